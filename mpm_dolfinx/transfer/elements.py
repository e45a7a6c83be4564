# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Finite elements: each node of a body has an unknown of its own."""

from __future__ import annotations

from typing import override

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..background.basis import BackgroundBasis, PointBasis
from .method import CornerBasis, DomainState, Method

__all__ = ["FiniteElements"]


class FiniteElements(Method):
    """Nodes have unknowns of their own: T is the identity on W, which is V too.

    Args:
        V: Space of the body's own displacement.
    """

    name = "fem"
    shares_nodes = True
    at_nodes = True
    one_point = False
    free = True

    def __init__(self, V: fem.FunctionSpace) -> None:
        super().__init__(V)
        layout = V.dofmap.index_map
        local = np.arange(layout.size_local + layout.num_ghosts, dtype=np.int32)
        nodes: NDArray[np.int64] = layout.local_to_global(local)[:, None]
        ones = np.ones(nodes.shape)
        self._rows = CornerBasis(None, PointBasis(nodes, ones, np.ones(len(nodes), dtype=bool)))

    @override
    def rows(self, state: DomainState, background: BackgroundBasis) -> CornerBasis:
        return self._rows

    @override
    def domains(self, state: DomainState) -> NDArray[np.float64]:
        return state.corners
