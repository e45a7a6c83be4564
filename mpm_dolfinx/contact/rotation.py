# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Finite rotations in the plane, by an angle ``(1,)``, and in space, by a vector ``(3,)``.

A step turns by a Cayley vector theta: ``Q_1 = cay(theta) Q_0`` with
``cay(theta) = (I - S/2)^-1 (I + S/2)``, S the matrix of the vector product with theta, which is a
turn by ``2 atan(|theta| / 2)``. Then ``Q_1 - Q_0 = S (Q_0 + Q_1) / 2`` exactly, on which it rests
that work and moments are those of the step's middle (J. C. Simo, K. K. Wong, "Unconditionally
stable algorithms for rigid body dynamics", Int. J. Numer. Meth. Engng 31, 1991).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["QUARTER", "Pose", "Turn", "cayley_variation", "crossing", "rotation"]

#: Most that a rigid body turns in a step that is tried, and an obstacle in one at whose end points
#: rub against it: friction is along the chord of their way in its frame.
QUARTER = 0.5 * np.pi


def rotation(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation matrix of an angle, or of a vector of rotation (Rodrigues' formula)."""
    if len(angle) == 1:
        c, s = np.cos(angle[0]), np.sin(angle[0])
        return np.array([[c, -s], [s, c]])
    size = float(np.linalg.norm(angle))
    if size == 0.0:
        return np.eye(3)
    W = -crossing(angle / size)
    return np.asarray(np.eye(3) + np.sin(size) * W + (1.0 - np.cos(size)) * W @ W)


def crossing(a: NDArray[Any]) -> NDArray[Any]:
    """Return the matrices C of vectors a by which ``w x a = C w`` for any rate of rotation w.

    Their transposes give moments, ``a x f = C^T f``.

    Args:
        a: Shape ``(..., gdim)``.

    Returns:
        Shape ``(..., 2, 1)`` or ``(..., 3, 3)``.
    """
    if a.shape[-1] == 2:
        return np.stack([-a[..., 1], a[..., 0]], axis=-1)[..., None]
    x, y, z = np.moveaxis(a, -1, 0)
    o = np.zeros_like(x)
    rows = [[o, z, -y], [-z, o, x], [y, -x, o]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def cayley_variation(theta: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return H, by which ``d cay(theta) = S(H d theta) cay(theta)``; ``(1, 1)`` or ``(3, 3)``."""
    factor = 1.0 / (1.0 + 0.25 * float(theta @ theta))
    if len(theta) == 1:
        return np.array([[factor]])
    return np.asarray(factor * (np.eye(3) - 0.5 * crossing(theta)))


@dataclass(frozen=True, eq=False)
class Pose:
    """Where a shape is: ``x = pivot + offset + Q (y - pivot)``.

    Attributes:
        offset: Shape ``(gdim,)``.
        angle: Angle, ``(1,)``, or vector of rotation ``(3,)``.
    """

    offset: NDArray[np.float64]
    angle: NDArray[np.float64]

    @cached_property
    def Q(self) -> NDArray[np.float64]:
        """The rotation."""
        return rotation(self.angle)

    def same_as(self, other: Pose) -> bool:
        """Return whether another pose is this one, to the last bit."""
        same = np.array_equal(self.offset, other.offset)
        return same and np.array_equal(self.angle, other.angle)

    def turn_from(self, other: Pose) -> float:
        """Return the angle of the turn from another pose; whole turns count."""
        return float(np.linalg.norm(self.angle - other.angle))

    def least_turn_from(self, other: Pose) -> float:
        """Return the angle of the least turn from another pose, at most half a turn."""
        Q = self.Q @ other.Q.T
        return 2.0 * float(np.arcsin(min(1.0, np.linalg.norm(Q - np.eye(len(Q))) / np.sqrt(8.0))))

    def mean(self, other: Pose) -> NDArray[np.float64]:
        """Return the mean of the rotations of two poses, which is none itself."""
        return np.asarray(0.5 * (self.Q + other.Q))


class Turn(NamedTuple):
    """An orientation.

    Attributes:
        values: Angle ``(1,)``, which may be any; in space a unit quaternion ``(4,)``.
    """

    values: NDArray[np.float64]

    @classmethod
    def none(cls, gdim: int) -> Turn:
        """Return no turn in a space of some dimension."""
        return cls(np.zeros(1) if gdim == 2 else np.array([1.0, 0.0, 0.0, 0.0]))

    @classmethod
    def of(cls, angle: NDArray[np.float64]) -> Turn:
        """Return that of an angle or a vector of rotation."""
        if len(angle) == 1:
            return cls(np.array(angle))
        half = 0.5 * float(np.linalg.norm(angle))
        return cls(np.concatenate([[np.cos(half)], 0.5 * np.sinc(half / np.pi) * angle]))

    def turned(self, theta: NDArray[np.float64]) -> Turn:
        """Return the orientation after a turn by a Cayley vector."""
        if len(theta) == 1:
            return Turn(self.values + 2.0 * np.arctan(0.5 * theta))
        a, u, b, v = 1.0, 0.5 * theta, self.values[0], self.values[1:]
        product = np.concatenate([[a * b - u @ v], a * v + b * u + np.cross(u, v)])
        return Turn(product / np.linalg.norm(product))

    def cayley_to(self, other: Turn) -> NDArray[np.float64]:
        """Return the Cayley vector of the turn to another orientation, by less than half a turn."""
        if len(self.values) == 1:
            return np.asarray(2.0 * np.tan(0.5 * (other.values - self.values)))
        b, v = self.values[0], -self.values[1:]
        a, u = other.values[0], other.values[1:]
        real, vector = a * b - u @ v, a * v + b * u + np.cross(u, v)
        return np.asarray(2.0 * vector / real)

    @property
    def angle(self) -> NDArray[np.float64]:
        """Angle, ``(1,)``, or vector of rotation ``(3,)``, of at most half a turn."""
        if len(self.values) == 1:
            return np.array(self.values)
        sign = -1.0 if self.values[0] < 0.0 else 1.0
        real, vector = sign * self.values[0], sign * self.values[1:]
        size = float(np.linalg.norm(vector))
        half = np.arctan2(size, real)
        return np.asarray(2.0 * vector * (half / size if size > 0.0 else 1.0))
