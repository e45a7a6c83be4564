# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The transfer T as a sparse matrix."""

from __future__ import annotations

from petsc4py import PETSc

import numpy as np

from dolfinx import fem

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
    values, nodes = basis.values[:owned], basis.nodes[:owned]
    order = np.argsort(nodes, axis=1)
    nodes = np.take_along_axis(nodes, order, axis=1)
    values = np.take_along_axis(values, order, axis=1)
    kept = values != 0.0
    counts = np.repeat(kept.sum(axis=1), bs)
    indptr = np.concatenate([[0], np.cumsum(counts)]).astype(PETSc.IntType)
    component = np.arange(bs)[None, :, None]
    shape = (owned, bs, nodes.shape[1])
    keep = np.broadcast_to(kept[:, None, :], shape)
    indices = (nodes[:, None, :] * bs + component)[keep].astype(PETSc.IntType)
    data = np.broadcast_to(values[:, None, :], shape)[keep]
    sizes = (
        (owned * bs, rows.size_global * bs),
        (columns.size_local * bs, columns.size_global * bs),
    )
    return PETSc.Mat().createAIJ(sizes, csr=(indptr, indices, data), comm=W.mesh.comm)
