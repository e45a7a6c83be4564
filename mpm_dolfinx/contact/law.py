# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Tractions of contact at points: a penalty on the gap, and Coulomb friction with a memory.

The pressure is ``p = <-k g>`` for a gap g, where a point has penetrated (g < 0). Friction remembers
an anchor a, a place on the other body: the traction along the surface is ``t* = -k_t P (x - a)``
with ``P = I - n n``, as long as its size stays within ``min(mu p + c, limit)``; beyond it slips,
and has that size (the return mapping of Wriggers 2006, Computational Contact Mechanics, section
5.2.3, with the anchor instead of a traction that would have to be turned and transported). Compiled
loops do so for the points of obstacles and of pairs alike; a law of a user's own gives the bound.

Tractions are per undeformed area. k and k_t are per area at the last converged step: clay that is
drawn out over a pile is held off it by the pressure that it bears. In a step of a motion they are
not, or a facet that is drawn out would gain energy.

In a step of a motion contact neither adds energy nor takes any. A gap g stores the energy
``W(g) = k/2 <-g>^2`` per area. Over a step in which positions z go from z_0 to z_1 and the gap from
g_0 to g_1 there acts

    p G,   p = -(W(g_1) - W(g_0)) / (g_1 - g_0),
    G = grad g(z_m) + (g_1 - g_0 - grad g(z_m) . dz) v / (v . v),   dz = z_1 - z_0,

z_m being the middle and v the change dz less its rigid part at z_m. Then ``p G . dz`` is the loss
of energy, whatever facets the gaps are measured from; and as the gradient and v have neither sum
nor moment about any point at z_m, momentum and angular momentum stay what they are (the discrete
gradient that knows symmetries of Gonzalez 1996, J. Nonlinear Sci. 6, section 4). Friction acts
with its traction at the step's end, within the cone of the step's pressure: it never gives energy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, override

import numpy as np
from numpy.typing import NDArray

from .._core import is_as_inherited, loops
from ..errors import MPMError, as_ours
from ..parallel.given import as_positive
from ..reals import as_finite
from ..tolerances import DIFFERENCE, EQUAL, HALF_DIGITS, LOCAL_ITERATIONS, ROUND_OFF, SMALL

__all__ = [
    "Begun",
    "Coulomb",
    "Friction",
    "Points",
    "Rubbing",
    "Separation",
    "Traction",
    "as_friction",
    "bounds",
    "by_pressure",
    "known",
    "remembered",
    "secant_along",
    "slopes",
    "traction",
    "unworn",
]


type Array = NDArray[np.float64]


class Rubbing(NamedTuple):
    """Points that rub, as a law of friction sees them.

    Attributes:
        pressure: Per undeformed area, shape ``(n,)``.
        slip: Way along the surface that each slips in this step, shape ``(n,)``.
        gap: Negative where a point has penetrated, shape ``(n,)``.
        stretch: Area at the last converged step over undeformed area, shape ``(n,)``.
        memory: What the law remembered at the last converged step, shape ``(n, k)``.
    """

    pressure: Array
    slip: Array
    gap: Array
    stretch: Array
    memory: Array


class Friction:
    """A law of friction: the largest shear traction of points, and what they remember.

    A subclass has :meth:`bound`, of which derivatives are taken by differences; and, if that
    depends on what has happened before, the first values of a :attr:`memory` and :meth:`remember`.
    So a surface that is polished by the way that it has slipped is::

        class Polished(mpm.contact.Friction):
            memory = (0.0,)

            def bound(self, at):
                slipped = at.memory[:, 0] + at.slip
                return (0.2 + 0.3 * np.exp(-slipped / 0.01)) * at.pressure

            def remember(self, at):
                return at.memory + at.slip[:, None]

    Attributes:
        memory: What each point remembers before it has touched anything.
        stiffness: Stiffness of points that stick, over that of the domain behind, without unit.
    """

    memory: Sequence[float] = ()
    stiffness: float = 1.0

    @property
    def smooth(self) -> bool:
        """Whether there is no friction at all."""
        return False

    @property
    def compiled(self) -> bool:
        """Whether compiled loops know it by heart."""
        return is_as_inherited(self, "_loop")

    def bound(self, at: Rubbing) -> Array:
        """Return the largest shear traction of points, per undeformed area, shape ``(n,)``.

        Args:
            at: The points.
        """
        raise NotImplementedError

    def remember(self, at: Rubbing) -> Array:
        """Return the memory of points at the end of a step, shape ``(n, k)``.

        Args:
            at: The points that touch then.
        """
        return at.memory

    @property
    def told(self) -> list[Any]:
        """Values that ranks must agree on: the kind of the law, and its numbers."""
        numbers = {k: v for k, v in vars(self).items() if isinstance(v, float | int)}
        return [type(self).__name__, *numbers.values()]


