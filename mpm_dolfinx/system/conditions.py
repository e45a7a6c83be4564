# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Dirichlet values at the present load, and the forces that they need."""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from .. import _compat
from ..errors import MPMError
from ..parallel.totals import over_ranks

__all__ = ["dirichlet_values", "fixed_dofs", "force_at"]


def dirichlet_values(bcs: Sequence[fem.DirichletBC], V: fem.FunctionSpace) -> NDArray[np.float64]:
    """Return the present totals of Dirichlet conditions, on the local dofs of V (collective).

    Raises:
        MPMError: Some are not finite.
    """
    layout = V.dofmap.index_map
    values = np.zeros((layout.size_local + layout.num_ghosts) * V.dofmap.index_map_bs)
    for bc in bcs:
        bc.set(values, None, 1.0)
    if not over_ranks(V.mesh.comm, bool(np.isfinite(values).all()), MPI.LAND):
        raise MPMError("A Dirichlet condition has a value that is not finite")
    return values


def fixed_dofs(bcs: Sequence[fem.DirichletBC], V: fem.FunctionSpace) -> NDArray[np.bool_]:
    """Return whether a condition holds each of this rank's own dofs of V."""
    fixed = np.zeros(V.dofmap.index_map.size_local * V.dofmap.index_map_bs, dtype=bool)
    for bc in bcs:
        fixed[_compat.own_dofs(bc, V)] = True
    return fixed


def force_at(
    bc: fem.DirichletBC, forces: NDArray[np.float64] | None, V: fem.FunctionSpace
) -> NDArray[np.float64]:
    """Return the sum of forces on the dofs of a condition, ``(gdim,)`` (collective).

    Args:
        bc: The condition.
        forces: Forces on this rank's own dofs of V; ``None`` are none.
        V: The background space.
    """
    gdim = V.dofmap.index_map_bs
    force = np.zeros(gdim)
    if forces is not None:
        own = _compat.own_dofs(bc, V)
        np.add.at(force, own % gdim, forces[own])
    return np.asarray(V.mesh.comm.allreduce(force))
