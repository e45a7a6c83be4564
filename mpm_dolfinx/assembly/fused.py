# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""``T^T K T`` domain by domain, in one compiled loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from .._core import loops
from ..history import Statistics
from ..parallel.totals import over_ranks
from ..particles.particles import Particles
from ..solvers.products import keep_rows
from .blocks import Block, Coupled, Coupling, Masses, Restriction
from .body_forms import BodyForms, no_values
from .supports import BodyLoops

__all__ = ["FusedTangent"]


class FusedTangent:
    """``T^T K T`` of all bodies of some fields at the unknowns, without ever forming K.

    Each rank adds its own domains' ``T_p^T K_p T_p`` to the entries of the matrix, and what belongs
    to rows of other ranks to values that it sends these, once for each assembly. The pattern, and
    with it the matrix, lasts until a node of a body enters another cell. The fields are blocks on
    the diagonal of one matrix, into which each writes; what couples a body and a field on it has
    blocks beside these.

    Args:
        comm: The ranks.
        fields: Bodies with their forms, those of each field; of fields that are no displacements
            those of ``couplings`` are known.
        couplings: What couples a displacement and another field, with the numbers of both.
        statistics: Where to count.
    """

    def __init__(
        self,
        comm: MPI.Comm,
        fields: Sequence[Sequence[tuple[Particles, BodyForms]]],
        couplings: Sequence[tuple[int, int, Coupling]],
        statistics: Statistics,
    ) -> None:
        self._comm = comm
        coupled = [coupling.places[0] for _, _, coupling in couplings]

        def loops_of(body: tuple[Particles, BodyForms]) -> BodyLoops:
            return BodyLoops(*body, any(body[0] is one for one in coupled))

        self._blocks = [Block(comm, [loops_of(body) for body in bodies]) for bodies in fields]
        self._couplings = [
            Coupled(self._blocks[i], self._blocks[j], coupling) for i, j, coupling in couplings
        ]
        self._statistics = statistics
        self._A: PETSc.Mat | None = None
        self._rows: tuple[Any, Any] = (), ()  # of the matrix, in columns of this rank and in others
        self._room = [no_values, no_values]  # for entries in columns of this rank, and in others

    def restrict(
        self,
        fields: Sequence[Restriction],
        sizes: tuple[int, int],
        release: Callable[[], None] | None = None,
    ) -> None:
        """Take over the present transfer and unknowns (collective).

        Args:
            fields: Those of each field.
            sizes: Number of unknowns of this rank and of all ranks.
            release: Called before the matrix is made anew, so that others let go of the old one.
        """
        same = self._A is not None and self._A.getSizes()[0] == sizes
        pairs = list(zip(self._blocks, fields, strict=True))
        for block, field in sorted(pairs, key=lambda pair: pair[0].is_carried):  # (hosts first)
            same &= block.restrict(field)
        if not over_ranks(self._comm, same, MPI.LAND):
            self._A, self._rows = None, ((), ())
            if release is not None:
                release()
            self._make_matrix(fields, sizes)
            self._statistics.count("patterns")
        for block, field in zip(self._blocks, fields, strict=True):
            block.transfer(field)

    def forget(self) -> None:
        """Make the pattern anew in the next step."""
        self._A = None

    def _make_matrix(self, fields: Sequence[Restriction], sizes: tuple[int, int]) -> None:
        lasts = np.cumsum(self._comm.allgather(sizes[0]))
        start = int(lasts[self._comm.rank]) - sizes[0]
        for block in self._blocks:
            block.make_patterns()
        found = [
            block.make_rows((start + field.part.start, start + field.part.stop), start, lasts)
            for block, field in zip(self._blocks, fields, strict=True)
        ]
        parts = [field.part for field in fields]
        csr = [_stacked(parts, [rows[side] for rows in found], sizes[0]) for side in range(2)]
        values = [self._entries(side, len(columns)) for side, (_, columns) in enumerate(csr)]
        ends = [np.cumsum([len(rows[side][1]) for rows in found])[:-1] for side in range(2)]
        split = zip(*(np.split(*each) for each in zip(values, ends, strict=True)), strict=True)
        for block, (inside, outside) in zip(self._blocks, split, strict=True):
            block.inside, block.outside = inside, outside
        matrices = [(*one, data) for one, data in zip(csr, values, strict=True)]
        offsets, columns, entries = matrices[1]
        self._rows = matrices[0], (offsets, columns.copy(), entries)  # (PETSc numbers them anew)
        self._A = PETSc.Mat().createAIJWithArrays(
            (sizes, sizes),
            matrices[0] if self._comm.size == 1 else tuple(matrices),
            comm=self._comm,
        )
        keep_rows(self._A, *matrices[0])

    def _entries(self, side: int, count: int) -> NDArray[np.float64]:
        """Return room for entries, that of the matrix before where it is large enough.

        Memory that is new has to be cleared by the system, page by page.
        """
        spare = count // 20
        if not count <= len(self._room[side]) <= count + 2 * spare:
            self._room[side] = np.empty(count + spare)
        room = self._room[side][:count]
        room[:] = 0.0
        return room

    def weigh(self, masses: Masses) -> PETSc.Mat:
        """Return ``T^T M T``, and keep it for :meth:`assemble` in this step (collective).

        What :meth:`assemble` has returned is overwritten.

        Args:
            masses: M of domains.
        """
        assert self._A is not None
        for block in self._blocks:
            block.weigh(masses)
        self._A.assemble()
        # Of all components of two nodes, masses join equal ones.
        offsets, columns, values = self._A.getValuesCSR()
        kept = values != 0.0
        ends = np.concatenate([[0], np.cumsum(kept)])[offsets]
        csr = (ends.astype(PETSc.IntType), columns[kept], values[kept])
        return PETSc.Mat().createAIJ(self._A.getSizes(), csr=csr, comm=self._comm)

    def assemble(self, factor: float = 0.0) -> PETSc.Mat:
        """Return ``T^T K T``; the same object as long as the pattern lasts (collective).

        Args:
            factor: How often the masses of :meth:`weigh` are added, if there are any.
        """
        assert self._A is not None
        for block in self._blocks:
            block.begin()
        for coupled in self._couplings:
            coupled.add()
        for block in self._blocks:
            block.assemble(factor)
        self._A.assemble()
        return self._A

    def add(self, part: PETSc.Mat) -> bool:
        """Add to the last tangent, if it has a place for each entry (collective).

        Args:
            part: A matrix in all unknowns.

        Returns:
            Whether it has; nothing is added otherwise.
        """
        assert self._A is not None
        given = part.getValuesCSR(), *self._rows, self._A.getOwnershipRange()
        if not over_ranks(self._comm, loops.add_entries(*given, False), MPI.LAND):
            return False
        loops.add_entries(*given, True)
        self._A.assemble()
        return True


def _stacked(
    parts: Sequence[slice],
    entries: Sequence[tuple[NDArray[np.int32], NDArray[np.int32]]],
    count: int,
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return offsets and columns of rows below each other, of which each part has some."""
    counts = np.zeros(count + 1, dtype=PETSc.IntType)
    for part, (starts, _) in zip(parts, entries, strict=True):
        counts[part.start + 1 : part.stop + 1] = np.diff(starts)
    whole = [columns for _, columns in entries if len(columns) > 0]
    columns = whole[0] if len(whole) == 1 else np.concatenate([entries[0][1][:0], *whole])
    return np.cumsum(counts, dtype=PETSc.IntType), columns.astype(PETSc.IntType, copy=False)
