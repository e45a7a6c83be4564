# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""CPDI2 and CPDI: the background is evaluated at the corners of the domains."""

from __future__ import annotations

from typing import override

import numpy as np
from numpy.typing import NDArray

from ..background.basis import BackgroundBasis
from .method import CornerBasis, DomainState, Method

__all__ = ["CPDI", "CPDI2"]


class CPDI2(Method):
    """Corners ride on the background (Sadeghirad, Brannon & Guilkey 2013)."""

    name = "cpdi2"
    shares_nodes = True
    at_nodes = True
    one_point = False

    @override
    def rows(self, state: DomainState, background: BackgroundBasis) -> CornerBasis:
        return CornerBasis(None, background.at(state.positions))

    @override
    def domains(self, state: DomainState) -> NDArray[np.float64]:
        return state.corners


class CPDI(Method):
    """Corners of a parallelogram that F_p deforms (Sadeghirad, Brannon & Burghardt 2011)."""

    name = "cpdi"
    at_nodes = True

    @override
    def rows(self, state: DomainState, background: BackgroundBasis) -> CornerBasis:
        corners = state.parallelograms()
        positions = state.nodes.copy()
        positions[state.domains] = corners
        return CornerBasis(corners, background.at(positions[: state.domains.size]))
