# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Symmetric tensors as Mandel vectors.

A symmetric tensor is the vector of its components in an orthonormal basis, so that inner
products, norms and fourth-order tensors keep their meaning (Mandel 1965; Fedorov 1968):

- plane strain, ``m = 4``: xx, yy, zz, sqrt(2) xy,
- three dimensions, ``m = 6``: xx, yy, zz, sqrt(2) xy, sqrt(2) yz, sqrt(2) xz.

The functions that a yield function needs (:func:`trace`, :func:`deviator`, :func:`norm`)
accept complex vectors and are analytic in them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError

__all__ = [
    "deviator",
    "deviatoric_projector",
    "identity",
    "norm",
    "num_components",
    "to_tensor",
    "to_vector",
    "trace",
]

PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))
"""Tensor indices of each component."""

POSITIONS = np.array([[PAIRS.index((min(i, j), max(i, j))) for i in range(3)] for j in range(3)])
"""Component that holds each tensor entry."""

WEIGHTS = np.where(np.eye(3, dtype=bool), 1.0, np.sqrt(0.5))
"""Tensor entry over component."""


def num_components(dim: int) -> int:
    """Return the length m of a Mandel vector: 4 for ``dim = 2`` (plane strain), 6 for 3.

    Raises:
        MPMError: ``dim`` is neither 2 nor 3.
    """
    if dim not in (2, 3):
        raise MPMError(f"materials exist in 2 (plane strain) and 3 dimensions, not in {dim}")
    return 4 if dim == 2 else 6


def to_vector(tensor: NDArray[np.float64], dim: int) -> NDArray[np.float64]:
    """Return the Mandel vectors of symmetric tensors.

    Args:
        tensor: Symmetric tensors, shape ``(n, 3, 3)``.
        dim: Dimension of the body; for 2 the entries xz and yz are taken to be zero.

    Returns:
        Shape ``(n, m)``.
    """
    rows, columns = zip(*PAIRS[: num_components(dim)], strict=True)
    return np.asarray(tensor[:, rows, columns] / WEIGHTS[rows, columns])


def to_tensor(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the symmetric tensors, shape ``(n, 3, 3)``, of Mandel vectors ``(n, m)``."""
    tensor = np.zeros((len(vector), 3, 3))
    for k, (i, j) in enumerate(PAIRS[: vector.shape[1]]):
        tensor[:, i, j] = tensor[:, j, i] = vector[:, k] * WEIGHTS[i, j]
    return tensor


def identity(m: int) -> NDArray[np.float64]:
    """Return the Mandel vector of the identity, shape ``(m,)``."""
    vector = np.zeros(m)
    vector[:3] = 1.0
    return vector


def deviatoric_projector(m: int) -> NDArray[np.float64]:
    """Return the matrix, shape ``(m, m)``, that takes a vector to its deviator."""
    return np.eye(m) - np.outer(identity(m), identity(m)) / 3.0


def trace(vector: NDArray[Any]) -> NDArray[Any]:
    """Return the traces, shape ``(n,)``, of Mandel vectors ``(n, m)``."""
    return np.asarray(vector[:, 0] + vector[:, 1] + vector[:, 2])


def deviator(vector: NDArray[Any]) -> NDArray[Any]:
    """Return the deviators of Mandel vectors, shape ``(n, m)``."""
    result = vector.copy(order="K")
    result[:, :3] -= (trace(vector) / 3.0)[:, None]
    return result


def norm(vector: NDArray[Any]) -> NDArray[Any]:
    """Return the Frobenius norms, shape ``(n,)``, of Mandel vectors ``(n, m)``."""
    return np.asarray(np.sqrt(np.einsum("ni,ni->n", vector, vector)))
