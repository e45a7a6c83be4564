# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The equations of motion of a rigid body over a step.

A rigid body has the place of its centre of mass X, an orientation Q, a velocity V and a rate of
rotation Omega in its own frame. A step changes them by ``dX`` and a Cayley vector theta (see
:mod:`.rotation`). With tractions f per area on the other bodies at arms r from the centre,

    m (V_1 - V_0) / dt + int f dA = F,
    (Q_1 J Omega_1 - Q_0 J Omega_0) / dt + int r x f dA = M

hold, where V_1 = 2 dX/dt - V_0 and Omega_1 = 2 Q_0^T theta / dt - Omega_0, and f and r are those of
the step's middle; or V_1 = dX/dt, Omega_1 = Q_0^T theta / dt, and those of its end
(``"euler"``); or, in equilibrium, without mass.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError
from ..parallel.given import one_line
from ..reals import as_finite
from .rotation import Pose, Turn, cayley_variation, crossing

__all__ = ["RigidMotion", "State", "as_inertia", "held_of", "names_of"]

NAMES = ("x", "y", "z")
TURNS = "rotation"


class State(NamedTuple):
    """Where a rigid body is, how it moves, and what drives it.

    Attributes:
        place: Of its centre, less that at the beginning, shape ``(gdim,)``.
        turn: Its orientation.
        velocity: Of its centre.
        spin: Rate of rotation in its own frame, ``(1,)`` or ``(3,)``.
        force: Force on it besides its weight.
        moment: Moment on it about its centre.
    """

    place: NDArray[np.float64]
    turn: Turn
    velocity: NDArray[np.float64]
    spin: NDArray[np.float64]
    force: NDArray[np.float64]
    moment: NDArray[np.float64]

    @property
    def Q(self) -> NDArray[np.float64]:
        """Its orientation as a matrix."""
        return Pose(self.place, self.turn.angle).Q


