# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Thin structures in bodies: bars, cables, anchors, nails, geogrids, membranes and linings.

A structure is a term (:mod:`~mpm_dolfinx.structures.structure`) with a mesh of lower dimension
(:mod:`~mpm_dolfinx.structures.layout`), whose nodes follow the bodies that they lie in
(:mod:`~mpm_dolfinx.structures.hosts`) or slip along them (:mod:`~mpm_dolfinx.structures.bond`). Its
stretches make forces by a law (:mod:`~mpm_dolfinx.structures.laws`), and these act on its nodes
(:mod:`~mpm_dolfinx.structures.stretching`).
"""

from .bond import Bond
from .membrane import Membrane
from .truss import Truss

__all__ = ["Bond", "Membrane", "Truss"]
