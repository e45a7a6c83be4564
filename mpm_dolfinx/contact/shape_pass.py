# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Points of a body's surface against a rigid shape, through steps.

Tractions are those of :mod:`.law` in the frame of the shape, where it is at the end of a step; or,
in motion by the middle of a step, turned by the mean of the rotations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, override

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from .._core import loops
from ..errors import ConvergenceError, agree
from ..parallel.given import require_same
from ..tolerances import NEGLIGIBLE
from .behind import At
from .law import (
    Begun,
    Friction,
    Points,
    Separation,
    Traction,
    by_pressure,
    remembered,
    secant_along,
    slopes,
    traction,
    unworn,
)
from .memory import ShapeMemory
from .nitsche import Spread
from .one_pass import Pass, retold, worn
from .outcome import Outcome, untouched
from .pair_matrices import Met, Places
from .placed import distance_within, framed, unframed
from .reach import Reach, is_near
from .rotation import QUARTER, Pose
from .shapes import Shape
from .slip_changes import SlipChanges
from .surface import Surface, global_nodes
from .ways import OPPOSITE, passes

__all__ = ["ShapePass", "Touch"]

type Array = NDArray[np.float64]


@dataclass(frozen=True)
class Touch:
    """An evaluation of points against a shape.

    Attributes:
        source: The points.
        shape: The shape.
        law: Friction.
        last: What is known of the facets that were looked at.
        pose: Where the shape is.
        x: Where the points are, shape ``(m, nq, gdim)``.
        y: The same in its frame, shape ``(n, gdim)``.
        normal: Normals there, shape ``(n, gdim)``.
        middle: Where they are in the middle of a step of a motion; ``None``: forces are of its end.
        points: Stiffness and memory.
        at: Gaps, normals and ways, in the frame.
        acts: Tractions, in the frame.
    """

    source: Surface
    shape: Shape
    law: Friction
    last: ShapeMemory
    pose: Pose
    x: Array
    y: Array
    normal: Array
    middle: Array | None
    points: Points
    at: Separation
    acts: Traction

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Numbers of the facets that were looked at."""
        facets = self.last.facets
        return np.arange(len(self.x)) if facets is None else facets

    @cached_property
    def rotation(self) -> Array:
        """The rotation of tractions out of the frame of the shape."""
        return self.pose.Q if self.middle is None else self.last.pose.mean(self.pose)

    @cached_property
    def push(self) -> Array:
        """Tractions by pressure, shape ``(m, nq, gdim)``."""
        return (self.acts.normal @ self.rotation.T).reshape(self.x.shape)

    @cached_property
    def rub(self) -> Array:
        """Tractions by friction, shape ``(m, nq, gdim)``."""
        return (self.acts.shear @ self.rotation.T).reshape(self.x.shape)

    @cached_property
    def outcome(self) -> Outcome:
        """Tractions on the points, and which of them touch, stick or slip."""
        shape, at, acts = self.x.shape[:2], self.at, self.acts
        inside = at.gap <= at.touch if at.behind is None else acts.inside
        return Outcome(
            self.x,
            at.gap.reshape(shape),
            acts.pressure.reshape(shape),
            self.push + self.rub,
            inside.reshape(shape),
            acts.slips.reshape(shape),
        )

    @property
    def works(self) -> tuple[float, float]:
        """Work against pressure and against friction in a step of a motion."""
        if self.middle is None:
            return 0.0, 0.0
        moves = self.source.weights[self.numbers][:, :, None] * self.moves
        return -float((self.push * moves).sum()), -float((self.rub * moves).sum())

    @property
    def moves(self) -> Array:
        """How far the points have moved in the step, shape ``(m, nq, gdim)``."""
        return self.x - self.last.outcome.positions

    @cached_property
    def acting(self) -> NDArray[np.int64]:
        """Numbers of the points on which something acts, among those that were looked at."""
        inside = self.outcome.inside
        if self.middle is not None:
            inside = inside | (self.last.gap <= self.at.touch)
        return np.flatnonzero(inside & (self.source.weights[self.numbers] > 0.0))

    @property
    def of_acting(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Numbers of the facets of points on which something acts, and of the points there."""
        return self.numbers[self.acting // self.source.nq], self.acting % self.source.nq

    def met(self) -> Met:
        """Return the facets of the points where something acts."""
        own, _ = self.of_acting
        nodes = global_nodes(self.source.particles.W, self.source.layout.nodes[own])
        return Met(own[:, None], (nodes,))

    def slopes(self) -> Array:
        """Return the derivatives of tractions there by positions, shape ``(n, gdim, gdim)``."""
        flat = self.acting
        if self.middle is None:
            H = self.shape.curvature(self.y[flat])
        else:
            H = 0.5 * self.shape.curvature(self.middle[flat])
        found = slopes(self.law, self.points.of(flat), self.at.of(flat), self.normal[flat], H)
        return np.asarray(self.rotation @ found @ self.pose.Q.T)

    def by_stress(self, factor: float) -> tuple[At, list[Spread]]:
        """Return points with normals, and how forces grow with the stress behind.

        Args:
            factor: What forces are multiplied by.
        """
        flat, source = self.acting, self.source
        own, place = self.of_acting
        grows = by_pressure(self.law, self.points.of(flat), self.at.of(flat)) @ self.pose.Q.T
        at = At(own, place, self.normal[flat] @ self.pose.Q.T)
        force = factor * source.weights[own, place][:, None] * grows
        return at, [Spread.over_facets(source, at, force)]

    def state(self) -> ShapeMemory:
        """Return the memory of the points, if a step ends with this."""
        acts, points, shape = self.acts, self.points, self.x.shape
        outcome = self.outcome
        inside = outcome.inside.ravel()
        foot = self.y - self.at.gap[:, None] * self.normal
        foot += acts.shear / points.tangential[:, None]
        stays = inside & ~acts.slips & points.touched
        anchor = np.where(stays[:, None], points.anchor, foot)
        return ShapeMemory(
            self.pose,
            np.where(inside[:, None], anchor, self.y).reshape(shape),
            self.normal.reshape(shape),
            outcome,
            remembered(self.law, points, self.at).reshape(self.last.friction.shape),
            self.last.facets,
        )


class ShapePass(Pass[ShapeMemory, Touch]):
    """Points of a body's surface against a rigid shape.

    Args:
        source: The points.
        law: The law of friction.
        penalty: Stiffness in the normal direction, without unit.
        stiffness: Modulus over height behind each facet, shape ``(m,)``.
        shape: The shape.
        pose: Where it is.
        whole_turns: Whether whole turns of the shape count in its angle.

    Attributes:
        pose: Where the shape is now.
        tangent: Derivatives of tractions that were taken last, shape ``(n, gdim, gdim)``.
    """

    WITHIN = (
        "The body begins within the obstacle of a Rigid: {particles} are up to {depth:.3g} deep in "
        "it, at {where}; move one of them away."
    )

    def __init__(
        self,
        source: Surface,
        law: Friction,
        penalty: float,
        stiffness: Array,
        shape: Shape,
        pose: Pose,
        whole_turns: bool,
    ) -> None:
        super().__init__(source, law, penalty)
        self._stiffness = self._normal = stiffness
        self._shape, self.pose, self._whole_turns = shape, pose, whole_turns
        self._comm = source.particles.mesh.comm
        self._reach = Reach(source, shape)
        self._slip_changes = SlipChanges()
        self.tangent = np.zeros((0, source.gdim, source.gdim))
        self._require_same_shape()
        self.state = self._anew(pose)

    def _require_same_shape(self) -> None:
        """Raise an error where ranks have different shapes, by some distances (collective)."""
        if self._comm.size == 1:
            return
        x = self.source.positions(converged=True).reshape(-1, self._shape.dim)
        # at most 16 points of each rank
        places = np.concatenate(self._comm.allgather(x[:: 1 + len(x) // 16]))
        with agree(self._comm):
            distances = self._shape.distance(framed(self._shape, self.pose, places))[0]
        told = distances.astype(np.float32).tolist()
        require_same(self._comm, shape=[type(self._shape).__name__, *told])

    def _anew(self, pose: Pose) -> ShapeMemory:
        """Return the memory at converged positions, of points that nothing has touched yet."""
        x = self.source.positions(converged=True)
        with agree(self._comm):
            y = framed(self._shape, pose, x)
            gap, n = self._shape.distance(y.reshape(-1, x.shape[2]))
        outcome = untouched(x, gap.reshape(x.shape[:2]))
        return ShapeMemory(pose, y, n.reshape(x.shape), outcome, unworn(self._law, x.shape[:2]))

    @override
    def stiffen(self, *stiffnesses: Array) -> None:
        self._normal = stiffnesses[0]

    @property
    def penalties(self) -> Array:
        """Stiffnesses of all points in the normal direction, shape ``(m, nq)``."""
        return self._stiffnesses(None)[0].reshape(self.source.weights.shape)

    # -- What it tells ----------------------------------------------------------------------------

    @property
    @override
    def gap(self) -> Array:
        if not self.state.exact:
            self.state = self._exact(self.state)
        return self.state.gap

    @property
    def normals(self) -> Array:
        """Normals of the shape at the points, shape ``(m, nq, gdim)``."""
        return np.asarray(self.state.normal @ self.state.pose.Q.T)

    @property
    @override
    def anchors(self) -> Array:
        return unframed(self._shape, self.state.pose, self.state.anchor)

    def _exact(self, memory: ShapeMemory, which: NDArray[np.int64] | None = None) -> ShapeMemory:
        """Return the memory with the gaps of all points of some facets, or of all facets."""
        chosen = slice(None) if which is None else which
        x = memory.outcome.positions[chosen]
        phi, n = self._shape.distance(framed(self._shape, memory.pose, x).reshape(-1, x.shape[2]))
        gap, normal = memory.gap.copy(), memory.normal.copy()
        gap[chosen], normal[chosen] = phi.reshape(x.shape[:2]), n.reshape(x.shape)
        outcome = memory.outcome._replace(gap=gap)
        return replace(memory, normal=normal, outcome=outcome, exact=which is None)

    # -- A step ---------------------------------------------------------------------------------

    @override
    def prepare(self) -> None:
        """Note which facets may touch in the step."""
        self._slip_changes.begin()
        if self.stress is None:
            self._reach.look(self.state)
        else:  # (the stress presses wherever it does)
            self._reach.forget()

    def require_free_way(self) -> None:
        """Raise an error where the shape is to move through the body (collective).

        Raises:
            ConvergenceError: It moves too far in one step.
        """
        with agree(self._comm):
            x = self.state.outcome.positions
            if passes(self._shape, self.source, self.state, x, self.pose):
                raise ConvergenceError(
                    "The obstacle of a Rigid moves through the body in one step; move it in "
                    "smaller ones, by a path (update=)"
                )

    @override
    def evaluate(self) -> None:
        near = self._reach.of(self.state, self.pose)
        if near is None and not self.state.exact:
            self.state = self._exact(self.state)
        self.evaluation = self._evaluated(self.state if near is None else near)

    def _evaluated(self, memory: ShapeMemory) -> Touch:
        """Return the contact of facets of which something is known."""
        source, shape, pose, touch = self.source, self._shape, self.pose, self.source.touch
        x = source.positions(which=memory.facets)
        y = framed(shape, pose, x).reshape(-1, source.gdim)
        points = self._points(memory)
        behind, reach = None, np.full(len(y), touch)
        if self.stress is not None:
            behind, reach = self._behind(memory.facets, touch)
            behind = behind @ pose.Q
        gap, n = self._distance(y, memory, reach)
        at, middle = Separation(gap, n, y - points.anchor, touch, behind), None
        if self.of_step:
            middle, at = self._over_step(memory, y, at)
        acts = traction(self._law, points, at)
        return Touch(source, shape, self._law, memory, pose, x, y, n, middle, points, at, acts)

    def _points(self, memory: ShapeMemory) -> Points:
        """Return the points of facets of which something is known."""
        normal, tangential, stretch = self._stiffnesses(memory.facets)
        return Points(
            normal,
            tangential,
            memory.outcome.inside.ravel(),
            memory.anchor.reshape(-1, self.source.gdim),
            memory.gap.ravel(),
            stretch,
            memory.friction.reshape(memory.gap.size, memory.friction.shape[2]),
        )

    def _distance(self, y: Array, memory: ShapeMemory, reach: Array) -> tuple[Array, Array]:
        """Return gaps and normals of points; of a costly shape what they are at least if far.

        Args:
            y: The points, in the frame of the shape.
            memory: What is known of the last converged step.
            reach: Gap within which a point may be pressed.
        """
        phi, n = np.zeros(len(y)), memory.normal.reshape(y.shape).copy()
        near = np.ones(len(y), dtype=bool)
        if self._shape.costly:
            phi = memory.gap.ravel() - np.linalg.norm(y - _started(self._shape, memory, y), axis=1)
            near = ~(phi > reach)
        phi[near], n[near] = distance_within(self._shape, y[near])
        return phi, n

    def _over_step(self, memory: ShapeMemory, y: Array, at: Separation) -> tuple[Array, Separation]:
        """Return the middle of a step of a motion, and where points are over it."""
        before = memory.gap.ravel()
        change = y - _started(self._shape, memory, y)
        middle = y - 0.5 * change
        n = memory.normal.reshape(y.shape).copy()
        acts = (before <= at.touch) | (at.gap <= at.touch)
        n[acts] = self._shape.distance(middle[acts])[1]
        begun = Begun(before, np.zeros_like(before), change)
        return middle, at._replace(normal=n, begun=begun)

    @override
    def forces(self, factor: float) -> list[PETSc.Vec]:
        if self.evaluation is None:
            return [self.source.force(self.told.traction, factor)]
        found = self.evaluation
        return [self.source.force(found.outcome.traction, factor, found.last.facets)]

    def _secants(self, found: Touch) -> Array:
        """Return the part of tangents besides slopes where points change their slip.

        It notes how they slip, also where nothing touches.
        """
        gdim, source, flat = self.source.gdim, self.source, found.acting
        n, force = found.at.normal, found.acts.normal + found.acts.shear
        shear = force - n * (n * force).sum(axis=1)[:, None]
        count = source.weights.size
        place = (source.nq * found.numbers[:, None] + np.arange(source.nq)).ravel()
        slipping, along = np.zeros(count, dtype=bool), np.zeros((count, gdim))
        slipping[place], along[place] = found.acts.slips, shear
        changed = self._slip_changes.note(slipping, along)[place][flat]
        secants = np.zeros((len(flat), gdim, gdim))
        if changed.any():
            some = flat[changed]
            part = secant_along(found.at.of(some), shear[some])
            secants[changed] = found.rotation @ part @ found.pose.Q.T
        return secants

    @override
    def add_tangents(self, factor: float, secants: bool, into: Places) -> None:
        assert self.evaluation is not None
        found, source = self.evaluation, self.source
        self.tangent = found.slopes()
        if secants and not self._law.smooth:
            self.tangent = self.tangent + self._secants(found)
        facets, places = found.of_acting
        weights = factor * source.weights[facets, places]
        D = np.ascontiguousarray(self.tangent)
        loops.add_slopes(D, weights, source.shapes[places], *into)

    @override
    def after(self) -> ShapeMemory:
        """Return the state after the last evaluation.

        Raises:
            ConvergenceError: The body has gone through the obstacle, or this turns too far.
        """
        before, found = self.state, self.evaluation
        assert found is not None
        trial = (found if found.last.facets is None else self._evaluated(before)).state()
        if self._shape.costly:
            trial = self._exact(trial, np.flatnonzero(is_near(trial, self.source)))
        turned = (before.normal * trial.normal).sum(axis=2) < OPPOSITE
        flipped = before.outcome.inside & trial.outcome.inside & turned
        x = trial.outcome.positions
        if flipped.any() or passes(self._shape, self.source, before, x, trial.pose):
            raise ConvergenceError(
                "A body goes through the obstacle of a Rigid in one step; take smaller steps"
            )
        last, pose = before.pose, trial.pose
        turn = pose.turn_from(last) if self._whole_turns else pose.least_turn_from(last)
        rubs = not self._law.smooth and bool(trial.outcome.inside.any())
        if rubs and turn > QUARTER * (1.0 + NEGLIGIBLE):
            raise ConvergenceError(
                f"An obstacle turns by {turn:.3g} rad in one step, and friction follows a "
                "quarter of a turn at most; turn it in smaller steps, by a path (update=), and "
                "count whole turns on"
            )
        self._reach.forget()
        return trial

    @override
    def roll_back(self) -> None:
        super().roll_back()
        self.pose = self.state.pose
        self._reach.forget()

    # -- What is kept ---------------------------------------------------------------------------

    @override
    def columns(self) -> dict[str, NDArray[Any]]:
        return super().columns() | {"own anchor": self.state.anchor}

    @override
    def restore(self, columns: dict[str, NDArray[Any]]) -> None:
        """Take what was kept, anchors in the frame of the shape if that is still the same one."""
        memory, touched = self.state, columns["touches"][:, :, None]
        anchor = framed(self._shape, memory.pose, columns["anchor"])
        own = columns["own anchor"]
        same = np.abs(own - anchor).max(axis=2, keepdims=True) <= self.source.touch
        self.state = replace(
            memory,
            anchor=np.where(touched, np.where(same, own, anchor), memory.anchor),
            outcome=retold(memory.outcome, columns),
            friction=worn(columns.get("friction"), memory.friction),
        )


def _started(shape: Shape, memory: ShapeMemory, y: Array) -> Array:
    """Return where points at y were at the last converged step, in the frame of a shape."""
    return framed(shape, memory.pose, memory.outcome.positions).reshape(y.shape)
