# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Background dofs that the body supports badly: ghost penalty and aggregation."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from . import _compat
from .cell_fill import CellFill, CellPairs
from .errors import MPMError
from .extension import CellPolynomials
from .history import Statistics
from .particles import Particles

__all__ = ["Aggregation", "GhostPenalty", "stabilisation_of"]

#: Fill of a cell below which its dofs count as badly supported.
FILL = 0.5
#: Ghost penalty over shear modulus / cell size^2.
PENALTY = 1e-4
#: Background nodes with weight over nodes of the bodies, from which on a background of degree 1
#: needs a penalty.
CROWDED = 0.9
#: Layers of cells over which aggregation looks for a well filled one.
LAYERS = 8
KINDS = ("auto", "ghost", "aggregate")
#: Methods whose rows of T are values of the background at the domains' nodes.
NODAL = ("cpdi2", "cpdi")


def stabilisation_of(
    kind: str | None, bodies: Sequence[Particles]
) -> GhostPenalty | Aggregation | None:
    """Return what is done about badly supported dofs.

    Args:
        kind: ``"ghost"``, ``"aggregate"``, ``None`` (nothing) or ``"auto"``: a ghost penalty
            for a background of degree 2 or more; for degree 1 only while the bodies have hardly
            more nodes than the background, for methods that move particles at their nodes.
        bodies: The bodies of a problem.

    Raises:
        MPMError: Something else, or a method whose particles are not moved at their nodes.
    """
    if kind is not None and kind not in KINDS:
        raise MPMError(
            f"Unknown stabilisation={kind!r}; choose {', '.join(map(repr, KINDS))} or None."
        )
    if kind is None:
        return None
    least = CROWDED if kind == "auto" and bodies[0].V.ufl_element().degree == 1 else 0.0
    for body in bodies:
        if body.method not in NODAL:
            if least > 0.0:
                return None
            raise MPMError(
                f"stabilisation={kind!r} is for the methods 'cpdi2' and 'cpdi', not for "
                f"{body.method!r}; use stabilisation=None."
            )
    return Aggregation(bodies) if kind == "aggregate" else GhostPenalty(bodies, least)


