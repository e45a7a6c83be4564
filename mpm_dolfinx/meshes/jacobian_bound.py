# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A sure lower bound of a curved domain's Jacobian, by Bernstein coefficients."""

from __future__ import annotations

from itertools import product
from math import comb, factorial
from typing import Any

import numpy as np
from numpy.typing import NDArray

import basix

from ..tolerances import NEGLIGIBLE

__all__ = ["JacobianBound", "jacobians"]

#: Halvings of a domain after which a Jacobian that may vanish counts as vanishing.
HALVINGS = 4


class JacobianBound:
    """Whether ``det dx/dxi`` of mapped cells is positive everywhere, decided for sure.

    The determinant is a polynomial in the reference cell, nowhere below its smallest Bernstein
    coefficient, and equal to those at the corners (Johnen, Remacle & Geuzaine 2013). Where the
    corners are positive and a coefficient is not, the cell is halved.

    Args:
        cell: Cell type.
        shape_functions: basix element of the map.
    """

    def __init__(self, cell: basix.CellType, shape_functions: Any) -> None:
        gdim = len(basix.topology(cell)) - 1
        degree = shape_functions.degree
        simplex = cell in (basix.CellType.triangle, basix.CellType.tetrahedron)
        self._degree = gdim * (degree - 1) if simplex else gdim * degree - 1
        n = max(self._degree, 0)
        powers = np.array(list(product(range(n + 1), repeat=gdim)))
        self._powers = powers[powers.sum(axis=1) <= n] if simplex else powers
        self._simplex = simplex
        points = self._powers / max(n, 1)
        self._slopes = shape_functions.tabulate(1, points)[1:, :, :, 0]
        self._to_bernstein = np.linalg.inv(self._basis(points))
        corners = basix.geometry(cell)
        self._corners = [int(np.argmin(np.abs(points - corner).sum(axis=1))) for corner in corners]
        self._parts = [
            self._to_bernstein @ self._basis(origin + points @ axes)
            for origin, axes in _halves(cell, corners)
        ]

    def _basis(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the Bernstein polynomials at points, shape ``(points, polynomials)``."""
        n = self._degree
        if self._simplex:
            whole = np.column_stack([points, 1.0 - points.sum(axis=1)])
            powers = np.column_stack([self._powers, n - self._powers.sum(axis=1)])
            number = [factorial(n) / np.prod([factorial(k) for k in p]) for p in powers]
            return np.asarray(number * np.prod(whole[:, None] ** powers, axis=2))
        number = [np.prod([comb(n, k) for k in p]) for p in self._powers]
        inner = points[:, None] ** self._powers * (1.0 - points[:, None]) ** (n - self._powers)
        return np.asarray(number * np.prod(inner, axis=2))

    def coefficients(self, nodes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the Bernstein coefficients of the determinants of cells ``(n, k, gdim)``."""
        return np.asarray(jacobians(self._slopes, nodes) @ self._to_bernstein.T)

    def lower_bound(
        self, nodes: NDArray[np.float64], sign: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return a bound from below of the determinants, after two halvings, shape ``(n,)``.

        Args:
            nodes: Nodes of the cells, shape ``(n, k, gdim)``.
            sign: The right sign, shape ``(n,)``.
        """
        values = self.coefficients(nodes)
        halves = [values @ part.T for part in self._parts]
        quarters = [half @ part.T for half in halves for part in self._parts]
        least = np.min([(sign[:, None] * q).min(axis=1, initial=np.inf) for q in quarters], axis=0)
        return np.asarray(least)

    def vanishes(self, nodes: NDArray[np.float64], sign: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which cells have a determinant that is zero or of the wrong sign somewhere.

        Args:
            nodes: Nodes of the cells, shape ``(n, k, gdim)``.
            sign: The right sign, shape ``(n,)``.

        Returns:
            Shape ``(n,)``; a positive determinant below about 1e-2 of its range may count too.
        """
        result = np.zeros(len(nodes), dtype=bool)
        cell = np.arange(len(nodes))
        open_ = self.coefficients(nodes) * sign[:, None]
        if (open_ > 0.0).all():
            return result
        for halving in range(HALVINGS + 1):
            wrong = ~(open_[:, self._corners] > 0.0).all(axis=1)
            result[cell[wrong]] = True
            unsure = ~(open_ > 0.0).all(axis=1) & ~result[cell]
            cell, open_ = cell[unsure], open_[unsure]
            if halving == HALVINGS or len(cell) == 0:
                break
            open_ = np.concatenate([open_ @ part.T for part in self._parts])
            cell = np.tile(cell, len(self._parts))
        result[cell] = True
        return result

    def folded(
        self, nodes: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Return sign and size of cells, and which have a determinant of both signs for sure.

        Args:
            nodes: Nodes of the cells, shape ``(n, k, gdim)``.

        Returns:
            Sign of the volume, the largest coefficient, and whether the determinant has the other
            sign somewhere, shape ``(n,)`` each.
        """
        values = self.coefficients(nodes)
        sign = np.where(values.sum(axis=1) < 0.0, -1.0, 1.0)
        size = np.abs(values).max(axis=1, initial=0.0)
        open_ = values * (sign / np.maximum(size, np.finfo(float).tiny))[:, None]
        result, cell = np.zeros(len(nodes), dtype=bool), np.arange(len(nodes))
        for _ in range(HALVINGS + 1):
            result[cell[(open_[:, self._corners] < -NEGLIGIBLE).any(axis=1)]] = True
            unsure = (open_ < -NEGLIGIBLE).any(axis=1) & ~result[cell]
            cell, open_ = cell[unsure], open_[unsure]
            if len(cell) == 0:
                break
            open_ = np.concatenate([open_ @ part.T for part in self._parts])
            cell = np.tile(cell, len(self._parts))
        return sign, size, result


def jacobians(slopes: NDArray[np.float64], nodes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return det dx/dxi of cells at points, shape ``(n, points)``.

    Args:
        slopes: Derivatives of their shape functions there, shape ``(gdim, points, k)``.
        nodes: The cells, shape ``(n, k, gdim)``.
    """
    gdim, points, k = slopes.shape
    columns = np.matmul(slopes.reshape(-1, k), nodes).reshape(-1, gdim, points, gdim)
    a, b, c = columns[:, 0], columns[:, 1], columns[:, -1]
    if columns.shape[1] == 2:
        return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
    return np.asarray(
        a[..., 0] * (b[..., 1] * c[..., 2] - b[..., 2] * c[..., 1])
        + a[..., 1] * (b[..., 2] * c[..., 0] - b[..., 0] * c[..., 2])
        + a[..., 2] * (b[..., 0] * c[..., 1] - b[..., 1] * c[..., 0])
    )


def _halves(
    cell: basix.CellType, corners: NDArray[np.float64]
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return the parts that halving its edges makes of a reference cell: origins and axes."""
    half = 0.5 * np.eye(corners.shape[1])
    parts = [(0.5 * corner, half) for corner in corners]
    if cell == basix.CellType.triangle:
        parts.append((np.full(2, 0.5), -half))
    elif cell == basix.CellType.tetrahedron:
        # An octahedron is left inside: four parts around the line between two of its corners.
        middle = 0.5 * (corners[:, None] + corners[None])
        ring = [middle[0, 1], middle[1, 2], middle[2, 3], middle[3, 0]]
        one, other = middle[0, 2], middle[1, 3]
        for a, b in zip(ring, ring[1:] + ring[:1], strict=True):
            parts.append((one, np.stack([other - one, a - one, b - one])))
    return parts
