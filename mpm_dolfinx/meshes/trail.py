# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The meshes that a body has left, and what has moved with it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

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