class GhostPenalty:
    """Each badly filled cell is tied to the polynomials of its neighbours (Burman 2010).

    On facets between two cells that a body reaches into, of which one is filled below one
    half, ``gamma G / h^2 int (p_1 - p_2) (q_1 - q_2) dx`` over both cells is added to residual
    and tangent (the direct form of Preuss 2018), where p_1 and p_2 are the increment of either
    cell, continued over both as polynomials. It vanishes where the increment is one polynomial.
    All nodes of these cells become unknowns.

    Args:
        bodies: The bodies (collective).
        least: Number of background nodes with weight over that of the bodies' nodes, below which
            there is no penalty.

    Attributes:
        acts: Whether there is any penalty now.
    """

    def __init__(self, bodies: Sequence[Particles], least: float = 0.0) -> None:
        self._bodies = list(bodies)
        self._V = bodies[0].V
        self._least = least * sum(_num_nodes(body) for body in bodies)
        self.acts = False

    @cached_property
    def _cells(self) -> CellPairs:
        return CellPairs(self._V)

    @cached_property
    def _polynomials(self) -> CellPolynomials:
        return CellPolynomials(self._V)

    def unknowns(self, active: NDArray[np.bool_], statistics: Statistics) -> NDArray[np.bool_]:
        """Look at the bodies where they are at the last converged step (collective).

        Args:
            active: Whether each own node of V has weight.
            statistics: Where to count.

        Returns:
            Which own nodes are unknowns.
        """
        self.acts = self._V.mesh.comm.allreduce(int(active.sum())) >= self._least
        if not self.acts:
            statistics["ghost_facets"] = 0
            return active
        self._choose(statistics)
        return active | self._marked

    def _choose(self, statistics: Statistics) -> None:
        """Find the pairs of cells that are tied together."""
        cells = self._cells
        support = CellFill.of(self._bodies, cells.num_own)
        fill, active = cells.with_others(support.fill), cells.with_others(support.active)
        a, b = cells.pairs.T
        least = np.minimum(fill[a].sum(axis=1), fill[b].sum(axis=1))
        chosen = cells.pairs[cells.mine & active[a] & active[b] & (least < FILL)]
        self._chosen = chosen
        self._shares = fill[chosen].sum(axis=1)
        self._marked = marked(self._V, cells.nodes[chosen])
        statistics["ghost_facets"] = self._V.mesh.comm.allreduce(len(chosen))

    def matrix(self, moduli: Sequence[float]) -> PETSc.Mat:
        """Return the penalty's matrix on all dofs of V (collective).

        Args:
            moduli: Shear modulus of each body.
        """
        chosen, cells, bs = self._chosen, self._cells, self._V.dofmap.index_map_bs
        body = np.asarray(moduli)
        total = self._shares.sum(axis=1)
        mean = self._shares @ body / np.where(total > 0.0, total, 1.0)
        modulus = PENALTY * np.where(total > 0.0, mean, body.min())
        nodes = cells.nodes[chosen].reshape(len(chosen), 2 * cells.nodes.shape[1])
        values = modulus[:, None, None] * self._penalties(cells.vertices[chosen])
        rows = np.broadcast_to(nodes[:, :, None], values.shape)
        columns = np.broadcast_to(nodes[:, None, :], values.shape)
        return blocked(self._V, rows.ravel(), columns.ravel(), values.ravel(), bs)

    def _penalties(self, vertices: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the matrices of pairs of cells, each shape of a pair once computed.

        Args:
            vertices: Geometry nodes of both cells, shape ``(n, 2, m, gdim)``.
        """
        n, _, _, gdim = vertices.shape
        size = np.ptp(vertices.reshape(n, 2 * vertices.shape[2], gdim), axis=1).max(axis=1)
        shape = (vertices - vertices[:, :1, :1]) / size[:, None, None, None]
        keys = np.round(shape.reshape(n, vertices[:1].size), 9)
        _, first, which = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        each = self._unit_penalties(shape[first])[which.reshape(-1)]
        return np.asarray(each * (size ** (gdim - 2))[:, None, None])

    def _unit_penalties(self, vertices: NDArray[np.float64]) -> NDArray[np.float64]:
        frame = self._polynomials.frame(vertices[:, 0])
        one, two = (self._polynomials.moments(vertices[:, side], frame) for side in (0, 1))
        jump = np.concatenate([one.coefficients, -two.coefficients], axis=2)
        size = (0.5 * (one.volume + two.volume)) ** (2.0 / vertices.shape[3])
        values = jump.swapaxes(1, 2) @ (one.mass + two.mass) @ jump / size[:, None, None]
        return np.asarray(0.5 * (values + values.swapaxes(1, 2)))


def _num_nodes(body: Particles) -> int:
    """Return the number of nodes of a body, each counted once where domains may part."""
    nodes: int = body.W.dofmap.index_map.size_global
    corners: int = body.mesh.topology.index_map(0).size_global
    return min(nodes, corners) if body.W.ufl_element().degree == 1 else nodes


class Aggregation:
    """Badly supported dofs follow the polynomial of a well filled cell near by.

    A node whose cells are all filled below one half takes the value there of the continued
    polynomial of a well filled cell, reached over facets (Badia, Verdugo & Martin 2018). Where
    there is none within eight cells the node stays an unknown of its own.

    Args:
        bodies: The bodies (collective).
    """

    def __init__(self, bodies: Sequence[Particles]) -> None:
        self._bodies = list(bodies)
        self._V = bodies[0].V
        self._cells = CellPairs(self._V)
        self._polynomials = CellPolynomials(self._V)
        coordinates = self._V.tabulate_dof_coordinates()
        own = self._V.mesh.topology.index_map(self._V.mesh.topology.dim).size_local
        dofs = self._V.dofmap.list[:own]
        self._positions = coordinates[dofs][:, :, : self._V.mesh.geometry.dim]

    def unknowns(self, active: NDArray[np.bool_], statistics: Statistics) -> NDArray[np.bool_]:
        """See :meth:`GhostPenalty.unknowns`."""
        cells, V = self._cells, self._V
        support = CellFill.of(self._bodies, cells.num_own)
        good = support.active & (support.fill.sum(axis=1) >= FILL)
        self._good = marked(V, cells.nodes[: cells.num_own][good])
        root = self._roots(good, support.active)
        lost = np.flatnonzero(support.active & ~good & (root.index >= 0))
        coefficients, frame = self._root_polynomials(root.vertices[lost])
        at = self._polynomials.at(self._positions[lost], frame)
        values = at @ coefficients
        gap = np.linalg.norm(self._positions[lost].mean(axis=1) - frame.origin, axis=1)
        distance = np.round(gap / np.ptp(self._positions[lost], axis=1).max(axis=1), 9)
        self._take(cells.nodes[lost], values, root.nodes[lost], distance, cells.index[lost])
        count = V.mesh.comm.allreduce(len(self._node)) * V.dofmap.index_map_bs
        statistics["aggregated_dofs"] = count
        result = active | self._good
        result[self._node] = False
        return result

    def _root_polynomials(self, vertices: NDArray[np.float64]) -> tuple[NDArray[np.float64], Any]:
        frame = self._polynomials.frame(vertices)
        return self._polynomials.moments(vertices, frame).coefficients, frame

    def _roots(self, good: NDArray[np.bool_], active: NDArray[np.bool_]) -> _Roots:
        """Return for each own cell the nearest well filled one over active cells (collective)."""
        cells = self._cells
        n = cells.num_own
        roots = _Roots(
            np.where(good, cells.index[:n], -1), cells.nodes[:n].copy(), cells.vertices[:n].copy()
        )
        middle = cells.vertices[:n].mean(axis=1)
        a, b = cells.pairs.T
        inner = b < n
        a, b = np.concatenate([a, b[inner]]), np.concatenate([b, a[inner]])
        for _ in range(LAYERS):
            found = _Roots(*(cells.with_others(part) for part in roots))
            open_ = active & (roots.index < 0)
            use = open_[a] & (found.index[b] >= 0)
            if not self._V.mesh.comm.allreduce(bool(use.any()), MPI.LOR):
                break
            one, other = a[use], b[use]
            gap = np.linalg.norm(found.vertices[other].mean(axis=1) - middle[one], axis=1)
            near = np.round(gap / np.ptp(cells.vertices[one], axis=1).max(axis=1), 9)
            order = np.lexsort((found.index[other], near, one))
            one, first = np.unique(one[order], return_index=True)
            chosen = other[order][first]
            for mine, theirs in zip(roots, found, strict=True):
                mine[one] = theirs[chosen]
        return roots

    def _take(
        self,
        nodes: NDArray[np.int64],
        values: NDArray[np.float64],
        roots: NDArray[np.int64],
        distance: NDArray[np.float64],
        index: NDArray[np.int64],
    ) -> None:
        """Keep for each own node that is badly supported the nearest cell's offer (collective)."""
        comm: MPI.Comm = self._V.mesh.comm
        imap = self._V.dofmap.index_map
        m, k = nodes.shape
        offers = (
            nodes.ravel(),
            values.reshape(m * k, k),
            np.repeat(roots, k, axis=0),
            np.repeat(distance, k),
            np.repeat(index, k),
        )
        ends = np.asarray(comm.allgather(imap.local_range[1]))
        home = np.searchsorted(ends, offers[0], side="right")
        parts = comm.alltoall([[part[home == r] for part in offers] for r in range(comm.size)])
        node, value, root, far, cell = (
            np.concatenate([part[i] for part in parts]) for i in range(5)
        )
        node = node - imap.local_range[0]
        order = np.lexsort((cell, far, node))
        order = order[~self._good[node[order]]]
        self._node, first = np.unique(node[order], return_index=True)
        self._value, self._root = value[order][first], root[order][first]

    def extension(self, fixed: NDArray[np.bool_]) -> PETSc.Mat:
        """Return E, which gives all dofs of V from the unknowns and the fixed ones (collective).

        Args:
            fixed: Own dofs with a Dirichlet condition, which follow nobody.
        """
        V = self._V
        bs = V.dofmap.index_map_bs
        start = V.dofmap.index_map.local_range[0]
        own = V.dofmap.index_map.size_local
        follows = np.zeros((own, bs), dtype=bool)
        follows[self._node] = ~fixed.reshape(-1, bs)[self._node]
        itself = np.flatnonzero(~follows.ravel()) + start * bs
        k = self._root.shape[1]
        component = np.arange(bs)
        shape = (len(self._node), bs, k)
        use = np.broadcast_to(follows[self._node][:, :, None], shape)
        rows = np.broadcast_to(((self._node + start)[:, None] * bs + component)[:, :, None], shape)
        columns = self._root[:, None, :] * bs + component[:, None]
        values = np.broadcast_to(self._value[:, None, :], shape)
        return assembled(
            V,
            np.concatenate([itself, rows[use]]),
            np.concatenate([itself, columns[use]]),
            np.concatenate([np.ones(len(itself)), values[use]]),
            bs,
        )


class _Roots:
    """The well filled cell that each cell follows: input index (-1: none), nodes, vertices."""

    def __init__(
        self, index: NDArray[np.int64], nodes: NDArray[np.int64], vertices: NDArray[np.float64]
    ) -> None:
        self.index = index
        self.nodes = nodes
        self.vertices = vertices

    def __iter__(self) -> Any:
        return iter((self.index, self.nodes, self.vertices))


def marked(V: fem.FunctionSpace, nodes: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which of this rank's own nodes any rank names by their global numbers."""
    imap = V.dofmap.index_map
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
    matrix = PETSc.Mat().create(comm=V.mesh.comm)
    matrix.setSizes((sizes, sizes))
    matrix.setType("aij")
    _compat.set_entry_places(matrix, rows.astype(PETSc.IntType), columns.astype(PETSc.IntType))
    _compat.set_entries(matrix, np.ascontiguousarray(values))
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
