# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Tractions of an obstacle at the points of a body's facets, and their derivatives.

They are those of :mod:`.law` in the frame of the shape, where it is at the end of a step; or, in
motion by the middle of a step, turned by the mean of the rotations.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .contact import Outcome
from .law import (
    Begun,
    Friction,
    Points,
    Separation,
    by_pressure,
    remembered,
    secant_along,
    slopes,
    traction,
)
from .memory import Memory, Step
from .nitsche import Nitsche
from .placed import distance_within, framed
from .rotation import Pose
from .shapes import Shape
from .slip_changes import SlipChanges
from .surface import Surface

__all__ = ["Acting", "ObstacleTractions"]


class Acting(NamedTuple):
    """Points that touch.

    Attributes:
        here: Places of their facets among those that were looked at, shape ``(f,)``.
        inside: Which points of these touch, shape ``(f, nq)``.
        flat: Numbers of the points, shape ``(n,)``, among all of the facets that were looked at.
    """

    here: NDArray[np.int64]
    inside: NDArray[np.bool_]
    flat: NDArray[np.int64]


class ObstacleTractions:
    """Tractions of an obstacle at the points of a surface, and their derivatives.

    Args:
        surface: The points.
        shape: The obstacle.
        friction: The law of friction.
        penalty: Stiffness in the normal direction, without unit.
        tangential: Stiffness of points that stick, without unit.

    Attributes:
        of_step: Whether forces are those of whole steps of a motion.
        nitsche: The stress behind the facets, where the pressure is that.
        inertial: What their mass adds to the stiffness in a step of a motion, shape ``(m,)``, or 0.
        slip_changes: Which points have changed their slip.
    """

    def __init__(
        self, surface: Surface, shape: Shape, friction: Friction, penalty: float, tangential: float
    ) -> None:
        self._surface, self._shape, self._friction = surface, shape, friction
        self._penalty, self._tangential = penalty, tangential
        self.of_step = False
        self.nitsche: Nitsche | None = None
        self.inertial: NDArray[np.float64] = np.zeros(0)
        self.slip_changes = SlipChanges()
        self._stretch: NDArray[np.float64] | None = None

    # -- What points have -----------------------------------------------------------------------

    def settle(self, stiffness: NDArray[np.float64]) -> None:
        """Take the present facets of the surface.

        Args:
            stiffness: Modulus over thickness of each, shape ``(m,)``.
        """
        self._stiffness = np.repeat(stiffness[:, None], self._surface.nq, axis=1)
        self.inertial = np.zeros(len(stiffness))

    def hold_stretch(self) -> None:
        """Note the stretch of facets that counts for friction, once in a step.

        Where a step is committed bodies are at its end already, and a motion begins its terms anew.
        """
        if self._stretch is None:
            self._stretch = self._surface.stretch(self._friction.by_area)

    def forget_stretch(self) -> None:
        """Forget the stretch of facets."""
        self._stretch = None

    def stiffnesses(
        self, which: NDArray[np.int64] | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return those of points in the normal direction and along the surface, ``(m, nq)``.

        Args:
            which: Numbers of facets; ``None``: all.
        """
        some = slice(None) if which is None else which
        k = self._stiffness[some]
        return self._penalty * (self._stiffness + self.inertial[:, None])[
            some
        ], self._tangential * k

    def points(self, memory: Memory) -> Points:
        """Return the points of facets of which something is known."""
        which = memory.facets
        normal, tangential = self.stiffnesses(which)
        gdim = memory.anchor.shape[2]
        return Points(
            normal.ravel(),
            tangential.ravel(),
            memory.touched.ravel(),
            memory.anchor.reshape(-1, gdim),
            memory.gap.ravel(),
            self._stretch_of(which).ravel(),
            memory.friction.reshape(memory.gap.size, memory.friction.shape[2]),
        )

    def _stretch_of(self, which: NDArray[np.int64] | None) -> NDArray[np.float64]:
        """Return the stretch of facets that counts for friction: that at the step's beginning."""
        if self._stretch is None:
            return self._surface.stretch(self._friction.by_area, which)
        return self._stretch if which is None else self._stretch[which]

    def weights(self, memory: Memory) -> NDArray[np.float64]:
        """Return the undeformed areas of the points of facets of which something is known."""
        weights = self._surface.weights
        return weights if memory.facets is None else np.asarray(weights[memory.facets])

    # -- What acts on them ----------------------------------------------------------------------

    def evaluated(self, memory: Memory, x: NDArray[np.float64], pose: Pose) -> Memory:
        """Return facets with the tractions that act on them, of which something is known.

        Args:
            memory: What is known of the last converged step.
            x: Where their points are, shape ``(m, nq, gdim)``.
            pose: Where the shape is.
        """
        which = memory.facets
        m, nq, gdim = x.shape
        y = framed(self._shape, pose, x).reshape(-1, gdim)
        points = self.points(memory)
        touch = self._surface.touch
        behind, pressing, reach = None, None, np.full(len(y), touch)
        if self.nitsche is not None:
            behind = self.nitsche.tractions()
            pressing = (behind @ pose.Q).reshape(-1, gdim)
            reach = touch + np.linalg.norm(pressing, axis=1) / points.stiffness
        phi, n = self._distance(y, memory, reach)
        at = Separation(phi, n, y - points.anchor, touch, pressing)
        step, Q = None, pose.Q
        if self.of_step:
            step, Q = self._step(memory, y, phi), memory.pose.mean(pose)
            at = at._replace(normal=step.normal, begun=step.begun)
        acts = traction(self._friction, points, at)
        shape = (m, nq)
        normal, shear = ((part @ Q.T).reshape(x.shape) for part in (acts.normal, acts.shear))
        force = normal + shear
        works = (0.0, 0.0)
        if step is not None:
            step = step._replace(push=acts.normal)
            moves = self.weights(memory)[:, :, None] * (x - memory.outcome.positions)
            works = -float((normal * moves).sum()), -float((shear * moves).sum())
        outcome = Outcome(
            x,
            phi.reshape(shape),
            acts.pressure.reshape(shape),
            force,
            (acts.inside if behind is not None else phi <= touch).reshape(shape),
            acts.slips.reshape(shape),
        )
        return Memory(
            pose,
            outcome.inside,
            # (not asked for until all facets are looked at)
            memory.anchor
            if which is not None
            else _anchors(points, y, phi, n, acts.shear, outcome).reshape(x.shape),
            outcome.gap,
            n.reshape(x.shape),
            outcome,
            memory.friction
            if which is not None
            else remembered(self._friction, points, at).reshape(memory.friction.shape),
            works,
            step,
            behind,
            which,
        )

    def _distance(
        self, y: NDArray[np.float64], memory: Memory, reach: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return gaps and normals of points; of a costly shape what they are at least if far.

        Args:
            y: The points, in the frame of the shape.
            memory: What is known of the last converged step.
            reach: Gap within which a point may be pressed.
        """
        phi, n = np.zeros(len(y)), memory.normal.reshape(y.shape).copy()
        near = np.ones(len(y), dtype=bool)
        if self._shape.costly:
            before = framed(self._shape, memory.pose, memory.outcome.positions).reshape(y.shape)
            phi = memory.gap.ravel() - np.linalg.norm(y - before, axis=1)
            near = ~(phi > reach)
        phi[near], n[near] = distance_within(self._shape, y[near])
        return phi, n

    def _step(self, memory: Memory, y: NDArray[np.float64], gap: NDArray[np.float64]) -> Step:
        """Return the step to positions and gaps at all points."""
        before = memory.gap.ravel()
        change = y - framed(self._shape, memory.pose, memory.outcome.positions).reshape(y.shape)
        middle = y - 0.5 * change
        touch = self._surface.touch
        n = memory.normal.reshape(y.shape).copy()
        acts = (before <= touch) | (gap <= touch)
        n[acts] = self._shape.distance(middle[acts])[1]
        return Step(middle, n, Begun(before, np.zeros_like(before), change))

    # -- Derivatives of what acts ---------------------------------------------------------------

    def acting(self, trial: Memory, memory: Memory) -> Acting:
        """Return the points that touch.

        Args:
            trial: What acts.
            memory: What is known of its facets at the last converged step.
        """
        surface, acting = self._surface, trial.touched
        if self.of_step:
            acting = acting | (memory.gap <= surface.touch)
        here = np.flatnonzero(
            acting.any(axis=1) & (self.weights(trial).max(axis=1, initial=0.0) > 0.0)
        )
        inside = acting[here]
        flat = (here[:, None] * surface.nq + np.arange(surface.nq))[inside]
        return Acting(here, inside, flat)

    def rotation(self, trial: Memory, memory: Memory) -> NDArray[np.float64]:
        """Return the rotations of tractions out of the frame of the shape."""
        return memory.pose.mean(trial.pose) if self.of_step else trial.pose.Q

    def derivative(
        self, trial: Memory, memory: Memory, flat: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return the derivative of the traction by positions, shape ``(n, gdim, gdim)``.

        Args:
            trial: As for :meth:`acting`.
            memory: As there.
            flat: Numbers of points that touch.
        """
        Q = self.rotation(trial, memory)
        return np.asarray(Q @ self.derivative_within(trial, memory, flat) @ trial.pose.Q.T)

    def derivative_within(
        self, trial: Memory, memory: Memory, flat: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return :meth:`derivative` in the frame of the shape."""
        points, at, y = self._seen(trial, memory, flat)
        n = trial.normal.reshape(-1, y.shape[1])[flat]
        if trial.step is None:
            H = self._shape.curvature(y)
        else:
            H = 0.5 * self._shape.curvature(trial.step.middle[flat])
        return slopes(self._friction, points, at, n, H)

    def secants(
        self, trial: Memory, memory: Memory, flat: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return the part of tangents besides :meth:`derivative` where points change their slip.

        It notes how they slip, and is called on all ranks, also where nothing touches.
        """
        gdim, Q = self._surface.gdim, self.rotation(trial, memory)
        slips = trial.outcome.slips.ravel()
        normal = trial.normal if trial.step is None else trial.step.normal
        n = normal.reshape(-1, gdim)
        force = np.linalg.solve(Q, trial.outcome.traction.reshape(-1, gdim).T).T
        shear = force - n * (n * force).sum(axis=1)[:, None]
        m, nq = self._surface.weights.shape
        place = nq * trial.numbers(np.arange(len(trial.gap)))[:, None] + np.arange(nq)
        slipping, along = np.zeros(m * nq, dtype=bool), np.zeros((m * nq, gdim))
        slipping[place.ravel()], along[place.ravel()] = slips, shear
        changed = self.slip_changes.note(slipping, along)[place.ravel()][flat]
        found = np.zeros((len(flat), gdim, gdim))
        if changed.any():
            some = flat[changed]
            _, at, _ = self._seen(trial, memory, some)
            found[changed] = Q @ secant_along(at, shear[some]) @ trial.pose.Q.T
        return found

    def by_stress(
        self, trial: Memory, memory: Memory, flat: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return the derivative of the traction by that of the stress behind.

        Of the latter by its part along the normal, shape ``(n, gdim)``.
        """
        points, at, _ = self._seen(trial, memory, flat)
        return np.asarray(by_pressure(self._friction, points, at) @ trial.pose.Q.T)

    def _seen(
        self, trial: Memory, memory: Memory, flat: NDArray[np.int64]
    ) -> tuple[Points, Separation, NDArray[np.float64]]:
        """Return some points, where they are, and their coordinates, in the frame of the shape."""
        gdim, pose, step, behind = self._surface.gdim, trial.pose, trial.step, None
        points = self.points(memory).of(flat)
        y = framed(self._shape, pose, trial.outcome.positions.reshape(-1, gdim)[flat])
        if trial.behind is not None:
            behind = trial.behind.reshape(-1, gdim)[flat] @ pose.Q
        n = trial.normal.reshape(-1, gdim)[flat] if step is None else step.normal[flat]
        begun = None if step is None else Begun(*(part[flat] for part in step.begun))
        at = Separation(
            trial.gap.ravel()[flat], n, y - points.anchor, self._surface.touch, behind, begun
        )
        return points, at, y


def _anchors(
    points: Points,
    y: NDArray[np.float64],
    phi: NDArray[np.float64],
    n: NDArray[np.float64],
    shear: NDArray[np.float64],
    outcome: Outcome,
) -> NDArray[np.float64]:
    """Return the anchors to be remembered, and where points were that touch nothing."""
    inside, slips = outcome.inside.ravel(), outcome.slips.ravel()
    foot = y - phi[:, None] * n + shear / points.tangential[:, None]
    stays = inside & ~slips & points.touched
    anchor = np.where(stays[:, None], points.anchor, foot)
    return np.where(inside[:, None], anchor, y)
