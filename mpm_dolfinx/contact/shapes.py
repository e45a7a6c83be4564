# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Rigid shapes by their signed distance, positive outside."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import ConvergenceError, MPMError, as_ours
from ..parallel.given import as_positive, is_number, one_line
from ..reals import as_finite, as_reals
from ..tolerances import DIFFERENCE, HALF_DIGITS

__all__ = [
    "Shape",
    "as_direction",
    "as_point",
    "as_radius",
    "as_rotation",
    "box",
    "cavity",
    "cylinder",
    "disc",
    "plane",
    "signed_distance",
    "sphere",
]

#: Step of second differences of a user's distance, relative to the size of coordinates: errors by
#: it and by round-off are equal.
SECOND = float(np.sqrt(HALF_DIGITS))
#: How far a gradient of a distance may be from a unit vector.
UNIT = 1e-2
#: Added to squares of lengths, so that none of their roots is zero.
TINY = np.finfo(float).tiny


class Shape:
    """A rigid shape, in the place where it is before it moves.

    Args:
        dim: Dimension of space.
        pivot: The point about which it turns, shape ``(dim,)``.

    Attributes:
        dim: As given.
        pivot: As given.
        costly: Whether looking for the distance takes long, so that it is not done in each
            iteration for points that cannot have come near; it must not change faster than its
            points move then.
        measures: Whether what it calls a distance is one everywhere: it changes no faster than
            points move.
    """

    costly = False
    measures = True

    def __init__(self, dim: int, pivot: Any) -> None:
        self.dim = dim
        self.pivot: NDArray[np.float64] = np.asarray(pivot, dtype=np.float64)

    @property
    def bounds(self) -> NDArray[np.float64] | None:
        """Corners of a box around it along the axes, ``(2, dim)``; ``None`` where it has none."""
        return None

    @property
    def arm(self) -> float | None:
        """How much its distances change at most, by the angle it turns by; ``None``: not known.

        No more than its own points move: by their distance from the pivot.
        """
        if self.bounds is None:
            return None
        return float(np.linalg.norm(np.abs(self.bounds - self.pivot).max(axis=0)))

    @property
    def outline(self) -> tuple[NDArray[np.float64], NDArray[np.int64]] | None:
        """Points ``(n, dim)`` and facets ``(m, dim)`` of its surface, where it is made of such."""
        return None

    def distance(self, y: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the signed distance of points and its gradient, ``(n,)`` and ``(n, dim)``.

        Args:
            y: Points, shape ``(n, dim)``.
        """
        raise NotImplementedError

    def curvature(self, y: NDArray[Any]) -> NDArray[Any]:
        """Return the second derivatives of the distance at points, shape ``(n, dim, dim)``."""
        raise NotImplementedError


class _Plane(Shape):
    def __init__(self, point: NDArray[np.float64], normal: NDArray[np.float64]) -> None:
        super().__init__(len(point), point)
        self._normal = normal

    def distance(self, y: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        normals = np.broadcast_to(self._normal, y.shape)
        return (y - self.pivot) @ self._normal, normals

    def curvature(self, y: NDArray[Any]) -> NDArray[Any]:
        return np.zeros((len(y), self.dim, self.dim), dtype=y.dtype)


class _Round(Shape):
    """A disc, a sphere, or a cylinder: what is nearer to a point or to an axis than a radius."""

    def __init__(
        self,
        centre: NDArray[np.float64],
        radius: float,
        axis: NDArray[np.float64] | None = None,
    ) -> None:
        super().__init__(len(centre), centre)
        self._radius = radius
        self._across = np.eye(self.dim)
        if axis is not None:
            self._across -= np.outer(axis, axis)

    @property
    def bounds(self) -> NDArray[np.float64] | None:
        if np.linalg.matrix_rank(self._across) < self.dim:
            return None
        return np.array([self.pivot - self._radius, self.pivot + self._radius])

    @property
    def arm(self) -> float | None:
        return None if self.bounds is None else 0.0  # a ball turns in itself

    def distance(self, y: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        arm = (y - self.pivot) @ self._across
        length = np.sqrt((arm * arm).sum(axis=1) + TINY)
        return length - self._radius, arm / length[:, None]

    def curvature(self, y: NDArray[Any]) -> NDArray[Any]:
        phi, n = self.distance(y)
        turn = self._across - n[:, :, None] * n[:, None, :]
        return np.asarray(turn / (phi + self._radius)[:, None, None])


class _Box(Shape):
    """A box with rounded edges."""

    def __init__(
        self, lower: NDArray[np.float64], upper: NDArray[np.float64], radius: float
    ) -> None:
        super().__init__(len(lower), (lower + upper) / 2)
        self._half = (upper - lower) / 2 - radius
        self._radius = radius

    @property
    def bounds(self) -> NDArray[np.float64]:
        half = self._half + self._radius
        return np.array([self.pivot - half, self.pivot + half])

    def _beyond(
        self, y: NDArray[Any]
    ) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.bool_], NDArray[np.int64]]:
        """Return side and excess along each axis, which count, and the largest one."""
        arm = y - self.pivot
        side = np.where(arm.real < 0.0, -1.0, 1.0)
        excess = side * arm - self._half
        return side, excess, excess.real > 0.0, excess.real.argmax(axis=1)

    def distance(self, y: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        side, excess, out, most = self._beyond(y)
        row = np.arange(len(y))
        outside = out.any(axis=1)
        arm = np.where(out, excess, 0.0)
        length = np.sqrt((arm * arm).sum(axis=1) + TINY)
        flat = np.zeros_like(arm)
        flat[row, most] = 1.0
        n = side * np.where(outside[:, None], arm / length[:, None], flat)
        return np.where(outside, length, excess[row, most]) - self._radius, n

    def curvature(self, y: NDArray[Any]) -> NDArray[Any]:
        side, excess, out, _ = self._beyond(y)
        arm = np.where(out, excess, 0.0)
        length = np.sqrt((arm * arm).sum(axis=1) + TINY)
        n = side * arm / length[:, None]
        across = np.eye(self.dim) * out[:, :, None] - n[:, :, None] * n[:, None, :]
        edge = np.count_nonzero(out, axis=1) > 1
        return np.where(edge[:, None, None], across / length[:, None, None], 0.0)


class _Cavity(Shape):
    def __init__(self, shape: Shape) -> None:
        super().__init__(shape.dim, shape.pivot)
        self._shape = shape
        self.costly, self.measures = shape.costly, shape.measures

    @property
    def outline(self) -> tuple[NDArray[np.float64], NDArray[np.int64]] | None:
        return self._shape.outline

    def distance(self, y: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        phi, n = self._shape.distance(y)
        return -phi, -n

    def curvature(self, y: NDArray[Any]) -> NDArray[Any]:
        return -self._shape.curvature(y)


class _Given(Shape):
    """A shape by a user's distance, whose derivatives are differences."""

    measures = False

    def __init__(self, function: Callable[..., Any], dim: int, pivot: Any) -> None:
        super().__init__(dim, pivot)
        self._function = function

    def _values(self, y: NDArray[np.float64]) -> NDArray[np.float64]:
        try:
            phi = as_reals(self._function(y))
        except Exception as error:
            raise as_ours(error, "The signed distance of a shape") from error
        if phi.shape != (len(y),) or not np.isfinite(phi).all():
            # No number is what points far out may have at a trial that has gone too far.
            kind = MPMError if phi.shape != (len(y),) else ConvergenceError
            raise kind(
                f"A signed distance must return {len(y)} finite numbers for points of the shape "
                f"{y.shape}, not an array of the shape {phi.shape}."
            )
        return phi

    def _slopes(self, y: NDArray[np.float64], step: float) -> NDArray[np.float64]:
        ahead = [self._values(y + step * e) for e in np.eye(self.dim)]
        behind = [self._values(y - step * e) for e in np.eye(self.dim)]
        return np.stack([(a - b) / (2 * step) for a, b in zip(ahead, behind, strict=True)], axis=1)

    def distance(self, y: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        phi = self._values(y)
        n = self._slopes(y, DIFFERENCE * _size(y))
        length = np.linalg.norm(n, axis=1)
        near = np.abs(phi) <= DIFFERENCE ** (1 / 3) * _size(y)
        if np.any(near & (np.abs(length - 1.0) > UNIT)):
            wrong = length[near & (np.abs(length - 1.0) > UNIT)][0]
            raise MPMError(
                f"The gradient of a signed distance has the length {wrong:.3g} near the surface, "
                "but that of a distance has 1; divide the function by the length of its gradient."
            )
        return phi, n / np.maximum(length, UNIT)[:, None]

    def curvature(self, y: NDArray[Any]) -> NDArray[Any]:
        step = SECOND * _size(y)
        rows = [
            (self._slopes(y + step * e, step) - self._slopes(y - step * e, step)) / (2 * step)
            for e in np.eye(self.dim)
        ]
        H = np.stack(rows, axis=1)
        return np.asarray((H + H.swapaxes(1, 2)) / 2)


def _size(y: NDArray[np.float64]) -> float:
    return float(np.abs(y).max(initial=1e-300))


def plane(point: Any, normal: Any) -> Shape:
    """Return the half-space behind a line or plane.

    Args:
        point: A point of it, shape ``(gdim,)``.
        normal: Its normal, away from the obstacle, towards the body; any length.

    Raises:
        MPMError: No point and direction.
    """
    at = as_point(point, "point")
    return _Plane(at, as_direction(normal, "normal", len(at)))


def disc(centre: Any, radius: float) -> Shape:
    """Return a disc in the plane.

    Args:
        centre: Shape ``(2,)``.
        radius: Positive.

    Raises:
        MPMError: No centre in the plane, or no radius.
    """
    return _Round(as_point(centre, "centre", 2), as_positive(radius, "radius"))


def sphere(centre: Any, radius: float) -> Shape:
    """Return a ball in space; see :func:`disc`, with a centre of shape ``(3,)``."""
    return _Round(as_point(centre, "centre", 3), as_positive(radius, "radius"))


def cylinder(point: Any, axis: Any, radius: float) -> Shape:
    """Return a cylinder in space without ends.

    Args:
        point: A point of its axis, shape ``(3,)``.
        axis: Direction of the axis, any length.
        radius: Positive.

    Raises:
        MPMError: No axis in space, or no radius.
    """
    at = as_point(point, "point", 3)
    return _Round(at, as_positive(radius, "radius"), as_direction(axis, "axis", 3))


def box(lower: Any, upper: Any, radius: float = 0.0) -> Shape:
    """Return a rectangle or a box along the axes, with rounded edges within its outline.

    Args:
        lower: Its lowest corner, shape ``(gdim,)``.
        upper: Its highest corner.
        radius: Of the edges. A sharp edge cuts in unseen between two points of a body; take
            at least half the size of a domain.

    Raises:
        MPMError: No box, or a radius above half its smallest side.
    """
    low = as_point(lower, "lower")
    high = as_point(upper, "upper", len(low))
    if not np.all(high > low):
        raise MPMError(f"A box needs lower below upper, not {lower!r} and {upper!r}.")
    r = as_radius(radius)
    if 2.0 * r >= (high - low).min():
        raise MPMError(f"The radius {r:g} of a box must be below half of its smallest side.")
    return _Box(low, high, r)


def cavity(shape: Shape) -> Shape:
    """Return all that is outside of a shape, to hold bodies within it.

    Args:
        shape: The shape of the hole.

    Raises:
        MPMError: Something else than a shape.
    """
    if not isinstance(shape, Shape):
        raise MPMError(f"A cavity needs a shape of mpm.contact, not {type(shape).__name__}.")
    return _Cavity(shape)


def signed_distance(function: Callable[..., Any], pivot: Any) -> Shape:
    """Return a shape by its signed distance, positive outside.

    Its derivatives are differences of second order, so the function must be as smooth as the
    shape is, and a distance (a gradient of length one) near the surface.

    Args:
        function: Takes points of shape ``(n, gdim)``, as the shape lies before it moves, and
            returns the distances, shape ``(n,)``.
        pivot: The point about which the shape turns, shape ``(gdim,)``.

    Raises:
        MPMError: No function or no point.
    """
    if not callable(function):
        raise MPMError(f"signed_distance needs a function of points, not {function!r}.")
    at = as_point(pivot, "pivot")
    return _Given(function, len(at), at)


def as_point(value: Any, name: str, dim: int | None = None) -> NDArray[np.float64]:
    """Return coordinates of a point or a vector.

    Raises:
        MPMError: They are none.
    """
    vector = as_finite(value, None)
    dims = (2, 3) if dim is None else (dim,)
    if vector is None or len(vector) not in dims:
        raise MPMError(
            f"{name} must be {' or '.join(map(str, dims))} finite numbers, not {value!r}."
        )
    return vector


def as_direction(value: Any, name: str, dim: int) -> NDArray[np.float64]:
    """Return the unit vector of a direction.

    Raises:
        MPMError: It is none.
    """
    vector = as_point(value, name, dim)
    length = float(np.linalg.norm(vector))
    if length == 0.0:
        raise MPMError(f"{name} must not be zero.")
    return vector / length


def as_radius(value: Any) -> float:
    """Return a radius, which may be 0.

    Raises:
        MPMError: It is none.
    """
    if not is_number(value) or not 0.0 <= value < np.inf:
        raise MPMError(f"radius must be a number from 0 on, not {value!r}.")
    return float(value)


def as_rotation(value: Any, what: str, gdim: int) -> NDArray[np.float64]:
    """Return a number ``(1,)``, or a vector in space; a zero is none of either.

    Raises:
        MPMError: It is something else.
    """
    count = 1 if gdim == 2 else 3
    number, found = as_finite(value), as_finite(value, count)
    if number is not None and (count == 1 or number == 0.0):
        found = np.full(count, number)
    if found is None:
        numbers = "a finite number" if count == 1 else "3 finite numbers"
        raise MPMError(f"{what} must be {numbers}, not {one_line(value)}.")
    return found