@dataclass(frozen=True)
class Coulomb(Friction):
    """Friction that does not depend on the velocity: at most ``min(friction p + cohesion, limit)``.

    Args:
        friction: Coefficient of friction.
        cohesion: Shear traction that is borne without pressure, where bodies touch, per area of
            the facets as they were at the last converged step.
        limit: Largest shear traction, such as the undrained strength of clay on a pile, as well.
        stiffness: See :class:`Friction`.

    Raises:
        MPMError: A negative or no number.
    """

    friction: float = 0.0
    cohesion: float = 0.0
    limit: float = np.inf
    stiffness: float = 1.0
    _loop: ClassVar[str] = "coulomb"

    def __post_init__(self) -> None:
        """Say so where a number makes no sense."""
        for name in ("friction", "cohesion", "limit"):
            value = getattr(self, name)
            known = isinstance(value, float | int | np.number) and not isinstance(value, bool)
            if not known or not value >= 0.0 or (name != "limit" and not np.isfinite(value)):
                raise MPMError(f"{name} must be a number from 0 on, not {value!r}.")

    @property
    @override
    def smooth(self) -> bool:
        none = self.limit == 0.0 or (self.friction == 0.0 and self.cohesion == 0.0)
        return none and type(self).bound is Coulomb.bound

    @override
    def bound(self, at: Rubbing) -> Array:
        p, stretch = map(np.ascontiguousarray, (at.pressure, at.stretch))
        return np.asarray(loops.coulomb(p, stretch, self.friction, self.cohesion, self.limit))


def as_friction(value: Any) -> Friction:
    """Return a coefficient of friction, or a law, as a law.

    Raises:
        MPMError: It is neither, or a law without a stiffness, or whose memory does not begin with
            numbers.
    """
    if not isinstance(value, Friction):
        return Coulomb(friction=value)
    as_positive(value.stiffness, f"{value.told[0]}.stiffness")
    if as_finite(value.memory, None) is None:
        raise MPMError(
            f"{value.told[0]}.memory must be a list of finite numbers, not {value.memory!r}."
        )
    return value


def _told_by(law: Friction, name: str, at: Rubbing, shape: tuple[int, ...]) -> Array:
    """Return the answer of a law's method at points, which it may not change.

    Raises:
        MPMError: It fails, or does not tell as many finite numbers.
    """
    which = f"{law.told[0]}.{name}"
    views = [values.view() for values in at]
    for view in views:
        view.setflags(write=False)
    try:
        found = np.array(getattr(law, name)(Rubbing(*views)), dtype=np.float64)
    except Exception as error:
        raise as_ours(error, which) from error
    if found.shape != shape or not np.isfinite(found).all():
        raise MPMError(f"{which} must return finite numbers of shape {shape}, one for each point.")
    return found


def _bound(law: Friction, at: Rubbing) -> Array:
    """Return the bound by a law at points.

    Raises:
        MPMError: The law fails, or gives no bound for each point.
    """
    found = _told_by(law, "bound", at, (len(at.pressure),))
    if not (found >= 0.0).all():
        raise MPMError(f"{law.told[0]}.bound must return shear tractions from 0 on.")
    return found


def unworn(law: Friction, shape: tuple[int, ...]) -> Array:
    """Return the memory of a law of friction at points that have touched nothing yet.

    Args:
        law: The law.
        shape: That of the points.
    """
    return np.tile(np.asarray(law.memory, dtype=np.float64), (*shape, 1))


class Points(NamedTuple):
    """Some points, and what they remember of the last converged step.

    Attributes:
        stiffness: k of each, shape ``(n,)``.
        tangential: k_t of each, shape ``(n,)``.
        touched: Whether each was in contact, shape ``(n,)``.
        anchor: The anchor where it was, where it was not its place at that time, ``(n, gdim)``.
        gap: The gap at that time, shape ``(n,)``.
        stretch: Area at that time over undeformed area, shape ``(n,)``.
        memory: What the law of friction remembers, shape ``(n, k)``.
    """

    stiffness: NDArray[np.float64]
    tangential: NDArray[np.float64]
    touched: NDArray[np.bool_]
    anchor: NDArray[np.float64]
    gap: NDArray[np.float64]
    stretch: NDArray[np.float64]
    memory: NDArray[np.float64]

    def of(self, which: Any) -> Points:
        """Return some of them."""
        return Points(*(values[which] for values in self))


class Begun(NamedTuple):
    """How a step of a motion began, at some points.

    Attributes:
        gap: Gap at its beginning, shape ``(n,)``.
        offset: Gap at which points begin to be pressed, shape ``(n,)``.
        change: Change of positions with respect to what they touch, shape ``(n, gdim)``.
    """

    gap: Array
    offset: Array
    change: Array


