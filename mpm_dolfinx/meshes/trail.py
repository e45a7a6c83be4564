# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The meshes that a body has left, and what has moved with it."""

from __future__ import annotations

from typing import Any

from .redistribution import Carrier

__all__ = ["Trail"]

#: How many of the meshes that a body has left are known, but the first: each holds communicators
#: of MPI, of which there are about 2000.
REMEMBERED = 8


class Trail:
    """The way of a body from the mesh that was given to the present one."""

    def __init__(self) -> None:
        self._carriers: list[Carrier] = []

    def append(self, move: Carrier) -> None:
        """Go to another mesh (collective).

        Args:
            move: Takes tags from the present mesh to the next one.
        """
        carriers = [carrier.then(move) for carrier in self._carriers]
        self._carriers = [*carriers[:1], *carriers[1:][1 - REMEMBERED :], move]

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
