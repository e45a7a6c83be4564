# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Products of a tangent that is a sum over groups of domains."""

from __future__ import annotations

from petsc4py import PETSc

import numpy as np

from .. import _compat
from ..constitutive.averaging import Array, Linearised
from ..particles.particles import Particles
from .petsc import with_entries_at

__all__ = ["LowRankTangent", "ReducedLowRank"]


class LowRankTangent:
    """The low-rank part of a body's tangent by PETSc's sparse products.

    With the k-th left and right vectors of all groups as rows of sparse matrices L_k and R_k, the
    part is the sum of ``L_k^T R_k``.

    Args:
        particles: The body.
        source: What knows the vectors.
    """

    def __init__(self, particles: Particles, source: Linearised) -> None:
        self._source = source
        self._W = particles.W
        self._nodes = particles.domain_nodes
        self._factors: list[PETSc.Mat] = []
        self._pairs: list[tuple[int, int]] = []

    def times(self, nodal: Array) -> Array:
        """Return :meth:`LowRankTerm.times` of the present part (collective)."""
        return self._source.linearise().times(nodal)

    def reduced(self, T: PETSc.Mat, last: ReducedLowRank | None) -> ReducedLowRank:
        """Return ``T^T`` times the part times T (collective).

        Args:
            T: Rows of W.
            last: What this returned before for the same T, if anything.
        """
        last = ReducedLowRank() if last is None else last
        factors = self._filled()
        known = last.factors or [None] * len(factors)
        last.factors = [
            factor.matMult(T, result=result) for factor, result in zip(factors, known, strict=True)
        ]
        last.parts = last.products.of(last.factors, self._pairs)
        return last

    def _filled(self) -> list[PETSc.Mat]:
        """Return the factors with their present values, always the same objects.

        Vectors that are the same array are one factor.
        """
        term = self._source.linearise()
        parts: list[Array] = []
        numbers = [_number(parts, part) for part in (*term.left, *term.right)]
        count = len(term.left)
        self._pairs = list(zip(numbers[:count], numbers[count:], strict=True))
        if not self._factors:
            self._factors = [self._empty() for _ in parts]
        for matrix, part in zip(self._factors, parts, strict=True):
            _compat.set_entries(matrix, np.ascontiguousarray(part).ravel())
        return self._factors

    def _empty(self) -> PETSc.Mat:
        """Return a matrix with a row for each group and the dofs of W as columns."""
        layout, gdim = self._W.dofmap.index_map, self._W.dofmap.index_map_bs
        blocks = layout.local_to_global(self._nodes.ravel())
        dofs = blocks[:, None] * gdim + np.arange(gdim, dtype=PETSc.IntType)
        groups = self._source.groups
        rows = np.repeat(groups.number, self._nodes.shape[1] * gdim)
        columns = (layout.size_local * gdim, layout.size_global * gdim)
        sizes = ((groups.owned, groups.count), columns)
        return with_entries_at(self._W.mesh.comm, sizes, rows, dofs)


def _number(parts: list[Array], part: Array) -> int:
    """Return the number of an array in a list, to which it is added if it is not there."""
    for number, known in enumerate(parts):
        if known is part:
            return number
    parts.append(part)
    return len(parts) - 1


class _Products:
    """``L^T R`` of pairs of matrices whose sparsity does not change."""

    def __init__(self) -> None:
        self._results: list[PETSc.Mat] = []

    def of(self, factors: list[PETSc.Mat], pairs: list[tuple[int, int]]) -> list[PETSc.Mat]:
        """Return the products for new values, always the same objects."""
        known = self._results or [None] * len(pairs)
        self._results = [
            factors[left].transposeMatMult(factors[right], result=result)
            for (left, right), result in zip(pairs, known, strict=True)
        ]
        return list(self._results)


class ReducedLowRank:
    """Factors and products of one T.

    Attributes:
        factors: Those of the tangent times T.
        parts: The matrices whose sum is the reduced part.
    """

    def __init__(self) -> None:
        self.factors: list[PETSc.Mat] = []
        self.products = _Products()
        self.parts: list[PETSc.Mat] = []
