# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Nodes of a body that no background carries: each has an unknown of its own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem, la, mesh

from ..background.basis import PointBasis
from ..errors import MPMError, agree
from ..meshes.regions import marked
from ..meshes.tags import cells_with, is_pair_with_tags
from ..parallel.given import require_same
from ..reals import as_wholes
from ..transfer.matrix import transfer_matrix
from .response import MaterialDomains

__all__ = ["FreeNodes", "chosen_nodes"]


class FreeNodes:
    """The free nodes of a body, as the system moves them: T is the identity on W.

    The other nodes are carried: they follow the background. A body's displacement is
    ``d = d_n + T u + T_f w`` with T zero in the rows of free nodes and T_f in all others, so that
    the elements between them are those of the body's mesh.

    Args:
        particles: The body, of which no node is free at first.
        locate: Finds the background cells of all nodes (collective).
        automatic: Whether nodes are free as long as the domains around them are good.

    Attributes:
        particles: As given.
        V: Space of the unknowns: W.
        W: The same.
        locate: As given.
        automatic: As given.
        increment: Their increment in the step being solved.
        led: How far each node has gone with held dofs of the background that move: a free one goes
            on to follow them from where that began, although the background stays where it is.
        bound: Which nodes have gone, or go, with such dofs; ghosts too.
        chosen: Which of this rank's nodes of W are free, ghosts too.
        spent: Which have been free until the domains around them were bad, and stay carried.
    """

    shares_nodes = True

    def __init__(
        self, particles: MaterialDomains, locate: Callable[[], None], automatic: bool
    ) -> None:
        self.particles, self.locate, self.automatic = particles, locate, automatic
        self.V = self.W = particles.W
        self.increment = fem.Function(self.W, name="increment of free nodes")
        self.led = fem.Function(self.W, name="displacement with held dofs")
        self._background: PointBasis | None = None
        layout = self.W.dofmap.index_map
        local = np.arange(layout.size_local + layout.num_ghosts, dtype=np.int32)
        self._nodes: NDArray[np.int64] = layout.local_to_global(local)
        self.chosen, self.spent, self.bound = (np.zeros(len(local), dtype=bool) for _ in range(3))
        self._dead = np.zeros(len(local), dtype=bool)
        self._basis: PointBasis | None = None
        self._T: PETSc.Mat | None = None

    @property
    def mesh(self) -> mesh.Mesh:
        """The body mesh."""
        return self.particles.mesh

    def choose(self, chosen: NDArray[np.bool_], spent: NDArray[np.bool_]) -> None:
        """Let others of this rank's nodes of W, ghosts too, be free, and others stay carried."""
        self.chosen, self.spent = chosen, spent

    def take(self, rows: PointBasis) -> None:
        """Take the free nodes out of the rows of the background, in place.

        Args:
            rows: The background basis at the local nodes of W.
        """
        free = self.chosen
        values = np.where(rows.found[:, None], rows.values, 0.0)
        self._background = PointBasis(rows.nodes, values, rows.found)
        rows.values[free] = 0.0
        rows.found[free] = True
        self._basis = self._T = None

    def leave(self, dead: NDArray[np.bool_]) -> None:
        """Leave nodes without weight.

        Args:
            dead: Which local nodes of W belong to deleted domains alone.
        """
        self._dead = dead[: len(self.chosen)].copy()
        self._basis = self._T = None

    @property
    def background(self) -> PointBasis:
        """The rows that the local nodes would have if all were carried: zero off the background."""
        assert self._background is not None
        return self._background

    @property
    def beneath(self) -> PointBasis:
        """The same of free nodes: zero for others."""
        return self._of_free(self.background)

    def _of_free(self, rows: PointBasis) -> PointBasis:
        """Return rows that are zero for nodes that are carried."""
        return rows._replace(values=np.where(self.chosen[:, None], rows.values, 0.0))

    def bind(self, own: NDArray[np.bool_]) -> None:
        """Say which own dofs of W follow held dofs that move, or have moved (collective)."""
        bs = self.W.dofmap.index_map_bs
        self.bound = chosen_nodes(self.W, np.flatnonzero(own.reshape(-1, bs).any(axis=1)))

    @property
    def are_led(self) -> NDArray[np.bool_]:
        """Which local nodes have gone with held dofs of the background."""
        return np.asarray(self.led.x.array.reshape(len(self.chosen), -1).any(axis=1))

    @property
    def dofs(self) -> NDArray[np.bool_]:
        """Whether each of this rank's own dofs of W is free."""
        dofmap = self.W.dofmap
        return np.repeat(self.chosen[: dofmap.index_map.size_local], dofmap.index_map_bs)

    @property
    def node_basis(self) -> PointBasis:
        """The rows of T at the local nodes of W: one entry each, zero where a node is carried."""
        if self._basis is None:
            weights = np.where(self.chosen & ~self._dead, 1.0, 0.0)[:, None]
            found = np.ones(len(weights), dtype=bool)
            self._basis = PointBasis(self._nodes[:, None].copy(), weights, found)
        return self._basis

    @property
    def T(self) -> PETSc.Mat:
        """All dofs of W by the same (collective)."""
        if self._T is None:
            self._T = transfer_matrix(self.node_basis, self.W, self.W)
        return self._T

    def roll_back(self) -> None:
        """Return to no increment."""
        self.increment.x.array[:] = 0.0


