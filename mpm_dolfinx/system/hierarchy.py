# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The coarse levels of multigrid: the unknowns follow grids of ever larger boxes.

What multigrid needs is a basis for the smooth displacements of the background. The multilinear
basis of boxes twice as large as its cells is one for every background, of simplices as well as of
boxes, and for every degree; it is taken at the nodes of the free dofs, for each component. Boxes
twice as large again follow, until few dofs are left.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..background.grids import box_weights, cell_lines, coarser, grid_lines
from ..meshes.boxes import BOX_CELLS
from ..solvers.products import keep_rows
from ..tolerances import NEGLIGIBLE
from .numbering import FreeDofs

__all__ = ["Boxes", "FieldDofs", "interpolations"]


class FieldDofs(NamedTuple):
    """Dofs of a field on one level.

    Attributes:
        numbers: Their places in the level's numbering, shape ``(n,)``.
        points: Where they are, shape ``(n, gdim)``.
        components: Their components, shape ``(n,)``.
        lines: The lines of the next coarser grid.
        bs: Number of components.
    """

    numbers: NDArray[np.int64]
    points: NDArray[np.float64]
    components: NDArray[np.int64]
    lines: list[NDArray[np.float64]]
    bs: int

    @property
    def size(self) -> int:
        """Number of dofs of the coarser grid, used or not."""
        return self.bs * int(np.prod([len(line) for line in self.lines]))

    def weights(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return numbers of dofs of the coarser grid, and what each dof has of them."""
        nodes, values = box_weights(self.lines, self.points)
        return nodes * self.bs + self.components[:, None], values

    def coarse(self, dofs: NDArray[np.int64], numbers: NDArray[np.int64]) -> FieldDofs:
        """Return dofs of the coarser grid, which have places in the coarser level's numbering."""
        nodes, components = np.divmod(dofs, self.bs)
        shape = tuple(len(line) for line in self.lines)
        index = np.unravel_index(nodes, shape)
        points = np.stack([line[i] for line, i in zip(self.lines, index, strict=True)], axis=1)
        return FieldDofs(numbers, points, components, coarser(self.lines), self.bs)


class Boxes:
    """The boxes of multigrid over one background.

    Args:
        V: The background space.
    """

    def __init__(self, V: fem.FunctionSpace) -> None:
        self._V = V

    @cached_property
    def nested(self) -> bool:
        """Whether they follow the background: a grid of degree 1, or of boxes (collective)."""
        degree = self._V.ufl_element().degree
        boxes = degree == 2 and self._V.mesh.basix_cell() in BOX_CELLS
        return grid_lines(self._V) is not None and (degree == 1 or boxes)

    @cached_property
    def _lines(self) -> list[NDArray[np.float64]]:
        lines = cell_lines(self._V)
        return lines if self._V.ufl_element().degree > 1 else coarser(lines)

    def finest(self, free: FreeDofs, dofs: NDArray[np.int32], first: int) -> FieldDofs:
        """Return unknowns of V as the finest level (collective).

        Args:
            free: The unknowns.
            dofs: Their local numbers on V.
            first: Place of the first among this rank's unknowns.
        """
        V, bs = self._V, self._V.dofmap.index_map_bs
        nodes, components = np.divmod(dofs, bs)
        points = free.collect(V.tabulate_dof_coordinates()[nodes, : V.mesh.geometry.dim])
        numbers = first + np.arange(len(points))
        return FieldDofs(numbers, points, free.collect(components), self._lines, bs)


class _Entries(NamedTuple):
    """Entries of an interpolation: rows, numbers of coarse dofs of all fields, values."""

    rows: NDArray[np.int64]
    dofs: NDArray[np.int64]
    values: NDArray[np.float64]

    @classmethod
    def of(cls, fields: Sequence[FieldDofs]) -> _Entries:
        parts, first = [], 0
        for field in fields:
            dofs, values = field.weights()
            rows = np.broadcast_to(field.numbers[:, None], dofs.shape)
            kept = values > NEGLIGIBLE
            parts.append((rows[kept], first + dofs[kept], values[kept]))
            first += field.size
        return cls(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def interpolations(
    comm: MPI.Comm, count: int, fields: Sequence[FieldDofs], coarsest: int
) -> list[PETSc.Mat]:
    """Return the interpolations to the dofs of each level from the next coarser one (collective).

    Args:
        comm: The ranks.
        count: Number of this rank's unknowns.
        fields: This rank's unknowns, of each field; ``numbers`` are places among its own.
        coarsest: Number of dofs below which no coarser level is made.

    Returns:
        Matrices from the finest level on; none where there are few unknowns.
    """
    found: list[PETSc.Mat] = []
    total = comm.allreduce(count)
    entries = _Entries.of(fields)
    sums = _offered(comm, entries)
    owner: NDArray[np.int64] | None = None  # of the dofs of all ranks, below the finest level
    while total > coarsest:
        dofs, homes = _homes(sums, comm.size, coarsest)
        if len(dofs) >= total:
            break
        order = np.lexsort((dofs, homes))
        numbers = np.empty(len(dofs), dtype=np.int64)
        numbers[order] = np.arange(len(dofs))
        own = int(np.count_nonzero(homes == comm.rank))
        found.append(
            _matrix(comm, count, own, entries, numbers[np.searchsorted(dofs, entries.dofs)])
        )
        fields = _coarse(fields, dofs, numbers)
        whole = _Entries.of(fields)
        owner = homes[order]
        first = int(np.searchsorted(owner, comm.rank))
        mine = owner[whole.rows] == comm.rank
        entries = _Entries(whole.rows[mine] - first, whole.dofs[mine], whole.values[mine])
        sums = _summed(whole.dofs, owner[whole.rows], whole.values)
        count, total = own, len(dofs)
    return found


def _coarse(
    fields: Sequence[FieldDofs], dofs: NDArray[np.int64], numbers: NDArray[np.int64]
) -> list[FieldDofs]:
    """Return the dofs of the coarser level, of all ranks, by field."""
    ends = np.cumsum([field.size for field in fields])
    cuts = np.searchsorted(dofs, np.concatenate([[0], ends]))
    return [
        field.coarse(dofs[a:b] - (end - field.size), numbers[a:b])
        for field, end, a, b in zip(fields, ends, cuts[:-1], cuts[1:], strict=True)
    ]


type _Sums = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]


def _summed(
    dofs: NDArray[np.int64], ranks: NDArray[np.int64] | int, values: NDArray[np.float64]
) -> _Sums:
    """Return coarse dofs, ranks that use them and the sum of their values there."""
    span = int(np.max(ranks, initial=0)) + 1
    pairs, place = np.unique(dofs * span + ranks, return_inverse=True)
    return pairs // span, pairs % span, np.bincount(place, values, len(pairs))


def _offered(comm: MPI.Comm, entries: _Entries) -> _Sums:
    """Return the sums of :func:`_summed` over all ranks' rows (collective)."""
    dofs, ranks, sums = _summed(entries.dofs, 0, entries.values)
    parts = comm.allgather((dofs, np.full_like(ranks, comm.rank), sums))
    dofs, ranks, sums = (np.concatenate(part) for part in zip(*parts, strict=True))
    return dofs, ranks, sums


def _homes(offers: _Sums, size: int, coarsest: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return all coarse dofs, sorted, and the rank of each: which uses it most.

    Those of the coarsest level are the first rank's.
    """
    dofs, ranks, sums = offers
    order = np.lexsort((ranks, -sums, dofs))
    found, first = np.unique(dofs[order], return_index=True)
    homes = ranks[order][first]
    if len(found) <= coarsest and size > 1:
        homes = np.zeros_like(homes)
    return found, homes


def _matrix(
    comm: MPI.Comm, rows: int, columns: int, entries: _Entries, numbers: NDArray[np.int64]
) -> PETSc.Mat:
    """Return the matrix of this rank's rows (collective)."""
    order = np.lexsort((numbers, entries.rows))
    ends = np.cumsum(np.bincount(entries.rows, minlength=rows))
    csr = (
        np.concatenate([[0], ends]).astype(PETSc.IntType),
        numbers[order].astype(PETSc.IntType),
        entries.values[order],
    )
    matrix = PETSc.Mat().createAIJWithArrays(((rows, None), (columns, None)), csr, comm=comm)
    keep_rows(matrix, *csr)
    return matrix
