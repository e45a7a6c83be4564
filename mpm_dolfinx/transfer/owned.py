# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Rows of T of nodes that several ranks know."""

from __future__ import annotations

import numpy as np

from dolfinx import fem, la

from ..background.basis import PointBasis

__all__ = ["OwnedRows"]


class OwnedRows:
    """Gives nodes that several ranks know the rows of the rank that owns them.

    What ranks find by themselves differs by round-off, as they know different parts of the
    background. Of a node 1e-12 of a cell behind a facet, as on a stiff support, that is the fifth
    digit of a weight. Domains of two ranks would follow the background by different T, and the sum
    of their tangents would be that of no forces.

    Args:
        W: Space of the domains (collective).
        count: Number of background nodes of a row.
    """

    def __init__(self, W: fem.FunctionSpace, count: int) -> None:
        layout = W.dofmap.index_map
        self._own = layout.size_local
        self._nodes = la.vector(layout, count, dtype=np.int64)
        self._values = la.vector(layout, count + 1, dtype=np.float64)

    def share(self, rows: PointBasis) -> None:
        """Replace the rows of nodes that others own (collective).

        Args:
            rows: The background basis at the local nodes of W; changed.
        """
        own, count = self._own, rows.nodes.shape[1]
        nodes = self._nodes.array.reshape(-1, count)
        values = self._values.array.reshape(-1, count + 1)
        nodes[:own], values[:own, :count] = rows.nodes[:own], rows.values[:own]
        values[:own, count] = rows.found[:own]
        self._nodes.scatter_forward()
        self._values.scatter_forward()
        rows.nodes[own:], rows.values[own:] = nodes[own:], values[own:, :count]
        rows.found[own:] = values[own:, count] > 0.0
