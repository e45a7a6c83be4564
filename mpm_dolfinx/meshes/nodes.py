# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Positions of the nodes of a space."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from .. import _compat
from ..tolerances import BLOCK, EQUAL
from .cells import coordinate_element

__all__ = ["node_positions"]


def node_positions(space: fem.FunctionSpace) -> NDArray[np.float64]:
    """Return the positions of the local nodes of a Lagrange space, shape ``(N, gdim)``.

    They are the same to the last bit from whatever cell a node is seen, and so on any number of
    ranks. DOLFINx's own differ by round-off, and with them the weights of a background node that is
    just behind a facet: a body on a line of the grid has other motions then.
    """
    domain, layout = space.mesh, space.dofmap.index_map
    points = space.ufl_element().basix_element.points
    map_of_cells = coordinate_element(domain).basix_element
    table = _equalised(_compat.tabulated(map_of_cells, 0, points)[0])
    dofs, nodes = space.dofmap.list, _compat.geometry_dofmap(domain)
    x = domain.geometry.x[:, : domain.geometry.dim]
    result = np.empty((layout.size_local + layout.num_ghosts, x.shape[1]))
    for start in range(0, len(nodes), BLOCK):
        own = slice(start, start + BLOCK)
        corners = x[nodes[own]]
        # (sums have one order in all cells, and nodes off a common facet add zero)
        order = np.lexsort(np.moveaxis(corners, 2, 0), axis=1)
        sums = np.zeros((len(corners), len(points), x.shape[1]))
        for place in order.T:
            sums += table.T[place][:, :, None] * corners[np.arange(len(place)), place][:, None]
        result[dofs[own]] = sums
    return result


def _equalised(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return values of which those that differ by round-off are equal; of integers, these."""
    distinct, number = np.unique(values, return_inverse=True)
    first = np.flatnonzero(np.diff(distinct, prepend=-np.inf) > EQUAL)
    chosen = distinct[first]
    whole = np.round(chosen)
    chosen = np.where(np.abs(chosen - whole) <= EQUAL, whole, chosen)
    group = np.searchsorted(first, np.arange(len(distinct)), side="right") - 1
    return np.asarray(chosen[group][number].reshape(values.shape))