def chosen_nodes(W: fem.FunctionSpace, where: Any) -> NDArray[np.bool_]:
    """Return which of this rank's nodes of W, ghosts too, are chosen (collective).

    Args:
        W: Space on the body mesh.
        where: A function of undeformed coordinates, shape ``(3, n)``, such as ``mpm.region(...)``;
            a pair of cell tags and a tag, or a list of tags: all nodes of these cells; local
            nodes of W, of which there may be none; or ``"auto"``: all nodes.

    Raises:
        MPMError: Something else, a place where no node is, or ranks that choose by other means.
    """
    require_same(W.mesh.comm, free="nodes" if _is_listed(where) else type(where).__name__)
    layout = W.dofmap.index_map
    marks = la.vector(layout, 1, dtype=np.float64)
    if is_pair_with_tags(where):
        cells = cells_with(W.mesh, where[0], where[1], "free=")
        marks.array[W.dofmap.list[cells].ravel()] = 1.0
    else:
        with agree(W.mesh.comm):
            marks.array[_local_nodes(W, where)] = 1.0
    marks.scatter_reverse(la.InsertMode.add)
    own = marks.array[: layout.size_local]
    own[:] = own > 0.0
    marks.scatter_forward()
    chosen = np.asarray(marks.array > 0.5)
    if not _is_listed(where) and not W.mesh.comm.allreduce(int(own.sum())):
        raise MPMError("No node of the body is where free= asks for nodes of their own.")
    return chosen


def _is_listed(where: Any) -> bool:
    """Return whether nodes are given one by one."""
    try:
        return as_wholes(where).ndim == 1
    except (TypeError, ValueError):
        return False


def _local_nodes(W: fem.FunctionSpace, where: Any) -> NDArray[np.integer[Any]]:
    """Return local nodes of W."""
    layout = W.dofmap.index_map
    count = layout.size_local + layout.num_ghosts
    if isinstance(where, str) and where == "auto":
        return np.arange(count)
    if callable(where):
        x = W.tabulate_dof_coordinates()[:count].T
        inside = marked(where, x, "The function free=")
        return np.flatnonzero(inside[: layout.size_local])  # owners of the others know them
    if _is_listed(where):
        nodes = as_wholes(where)
        if len(nodes) and (nodes.min() < 0 or nodes.max() >= count):
            raise MPMError(f"free= has nodes that are none of the {count} local ones of W.")
        return nodes
    raise MPMError(
        "free= is 'auto', a function of coordinates such as mpm.region(...), (cell tags, tag), or "
        f"a list of local nodes of W, not {where!r}."
    )
