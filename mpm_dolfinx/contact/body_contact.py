# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The contact of one body with a rigid one that is put in one place after the other."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, override

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError
from ..particles.particles import Particles
from .contact import Contact
from .law import Friction
from .placed import distance_within, framed
from .rigid import Rigid
from .rotation import Pose, cayley_variation, crossing
from .shape_pass import Touch
from .shapes import Shape
from .surface import Blocks, Layout, PointMatrix, global_dofs

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

    @property
    @override
    def _counts_turns(self) -> bool:
        """Whether whole turns count; a vector of rotation in space tells none."""
        return False

    @override
    def begin(self) -> Sequence[PETSc.Vec]:
        """Begin a step; where the rigid body goes is found later."""
        return Contact.begin(self)

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
        self._pose = self._aim = self._pass.pose = pose
        self._passes.evaluate()

    @property
    def _touch(self) -> Touch:
        """Contact at the place where the shape was put last."""
        assert self._pass.evaluation is not None
        return self._pass.evaluation

    @property
    def whole_stiffness(self) -> float:
        """Stiffness of all of this rank's points together."""
        return float((self._pass.source.weights * self._pass.penalties).sum())

    @property
    def layout(self) -> Layout:
        """The facets of the body that deforms."""
        return self._pass.source.layout

    def total(self, centres: tuple[NDArray[np.float64], ...]) -> NDArray[np.float64]:
        """Return this rank's force and moment on the other body.

        Args:
            centres: Centre of the rigid body at the step's beginning and end.

        Returns:
            Force, moment about the centre, size of the force, and number of points that touch,
            ``(gdim + nr + 2,)``.
        """
        touch, outcome = self._touch, self._touch.outcome
        here = np.flatnonzero(outcome.traction.any(axis=(1, 2)))
        f = touch.source.weights[touch.numbers[here], :, None] * outcome.traction[here]
        arm = self._arms(here, centres)
        moments = np.einsum("mqij,mqi->j", crossing(arm), f)
        size = np.linalg.norm(f, axis=2).sum()
        count = np.count_nonzero(outcome.inside)
        return np.concatenate([f.sum(axis=(0, 1)), moments, [size, count]])

    def _arms(
        self, here: NDArray[np.int64], centres: tuple[NDArray[np.float64], ...]
    ) -> NDArray[np.float64]:
        """Return arms from the centre, those of the middle where forces are of whole steps.

        Args:
            here: Places of facets among those that were looked at.
            centres: As for :meth:`total`.
        """
        after = self._touch.x[here]
        if not self._of_step:
            return after - centres[1]
        before = self._touch.last.outcome.positions[here]
        return np.asarray(0.5 * (before - centres[0] + after - centres[1]))

    def works(self, motion: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Any:
        """Return this rank's work of the last step on the rigid body, and what friction has taken.

        Args:
            motion: Returns the motions of the rigid body at arms of the middle.
        """
        touch = self._pass.evaluation
        if touch is None or touch.middle is None:
            return np.zeros(2)
        w = touch.source.weights[touch.numbers][:, :, None]
        slid = touch.moves - motion(touch.x - 0.5 * touch.moves)
        taken = -float((w * touch.rub * slid).sum())
        return np.array([-float((w * touch.outcome.traction * touch.moves).sum()) - taken, taken])

    def least(self, pose: Pose) -> float:
        """Return the least gap of this rank's points with the shape in some place."""
        surface = self._pass.source
        borne = np.flatnonzero((surface.weights > 0.0).any(axis=1))
        x = surface.positions(which=borne)[surface.weights[borne] > 0.0]
        return float(
            distance_within(self.shape, framed(self.shape, pose, x))[0].min(initial=np.inf)
        )

    def energy(self) -> float:
        """Return this rank's energy of penetration at the last converged step."""
        gap, source = self._every()[0].gap, self._pass.source
        pressed = np.where(gap <= source.touch, gap, 0.0)
        return float(0.5 * (source.weights * self._pass.penalties * pressed**2).sum())

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
        K = self._passes.tangents(-1.0 / self._share, secants).get((0, 0))
        rows, by_s, own = self._by_motion(self._pass.tangent, centres, theta)
        touch, source = self._touch, self._touch.source
        facets, places = touch.of_acting
        N, w = source.shapes[places], source.weights[facets, places]
        keys, block = np.unique(facets, return_inverse=True)
        m, k, n = len(keys), source.shapes.shape[1] * source.gdim, per_unknown.shape[1]
        of, by = np.zeros((m, n, k)), np.zeros((m, k, n))
        part = np.einsum("p,pa,psi,sn->pnai", w, N, rows, per_unknown, optimize=True)
        np.add.at(of, block, part.reshape(len(w), n, k))
        part = np.einsum("p,pa,pis,sn->pain", -w, N, by_s, per_unknown, optimize=True)
        np.add.at(by, block, part.reshape(len(w), k, n))
        dofs = global_dofs(source.particles.W, source.layout.nodes[keys])
        motions = np.broadcast_to(np.arange(n), (m, n))
        of_motion, by_motion = self._couplings
        return Coupled(
            K,
            of_motion.of(Blocks(keys, motions, dofs, of)),
            by_motion.of(Blocks(keys, dofs, motions, by)),
            own,
        )

    def of_own(
        self, centres: tuple[NDArray[np.float64], ...], theta: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return this rank's derivative of force and moment by a step of the rigid body."""
        return self._by_motion(self._touch.slopes(), centres, theta)[2]

    def _by_motion(
        self,
        slopes: NDArray[np.float64],
        centres: tuple[NDArray[np.float64], ...],
        theta: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return derivatives by and of a step ``(dX, theta)`` of the rigid body.

        Args:
            slopes: Derivatives of tractions where something acts by positions, ``(n, gdim, gdim)``.
            centres: As for :meth:`total`.
            theta: Cayley vector of the step.

        Returns:
            Of force and moment at these points by their positions ``(n, r, gdim)``, of tractions by
            the step ``(n, gdim, r)``, and of all force and moment by it ``(r, r)``.
        """
        touch, flat = self._touch, self._touch.acting
        share = 0.5 if self._of_step else 1.0
        D = slopes / self._share
        gdim = D.shape[2]
        force = touch.outcome.traction.reshape(-1, gdim)[flat] / self._share
        within = np.linalg.solve(touch.rotation, force.T).T
        H = cayley_variation(theta)
        arm = touch.x.reshape(-1, gdim)[flat] - centres[1]
        middle = self._arms(np.arange(len(touch.x)), centres).reshape(-1, gdim)[flat]
        unit = np.broadcast_to(np.eye(gdim), D.shape)
        by_s = -D @ np.concatenate([unit, crossing(arm) @ H], axis=2)
        by_s[..., gdim:] += share * crossing(within @ touch.pose.Q.T) @ H
        rigid = np.concatenate([unit, crossing(middle)], axis=2).swapaxes(1, 2)
        turning = share * crossing(force).swapaxes(1, 2)
        facets, places = touch.of_acting
        w = touch.source.weights[facets, places][:, None, None]
        own = (w * (rigid @ by_s)).sum(axis=0)
        own[gdim:, :gdim] += (w * turning).sum(axis=0)
        rows = rigid @ D
        rows[:, gdim:] -= turning
        return rows, by_s, own
