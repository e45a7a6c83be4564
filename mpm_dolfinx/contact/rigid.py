# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Contact of a body with a rigid obstacle on a path."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple, override

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import mesh

from ..errors import ConvergenceError, MPMError, agree, agreed
from ..parallel.boundary import collective
from ..parallel.given import as_positive, require_same
from ..particles.particles import Particles
from ..system.term import PointMaterial
from ..tolerances import NEGLIGIBLE
from .behind import At
from .contact import require_apart
from .law import Friction, as_friction
from .memory import Memory
from .nitsche import Spread, require_stress
from .obstacle import Obstacle
from .obstacle_tractions import Acting, ObstacleTractions
from .placed import framed
from .reach import is_near
from .rotation import Pose
from .shapes import Shape
from .surface import Blocks, Surface, global_dofs
from .ways import OPPOSITE, passes

__all__ = ["Rigid"]

#: Most that an obstacle turns in a step at whose end points rub against it: friction is along the
#: chord of their way in its frame.
MOST_TURN = 0.5 * np.pi
#: What is said of a body that is in the obstacle from the beginning.
WITHIN = (
    "The body begins within the obstacle of a Rigid: {particles} are up to {depth:.3g} deep in it, "
    "at {where}; move one of them away."
)


class Slopes(NamedTuple):
    """Derivatives of what acts at points that touch.

    Attributes:
        trial: What acts.
        acting: The points.
        facets: Numbers of their facets, shape ``(n,)``.
        dofs: Global dofs of these, shape ``(n, k gdim)``.
        by_position: Of tractions by positions, as often as forces count, ``(n, nq, gdim, gdim)``.
    """

    trial: Memory
    acting: Acting
    facets: NDArray[np.int64]
    dofs: NDArray[np.int64]
    by_position: NDArray[np.float64]


