# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Rigid bodies that forces drive, in contact with bodies that deform.

Its equations of motion are in :mod:`.rigid_motion`, the tractions of its contacts in
:mod:`.body_contact`.

What contact keeps rests on one identity: in the frame of the body a point's coordinates
``z = Q^T (x - X)`` change by ``Q_m^T (dx - dX - theta x r_m)``, where ``Q_m`` is the mean of the
rotations and ``r_m`` that of the arms. So tractions ``Q_m t`` do the work ``t . dz`` on both
together, which is the loss of the energy of penetration where t is its discrete gradient
(:mod:`.law`), and moments about any point balance, as the arms are those of the middle.

Its displacement and rotation in a step are unknowns of Newton's method, by their balance in
:mod:`.rigid_balance`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, override

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..errors import ConvergenceError, MPMError
from ..io.snapshot import Kept
from ..parallel.boundary import collective
from ..parallel.given import as_positive, require_same
from ..particles.particles import Particles
from ..system.term import Motion, PointMaterial, Term, Transfer
from .body_contact import BodyContact
from .contact import KeptContact
from .driven import Driven, KeptMotion
from .law import Friction
from .placed import Placed
from .rigid_balance import RigidBalance
from .rigid_motion import RigidMotion, State, as_inertia, held_of
from .rotation import Turn, crossing
from .shapes import Shape, as_point, as_rotation

__all__ = ["RigidBody"]

#: Largest Cayley vector of a free body in a step of a motion: its angle lags by 2 % then.
MOST_SPIN = 0.5


