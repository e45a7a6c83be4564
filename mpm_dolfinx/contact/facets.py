# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Facets of one body near points of another: copies of them on the points' ranks, and the closest.

Facets are known by a number that is the same on any ranks. They are looked for in boxes of a grid,
so that the cost grows with the number of points and facets, not with its square.
"""

from __future__ import annotations

from itertools import product
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import basix

from .._core import loops
from ..parallel.exchange import swap
from .surface import Surface, global_dofs, normals

__all__ = ["Closest", "NearFacets", "Table", "separated", "solved"]

#: Cosine of the angle of two normals below which surfaces face each other; and in the middle of a
#: facet, below which they may do so somewhere, and below which they do so for sure.
FACING, MAY_FACE, SURELY_FACING = -0.1, 0.5, -0.4
#: Most Newton steps of a projection, and the step that ends them: the next one is its square.
PROJECTIONS, CLOSE = 20, 1e-10


#: Shape functions of a facet at points, ``(n, k)``, with their first and second derivatives.
type Table = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


class Closest(NamedTuple):
    """The facet that is closest to each of some points.

    Attributes:
        facet: Its place among those that are known, -1 where there is none, shape ``(n,)``.
        place: Reference coordinates of the projection, which may lie beyond its edges, ``(n, e)``.
        gap: Distance along the normal, negative behind it; infinite where there is none.
        near: Whether the points may touch: a facet is near, and they are not off its end.
        beside: How far projections are beyond the edges, over the facet's size, ``(n,)``.
    """

    facet: NDArray[np.int64]
    place: NDArray[np.float64]
    gap: NDArray[np.float64]
    near: NDArray[np.bool_]
    beside: NDArray[np.float64]


class NearFacets:
    """Facets of a surface on the ranks where points are near to them.

    Args:
        surface: The facets.
        number: A number of each facet that this rank owns, the same on any ranks, shape ``(m,)``.
        points: This rank's points as they are, shape ``(n, gdim)``.
        around: How near a facet must be.
        nodes: Positions of the surface's own nodes as they are, shape ``(N, gdim)``.

    Attributes:
        number: Numbers of the facets that this rank knows, sorted.
        dofs: Their global dofs, shape ``(f, k gdim)``.
        outward: As that of :class:`Surface`.
        present: Whether the domain behind is there.
    """

    def __init__(
        self,
        surface: Surface,
        number: NDArray[np.int64],
        points: NDArray[np.float64],
        around: float,
        nodes: NDArray[np.float64],
    ) -> None:
        self._surface = surface
        self._comm: MPI.Comm = surface.particles.mesh.comm
        self.gdim, self.element = surface.gdim, surface.element
        self._flat = self.element.degree == 1 and self.element.dim == self.gdim
        empty = np.full((1, self.gdim), np.inf)
        low = np.append(points, empty, axis=0).min(axis=0) - around
        high = np.append(points, -empty, axis=0).max(axis=0) + around
        boxes = np.array(self._comm.allgather([low, high]))
        x = nodes[surface.layout.own]
        lower, upper = x.min(axis=1, initial=np.inf), x.max(axis=1, initial=-np.inf)
        self._given = [
            np.flatnonzero((upper >= box[0]).all(axis=1) & (lower <= box[1]).all(axis=1))
            for box in boxes
        ]
        W = surface.particles.W
        dofs = global_dofs(W, surface.layout.nodes)
        there = (surface.weights > 0.0).any(axis=1)
        whole = np.column_stack([number, dofs, there])
        told = np.concatenate(swap(self._comm, [whole[which] for which in self._given]))
        outward = swap(self._comm, [surface.layout.outward[which] for which in self._given])
        self._order = np.argsort(told[:, 0], kind="stable")
        told = told[self._order]
        self.number, self.dofs, self.present = told[:, 0], told[:, 1:-1], told[:, -1] > 0
        self.outward = np.concatenate(outward)[self._order]

    def positions(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the nodes of the facets, shape ``(f, k, gdim)`` (collective).

        Args:
            x: Positions of the surface's own nodes, shape ``(N, gdim)``.
        """
        mine = x[self._surface.layout.own]
        parts = swap(self._comm, [mine[which] for which in self._given])
        return np.concatenate(parts)[self._order]

    def find(self, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the places of facets by their numbers, -1 where they are not known."""
        if len(self.number) == 0:
            return np.full(len(numbers), -1, dtype=np.int64)
        place = np.minimum(np.searchsorted(self.number, numbers), len(self.number) - 1)
        return np.where(self.number[place] == numbers, place, -1)

    def numbers(self, facet: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return numbers of facets by their places, -1 where there is none."""
        numbers = np.full(len(facet), -1, dtype=np.int64)
        numbers[facet >= 0] = self.number[facet[facet >= 0]]
        return numbers

    def tabulate(
        self, place: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return shape functions with first and second derivatives at reference points ``(n, e)``.

        Returns:
            Shapes ``(n, k)``, ``(n, e, k)`` and ``(n, e, e, k)``.
        """
        n, e = place.shape
        k = self.element.dim
        if n == 0:
            return np.zeros((0, k)), np.zeros((0, e, k)), np.zeros((0, e, e, k))
        if self.element.degree == 1:
            return self._of_degree_1(place)
        table = self.element.tabulate(2, place)[:, :, :, 0]
        first = [1 + i for i in range(e)]
        if e == 1:
            second = [[2]]
        else:
            second = [
                [basix.index(2, 0), basix.index(1, 1)],
                [basix.index(1, 1), basix.index(0, 2)],
            ]
        return table[0], table[first].swapaxes(0, 1), np.moveaxis(table[np.array(second)], 2, 0)

    def _of_degree_1(
        self, place: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return :meth:`tabulate` of lines, triangles and quadrilaterals of degree 1."""
        n, e = place.shape
        k = self.element.dim
        N, dN, ddN = np.empty((n, k)), np.empty((n, e, k)), np.zeros((n, e, e, k))
        if k < 4:
            N[:, 0], N[:, 1:] = 1.0 - place.sum(axis=1), place
            dN[:] = np.vstack([-np.ones(e), np.eye(e)]).T
            return N, dN, ddN
        ends = np.stack([1.0 - place, place], axis=1)
        slopes = np.array([-1.0, 1.0])
        for node in range(4):
            i, j = node % 2, node // 2
            N[:, node] = ends[:, i, 0] * ends[:, j, 1]
            dN[:, 0, node] = slopes[i] * ends[:, j, 1]
            dN[:, 1, node] = slopes[j] * ends[:, i, 0]
            ddN[:, 0, 1, node] = ddN[:, 1, 0, node] = slopes[i] * slopes[j]
        return N, dN, ddN

    def project(
        self, points: NDArray[np.float64], nodes: NDArray[np.float64], place: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return where points project onto facets, by Newton's method from a place.

        Args:
            points: Shape ``(n, gdim)``.
            nodes: Nodes of the facet of each, shape ``(n, k, gdim)``.
            place: Where to begin, shape ``(n, e)``.
        """
        if self._flat:  # lines and planes, on which no steps are needed
            N, dN, _ = self.tabulate(place)
            r = points - np.einsum("nk,nki->ni", N, nodes)
            A = np.einsum("nek,nki->nei", dN, nodes)
            step = solved(A @ A.swapaxes(1, 2), np.einsum("nei,ni->ne", A, r))
            return np.asarray(np.clip(place + step, -3.0, 4.0))
        place = place.copy()
        left = np.arange(len(points))
        x, X = points, nodes
        for _ in range(PROJECTIONS):
            N, dN, ddN = self.tabulate(place[left])
            r = x - np.einsum("nk,nki->ni", N, X)
            A = dN @ X
            G = A @ A.swapaxes(1, 2)
            # where a curved facet bends towards the point too much, its plane has to do
            bent = G - np.einsum("nefk,nk->nef", ddN, np.einsum("nki,ni->nk", X, r))
            good = _determinant(bent) > 0.1 * _determinant(G)
            G = np.where(good[:, None, None], bent, G)
            if not (_determinant(G) > 0.0).all():
                raise np.linalg.LinAlgError("A facet has no area.")
            step = np.clip(solved(G, np.einsum("nei,ni->ne", A, r)), -1.0, 1.0)
            place[left] = np.clip(place[left] + step, -3.0, 4.0)
            going = np.abs(step).max(axis=1, initial=0.0) > CLOSE
            left, x, X = left[going], x[going], X[going]
            if len(left) == 0:
                break
        return place

    def clamped(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return places within the reference facet."""
        inner = np.clip(place, 0.0, 1.0)
        if self.element.cell_type == basix.CellType.triangle:
            inner = inner / np.maximum(inner.sum(axis=1), 1.0)[:, None]
        return inner

    def _start(self, count: int) -> NDArray[np.float64]:
        middle = basix.geometry(self.element.cell_type).mean(axis=0)
        return np.tile(middle, (count, 1))

    def closest(
        self,
        points: NDArray[np.float64],
        outward: NDArray[np.float64] | None,
        nodes: NDArray[np.float64],
        reach: float,
    ) -> Closest:
        """Return the closest facet of each point.

        Args:
            points: Shape ``(n, gdim)``.
            outward: Normals of the surface that the points are on: facets must face them. ``None``
                takes facets as they come.
            nodes: Nodes of the facets, of :meth:`positions`.
            reach: How near a facet must be.

        Raises:
            numpy.linalg.LinAlgError: A facet has no area.
        """
        if self.element.degree > 1:
            return self.closest_curved(points, outward, nodes, reach)
        found = self._nothing_near(len(points))
        good = loops.find_closest(
            np.ascontiguousarray(points),
            np.zeros((0, 1)) if outward is None else np.ascontiguousarray(outward),
            np.ascontiguousarray(nodes),
            np.ascontiguousarray(self.outward),
            self.present.view(np.uint8),
            [reach, FACING, SURELY_FACING, MAY_FACE, CLOSE],
            PROJECTIONS,
            found.facet,
            found.place,
            found.gap,
            found.near.view(np.uint8),
            found.beside,
        )
        if not good:
            raise np.linalg.LinAlgError("A facet has no area.")
        return found

    def _nothing_near(self, count: int) -> Closest:
        """Return the answer for points to which no facet is near."""
        return Closest(
            np.full(count, -1, dtype=np.int64),
            np.zeros((count, self.gdim - 1)),
            np.full(count, np.inf),
            np.zeros(count, dtype=bool),
            np.zeros(count),
        )

    def closest_curved(
        self,
        points: NDArray[np.float64],
        outward: NDArray[np.float64] | None,
        nodes: NDArray[np.float64],
        reach: float,
    ) -> Closest:
        """Return the closest facet of each point, whatever the degree of the facets.

        Args:
            points: As for :meth:`closest`, as are the others.
            outward: See there.
            nodes: See there.
            reach: See there.
        """
        facet, place, gap, near, beside = found = self._nothing_near(len(points))
        which, facets = self._candidates(points, nodes, reach)
        which, facets, faces = self._facing(points, outward, nodes, which, facets, reach)
        which, facets = self._nearest(points, nodes, which, facets, faces)
        if len(which) == 0:
            return found
        x, X = points[which], nodes[facets]
        s = self.project(x, X, self._start(len(which)))
        inner = self.clamped(s)
        r, n_of = separated(self.tabulate(inner), x, X, self.outward[facets])
        far = np.linalg.norm(r, axis=1)
        ok = far <= reach
        if outward is not None:
            ok &= (outward[which] * n_of).sum(axis=1) < FACING
        which, facets, s, inner, far = which[ok], facets[ok], s[ok], inner[ok], far[ok]
        # the nearest, and among equals that with the lowest number
        order = np.lexsort((facets, np.round(far / reach, 12), which))
        first = order[np.diff(which[order], prepend=-1) != 0]
        who = which[first]
        facet[who], place[who] = facets[first], s[first]
        table, X = self.tabulate(s[first]), nodes[facets[first]]
        r, n_of = separated(table, points[who], X, self.outward[facets[first]])
        gap[who] = g = (r * n_of).sum(axis=1)
        # A point beside the end of an open surface, or beside an edge, touches nothing, behind the
        # plane of the facet nor at a gap; nor does one beside the edge of a thin body that faces
        # its far side.
        size = np.linalg.norm(np.einsum("nek,nki->nei", table[1], X), axis=2).max(axis=1)
        over = np.abs(s[first] - inner[first]).max(axis=1) * size
        off = over > np.maximum(1e-9 * size, 0.2 * np.minimum(np.abs(g), 0.1 * size))
        off &= (far[first] > 2.0 * np.abs(g) + 1e-12 * size) | (g < -0.5 * size)
        near[who] = ~off
        beside[who] = over / size
        return found

    def _nearest(
        self,
        points: NDArray[np.float64],
        nodes: NDArray[np.float64],
        which: NDArray[np.int64],
        facets: NDArray[np.int64],
        faces: NDArray[np.bool_],
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the pairs in which a facet may be the closest.

        No facet is nearer than its box, nor farther than the place on it where its plane in the
        middle has the point.

        Args:
            points: Shape ``(n, gdim)``.
            nodes: Nodes of the facets.
            which: Points of some pairs.
            facets: Their facets.
            faces: Whether the facet of each faces its point for sure.
        """
        if len(which) == 0:
            return which, facets
        N, dN, _ = self.tabulate(self._start(1))
        middle, A = N[0] @ nodes, dN[0] @ nodes
        G = A @ A.swapaxes(1, 2)
        x, X = points[which], nodes[facets]
        along = np.einsum("nei,ni->ne", A[facets], x - middle[facets])
        good = _determinant(G)[facets] > 0.0
        place = self._start(len(which))
        place[good] += solved(G[facets][good], along[good])
        at, _, _ = self.tabulate(self.clamped(place))
        far = np.linalg.norm(x - np.einsum("nk,nki->ni", at, X), axis=1)
        most = np.full(len(points), np.inf)
        np.minimum.at(most, which[faces], far[faces])
        low, high = nodes.min(axis=1), nodes.max(axis=1)
        if self.element.degree > 1:  # which goes beyond its nodes
            more = 0.5 * (high - low)
            low, high = low - more, high + more
        out = np.maximum(np.maximum(low[facets] - x, x - high[facets]), 0.0)
        # (within round-off, as where surfaces touch all of these are nothing)
        slack = 1e-9 * (high - low).max(axis=1, initial=0.0)[facets]
        good = np.linalg.norm(out, axis=1) <= most[which] * (1.0 + 1e-9) + slack
        return which[good], facets[good]

    def _facing(
        self,
        points: NDArray[np.float64],
        outward: NDArray[np.float64] | None,
        nodes: NDArray[np.float64],
        which: NDArray[np.int64],
        facets: NDArray[np.int64],
        reach: float,
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
        """Return the pairs of points and facets that may be near, by the planes of the facets.

        And which of the facets face their points for sure.
        """
        faces = np.ones(len(which), dtype=bool)
        if len(which) == 0:
            return which, facets, faces
        _, dN, _ = self.tabulate(self._start(1))
        n = self.outward[:, None] * normals(np.einsum("ek,fki->fie", dN[0], nodes))
        n = n / np.maximum(np.linalg.norm(n, axis=1), 1e-300)[:, None]
        middle = nodes.mean(axis=1)
        curved = self.element.degree > 1 or self.element.dim == 4
        away = ((points[which] - middle[facets]) * n[facets]).sum(axis=1)
        size = np.linalg.norm(nodes - middle[:, None], axis=2).max(axis=1, initial=0.0)
        good = np.abs(away) <= reach + (0.5 * size[facets] if curved else 0.0)
        good &= np.linalg.norm(points[which] - middle[facets], axis=1) <= reach + size[facets]
        if outward is not None:
            facing = (outward[which] * n[facets]).sum(axis=1)
            good &= facing < MAY_FACE
            faces = facing < SURELY_FACING
        return which[good], facets[good], faces[good]

    def _candidates(
        self, points: NDArray[np.float64], nodes: NDArray[np.float64], reach: float
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return pairs of points and facets whose boxes, made larger by the reach, hold them."""
        none = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        if len(points) == 0 or len(nodes) == 0:
            return none
        low, high = nodes.min(axis=1) - reach, nodes.max(axis=1) + reach
        there = self.present & np.isfinite(low).all(axis=1) & np.isfinite(high).all(axis=1)
        if not there.any():
            return none
        edge = max(float(np.median((high - low)[there])), 1e-300)
        base = low[there].min(axis=0)
        top = high[there].max(axis=0)
        inside = ((points >= base) & (points <= top)).all(axis=1)
        who = np.flatnonzero(inside)
        if len(who) == 0:
            return none
        count = np.minimum((top - base) / edge + 1.0, 2.0**20).astype(np.int64)
        edges = (top - base) / count
        edges[edges == 0.0] = 1.0

        def tile(x: NDArray[np.float64]) -> NDArray[np.int64]:
            return np.asarray(np.clip((x - base) / edges, 0, count - 1).astype(np.int64))

        facets = np.flatnonzero(there)
        first, last = tile(low[facets]), tile(high[facets])
        most = (last - first).max(axis=0) + 1
        tiles, owners = [], []
        for shift in product(*(range(m) for m in most)):
            at = first + shift
            good = (at <= last).all(axis=1)
            tiles.append(np.ravel_multi_index(tuple(at[good].T), tuple(count)))
            owners.append(facets[good])
        all_tiles, all_owners = np.concatenate(tiles), np.concatenate(owners)
        order = np.argsort(all_tiles, kind="stable")
        all_tiles, all_owners = all_tiles[order], all_owners[order]
        mine = np.ravel_multi_index(tuple(tile(points[who]).T), tuple(count))
        begin = np.searchsorted(all_tiles, mine)
        size = np.searchsorted(all_tiles, mine, side="right") - begin
        which = np.repeat(who, size)
        offset = np.arange(size.sum()) - np.repeat(np.cumsum(size) - size, size)
        facet = all_owners[np.repeat(begin, size) + offset]
        x = points[which]
        good = ((x >= low[facet]) & (x <= high[facet])).all(axis=1)
        return which[good], facet[good]


def _determinant(G: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return determinants of matrices ``(n, e, e)`` of one or two rows."""
    if G.shape[1] == 1:
        return G[:, 0, 0]
    return np.asarray(G[:, 0, 0] * G[:, 1, 1] - G[:, 0, 1] * G[:, 1, 0])


def separated(
    table: Table, x: NDArray[np.float64], X: NDArray[np.float64], outward: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the ways from places on facets to points, and outward unit normals there.

    Args:
        table: Shape functions with derivatives at the places.
        x: The points, shape ``(n, gdim)``.
        X: Nodes of the facets, shape ``(n, k, gdim)``.
        outward: As that of :class:`Surface`.
    """
    N, dN, _ = table
    n = outward[:, None] * normals(np.einsum("nek,nki->nie", dN, X))
    return x - np.einsum("nk,nki->ni", N, X), n / np.linalg.norm(n, axis=1)[:, None]


def solved(G: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    """Return the solutions of positive systems ``(n, e, e)``, e = 1 or 2, for ``b``, ``(n, e)``."""
    if G.shape[1] == 1:
        return np.asarray(b / G[:, 0])
    det = G[:, 0, 0] * G[:, 1, 1] - G[:, 0, 1] * G[:, 1, 0]
    x = G[:, 1, 1] * b[:, 0] - G[:, 0, 1] * b[:, 1]
    y = G[:, 0, 0] * b[:, 1] - G[:, 1, 0] * b[:, 0]
    return np.asarray(np.stack([x, y], axis=1) / det[:, None])
