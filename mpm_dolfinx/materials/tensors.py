# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Algebra of many small tensors, with the points last.

Arrays are contiguous with shape ``(..., n)``: operations on components run over contiguous
memory, several times faster than products of many small matrices.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .mandel import PAIRS, POSITIONS, WEIGHTS, num_components

__all__ = [
    "determinant",
    "eigen",
    "growth",
    "inverse",
    "logarithm_quotient",
    "pack",
    "points_first",
    "points_last",
    "unpack",
]

Array = NDArray[np.float64]


def points_last(array: Array) -> Array:
    """Return a copy of an array ``(n, ...)`` as a contiguous one ``(..., n)``."""
    return np.array(np.moveaxis(array, 0, -1), dtype=np.float64, order="C")


def points_first(array: Array) -> Array:
    """Return an array ``(..., n)`` as a contiguous one ``(n, ...)``."""
    return np.ascontiguousarray(np.moveaxis(array, -1, 0))


def pack(tensor: Array) -> Array:
    """Return Mandel vectors ``(m, n)`` of the symmetric parts of ``(dim, dim, n)``."""
    dim = len(tensor)
    vector = np.zeros((num_components(dim), tensor.shape[-1]))
    for k, (i, j) in enumerate(PAIRS[: len(vector)]):
        if max(i, j) < dim:
            vector[k] = tensor[i, i] if i == j else (tensor[i, j] + tensor[j, i]) * WEIGHTS[i, j]
    return vector


def unpack(vector: Array, dim: int) -> Array:
    """Return the block ``(dim, dim, ...)`` of the tensors of Mandel vectors ``(m, ...)``."""
    weights = WEIGHTS[:dim, :dim].reshape((dim, dim) + (1,) * (vector.ndim - 1))
    return np.asarray(vector[POSITIONS[:dim, :dim]] * weights)


def determinant(gradient: Array) -> Array:
    """Return det(I + H), shape ``(n,)``, of displacement gradients ``(dim, dim, n)``."""
    return inverse(gradient)[1]


def growth(gradient: Array) -> Array:
    """Return det(I + H) - 1 with the relative precision of a small H, shape ``(..., dim, dim)``."""
    trace = np.einsum("...ii->...", gradient)
    change = trace + 0.5 * (trace**2 - np.einsum("...ij,...ji->...", gradient, gradient))
    return np.asarray(change if gradient.shape[-1] == 2 else change + np.linalg.det(gradient))


def inverse(gradient: Array) -> tuple[Array, Array]:
    """Return the inverse of I + H and its determinant.

    Args:
        gradient: Displacement gradients H, shape ``(dim, dim, n)``.

    Returns:
        Inverses ``(dim, dim, n)`` and determinants ``(n,)``.
    """
    dim = len(gradient)
    F = gradient + np.eye(dim)[:, :, None]
    adjugate = np.empty_like(F)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if dim == 2:
            adjugate[0, 0], adjugate[0, 1] = F[1, 1], -F[0, 1]
            adjugate[1, 0], adjugate[1, 1] = -F[1, 0], F[0, 0]
        else:
            for k in range(3):
                adjugate[:, k] = np.cross(F[(k + 1) % 3], F[(k + 2) % 3], axis=0)
        det = np.einsum("jn,jn->n", F[0], adjugate[:, 0])
        return adjugate / det, det


def eigen(tensor: Array) -> tuple[Array, Array]:
    """Return eigenvalues and eigenvectors of symmetric tensors.

    In two dimensions by the rotation of Jacobi, whose error is that of round-off relative to
    the largest entry (Golub & Van Loan 2013, section 8.5.2), far faster than LAPACK point
    by point.

    Args:
        tensor: Symmetric tensors, shape ``(dim, dim, n)``.

    Returns:
        Eigenvalues ``(dim, n)`` and eigenvectors ``(dim, dim, n)``, one per column.
    """
    if len(tensor) == 3:
        values, vectors = np.linalg.eigh(np.moveaxis(tensor, -1, 0))
        return np.ascontiguousarray(values.T), points_last(vectors)
    mean = 0.5 * (tensor[0, 0] + tensor[1, 1])
    half = 0.5 * (tensor[0, 0] - tensor[1, 1])
    radius = np.hypot(half, tensor[0, 1])
    # (far, near) is along the axis of the larger eigenvalue where half >= 0, its mirror else.
    far, near = np.abs(half) + radius, tensor[0, 1]
    length = np.hypot(far, near)
    isotropic = length == 0.0
    length[isotropic] = 1.0
    far[isotropic] = 1.0
    far, near = far / length, near / length
    upright = half >= 0.0
    cosine, sine = np.where(upright, far, near), np.where(upright, near, far)
    vectors = np.stack((np.stack((cosine, -sine)), np.stack((sine, cosine))))
    return np.stack((mean + radius, mean - radius)), vectors


def logarithm_quotient(first: Array, second: Array) -> Array:
    """Return (1/2 ln(1 + x) - 1/2 ln(1 + y))/(x - y), its limit for x = y."""
    difference = first - second
    ratio = difference / (1.0 + second)
    equal = difference == 0.0
    ratio[equal] = 1.0
    quotient = np.log1p(ratio) / ratio
    quotient[equal] = 1.0
    return np.asarray(0.5 * quotient / (1.0 + second))
