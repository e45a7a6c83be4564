# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Ghost penalty on facets of badly filled background cells."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..assembly.petsc import blocked, marked
from ..background.pairs import CellPairs
from ..background.polynomials import CellPolynomials
from ..parallel.totals import over_ranks
from ..particles.particles import Particles
from ..transfer.touched import TouchedNodes
from .cell_fill import CellFill, poorly_filled

__all__ = ["GhostPenalty"]

#: Ghost penalty over shear modulus / cell size^2.
PENALTY = 1e-4


class GhostPenalty:
    """Each badly filled cell is tied to the polynomials of its neighbours (Burman 2010).

    On facets between two cells that a body reaches into, of which one is filled below one
    half, ``gamma G / h^2 int (p_1 - p_2) (q_1 - q_2) dx`` over both cells is added to residual
    and tangent (the direct form of Preuss 2018), where p_1 and p_2 are the increment of either
    cell, continued over both as polynomials. It vanishes where the increment is one polynomial.
    All nodes of these cells become unknowns.

    Args:
        bodies: The bodies (collective).
        least: Number of background nodes with weight over that of the bodies' carried nodes, below
            which there is no penalty.

    Attributes:
        acts: Whether there is a penalty where the bodies are now.
        counts: Number of facets with a penalty, by the name of the statistics.
    """

    def __init__(self, bodies: Sequence[Particles], least: float = 0.0) -> None:
        self._bodies = list(bodies)
        self._V = bodies[0].V
        self._least = least
        self.acts = False
        self.counts: dict[str, int] = {}
        self._known: dict[bytes, NDArray[np.float64]] = {}
        self._chosen = np.zeros((0, 2), dtype=np.int64)
        self._unit: NDArray[np.float64] | None = None  # matrices of the pairs that are chosen

    @cached_property
    def _cells(self) -> CellPairs:
        return CellPairs(self._V)

    @cached_property
    def _polynomials(self) -> CellPolynomials:
        return CellPolynomials(self._V)

    def tie(self, touched: TouchedNodes) -> NDArray[np.bool_]:
        """Tie cells together where the bodies are at the last converged step (collective).

        Args:
            touched: The nodes of V that they touch.

        Returns:
            Which of this rank's own nodes of V are unknowns: those with weight, and all of cells
            that are tied together.
        """
        active = touched.has_weight
        carried = sum(_num_carried(body) for body in self._bodies)
        self.acts = over_ranks(self._V.mesh.comm, len(touched.active)) >= self._least * carried
        if self.acts:
            self._choose()
            active = active | self._marked
        self.counts = {"ghost_facets": self._num_chosen if self.acts else 0}
        return active

    def _choose(self) -> None:
        """Find the pairs of cells that are tied together."""
        cells = self._cells
        support = CellFill.of(self._bodies, cells)
        fill, active = cells.with_others(support.fill), cells.with_others(support.active)
        a, b = cells.pairs.T
        poor = poorly_filled(fill)
        chosen = cells.pairs[cells.mine & active[a] & active[b] & (poor[a] | poor[b])]
        if not np.array_equal(chosen, self._chosen):
            self._chosen, self._unit = chosen, None
        self._shares = fill[chosen].sum(axis=1)
        self._marked = marked(self._V, cells.nodes[chosen])
        self._num_chosen: int = over_ranks(self._V.mesh.comm, len(chosen))

    @property
    def tied(self) -> NDArray[np.int64]:
        """Global nodes of each pair of cells that are tied together, shape ``(n, 2 k)``."""
        nodes = self._cells.nodes
        return nodes[self._chosen].reshape(len(self._chosen), 2 * nodes.shape[1])

    def penalty(self, moduli: Sequence[float]) -> PETSc.Mat:
        """Return the addition to the tangent on all dofs of V; its product is one to the residual.

        Args:
            moduli: Shear modulus of each body.
        """
        chosen, bs = self._chosen, self._V.dofmap.index_map_bs
        body = np.asarray(moduli)
        total = self._shares.sum(axis=1)
        mean = self._shares @ body / np.where(total > 0.0, total, 1.0)
        modulus = PENALTY * np.where(total > 0.0, mean, body.min())
        nodes = self.tied
        if self._unit is None:
            self._unit = self._penalties(self._cells.vertices(chosen))
        values = modulus[:, None, None] * self._unit
        rows = np.broadcast_to(nodes[:, :, None], values.shape)
        columns = np.broadcast_to(nodes[:, None, :], values.shape)
        return blocked(self._V, rows.ravel(), columns.ravel(), values.ravel(), bs)

    def _penalties(self, vertices: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the matrices of pairs of cells, each shape of a pair computed once.

        Those of the last call are kept, and known by their vertices to the last bit, so that a run
        that goes on from a checkpoint has the same matrices as one that has kept them.

        Args:
            vertices: Geometry nodes of both cells, shape ``(n, 2, m, gdim)``.
        """
        n, _, _, gdim = vertices.shape
        size = np.ptp(vertices.reshape(n, 2 * vertices.shape[2], gdim), axis=1).max(axis=1)
        shape = (vertices - vertices[:, :1, :1]) / size[:, None, None, None]
        keys = np.round(shape.reshape(n, vertices[:1].size), 9)
        _, first, which = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        names = [one.tobytes() for one in shape[first]]
        new = [i for i, name in enumerate(names) if name not in self._known]
        known = {name: self._known[name] for name in names if name in self._known}
        if len(new) > 0:
            matrices = self._unit_penalties(shape[first[new]])
            known.update(zip([names[i] for i in new], matrices, strict=True))
        self._known = known
        if n == 0:
            k = 2 * self._cells.nodes.shape[1]
            return np.zeros((0, k, k))
        each = np.stack([self._known[name] for name in names])[which.reshape(-1)]
        return np.asarray(each * (size ** (gdim - 2))[:, None, None])

    def _unit_penalties(self, vertices: NDArray[np.float64]) -> NDArray[np.float64]:
        frame = self._polynomials.frame(vertices[:, 0])
        one, two = (self._polynomials.moments(vertices[:, side], frame) for side in (0, 1))
        jump = np.concatenate([one.coefficients, -two.coefficients], axis=2)
        size = (0.5 * (one.volume + two.volume)) ** (2.0 / vertices.shape[3])
        values = jump.swapaxes(1, 2) @ (one.mass + two.mass) @ jump / size[:, None, None]
        return np.asarray(0.5 * (values + values.swapaxes(1, 2)))


def _num_carried(body: Particles) -> int:
    """Return how many nodes are carried, each counted once where domains may part (collective)."""
    layout = body.W.dofmap.index_map
    nodes: int = layout.size_global
    corners: int = body.mesh.topology.index_map(0).size_global
    whole = min(nodes, corners) if body.W.ufl_element().degree == 1 else nodes
    return whole - over_ranks(body.mesh.comm, int(body.free[: layout.size_local].sum()))
