# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A body: a mesh of particle domains, its displacement, and how it rides on the background.

:class:`~mpm_dolfinx.particles.particles.Particles` joins what stands in the files: the domains and
their deformation, the undeformed reference, particles that are deleted, and the fields for output.
Its displacement d lives on the body mesh; T of :mod:`mpm_dolfinx.transfer` gives the increments.
What a material says of the body comes through a protocol
(:mod:`~mpm_dolfinx.particles.response`), since nothing here knows a material.
"""

from .particles import Particles

__all__ = ["Particles"]
