# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Rigid bodies that forces drive, in contact with bodies that deform.

Its equations of motion are in :mod:`.rigid_motion`, the tractions of its contacts in
:mod:`.body_contact`.

What contact keeps rests on one identity: in the frame of the body a point's coordinates
``z = Q^T (x - X)`` change by ``Q_m^T (dx - dX - theta x r_m)``, where ``Q_m`` is the mean of the
rotations and ``r_m`` that of the arms. So tractions ``Q_m t`` do the work ``t . dz`` on both
together, which is the loss of the energy of penetration where t is its discrete gradient
(:mod:`.whole_step`), and moments about any point balance, as the arms are those of the middle.

These few unknowns s are found by Newton's method for whatever positions the other bodies have, and
condensed out of the tangent: it has ``- (df/ds) K_ss^-1 (dR/dd)`` besides that of an obstacle at
rest, which is of the rank of their number, and dense in the unknowns near the contact.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, override

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..errors import TRIAL_ERRORS, ConvergenceError, MPMError, agree
from ..io.snapshot import Kept, Taken
from ..parallel.boundary import collective
from ..parallel.given import as_positive, require_same
from ..particles.particles import Particles
from ..system.term import PointMaterial, Term, Transfer
from .body_contact import BodyContact
from .law import Friction
from .placed import Placed
from .rigid_motion import RigidMotion, State, as_inertia, as_rotation, held_of
from .rotation import Pose, Turn, crossing
from .shapes import Shape, as_point
from .yielding import Yielding

__all__ = ["RigidBody"]

#: Residual of the balance of a rigid body, relative to its forces, that is round-off, and that is
#: good enough where it falls no further.
BALANCED, AT_ROUND_OFF = 1e-14, 1e-9
#: Most iterations, and most halvings of one of them.
MOST_ITERATIONS, MOST_HALVINGS = 60, 12
#: Stiffness, relative to the largest, below which nothing holds a body.
LOOSE = 1e-11
#: Gap, over twice the length of what it falls on, to which a body without a hold falls; at least
#: this much times the round-off of coordinates.
NEAR, LEAST = 1e-7, 8.0
#: Most that a body turns in one iteration.
MOST_TURN = 0.5
#: Largest Cayley vector of a free body in a step of a motion: its angle lags by 2 % then.
MOST_SPIN = 0.5
#: Drag on a body that creeps to its balance, over the largest stiffness, to begin with; by how much
#: it changes in an iteration at most, down and up; and how much larger the residual may become.
DRAG, FADES, RISES, GROWS = 0.1, 0.25, 4.0, 2.0


class Balance(NamedTuple):
    """Forces on a rigid body that is put somewhere.

    Attributes:
        residual: Forces and moments that are left, shape ``(gdim + nr,)``.
        size: Size of all forces.
        enough: Size of a residual that is good enough where it falls no further: by round-off of
            the forces and of the coordinates that they depend on.
        state: Where the body is.
    """

    residual: NDArray[np.float64]
    size: float
    enough: float
    state: State


