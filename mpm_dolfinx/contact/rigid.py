# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Contact of a body with a rigid obstacle on a path."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, override

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import mesh

from ..assembly.petsc import MatrixSum
from ..errors import ConvergenceError, MPMError, agree, agreed
from ..io.snapshot import Taken
from ..meshes.remesh import Column
from ..parallel.boundary import collective
from ..parallel.given import as_positive, require_same
from ..particles.particles import Particles
from ..reals import as_reals
from ..system.term import PointMaterial
from .behind import At
from .contact import Contact, Outcome, stiffness
from .law import Friction, as_friction, unworn
from .memory import Grip, Memory
from .nitsche import Nitsche, Spread, require_stress
from .obstacle_tractions import Acting, ObstacleTractions
from .placed import Placed, framed, placed, unframed
from .reach import Reach, is_near
from .rotation import Pose
from .shapes import Shape
from .surface import Blocks, PointMatrix, Surface, global_dofs
from .ways import OPPOSITE, passes

__all__ = ["Rigid"]

#: Penetration, over the thickness of the domain behind, of a body that is given in an obstacle.
OVERLAP = 0.1
#: Most that an obstacle turns in a step at whose end points rub against it: friction is along the
#: chord of their way in its frame.
MOST_TURN = 0.5 * np.pi
#: Difference of normals, and of gaps over the body's coordinates, of obstacles in the same place.
SAME = 1e-10


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


