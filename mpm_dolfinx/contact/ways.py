# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Straight ways of points in the frame of a shape: do they get deep into it, or through it?

A body may end a step where nothing shows that it has been where it cannot be: a thin obstacle is
behind it, or a point is out again on the side of a corner. So it is asked where each point comes to
the surface on its way, and where it would on the way back: it has gone through where these are
opposite sides, however thin the shape is between them, or where it is deep in the middle.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..tolerances import LOCAL_ITERATIONS, SLIGHT
from .memory import ShapeMemory
from .placed import framed
from .rotation import Pose
from .shapes import Shape
from .surface import Surface

__all__ = ["OPPOSITE", "goes_through", "passes"]

#: Least cosine between a way and the normal of a surface that it goes through.
STEEP = 0.1
#: Product of two normals below which they are those of opposite sides, for a point that touches
#: one of them, and for one that touches neither before nor after.
OPPOSITE, OPPOSITE_FREE = -0.5, -0.1

type Array = NDArray[np.float64]


def passes(shape: Shape, surface: Surface, memory: ShapeMemory, x: Array, pose: Pose) -> bool:
    """Return whether points get deep into an obstacle, or through it, on a straight way.

    Args:
        shape: The obstacle.
        surface: The points.
        memory: Where they and the obstacle begin.
        x: Where they end, shape ``(m, nq, gdim)``.
        pose: Where the obstacle ends.
    """
    a = framed(shape, memory.pose, memory.outcome.positions)
    b = framed(shape, pose, x)
    way = np.linalg.norm(b - a, axis=2)
    near = (memory.gap < way) & (way > 0.0) & (surface.weights > 0.0)
    gap, normal = memory.gap[near], memory.normal[near]
    if len(gap) and not memory.exact:
        gap, normal = shape.distance(a[near])
    thickness = np.broadcast_to(surface.thickness[:, None], near.shape)[near]
    return goes_through(shape, a[near], b[near], gap, normal, thickness)


def goes_through(
    shape: Shape, a: Array, b: Array, gap: Array, normal: Array, thickness: Array
) -> bool:
    """Return whether points get deep into the shape, or leave it on the opposite side.

    A point that slides past a corner goes in and out by sides whose normals are not opposite, or
    cuts off a little of a sharp corner.

    Args:
        shape: The shape.
        a: Where points begin, in its frame, shape ``(n, dim)``.
        b: Where they end.
        gap: Their distances at the beginning, shape ``(n,)``.
        normal: Normals there.
        thickness: Of the domains behind them, shape ``(n,)``: more is deep, besides what they
            begin with.
    """
    if len(a) == 0:
        return False
    end, normal_at_end = shape.distance(b)
    deep, on = np.maximum(-gap, 0.0) + thickness, SLIGHT * thickness
    if (end < -deep).any():
        return True
    way = b - a
    size = np.linalg.norm(way, axis=1)
    # off the surface, or going through it, at an angle or so far that it gets deep all the same
    far = STEEP * size > deep
    begins = far | (gap > on) | (-(normal * way).sum(axis=1) > STEEP * size)
    ends = far | (end > on) | ((normal_at_end * way).sum(axis=1) > STEEP * size)
    which = np.flatnonzero(begins & ends)
    first, enters = _reached(shape, a[which], b[which], on[which])
    goes = first < 1.0
    which, first, enters = which[goes], first[goes], enters[goes]
    if len(which) == 0:
        return False
    last, leaves = _reached(shape, b[which], a[which], on[which])
    way, size = way[which], size[which]
    middle = a[which] + 0.5 * (1.0 + first - last)[:, None] * way
    if (shape.distance(middle)[0] < -deep[which]).any():
        return True
    free = (first > 0.0) & (last > 0.0)
    through = (enters * leaves).sum(axis=1) < np.where(free, OPPOSITE_FREE, OPPOSITE)
    through &= -(enters * way).sum(axis=1) > STEEP * size
    through &= (leaves * way).sum(axis=1) > STEEP * size
    through &= (1.0 - first - last) * size > on[which]
    return bool(through.any())


def _reached(shape: Shape, a: Array, b: Array, on: Array) -> tuple[Array, Array]:
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
