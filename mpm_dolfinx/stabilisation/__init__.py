# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Stabilisation of badly supported dofs.

Background dofs that hardly anything of a body supports make a tangent singular or nearly so. They
are held by a penalty on facets (:mod:`~mpm_dolfinx.stabilisation.ghost_penalty`);
:mod:`~mpm_dolfinx.stabilisation.choice` chooses. Bodies that bear on each other are kept together
where the background would let them part (:mod:`~mpm_dolfinx.stabilisation.joints`).
"""

from .choice import joints_of, stabilisation_of
from .ghost_penalty import PENALTY, GhostPenalty

__all__ = ["PENALTY", "GhostPenalty", "joints_of", "stabilisation_of"]
