# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Facets of one body near points of another: copies of them on the points' ranks, and the closest.

Facets are known by a number that is the same on any ranks. Compiled loops look for them in boxes of
a grid, so that the cost grows with the number of points and facets, not with its square.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import basix

from .._core import loops
from ..errors import ConvergenceError
from ..parallel.exchange import swap
from ..tolerances import HALF_DIGITS, LOCAL_ITERATIONS
from .surface import Surface, global_dofs, normals

__all__ = ["Closest", "NearFacets", "Table", "separated"]

#: Cosine of the angle of two normals below which surfaces face each other; and in the middle of a
#: facet, below which they may do so somewhere, and below which they do so for sure.
FACING, MAY_FACE, SURELY_FACING = -0.1, 0.5, -0.4

COLLAPSE = "Facets of a Pair collapse; take smaller steps"

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

    @classmethod
    def none(cls, n: int, e: int) -> Closest:
        """Return the closest facets of n points to which none is near."""
        facet, gap, place = np.full(n, -1, dtype=np.int64), np.full(n, np.inf), np.zeros((n, e))
        return cls(facet, place, gap, np.zeros(n, dtype=bool), np.zeros(n))

    def with_some(self, which: NDArray[np.int64], **parts: Any) -> Closest:
        """Return these with other values of some points, by names."""
        for name, values in parts.items():
            whole = parts[name] = getattr(self, name).copy()
            whole[which] = values
        return self._replace(**parts)


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
        degree, e = self.element.degree, self.gdim - 1
        simplex = self.element.cell_type != basix.CellType.quadrilateral
        grid = np.indices((degree + 1,) * e).reshape(e, -1).T
        # shape functions by monomials
        powers = grid[grid.sum(axis=1) <= degree] if simplex else grid
        values = np.prod(self.element.points[:, None, :] ** powers, axis=2)
        self._shape = np.linalg.inv(values), (degree, simplex), HALF_DIGITS, LOCAL_ITERATIONS
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

    def tabulate(self, place: NDArray[np.float64]) -> Table:
        """Return shape functions with first and second derivatives at reference points ``(n, e)``.

        Returns:
            Shapes ``(n, k)``, ``(n, e, k)`` and ``(n, e, e, k)``.
        """
        (n, e), k = place.shape, self.element.dim
        shapes = ((n, k), (n, e, k), (n, e, e, k))
        N, dN, ddN = (np.empty(shape) for shape in shapes)
        loops.tabulate(np.ascontiguousarray(place), *self._shape, N, dN, ddN)
        return N, dN, ddN

    def project(
        self, points: NDArray[np.float64], nodes: NDArray[np.float64], place: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return where points project onto facets, by Newton's method from a place.

        Args:
            points: Shape ``(n, gdim)``.
            nodes: Nodes of the facet of each, shape ``(n, k, gdim)``.
            place: Where to begin, shape ``(n, e)``.

        Raises:
            ConvergenceError: A facet has no area.
        """
        found = np.array(place)
        nodes = np.ascontiguousarray(nodes)
        if not loops.project(np.ascontiguousarray(points), nodes, *self._shape, found):
            raise ConvergenceError(COLLAPSE)
        return found

    def clamped(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return places within the reference facet."""
        inner = np.clip(place, 0.0, 1.0)
        if self.element.cell_type == basix.CellType.triangle:
            inner = inner / np.maximum(inner.sum(axis=1), 1.0)[:, None]
        return inner

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
            ConvergenceError: A facet has no area.
        """
        found = Closest.none(len(points), self.gdim - 1)
        good = loops.find_closest(
            np.ascontiguousarray(points),
            np.zeros((0, 1)) if outward is None else np.ascontiguousarray(outward),
            np.ascontiguousarray(nodes),
            *self._shape,
            np.ascontiguousarray(self.outward),
            self.present.view(np.uint8),
            [reach, FACING, SURELY_FACING, MAY_FACE],
            found.facet,
            found.place,
            found.gap,
            found.near.view(np.uint8),
            found.beside,
        )
        if not good:
            raise ConvergenceError(COLLAPSE)
        return found


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