class Separation(NamedTuple):
    """Where points are with respect to what they touch.

    Attributes:
        gap: Shape ``(n,)``.
        normal: Normals, towards the points, in a step of a motion those of its middle, shape
            ``(n, gdim)``.
        delta: From anchors to points, shape ``(n, gdim)``.
        touch: Gap at which points touch: round-off of positions.
        behind: Tractions of the body at its facets that press but for what gaps are left (Nitsche's
            method), shape ``(n, gdim)``; ``None``: gaps alone do.
        begun: How a step of a motion began, of whose whole forces are; ``None``: of its end.
    """

    gap: Array
    normal: Array
    delta: Array
    touch: float
    behind: Array | None = None
    begun: Begun | None = None

    def of(self, which: Any) -> Separation:
        """Return some of them."""
        behind = None if self.behind is None else self.behind[which]
        begun = None if self.begun is None else Begun(*(part[which] for part in self.begun))
        return Separation(
            self.gap[which], self.normal[which], self.delta[which], self.touch, behind, begun
        )


class Traction(NamedTuple):
    """Tractions at points.

    Attributes:
        pressure: Shape ``(n,)``.
        normal: Traction by it, shape ``(n, gdim)``: along the normal, or over a step the gradient
            of the gap.
        shear: Traction along the surface, shape ``(n, gdim)``.
        inside: Which are in contact.
        slips: Which of these slip.
    """

    pressure: Array
    normal: Array
    shear: Array
    inside: NDArray[np.bool_]
    slips: NDArray[np.bool_]


def traction(law: Friction, points: Points, at: Separation) -> Traction:
    """Return the tractions at points.

    Args:
        law: The friction.
        points: The points.
        at: Where they are.
    """
    return _acting(at, known(law, points, at.touch, at.behind, bounds(law, points, at)))


def slopes(law: Friction, points: Points, at: Separation, n: Array, bends: Array) -> Array:
    """Return the derivatives of tractions by positions, shape ``(n, gdim, gdim)``.

    Args:
        law: The friction.
        points: The points.
        at: Where they are.
        n: Derivatives of gaps, shape ``(n, gdim)``.
        bends: Those of normals, shape ``(n, gdim, gdim)``.
    """
    found = np.zeros(bends.shape)
    acting = known(law, points, at.touch, at.behind, bounds(law, points, at))
    loops.traction_slopes(
        _given(at), *acting, np.ascontiguousarray(n), np.ascontiguousarray(bends), found
    )
    return found


def by_pressure(law: Friction, points: Points, at: Separation) -> Array:
    """Return the derivatives of tractions by pressures on top where some act, ``(n, gdim)``."""
    found = np.zeros(at.normal.shape)
    acting = known(law, points, at.touch, at.behind, bounds(law, points, at))
    loops.traction_by_pressure(_given(at), *acting, found)
    return found


def known(
    law: Friction, points: Points, touch: float, behind: Array | None, most: Array
) -> tuple[Any, ...]:
    """Return the arguments of the compiled loops for points and their friction.

    Args:
        law: The friction.
        points: The points.
        touch: As that of :class:`Separation`.
        behind: As there.
        most: What :func:`bounds` has returned.
    """
    behind = np.zeros(0) if behind is None else behind
    parts = (points.stiffness, points.tangential, points.gap, points.stretch, behind, most)
    touched = np.ascontiguousarray(points.touched).view(np.uint8)
    numbers = [0.0] * 3
    if isinstance(law, Coulomb):
        numbers = [law.friction, law.cohesion, law.limit]
    numbers += [touch, HALF_DIGITS / ROUND_OFF * touch]  # (changes that are none)
    return [np.ascontiguousarray(part) for part in parts], touched, numbers, law.smooth


def _given(at: Separation) -> list[Array]:
    """Return the arguments of the compiled loops for places."""
    begun = [np.zeros(0)] * 3 if at.begun is None else at.begun
    return [np.ascontiguousarray(part) for part in (at.gap, at.normal, at.delta, *begun)]


def _acting(at: Separation, known: tuple[Any, ...]) -> Traction:
    """Return the tractions at points, by the arguments of the compiled loops."""
    n, dim = at.normal.shape
    acts = Traction(np.zeros(n), *np.zeros((2, n, dim)), *np.zeros((2, n), dtype=bool))
    loops.traction(_given(at), *known, *acts[:3], *(mask.view(np.uint8) for mask in acts[3:]))
    return acts


# -- Laws of a user's own -----------------------------------------------------------------------


