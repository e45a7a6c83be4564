# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Straight ways of points in the frame of a shape: do they get deep into it, or through it?

A body may end a step where nothing shows that it has been where it cannot be: a thin obstacle is
behind it, or a point is out again on the side of a corner. What happens on the way is asked in two
questions, as neither has the other's answer: whether a point is ever deep in the shape
(:func:`gets_deep`, which also tells of ways that end in it), and whether one goes in on one
side and out on the opposite one, however thin the shape is between them (:func:`crosses`).
:func:`passes` asks both of the points of a body's surface.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..tolerances import BLOCK, LOCAL_ITERATIONS
from .memory import ShapeMemory
from .placed import framed
from .rotation import Pose
from .shapes import Shape
from .surface import Surface

__all__ = ["OPPOSITE", "crosses", "gets_deep", "passes"]

#: Most places on the way of a point that are looked at.
MOST_PLACES = 1000
#: How near to the surface a point is on it, over the thickness of the domain behind.
ON = 1e-3
#: Least length of a way through an obstacle, over the same: less is cut off a sharp corner.
CUT = 0.02
#: Least cosine between a way and the normal of a surface that it goes through.
STEEP = 0.1
#: Product of two normals below which they are those of opposite sides, for a point that touches
#: one of them, and for one that touches neither before nor after.
OPPOSITE, OPPOSITE_FREE = -0.5, -0.1


def passes(
    shape: Shape, surface: Surface, memory: ShapeMemory, x: NDArray[np.float64], pose: Pose
) -> bool:
    """Return whether points get deep into an obstacle, or through it, on a straight way.

    Args:
        shape: The obstacle.
        surface: The points.
        memory: Where they and the obstacle begin.
        x: Where they end, shape ``(m, nq, gdim)``.
        pose: Where the obstacle ends.
    """
    deep = np.broadcast_to(surface.thickness[:, None], memory.gap.shape)
    a = framed(shape, memory.pose, memory.outcome.positions)
    b = framed(shape, pose, x)
    way = np.linalg.norm(b - a, axis=2)
    reached = memory.gap - way < -deep
    if gets_deep(shape, a, b, memory.gap, deep, reached & (surface.weights > 0.0)):
        return True
    near = (memory.gap < way) & (way > 0.0) & (surface.weights > 0.0)
    thickness, gap, normal = deep[near], memory.gap[near], memory.normal[near]
    if len(gap) and not memory.exact:
        gap, normal = shape.distance(a[near])
    return crosses(shape, a[near], b[near], gap, normal, thickness)


def gets_deep(
    shape: Shape,
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    gap: NDArray[np.float64],
    deep: NDArray[np.float64],
    reached: NDArray[np.bool_],
) -> bool:
    """Return whether points are deep in the shape anywhere on a straight way in its frame.

    Args:
        shape: The shape.
        a: Where points begin, shape ``(m, nq, dim)``.
        b: Where they end.
        gap: Their distances at the beginning, shape ``(m, nq)``.
        deep: What is deep, shape ``(m, nq)``.
        reached: Which points may have been so.
    """
    a, way, deep, gap = a[reached], (b - a)[reached], deep[reached], gap[reached]
    steps = np.ceil(2.0 * np.linalg.norm(way, axis=1) / deep) + 1.0
    count = np.minimum(steps, MOST_PLACES).astype(np.int64) + 1
    for part in np.array_split(np.arange(len(a)), 1 + count.sum() // BLOCK):
        number = count[part]
        which = np.repeat(part, number)
        place = np.arange(len(which)) - np.repeat(np.cumsum(number) - number, number)
        share = place / (count[which] - 1.0)
        phi = shape.distance(a[which] + share[:, None] * way[which])[0]
        if np.any(phi < -deep[which] - np.maximum(-gap[which], 0.0)):
            return True
    return False


def crosses(
    shape: Shape,
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    gap: NDArray[np.float64],
    normal: NDArray[np.float64],
    thickness: NDArray[np.float64],
) -> bool:
    """Return whether points go into the shape on one side and out of it on the opposite one.

    The way is a straight one in the shape's frame. A point that slides past a corner goes in
    and out by sides whose normals are not opposite, or cuts off a little of a sharp corner.

    Args:
        shape: The shape.
        a: Where points begin, shape ``(n, dim)``.
        b: Where they end.
        gap: Their distances at the beginning, shape ``(n,)``.
        normal: Normals there.
        thickness: Of the domains behind them, shape ``(n,)``.
    """
    on = ON * thickness

    def left(along: NDArray[np.float64], phi: Any, n: Any, sign: float) -> NDArray[np.bool_]:
        """Return which points are off the surface, or go through it."""
        cosine = sign * (n * along).sum(axis=1) / np.linalg.norm(along, axis=1)
        return np.asarray((phi > on[which]) | (cosine > STEEP))

    which = np.arange(len(a))
    which = which[left(b - a, gap, normal, -1.0)]
    if len(which) == 0:
        return False
    which = which[left((b - a)[which], *shape.distance(b[which]), 1.0)]
    first, enters = _reached(shape, a[which], b[which], on[which])
    goes = first < 1.0
    which, first, enters = which[goes], first[goes], enters[goes]
    last, leaves = _reached(shape, b[which], a[which], on[which])
    way = b[which] - a[which]
    size = np.linalg.norm(way, axis=1)
    free = (first > 0.0) & (last > 0.0)
    through = (enters * leaves).sum(axis=1) < np.where(free, OPPOSITE_FREE, OPPOSITE)
    through &= -(enters * way).sum(axis=1) > STEEP * size
    through &= (leaves * way).sum(axis=1) > STEEP * size
    through &= (1.0 - first - last) * size > CUT * thickness[which]
    return bool(through.any())


def _reached(
    shape: Shape, a: NDArray[np.float64], b: NDArray[np.float64], on: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how much of their ways points go before they are on the shape, and normals there.

    A point goes on by its distance, within which there is no surface (J. C. Hart, "Sphere
    tracing", Vis. Comput. 12, 1996).

    Args:
        shape: The shape.
        a: Where they begin, in the frame of the shape, shape ``(n, dim)``.
        b: Where they end.
        on: Distance at which a point is on the shape, shape ``(n,)``.
    """
    way = b - a
    size = np.linalg.norm(way, axis=1)
    share, normals = np.zeros(len(a)), np.zeros_like(a)
    going = np.arange(len(a))
    for _ in range(LOCAL_ITERATIONS):
        if len(going) == 0:
            break
        phi, normals[going] = shape.distance(a[going] + share[going, None] * way[going])
        off = phi > on[going]
        going, phi = going[off], phi[off]
        share[going] = np.minimum(share[going] + phi / size[going], 1.0)
        going = going[share[going] < 1.0]
    share[going] = 1.0
    return share, normals
