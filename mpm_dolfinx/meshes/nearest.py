# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The segments or triangles that are nearest to points, by a tree of boxes.

Facets are ordered along a curve that fills space (Morton 1966), so that such of near numbers lie
together, and boxes are made of them, level by level. All points go down the levels together, into
all boxes that are not farther away than the nearest place that is known. The cost for each point
grows with the logarithm of the number of facets.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..tolerances import EQUAL, LAST_PLACES

__all__ = ["FacetTree", "Nearest"]

#: Boxes in a box of the next level, and points that are looked at together.
ARITY, AT_ONCE = 4, 2048


class Nearest(NamedTuple):
    """Where points are nearest to facets.

    Attributes:
        facet: The facet, that of lowest number among equals, shape ``(n,)``.
        corner: Local corner that is nearest, -1 where none is, shape ``(n,)``.
        edge: Local edge of a triangle (from corner ``edge`` to the next) that is nearest, -1 where
            none is, nor a corner, shape ``(n,)``.
    """

    facet: NDArray[np.int64]
    corner: NDArray[np.int64]
    edge: NDArray[np.int64]


class FacetTree:
    """Segments in the plane or triangles in space, in which the nearest to points are looked for.

    Args:
        corners: Corners of each, shape ``(m, dim, dim)``, at least one facet.
    """

    def __init__(self, corners: NDArray[np.float64]) -> None:
        m, dim = len(corners), corners.shape[-1]
        self._corners, self._dim = corners, dim
        self._nothing = (LAST_PLACES * np.abs(corners).max()) ** 2
        self._hints: dict[int, NDArray[np.int64]] = {}
        order = _along_curve(corners.mean(axis=1))
        self._facets = order
        # level 0 has the facets themselves
        self._low, self._high = [corners.min(axis=1)[order]], [corners.max(axis=1)[order]]
        self._some = [corners[order, 0]]
        while len(self._low[-1]) > 2 * ARITY:
            starts = np.arange(0, len(self._low[-1]), ARITY)
            self._low.append(np.minimum.reduceat(self._low[-1], starts))
            self._high.append(np.maximum.reduceat(self._high[-1], starts))
            self._some.append(self._some[-1][starts])
        edges = np.roll(corners, -1, axis=1) - corners
        self._edges = edges if dim == 3 else edges[:, :1]
        self._squares = (self._edges**2).sum(axis=2)
        if dim == 3:
            a, b = edges[:, 0], -edges[:, 2]
            normal = np.cross(a, b)
            size = (normal**2).sum(axis=1)
            # a facet without area has no inside
            size = np.where(size > 0.0, size, np.inf)[:, None]
            self._normal = normal / np.sqrt(size)
            self._dual = (
                np.stack([np.cross(b, normal), np.cross(normal, a)], axis=1) / size[:, None]
            )
        assert m > 0

    def __call__(self, points: NDArray[np.float64]) -> Nearest:
        """Return where points are nearest to the facets.

        It is fastest where as many points as in a call before are near to where these were.

        Args:
            points: Shape ``(n, dim)``.
        """
        hints = self._hints.get(len(points))
        parts = [np.zeros(0, np.int64)]
        for i in range(0, len(points), AT_ONCE):
            here = slice(i, i + AT_ONCE)
            parts.append(self._find(points[here], None if hints is None else hints[here]))
        facet = np.concatenate(parts)
        if len(self._hints) >= 4:  # sets of points for which facets are kept
            self._hints.clear()
        self._hints[len(points)] = facet
        _, corner, edge = self._places(points, facet)
        return Nearest(facet, corner, edge)

    def ways(self, points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the nearest facets of points, and the ways to their nearest places.

        A way to the inside of a facet is along its normal to the last place.

        Args:
            points: Shape ``(n, dim)``.

        Returns:
            Shapes ``(n,)`` and ``(n, dim)``.
        """
        facet, corner, edge = self(points)
        row, corners = np.arange(len(points)), self._corners[facet]
        arm = points - corners[row, np.maximum(np.maximum(corner, edge), 0)]
        if self._dim == 2:
            inside = corner < 0
            along = self._edges[facet, 0]
            normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
            normal /= np.linalg.norm(normal, axis=1)[:, None]
        else:
            inside = (corner < 0) & (edge < 0)
            normal = self._normal[facet]
            side = self._edges[facet, np.maximum(edge, 0)]
            square = self._squares[facet, np.maximum(edge, 0)]
            share = (arm * side).sum(axis=1) / np.where(square > 0.0, square, np.inf)
            arm = np.where((edge >= 0)[:, None], arm - share[:, None] * side, arm)
        flat = (arm * normal).sum(axis=1)[:, None] * normal
        return facet, -np.where(inside[:, None], flat, arm)

    def _find(
        self, points: NDArray[np.float64], hints: NDArray[np.int64] | None
    ) -> NDArray[np.int64]:
        """Return the nearest facets; hints are such that are near."""
        n = len(points)
        best = np.full(n, np.inf)
        if hints is not None:
            best = self._up(self._places(points, hints)[0])
        count = len(self._low[-1])
        which, node = np.repeat(np.arange(n), count), np.tile(np.arange(count), n)
        for level in reversed(range(len(self._low))):
            x = points[which]
            out = np.maximum(self._low[level][node] - x, x - self._high[level][node])
            out = np.maximum(out, 0.0)
            least = (out**2).sum(axis=1)
            if hints is None:
                most = ((x - self._some[level][node]) ** 2).sum(axis=1)
                best = np.minimum(best, self._up(_least_of_each(most, which)))
            left = least <= best[which]
            which, node = which[left], node[left]
            if level:
                which = np.repeat(which, ARITY)
                node = (node[:, None] * ARITY + np.arange(ARITY)).ravel()
                there = node < len(self._low[level - 1])
                which, node = which[there], node[there]
        facet = self._facets[node]
        square, _, _ = self._places(points[which], facet)
        best = self._up(_least_of_each(square, which))
        return _least_of_each(np.where(square <= best[which], facet, len(self._corners)), which)

    def _up(self, squares: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return squared distances that are larger by round-off."""
        return np.asarray(squares * (1.0 + EQUAL) + self._nothing)

    def _places(
        self, x: NDArray[np.float64], facet: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
        """Return squared distances of points to facets, and their nearest corner or edge."""
        arm = x[:, None] - self._corners[facet][:, : self._edges.shape[1]]
        edges, squares = self._edges[facet], self._squares[facet]
        along = (arm * edges).sum(axis=2) / np.where(squares > 0.0, squares, np.inf)
        along = np.clip(along, 0.0, 1.0)
        off = ((arm - along[:, :, None] * edges) ** 2).sum(axis=2)
        row = np.arange(len(x))
        edge = off.argmin(axis=1)
        square, place = off[row, edge], along[row, edge]
        corner = np.where(place <= 0.0, edge, np.where(place >= 1.0, (edge + 1) % self._dim, -1))
        if self._dim == 2:
            return square, corner, np.full(len(x), -1)
        uv = np.einsum("ni,nki->nk", arm[:, 0], self._dual[facet])
        inner = (uv >= 0.0).all(axis=1) & (uv.sum(axis=1) <= 1.0)
        inner &= (self._dual[facet] != 0.0).any(axis=(1, 2))
        flat = (arm[:, 0] * self._normal[facet]).sum(axis=1) ** 2
        corner = np.where(inner, -1, corner)
        edge = np.where(inner | (corner >= 0), -1, edge)
        return np.where(inner, flat, square), corner, edge


def _least_of_each(values: NDArray[Any], which: NDArray[np.int64]) -> NDArray[Any]:
    """Return the least of the values of each point, of which all have some, sorted by points."""
    return np.asarray(np.minimum.reduceat(values, np.flatnonzero(np.diff(which, prepend=-1))))


def _along_curve(x: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return an order of points in which neighbours are near (Morton's)."""
    dim = x.shape[1]
    bits = 20
    span = np.maximum(np.ptp(x, axis=0).max(), 1e-300)
    cells = ((x - x.min(axis=0)) / span * (2**bits - 1)).astype(np.uint64)
    code = np.zeros(len(x), dtype=np.uint64)
    for bit in range(bits):
        for axis in range(dim):
            one = (cells[:, axis] >> np.uint64(bit)) & np.uint64(1)
            code |= one << np.uint64(bit * dim + axis)
    return np.asarray(np.argsort(code, kind="stable"))
