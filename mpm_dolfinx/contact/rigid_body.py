# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Rigid bodies that forces drive, in contact with bodies that deform.

A rigid body has the place of its centre of mass X, an orientation Q, a velocity V and a rate of
rotation Omega in its own frame. A step changes them by ``dX`` and a Cayley vector theta (see
:mod:`.rotation`). With tractions f per area on the other bodies at arms r from the centre,

    m (V_1 - V_0) / dt + int f dA = F,
    (Q_1 J Omega_1 - Q_0 J Omega_0) / dt + int r x f dA = M

hold, where V_1 = 2 dX/dt - V_0 and Omega_1 = 2 Q_0^T theta / dt - Omega_0, and f and r are those of
the step's middle; or V_1 = dX/dt, Omega_1 = Q_0^T theta / dt, and those of its end
(``"euler"``); or, in equilibrium, without mass.

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
from typing import Any, NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..assembly.petsc import MatrixSum
from ..errors import ConvergenceError, MPMError, agree
from ..io.snapshot import Kept, Taken
from ..parallel.given import require_same
from ..particles.particles import Particles
from ..system.term import PointMaterial, Term, Transfer
from .law import Coulomb
from .rigid import Placed, Rigid
from .rotation import Pose, Turn, cayley_variation, crossing
from .shapes import Shape, as_point, as_positive
from .surface import Blocks, PointMatrix, global_dofs

__all__ = ["RigidBody"]

#: Residual of the balance of a rigid body, relative to its forces, that is round-off, and that is
#: good enough where it falls no further.
BALANCED, AT_ROUND_OFF = 1e-14, 1e-9
#: Most iterations, and most halvings of one of them.
MOST_ITERATIONS, MOST_HALVINGS = 60, 12
#: Stiffness, relative to the largest, below which nothing holds a body.
LOOSE = 1e-11
#: Gap, over twice the largest coordinate, to which a body without a hold falls.
NEAR = 1e-7
#: Most that a body turns in one iteration.
MOST_TURN = 0.5

NAMES = ("x", "y", "z")
TURNS = "rotation"


class _State(NamedTuple):
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


class _Acting(NamedTuple):
    """What a contact tells of the points that touch.

    Attributes:
        facets: Numbers of their facets, shape ``(n,)``.
        dofs: Global dofs of these, shape ``(n, k gdim)``.
        shapes: Shape functions of nodes at points, shape ``(nq, k)``.
        weights: Shape ``(n, nq)``.
        before: Positions at the step's beginning, shape ``(n, nq, gdim)``.
        after: At its end.
        force: Tractions.
        within: Tractions in the frame of the shape.
        slopes: Their derivatives by coordinates there, shape ``(n, nq, gdim, gdim)``.
    """

    facets: NDArray[np.int64]
    dofs: NDArray[np.int64]
    shapes: NDArray[np.float64]
    weights: NDArray[np.float64]
    before: NDArray[np.float64]
    after: NDArray[np.float64]
    force: NDArray[np.float64]
    within: NDArray[np.float64]
    slopes: NDArray[np.float64]


class _Blocks(NamedTuple):
    """Derivatives that a contact adds, s being a step ``(dX, theta)`` of the rigid body.

    Attributes:
        own: Of the rigid body's balance by s, ``(n, n)``.
        by_nodes: Of the balance by nodes of the other body, ``(m, n, k gdim)``.
        of_nodes: Of tractions on these nodes by s, ``(m, k gdim, n)``.
    """

    own: NDArray[np.float64]
    by_nodes: NDArray[np.float64]
    of_nodes: NDArray[np.float64]


