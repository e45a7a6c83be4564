# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Checkpoints and series of pictures: what is written to files and read again.

A snapshot (:mod:`~mpm_dolfinx.io.snapshot`) is the state of a problem as numbers and tables that do
not depend on the ranks; :mod:`~mpm_dolfinx.io.checkpoint` writes and reads it,
:mod:`~mpm_dolfinx.io.identity` tells whether it belongs to a problem. Series of grids for pictures
are written by :mod:`~mpm_dolfinx.io.series`. Whoever keeps an array of his own makes an heir of
:class:`Kept`, which says where its values live.
"""

from ..meshes.remesh import Column
from .snapshot import Kept, fill, of_cells

__all__ = ["Column", "Kept", "fill", "of_cells"]
