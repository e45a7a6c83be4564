# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Drives of a rigid body, and the account of its motion."""

from __future__ import annotations

from typing import Any, override

import numpy as np
from numpy.typing import NDArray

from ..io.snapshot import Kept, Taken
from ..particles.particles import Particles
from ..system.own import OwnUnknowns
from ..system.term import Term
from .rigid_motion import RigidMotion
from .rotation import Pose, crossing
from .shapes import as_point, as_rotation

__all__ = ["Driven", "KeptMotion"]


class Driven(Term):
    """A rigid body that forces and paths drive.

    Args:
        bodies: What it touches.
        motion: How it moves.
    """

    def __init__(self, bodies: list[Particles], motion: RigidMotion) -> None:
        super().__init__(bodies)
        self._motion = motion

    # -- What drives it ---------------------------------------------------------------------------

    def push(self, force: Any, moment: Any = 0.0) -> None:
        """Set the force that acts on its centre at the end of the next step, and the moment.

        Args:
            force: Shape ``(gdim,)``; its weight comes on top of it.
            moment: About its centre: a number, in space a vector ``(3,)``.

        Raises:
            MPMError: No finite numbers of these shapes.
        """
        gdim = len(self._motion.start)
        turning = as_rotation(moment, "moment of a RigidBody", gdim)
        self._motion.push = as_point(force, "force", gdim), turning

    def move(self, offset: Any, angle: Any = 0.0) -> None:
        """Say where it is to be at the end of the next step, in what is ``fixed`` of it.

        Args:
            offset: Of its centre from where it began, shape ``(gdim,)``; what is not fixed in it
                does not matter.
            angle: Angle in radians, anticlockwise; in space the vector of rotation, ``(3,)``.

        Raises:
            MPMError: No finite numbers of these shapes.
        """
        gdim = len(self._motion.start)
        turn = as_rotation(angle, "angle of a RigidBody", gdim)
        self._motion.aim = Pose(as_point(offset, "offset", gdim), turn)

    # -- What it tells, at the last converged step ----------------------------------------------

    @property
    def centre(self) -> NDArray[np.float64]:
        """Place of its centre, shape ``(gdim,)``."""
        return self._motion.centres[0]

    @property
    def offset(self) -> NDArray[np.float64]:
        """How far its centre has moved, shape ``(gdim,)``."""
        return self._motion.last.place.copy()

    @property
    def angle(self) -> NDArray[np.float64]:
        """Angle that it has turned, ``(1,)``, or in space its vector of rotation, ``(3,)``."""
        return self._motion.last.turn.angle

    @property
    def velocity(self) -> NDArray[np.float64]:
        """Velocity of its centre, shape ``(gdim,)``; in what is ``fixed`` the mean of the step."""
        return self._motion.last.velocity.copy()

    @property
    def spin(self) -> NDArray[np.float64]:
        """Rate of rotation, ``(1,)``, or in space a vector ``(3,)``."""
        state = self._motion.last
        return state.spin.copy() if len(state.spin) == 1 else state.Q @ state.spin

    @property
    def kinetic_energy(self) -> float:
        """Kinetic energy."""
        state, motion = self._motion.last, self._motion
        turning = float(state.spin @ motion.inertia @ state.spin)
        return 0.5 * (motion.mass * float(state.velocity @ state.velocity) + turning)

    @property
    def potential_energy(self) -> float:
        """Energy in the field of gravity, zero at the beginning."""
        return -self._motion.mass * float(self._motion.gravity @ self._motion.last.place)

    @property
    def momentum(self) -> NDArray[np.float64]:
        """Momentum, shape ``(gdim,)``."""
        return self._motion.mass * self._motion.last.velocity

    @property
    def angular_momentum(self) -> NDArray[np.float64]:
        """Angular momentum about the origin, ``(1,)`` or ``(3,)``."""
        state = self._motion.last
        turning = self._motion.inertia @ state.spin
        if len(turning) == 3:
            turning = state.Q @ turning
        return np.asarray(turning + crossing(self.centre).T @ self.momentum)


class KeptMotion(Kept):
    """Where a rigid body is, and how it moves.

    Args:
        motion: Its motion.
        own: Its unknowns, if it has any.
        key: See :class:`Kept`.
    """

    def __init__(self, motion: RigidMotion, own: OwnUnknowns | None, key: str) -> None:
        self._motion, self._own, self.key = motion, own, key

    @override
    def numbers(self) -> dict[str, Any]:
        past = [] if self._own is None else self._own.past
        known = [[size, *(part.tolist() for part in parts)] for size, parts in past]
        return self._motion.numbers() | {"past": known}

    @override
    def restore(self, taken: Taken) -> None:
        self._motion.take(taken.numbers)
        if self._own is not None:
            past = taken.numbers.get("past", [])
            self._own.past = [(size, [np.array(part)]) for size, part in past]