class Rigid(Contact):
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
        super().__init__([particles], rubs, axisymmetric, law)
        self.shape = shape
        self._modulus = None if modulus is None else as_positive(modulus, "modulus")
        penalties = (
            as_positive(penalty, "penalty"),
            as_positive(tangential_penalty, "tangential_penalty"),
        )
        self._surface = Surface(
            particles, facet_tags, tag, quadrature_degree, axisymmetric, "A Rigid"
        )
        self._tractions = ObstacleTractions(self._surface, shape, rubs, *penalties)
        self._reach = Reach(self._surface, shape)
        self._pose = self._aim = Pose(np.zeros(gdim), np.zeros(1 if gdim == 2 else 3))
        self._memory: Memory | None = None
        self._trial: Memory | None = None

    # -- The path -------------------------------------------------------------------------------

    def move(self, offset: Any, angle: Any = 0.0) -> None:
        """Put the obstacle where it is to be at the end of the next step.

        It turns about the pivot of its shape, and is shifted then. Both are counted from where it
        was made, not from where it is. A path, ``update=``, is asked again where a step is made
        smaller; what was moved without one goes the whole way in the next step, however small.

        Args:
            offset: Shape ``(gdim,)``.
            angle: Angle in radians, anticlockwise; in space the vector of rotation, shape ``(3,)``,
                whose length is the angle.

        Raises:
            MPMError: No finite numbers of these shapes.
        """
        gdim = len(self._pose.offset)
        count = len(self._pose.angle)
        try:
            to = as_reals(offset)
            turn = np.atleast_1d(as_reals(angle))
        except (TypeError, ValueError):
            to = turn = np.zeros(0)
        if count == 3 and turn.shape == (1,) and turn[0] == 0.0:
            turn = np.zeros(3)
        good = to.shape == (gdim,) and turn.shape == (count,)
        if not good or not (np.isfinite(to).all() and np.isfinite(turn).all()):
            raise MPMError(
                f"An obstacle moves by an offset of {gdim} numbers and an angle of {count}, not "
                f"{offset!r} and {angle!r}."
            )
        self._pose = self._aim = Pose(to, turn)

    @property
    def offset(self) -> NDArray[np.float64]:
        """Offset of the obstacle now, shape ``(gdim,)``."""
        return self._pose.offset.copy()

    @property
    def angle(self) -> NDArray[np.float64]:
        """Angle of the obstacle now, shape ``(1,)``, or its vector of rotation, ``(3,)``."""
        return self._pose.angle.copy()

    def placed(self) -> Placed:
        """Return the obstacle as it is now; it does not follow when this one moves."""
        return placed(self.shape, self._pose)

    def distance(self, x: Any) -> NDArray[np.float64]:
        """Return the distance of points to the obstacle now, negative inside, shape ``(n,)``.

        Args:
            x: Points, shape ``(n, gdim)``.

        Raises:
            MPMError: No points of this dimension.
        """
        points = np.asarray(x, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != self.shape.dim:
            raise MPMError(f"Points have the shape (n, {self.shape.dim}), not {points.shape}.")
        return self.placed().distance(points)

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
            self._require_apart(self._memory)
            self._joins, self._gone = False, []

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

    def _settle(self, anew: bool = False) -> None:
        """Take the present mesh of the body (collective).

        Args:
            anew: Whether to begin anew on the same mesh too.
        """
        if self._surface.settle() or anew:
            self._take_stiffness()
            self._take_stress()
            self._new_pattern()
            self._begin_anew(self._pose)

    def _take_stiffness(self) -> None:
        """Take the stiffness of the body behind its facets (collective)."""
        k = stiffness(self._surface, self._modulus, self._materials[0], "A Rigid")
        self._tractions.settle(k)

    def _take_stress(self) -> None:
        """Take the stress behind the present facets, where the pressure is that."""
        material = self._materials[0]
        if self._nitsche and material is not None:
            self._tractions.nitsche = Nitsche(self._surface, material)

    def _begin_anew(self, pose: Pose) -> None:
        """Take the converged positions for those of points that nothing has touched yet."""
        self._forget_step()
        x = self._surface.positions(converged=True)
        m, nq, gdim = x.shape
        with agree(self._comm):
            y = framed(self.shape, pose, x).reshape(-1, gdim)
            phi, n = self.shape.distance(y)
        none = np.zeros((m, nq), dtype=bool)
        nothing = np.zeros((m, nq))
        still = Outcome(x, phi.reshape(m, nq), nothing, np.zeros_like(x), none, none)
        self._memory = self._trial = Memory(
            pose,
            none,
            y.reshape(x.shape),
            phi.reshape(m, nq),
            n.reshape(x.shape),
            still,
            unworn(self.friction, (m, nq)),
        )

    def _new_pattern(self) -> None:
        W = self.bodies[0].W
        self._matrix, self._sum = PointMatrix(W, W), MatrixSum()
        if self._tractions.nitsche is not None:
            self._tractions.nitsche.new_pattern()

    def _require_apart(self, memory: Memory) -> None:
        """Raise an error where the body is in the obstacle from the beginning (collective)."""
        surface = self._surface
        depth = -memory.gap / surface.thickness[:, None]
        deep = (depth > OVERLAP) & (surface.weights > 0.0) & ~memory.touched
        with agree(self._comm):
            if deep.any():
                place = np.unravel_index(np.argmax(np.where(deep, depth, 0.0)), depth.shape)
                where = tuple(float(f"{x:.6g}") for x in memory.outcome.positions[place])
                index = self.bodies[0].global_index[surface.cells[deep.any(axis=1)]]
                raise MPMError(
                    f"The body begins within the obstacle of a Rigid: {{particles}} are up to "
                    f"{-float(memory.gap[place]):.3g} deep in it, at {where}; move one of them "
                    "away.",
                    index,
                )

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

    def _forget_step(self) -> None:
        """Forget what is noted for a step alone."""
        self._reach.forget()
        self._tractions.forget_stretch()

    @override
    def update(self) -> MPMError | None:
        try:
            self._trial = self._evaluated()
        except MPMError as error:
            return error
        return None

    def _evaluated(self, whole: bool = False) -> Memory:
        """Return the memory with tractions at the present positions.

        Args:
            whole: Whether to look at facets as well that are too far to touch.
        """
        memory = self._memory
        assert memory is not None
        near = None if whole else self._reach.of(memory, self._pose)
        if near is None:
            if not (whole or memory.exact):
                self._memory = memory = self._exact(memory)
            near = memory
        x = self._surface.positions(which=near.facets)
        return self._tractions.evaluated(near, x, self._pose)

    def _known(self, trial: Memory) -> Memory:
        """Return the memory of the facets that were looked at in a trial."""
        assert self._memory is not None
        return self._reach.known(trial, self._memory)

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
        dofs = global_dofs(self.bodies[0].W, surface.nodes[which])
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
            if rubs and turn > MOST_TURN * (1.0 + SAME):
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

    def _exact(self, memory: Memory, which: NDArray[np.int64] | None = None) -> Memory:
        """Return the memory with the gaps of all points of some facets, or of all facets."""
        chosen = slice(None) if which is None else which
        x = memory.outcome.positions[chosen]
        phi, n = self.shape.distance(framed(self.shape, memory.pose, x).reshape(-1, x.shape[2]))
        gap, normal = memory.gap.copy(), memory.normal.copy()
        gap[chosen], normal[chosen] = phi.reshape(x.shape[:2]), n.reshape(x.shape)
        outcome = replace(memory.outcome, gap=gap)
        return replace(memory, gap=gap, normal=normal, outcome=outcome, exact=which is None)

    @property
    @override
    def gap(self) -> NDArray[np.float64]:
        self._outcome()
        assert self._memory is not None
        if not self._memory.exact:
            self._memory = self._exact(self._memory)
        return super().gap

    @property
    @override
    def friction_memory(self) -> NDArray[np.float64]:
        self._outcome()
        assert self._memory is not None
        return self._tractions.points(self._memory).memory

    @override
    def roll_back(self) -> None:
        assert self._memory is not None
        self._trial = self._memory
        self._pose = self._memory.pose
        self._forget_step()

    def _outcome(self) -> tuple[Surface, Outcome]:
        if self._memory is None:
            raise MPMError("A contact belongs to no problem yet; give it as terms=[contact].")
        return self._surface, self._memory.outcome

    def columns(self, body: int | None) -> dict[str, Column]:
        """Return the columns kept on a body, by its number in the problem."""
        if body is None or body != self._places[0]:
            return {}
        assert self._memory is not None
        memory, surface = self._memory, self._surface
        known = {
            **surface.columns(),
            "anchor": surface.column(memory.anchor),
            "touches": surface.column(memory.touched),
            "slips": surface.column(memory.outcome.slips),
        }
        if self.friction.memory:
            known["friction"] = surface.column(memory.friction)
        if self._tells_more:
            known["pressure"] = surface.column(memory.outcome.pressure)
            known["traction"] = surface.column(memory.outcome.traction)
        return known

    def numbers(self) -> dict[str, Any]:
        """Return where the obstacle was."""
        assert self._memory is not None
        pose, aim = self._memory.pose, self._aim
        return {
            "offset": pose.offset.tolist(),
            "angle": pose.angle.tolist(),
            "aim": [aim.offset.tolist(), aim.angle.tolist()],
        }

    @override
    def known_by(self) -> list[Any]:
        pivot = self.shape.pivot
        depth = float(self.shape.distance(pivot[None])[0][0])
        kind = type(self.shape).__name__.strip("_")
        return [type(self).__name__, kind, pivot.tolist(), depth, self._places]

    def take(self, taken: Taken) -> None:
        """Take what was kept (collective)."""
        columns = taken.columns[self._places[0]]
        pose = Pose(*(np.array(taken.numbers[name]) for name in ("offset", "angle")))
        aim = taken.numbers.get("aim", (pose.offset, pose.angle))
        surface = self._surface
        self._settle()
        surface.restore(columns)
        self._take_stress()
        self._take_stiffness()
        self._pose, self._aim = pose, Pose(*map(np.array, aim))
        self._begin_anew(pose)
        assert self._memory is not None
        touched = surface.of_column(columns["touches"])
        anchor = np.where(
            touched[:, :, None], surface.of_column(columns["anchor"]), self._memory.anchor
        )
        found = self._memory
        rubbed = found.friction
        if "friction" in columns and columns["friction"].shape[3] == rubbed.shape[2]:
            rubbed = surface.of_column(columns["friction"])
        self._memory = replace(found, touched=touched, anchor=anchor, friction=rubbed)
        outcome = found.outcome
        if self._tells_more:
            told = {name: surface.of_column(columns[name]) for name in ("pressure", "traction")}
            outcome = replace(outcome, **told)
        else:
            outcome = self._evaluated_at_converged().outcome
        outcome = replace(outcome, inside=touched, slips=surface.of_column(columns["slips"]))
        self._memory = self._trial = replace(self._memory, outcome=outcome)

    def grip(self) -> Grip:
        """Return how its points hold on to the obstacle at the last converged step."""
        assert self._memory is not None
        memory = self._memory if self._memory.exact else self._exact(self._memory)
        pose = memory.pose
        return Grip(
            self._surface,
            memory.touched,
            memory.gap,
            memory.normal @ pose.Q.T,
            unframed(self.shape, pose, memory.anchor),
            memory.outcome,
            memory.friction,
        )

    def _stand_in(self, before: Grip) -> None:
        """Take over how points hold on to an obstacle that was in the same place.

        Args:
            before: Of the contact that is gone, on the same body.
        """
        surface, memory = self._surface, self._memory
        assert memory is not None
        if before.surface.nq != surface.nq:
            return

        def seen(values: NDArray[Any]) -> NDArray[Any]:
            return surface.of_column(before.surface.column(values).values)

        n = memory.normal @ memory.pose.Q.T
        there = np.abs(seen(before.gap) - memory.gap) <= SAME * surface.extent
        whole = surface.column(there & there.all(axis=1)[:, None]).values
        known = before.surface.columns().items()
        surface.restore({name: np.where(whole, c.values, 0.0) for name, c in known})
        self._take_stiffness()
        same = seen(before.touched) & there
        same &= np.abs(seen(before.normal) - n).max(axis=2) <= SAME
        anchor = framed(self.shape, memory.pose, seen(before.anchor))
        acts, mine, rubbed = before.outcome, memory.outcome, memory.friction
        if before.friction.shape[2] == rubbed.shape[2]:
            rubbed = np.where(same[:, :, None], seen(before.friction), rubbed)
        outcome = replace(
            mine,
            pressure=np.where(same, seen(acts.pressure), mine.pressure),
            traction=np.where(same[:, :, None], seen(acts.traction), mine.traction),
            inside=same | mine.inside,
            slips=np.where(same, seen(acts.slips), mine.slips),
        )
        self._memory = self._trial = replace(
            memory,
            touched=same | memory.touched,
            anchor=np.where(same[:, :, None], anchor, memory.anchor),
            outcome=outcome,
            friction=rubbed,
        )

    @property
    def _tells_more(self) -> bool:
        """Whether tractions were other ones than positions tell.

        So they are by stress, of whole steps, and by areas of the end of the step before.
        """
        return self._nitsche or self._of_step or self.friction.by_area

    def _evaluated_at_converged(self) -> Memory:
        body = self.bodies[0]
        present = body.displacement.x.array.copy()
        body.displacement.x.array[:] = body.converged_displacement
        try:
            return self._evaluated()
        finally:
            body.displacement.x.array[:] = present