class RigidBody(Driven):
    """A rigid body that forces drive, in contact with bodies that deform, with friction.

    In a ``DynamicProblem`` it has a mass: a boulder that falls, a pile that is dropped, a cylinder
    that rolls. In a ``QuasiStaticProblem`` it is where its forces and those of contact
    balance: a footing that a force presses down, and that is free to tilt::

        footing = mpm.contact.RigidBody(soil, shape, friction=0.5)
        problem = mpm.QuasiStaticProblem(mpm.Body(soil, law), bcs, terms=[footing])
        problem.solve(20, update=lambda t: footing.push((0.0, -300.0 * t), -20.0 * t))

    It has two or three displacements and one or three rotations; axisymmetric one displacement
    along the axis. Those that are named as ``fixed`` follow :meth:`move` instead.
    Another rigid obstacle does not stop it: contact is with bodies that deform alone.

    Args:
        particles: The body that deforms, or a list of them.
        shape: The shape, of :mod:`mpm_dolfinx.contact`, as it lies at the beginning.
        mass: Mass, per thickness in the plane, of the whole ring in a body of revolution; needed
            in motion, and for a weight.
        inertia: Moment of inertia about the centre in the plane; in space the tensor ``(3, 3)``, or
            one number where it is the same about all axes. Needed in motion unless it cannot turn.
        centre: Centre of mass at the beginning, shape ``(gdim,)``; the pivot of the shape by
            default.
        friction: As for :class:`Rigid`.
        gravity: Its acceleration by gravity, shape ``(gdim,)``, which acts in full always.
        velocity: Of its centre at the beginning, shape ``(gdim,)``.
        spin: Its rate of rotation at the beginning: a number, in space a vector ``(3,)``.
        fixed: What follows :meth:`move`: names among ``"x"``, ``"y"``, ``"z"`` and ``"rotation"``.
        **options: Those of :class:`Rigid` for its contacts: ``penalty``, ``facets``, ...

    Attributes:
        contacts: The contact with each body, which tells pressures, gaps, and where points stick.
        shape: As given.
        mass: As given.

    Raises:
        MPMError: What makes no sense.
    """

    movable = remeshable = True  # its contacts go with the facets of its bodies

    @collective()
    def __init__(
        self,
        particles: Particles | Sequence[Particles],
        shape: Shape,
        mass: float | None = None,
        *,
        inertia: Any = None,
        centre: Any = None,
        friction: float | Friction = 0.0,
        gravity: Any = None,
        velocity: Any = None,
        spin: Any = None,
        fixed: Sequence[str] = (),
        **options: Any,
    ) -> None:
        bodies: list[Any] = list(particles) if isinstance(particles, list | tuple) else [particles]
        if not bodies:
            raise MPMError("A RigidBody needs one body of mpm.Particles or more.")
        self.contacts = [BodyContact(body, shape, friction, **options) for body in bodies]
        if any(one is other for i, one in enumerate(bodies) for other in bodies[:i]):
            raise MPMError("A RigidBody needs bodies that differ, not the same one twice.")
        gdim = shape.dim
        self.axisymmetric = self.contacts[0].axisymmetric
        self.shape = shape
        self.mass = None if mass is None else as_positive(mass, "mass")
        nr = 1 if gdim == 2 else 3
        held = held_of(fixed, gdim, bool(self.axisymmetric))
        self._inertia = None if inertia is None else as_inertia(inertia, gdim)
        at = shape.pivot.copy() if centre is None else as_point(centre, "centre", gdim)
        down = np.zeros(gdim) if gravity is None else as_point(gravity, "gravity", gdim)
        if gravity is not None and self.mass is None:
            raise MPMError("gravity= of a RigidBody needs its mass=.")
        still = State(
            np.zeros(gdim),
            Turn.none(gdim),
            np.zeros(gdim) if velocity is None else as_point(velocity, "velocity", gdim),
            np.zeros(nr) if spin is None else as_rotation(spin, "spin of a RigidBody", gdim),
            np.zeros(gdim),
            np.zeros(nr),
        )
        self._comm = bodies[0].mesh.comm
        motion = RigidMotion(self.mass, self._inertia, at, down, held, still)
        super().__init__(bodies, motion)
        self._balance = RigidBalance(self.contacts, motion, self._comm)
        self.own = self._balance.own
        self._number = 0

    @property
    def contact_energy(self) -> float:
        """Energy of penetration of all contacts (collective)."""
        own = sum(contact.energy() for contact in self.contacts)
        return float(self._comm.allreduce(own))

    @property
    def reaction(self) -> NDArray[np.float64]:
        """Force on the bodies that it touches, shape ``(gdim,)`` (collective)."""
        return np.asarray(np.sum([contact.reaction for contact in self.contacts], axis=0))

    def placed(self) -> Placed:
        """Return its shape where it is now; it does not follow when this one moves."""
        return self.contacts[0].placed()

    # -- The term -------------------------------------------------------------------------------

    @override
    def come_after(self, gone: Sequence[Term]) -> None:
        """Keep place and motion of the body of before; points begin anew."""
        for contact in self.contacts:
            contact.come_after(gone)

    @override
    def take_part(
        self,
        number: int,
        bodies: Sequence[Particles],
        materials: Sequence[PointMaterial | None],
    ) -> None:
        self._number = number
        for contact in self.contacts:
            contact.take_part(number, bodies, materials)
        self._balance.take_part()

    @override
    def pace(self, dt: float, share: float) -> None:
        """Begin a step of a motion.

        Raises:
            MPMError: It has no mass.
        """
        if self.mass is None:
            raise MPMError("A RigidBody needs its mass= in a motion.")
        if self._inertia is None and not self._motion.held[-1]:
            raise MPMError(
                "A RigidBody needs its inertia= in a motion, or fixed=['rotation'] where it cannot "
                "turn."
            )
        self._balance.share = share
        self._motion.dt, self._motion.whole = dt, share < 1.0
        for contact in self.contacts:
            contact.pace(dt, share)

    @override
    def begin(self) -> Sequence[PETSc.Vec]:
        """Begin a step.

        Raises:
            ConvergenceError: It is to turn by half a turn or more, which no Cayley vector tells.
        """
        (force, moment), aim = self._motion.push, self._motion.aim
        require_same(self._comm, force=force, moment=moment, offset=aim.offset, angle=aim.angle)
        turn = aim.angle - self.angle
        if self._motion.held[-1] and len(turn) == 1 and abs(turn[0]) >= np.pi:
            raise ConvergenceError(
                "A RigidBody turns by half a turn or more in one step; turn it by less, on a path "
                "(update=)"
            )
        for contact in self.contacts:
            contact.begin()
        self._balance.begin()
        return ()

    @override
    def start(self, transfer: Transfer, prescribed: Motion) -> None:
        for contact in self.contacts:
            contact.start(transfer, prescribed)

    @override
    def end_forces(self) -> Sequence[PETSc.Vec]:
        return () if self._motion.whole else self.residuals()

    @override
    def step_work(self) -> tuple[float, float]:
        """Return the work of the step; the energy taken up counts as internal."""
        if not self._motion.whole:
            return 0.0, 0.0
        u, theta = np.split(self._motion.step, [self.shape.dim])
        middle = np.mean(self._motion.centres, axis=0)

        def motion(x: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray(u + crossing(x - middle) @ theta)

        own = np.sum([contact.works(motion) for contact in self.contacts], axis=0)
        taken_up, damped = self._comm.allreduce(own)
        return float(taken_up), float(damped)

    @override
    def smooth(self) -> bool:
        """Return false: contact is not smooth."""
        return all([contact.smooth() for contact in self.contacts])

    @override
    def update(self) -> MPMError | None:
        return self._balance.update()

    @override
    def residuals(self) -> Sequence[PETSc.Vec]:
        return [force for contact in self.contacts for force in contact.residuals()]

    @override
    def tangents(self) -> Mapping[tuple[int, int], PETSc.Mat]:
        return self._balance.tangents(True)

    @override
    def derivatives(self) -> Mapping[tuple[int, int], PETSc.Mat]:
        return self._balance.tangents(False)

    @override
    def commit(self) -> Callable[[], None]:
        """Commit the step.

        Raises:
            ConvergenceError: It turns too far for the scheme, or a contact is refused.
        """
        turn = float(np.linalg.norm(self._motion.theta))
        if self._motion.dt is not None and not self._motion.held[-1] and turn > MOST_SPIN:
            raise ConvergenceError(
                f"A RigidBody spins by {turn:.3g} rad in one step, of which the scheme follows "
                f"{MOST_SPIN:g}; take smaller steps"
            )
        before = self._motion.last
        done: list[Callable[[], None]] = []

        def undo() -> None:
            for back in reversed(done):
                back()
            self._motion.last = before

        try:
            for contact in self.contacts:
                done.append(contact.commit())
        except BaseException:
            undo()
            raise
        self._motion.last = self._motion.trial
        return undo

    @override
    def roll_back(self) -> None:
        for contact in self.contacts:
            contact.roll_back()
        self._motion.roll_back()

    # -- What is kept ---------------------------------------------------------------------------

    @override
    def kept(self) -> Sequence[Kept]:
        of_contacts = self.name or f"contact{self._number}"
        return [
            *(KeptContact(one, f"{of_contacts}_{i}") for i, one in enumerate(self.contacts)),
            KeptMotion(self._motion, self.own, self.name or f"rigid_body{self._number}"),
        ]
