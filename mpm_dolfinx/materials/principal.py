# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Isotropic laws in the principal frame of the trial strain, its values in descending order.

Arrays have their points last. An isotropic law's stress shares the axes of the strain, and its
tangent has two parts in that frame (Ogden 1984, section 6.1; de Souza Neto, Peric & Owen 2008,
appendix A): the derivatives of the principal stresses by the principal strains, and for each two
axes the quotient (stress_a - stress_b)/(strain_a - strain_b).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .tensors import eigen, pack, unpack

__all__ = ["axes_in_order", "from_axes", "tangent_from_axes"]

Array = NDArray[np.float64]


def axes_in_order(strain: Array) -> tuple[Array, Array]:
    """Return principal strains, the largest first, and their axes.

    Args:
        strain: Mandel vectors, shape ``(n, m)``.

    Returns:
        Values ``(3, n)`` and axes ``(3, 3, n)``, one per column.
    """
    n, m = strain.shape
    vector = strain.T
    if m == 6:
        values, axes = eigen(unpack(vector, 3))
    else:
        values, axes = np.empty((3, n)), np.zeros((3, 3, n))
        values[:2], axes[:2, :2] = eigen(unpack(vector, 2))
        values[2], axes[2, 2] = vector[2], 1.0
    order = np.argsort(-values, axis=0, kind="stable")
    return np.take_along_axis(values, order, 0), np.take_along_axis(axes, order[None], 1)


def from_axes(values: Array, axes: Array, m: int) -> Array:
    """Return Mandel vectors ``(n, m)`` of principal values ``(3, n)`` and axes ``(3, 3, n)``."""
    return pack(np.einsum("ian,jan->ijn", values * axes, axes))[:m].T


def tangent_from_axes(normal: Array, quotients: Array, axes: Array, m: int) -> Array:
    """Return the tangent of principal values as matrices of Mandel vectors, shape ``(n, m, m)``.

    Args:
        normal: Derivatives of the principal stresses by the principal strains, ``(3, 3, n)``.
        quotients: Those of differences of stress and strain, shape ``(3, 3, n)``.
        axes: Shape ``(3, 3, n)``.
        m: Length of a Mandel vector.
    """
    dyads = np.stack([pack(axes[:, None, a] * axes[None, :, a])[:m] for a in range(3)])
    tangent = np.einsum("ain,abn,bjn->nij", dyads, normal, dyads)
    for a, b in ((0, 1), (1, 2), (0, 2)):
        dyad = pack(axes[:, None, a] * axes[None, :, b])[:m]
        tangent += np.einsum("n,in,jn->nij", 2.0 * quotients[a, b], dyad, dyad)
    return np.asarray(tangent)
