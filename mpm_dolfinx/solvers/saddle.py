# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Multigrid where other unknowns stand beside displacements, as a pressure does."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

from petsc4py import PETSc

import numpy as np

from .multigrid import Multigrid

__all__ = ["Fields", "SaddleMultigrid"]


class Fields(Protocol):
    """Unknowns of several fields, as multigrid must know them. All calls are collective."""

    def diagonal(self, K: PETSc.Mat) -> PETSc.Vec:
        """Return sizes of a tangent's diagonal; for values that of their Schur complement."""

    def splits(self) -> Sequence[tuple[str, slice]]:
        """Return names of the fields, and where their unknowns are among this rank's."""

    def mass(self) -> PETSc.Mat:
        """Return the mass matrix of the unknowns that are no displacements, numbered alone."""

    def interpolations(self, coarsest: int, values: bool = False) -> Sequence[PETSc.Mat]:
        """Return the interpolations to the unknowns of each level from the next coarser one.

        Args:
            coarsest: Number of unknowns below which no coarser level is made.
            values: Whether of those that are no displacements, numbered alone.
        """


class _Parts(NamedTuple):
    """Parts of a tangent; see :class:`SaddleMultigrid`.

    Attributes:
        places: Rows and columns of A, B and D.
        blocks: These.
        u: A vector of displacements.
        f: Another.
        p: A vector of values.
        g: Another.
        M: ``c r M r``.
        S: The Schur complement.
    """

    places: list[tuple[PETSc.IS, PETSc.IS]]
    blocks: list[PETSc.Mat]
    u: PETSc.Vec
    f: PETSc.Vec
    p: PETSc.Vec
    g: PETSc.Vec
    M: PETSc.Mat
    S: PETSc.Mat


class SaddleMultigrid:
    """Makes a PETSc PC a block triangle with a V cycle for each of its diagonal blocks.

    With displacements u and the values p of all other fields a tangent is ``[[A, B], [C, D]]``. In
    its Schur complement ``D - C A^-1 B`` the second part is as large as a mass matrix M over a
    modulus (Elman, Silvester & Wathen 2014, section 4.2). Which, the tangent tells: with
    ``r = |diag(C diag(A)^-1 B) / diag(M)|^1/2`` the Schur complement is taken for

        S = D - c r M r ,    c = p . C A^-1 B p / p . r M r p

    with c from one vector p, and a V cycle for ``A^-1``. D has the storage and the diffusion of a
    pore pressure. A residual (f, g) becomes ``p = S^-1 g``, ``u = A^-1 (f - B p)``. Where p carries
    all change of volume, A is singular for a body that swells; its diagonal grows by a share, the
    square of the cells' size over the body's.

    Args:
        pc: The preconditioner (collective).
        fields: What is known of the unknowns, of which displacements come first.
        coarsest: Most unknowns of the coarsest levels.
        symmetric: Whether tangents are symmetric.
        dim: Dimension of space.

    Attributes:
        levels: Number of levels below the finest.
    """

    def __init__(
        self, pc: PETSc.PC, fields: Fields, coarsest: int, symmetric: bool, dim: int
    ) -> None:
        self._fields, self._dim = fields, dim
        self._pcs = [PETSc.PC().create(pc.comm) for _ in range(2)]
        self._cycles = [
            Multigrid(cycle, fields.interpolations(coarsest, values=values), symmetric)
            for cycle, values in zip(self._pcs, (False, True), strict=True)
        ]
        self.levels = max(cycle.levels for cycle in self._cycles)
        self._first: int = fields.splits()[0][1].stop
        self._parts: _Parts | None = None
        pc.reset()
        pc.setType("python")
        pc.setPythonContext(self)

    def set(self, K: PETSc.Mat) -> None:
        """Take over the values of a tangent (collective)."""
        if self._parts is None:
            self._parts = self._parted(K)
        else:
            for (rows, columns), block in zip(self._parts.places, self._parts.blocks, strict=True):
                K.createSubMatrix(rows, columns, block)
            self._soften(self._parts.blocks[0])
        blocks, S = self._parts.blocks, self._parts.S
        S.zeroEntries()
        S.axpy(1.0, blocks[2], PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
        S.axpy(-1.0, self._parts.M, PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
        self._take(0, blocks[0])
        self._take(1, S)

    def _soften(self, A: PETSc.Mat) -> None:
        """Add to the diagonal of A as much as its smallest eigenvalues are."""
        diagonal = A.getDiagonal()
        diagonal.abs()
        diagonal.scale((A.getSize()[0] / self._dim) ** (-2.0 / self._dim))
        A.setDiagonal(diagonal, addv=PETSc.InsertMode.ADD_VALUES)

    def _take(self, number: int, matrix: PETSc.Mat) -> None:
        pc = self._pcs[number]
        pc.setOperators(matrix, matrix)
        self._cycles[number].set(matrix)
        pc.setUp()

    def _parted(self, K: PETSc.Mat) -> _Parts:
        """Part the unknowns, and find the size of the Schur complement."""
        start, stop = K.getOwnershipRange()
        moving, values = (
            PETSc.IS().createStride(b - a, first=a, step=1, comm=K.comm)
            for a, b in ((start, start + self._first), (start + self._first, stop))
        )
        places = [(moving, moving), (moving, values), (values, values)]
        A, B, D = blocks = [K.createSubMatrix(rows, columns) for rows, columns in places]
        self._soften(A)
        u, f = B.createVecLeft(), B.createVecLeft()
        p, g = D.createVecRight(), D.createVecRight()
        M = self._fields.mass()
        diagonal = M.getDiagonal().array_r
        size = D.getDiagonal().array_r - self._fields.diagonal(K).array_r[self._first :]
        root = p.duplicate()
        known = diagonal > 0.0
        root.array_w[:] = np.sqrt(np.abs(size) / np.where(known, diagonal, 1.0)) * known
        M.diagonalScale(L=root, R=root)
        self._take(0, A)
        parts = _Parts(places, blocks, u, f, p, g, M, M + D)
        M.scale(self._modulus(K, parts, start + self._first))
        return parts

    def _modulus(self, K: PETSc.Mat, parts: _Parts, first: int) -> float:
        """Return c."""
        whole, force = K.createVecRight(), K.createVecLeft()
        p, g = parts.p, parts.g
        p.array_w[:] = np.sin(1.0 + 1.7 * (first + np.arange(p.getLocalSize())))
        parts.M.mult(p, g)
        expected = p.dot(g)
        parts.blocks[1].mult(p, parts.f)
        self._pcs[0].apply(parts.f, parts.u)
        whole.set(0.0)
        whole.array_w[: self._first] = parts.u.array_r
        K.mult(whole, force)
        g.array_w[:] = force.array_r[self._first :]
        found = p.dot(g)
        return float(found / expected) if expected > 0.0 else 0.0

    def apply(self, _: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Apply the preconditioner (collective)."""
        assert self._parts is not None
        first, residual = self._first, x.array_r
        _, blocks, u, f, p, g, _, _ = self._parts
        g.array_w[:] = residual[first:]
        self._pcs[1].apply(g, p)
        blocks[1].mult(p, u)
        f.array_w[:] = residual[:first] - u.array_r
        self._pcs[0].apply(f, u)
        values = y.array_w
        values[:first] = u.array_r
        values[first:] = p.array_r
