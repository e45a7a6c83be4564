# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The transfer from a background space to the nodes of domains, and what follows from it."""

from __future__ import annotations

from functools import cached_property

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from .matrix import transfer_action, transfer_matrix
from .method import CornerBasis
from .touched import TouchedNodes

__all__ = ["Transfer"]


class Transfer:
    """How a background space moves the nodes of domains that are in one place.

    When the domains are elsewhere there is another transfer. What is made of the rows is made
    when it is asked for.

    Args:
        rows: What the background does to the domains' corners.
        W: Space of the domains.
        V: Background space.

    Attributes:
        rows: As given.
    """

    def __init__(self, rows: CornerBasis, W: fem.FunctionSpace, V: fem.FunctionSpace) -> None:
        self.rows = rows
        self._W, self._V = W, V

    @cached_property
    def T(self) -> PETSc.Mat:
        """All dofs of W by all dofs of V (collective)."""
        return transfer_matrix(self.rows.basis, self._W, self._V)

    @cached_property
    def action(self) -> PETSc.Mat:
        """A matrix that multiplies as T does (collective); on one rank without entries."""
        if self._W.mesh.comm.size > 1:
            return self.T
        return transfer_action(self.rows.basis, self._W, self._V)

    @cached_property
    def active_nodes(self) -> NDArray[np.int32]:
        """Nodes of V with weight that this rank owns, local numbers, sorted (collective)."""
        owned = self._W.dofmap.index_map.size_local
        return TouchedNodes(self._V, [self.rows.basis], [owned]).active