class RigidMotion:
    """How a rigid body moves: where it was, and where a step leads to.

    Args:
        mass: Its mass, if it has one.
        inertia: Moment of inertia about the centre ``(1, 1)``, or the tensor ``(3, 3)``, if it has
            one.
        start: Centre of mass at the beginning, shape ``(gdim,)``.
        gravity: Acceleration by gravity, shape ``(gdim,)``.
        held: Which of its displacements and rotations follow a path.
        still: How it begins.

    Attributes:
        mass: As given; 0 if it has none.
        inertia: As given; zero if it has none.
        gravity: As given.
        held: As given.
        start: As given.
        last: State at the last converged step.
        trial: State at the end of the step that was tried last.
        step: This step: displacement of the centre and Cayley vector, shape ``(gdim + nr,)``.
        push: Force and moment on it at the end of the next step.
        aim: Where it is to be then, in what is held.
        dt: Length of a step, ``None`` in equilibrium.
        whole: Whether forces are those of a step's middle.
    """

    def __init__(
        self,
        mass: float | None,
        inertia: NDArray[np.float64] | None,
        start: NDArray[np.float64],
        gravity: NDArray[np.float64],
        held: NDArray[np.bool_],
        still: State,
    ) -> None:
        self.held, self.start, self.gravity = held, start, gravity
        self._gdim = len(start)
        self.mass = 0.0 if mass is None else mass
        nr = len(held) - self._gdim
        self.inertia = np.zeros((nr, nr)) if inertia is None else inertia
        self.last = self.trial = still
        self.step = np.zeros(len(held))
        self.push = still.force, still.moment
        self.aim = Pose(np.zeros(self._gdim), np.zeros(nr))
        self.dt: float | None = None
        self.whole = False

    @property
    def gyration(self) -> float | None:
        """Radius of gyration, where it has a mass and an inertia."""
        mean = float(np.trace(self.inertia)) / len(self.inertia)
        return float(np.sqrt(mean / self.mass)) if self.mass > 0.0 and mean > 0.0 else None

    # -- A step ---------------------------------------------------------------------------------

    @property
    def centres(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Places of its centre at the beginning and the end of the step, shape ``(gdim,)``."""
        return self.start + self.last.place, self.start + self.trial.place

    @property
    def theta(self) -> NDArray[np.float64]:
        """Cayley vector of the step."""
        return self.step[self._gdim :]

    def guess(self) -> NDArray[np.float64]:
        """Return a step to begin with: as it moved before, or the way to go in what is held."""
        gdim, last = self._gdim, self.last
        s = np.zeros(len(self.held))
        if self.dt is not None:
            s[:gdim] = self.dt * last.velocity
            s[gdim:] = self.dt * (last.spin if gdim == 2 else last.Q @ last.spin)
        path = np.concatenate([self.aim.offset - last.place, s[gdim:]])
        path[gdim:] = last.turn.cayley_to(Turn.of(self.aim.angle)) if self.held[-1] else 0.0
        return np.where(self.held, path, s)

    def stepped(self, s: NDArray[np.float64]) -> State:
        """Return where a step leads to.

        Args:
            s: The step: displacement of the centre and Cayley vector.
        """
        gdim, last = self._gdim, self.last
        u, theta = s[:gdim], s[gdim:]
        velocity, spin = last.velocity, last.spin
        if self.dt is not None:
            # (what follows a path has the mean of the step, or a jump of it would swing for ever)
            c = np.where(self.held, 1.0, 2.0 if self.whole else 1.0)
            velocity = c[:gdim] * u / self.dt - (c[:gdim] - 1.0) * velocity
            turn = Turn.none(gdim).turned(theta).angle if self.held[-1] else theta
            own = turn if gdim == 2 else last.Q.T @ turn
            spin = c[gdim:] * own / self.dt - (c[gdim:] - 1.0) * spin
        return State(last.place + u, last.turn.turned(theta), velocity, spin, *self.push)

    def go(self, s: NDArray[np.float64]) -> None:
        """Try a step."""
        self.step, self.trial = s, self.stepped(s)

    def roll_back(self) -> None:
        """Return to the last converged step."""
        self.step, self.trial = np.zeros(len(self.held)), self.last

    def given(self) -> NDArray[np.float64]:
        """Return force and moment on it in the step, besides those of contact."""
        force, moment = self.push
        if self.whole:
            force = 0.5 * (force + self.last.force)
            moment = 0.5 * (moment + self.last.moment)
        return np.concatenate([force + self.mass * self.gravity, moment])

    def inertial(self) -> NDArray[np.float64]:
        """Return the forces of inertia over the step."""
        last, state = self.last, self.trial
        if self.dt is None:
            return np.zeros(len(self.held))
        before, after = (self.inertia @ s.spin for s in (last, state))
        if len(before) == 3:
            before, after = last.Q @ before, state.Q @ after
        linear = self.mass * (state.velocity - last.velocity)
        return np.concatenate([linear, after - before]) / self.dt

    def slopes(self) -> NDArray[np.float64]:
        """Return their derivatives by the step."""
        gdim, theta, state = self._gdim, self.theta, self.trial
        nr = len(theta)
        K = np.zeros((gdim + nr, gdim + nr))
        if self.dt is None:
            return K
        c = 2.0 if self.whole else 1.0
        K[:gdim, :gdim] = c * self.mass / self.dt**2 * np.eye(gdim)
        if nr == 1:
            K[gdim:, gdim:] = c * self.inertia / self.dt**2
            return K
        Q, J = state.Q, self.inertia
        K[gdim:, gdim:] = crossing(Q @ J @ state.spin) @ cayley_variation(theta) / self.dt
        K[gdim:, gdim:] += c * Q @ J @ self.last.Q.T / self.dt**2
        return K

    def swing(self) -> float:
        """Return the size of the forces of inertia that would stop it within a step."""
        if self.dt is None:
            return 0.0
        return 2.0 / self.dt * self.mass * float(np.linalg.norm(self.last.velocity))

    # -- What is kept ---------------------------------------------------------------------------

    def numbers(self) -> dict[str, Any]:
        """Return where it is and how it moves, for a checkpoint."""
        values = self.last._asdict() | {"turn": self.last.turn.values}
        return {name: value.tolist() for name, value in values.items()} | {
            "push": [part.tolist() for part in self.push],
            "aim": [self.aim.offset.tolist(), self.aim.angle.tolist()],
        }

    def take(self, numbers: dict[str, Any]) -> None:
        """Take what :meth:`numbers` returned."""
        values = {name: np.array(numbers[name], dtype=np.float64) for name in State._fields}
        turn = Turn(values.pop("turn"))
        last = self.last = self.trial = State(turn=turn, **values)
        force, moment = numbers.get("push", (last.force, last.moment))
        self.push = np.array(force), np.array(moment)
        offset, angle = numbers.get("aim", (last.place, last.turn.angle))
        self.aim = Pose(np.array(offset), np.array(angle))


def names_of(gdim: int) -> list[str]:
    """Return the names of what a rigid body can do; all of its rotations have one."""
    return [*NAMES[:gdim], TURNS]


def held_of(fixed: Any, gdim: int, axisymmetric: bool) -> NDArray[np.bool_]:
    """Return which of the unknowns of a rigid body follow a path.

    Raises:
        MPMError: Names that are none.
    """
    names = names_of(gdim)
    try:
        given = [fixed] if isinstance(fixed, str) else list(fixed)
    except TypeError:
        given = [fixed]
    for name in given:
        if name not in names:
            raise MPMError(
                f"fixed= of a RigidBody has names among {', '.join(map(repr, names))}, not "
                f"{name!r}."
            )
    if axisymmetric:
        given += [NAMES[0], TURNS]
    held = [name in given for name in names[:-1]]
    return np.array(held + [TURNS in given] * (1 if gdim == 2 else 3))


def as_inertia(value: Any, gdim: int) -> NDArray[np.float64]:
    """Return a moment of inertia ``(1, 1)``, or a tensor ``(3, 3)``.

    Raises:
        MPMError: It is none: not symmetric, or not positive.
    """
    count = 1 if gdim == 2 else 3
    number = as_finite(value)
    found = as_finite(value, count, count) if number is None else number * np.eye(count)
    if found is None or np.abs(found - found.T).max() > 1e-12 * np.abs(found).max():
        raise MPMError(
            f"inertia of a RigidBody must be a number{'' if gdim == 2 else ' or (3, 3) numbers'}, "
            f"not {one_line(value)}."
        )
    if not np.linalg.eigvalsh(found).min() > 0.0:
        raise MPMError(f"inertia of a RigidBody must be positive, not {one_line(value)}.")
    return found
