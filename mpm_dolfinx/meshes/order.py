# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""An order of points in which neighbours come one after the other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["morton_order"]

#: Bits of a coordinate.
BITS = 10


def morton_order(points: NDArray[np.float64]) -> NDArray[np.int32]:
    """Return the order of points along Morton's curve.

    Args:
        points: Shape ``(n, gdim)``.

    Returns:
        Shape ``(n,)``.
    """
    gdim = points.shape[1]
    code = np.zeros(len(points), dtype=np.uint32)
    if len(points) > 0:
        low = points.min(axis=0)
        size = float((points.max(axis=0) - low).max()) or 1.0
        cells = ((points - low) * ((2**BITS - 1) / size)).astype(np.uint32)
        for bit in range(BITS):
            for i in range(gdim):
                code |= ((cells[:, i] >> bit) & 1) << (bit * gdim + i)
    return np.argsort(code, kind="stable").astype(np.int32)
