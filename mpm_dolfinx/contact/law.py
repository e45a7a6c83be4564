# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Tractions of contact at points: a penalty on the gap, and Coulomb friction with a memory.

The pressure is ``p = <-k g>`` for a gap g, where a point has penetrated (g < 0). Friction remembers
an anchor a, a place on the other body: the traction along the surface is ``t* = -k_t P (x - a)``
with ``P = I - n n``, as long as its size stays within ``min(mu p + c, limit)``; beyond it slips,
and has that size (the return mapping of Wriggers 2006, Computational Contact Mechanics, section
5.2.3, with the anchor instead of a traction that would have to be turned and transported).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._core import is_as_inherited
from ..errors import MPMError

__all__ = [
    "Coulomb",
    "Points",
    "Push",
    "Traction",
    "as_friction",
    "derivative",
    "nitsche",
    "push_derivative",
    "secant_along",
    "shear_derivative",
    "traction",
]


@dataclass(frozen=True)
class Coulomb:
    """Friction that does not depend on the velocity: at most ``min(friction p + cohesion, limit)``.

    An heir has another bound by :meth:`bound`, of which derivatives are taken by complex steps.

    Args:
        friction: Coefficient of friction.
        cohesion: Shear traction that is borne without pressure, where bodies touch, per area of
            the facets as they were at the last converged step.
        limit: Largest shear traction, such as the undrained strength of clay on a pile, as well.

    Raises:
        MPMError: A negative or no number.
    """

    friction: float = 0.0
    cohesion: float = 0.0
    limit: float = np.inf
    _loop: ClassVar[str] = "coulomb"

    def __post_init__(self) -> None:
        """Say so where a number makes no sense."""
        for name in ("friction", "cohesion", "limit"):
            value = getattr(self, name)
            known = isinstance(value, float | int | np.number) and not isinstance(value, bool)
            if not known or not value >= 0.0 or (name != "limit" and not np.isfinite(value)):
                raise MPMError(f"{name} must be a number from 0 on, not {value!r}.")

    @property
    def smooth(self) -> bool:
        """Whether there is no friction at all."""
        none = self.limit == 0.0 or (self.friction == 0.0 and self.cohesion == 0.0)
        return none and type(self).bound is Coulomb.bound

    @property
    def by_area(self) -> bool:
        """Whether a part of it does not grow with the pressure, but with the area."""
        known = type(self).bound is Coulomb.bound
        return not known or self.cohesion > 0.0 or bool(np.isfinite(self.limit))

    def bound(
        self, p: NDArray[Any], stretch: NDArray[np.float64]
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return the largest shear traction at pressures, and its derivative, ``(n,)`` each.

        Args:
            p: Pressure per undeformed area.
            stretch: Area over undeformed area.
        """
        bound = self.friction * np.where(p.real > 0.0, p, 0.0) + self.cohesion * stretch
        limit = self.limit * stretch
        free = (bound.real < limit) & (p.real > 0.0)
        return np.where(bound.real < limit, bound, limit), self.friction * free

    def shared(self, share: float) -> Coulomb:
        """Return the friction of points that bear a share of the pressure, and of its bound."""
        if is_as_inherited(self, "_loop"):
            return Coulomb(self.friction, share * self.cohesion, share * self.limit)
        return _Shared(self.friction, self.cohesion, self.limit, self, share)


@dataclass(frozen=True)
class _Shared(Coulomb):
    """Friction by an heir's law, of points that bear a share of the pressure.

    Attributes:
        whole: The law of points that bear all of it.
        share: The share.
    """

    whole: Coulomb = Coulomb()
    share: float = 1.0

    @property
    def smooth(self) -> bool:
        """See :class:`Coulomb`."""
        return self.whole.smooth

    @property
    def by_area(self) -> bool:
        """See :class:`Coulomb`."""
        return self.whole.by_area

    def bound(
        self, p: NDArray[Any], stretch: NDArray[np.float64]
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        """See :class:`Coulomb`."""
        bound, slope = self.whole.bound(p / self.share, stretch)
        return self.share * bound, slope


def as_friction(value: Any) -> Coulomb:
    """Return a coefficient of friction, or a law, as a law.

    Raises:
        MPMError: It is neither.
    """
    return value if isinstance(value, Coulomb) else Coulomb(friction=value)


class Points(NamedTuple):
    """Some points, and what they remember of the last converged step.

    Attributes:
        stiffness: k of each, shape ``(n,)``.
        tangential: k_t of each, shape ``(n,)``.
        touched: Whether each was in contact, shape ``(n,)``.
        anchor: The anchor where it was, where it was not its place at that time, ``(n, gdim)``.
        gap: The gap at that time, shape ``(n,)``.
        stretch: Area at that time over undeformed area, shape ``(n,)``.
    """

    stiffness: NDArray[np.float64]
    tangential: NDArray[np.float64]
    touched: NDArray[np.bool_]
    anchor: NDArray[np.float64]
    gap: NDArray[np.float64]
    stretch: NDArray[np.float64]

    def of(self, which: Any) -> Points:
        """Return some of them."""
        return Points(*(values[which] for values in self))


class Traction(NamedTuple):
    """What acts on points.

    Attributes:
        pressure: Shape ``(n,)``.
        shear: Traction along the surface, shape ``(n, gdim)``.
        inside: Which are in contact.
        slips: Which of these slip.
    """

    pressure: NDArray[Any]
    shear: NDArray[Any]
    inside: NDArray[np.bool_]
    slips: NDArray[np.bool_]


class Push(NamedTuple):
    """Pressures ``<n . T - k g>`` with a traction T of the body (Nitsche's method).

    Attributes:
        pressure: Shape ``(n,)``.
        acts: Whether each is more than nothing, or about to be, shape ``(n,)``.
        by_position: Derivative by the position, T being as it is, shape ``(n, gdim)``.
    """

    pressure: NDArray[Any]
    acts: NDArray[np.bool_]
    by_position: NDArray[np.float64]

    def of(self, which: Any) -> Push:
        """Return some of them."""
        return Push(*(values[which] for values in self))


def nitsche(
    points: Points,
    behind: NDArray[Any],
    gap: NDArray[Any],
    n: NDArray[Any],
    touch: float,
    H: NDArray[np.float64] | None = None,
) -> Push:
    """Return pressures that a traction of the body bears, but for what gaps are left.

    Args:
        points: The points.
        behind: Tractions of the body at its facets, shape ``(n, gdim)``.
        gap: Shape ``(n,)``.
        n: Normals, towards the points, shape ``(n, gdim)``.
        touch: Gap at which points touch.
        H: Derivatives of the normals, where those of the pressure are asked for.
    """
    p = (n * behind).sum(axis=1) - points.stiffness * gap
    acts = p.real >= -points.stiffness * touch
    slope = np.zeros(n.shape)
    if H is not None:
        slope = np.einsum("nij,ni->nj", H, behind) - points.stiffness[:, None] * n
        slope = np.where(acts[:, None], slope, 0.0)
    return Push(np.where(acts, p, 0.0), acts, slope)


def _since_touch(
    points: Points, gap: NDArray[Any], touch: float
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return which share of its way a point has been in contact, and the derivative by the gap.

    That is all of it where it was before, and the part behind the surface where it has come from
    outside, on a straight line: none where it is pressed with a gap left.
    """
    came = ~points.touched & (points.gap > 10.0 * touch)
    behind = came & (gap.real < 0.0)
    span = np.where(behind, points.gap - gap, 1.0)
    share = np.where(behind, -gap / span, np.where(came, 0.0, 1.0))
    return share, np.where(behind, -points.gap / span**2, 0.0)


def _trial(
    points: Points, delta: NDArray[Any], gap: NDArray[Any], n: NDArray[Any], touch: float
) -> NDArray[Any]:
    """Return the shear traction ``-k_t s P delta`` of points that would all stick."""
    share, _ = _since_touch(points, gap, touch)
    along = delta - n * (n * delta).sum(axis=1)[:, None]
    return np.asarray(-(points.tangential * share)[:, None] * along)


def traction(
    law: Coulomb,
    points: Points,
    delta: NDArray[Any],
    gap: NDArray[Any],
    n: NDArray[Any],
    touch: float,
    pressure: NDArray[Any] | None = None,
) -> Traction:
    """Return what acts on points.

    Args:
        law: The friction.
        points: The points.
        delta: From anchors to points, shape ``(n, gdim)``.
        gap: Shape ``(n,)``.
        n: Normals, towards the points, shape ``(n, gdim)``.
        touch: Gap at which points touch: round-off of positions.
        pressure: That of a whole step or of Nitsche's method, which may act where there is a gap at
            the end; ``None`` is that of the gap.
    """
    inside = gap.real <= touch
    if pressure is None:
        p = np.where(inside, -points.stiffness * gap, 0.0)
    else:
        p, inside = pressure, inside | (pressure.real != 0.0)
    none = np.zeros(len(p), dtype=bool)
    if law.smooth:
        return Traction(p, np.zeros_like(n), inside, none)
    which = np.flatnonzero(inside)
    some = points.of(which)
    tried = _trial(some, delta[which], gap[which], n[which], touch)
    size = np.sqrt((tried * tried).sum(axis=1))
    bound, _ = law.bound(p[which], some.stretch)
    slipping = size.real > bound.real + some.tangential * touch
    factor = np.where(slipping, bound / np.where(slipping, size, 1.0), 1.0)
    shear, slips = np.zeros(n.shape, dtype=np.result_type(tried, factor)), none
    shear[which], slips[which] = factor[:, None] * tried, slipping
    return Traction(p, shear, inside, slips)


def derivative(
    law: Coulomb,
    points: Points,
    delta: NDArray[np.float64],
    gap: NDArray[np.float64],
    n: NDArray[np.float64],
    H: NDArray[np.float64],
    touch: float,
    push: Push | None = None,
) -> NDArray[np.float64]:
    """Return the derivative of ``p n + t`` by positions of points that are all in contact.

    Args:
        law: As for :func:`traction`, as all that is not said here.
        points: As there.
        delta: As there.
        gap: As there.
        n: As there.
        H: Derivatives of the normals, shape ``(n, gdim, gdim)``.
        touch: As there.
        push: A pressure that is not of the gap alone.

    Returns:
        Shape ``(n, gdim, gdim)``.
    """
    acts = traction(law, points, delta, gap, n, touch, None if push is None else push.pressure)
    dp = -points.stiffness[:, None] * n if push is None else push.by_position
    D = n[:, :, None] * dp[:, None, :] + acts.pressure[:, None, None] * H
    if law.smooth:
        return D
    return D + shear_derivative(law, points, delta, gap, n, H, touch, acts, dp, n)


def push_derivative(
    law: Coulomb,
    points: Points,
    delta: NDArray[np.float64],
    gap: NDArray[np.float64],
    n: NDArray[np.float64],
    touch: float,
    push: Push,
) -> NDArray[np.float64]:
    """Return the derivative of ``p n + t`` by the traction's part in the pressure.

    Args:
        law: As for :func:`derivative`, as all that is not said here.
        points: As there.
        delta: As there.
        gap: As there.
        n: As there.
        touch: As there.
        push: The pressure.

    Returns:
        Shape ``(n, gdim)``.
    """
    found = n.copy()
    acts = traction(law, points, delta, gap, n, touch, push.pressure)
    if acts.slips.any():
        s = acts.slips
        trial = _trial(points, delta, gap, n, touch)[s]
        _, grows = law.bound(acts.pressure[s], points.stretch[s])
        tau = trial / np.linalg.norm(trial, axis=1)[:, None]
        found[s] += np.asarray(grows)[:, None] * tau
    return np.asarray(found * push.acts[:, None])


def shear_derivative(
    law: Coulomb,
    points: Points,
    delta: NDArray[np.float64],
    gap: NDArray[np.float64],
    n: NDArray[np.float64],
    H: NDArray[np.float64],
    touch: float,
    acts: Traction,
    dp: NDArray[np.float64],
    dgap: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the derivative of the shear traction by positions of points that are in contact.

    Args:
        law: As for :func:`derivative`, as all that is not said here.
        points: As there.
        delta: As there.
        gap: As there.
        n: As there.
        H: As there.
        touch: As there.
        acts: What :func:`traction` returned.
        dp: Derivative of the pressure, shape ``(n, gdim)``.
        dgap: Derivative of the gap, shape ``(n, gdim)``.

    Returns:
        Shape ``(n, gdim, gdim)``.
    """
    share, slope = _since_touch(points, gap, touch)
    depth = (n * delta).sum(axis=1)
    along = delta - n * depth[:, None]
    bent = np.einsum("nij,nj->ni", H, delta)
    eye = np.eye(n.shape[1])
    moved = eye - n[:, :, None] * n[:, None, :]
    moved = moved - depth[:, None, None] * H - n[:, :, None] * bent[:, None, :]
    dt = share[:, None, None] * moved + along[:, :, None] * (slope[:, None] * dgap)[:, None, :]
    dt *= -points.tangential[:, None, None]
    if acts.slips.any():
        s = acts.slips
        trial = _trial(points, delta, gap, n, touch)[s]
        size = np.linalg.norm(trial, axis=1)
        tau = trial / size[:, None]
        bound, grows = law.bound(acts.pressure[s], points.stretch[s])
        turned = (bound / size)[:, None, None] * (eye - tau[:, :, None] * tau[:, None, :])
        dt[s] = turned @ dt[s] + tau[:, :, None] * (np.asarray(grows)[:, None] * dp[s])[:, None, :]
    return np.asarray(dt)


def secant_along(
    points: Points,
    delta: NDArray[np.float64],
    gap: NDArray[np.float64],
    n: NDArray[np.float64],
    touch: float,
    acts: Traction,
) -> NDArray[np.float64]:
    """Return what the secant of friction has along the shear of points that slip.

    That is the traction over the way from the anchor, of which :func:`shear_derivative` has what is
    across the shear alone.

    Args:
        points: As for :func:`traction`, as all that is not said here.
        delta: As there.
        gap: As there.
        n: As there.
        touch: As there.
        acts: What :func:`traction` returned.

    Returns:
        Shape ``(n, gdim, gdim)``, to be added to derivatives by positions.
    """
    share, _ = _since_touch(points, gap, touch)
    size = np.linalg.norm(_trial(points, delta, gap, n, touch), axis=1)
    bound = np.linalg.norm(acts.shear, axis=1)
    tau = acts.shear / np.where(bound > 0.0, bound, 1.0)[:, None]
    stiffness = points.tangential * share * bound / np.where(size > 0.0, size, 1.0)
    return np.asarray(-stiffness[:, None, None] * tau[:, :, None] * tau[:, None, :])
