# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Dirichlet values at the present load, and the forces that they need."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from .. import _compat
from ..errors import MPMError
from ..parallel.totals import over_ranks

__all__ = ["Prescribed", "dirichlet_values", "fixed_dofs", "force_at"]


def dirichlet_values(bcs: Iterable[fem.DirichletBC], V: fem.FunctionSpace) -> NDArray[np.float64]:
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


def fixed_dofs(bcs: Iterable[fem.DirichletBC], V: fem.FunctionSpace) -> NDArray[np.bool_]:
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


class Prescribed:
    """The Dirichlet conditions on one space, and their values in a step.

    Args:
        conditions: Conditions, of which those on this space count.
        V: The space.

    Attributes:
        change: What the values change by in the step that has begun, on own dofs of V.
        totals: What they are at its beginning.
        changes: Whether any change, on any rank.
        imposed: Whether increments have them.
    """

    def __init__(self, conditions: Sequence[fem.DirichletBC], V: fem.FunctionSpace) -> None:
        self._conditions, self._V = conditions, V
        self._known: list[fem.DirichletBC] | None = None
        self._held = np.zeros(V.dofmap.index_map.size_local * V.dofmap.index_map_bs, dtype=bool)
        self.change = self.totals = np.zeros(len(self._held))
        self.changes = self.imposed = False

    def __iter__(self) -> Iterator[fem.DirichletBC]:
        return (bc for bc in self._conditions if _compat.is_condition_on(bc, self._V))

    @property
    def held(self) -> NDArray[np.bool_]:
        """Which of this rank's own dofs of V have a condition, looked up once for each."""
        conditions, known = list(self), self._known
        if known is None or list(map(id, conditions)) != list(map(id, known)):
            self._known, self._held = conditions, fixed_dofs(conditions, self._V)
        return self._held

    @property
    def at_rest(self) -> NDArray[np.bool_]:
        """Which components of own nodes of V are held where they were, shape ``(n, bs)``."""
        moved = (self.change != 0.0) | (self.totals != 0.0)
        return np.asarray((self.held & ~moved).reshape(-1, self._V.dofmap.index_map_bs))

    def begin(self, change: NDArray[np.float64], before: NDArray[np.float64] | None) -> None:
        """Take over the values of a step, on the local dofs of V (collective).

        Args:
            change: Their change in the step.
            before: Their totals at its beginning; ``None``: zero.
        """
        own = slice(len(self._held))
        self.change = change[own]
        self.totals = np.zeros(len(self._held)) if before is None else before[own]
        self.imposed = False
        self.changes = over_ranks(self._V.mesh.comm, bool(np.any(change)), MPI.LOR)
