# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Products of a tangent that is a sum over groups of domains."""

from __future__ import annotations

from typing import Any

from petsc4py import PETSc

import numpy as np

from .. import _compat
from ..constitutive.averaging import Array, Linearised
from ..particles.particles import Particles
from .petsc import MatrixSum

__all__ = ["LowRankTangent", "ReducedLowRank"]


class LowRankTangent:
    """The low-rank part of a body's tangent by PETSc's sparse products.

    With the vectors g, left and right of all groups as rows of sparse matrices G, L and R, the
    part is ``G^T R + L^T G``.

    Args:
        particles: The body.
        source: What knows the vectors.
    """

    def __init__(self, particles: Particles, source: Linearised) -> None:
        self._source = source
        self._W = particles.W
        self._nodes = particles.domain_nodes
        self._factors: list[PETSc.Mat] = []
        self._total = MatrixSum()
        self._products = _Products()

    def times(self, nodal: Array) -> Array:
        """Return :meth:`LowRankTerm.times` of the present part (collective)."""
        return self._source.linearise().times(nodal)

    def added_to(self, K: PETSc.Mat) -> PETSc.Mat:
        """Return K on W plus the low-rank part, always the same object (collective)."""
        parts = [K, *self._products.of(*self._filled())]
        return self._total.of(parts)

    def reduced(self, T: PETSc.Mat, last: ReducedLowRank | None) -> ReducedLowRank:
        """Return ``T^T`` times the part times T (collective).

        Args:
            T: Rows of W.
            last: What this returned before for the same T, if anything.
        """
        last = ReducedLowRank() if last is None else last
        for number, factor in enumerate(self._filled()):
            last.factors[number] = factor.matMult(T, result=last.factors[number])
        last.parts = last.products.of(*last.factors)
        return last

    def _filled(self) -> list[PETSc.Mat]:
        """Return G, L and R with their present values, always the same objects."""
        term = self._source.linearise()
        if not self._factors:
            self._factors = [self._empty() for _ in range(3)]
        for matrix, part in zip(self._factors, (term.g, term.left, term.right), strict=True):
            _compat.set_entries(matrix, np.ascontiguousarray(part).ravel())
        return self._factors

    def _empty(self) -> PETSc.Mat:
        """Return a matrix with a row for each group and the dofs of W as columns."""
        layout, gdim = self._W.dofmap.index_map, self._W.dofmap.index_map_bs
        blocks = layout.local_to_global(self._nodes.ravel()).astype(PETSc.IntType)
        dofs = (blocks[:, None] * gdim + np.arange(gdim, dtype=PETSc.IntType)).ravel()
        groups = self._source.groups
        rows = np.repeat(groups.number, self._nodes.shape[1] * gdim).astype(PETSc.IntType)
        matrix = PETSc.Mat().create(comm=self._W.mesh.comm)
        columns = (layout.size_local * gdim, layout.size_global * gdim)
        matrix.setSizes(((groups.owned, groups.count), columns))
        matrix.setType("aij")
        # PETSc sorts the index arrays in place.
        _compat.set_entry_places(matrix, rows, dofs)
        return matrix


class _Products:
    """``G^T R`` and ``L^T G`` of matrices whose sparsity does not change."""

    def __init__(self) -> None:
        self._results: list[PETSc.Mat | None] = [None, None]

    def of(self, G: PETSc.Mat, L: PETSc.Mat, R: PETSc.Mat) -> list[PETSc.Mat]:
        """Return both products for new values, always the same objects."""
        first, second = self._results
        products = [G.transposeMatMult(R, result=first), L.transposeMatMult(G, result=second)]
        self._results = [*products]
        return products


class ReducedLowRank:
    """Factors and products of one T.

    Attributes:
        factors: G T, L T and R T.
        parts: The matrices whose sum is the reduced part.
    """

    def __init__(self) -> None:
        self.factors: list[Any] = [None, None, None]
        self.products = _Products()
        self.parts: list[PETSc.Mat] = []