class Rigid(Obstacle):
    """Contact of a body with a rigid obstacle, with friction.

    Points on the body's facets may touch the obstacle, stick, slide and lift off. The pressure is
    ``penalty M / h`` times the penetration, M a modulus of the material and h the height of the
    domain behind over the facet (and over the square of its degree), so that ``penalty`` is a
    number without unit. It makes the
    body softer by about one layer of domains, and should stay near 1: where facets
    are chords of a curved surface, a larger one puts all load on their ends. Friction
    remembers where each point has stuck to the obstacle.

    Give it to ``QuasiStaticProblem(..., terms=[contact])``, and move the obstacle along a path::

        shape = mpm.contact.polygon(corners, radius=0.05)
        pile = mpm.contact.Rigid(soil, shape, friction=0.3)
        problem = mpm.QuasiStaticProblem(soil, law, terms=[pile])
        problem.solve(40, update=lambda t: pile.move((0.0, -0.5 * t)))

    Args:
        particles: The body.
        shape: The obstacle, of :mod:`mpm_dolfinx.contact`, as it lies at the beginning.
        friction: Coefficient of friction, a :class:`Coulomb` with cohesion and a limit, or another
            law of :class:`Friction`.
        facet_tags: Tags of the body's facets, where not all of its boundary may touch.
        tag: The tag of those that may.
        modulus: Modulus of the body; that of the material by default.
        penalty: Stiffness in the normal direction, without unit.
        tangential_penalty: Stiffness of points that stick, without unit.
        quadrature_degree: Degree of the rule on each facet; ``None`` is one more than twice the
            degree of the shape functions.
        axisymmetric: Whether ``x[0]`` is a radius.
        law: ``"penalty"``, or ``"nitsche"``: the pressure is that of the stress behind the facet,
            and the penalty holds the gap at zero. It takes the body's material, and a solver for
            tangents that are not symmetric.

    Raises:
        MPMError: What makes no sense.
    """

    @collective()
    def __init__(
        self,
        particles: Particles,
        shape: Shape,
        friction: float | Friction = 0.0,
        *,
        facet_tags: mesh.MeshTags | None = None,
        tag: int | None = None,
        modulus: float | None = None,
        penalty: float = 1.0,
        tangential_penalty: float = 1.0,
        quadrature_degree: int | None = None,
        axisymmetric: bool = False,
        law: str = "penalty",
    ) -> None:
        if not isinstance(particles, Particles):
            raise MPMError(f"A contact needs mpm.Particles, not {type(particles).__name__}.")
        gdim = particles.mesh.geometry.dim
        if not isinstance(shape, Shape):
            raise MPMError(
                f"A Rigid needs a shape of mpm.contact, such as plane(...) or disc(...), not "
                f"{type(shape).__name__}."
            )
        if shape.dim != gdim:
            raise MPMError(f"The shape is one in {shape.dim} dimensions, the body in {gdim}.")
        rubs = as_friction(friction)
        own = None if modulus is None else as_positive(modulus, "modulus")
        penalties = (
            as_positive(penalty, "penalty"),
            as_positive(tangential_penalty, "tangential_penalty"),
        )
        surface = Surface(particles, facet_tags, tag, quadrature_degree, axisymmetric, "A Rigid")
        tractions = ObstacleTractions(surface, shape, rubs, *penalties)
        super().__init__(surface, tractions, shape, rubs, own, law)

    # -- The term -------------------------------------------------------------------------------

    @override
    def take_part(
        self,
        number: int,
        bodies: Sequence[Particles],
        materials: Sequence[PointMaterial | None],
    ) -> None:
        super().take_part(number, bodies, materials)
        if self._nitsche:
            require_stress(self._materials[0], "a Rigid")
        self._tractions.of_step = self._of_step
        self._take_stress()
        self._settle(self._joins)
        if self._joins:
            self._require_same_shape()
            for contact in self._gone:
                if isinstance(contact, Rigid) and contact.bodies == self.bodies:
                    self._stand_in(contact.grip())
            assert self._memory is not None
            require_apart(self._surface, self._memory.outcome, WITHIN)
            self._has_joined()

    @override
    def pace(self, dt: float, share: float) -> None:
        super().pace(dt, share)
        self._tractions.of_step = self._of_step
        self._tractions.inertial = self._inertial(0, self._surface, dt)

    def _require_same_shape(self) -> None:
        """Raise an error where ranks have different shapes, by some distances (collective)."""
        if self._comm.size == 1:
            return
        x = self._surface.positions(converged=True).reshape(-1, self.shape.dim)
        # at most 16 points of each rank
        places = np.concatenate(self._comm.allgather(x[:: 1 + len(x) // 16]))
        with agree(self._comm):
            distances = self.shape.distance(framed(self.shape, self._pose, places))[0]
        told = distances.astype(np.float32).tolist()
        require_same(self._comm, shape=[type(self.shape).__name__, *told])

    @override
    def begin(self) -> Sequence[PETSc.Vec]:
        self._settle()
        self._surface.look_at_deleted()
        assert self._memory is not None
        memory = self._memory
        self._pose = self._aim
        require_same(self._comm, offset=self._pose.offset, angle=self._pose.angle)
        self._new_pattern()
        self._tractions.slip_changes.begin()
        with agree(self._comm):
            x = memory.outcome.positions
            if passes(self.shape, self._surface, memory, x, self._pose):
                raise ConvergenceError(
                    "The obstacle of a Rigid moves through the body in one step; move it in "
                    "smaller ones, by a path (update=)"
                )
        self._look_near()
        return ()

    def _look_near(self) -> None:
        """Note which facets may touch in a step, and the stretch of all."""
        self._tractions.hold_stretch()
        if self._nitsche:  # (the stress presses wherever it does)
            self._reach.forget()
        else:
            assert self._memory is not None
            self._reach.look(self._memory)

    @override
    def update(self) -> MPMError | None:
        try:
            self._trial = self._evaluated()
        except MPMError as error:
            return error
        return None

    @override
    def _works(self) -> tuple[float, float]:
        assert self._trial is not None
        return self._trial.works

    @override
    def smooth(self) -> bool:
        """Return false: contact is not smooth."""
        assert self._trial is not None and self._memory is not None
        return not bool(self._trial.touched.any() or self._memory.touched.any())

    @override
    def drives(self) -> bool:
        assert self._memory is not None
        return not self._pose.same_as(self._memory.pose) and not self.smooth()

    @override
    def residuals(self) -> Sequence[PETSc.Vec]:
        assert self._trial is not None
        trial = self._trial
        return [self._surface.force(trial.outcome.traction, -1.0 / self._share, trial.facets)]

    @override
    def tangents(self) -> Mapping[tuple[int, int], PETSc.Mat]:
        """Return tangents, with secants where points change their slip."""
        return self._tangents(not self.friction.smooth)

    @override
    def derivatives(self) -> Mapping[tuple[int, int], PETSc.Mat]:
        return self._tangents(False)

    def _tangents(self, secants: bool) -> Mapping[tuple[int, int], PETSc.Mat]:
        """Return the derivatives of the forces.

        Args:
            secants: Whether points that have changed their slip take secants instead.
        """
        surface, tractions = self._surface, self._tractions
        slopes = self._slopes(secants)
        parts = [self._blocks_of(slopes)]
        if tractions.nitsche is None:
            K = self._matrix.of(parts)
            return {} if K is None else {(0, 0): K}
        trial, flat = slopes.trial, slopes.acting.flat
        memory = self._known(trial)
        along = (trial.normal @ trial.pose.Q.T).reshape(-1, surface.gdim)[flat]
        at = At(flat // surface.nq, flat % surface.nq, along)
        force = -surface.weights.ravel()[flat, None] * tractions.by_stress(trial, memory, flat)
        by_stress = tractions.nitsche.tangents(at, [Spread.over_facets(surface, at, force)])
        found = [K for K in (self._matrix.of(parts), *by_stress) if K is not None]
        return {(0, 0): self._sum.of(found)} if found else {}

    def _slopes(self, secants: bool) -> Slopes:
        """Return the derivatives of the tractions at points that touch.

        Args:
            secants: As for :meth:`_tangents`.
        """
        assert self._trial is not None
        trial, surface, tractions = self._trial, self._surface, self._tractions
        memory = self._known(trial)
        acting = tractions.acting(trial, memory)
        which, inside = trial.numbers(acting.here), acting.inside
        D = np.zeros((len(which), surface.nq, surface.gdim, surface.gdim))
        if len(acting.flat):
            D[inside] = tractions.derivative(trial, memory, acting.flat) / self._share
        if secants:  # (also where nothing touches on this rank: it notes that)
            D[inside] += tractions.secants(trial, memory, acting.flat) / self._share
        dofs = global_dofs(self.bodies[0].W, surface.layout.nodes[which])
        return Slopes(trial, acting, which, dofs, D)

    def _blocks_of(self, slopes: Slopes) -> Blocks:
        """Return the derivatives of forces on nodes by nodes."""
        surface, (m, k) = self._surface, slopes.dofs.shape
        N, w = surface.shapes, surface.weights[slopes.facets]
        values = np.einsum("mq,qa,qb,mqij->maibj", -w, N, N, slopes.by_position, optimize=True)
        return Blocks(slopes.facets, slopes.dofs, slopes.dofs, values.reshape(m, k, k))

    # -- What it remembers ------------------------------------------------------------------------

    @override
    def commit(self) -> Callable[[], None]:
        """Commit the step.

        Raises:
            ConvergenceError: The body has gone through the obstacle.
        """
        before, trial = self._memory, self._trial
        assert before is not None and trial is not None
        failure: MPMError | None = None
        try:
            if trial.facets is not None:
                trial = self._evaluated(whole=True)
            if self.shape.costly:
                trial = self._exact(trial, np.flatnonzero(is_near(trial, self._surface)))
            turned = (before.normal * trial.normal).sum(axis=2) < OPPOSITE
            flipped = before.touched & trial.touched & turned
            if flipped.any() or passes(
                self.shape, self._surface, before, trial.outcome.positions, trial.pose
            ):
                failure = ConvergenceError(
                    "A body goes through the obstacle of a Rigid in one step; take smaller steps"
                )
            turn = self._turn(before.pose, trial.pose)
            rubs = not self.friction.smooth and bool(trial.touched.any())
            if rubs and turn > MOST_TURN * (1.0 + NEGLIGIBLE):
                failure = ConvergenceError(
                    f"An obstacle turns by {turn:.3g} rad in one step, and friction follows a "
                    "quarter of a turn at most; turn it in smaller steps, by a path (update=), and "
                    "count whole turns on"
                )
        except MPMError as error:
            failure = error
        if (failure := agreed(self._comm, failure)) is not None:
            raise failure
        self._memory = replace(trial, step=None)
        self._forget_step()

        def undo() -> None:
            self._memory = before

        return undo

    def _turn(self, last: Pose, pose: Pose) -> float:
        """Return the angle by which the obstacle has turned in a step."""
        return pose.turn_from(last)

    @override
    def roll_back(self) -> None:
        assert self._memory is not None
        self._trial = self._memory
        self._pose = self._memory.pose
        self._forget_step()