class BodyContact(Rigid):
    """The contact of one body with a rigid one that is where it is put.

    Args:
        place: Its number among the contacts of the rigid body.
        particles: The body that deforms.
        shape: That of the rigid body.
        friction: As for :class:`Rigid`.
        **options: As there.
    """

    def __init__(
        self,
        place: int,
        particles: Particles,
        shape: Shape,
        friction: float | Coulomb,
        **options: Any,
    ) -> None:
        super().__init__(particles, shape, friction, **options)
        if self._nitsche:
            raise MPMError(
                "law='nitsche' is for a Rigid that moves on a path; a RigidBody has the penalty, "
                "by which its forces balance."
            )
        self._place = place
        self._seen: tuple[float, NDArray[np.float64]] | None = None

    @property
    def _key(self) -> str:
        """See :class:`Contact`."""
        return f"contact{self._number}_{self._place}"

    def move(self, offset: Any, angle: Any = 0.0) -> None:
        """Raise an error: the rigid body moves it.

        Raises:
            MPMError: Always.
        """
        raise MPMError("A contact of a RigidBody is moved by it; use move() of the RigidBody.")

    def begin(self) -> Sequence[PETSc.Vec]:
        """See :meth:`Term.begin`; where the rigid body goes is found out later."""
        self._settle()
        self._surface.look_at_deleted()
        self._new_pattern()
        self._look_near()
        self._seen = None
        return ()

    def look(self) -> None:
        """Look where the body is now, for all places in which the shape is tried."""
        self._seen = None
        if self._near is not None:
            near = self._near
            self._seen = super()._largest_change(near), self._surface.positions(which=near.which)

    def _largest_change(self, near: Any) -> float:
        """See :class:`Rigid`."""
        return super()._largest_change(near) if self._seen is None else self._seen[0]

    def _positions(self, which: NDArray[np.int64] | None) -> NDArray[np.float64]:
        """See :class:`Rigid`."""
        seen = None if which is None else self._seen
        return super()._positions(which) if seen is None else seen[1]

    def put(self, pose: Pose, whole: bool = False) -> None:
        """Evaluate what acts with the shape in some place.

        Args:
            pose: The place.
            whole: Whether gaps are asked for that are too wide to matter.

        Raises:
            MPMError: That cannot be.
        """
        self._pose = self._aim = pose
        self._trial = self._evaluated(whole)

    @property
    def extent(self) -> float:
        """Largest coordinate of the undeformed body."""
        return self._surface.extent

    def total(self, centres: tuple[NDArray[np.float64], ...]) -> NDArray[np.float64]:
        """Return this rank's force and moment on the other body, and the size of both.

        Args:
            centres: Centre of the rigid body at the step's beginning and end.

        Returns:
            Force, moment about the centre, size of the force: shape ``(gdim + nr + 1,)``.
        """
        assert self._trial is not None
        outcome = self._trial.outcome
        which = np.flatnonzero(outcome.traction.any(axis=(1, 2)))
        f = self._surface.weights[which, :, None] * outcome.traction[which]
        arm = self._arms(which, centres)
        moments = np.einsum("mqij,mqi->j", crossing(arm), f)
        size = np.linalg.norm(f, axis=2).sum()
        return np.concatenate([f.sum(axis=(0, 1)), moments, [size]])

    def _arms(
        self, which: NDArray[np.int64], centres: tuple[NDArray[np.float64], ...]
    ) -> NDArray[np.float64]:
        """Return arms from the centre, those of the middle where forces are of whole steps."""
        assert self._memory is not None and self._trial is not None
        after = self._trial.outcome.positions[which]
        if not self._of_step:
            return after - centres[1]
        before = self._memory.outcome.positions[which]
        return np.asarray(0.5 * (before - centres[0] + after - centres[1]))

    def works(self, motion: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Any:
        """Return this rank's work of the last step on the rigid body, and what friction has taken.

        Args:
            motion: Returns the motions of the rigid body at arms of the middle.
        """
        assert self._trial is not None and self._memory is not None
        surface, trial = self._surface, self._trial
        if trial.step is None:
            return np.zeros(2)
        f = surface.weights[:, :, None] * trial.outcome.traction
        change = trial.outcome.positions - self._memory.outcome.positions
        Q = self._rotation(trial, self._memory)
        step = trial.step
        normal = (step.pressure[:, None] * step.gradient) @ Q.T
        shear = trial.outcome.traction - normal.reshape(f.shape)
        slid = change - motion(0.5 * change + self._memory.outcome.positions)
        taken = -float((surface.weights[:, :, None] * shear * slid).sum())
        return np.array([-float((f * change).sum()) - taken, taken])

    def least(self) -> float:
        """Return the least gap of this rank's points, as they were evaluated last."""
        assert self._trial is not None
        trial = self._exact(self._trial) if self.shape.costly else self._trial
        return float(trial.gap[self._surface.weights > 0.0].min(initial=np.inf))

    def energy(self) -> float:
        """Return this rank's energy of penetration at the last converged step."""
        self._outcome()
        assert self._memory is not None
        points, gap = self._points(self._memory), self._memory.gap.ravel()
        pressed = np.where(gap <= self._surface.touch, gap, 0.0)
        return float(0.5 * self._surface.weights.ravel() @ (points.stiffness * pressed**2))

    def acting(self) -> _Acting:
        """Return what there is at the points that touch."""
        trial, memory, surface = self._trial, self._memory, self._surface
        assert trial is not None and memory is not None
        which, inside, flat = self._acting(trial, memory)
        slopes = np.zeros((len(which), surface.nq, surface.gdim, surface.gdim))
        if len(flat):
            slopes[inside] = self._derivative_within(trial, memory, flat)
        force = trial.outcome.traction[which]
        return _Acting(
            which,
            global_dofs(self.bodies[0].W, surface.nodes[which]),
            surface.shapes,
            surface.weights[which],
            memory.outcome.positions[which],
            trial.outcome.positions[which],
            force,
            np.linalg.solve(self._rotation(trial, memory), force[..., None])[..., 0],
            slopes,
        )

    def blocks(
        self,
        acting: _Acting,
        centres: tuple[NDArray[np.float64], ...],
        theta: NDArray[np.float64],
        on_nodes: bool = True,
    ) -> _Blocks:
        """Return the derivatives by a step of the rigid body.

        Args:
            acting: What :meth:`acting` has returned.
            centres: As for :meth:`total`.
            theta: Cayley vector of the step.
            on_nodes: Whether those by and of nodes are asked for.
        """
        trial, memory = self._trial, self._memory
        assert trial is not None and memory is not None
        gdim, share = acting.force.shape[2], 0.5 if self._of_step else 1.0
        Q, last = self._rotation(trial, memory), trial.pose.Q
        H = cayley_variation(theta)
        arm = acting.after - centres[1]
        middle = 0.5 * (acting.before - centres[0] + arm) if self._of_step else arm
        here = np.broadcast_to(np.eye(gdim), (*arm.shape, gdim))
        by_x = Q @ acting.slopes @ last.T
        by_s = -by_x @ np.concatenate([here, crossing(arm) @ H], axis=3)
        by_s[..., gdim:] += share * crossing(acting.within @ last.T) @ H
        rigid = np.concatenate([here, crossing(middle)], axis=3)
        w = acting.weights[:, :, None, None]
        turning = share * crossing(acting.force).swapaxes(2, 3)
        own = (w * (rigid.swapaxes(2, 3) @ by_s)).sum(axis=(0, 1))
        own[gdim:, :gdim] += (w * turning).sum(axis=(0, 1))
        if not on_nodes:
            nothing = np.zeros((0, 0, 0))
            return _Blocks(own, nothing, nothing)
        rows = rigid.swapaxes(2, 3) @ by_x
        rows[:, :, gdim:] -= turning
        N, m, n = acting.shapes, len(arm), len(own)
        by_nodes = np.einsum("qa,mqsi->msai", N, w * rows).reshape(m, n, N.shape[1] * gdim)
        of_nodes = np.einsum("qa,mqis->mais", N, w * by_s).reshape(m, N.shape[1] * gdim, n)
        return _Blocks(own, by_nodes, of_nodes)


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
        friction: Coefficient of friction, or a :class:`Coulomb` with cohesion and a limit.
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

    def __init__(
        self,
        particles: Particles | Sequence[Particles],
        shape: Shape,
        mass: float | None = None,
        *,
        inertia: Any = None,
        centre: Any = None,
        friction: float | Coulomb = 0.0,
        gravity: Any = None,
        velocity: Any = None,
        spin: Any = None,
        fixed: Sequence[str] = (),
        **options: Any,
    ) -> None:
        bodies: list[Any] = list(particles) if isinstance(particles, list | tuple) else [particles]
        if not bodies:
            raise MPMError("A RigidBody needs one body of mpm.Particles or more.")
        self.contacts = [
            BodyContact(place, body, shape, friction, **options)
            for place, body in enumerate(bodies)
        ]
        if any(one is other for i, one in enumerate(bodies) for other in bodies[:i]):
            raise MPMError("A RigidBody needs bodies that differ, not the same one twice.")
        super().__init__(bodies)
        gdim = shape.dim
        self.axisymmetric = self.contacts[0].axisymmetric
        self.shape = shape
        self.mass = None if mass is None else as_positive(mass, "mass")
        nr = 1 if gdim == 2 else 3
        self._held = _held(fixed, gdim, bool(self.axisymmetric))
        self._inertia = None if inertia is None else _as_inertia(inertia, gdim)
        self._centre = shape.pivot.copy() if centre is None else as_point(centre, "centre", gdim)
        self._gravity = np.zeros(gdim) if gravity is None else as_point(gravity, "gravity", gdim)
        if gravity is not None and self.mass is None:
            raise MPMError("gravity= of a RigidBody needs its mass=.")
        still = _State(
            np.zeros(gdim),
            Turn.none(gdim),
            np.zeros(gdim) if velocity is None else as_point(velocity, "velocity", gdim),
            np.zeros(nr) if spin is None else _as_rotation(spin, "spin", gdim),
            np.zeros(gdim),
            np.zeros(nr),
        )
        self._comm = bodies[0].mesh.comm
        require_same(
            self._comm,
            mass=mass,
            inertia=self._inertia,
            centre=self._centre,
            gravity=self._gravity,
            velocity=still.velocity,
            spin=still.spin,
            fixed=[name for name, held in zip(_names(gdim), self._held, strict=False) if held],
        )
        self._memory = self._trial = still
        self._found = np.zeros(gdim + nr)
        self._lever = 1.0
        self._aim = Pose(np.zeros(gdim), np.zeros(nr))
        self._push = still.force, still.moment
        self._dt: float | None = None
        self._share = 1.0
        self._number = 0
        self._condensed: _Condensed | None = None
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
        self._push = as_point(force, "force", gdim), _as_rotation(moment, "moment", gdim)

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
        self._aim = Pose(as_point(offset, "offset", gdim), _as_rotation(angle, "angle", gdim))

    # -- What it tells, at the last converged step ----------------------------------------------

    @property
    def centre(self) -> NDArray[np.float64]:
        """Place of its centre, shape ``(gdim,)``."""
        return np.asarray(self._centre + self._memory.place)

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
        return state.spin.copy() if len(state.spin) == 1 else self._Q(state) @ state.spin

    @property
    def kinetic_energy(self) -> float:
        """Kinetic energy."""
        state = self._memory
        turning = 0.5 * float(state.spin @ self._J @ state.spin)
        return 0.5 * self._m * float(state.velocity @ state.velocity) + turning

    @property
    def potential_energy(self) -> float:
        """Energy in the field of gravity, zero at the beginning."""
        return -self._m * float(self._gravity @ self._memory.place)

    @property
    def contact_energy(self) -> float:
        """Energy of penetration of all contacts (collective)."""
        own = sum(contact.energy() for contact in self.contacts)
        return float(self._comm.allreduce(own))

    @property
    def momentum(self) -> NDArray[np.float64]:
        """Momentum, shape ``(gdim,)``."""
        return self._m * self._memory.velocity

    @property
    def angular_momentum(self) -> NDArray[np.float64]:
        """Angular momentum about the origin, ``(1,)`` or ``(3,)``."""
        state = self._memory
        turning = self._J @ state.spin
        if len(turning) == 3:
            turning = self._Q(state) @ turning
        return np.asarray(turning + crossing(self.centre).T @ self.momentum)

    @property
    def reaction(self) -> NDArray[np.float64]:
        """Force on the bodies that it touches, shape ``(gdim,)`` (collective)."""
        return np.asarray(np.sum([contact.reaction for contact in self.contacts], axis=0))

    def placed(self) -> Placed:
        """Return its shape where it is now; it does not follow when this one moves."""
        return self.contacts[0].placed()

    # -- Its balance ------------------------------------------------------------------------------

    @property
    def _m(self) -> float:
        return 0.0 if self.mass is None else self.mass

    @property
    def _J(self) -> NDArray[np.float64]:
        nr = len(self._memory.spin)
        return np.zeros((nr, nr)) if self._inertia is None else self._inertia

    @staticmethod
    def _Q(state: _State) -> NDArray[np.float64]:
        return Pose(state.place, state.turn.angle).Q

    def _pose(self, state: _State) -> Pose:
        """Return where the shape is, which turns about its pivot, and not about the centre."""
        arm = self.shape.pivot - self._centre
        angle = state.turn.angle
        return Pose(state.place + self._Q(state) @ arm - arm, angle)

    def _stepped(self, s: NDArray[np.float64]) -> _State:
        """Return where a step of the unknowns leads to from the last converged place."""
        last, gdim = self._memory, self.shape.dim
        u, theta = s[:gdim], s[gdim:]
        velocity, spin = last.velocity, last.spin
        if self._dt is not None:
            # (what follows a path has the mean of the step, or a jump of it would swing for ever)
            c = np.where(self._held, 1.0, 2.0 if self._share < 1.0 else 1.0)
            velocity = c[:gdim] * u / self._dt - (c[:gdim] - 1.0) * velocity
            turn = Turn.none(gdim).turned(theta).angle if self._held[-1] else theta
            own = turn if gdim == 2 else self._Q(last).T @ turn
            spin = c[gdim:] * own / self._dt - (c[gdim:] - 1.0) * spin
        return _State(last.place + u, last.turn.turned(theta), velocity, spin, *self._push)

    def _centres(self, state: _State) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return self._centre + self._memory.place, self._centre + state.place

    def _given(self) -> NDArray[np.float64]:
        """Return force and moment on it in the step, besides those of contact."""
        force, moment = self._push
        if self._share < 1.0:
            force = 0.5 * (force + self._memory.force)
            moment = 0.5 * (moment + self._memory.moment)
        return np.concatenate([force + self._m * self._gravity, moment])

    def _inertial(self, state: _State) -> NDArray[np.float64]:
        """Return the forces of inertia over a step."""
        last = self._memory
        if self._dt is None:
            return np.zeros(len(state.place) + len(state.spin))
        before, after = (self._J @ s.spin for s in (last, state))
        if len(before) == 3:
            before, after = self._Q(last) @ before, self._Q(state) @ after
        linear = self._m * (state.velocity - last.velocity)
        return np.concatenate([linear, after - before]) / self._dt

    def _inertial_slopes(self, state: _State, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return their derivatives by the unknowns."""
        gdim, nr = len(state.place), len(theta)
        K = np.zeros((gdim + nr, gdim + nr))
        if self._dt is None:
            return K
        c = 2.0 if self._share < 1.0 else 1.0
        K[:gdim, :gdim] = c * self._m / self._dt**2 * np.eye(gdim)
        if nr == 1:
            K[gdim:, gdim:] = c * self._J / self._dt**2
            return K
        Q, J = self._Q(state), self._J
        K[gdim:, gdim:] = crossing(Q @ J @ state.spin) @ cayley_variation(theta) / self._dt
        K[gdim:, gdim:] += c * Q @ J @ self._Q(self._memory).T / self._dt**2
        return K

    def _put(self, s: NDArray[np.float64]) -> tuple[NDArray[np.float64], float, _State]:
        """Put the body somewhere; return its residual, the size of its forces, and its state.

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
        given, inertial = self._given(), self._inertial(state)
        size = float(total[-1]) + sum(
            float(np.linalg.norm(self._levelled(part))) for part in (given, inertial)
        )
        if self._dt is not None:
            c = 2.0 / self._dt
            size += c * self._m * float(np.linalg.norm(self._memory.velocity))
        return inertial + total[:-1] - given, size, state

    def _levelled(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return forces, and moments over the length that they are compared by."""
        gdim = self.shape.dim
        return np.concatenate([forces[:gdim], forces[gdim:] / self._lever])

    def _slopes(
        self, state: _State, theta: NDArray[np.float64], on_nodes: bool
    ) -> tuple[NDArray[Any], list[Any]]:
        """Return the derivative of the balance by s, and what contacts have (collective)."""
        centres, n = self._centres(state), len(state.place) + len(theta)
        parts, own = [], np.zeros((n, n))
        for contact in self.contacts:
            acting = contact.acting()
            blocks = contact.blocks(acting, centres, theta, on_nodes)
            parts.append((acting, blocks))
            own += blocks.own
        K = self._comm.allreduce(own) + self._inertial_slopes(state, theta)
        return K, parts

    def _inverse(self, K: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the inverse of a tangent, where it has one, and the projector on its range.

        Nothing is in the rows of what is fixed. Directions without any stiffness are left out.
        """
        free = ~self._held
        scale = np.where(np.arange(len(K)) < self.shape.dim, 1.0, self._lever)[free]
        A = K[np.ix_(free, free)] / scale[:, None] / scale
        U, sizes, V = np.linalg.svd(A)
        kept = sizes > LOOSE * sizes.max(initial=0.0) if sizes.max(initial=0.0) > 0.0 else sizes > 0
        inverse, onto = np.zeros_like(K), np.zeros_like(K)
        inner = (V[kept].T / sizes[kept]) @ U[:, kept].T
        inverse[np.ix_(free, free)] = inner / scale[:, None] / scale
        onto[np.ix_(free, free)] = scale[:, None] * (U[:, kept] @ U[:, kept].T) / scale
        return inverse, onto

    def _guess(self) -> NDArray[np.float64]:
        """Return the unknowns to begin with, those that are fixed as they are to be."""
        last, gdim = self._memory, self.shape.dim
        s = np.zeros(gdim + len(last.spin))
        if self._dt is not None:
            s[:gdim] = self._dt * last.velocity
            s[gdim:] = self._dt * (last.spin if gdim == 2 else self._Q(last) @ last.spin)
        path = np.concatenate([self._aim.offset - last.place, s[gdim:]])
        path[gdim:] = last.turn.cayley_to(Turn.of(self._aim.angle)) if self._held[-1] else 0.0
        return np.where(self._held, path, s)

    def update(self) -> MPMError | None:
        """See :meth:`Term.update`: find where the body is for what the others have."""
        for contact in self.contacts:
            contact.look()
        starts = [self._guess()]
        if not self._begins:
            assert self._condensed is not None
            starts = [*self._condensed.followed(), self._found, *starts]
        failure: MPMError | None = None
        for s in starts:
            try:
                self._find(s)
                self._begins = False
                return None
            except MPMError as error:
                failure = error
        return failure

    def _find(self, s: NDArray[np.float64]) -> None:
        """Solve for the balance of the body from some step of it (collective)."""
        gdim = self.shape.dim
        R, size, state = self._put(s)
        norm = self._size_of(R)
        for _ in range(MOST_ITERATIONS):
            if norm <= BALANCED * size:
                break
            K, _ = self._slopes(state, s[gdim:], False)
            inverse, onto = self._inverse(K)
            left = self._size_of(R - onto @ R)
            if left > AT_ROUND_OFF * size:
                s = self._fallen(s, onto @ R - R, left / size)
                R, size, state = self._put(s)
                norm = self._size_of(R)
                continue
            step = inverse @ R
            turn = float(np.linalg.norm(step[gdim:]))
            step *= min(1.0, MOST_TURN / turn) if turn > 0.0 else 1.0
            floor = norm <= AT_ROUND_OFF * size
            for _ in range(1 if floor else MOST_HALVINGS):
                tried = self._put(s - step)
                if (found := self._size_of(tried[0])) < norm:
                    break
                step *= 0.5
            else:
                R, size, state = self._put(s)
                break
            slow = floor and found > 0.5 * norm
            s, norm = s - step, found
            R, size, state = tried
            if slow:
                break
        if not norm <= AT_ROUND_OFF * size:
            raise ConvergenceError(
                f"The forces on a RigidBody do not balance: {norm / size:.1e} of them are left"
            )
        self._found, self._trial = s, state

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
        far = 2.0 * max(contact.extent for contact in self.contacts)
        gap, gone = self._least_gap(s), 0.0
        while size > 0.0 and 0.0 < gap and gone < far:
            gone += gap
            s = s + gap / size * way
            before, gap = gap, self._least_gap(s)
            if gap < NEAR * far:
                return np.asarray(s + (max(gap, 0.0) + NEAR * far) / size * way)
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
            for contact in self.contacts:
                contact.put(pose, whole=True)
        gaps = [contact.least() for contact in self.contacts]
        return float(self._comm.allreduce(min(gaps), MPI.MIN))

    def _size_of(self, R: NDArray[np.float64]) -> float:
        """Return the size of a residual in what is free."""
        return float(np.linalg.norm(self._levelled(np.where(self._held, 0.0, R))))

    # -- The term -------------------------------------------------------------------------------

    def take_part(
        self,
        number: int,
        bodies: Sequence[Particles],
        materials: Sequence[PointMaterial | None],
    ) -> None:
        """See :meth:`Term.take_part`."""
        self._number, self._dt, self._share = number, None, 1.0
        for contact in self.contacts:
            contact.take_part(number, bodies, materials)
        self._lever = max(contact.extent for contact in self.contacts)
        if self._inertia is not None and self.mass is not None:
            gyration = np.sqrt(np.trace(self._inertia) / len(self._inertia) / self.mass)
            self._lever = float(gyration)
        self._begins = True

    def pace(self, dt: float, share: float) -> None:
        """See :meth:`Term.pace`.

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
        self._dt, self._share = dt, share
        for contact in self.contacts:
            contact.pace(dt, share)

    def begin(self) -> Sequence[PETSc.Vec]:
        """See :meth:`Term.begin`.

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
        self._condensed = _Condensed(self.bodies, len(self._held))
        return ()

    def end_forces(self) -> Sequence[PETSc.Vec]:
        """See :meth:`Term.end_forces`."""
        return () if self._share < 1.0 else self.residuals()

    def step_work(self) -> tuple[float, float]:
        """See :meth:`Term.step_work`: what it has taken up counts as internal."""
        if self._share == 1.0:
            return 0.0, 0.0
        u, theta = np.split(self._found, [self.shape.dim])
        middle = np.mean(self._centres(self._trial), axis=0)

        def motion(x: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray(u + crossing(x - middle) @ theta)

        own = np.sum([contact.works(motion) for contact in self.contacts], axis=0)
        taken_up, damped = self._comm.allreduce(own)
        return float(taken_up), float(damped)

    def smooth(self) -> bool:
        """See :meth:`Term.smooth`: contact is not."""
        return all([contact.smooth() for contact in self.contacts])

    def residuals(self) -> Sequence[PETSc.Vec]:
        """See :meth:`Term.residuals`."""
        return [force for contact in self.contacts for force in contact.residuals()]

    def tangents(self) -> Mapping[tuple[int, int], PETSc.Mat]:
        """See :meth:`Term.tangents`: those of an obstacle at rest."""
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

    def reduced_tangents(self, transfer: Transfer) -> Sequence[PETSc.Mat]:
        """See :meth:`Term.reduced_tangents`: what it adds by yielding, for the last tangents."""
        assert self._condensed is not None
        return self._condensed.reduced([transfer(body) for body in self.bodies])

    def reduced_product(self, motions: Sequence[PETSc.Vec]) -> Sequence[PETSc.Vec]:
        """See :meth:`Term.reduced_product`."""
        assert self._condensed is not None
        return self._condensed.times(motions)

    def stiffness_force(self, motions: Sequence[PETSc.Vec]) -> Sequence[PETSc.Vec]:
        """See :meth:`Term.stiffness_force`."""
        forces = [motion.duplicate() for motion in motions]
        for force in forces:
            force.set(0.0)
        for (a, b), K in self.tangents().items():
            K.multAdd(motions[b], forces[a], forces[a])
        for force, more in zip(forces, self.reduced_product(motions), strict=False):
            force.axpy(1.0, more)
        return forces

    def commit(self) -> Callable[[], None]:
        """See :meth:`Term.commit`."""
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

    def roll_back(self) -> None:
        """See :meth:`Term.roll_back`."""
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

    def kept(self) -> Sequence[Kept]:
        """See :meth:`Term.kept`."""
        own = _KeptMotion(self, f"rigid_body{self._number}")
        return [*(kept for contact in self.contacts for kept in contact.kept()), own]

    def numbers(self) -> dict[str, Any]:
        """Return where it is and how it moves, for a checkpoint."""
        values = self._memory._asdict() | {"turn": self._memory.turn.values}
        return {name: value.tolist() for name, value in values.items()}

    def take(self, taken: Taken) -> None:
        """Take what :meth:`numbers` returned."""
        values = {name: np.array(v, dtype=np.float64) for name, v in taken.numbers.items()}
        turn = Turn(values.pop("turn"))
        self._memory = self._trial = _State(turn=turn, **values)
        self._push = self._memory.force, self._memory.moment
        self._aim = Pose(self._memory.place, self._memory.turn.angle)
        self._begins = True


class _KeptMotion(Kept):
    """Where a rigid body is, and how it moves.

    Args:
        body: The rigid body.
        key: See :class:`Kept`.
    """

    def __init__(self, body: RigidBody, key: str) -> None:
        self._body, self.key = body, key

    def numbers(self) -> dict[str, Any]:
        """See :class:`Kept`."""
        return self._body.numbers()

    def restore(self, taken: Taken) -> None:
        """See :class:`Kept`."""
        self._body.take(taken)


class _Condensed:
    """What a rigid body adds to a tangent by yielding, ``sum_ab L_a^T R_b`` on W of the bodies.

    Args:
        bodies: The bodies that it touches.
        count: Number of its unknowns.
    """

    def __init__(self, bodies: Sequence[Particles], count: int) -> None:
        self._left, self._right = (
            [PointMatrix(count, body.W) for body in bodies] for _ in range(2)
        )
        self._bodies = bodies
        self._at: tuple[NDArray[np.float64], list[NDArray[np.float64]]] | None = None
        self._factors: list[list[PETSc.Mat | None]] = [[], []]
        self._sums = MatrixSum(), MatrixSum()
        self._reduced: dict[tuple[int, int], tuple[PETSc.Mat, PETSc.Mat, PETSc.Mat]] = {}
        self._product: tuple[PETSc.Mat, PETSc.Mat, PETSc.Mat] | None = None

    def set(
        self,
        s: NDArray[np.float64],
        inverse: NDArray[np.float64],
        parts: Sequence[tuple[_Acting, _Blocks]],
        share: float,
    ) -> None:
        """Take derivatives at the present positions, where s balances the body (collective)."""
        self._at = s, [np.array(body.displacement.x.array) for body in self._bodies]
        rows = np.arange(len(inverse))
        self._factors = [[], []]
        for place, (acting, blocks) in enumerate(parts):
            keys = acting.facets[:, None]
            here = np.broadcast_to(rows, (len(keys), len(rows)))
            left = blocks.of_nodes.swapaxes(1, 2) / share
            for side, matrix, values in (
                (0, self._left[place], left),
                (1, self._right[place], inverse @ blocks.by_nodes),
            ):
                factor = matrix.of([Blocks(keys, here, acting.dofs, values)])
                self._factors[side].append(factor)

    def followed(self) -> list[NDArray[np.float64]]:
        """Return how the body would follow to the present positions, if that is known (collective).

        By the last derivatives: where a Newton step is good, that is where it is to be looked for.
        """
        if self._at is None:
            return []
        s, before = self._at
        total = self._yielding(
            [
                None if factor is None else _changed(factor, body, d)
                for factor, body, d in zip(self._factors[1], self._bodies, before, strict=True)
            ]
        )
        if total is None:
            return []
        own = total.array_r.copy()
        return [s - self._bodies[0].mesh.comm.bcast(own)]

    def _yielding(self, motions: Sequence[PETSc.Vec | None]) -> PETSc.Vec | None:
        """Return how the body follows displacements on W of all bodies, with the other sign."""
        total: PETSc.Vec | None = None
        for factor, motion in zip(self._factors[1], motions, strict=False):
            if factor is not None and motion is not None:
                part = factor.createVecLeft()
                factor.mult(motion, part)
                total = part if total is None else total + part
        return total

    def times(self, motions: Sequence[PETSc.Vec]) -> Sequence[PETSc.Vec]:
        """Return the product with displacements on W of all bodies (collective)."""
        total = self._yielding(motions)
        if total is None:
            return ()
        forces = []
        for factor, motion in zip(self._factors[0], motions, strict=True):
            force = motion.duplicate()
            force.set(0.0)
            if factor is not None:
                factor.multTranspose(total, force)
            forces.append(force)
        return forces

    def reduced(self, transfers: Sequence[PETSc.Mat]) -> Sequence[PETSc.Mat]:
        """Return the part in all unknowns, the same object for the same pattern (collective).

        Args:
            transfers: T of each body.
        """
        sums = []
        for side, factors in enumerate(self._factors):
            found = [
                self._times_transfer(side, place, factor, T)
                for place, (factor, T) in enumerate(zip(factors, transfers, strict=False))
                if factor is not None
            ]
            if not found:
                return ()
            sums.append(self._sums[side].of(found))
        left, right = sums
        known = self._product
        same = known is not None and known[0] is left and known[1] is right
        result = left.transposeMatMult(right, result=known[2] if same and known else None)
        self._product = left, right, result
        return [result]

    def _times_transfer(self, side: int, place: int, factor: PETSc.Mat, T: PETSc.Mat) -> PETSc.Mat:
        known = self._reduced.get((side, place))
        same = known is not None and known[0] is factor and known[1] is T
        product = factor.matMult(T, result=known[2] if same and known else None)
        self._reduced[side, place] = factor, T, product
        return product


def _changed(factor: PETSc.Mat, body: Particles, before: NDArray[np.float64]) -> PETSc.Vec:
    """Return how a body has been displaced since its displacements were others."""
    change = factor.createVecRight()
    own = slice(0, change.getLocalSize())
    change.array_w[:] = body.displacement.x.array[own] - before[own]
    return change


def _names(gdim: int) -> list[str]:
    """Return the names of what a rigid body can do; all of its rotations have one."""
    return [*NAMES[:gdim], TURNS]


def _held(fixed: Any, gdim: int, axisymmetric: bool) -> NDArray[np.bool_]:
    """Return which of the unknowns of a rigid body follow a path.

    Raises:
        MPMError: Names that are none.
    """
    names = _names(gdim)
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


def _as_rotation(value: Any, name: str, gdim: int) -> NDArray[np.float64]:
    """Return a number ``(1,)``, or a vector in space; a zero is none of either.

    Raises:
        MPMError: It is something else.
    """
    count = 1 if gdim == 2 else 3
    try:
        found = np.atleast_1d(np.array(value, dtype=np.float64))
    except (TypeError, ValueError):
        found = np.zeros(0)
    if count == 3 and found.shape == (1,) and found[0] == 0.0:
        found = np.zeros(3)
    if found.shape != (count,) or not np.isfinite(found).all():
        raise MPMError(f"{name} of a RigidBody must be {_finite(count)}, not {_shown(value)}.")
    return found


def _finite(count: int) -> str:
    """Return how many numbers are asked for, in words."""
    return "a finite number" if count == 1 else f"{count} finite numbers"


def _shown(value: Any) -> str:
    """Return what was given, on one line."""
    return " ".join(repr(value).split())


def _as_inertia(value: Any, gdim: int) -> NDArray[np.float64]:
    """Return a moment of inertia ``(1, 1)``, or a tensor ``(3, 3)``.

    Raises:
        MPMError: It is none: not symmetric, or not positive.
    """
    try:
        found = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        found = np.zeros(0)
    count = 1 if gdim == 2 else 3
    if found.shape == ():
        found = found * np.eye(count)
    good = found.shape == (count, count) and bool(np.isfinite(found).all())
    good = good and not isinstance(value, bool)
    if not good or np.abs(found - found.T).max() > 1e-12 * np.abs(found).max():
        raise MPMError(
            f"inertia of a RigidBody must be a number{'' if gdim == 2 else ' or (3, 3) numbers'}, "
            f"not {_shown(value)}."
        )
    if not np.linalg.eigvalsh(found).min() > 0.0:
        raise MPMError(f"inertia of a RigidBody must be positive, not {_shown(value)}.")
    return found
