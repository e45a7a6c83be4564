# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The contact of one body with a rigid one that is put in one place after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, override

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError
from ..particles.particles import Particles
from .law import Friction
from .placed import distance_within, framed
from .rigid import Rigid, Slopes
from .rotation import Pose, cayley_variation, crossing
from .shapes import Shape
from .surface import Blocks, PointMatrix

__all__ = ["BodyContact", "Coupled"]


class Coupled(NamedTuple):
    """Tangents of a contact, by the unknowns of the rigid body too.

    Attributes:
        nodes: Of forces on nodes by nodes.
        of_motion: Of forces and moments on the rigid body by nodes; ``None``: none yet, as above.
        by_motion: Of forces on nodes by unknowns of the rigid body.
        own: Of forces and moments on the rigid body by its step, of this rank, ``(n, n)``.
    """

    nodes: PETSc.Mat | None
    of_motion: PETSc.Mat | None
    by_motion: PETSc.Mat | None
    own: NDArray[np.float64]


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

    def couple(self, layout: tuple[int, int]) -> None:
        """Take how many unknowns the rigid body has, of this rank and of all."""
        W = self.bodies[0].W
        self._couplings = PointMatrix(layout, W), PointMatrix(W, layout)

    def put(self, pose: Pose) -> None:
        """Evaluate what acts with the shape in some place.

        Args:
            pose: The place.

        Raises:
            MPMError: That cannot be.
        """
        self._pose = self._aim = pose
        self._trial = self._evaluated()

    @property
    def whole_stiffness(self) -> float:
        """Stiffness of all of this rank's points together."""
        return float((self._surface.weights * self._tractions.stiffnesses()[0]).sum())

    @property
    def extent(self) -> float:
        """Largest coordinate of the undeformed body."""
        return self._surface.layout.extent

    def span(self) -> float:
        """Return the largest length of the undeformed body along an axis (collective)."""
        x = self.bodies[0].initial_domains.reshape(-1, self._surface.gdim)
        ends = np.concatenate([x.max(axis=0, initial=-np.inf), (-x).max(axis=0, initial=-np.inf)])
        self.bodies[0].mesh.comm.Allreduce(MPI.IN_PLACE, ends, MPI.MAX)
        above, below = np.split(ends, 2)
        return float((above + below).max())

    def total(self, centres: tuple[NDArray[np.float64], ...]) -> NDArray[np.float64]:
        """Return this rank's force and moment on the other body.

        Args:
            centres: Centre of the rigid body at the step's beginning and end.

        Returns:
            Force, moment about the centre, size of the force, and number of points that touch,
            ``(gdim + nr + 2,)``.
        """
        assert self._trial is not None
        trial, traction = self._trial, self._trial.outcome.traction
        here = np.flatnonzero(traction.any(axis=(1, 2)))
        which = trial.numbers(here)
        f = self._surface.weights[which, :, None] * traction[here]
        arm = self._arms(here, centres)
        moments = np.einsum("mqij,mqi->j", crossing(arm), f)
        size = np.linalg.norm(f, axis=2).sum()
        return np.concatenate(
            [f.sum(axis=(0, 1)), moments, [size, np.count_nonzero(trial.touched)]]
        )

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
        if trial.step is None or trial.step.push is None:
            return np.zeros(2)
        memory, w = self._known(trial), self._tractions.weights(trial)[:, :, None]
        f = w * trial.outcome.traction
        change = trial.outcome.positions - memory.outcome.positions
        normal = trial.step.push @ self._tractions.rotation(trial, memory).T
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

    def coupled(
        self,
        centres: tuple[NDArray[np.float64], ...],
        theta: NDArray[np.float64],
        per_unknown: NDArray[np.float64],
        secants: bool,
    ) -> Coupled:
        """Return the tangents (collective).

        Args:
            centres: As for :meth:`total`.
            theta: Cayley vector of the step.
            per_unknown: Displacement and Cayley vector by each unknown, ``(gdim + nr, n)``.
            secants: Whether points that have changed their slip take secants instead.
        """
        slopes = self._slopes(secants and not self.friction.smooth)
        rows, by_s, own = self._by_motion(slopes, centres, theta)
        N, w = self._surface.shapes, self._surface.weights[slopes.facets]
        m, k = slopes.dofs.shape
        keys, n = slopes.facets, per_unknown.shape[1]
        motions = np.broadcast_to(np.arange(n), (m, n))
        of = np.einsum("mq,qa,mqsi,sn->mnai", w, N, rows, per_unknown, optimize=True)
        by = np.einsum("mq,qa,mqis,sn->main", -w, N, by_s, per_unknown, optimize=True)
        of_motion, by_motion = self._couplings
        return Coupled(
            self._matrix.of([self._blocks_of(slopes)]),
            of_motion.of([Blocks(keys, motions, slopes.dofs, of.reshape(m, n, k))]),
            by_motion.of([Blocks(keys, slopes.dofs, motions, by.reshape(m, k, n))]),
            own,
        )

    def of_own(
        self, centres: tuple[NDArray[np.float64], ...], theta: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return this rank's derivative of force and moment by a step of the rigid body."""
        return self._by_motion(self._slopes(False), centres, theta)[2]

    def _by_motion(
        self,
        slopes: Slopes,
        centres: tuple[NDArray[np.float64], ...],
        theta: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return derivatives by and of a step ``(dX, theta)`` of the rigid body.

        Returns:
            Of force and moment at points by their positions ``(m, nq, n, gdim)``, of tractions by
            the step ``(m, nq, gdim, n)``, and of all force and moment by it ``(n, n)``.
        """
        trial, memory = slopes.trial, self._known(slopes.trial)
        here, D = slopes.acting.here, slopes.by_position
        share = 0.5 if self._of_step else 1.0
        gdim, force = D.shape[3], trial.outcome.traction[here] / self._share
        within = np.linalg.solve(self._tractions.rotation(trial, memory), force[..., None])[..., 0]
        H = cayley_variation(theta)
        arm = trial.outcome.positions[here] - centres[1]
        middle = self._arms(here, centres)
        unit = np.broadcast_to(np.eye(gdim), (*arm.shape, gdim))
        by_s = -D @ np.concatenate([unit, crossing(arm) @ H], axis=3)
        by_s[..., gdim:] += share * crossing(within @ trial.pose.Q.T) @ H
        rigid = np.concatenate([unit, crossing(middle)], axis=3).swapaxes(2, 3)
        turning = share * crossing(force).swapaxes(2, 3)
        w = self._surface.weights[slopes.facets][:, :, None, None]
        own = (w * (rigid @ by_s)).sum(axis=(0, 1))
        own[gdim:, :gdim] += (w * turning).sum(axis=(0, 1))
        rows = rigid @ D
        rows[:, :, gdim:] -= turning
        return rows, by_s, own
