# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The meshes that a body has left, and what has moved with it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dolfinx import mesh

from .redistribution import Carrier
from .remesh import Cuts

__all__ = ["Trail"]

#: How many of the meshes that a body has left are known, but the first: each holds communicators
#: of MPI, of which there are about 2000.
REMEMBERED = 8


class Trail:
    """The way of a body from the mesh that was given to the present one.

    Attributes:
        cuts: Which quadrilaterals were cut, in the order of the cuts, shape ``(m, 2)``.
        rebases: How often the nodes of the mesh were moved.
    """

    def __init__(self) -> None:
        self._carriers: list[Carrier] = []
        self.cuts: Cuts = np.zeros((0, 2), dtype=np.int64)
        self.rebases = 0

    def append(self, move: Carrier, cuts: Cuts | None = None, moved: bool = False) -> None:
        """Go to another mesh (collective).

        Args:
            move: Takes tags from the present mesh to the next one.
            cuts: Quadrilaterals that it cuts.
            moved: Whether it moves nodes.
        """
        carriers = [carrier.then(move) for carrier in self._carriers]
        self._carriers = [*carriers[:1], *carriers[1:][1 - REMEMBERED :], move]
        if cuts is not None:
            self.cuts = np.concatenate([self.cuts, cuts])
        self.rebases += moved

    def carry(self, thing: Any) -> Any:
        """Return tags or a DG0 Function on the present mesh (collective).

        Args:
            thing: ``MeshTags`` or a piecewise constant Function on the mesh that was given first
                or one of the last eight; anything else is returned as it is.

        Raises:
            MPMError: A Function that is not piecewise constant.
        """
        for carrier in self._carriers:
            thing = carrier.carry(thing)
        return thing

    def boundary(self, body: mesh.Mesh) -> NDArray[np.int32]:
        """Return this rank's own facets on the boundary that was given (collective).

        What a cut has laid bare inside the body is none of it.

        Args:
            body: The present mesh.
        """
        first = self._carriers[0].source if len(self.cuts) else body
        dim = body.topology.dim - 1
        first.topology.create_connectivity(dim, dim + 1)
        outer = mesh.exterior_facet_indices(first.topology)
        if first is body:
            return np.asarray(outer)
        tags = self.carry(mesh.meshtags(first, dim, outer, np.ones(len(outer), dtype=np.int32)))
        own = tags.indices < body.topology.index_map(dim).size_local
        return np.asarray(tags.indices[own])

    def origin_index(self, index: NDArray[np.int64], count: int) -> NDArray[np.int64]:
        """Return the input indices of the domains that the present ones are, or are halves of.

        Args:
            index: Input indices on the present mesh, shape ``(n,)``.
            count: Number of cells of the present mesh.
        """
        first = count - len(self.cuts)
        origin = index.copy()
        half = index >= first
        origin[half] = self.cuts[index[half] - first, 0]
        return origin

    def halves(self, index: NDArray[np.int64], count: int) -> NDArray[np.bool_]:
        """Return which of the present domains are halves of others; arguments as above."""
        return np.isin(self.origin_index(index, count), self.cuts[:, 0])