class RigidBody(Term):
    """A rigid body that forces drive, in contact with bodies that deform, with friction.

    In a ``DynamicProblem`` it has a mass: a boulder that falls, a pile that is dropped, a cylinder
    that rolls. In a ``QuasiStaticProblem`` it is where its forces and those of contact
    balance: a footing that a force presses down, and that is free to tilt::

        footing = mpm.contact.RigidBody(soil, shape, friction=0.5)
        problem = mpm.QuasiStaticProblem(soil, law, terms=[footing])
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
        **options: Those of :class:`Rigid` for its contacts: ``penalty``, ``facet_tags``, ...

    Attributes:
        contacts: The contact with each body, which tells pressures, gaps, and where points stick.
        shape: As given.
        mass: As given.

    Raises:
        MPMError: What makes no sense.
    """

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
        super().__init__(bodies)
        gdim = shape.dim
        self.axisymmetric = self.contacts[0].axisymmetric
        self.shape = shape
        self.mass = None if mass is None else as_positive(mass, "mass")
        nr = 1 if gdim == 2 else 3
        held = held_of(fixed, gdim, bool(self.axisymmetric))
        self._inertia = None if inertia is None else as_inertia(inertia, gdim)
        at = shape.pivot.copy() if centre is None else as_point(centre, "centre", gdim)
        down = np.zeros(gdim) if gravity is None else as_point(gravity, "gravity", gdim)
        self._motion = RigidMotion(self.mass, self._inertia, at, down, held)
        if gravity is not None and self.mass is None:
            raise MPMError("gravity= of a RigidBody needs its mass=.")
        still = State(
            np.zeros(gdim),
            Turn.none(gdim),
            np.zeros(gdim) if velocity is None else as_point(velocity, "velocity", gdim),
            np.zeros(nr) if spin is None else as_rotation(spin, "spin", gdim),
            np.zeros(gdim),
            np.zeros(nr),
        )
        self._comm = bodies[0].mesh.comm
        self._memory = self._trial = still
        self._found = np.zeros(gdim + nr)
        self._lever = self._span = 1.0
        self._aim = Pose(np.zeros(gdim), np.zeros(nr))
        self._push = still.force, still.moment
        self._share = 1.0
        self._number = 0
        self._condensed: Yielding | None = None
        self._begins = True

    # -- What drives it ---------------------------------------------------------------------------

    def push(self, force: Any, moment: Any = 0.0) -> None:
        """Set the force that acts on its centre at the end of the next step, and the moment.

        Args:
            force: Shape ``(gdim,)``; its weight comes on top of it.
            moment: About its centre: a number, in space a vector ``(3,)``.

        Raises:
            MPMError: No finite numbers of these shapes.
        """
        gdim = self.shape.dim
        self._push = as_point(force, "force", gdim), as_rotation(moment, "moment", gdim)

    def move(self, offset: Any, angle: Any = 0.0) -> None:
        """Say where it is to be at the end of the next step, in what is ``fixed`` of it.

        Args:
            offset: Of its centre from where it began, shape ``(gdim,)``; what is not fixed in it
                does not matter.
            angle: Angle in radians, anticlockwise; in space the vector of rotation, ``(3,)``.

        Raises:
            MPMError: No finite numbers of these shapes.
        """
        gdim = self.shape.dim
        self._aim = Pose(as_point(offset, "offset", gdim), as_rotation(angle, "angle", gdim))

    # -- What it tells, at the last converged step ----------------------------------------------

    @property
    def centre(self) -> NDArray[np.float64]:
        """Place of its centre, shape ``(gdim,)``."""
        return self._motion.centre(self._memory)

    @property
    def offset(self) -> NDArray[np.float64]:
        """How far its centre has moved, shape ``(gdim,)``."""
        return self._memory.place.copy()

    @property
    def angle(self) -> NDArray[np.float64]:
        """Angle that it has turned, ``(1,)``, or in space its vector of rotation, ``(3,)``."""
        return self._memory.turn.angle

    @property
    def velocity(self) -> NDArray[np.float64]:
        """Velocity of its centre, shape ``(gdim,)``; in what is ``fixed`` the mean of the step."""
        return self._memory.velocity.copy()

    @property
    def spin(self) -> NDArray[np.float64]:
        """Rate of rotation, ``(1,)``, or in space a vector ``(3,)``."""
        state = self._memory
        return state.spin.copy() if len(state.spin) == 1 else state.Q @ state.spin

    @property
    def kinetic_energy(self) -> float:
        """Kinetic energy."""
        return self._motion.kinetic_energy(self._memory)

    @property
    def potential_energy(self) -> float:
        """Energy in the field of gravity, zero at the beginning."""
        return self._motion.potential_energy(self._memory)

    @property
    def contact_energy(self) -> float:
        """Energy of penetration of all contacts (collective)."""
        own = sum(contact.energy() for contact in self.contacts)
        return float(self._comm.allreduce(own))

    @property
    def momentum(self) -> NDArray[np.float64]:
        """Momentum, shape ``(gdim,)``."""
        return self._motion.momentum(self._memory)

    @property
    def angular_momentum(self) -> NDArray[np.float64]:
        """Angular momentum about the origin, ``(1,)`` or ``(3,)``."""
        return self._motion.angular_momentum(self._memory)

    @property
    def reaction(self) -> NDArray[np.float64]:
        """Force on the bodies that it touches, shape ``(gdim,)`` (collective)."""
        return np.asarray(np.sum([contact.reaction for contact in self.contacts], axis=0))

    def placed(self) -> Placed:
        """Return its shape where it is now; it does not follow when this one moves."""
        return self.contacts[0].placed()

    # -- Its balance ------------------------------------------------------------------------------

    @property
    def _held(self) -> NDArray[np.bool_]:
        return self._motion.held

    def _pose(self, state: State) -> Pose:
        """Return where the shape is, which turns about its pivot, and not about the centre."""
        arm = self.shape.pivot - self._motion.start
        return Pose(state.place + state.Q @ arm - arm, state.turn.angle)

    def _stepped(self, s: NDArray[np.float64]) -> State:
        """Return where a step of the unknowns leads to from the last converged place."""
        return self._motion.stepped(self._memory, s, self._push)

    def _centres(self, state: State) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return self._motion.centre(self._memory), self._motion.centre(state)

    def _put(self, s: NDArray[np.float64]) -> Balance:
        """Put the body somewhere; return the forces on it there.

        Raises:
            MPMError: A contact cannot be evaluated there, on any rank (collective).
        """
        state = self._stepped(s)
        pose, centres = self._pose(state), self._centres(state)
        with agree(self._comm):
            for contact in self.contacts:
                contact.put(pose)
            own = np.sum([contact.total(centres) for contact in self.contacts], axis=0)
        total = self._comm.allreduce(own)
        last = self._memory
        given = self._motion.given(last, self._push)
        inertial = self._motion.inertial(last, state)
        size = float(total[-2]) + sum(
            float(np.linalg.norm(self._levelled(part))) for part in (given, inertial)
        )
        size += self._motion.swing(last)
        enough = AT_ROUND_OFF * size + float(total[-1])
        return Balance(inertial + total[:-2] - given, size, enough, state)

    def _scale(self) -> NDArray[np.float64]:
        """Return 1 for forces, and for moments the length over which they are compared."""
        return np.where(np.arange(len(self._held)) < self.shape.dim, 1.0, self._lever)

    def _levelled(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return forces, and moments over the length that they are compared by."""
        return forces / self._scale()

    def _slopes(
        self, state: State, theta: NDArray[np.float64], on_nodes: bool
    ) -> tuple[NDArray[Any], list[Any]]:
        """Return the derivative of the balance by s, and what contacts have (collective)."""
        centres, n = self._centres(state), len(state.place) + len(theta)
        parts, own = [], np.zeros((n, n))
        for contact in self.contacts:
            acting = contact.acting()
            blocks = contact.blocks(acting, centres, theta, on_nodes)
            parts.append((acting, blocks))
            own += blocks.own
        K = self._comm.allreduce(own) + self._motion.slopes(self._memory, state, theta)
        return K, parts

    def _inverse(self, K: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the inverse of a tangent, where it has one, and the projector on its range.

        Nothing is in the rows of what is fixed. Directions without any stiffness are left out.
        """
        free = ~self._held
        scale = self._scale()[free]
        A = K[np.ix_(free, free)] / scale[:, None] / scale
        U, sizes, V = np.linalg.svd(A)
        kept = sizes > LOOSE * sizes.max(initial=0.0) if sizes.max(initial=0.0) > 0.0 else sizes > 0
        inverse, onto = np.zeros_like(K), np.zeros_like(K)
        inner = (V[kept].T / sizes[kept]) @ U[:, kept].T
        inverse[np.ix_(free, free)] = inner / scale[:, None] / scale
        onto[np.ix_(free, free)] = scale[:, None] * (U[:, kept] @ U[:, kept].T) / scale
        return inverse, onto

    @override
    def update(self) -> MPMError | None:
        """Find where the body is for what the others have."""
        for contact in self.contacts:
            contact.look()
        starts = [self._motion.guess(self._memory, self._aim)]
        if not self._begins:
            assert self._condensed is not None
            starts = [*self._condensed.followed(), self._found, *starts]
        failure: MPMError | None = None
        # (later a shorter iteration of all unknowns finds it in fewer of them)
        for creeps in (False, True)[: 2 if self._begins else 1]:
            for s in starts:
                try:
                    self._find(self._crept(s) if creeps else s)
                    self._begins = False
                    return None
                except TRIAL_ERRORS as error:
                    failure = error
        return failure

    def _crept(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where the body creeps to from some step of it, against a drag that fades.

        Where points come to touch and lift off on its way, Newton's method goes to and fro between
        places of no balance; what creeps goes downhill (pseudo-transient continuation, the drag in
        proportion to the residual: Kelley & Keyes 1998, SIAM J. Numer. Anal. 35).

        Raises:
            MPMError: It begins where nothing touches it, and finds nothing on its way (collective).
        """
        gdim, free = self.shape.dim, ~self._held
        scale = self._scale()[free]
        now = self._put(s)
        norm, drag = self._size_of(now.residual), 0.0
        for _ in range(MOST_ITERATIONS):
            if norm <= now.enough:
                break
            K, _ = self._slopes(now.state, s[gdim:], False)
            A = K[np.ix_(free, free)] / scale[:, None] / scale
            drag = drag or DRAG * float(np.linalg.norm(A, 2))
            if drag == 0.0:
                s = self._fallen(s, -now.residual, norm / now.size)
                now = self._put(s)
                norm = self._size_of(now.residual)
                continue
            step = np.zeros_like(s)
            A += drag * np.eye(len(A))
            step[free] = np.linalg.solve(A, now.residual[free] / scale) / scale
            step = self._turned_at_most(step)
            tried = self._put(s - step)
            if (found := self._size_of(tried.residual)) > GROWS * norm:
                drag *= RISES
                now = self._put(s)
                continue
            drag *= max(found / norm, FADES)
            s, norm, now = s - step, found, tried
        return s

    def _turned_at_most(self, step: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a step, or as much of it as the body may turn in one iteration."""
        turn = float(np.linalg.norm(step[self.shape.dim :]))
        return step * (min(1.0, MOST_TURN / turn) if turn > 0.0 else 1.0)

    def _find(self, s: NDArray[np.float64]) -> None:
        """Solve for the balance of the body from some step of it (collective).

        With friction there may be several: starts are left for others only where they lead nowhere,
        or it would leap from one to another as the other bodies move.

        Args:
            s: The step.

        Raises:
            MPMError: It was not found.
        """
        gdim = self.shape.dim
        now = self._put(s)
        norm = self._size_of(now.residual)
        for _ in range(MOST_ITERATIONS):
            if norm <= BALANCED * now.size:
                break
            R = now.residual
            K, _ = self._slopes(now.state, s[gdim:], False)
            inverse, onto = self._inverse(K)
            left = self._size_of(R - onto @ R)
            if left > now.enough:
                s = self._fallen(s, onto @ R - R, left / now.size)
                now = self._put(s)
                norm = self._size_of(now.residual)
                continue
            step = self._turned_at_most(inverse @ R)
            floor = norm <= now.enough
            for _ in range(1 if floor else MOST_HALVINGS):
                tried = self._put(s - step)
                if (found := self._size_of(tried.residual)) < norm:
                    break
                step *= 0.5
            else:
                now = self._put(s)
                break
            slow = floor and found > 0.5 * norm
            s, norm, now = s - step, found, tried
            if slow:
                break
        if not norm <= now.enough:
            raise ConvergenceError(
                f"The forces on a RigidBody do not balance: {norm / now.size:.1e} of them are "
                "left; where it slides or rolls away, hold more of it (fixed=), or give it a mass "
                "in a DynamicProblem"
            )
        self._found, self._trial = s, now.state

    def _fallen(
        self, s: NDArray[np.float64], force: NDArray[np.float64], share: float
    ) -> NDArray[np.float64]:
        """Return where the body touches something, moved along a force that nothing holds.

        It goes on by the least distance of any point, within which there is nothing to touch.

        Raises:
            ConvergenceError: It touches already, or there is nothing on its way (collective).
        """
        way = np.where(self._held, 0.0, force)
        way[self.shape.dim :] = 0.0
        size = float(np.linalg.norm(way))
        extent = max(contact.extent for contact in self.contacts)
        close = max(2.0 * NEAR * self._span, LEAST * float(np.finfo(np.float64).eps) * extent)
        gap, gone = self._least_gap(s), 0.0
        far = 2.0 * (self._span + gap)
        while size > 0.0 and 0.0 < gap and gone < far:
            gone += gap
            s = s + gap / size * way
            before, gap = gap, self._least_gap(s)
            if gap < close:
                return np.asarray(s + (max(gap, 0.0) + close) / size * way)
            if gap > before:
                break
        raise ConvergenceError(
            f"Nothing holds a RigidBody against {share:.1e} of its forces; let it begin in touch, "
            "or give it a mass in a DynamicProblem"
        )

    def _least_gap(self, s: NDArray[np.float64]) -> float:
        """Return the least gap of all points after some step (collective)."""
        pose = self._pose(self._stepped(s))
        with agree(self._comm):
            least = min(contact.least(pose) for contact in self.contacts)
        return float(self._comm.allreduce(least, MPI.MIN))

    def _size_of(self, R: NDArray[np.float64]) -> float:
        """Return the size of a residual in what is free."""
        return float(np.linalg.norm(self._levelled(np.where(self._held, 0.0, R))))

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
        self._number, self._share = number, 1.0
        self._motion.dt, self._motion.whole = None, False
        for contact in self.contacts:
            contact.take_part(number, bodies, materials)
        self._lever = self._span = max([contact.span() for contact in self.contacts])
        gyration = self._motion.gyration
        if gyration is not None:
            self._lever = gyration
        self._begins = True

    @override
    def pace(self, dt: float, share: float) -> None:
        """Begin a step of a motion.

        Raises:
            MPMError: It has no mass.
        """
        if self.mass is None:
            raise MPMError("A RigidBody needs its mass= in a motion.")
        if self._inertia is None and not self._held[-1]:
            raise MPMError(
                "A RigidBody needs its inertia= in a motion, or fixed=['rotation'] where it cannot "
                "turn."
            )
        self._share = share
        self._motion.dt, self._motion.whole = dt, share < 1.0
        for contact in self.contacts:
            contact.pace(dt, share)

    @override
    def begin(self) -> Sequence[PETSc.Vec]:
        """Begin a step.

        Raises:
            ConvergenceError: It is to turn by half a turn or more, which no Cayley vector tells.
        """
        require_same(
            self._comm,
            force=self._push[0],
            moment=self._push[1],
            offset=self._aim.offset,
            angle=self._aim.angle,
        )
        turn = self._aim.angle - self._memory.turn.angle
        if self._held[-1] and len(turn) == 1 and abs(turn[0]) >= np.pi:
            raise ConvergenceError(
                "A RigidBody turns by half a turn or more in one step; turn it by less, on a path "
                "(update=)"
            )
        for contact in self.contacts:
            contact.begin()
        self._begins = True
        self._condensed = Yielding(self.bodies, len(self._held))
        return ()

    @override
    def end_forces(self) -> Sequence[PETSc.Vec]:
        return () if self._share < 1.0 else self.residuals()

    @override
    def step_work(self) -> tuple[float, float]:
        """Return the work of the step; the energy taken up counts as internal."""
        if self._share == 1.0:
            return 0.0, 0.0
        u, theta = np.split(self._found, [self.shape.dim])
        middle = np.mean(self._centres(self._trial), axis=0)

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
    def residuals(self) -> Sequence[PETSc.Vec]:
        return [force for contact in self.contacts for force in contact.residuals()]

    @override
    def tangents(self) -> Mapping[tuple[int, int], PETSc.Mat]:
        """Return the tangents of an obstacle at rest."""
        found = {}
        for place, contact in enumerate(self.contacts):
            for K in contact.tangents().values():
                found[place, place] = K
        self._condense()
        return found

    def _condense(self) -> None:
        """Find what the body adds by yielding (collective)."""
        K, parts = self._slopes(self._trial, self._found[self.shape.dim :], True)
        inverse, _ = self._inverse(K)
        assert self._condensed is not None
        self._condensed.set(self._found, inverse, parts, self._share)

    @override
    def reduced_tangents(self, transfer: Transfer) -> Sequence[PETSc.Mat]:
        """Return the part of the last tangents by yielding."""
        assert self._condensed is not None
        return self._condensed.reduced([transfer(body) for body in self.bodies])

    @override
    def reduced_product(self, motions: Sequence[PETSc.Vec]) -> Sequence[PETSc.Vec]:
        assert self._condensed is not None
        return self._condensed.times(motions)

    @override
    def stiffness_force(self, motions: Sequence[PETSc.Vec]) -> Sequence[PETSc.Vec]:
        forces = [motion.duplicate() for motion in motions]
        for force in forces:
            force.set(0.0)
        for (a, b), K in self.tangents().items():
            K.multAdd(motions[b], forces[a], forces[a])
        for force, more in zip(forces, self.reduced_product(motions), strict=False):
            force.axpy(1.0, more)
        return forces

    @override
    def commit(self) -> Callable[[], None]:
        """Commit the step.

        Raises:
            ConvergenceError: It turns too far for the scheme, or a contact is refused.
        """
        turn = float(np.linalg.norm(self._found[self.shape.dim :]))
        if self._motion.dt is not None and not self._held[-1] and turn > MOST_SPIN:
            raise ConvergenceError(
                f"A RigidBody spins by {turn:.3g} rad in one step, of which the scheme follows "
                f"{MOST_SPIN:g}; take smaller steps"
            )
        before = self._memory
        done: list[Callable[[], None]] = []

        def undo() -> None:
            for back in reversed(done):
                back()
            self._memory = before

        try:
            for contact in self.contacts:
                done.append(contact.commit())
        except BaseException:
            undo()
            raise
        self._memory = self._trial
        return undo

    @override
    def roll_back(self) -> None:
        for contact in self.contacts:
            contact.roll_back()
        self._trial = self._memory
        self._found = np.zeros(len(self._held))
        self._begins = True

    def require_movable(self, consequence: str) -> None:
        """Raise nothing: contact goes with the facets of its bodies."""

    def require_remeshable(self, consequence: str) -> None:
        """Raise nothing: see :meth:`require_movable`."""

    # -- What is kept ---------------------------------------------------------------------------

    @override
    def kept(self) -> Sequence[Kept]:
        of_contacts = self.name or f"contact{self._number}"
        return [
            *(one.remembered(f"{of_contacts}_{i}") for i, one in enumerate(self.contacts)),
            _KeptMotion(self, self.name or f"rigid_body{self._number}"),
        ]

    def numbers(self) -> dict[str, Any]:
        """Return where it is and how it moves, for a checkpoint."""
        values = self._memory._asdict() | {"turn": self._memory.turn.values}
        return {name: value.tolist() for name, value in values.items()} | {
            "push": [part.tolist() for part in self._push],
            "aim": [self._aim.offset.tolist(), self._aim.angle.tolist()],
        }

    def take(self, taken: Taken) -> None:
        """Take what :meth:`numbers` returned."""
        numbers = taken.numbers
        values = {name: np.array(numbers[name], dtype=np.float64) for name in State._fields}
        turn = Turn(values.pop("turn"))
        last = self._memory = self._trial = State(turn=turn, **values)
        force, moment = numbers.get("push", (last.force, last.moment))
        self._push = np.array(force), np.array(moment)
        offset, angle = numbers.get("aim", (last.place, last.turn.angle))
        self._aim = Pose(np.array(offset), np.array(angle))
        self._begins = True


class _KeptMotion(Kept):
    """Where a rigid body is, and how it moves.

    Args:
        body: The rigid body.
        key: See :class:`Kept`.
    """

    def __init__(self, body: RigidBody, key: str) -> None:
        self._body, self.key = body, key

    @override
    def numbers(self) -> dict[str, Any]:
        return self._body.numbers()

    @override
    def restore(self, taken: Taken) -> None:
        self._body.take(taken)
