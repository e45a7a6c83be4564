# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Polynomials of a background cell, continued beyond it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import basix
import basix.ufl
from dolfinx import fem

from .. import _compat

__all__ = ["CellPolynomials", "Frame"]


class Frame(NamedTuple):
    """Affine coordinates of cells: zero at the middle, one cell long.

    Attributes:
        origin: Shape ``(n, gdim)``.
        axes: Inverse of the cell's axes, shape ``(n, gdim, gdim)``.
    """

    origin: NDArray[np.float64]
    axes: NDArray[np.float64]


class Moments(NamedTuple):
    """A cell's basis as polynomials.

    Attributes:
        mass: Mass matrix of the polynomials over the cell, shape ``(n, a, a)``.
        coefficients: Of each basis function, shape ``(n, a, k)``.
        volume: Volume of the cell, shape ``(n,)``.
    """

    mass: NDArray[np.float64]
    coefficients: NDArray[np.float64]
    volume: NDArray[np.float64]


class CellPolynomials:
    """The L2 projection of a cell's basis on polynomials in an affine frame.

    In affine cells it is the basis itself: polynomials of total degree k on simplices, of degree
    k in each direction elsewhere.

    Args:
        V: Background space of degree k.
    """

    def __init__(self, V: fem.FunctionSpace) -> None:
        cell = V.mesh.basix_cell()
        self._gdim = V.mesh.geometry.dim
        self._degree = V.ufl_element().degree
        order = _compat.geometry_degree(V.mesh)
        shape = basix.ufl.element("Lagrange", cell.name, order).basix_element
        # Gauss and Jacobi's weights are positive, which not all rules on simplices have.
        points, self._weights = basix.make_quadrature(
            cell, 2 * self._degree + self._gdim * order, rule=basix.QuadratureType.gauss_jacobi
        )
        self._values = V.ufl_element().basix_element.tabulate(0, points)[0, :, :, 0]
        self._map = shape.tabulate(1, points)[:, :, :, 0]
        self._middle = shape.tabulate(1, basix.geometry(cell).mean(axis=0)[None])[:, 0, :, 0]
        powers = np.indices((self._degree + 1,) * self._gdim).reshape(self._gdim, -1)
        if cell in (basix.CellType.triangle, basix.CellType.tetrahedron):
            powers = powers[:, powers.sum(axis=0) <= self._degree]
        self._powers = powers

    def frame(self, vertices: NDArray[np.float64]) -> Frame:
        """Return the frames of cells with geometry nodes ``(n, m, gdim)``."""
        axes = np.einsum("jm,nmi->nij", self._middle[1:], vertices)
        return Frame(np.einsum("m,nmi->ni", self._middle[0], vertices), np.linalg.inv(axes))

    def at(self, points: NDArray[np.float64], frame: Frame) -> NDArray[np.float64]:
        """Return the polynomials at points ``(n, q, gdim)``, shape ``(n, q, a)``."""
        local = np.einsum("nij,nqj->nqi", frame.axes, points - frame.origin[:, None])
        table = np.polynomial.legendre.legvander(local, self._degree)
        values = np.ones((*points.shape[:2], self._powers.shape[1]))
        for axis, power in enumerate(self._powers):
            values *= table[:, :, axis][:, :, power]
        return values

    def moments(self, vertices: NDArray[np.float64], frame: Frame) -> Moments:
        """Project the basis of cells with geometry nodes ``(n, m, gdim)``."""
        points = np.einsum("qm,nmi->nqi", self._map[0], vertices)
        jacobian = np.einsum("jqm,nmi->nqij", self._map[1:], vertices)
        measure = self._weights * np.abs(np.linalg.det(jacobian))
        root = np.sqrt(measure)[:, :, None]
        # The mass matrix squares the condition of its factor, from which one does as well.
        Q, R = np.linalg.qr(root * self.at(points, frame))
        coefficients = np.linalg.solve(R, Q.swapaxes(1, 2) @ (root * self._values))
        return Moments(R.swapaxes(1, 2) @ R, coefficients, measure.sum(axis=1))
