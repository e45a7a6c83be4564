# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The transfer T as a sparse matrix."""

from __future__ import annotations

from typing import Any

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from .._core import loops
from ..background.basis import PointBasis

__all__ = ["transfer_action", "transfer_matrix"]


def transfer_matrix(basis: PointBasis, W: fem.FunctionSpace, V: fem.FunctionSpace) -> PETSc.Mat:
    """Assemble T: the background basis at the nodes of W, for each component.

    Args:
        basis: Background basis at this rank's nodes of W, its own nodes first.
        W: Space of the domains.
        V: Background space.

    Returns:
        Matrix of all dofs of W by all dofs of V, global numbering (collective).
    """
    bs = V.dofmap.index_map_bs
    rows = W.dofmap.index_map
    columns = V.dofmap.index_map
    owned = rows.size_local
    csr = _entries(basis.nodes[:owned], basis.values[:owned], bs)
    sizes = (
        (owned * bs, rows.size_global * bs),
        (columns.size_local * bs, columns.size_global * bs),
    )
    return PETSc.Mat().createAIJ(sizes, csr=csr, comm=W.mesh.comm)


class _Action:
    """Context of a PETSc matrix that acts as T does, by the basis at the nodes of W."""

    def __init__(self, basis: PointBasis) -> None:
        self._rows = basis.nodes, basis.values

    def mult(self, _: PETSc.Mat, u: PETSc.Vec, d: PETSc.Vec) -> None:
        """Set d to ``T u``."""
        loops.apply_basis(*self._rows, u.array_r, d.array_w)

    def multTranspose(self, _: PETSc.Mat, d: PETSc.Vec, u: PETSc.Vec) -> None:
        """Set u to ``T^T d``."""
        u.set(0.0)
        loops.add_transposed_basis(*self._rows, d.array_r, u.array)

    def multTransposeAdd(self, _: PETSc.Mat, d: PETSc.Vec, start: PETSc.Vec, u: PETSc.Vec) -> None:
        """Set u to a start and ``T^T d``."""
        if start != u:
            start.copy(u)
        loops.add_transposed_basis(*self._rows, d.array_r, u.array)


def transfer_action(basis: PointBasis, W: fem.FunctionSpace, V: fem.FunctionSpace) -> PETSc.Mat:
    """Return a matrix without entries that multiplies as :func:`transfer_matrix` of one rank does.

    Entries take more memory than all else that is known of T.
    """
    sizes = [space.dofmap.index_map.size_global * space.dofmap.index_map_bs for space in (W, V)]
    return PETSc.Mat().createPython(sizes, _Action(basis), comm=W.mesh.comm)


def _entries(
    nodes: NDArray[np.int64], values: NDArray[np.float64], bs: int
) -> tuple[NDArray[np.integer[Any]], NDArray[np.integer[Any]], NDArray[np.float64]]:
    """Return offsets, columns and values of rows for each component, sorted and without zeros.

    Args:
        nodes: Global nodes of V, shape ``(n, k)``.
        values: Basis there, shape ``(n, k)``.
        bs: Number of components.
    """
    offsets = np.empty(len(nodes) * bs + 1, dtype=PETSc.IntType)
    columns, data = loops.transfer_rows(nodes, values, bs, offsets)
    return offsets, columns, data
