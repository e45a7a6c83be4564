# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Unknowns that a term has of its own, as the motions of a rigid body are.

Beside the nodes of a body, which a background moves, they are nodes with the identity for T.
"""

from __future__ import annotations

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from .hierarchy import FieldDofs
from .predictor import extrapolated

__all__ = ["OwnUnknowns"]


class OwnUnknowns:
    """A few unknowns of a term.

    All ranks know them; in vectors and matrices of all unknowns they are the first rank's.

    Args:
        comm: The ranks.
        total: Their number.

    Attributes:
        total: As given.
        count: Number of those on this rank.
        part: Where they are among this rank's unknowns.
        start: Where the term lets them begin in a step, shape ``(total,)``.
        values: What is added to that in the present residual.
        residual: Forces on them, which the term sets in its ``update()``.
        size: Size of what these consist of, which it sets too.
        advice: What is to be done where they find no balance.
        expected: Where Newton's method starts that predicts a step; ``None``: as the past says.
        past: Sizes of the last steps, two at most, and where they were at their ends.
    """

    def __init__(self, comm: MPI.Comm, total: int) -> None:
        self._comm, self.total = comm, total
        self.count = total if comm.rank == 0 else 0
        self.part = slice(0, 0)
        self.start = np.zeros(total)
        self.values = np.zeros(total)
        self.residual = np.zeros(total)
        self.size = 0.0
        self.advice = ""
        self.expected: NDArray[np.float64] | None = None
        self.past: list[tuple[float, list[NDArray[np.float64]]]] = []
        self._selection: PETSc.Mat | None = None
        self._matrix: PETSc.Mat | None = None

    # -- Their numbers ----------------------------------------------------------------------------

    @property
    def owners(self) -> NDArray[np.int64]:
        """Rank of each."""
        return np.zeros(self.total, dtype=np.int64)

    @property
    def places(self) -> NDArray[np.int64]:
        """Place of each among its rank's."""
        return np.arange(self.total)

    @property
    def off_rank(self) -> NDArray[np.int64]:
        """None: see :attr:`.FreeDofs.off_rank`."""
        return np.zeros(3, dtype=np.int64)

    def rigid_motions(self) -> list[NDArray[np.float64]]:
        """Return none."""
        return []

    @property
    def layout(self) -> tuple[int, int]:
        """Number of rows on this rank and on all, of matrices on them."""
        return self.count, self.total

    def find(self) -> OwnUnknowns:
        """Return itself: its unknowns are always the same."""
        return self

    def number(self, part: slice, numbers: NDArray[np.int64], sizes: tuple[int, int]) -> None:
        """Take over their numbers among all unknowns; see :meth:`.Field.number` (collective)."""
        self.part = part
        own = numbers[: self.count].astype(PETSc.IntType)
        csr = np.arange(self.count + 1, dtype=PETSc.IntType), own, np.ones(self.count)
        self._selection = PETSc.Mat().createAIJ((self.layout, sizes), csr=csr, comm=self._comm)

    @property
    def selection(self) -> PETSc.Mat:
        """Matrix that takes them out of all unknowns."""
        assert self._selection is not None
        return self._selection

    def level(self) -> FieldDofs:
        """Return them as the finest level of multigrid; they stay on all levels."""
        own = np.arange(self.count)
        line = [np.array([0.0, 1.0])]
        return FieldDofs(self.part.start + own, np.zeros((self.count, 1)), own, line, self.total)

    def matrix(self, values: NDArray[np.float64]) -> PETSc.Mat:
        """Return a matrix on them with given entries, the same object each time (collective).

        Args:
            values: Shape ``(total, total)``.
        """
        rows = np.arange(self.count + 1, dtype=PETSc.IntType)
        csr = rows * self.total, np.tile(np.arange(self.total, dtype=PETSc.IntType), self.count)
        entries = np.ascontiguousarray(values[: self.count]).ravel()
        if self._matrix is None:
            sizes = (self.layout, self.layout)
            self._matrix = PETSc.Mat().createAIJ(sizes, csr=(*csr, entries), comm=self._comm)
        else:
            self._matrix.setValuesCSR(*csr, entries)
            self._matrix.assemble()
        return self._matrix

    # -- Vectors ----------------------------------------------------------------------------------

    def spread(self, x: PETSc.Vec) -> None:
        """Take the values that they have in x (collective)."""
        self.values = self._comm.bcast(x.array_r[self.part].copy())

    def collect(self, F: PETSc.Vec) -> None:
        """Set their part of F to their residual."""
        F.array_w[self.part] = self.residual[: self.count]

    def of(self, x: PETSc.Vec) -> PETSc.Vec:
        """Return their part of x, as a vector on them (collective)."""
        own = self.selection.createVecLeft()
        self.selection.mult(x, own)
        return own

    def left(self) -> float:
        """Return the share of their forces that is left."""
        return float(np.linalg.norm(self.residual)) / self.size if self.size > 0.0 else 0.0

    def predict(self, x: PETSc.Vec, size: float) -> None:
        """Set their part of x to what is expected of a step of some size."""
        guess = self.expected
        if guess is None:
            guess = extrapolated(self.past, size)[0] if self.past else np.zeros(self.total)
        x.array_w[self.part] = (guess - self.start)[: self.count]

    def record(self, size: float, again: bool = False) -> None:
        """Take note of a step of some size that has converged, or of its correction."""
        ends = self.start + self.values
        if again and self.past:
            self.past = [*self.past[:-1], (self.past[-1][0], [ends])]
            return
        self.past = [*self.past[-1:], (size, [ends])] if size > 0.0 else []
