# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Which facets may touch an obstacle in a step; what acts is not asked of others.

At the beginning of a step facets within some domains of the obstacle are noted. Others cannot touch
until points have come nearer by a margin, which is told by the motion of nodes and of the shape
(distances change no faster than positions do). Where they have, all facets are looked at.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .memory import ShapeMemory
from .rotation import Pose
from .shapes import Shape
from .surface import NEAR, Surface

__all__ = ["Reach", "is_near"]


class Near(NamedTuple):
    """Facets that may touch in a step.

    Attributes:
        memory: What is known of them.
        nodes: Where the nodes of all facets begin.
        radius: How much gaps change at most, by the angle that the shape turns by.
        margin: How far points may come nearer until others could touch.
    """

    memory: ShapeMemory
    nodes: NDArray[np.float64]
    radius: float
    margin: float


class Reach:
    """Facets of a surface that an obstacle may reach in a step.

    Args:
        surface: The surface.
        shape: The obstacle.
    """

    def __init__(self, surface: Surface, shape: Shape) -> None:
        self._surface, self._shape = surface, shape
        self._near: Near | None = None

    def forget(self) -> None:
        """Take all facets for near, until they are looked for."""
        self._near = None

    def look(self, memory: ShapeMemory) -> None:
        """Note which facets may touch in a step, and what others may move until they could.

        Args:
            memory: What is known of the last converged step.
        """
        self._near = self._within(memory)

    def of(self, memory: ShapeMemory, pose: Pose) -> ShapeMemory | None:
        """Return the memory of facets that may touch at the present positions; ``None``: all.

        Args:
            memory: What is known of the last converged step.
            pose: Where the shape is.
        """
        near = self._near
        if near is None or self._approach(near, memory, pose) >= near.margin:
            return None
        return near.memory

    def _within(self, memory: ShapeMemory) -> Near | None:
        """Return the facets that are within some domains; ``None``: all."""
        surface, shape = self._surface, self._shape
        if not shape.measures or memory.gap.size == 0:
            return None
        near = is_near(memory, surface)
        if near.all():
            return None
        which = np.flatnonzero(near)
        nodes = surface.own_nodes(converged=True)
        arms = nodes - shape.pivot - memory.pose.offset
        radius = float(np.linalg.norm(arms, axis=1).max())
        if (arm := shape.arm) is not None:
            radius = min(radius, arm)
        margin = float(memory.gap[~near].min()) - surface.touch
        return Near(memory.of(which), nodes, radius, margin)

    def _approach(self, near: Near, memory: ShapeMemory, pose: Pose) -> float:
        """Return by how much points have come nearer to the obstacle in the step at most."""
        shifted = float(np.linalg.norm(pose.offset - memory.pose.offset))
        turned = float(np.linalg.norm(pose.Q - memory.pose.Q, 2)) * near.radius
        change = self._surface.own_nodes() - near.nodes
        moved = float(np.sqrt((change * change).sum(axis=1).max(initial=0.0)))
        return self._surface.spread * (moved + turned) + shifted


def is_near(memory: ShapeMemory, surface: Surface) -> NDArray[np.bool_]:
    """Return which facets of a surface are near to an obstacle, shape ``(m,)``.

    Args:
        memory: What is known of them.
        surface: The surface.
    """
    return np.asarray(memory.gap.min(axis=1, initial=np.inf) <= NEAR * surface.thickness)