def bounds(law: Friction, points: Points, at: Separation) -> Array:
    """Return the largest shears by a law that is not compiled, and their derivatives.

    Returns:
        By pressure, gap, way from the anchor and tangential stiffness, shape ``(n, 5)``; or nothing
        of a law that is compiled.
    """
    if law.smooth or law.compiled:
        return np.zeros(0)
    rubs, stiffness, length = _rubbing(law, points, at)
    size = float(rubs.pressure.max(initial=0.0)) or 1.0
    by_slip = _slope(law, rubs, "slip", length)
    bound, slips = _bound(law, rubs), rubs.slip > 0.0
    # (slip = way - bound / stiffness)
    k = np.where(slips, stiffness, np.inf)
    factor = 1.0 / (1.0 + by_slip / k)
    pressed = rubs.pressure > 0.0
    slopes = [pressed * _slope(law, rubs, "pressure", size), _slope(law, rubs, "gap", length)]
    slopes += [np.where(slips, by_slip, 0.0), by_slip * bound / k**2]
    return np.column_stack([bound, *(factor * slope for slope in slopes)])


def remembered(law: Friction, points: Points, at: Separation) -> Array:
    """Return the memory of points at the end of a step: see :func:`traction`."""
    if not law.memory:
        return points.memory
    inside = traction(law, points, at).inside
    rubs, *_ = _rubbing(law, points.of(inside), at.of(inside))
    found = points.memory.copy()
    found[inside] = _told_by(law, "remember", rubs, rubs.memory.shape)
    return found


def _rubbing(law: Friction, points: Points, at: Separation) -> tuple[Rubbing, Array, float]:
    """Return points as a law sees them, their stiffnesses, and a length to vary slips by.

    The slip solves ``bound(slip) + stiffness slip = stiffness way``, by Newton's method in a
    bracket.

    Raises:
        MPMError: The law gives no bound for each point.
    """
    never = np.tile([np.inf, 0.0, 0.0, 0.0, 0.0], (len(at.gap), 1))
    trial = _acting(at, known(law, points, at.touch, at.behind, never))
    size, way = (np.linalg.norm(part, axis=1) for part in (trial.shear, _along(at)))
    stiffness = size / np.where(way > 0.0, way, 1.0)
    length = max(float(way.max(initial=0.0)), SMALL / ROUND_OFF * at.touch)
    # (points may touch at a gap of round-off)
    pressure = np.maximum(trial.pressure, 0.0)
    slip, low, high = np.zeros_like(way), np.zeros_like(way), way
    for _ in range(LOCAL_ITERATIONS):
        rubs = Rubbing(pressure, slip, at.gap, points.stretch, points.memory)
        bound = _bound(law, rubs)
        left = size - stiffness * slip - bound
        done = np.abs(left) <= EQUAL * size
        moves = ~done & ((left > 0.0) | (slip > 0.0))
        if not moves.any():
            break
        low, high = np.where(left > 0.0, slip, low), np.where(left < 0.0, slip, high)
        slope = stiffness + _slope(law, rubs, "slip", length)
        tried = slip + left / np.where(slope > 0.0, slope, 1.0)
        inside = (slope > 0.0) & (tried > low) & (tried < high)
        slip = np.where(moves, np.where(inside, tried, 0.5 * (low + high)), slip)
    return rubs, stiffness, length


def _slope(law: Friction, rubs: Rubbing, name: str, size: float) -> Array:
    """Return the derivative of a law's bound by one of what it depends on, shape ``(n,)``.

    It is of second order in a step forwards: there are no pressures nor slips below zero.
    """
    values, step = getattr(rubs, name), DIFFERENCE * size
    beside = (rubs._replace(**{name: values + i * step}) for i in range(3))
    first, second, third = (_bound(law, at) for at in beside)
    return np.asarray((4.0 * second - 3.0 * first - third) / (2.0 * step))


def _along(at: Separation) -> Array:
    """Return ways from anchors along surfaces, shape ``(n, gdim)``."""
    n, delta = at.normal, at.delta
    return np.asarray(delta - n * (n * delta).sum(axis=1)[:, None])


def secant_along(at: Separation, shear: Array) -> Array:
    """Return the secant of friction along the shear of points that slip.

    That is the traction over the way from the anchor, of which :func:`slopes` have what is across
    the shear alone.

    Args:
        at: Where the points are.
        shear: Tractions along the surface, shape ``(n, gdim)``.

    Returns:
        Shape ``(n, gdim, gdim)``, to be added to derivatives by positions.
    """
    way, size = (np.linalg.norm(part, axis=1) for part in (_along(at), shear))
    tau = shear / np.where(size > 0.0, size, 1.0)[:, None]
    stiffness = size / np.where(way > 0.0, way, 1.0)
    return np.asarray(-stiffness[:, None, None] * tau[:, :, None] * tau[:, None, :])
