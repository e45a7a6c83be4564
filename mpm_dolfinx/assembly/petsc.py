# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""PETSc matrices and vectors that sums over cells are added to."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem
from dolfinx.fem import petsc as fem_petsc

from .. import _compat

__all__ = [
    "MatrixSum",
    "absolute",
    "assemble_into",
    "assemble_matrix",
    "assembled",
    "blocked",
    "create_vector",
    "load_quotient",
    "marked",
    "with_entries_at",
]

# Their types name the first of several dispatched signatures only.
assemble_vector: Any = fem_petsc.assemble_vector
assemble_matrix: Any = fem_petsc.assemble_matrix
SUBSET = PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN
DIFFERENT = PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN
SAME = PETSc.Mat.Structure.SAME_NONZERO_PATTERN


def assemble_into(
    vector: PETSc.Vec, forms: list[fem.Form], start: NDArray[np.float64] | None = None
) -> None:
    """Assemble forms, added to what this rank has at its own and ghost dofs."""
    with vector.localForm() as local:
        local.set(0.0)
        if start is not None:
            local.array_w[:] = start
    for form in forms:
        assemble_vector(vector, form)
    vector.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)


def marked(V: fem.FunctionSpace, nodes: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which of this rank's own nodes any rank names by their global numbers."""
    imap = V.dofmap.index_map
    if V.mesh.comm.size == 1:
        alone = np.zeros(imap.size_local, dtype=bool)
        alone[nodes] = True
        return alone
    mark = PETSc.Vec().createMPI((imap.size_local, imap.size_global), comm=V.mesh.comm)
    named = np.unique(nodes).astype(PETSc.IntType)
    mark.setValues(named, np.ones(len(named)), addv=PETSc.InsertMode.ADD_VALUES)
    mark.assemble()
    result = np.asarray(mark.array_r > 0.0)
    mark.destroy()
    return result


def assembled(
    V: fem.FunctionSpace,
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    values: NDArray[np.float64],
    bs: int = 1,
) -> PETSc.Mat:
    """Return the sum of entries of any rank on nodes (bs 1) or dofs of V (collective)."""
    imap = V.dofmap.index_map
    sizes = (imap.size_local * bs, imap.size_global * bs)
    matrix = with_entries_at(V.mesh.comm, (sizes, sizes), rows, columns)
    _compat.set_entries(matrix, np.ascontiguousarray(values))
    return matrix


def with_entries_at(
    comm: MPI.Comm,
    sizes: Sequence[tuple[int, int]],
    rows: NDArray[Any],
    columns: NDArray[Any],
) -> PETSc.Mat:
    """Return a matrix whose entries :func:`._compat.set_entries` sums up at places (collective).

    Args:
        comm: The ranks.
        sizes: Numbers of rows of this rank and of all, and of columns.
        rows: Global row of each entry, any rank's, of any shape.
        columns: Global column of each entry, likewise.
    """
    matrix = PETSc.Mat().create(comm=comm)
    matrix.setSizes(sizes)
    matrix.setType("aij")
    # (copies: PETSc sorts them in place)
    _compat.set_entry_places(
        matrix, *(part.astype(PETSc.IntType).ravel() for part in (rows, columns))
    )
    return matrix


def blocked(
    V: fem.FunctionSpace,
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    values: NDArray[np.float64],
    bs: int,
) -> PETSc.Mat:
    """Return entries on nodes summed up as a matrix on dofs, the same for all components."""
    scalar = assembled(V, rows, columns, values)
    offsets, nodes, data = scalar.getValuesCSR()
    scalar.destroy()
    count = np.repeat(np.diff(offsets), bs)
    indptr = np.concatenate([[0], np.cumsum(count)])
    place = np.repeat(np.repeat(offsets[:-1], bs) - indptr[:-1], count) + np.arange(indptr[-1])
    component = np.repeat(np.tile(np.arange(bs), len(offsets) - 1), count)
    imap = V.dofmap.index_map
    sizes = (imap.size_local * bs, imap.size_global * bs)
    indices = (nodes[place] * bs + component).astype(PETSc.IntType)
    csr = (indptr.astype(PETSc.IntType), indices, data[place])
    return PETSc.Mat().createAIJ((sizes, sizes), csr=csr, comm=V.mesh.comm)


class MatrixSum:
    """The sum of matrices, of which each keeps its sparsity as long as it is the same object."""

    def __init__(self) -> None:
        self._parts: list[PETSc.Mat] = []
        self._total: PETSc.Mat | None = None
        self._holds = False  # whether the first has a place for each entry of the others

    def of(self, parts: Sequence[PETSc.Mat]) -> PETSc.Mat:
        """Return the sum, the same object for the same parts (collective).

        Args:
            parts: Matrices of the same size and layout; a single one is returned as it is.
        """
        if len(parts) == 1:
            return parts[0]
        known = len(parts) == len(self._parts) and all(
            one is other for one, other in zip(parts, self._parts, strict=True)
        )
        if not known or self._total is None:
            self._parts = list(parts)
            self._total = parts[0].copy()
            before = _num_entries(self._total)
            for part in parts[1:]:
                self._total.axpy(1.0, part, structure=DIFFERENT)
            self._holds = _num_entries(self._total) == before
            return self._total
        if self._holds:
            parts[0].copy(self._total, structure=SAME)
        else:
            self._total.zeroEntries()
            self._total.axpy(1.0, parts[0], structure=SUBSET)
        for part in parts[1:]:
            self._total.axpy(1.0, part, structure=SUBSET)
        return self._total


def _num_entries(matrix: PETSc.Mat) -> float:
    """Return the number of entries of a matrix that have a place (collective)."""
    return float(matrix.getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)["nz_used"])


def absolute(matrix: PETSc.Mat) -> PETSc.Mat:
    """Return a matrix with the absolute values of another (collective)."""
    indptr, columns, values = matrix.getValuesCSR()
    csr = indptr, columns, np.abs(values)
    return PETSc.Mat().createAIJ(matrix.getSizes(), csr=csr, comm=matrix.comm)


def create_vector(V: fem.FunctionSpace) -> PETSc.Vec:
    """Return a vector with ghosts for a space, on the communicator of its mesh (collective).

    DOLFINx makes it on the index map's own communicator, which is out of reach once the space is
    gone; then PETSc could not free the vector any more, nor the communicator.
    """
    places, block = V.dofmap.index_map, V.dofmap.index_map_bs
    sizes = (block * places.size_local, block * places.size_global)
    ghosts = places.ghosts.astype(PETSc.IntType)
    return PETSc.Vec().createGhost(ghosts, sizes, bsize=block, comm=V.mesh.comm)


def load_quotient(
    load: fem.Constant, like: PETSc.Vec, forms: list[fem.Form], order: int
) -> tuple[PETSc.Vec, float]:
    """Return a difference quotient of vectors by the load factor (collective).

    Args:
        load: The load factor.
        like: A vector of the same layout.
        forms: The vectors, which add up.
        order: 1, which is the derivative where they are affine in the load factor, or 2, which is
            zero there.

    Returns:
        The quotient, and the size of what it is the difference of.
    """
    coefficients = {1: (-1.0, 1.0), 2: (1.0, -2.0, 1.0)}[order]
    present, size = load.value.copy(), 0.0
    total, at = like.duplicate(), like.duplicate()
    total.set(0.0)
    for factor, coefficient in enumerate(coefficients):
        load.value[...] = factor
        assemble_into(at, forms)
        total.axpy(coefficient, at)
        size += float(at.norm())
    load.value[...] = present
    return total, size
