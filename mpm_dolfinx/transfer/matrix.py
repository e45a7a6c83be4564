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

__all__ = ["transfer_matrix"]


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
