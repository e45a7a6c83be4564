# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The contact of one body with a rigid one that is put in one place after the other."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, override

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError
from ..particles.particles import Particles
from .law import Friction
from .placed import distance_within, framed
from .rigid import Rigid
from .rotation import Pose, cayley_variation, crossing
from .shapes import Shape
from .surface import global_dofs

__all__ = ["ActingPoints", "BodyContact", "YieldBlocks"]


class ActingPoints(NamedTuple):
    """Points of a contact that touch, and the tractions there.

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


class YieldBlocks(NamedTuple):
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
        particles: The body that deforms.
        shape: That of the rigid body.
        friction: As for :class:`Rigid`.
        **options: As there.
    """

    def __init__(
        self,
        particles: Particles,
        shape: Shape,
        friction: float | Friction,
        **options: Any,
    ) -> None:
        super().__init__(particles, shape, friction, **options)
        if self._nitsche:
            raise MPMError(
                "law='nitsche' is for a Rigid that moves on a path; a RigidBody has the penalty, "
                "by which its forces balance."
            )

    def move(self, offset: Any, angle: Any = 0.0) -> None:
        """Raise an error: the rigid body moves it.

        Raises:
            MPMError: Always.
        """
        raise MPMError("A contact of a RigidBody is moved by it; use move() of the RigidBody.")

    @override
    def _turn(self, last: Pose, pose: Pose) -> float:
        """Return the turn in the step; a vector of rotation in space tells no whole turns."""
        return pose.least_turn_from(last)

    @override
    def begin(self) -> Sequence[PETSc.Vec]:
        """Begin a step; where the rigid body goes is found later."""
        self._settle()
        self._surface.look_at_deleted()
        self._new_pattern()
        self._look_near()
        return ()

    def look(self) -> None:
        """Look where the body is now, for all places in which the shape is tried."""
        self._reach.hold()

    def put(self, pose: Pose) -> None:
        """Evaluate what acts with the shape in some place.

        Args:
            pose: The place.

        Raises:
            MPMError: That cannot be.
        """
        self._pose = self._aim = pose
        self._trial = self._evaluated()

    @override
    def tangents(self) -> Mapping[tuple[int, int], PETSc.Mat]:
        """Return tangents by exact derivatives, as the rigid body's own are."""
        return self.derivatives()

    @property
    def extent(self) -> float:
        """Largest coordinate of the undeformed body."""
        return self._surface.extent

    def span(self) -> float:
        """Return the largest length of the undeformed body along an axis (collective)."""
        x = self.bodies[0].initial_domains.reshape(-1, self._surface.gdim)
        ends = np.concatenate([x.max(axis=0, initial=-np.inf), (-x).max(axis=0, initial=-np.inf)])
        self.bodies[0].mesh.comm.Allreduce(MPI.IN_PLACE, ends, MPI.MAX)
        above, below = np.split(ends, 2)
        return float((above + below).max())

    def total(self, centres: tuple[NDArray[np.float64], ...]) -> NDArray[np.float64]:
        """Return this rank's force and moment on the other body, their size, and their round-off.

        Gaps have the round-off of the body's coordinates.

        Args:
            centres: Centre of the rigid body at the step's beginning and end.

        Returns:
            Force, moment about the centre, size and round-off of the force, ``(gdim + nr + 2,)``.
        """
        assert self._trial is not None
        trial, traction = self._trial, self._trial.outcome.traction
        here = np.flatnonzero(traction.any(axis=(1, 2)))
        which = trial.numbers(here)
        f = self._surface.weights[which, :, None] * traction[here]
        arm = self._arms(here, centres)
        moments = np.einsum("mqij,mqi->j", crossing(arm), f)
        size = np.linalg.norm(f, axis=2).sum()
        k = sum(self._tractions.stiffnesses(which))
        stiffness = float((self._surface.weights[which] * k).sum())
        round_off = np.finfo(np.float64).eps * self._surface.extent * stiffness
        return np.concatenate([f.sum(axis=(0, 1)), moments, [size, round_off]])

    def _arms(
        self, here: NDArray[np.int64], centres: tuple[NDArray[np.float64], ...]
    ) -> NDArray[np.float64]:
        """Return arms from the centre, those of the middle where forces are of whole steps.

        Args:
            here: Places of facets among those that were looked at.
            centres: As for :meth:`total`.
        """
        assert self._trial is not None
        after = self._trial.outcome.positions[here]
        if not self._of_step:
            return after - centres[1]
        before = self._known(self._trial).outcome.positions[here]
        return np.asarray(0.5 * (before - centres[0] + after - centres[1]))

    def works(self, motion: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Any:
        """Return this rank's work of the last step on the rigid body, and what friction has taken.

        Args:
            motion: Returns the motions of the rigid body at arms of the middle.
        """
        assert self._trial is not None
        trial = self._trial
        if trial.step is None:
            return np.zeros(2)
        memory, w = self._known(trial), self._tractions.weights(trial)[:, :, None]
        f = w * trial.outcome.traction
        change = trial.outcome.positions - memory.outcome.positions
        Q = self._tractions.rotation(trial, memory)
        step = trial.step
        normal = (step.pressure[:, None] * step.gradient) @ Q.T
        shear = trial.outcome.traction - normal.reshape(f.shape)
        slid = change - motion(0.5 * change + memory.outcome.positions)
        taken = -float((w * shear * slid).sum())
        return np.array([-float((f * change).sum()) - taken, taken])

    def least(self, pose: Pose) -> float:
        """Return the least gap of this rank's points with the shape in some place."""
        surface = self._surface
        borne = np.flatnonzero((surface.weights > 0.0).any(axis=1))
        x = surface.positions(which=borne)[surface.weights[borne] > 0.0]
        return float(
            distance_within(self.shape, framed(self.shape, pose, x))[0].min(initial=np.inf)
        )

    def energy(self) -> float:
        """Return this rank's energy of penetration at the last converged step."""
        self._outcome()
        assert self._memory is not None
        points, gap = self._tractions.points(self._memory), self._memory.gap.ravel()
        pressed = np.where(gap <= self._surface.touch, gap, 0.0)
        return float(0.5 * self._surface.weights.ravel() @ (points.stiffness * pressed**2))

    def acting(self) -> ActingPoints:
        """Return the points that touch, with their tractions."""
        assert self._trial is not None
        trial, surface = self._trial, self._surface
        memory = self._known(trial)
        here, inside, flat = self._tractions.acting(trial, memory)
        which = trial.numbers(here)
        slopes = np.zeros((len(which), surface.nq, surface.gdim, surface.gdim))
        if len(flat):
            slopes[inside] = self._tractions.derivative_within(trial, memory, flat)
        force = trial.outcome.traction[here]
        return ActingPoints(
            which,
            global_dofs(self.bodies[0].W, surface.nodes[which]),
            surface.shapes,
            surface.weights[which],
            memory.outcome.positions[here],
            trial.outcome.positions[here],
            force,
            np.linalg.solve(self._tractions.rotation(trial, memory), force[..., None])[..., 0],
            slopes,
        )

    def blocks(
        self,
        acting: ActingPoints,
        centres: tuple[NDArray[np.float64], ...],
        theta: NDArray[np.float64],
        on_nodes: bool = True,
    ) -> YieldBlocks:
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
        Q, last = self._tractions.rotation(trial, memory), trial.pose.Q
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
            return YieldBlocks(own, nothing, nothing)
        rows = rigid.swapaxes(2, 3) @ by_x
        rows[:, :, gdim:] -= turning
        N, m, n = acting.shapes, len(arm), len(own)
        by_nodes = np.einsum("qa,mqsi->msai", N, w * rows).reshape(m, n, N.shape[1] * gdim)
        of_nodes = np.einsum("qa,mqis->mais", N, w * by_s).reshape(m, N.shape[1] * gdim, n)
        return YieldBlocks(own, by_nodes, of_nodes)
