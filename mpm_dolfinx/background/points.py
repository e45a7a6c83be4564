# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Values of a background's basis at points."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["PointBasis"]


class PointBasis(NamedTuple):
    """Background basis functions at points.

    Attributes:
        nodes: Global node (block) numbers of V, shape ``(n, k)``.
        values: Their values at the points, zero where below 1e-13, shape ``(n, k)``.
        found: Whether a background cell holds the point, shape ``(n,)``.
        gradients: Their gradients, shape ``(n, k, gdim)``, where asked for.
        cell: The cell, a local number on the rank that owns it, shape ``(n,)``; ``None`` where
            values are of several cells.
        rank: That rank, shape ``(n,)``.
    """

    nodes: NDArray[np.int64]
    values: NDArray[np.float64]
    found: NDArray[np.bool_]
    gradients: NDArray[np.float64] | None = None
    cell: NDArray[np.integer[Any]] | None = None
    rank: NDArray[np.integer[Any]] | None = None

    def part(self, count: int) -> PointBasis:
        """Return the basis at the first points."""
        return PointBasis._make(None if a is None else a[:count] for a in self)
