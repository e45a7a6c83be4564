# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Means of gradients over quadrilaterals, in UFL, which knows values at points."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import ufl

from .geometry import Geometry

__all__ = ["MeansInUFL"]

type Array = NDArray[np.float64]

#: Mixed second derivative of the shape functions of a quadrilateral of degree 1.
MIXED = np.array([1.0, -1.0, -1.0, 1.0])


class MeansInUFL:
    """How means over quadrilaterals of degree 1 follow from what a function is in the middle.

    Each linear functional of a bilinear function is a sum of its value, gradient and mixed second
    derivative in the middle; here are the factors.

    Args:
        geometry: The quadrilaterals.
    """

    def __init__(self, geometry: Geometry) -> None:
        self._geometry = geometry
        self._factors = geometry.quadrature_function("means", (11,))

    def set(self, gradients: Array, hoop: Array, share: Array) -> None:
        """Say what the means are.

        Args:
            gradients: Mean gradients of the shape functions, shape ``(n, k, 2)``.
            hoop: Mean hoop strains by a radial displacement of each node, shape ``(n, k)``.
            share: Volume that the point stands for over that in the mesh, shape ``(n,)``.
        """
        corners = self._geometry.corners
        before = np.einsum("nki,nkj->nij", corners, gradients).reshape(-1, 4)
        away = np.einsum("nk,nki->ni", hoop, corners - corners.mean(axis=1, keepdims=True))
        columns = [before, MIXED @ gradients / 4.0, hoop.sum(axis=1)[:, None], away]
        columns += [(hoop @ MIXED / 4.0)[:, None], share[:, None]]
        values = np.hstack(columns)
        self._factors.x.array[: values.size] = values.ravel()
        self._factors.x.scatter_forward()

    @property
    def share(self) -> Any:
        """Volume that the point stands for over that in the mesh."""
        return self._factors[10]

    def gradient(self, w: Any) -> Any:
        """Return the mean gradient of a displacement w, shape ``(2, 2)``."""
        f = self._factors
        before = ufl.as_matrix([[f[0], f[1]], [f[2], f[3]]])
        return ufl.dot(ufl.grad(w), before) + ufl.outer(self._mixed(w), ufl.as_vector([f[4], f[5]]))

    def hoop(self, w: Any) -> Any:
        """Return the mean hoop strain of a displacement w."""
        f, slope = self._factors, ufl.grad(w)
        return f[6] * w[0] + f[7] * slope[0, 0] + f[8] * slope[0, 1] + f[9] * self._mixed(w)[0]

    def _mixed(self, w: Any) -> Any:
        """Return the mixed second derivative by the cell's coordinates of what is not linear."""
        i, j, k = ufl.indices(3)
        J = ufl.Jacobian(self._geometry.mesh)
        return ufl.as_vector(ufl.grad(ufl.grad(w))[i, j, k] * J[j, 0] * J[k, 1], i)
