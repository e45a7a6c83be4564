# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Contact of a body with a rigid obstacle on a path."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import mesh

from ..errors import ConvergenceError, MPMError, agree, agreed, as_ours
from ..io.snapshot import Taken
from ..meshes.remesh import Column
from ..parallel.given import require_same
from ..particles.particles import Particles
from ..reals import as_reals, is_one_of
from ..system.term import PointMaterial
from .behind import Behind, ThroughGroups
from .contact import Contact, Outcome, stiffness
from .law import (
    Coulomb,
    Points,
    Push,
    Traction,
    as_friction,
    derivative,
    nitsche,
    push_derivative,
    secant_along,
    shear_derivative,
    traction,
)
from .memory import Memory, Near, Step
from .rotation import Pose
from .shapes import Shape, as_positive
from .slip_changes import SlipChanges
from .surface import Blocks, PointMatrix, Surface, global_dofs
from .ways import OPPOSITE, crosses, gets_deep
from .whole_step import corrected, corrected_slope, mean_pressure, pressure_slope

__all__ = ["Placed", "Rigid"]

#: What the pressure is made of.
LAWS = ("penalty", "nitsche")
#: Penetration, over the thickness of the domain behind, from which a body is in an obstacle
#: rather than on it.
DEEP = 1.0
#: The same for a body as it is given.
OVERLAP = 0.1
#: Gap, over the thickness of the domain behind, up to which a facet may touch in a step; and share
#: of facets that do so up to which others are left out.
NEAR, MOST_NEAR = 2.0, 0.7
#: How much farther facets are looked for than they have come nearer, where that was too far.
FARTHER = 1.4
#: Most points of each rank at which the shapes of ranks are compared.
LOOKED_AT = 16


class Placed(NamedTuple):
    """An obstacle in one place.

    Attributes:
        distance: Its signed distance, a function of points ``(n, gdim)``.
        bounds: Corners of a box around it, shape ``(2, gdim)``; ``None`` where it has none.
        facets: Points and facets of its surface, ``None`` where it has no facets.
    """

    distance: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    bounds: NDArray[np.float64] | None
    facets: tuple[NDArray[np.float64], NDArray[np.int64]] | None


class Rigid(Contact):
    """Contact of a body with a rigid obstacle, with friction.

    Points on the body's facets may touch the obstacle, stick, slide and lift off. The pressure is
    ``penalty M / h`` times the penetration, M a modulus of the material and h the thickness of the
    domain behind the facet (over the square of its degree), so that ``penalty`` is a number
    without unit. It makes the
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
        friction: Coefficient of friction, or a :class:`Coulomb` with cohesion and a limit.
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

    def __init__(
        self,
        particles: Particles,
        shape: Shape,
        friction: float | Coulomb = 0.0,
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
        if not is_one_of(law, LAWS):
            raise MPMError(f"law must be one of {', '.join(map(repr, LAWS))}, not {law!r}.")
        require_same(
            particles.mesh.comm,
            friction=[rubs.friction, rubs.cohesion, rubs.limit],
            tag=tag,
            modulus=modulus,
            penalty=penalty,
            tangential_penalty=tangential_penalty,
            quadrature_degree=quadrature_degree,
            axisymmetric=axisymmetric,
            law=law,
        )
        super().__init__([particles], rubs, axisymmetric)
        self._nitsche = law == "nitsche"
        self._behind: Behind | None = None
        self._groups: ThroughGroups | None = None
        self.shape = shape
        self._modulus = None if modulus is None else as_positive(modulus, "modulus")
        self._penalty = as_positive(penalty, "penalty")
        self._tangential = as_positive(tangential_penalty, "tangential_penalty")
        self._surface = Surface(
            particles, facet_tags, tag, quadrature_degree, axisymmetric, "A Rigid"
        )
        self._pose = self._aim = Pose(np.zeros(gdim), np.zeros(1 if gdim == 2 else 3))
        self._memory: Memory | None = None
        self._trial: Memory | None = None
        self._near: Near | None = None
        self._wider: Near | None = None
        self._slip_changes = SlipChanges()
        self._stretch: NDArray[np.float64] | None = None

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
        pose, shape = self._pose, self.shape

        def out(y: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray((y - shape.pivot) @ pose.Q.T + shape.pivot + pose.offset)

        bounds = None
        if shape.bounds is not None:
            corners = np.stack(np.meshgrid(*shape.bounds.T), axis=-1).reshape(-1, shape.dim)
            bounds = np.array([f(out(corners), axis=0) for f in (np.min, np.max)])
        facets = None if shape.outline is None else (out(shape.outline[0]), shape.outline[1])

        def distance(x: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray(shape.distance(self._framed(x, pose))[0])

        return Placed(distance, bounds, facets)

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

    def _framed(self, x: NDArray[Any], pose: Pose) -> NDArray[Any]:
        """Return positions in the frame of the shape."""
        arms = x.reshape(-1, x.shape[-1]) - (self.shape.pivot + pose.offset)
        return (arms @ pose.Q + self.shape.pivot).reshape(x.shape)

    # -- The term -------------------------------------------------------------------------------

    def take_part(
        self,
        number: int,
        bodies: Sequence[Particles],
        materials: Sequence[PointMaterial | None],
    ) -> None:
        """See :meth:`Term.take_part`."""
        super().take_part(number, bodies, materials)
        if self._nitsche:
            self._require_stress()
        self._behind = self._groups = None
        first = self._memory is None
        self._settle()
        if first:
            self._require_same_shape()
            assert self._memory is not None
            self._require_apart(self._memory)

    def _require_stress(self) -> None:
        """Raise an error where no material gives the stress behind the facets.

        Raises:
            MPMError: There is none, or it is no stress of the displacement alone.
        """
        instead = "use law='penalty'"
        material = self._materials[0]
        if material is None:
            raise MPMError(
                "law='nitsche' of a Rigid takes the stress of the body's material, which is in the "
                f"forms of this problem alone; use a QuasiStaticProblem, or {instead}."
            )
        if material.mean_stress is not None:
            raise MPMError(
                "law='nitsche' of a Rigid does not go with mixed='pressure', whose stress depends "
                f"on another field; {instead}, or f_bar='patch'."
            )

    def pace(self, dt: float, share: float) -> None:
        """See :meth:`Term.pace`.

        Raises:
            MPMError: The forces of the scheme are no ones of a step's end.
        """
        if self._nitsche and share < 1.0:
            raise MPMError(
                "law='nitsche' of a Rigid has forces of a step's end, and would add energy with "
                "each impact in this scheme; use scheme='euler', or law='penalty'."
            )
        super().pace(dt, share)

    @property
    def symmetric(self) -> bool:
        """See :attr:`Term.symmetric`."""
        return super().symmetric and not self._nitsche

    @property
    def takes_stress(self) -> bool:
        """See :attr:`Term.takes_stress`."""
        return self._nitsche

    def _require_same_shape(self) -> None:
        """Raise an error where ranks have different shapes, by some distances (collective)."""
        if self._comm.size == 1:
            return
        x = self._surface.positions(converged=True).reshape(-1, self.shape.dim)
        places = np.concatenate(self._comm.allgather(x[:: 1 + len(x) // LOOKED_AT]))
        with agree(self._comm):
            distances = self.shape.distance(self._framed(places, self._pose))[0]
        told = distances.astype(np.float32).tolist()
        require_same(self._comm, shape=[type(self.shape).__name__, *told])

    def _settle(self) -> None:
        """Take the present mesh of the body (collective)."""
        if self._surface.settle():
            k = stiffness(self._surface, self._modulus, self._materials[0], "A Rigid")
            self._stiffness = np.repeat(k[:, None], self._surface.nq, axis=1)
            self._new_pattern()
            self._behind = self._groups = None
            self._begin_anew(self._pose)

    def _begin_anew(self, pose: Pose) -> None:
        """Take the converged positions for those of points that nothing has touched yet."""
        self._near = self._stretch = None
        x = self._surface.positions(converged=True)
        m, nq, gdim = x.shape
        with agree(self._comm):
            y = self._framed(x, pose).reshape(-1, gdim)
            phi, n = self.shape.distance(y)
        none = np.zeros((m, nq), dtype=bool)
        nothing = np.zeros((m, nq))
        still = Outcome(x, phi.reshape(m, nq), nothing, np.zeros_like(x), none, none)
        self._memory = self._trial = Memory(
            pose, none, y.reshape(x.shape), phi.reshape(m, nq), n.reshape(x.shape), still
        )

    def _new_pattern(self) -> None:
        W = self.bodies[0].W
        self._matrix = PointMatrix(W, W)

    def _require_apart(self, memory: Memory) -> None:
        """Raise an error where the body is in the obstacle from the beginning (collective)."""
        surface = self._surface
        depth = -memory.gap / surface.thickness[:, None]
        deep = (depth > OVERLAP) & (surface.weights > 0.0)
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

    def begin(self) -> Sequence[PETSc.Vec]:
        """See :meth:`Term.begin`."""
        self._settle()
        self._surface.look_at_deleted()
        assert self._memory is not None
        memory = self._memory
        self._pose = self._aim
        require_same(self._comm, offset=self._pose.offset, angle=self._pose.angle)
        self._new_pattern()
        self._slip_changes.begin()
        with agree(self._comm):
            x = memory.outcome.positions
            if self._passes(memory, x, self._pose):
                raise ConvergenceError(
                    "The obstacle of a Rigid moves through the body in one step; move it in "
                    "smaller ones, by a path (update=)"
                )
        self._look_near()
        return ()

    def _passes(self, memory: Memory, x: NDArray[np.float64], pose: Pose) -> bool:
        """Return whether points get deep into the obstacle, or through it, on a straight way.

        Args:
            memory: Where they begin.
            x: Where they end, shape ``(m, nq, gdim)``.
            pose: Where the obstacle ends.
        """
        surface = self._surface
        deep = DEEP * np.broadcast_to(surface.thickness[:, None], memory.gap.shape)
        a = self._framed(memory.outcome.positions, memory.pose)
        b = self._framed(x, pose)
        way = np.linalg.norm(b - a, axis=2)
        reached = memory.gap - way < -deep
        if gets_deep(self.shape, a, b, memory.gap, deep, reached & (surface.weights > 0.0)):
            return True
        near = (memory.gap < way) & (way > 0.0) & (surface.weights > 0.0)
        thickness, gap, normal = deep[near] / DEEP, memory.gap[near], memory.normal[near]
        if len(gap) and not memory.exact:
            gap, normal = self.shape.distance(a[near])
        return crosses(self.shape, a[near], b[near], gap, normal, thickness)

    def update(self) -> MPMError | None:
        """See :meth:`Term.update`."""
        try:
            self._trial = self._evaluated()
        except MPMError as error:
            return error
        return None

    def _points(self, memory: Memory) -> Points:
        """Return the points of facets of which something is known."""
        which = memory.facets
        k = (self._stiffness if which is None else self._stiffness[which]).ravel()
        gdim = memory.anchor.shape[2]
        return Points(
            self._penalty * k,
            self._tangential * k,
            memory.touched.ravel(),
            memory.anchor.reshape(-1, gdim),
            memory.gap.ravel(),
            self._stretch_of(which).ravel(),
        )

    def _stretch_of(self, which: NDArray[np.int64] | None) -> NDArray[np.float64]:
        """Return the stretch of facets that counts for friction: that at the step's beginning."""
        if self._stretch is None:
            return self._surface.stretch(self.friction.by_area, which)
        return self._stretch if which is None else self._stretch[which]

    def _evaluated(self, whole: bool = False) -> Memory:
        """Return what acts at the present positions.

        Args:
            whole: Whether to look at facets as well that are too far to touch.
        """
        memory = self._memory
        assert memory is not None
        near = None if whole else self._within_reach()
        if near is None:
            if not (whole or memory.exact):
                self._memory = memory = self._exact(memory)
            return self._evaluated_on(memory)
        return self._evaluated_on(near.memory)

    def _look_near(self) -> None:
        """Note which facets may touch in a step, and what others may move until they could.

        And their stretch, once in a step: where it is committed bodies are at its end already, and
        a motion begins its terms anew.
        """
        if self._stretch is None:
            self._stretch = self._surface.stretch(self.friction.by_area)
        self._near, self._wider = self._nearer_than(0.0), None

    def _nearer_than(self, distance: float) -> Near | None:
        """Return the facets that are within a distance, or some domains; ``None``: nearly all."""
        memory, surface = self._memory, self._surface
        assert memory is not None
        if self._nitsche or not self.shape.measures or memory.gap.size == 0:
            return None
        least = memory.gap.min(axis=1)
        near = least <= np.maximum(NEAR * surface.thickness, distance)
        if near.mean() > MOST_NEAR:
            return None
        which = np.flatnonzero(near)
        nodes = surface.own_nodes(converged=True)
        arms = nodes - self.shape.pivot - memory.pose.offset
        radius = float(np.linalg.norm(arms, axis=1).max())
        if (arm := self.shape.arm) is not None:
            radius = min(radius, arm)
        margin = float(least[~near].min()) - surface.touch
        return Near(memory.of(which), nodes, radius, margin)

    def _within_reach(self) -> Near | None:
        """Return what may touch at the present positions; ``None``: all."""
        near = self._near
        if near is None or (moved := self._approach(near)) < near.margin:
            return near
        if self._wider is None or moved >= self._wider.margin:
            self._wider = self._nearer_than(FARTHER * moved)
        wider = self._wider
        return wider if wider is not None and moved < wider.margin else None

    def _approach(self, near: Near) -> float:
        """Return by how much points have come nearer to the obstacle in the step at most."""
        memory, pose = self._memory, self._pose
        assert memory is not None
        shifted = float(np.linalg.norm(pose.offset - memory.pose.offset))
        turned = float(np.linalg.norm(pose.Q - memory.pose.Q, 2)) * near.radius
        return self._surface.spread * (self._largest_change(near) + turned) + shifted

    def _largest_change(self, near: Near) -> float:
        """Return how far a node of the facets has moved in the step at most."""
        change = self._surface.own_nodes() - near.nodes
        return float(np.sqrt((change * change).sum(axis=1).max(initial=0.0)))

    def _positions(self, which: NDArray[np.int64] | None) -> NDArray[np.float64]:
        """Return where points of some facets are, ``None``: of all."""
        return self._surface.positions(which=which)

    def _evaluated_on(self, memory: Memory) -> Memory:
        """Return what acts on facets of which something is known."""
        pose, which = self._pose, memory.facets
        x = self._positions(which)
        m, nq, gdim = x.shape
        y = self._framed(x, pose).reshape(-1, gdim)
        points = self._points(memory)
        touch = self._surface.touch
        behind, reach = None, np.full(len(y), touch)
        if self._nitsche:
            behind = self._stress_behind().tractions(self._material)
            reach = touch + np.linalg.norm(behind, axis=2).ravel() / points.stiffness
        phi, n = self._distance(y, memory, reach)
        pushes, step, Q = n, None, pose.Q
        pressure, pressed = None, None
        if behind is not None:
            push = nitsche(points, (behind @ Q).reshape(-1, gdim), phi, n, touch)
            pressure, pressed = push.pressure, push.acts.reshape(m, nq)
        if self._of_step:
            step = self._step(points, memory, y, phi)
            pushes, Q = step.gradient, memory.pose.mean(pose)
            pressure = step.pressure
        acts = traction(
            self.friction,
            points,
            y - points.anchor,
            phi,
            n if step is None else step.normal,
            touch,
            pressure,
        )
        shape = (m, nq)
        normal, shear = (
            (part @ Q.T).reshape(x.shape) for part in (acts.pressure[:, None] * pushes, acts.shear)
        )
        force = normal + shear
        works = (0.0, 0.0)
        if step is not None:
            moves = self._weights(memory)[:, :, None] * (x - memory.outcome.positions)
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
            else self._anchors(points, y, phi, n, acts.shear, outcome).reshape(x.shape),
            outcome.gap,
            n.reshape(x.shape),
            outcome,
            works,
            step,
            behind,
            pressed,
            which,
        )

    def _known(self, trial: Memory) -> Memory:
        """Return what was known of the facets that were looked at."""
        assert self._memory is not None
        if trial.facets is None:
            return self._memory
        for near in (self._near, self._wider):
            if near is not None and near.memory.facets is trial.facets:
                return near.memory
        return self._memory.of(trial.facets)

    def _weights(self, memory: Memory) -> NDArray[np.float64]:
        """Return the undeformed areas of the points of facets of which something is known."""
        weights = self._surface.weights
        return weights if memory.facets is None else np.asarray(weights[memory.facets])

    def _stress_behind(self) -> Behind:
        """Return what takes the stress at the points of domains to their facets."""
        if self._behind is None:
            self._behind = Behind(self._surface)
        return self._behind

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
        if self.shape.costly:
            before = self._framed(memory.outcome.positions, memory.pose).reshape(y.shape)
            phi = memory.gap.ravel() - np.linalg.norm(y - before, axis=1)
            near = ~(phi > reach)
        phi[near], n[near] = self._measured(y[near])
        return phi, n

    def _measured(self, y: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return gaps and normals of points in the frame of the shape."""
        try:
            return self.shape.distance(y)
        except MPMError:
            raise
        except Exception as error:
            raise as_ours(error, "The shape of a Rigid") from error

    def _step(
        self,
        points: Points,
        memory: Memory,
        y: NDArray[np.float64],
        gap: NDArray[np.float64],
    ) -> Step:
        """Return what there is of a step to positions and gaps at all points."""
        before = memory.gap.ravel()
        x = memory.outcome.positions
        change = y - self._framed(x, memory.pose).reshape(y.shape)
        middle = y - 0.5 * change
        surface = self._surface
        n = memory.normal.reshape(y.shape).copy()
        acts = (before <= surface.touch) | (gap <= surface.touch)
        n[acts] = self.shape.distance(middle[acts])[1]
        gradient, factor = corrected(n, change, change, gap - before, surface.extent)
        pressure = mean_pressure(points.stiffness, before, gap, surface.touch)
        return Step(change, middle, n, gradient, factor, before, pressure)

    def _works(self) -> tuple[float, float]:
        """See :meth:`Contact._works`."""
        assert self._trial is not None
        return self._trial.works

    def _anchors(
        self,
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

    def smooth(self) -> bool:
        """See :meth:`Term.smooth`: contact is not."""
        assert self._trial is not None and self._memory is not None
        return not bool(self._trial.touched.any() or self._memory.touched.any())

    def residuals(self) -> Sequence[PETSc.Vec]:
        """See :meth:`Term.residuals`."""
        assert self._trial is not None
        trial = self._trial
        return [self._surface.force(trial.outcome.traction, -1.0 / self._share, trial.facets)]

    def tangents(self) -> Mapping[tuple[int, int], PETSc.Mat]:
        """See :meth:`Term.tangents`; points that change their slip have secants."""
        return self._tangents(not self.friction.smooth)

    def derivatives(self) -> Mapping[tuple[int, int], PETSc.Mat]:
        """See :meth:`Term.derivatives`."""
        return self._tangents(False)

    def _tangents(self, secants: bool) -> Mapping[tuple[int, int], PETSc.Mat]:
        """Return the derivatives of the forces.

        Args:
            secants: Whether points that have changed their slip take secants instead.
        """
        assert self._trial is not None
        trial, surface = self._trial, self._surface
        memory = self._known(trial)
        here, inside, flat = self._acting(trial, memory)
        which = trial.numbers(here)
        D = np.zeros((len(which), surface.nq, surface.gdim, surface.gdim))
        if len(flat):
            D[inside] = self._derivative(trial, memory, flat) / self._share
        if secants:  # (also where nothing touches on this rank: it notes that)
            D[inside] += self._secants(trial, memory, flat) / self._share
        N, w = surface.shapes, surface.weights[which]
        k = N.shape[1] * surface.gdim
        blocks = np.einsum("mq,qa,qb,mqij->maibj", -w, N, N, D, optimize=True)
        dofs = global_dofs(self.bodies[0].W, surface.nodes[which])
        parts = [Blocks(which, dofs, dofs, blocks.reshape(-1, k, k))]
        if trial.behind is None:
            K = self._matrix.of(parts)
            return {} if K is None else {(0, 0): K}
        force = np.zeros_like(trial.behind)
        force.reshape(-1, surface.gdim)[flat] = self._by_stress(trial, memory, flat)
        force *= -surface.weights[:, :, None]
        K = self._matrix.of([*parts, self._blocks_behind(trial, which, dofs, force)])
        averaging = self._material.averaging
        if K is not None and averaging is not None:
            if self._groups is None:
                self._groups = ThroughGroups(self._stress_behind(), surface, averaging)
            K = self._groups.added_to(K, trial.normal @ trial.pose.Q.T, force)
        return {} if K is None else {(0, 0): K}

    @property
    def _material(self) -> PointMaterial:
        material = self._materials[0]
        assert material is not None
        return material

    def _blocks_behind(
        self,
        trial: Memory,
        which: NDArray[np.int64],
        rows: NDArray[np.int64],
        force: NDArray[np.float64],
    ) -> Blocks:
        """Return what residuals have from displacements of the domains behind some facets.

        Args:
            trial: What acts.
            which: The facets.
            rows: Dofs of their nodes.
            force: What residuals have at all points by traction along the normal.
        """
        behind, N = self._stress_behind(), self._surface.shapes
        along = (trial.normal @ trial.pose.Q.T)[which]
        slopes = behind.slopes(self._material, along, which)
        blocks = np.einsum("qa,mqi,mqbj->maibj", N, force[which], slopes, optimize=True)
        columns = global_dofs(self.bodies[0].W, behind.nodes[which])
        shape = (len(which), rows.shape[1], columns.shape[1])
        return Blocks(which, rows, columns, blocks.reshape(shape))

    def _push(
        self, trial: Memory, memory: Memory, flat: NDArray[np.int64], bent: bool = False
    ) -> Push:
        """Return the pressure of Nitsche's method at some points.

        Args:
            trial: What acts.
            memory: What is known of the last converged step.
            flat: Their numbers.
            bent: Whether the derivative of the pressure is asked for.
        """
        gdim, pose = self._surface.gdim, trial.pose
        assert trial.behind is not None
        H = None
        if bent:
            x = trial.outcome.positions.reshape(-1, gdim)[flat]
            H = self.shape.curvature(self._framed(x, pose))
        return nitsche(
            self._points(memory).of(flat),
            trial.behind.reshape(-1, gdim)[flat] @ pose.Q,
            trial.gap.ravel()[flat],
            trial.normal.reshape(-1, gdim)[flat],
            self._surface.touch,
            H,
        )

    def _by_stress(
        self, trial: Memory, memory: Memory, flat: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return the derivative of the traction at some points by that of the stress behind.

        Of the latter by its part along the normal, shape ``(n, gdim)``.
        """
        gdim, pose = self._surface.gdim, trial.pose
        points = self._points(memory).of(flat)
        y = self._framed(trial.outcome.positions.reshape(-1, gdim)[flat], pose)
        force = push_derivative(
            self.friction,
            points,
            y - points.anchor,
            trial.gap.ravel()[flat],
            trial.normal.reshape(-1, gdim)[flat],
            self._surface.touch,
            self._push(trial, memory, flat),
        )
        return np.asarray(force @ pose.Q.T)

    def _acting(
        self, trial: Memory, memory: Memory
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.int64]]:
        """Return facets that touch, which of their points do, and the numbers of these points.

        As places among the facets that were looked at, and among their points.
        """
        surface, acting = self._surface, trial.touched
        if self._of_step:
            acting = acting | (memory.gap <= surface.touch)
        if trial.behind is not None:
            assert trial.pressed is not None
            acting = acting | trial.pressed
        here = np.flatnonzero(
            acting.any(axis=1) & (self._weights(trial).max(axis=1, initial=0.0) > 0.0)
        )
        inside = acting[here]
        flat = (here[:, None] * surface.nq + np.arange(surface.nq))[inside]
        return here, inside, flat

    def _derivative(
        self, trial: Memory, memory: Memory, flat: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return the derivative of the traction by positions at some points that touch."""
        Q = self._rotation(trial, memory)
        return np.asarray(Q @ self._derivative_within(trial, memory, flat) @ trial.pose.Q.T)

    def _secants(
        self, trial: Memory, memory: Memory, flat: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return what tangents have besides where points have changed their slip."""
        gdim, Q = self._surface.gdim, self._rotation(trial, memory)
        slips = trial.outcome.slips.ravel()
        normal = trial.normal if trial.step is None else trial.step.normal
        n, pressure = normal.reshape(-1, gdim), trial.outcome.pressure.ravel()
        force = np.linalg.solve(Q, trial.outcome.traction.reshape(-1, gdim).T).T
        shear = force - n * (n * force).sum(axis=1)[:, None]
        m, nq = self._surface.weights.shape
        place = nq * trial.numbers(np.arange(len(trial.gap)))[:, None] + np.arange(nq)
        slipping, along = np.zeros(m * nq, dtype=bool), np.zeros((m * nq, gdim))
        slipping[place.ravel()], along[place.ravel()] = slips, shear
        changed = self._slip_changes.note(slipping, along)[place.ravel()][flat]
        found = np.zeros((len(flat), gdim, gdim))
        if not changed.any():
            return found
        some = flat[changed]
        points = self._points(memory).of(some)
        y = self._framed(trial.outcome.positions.reshape(-1, gdim)[some], trial.pose)
        acts = Traction(pressure[some], shear[some], slips[some], slips[some])
        gap = trial.gap.ravel()[some]
        secant = secant_along(points, y - points.anchor, gap, n[some], self._surface.touch, acts)
        found[changed] = Q @ secant @ trial.pose.Q.T
        return found

    def _rotation(self, trial: Memory, memory: Memory) -> NDArray[np.float64]:
        """Return what turns tractions out of the frame of the shape."""
        return memory.pose.mean(trial.pose) if self._of_step else trial.pose.Q

    def _derivative_within(
        self, trial: Memory, memory: Memory, flat: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return :meth:`_derivative` in the frame of the shape."""
        surface, gdim = self._surface, self._surface.gdim
        y = self._framed(trial.outcome.positions.reshape(-1, gdim)[flat], trial.pose)
        n, gap = trial.normal.reshape(-1, gdim)[flat], trial.gap.ravel()[flat]
        points = self._points(memory).of(flat)
        delta = y - points.anchor
        touch, law = surface.touch, self.friction
        if not self._of_step:
            H = self.shape.curvature(y)
            push = None if trial.behind is None else self._push(trial, memory, flat, bent=True)
            return derivative(law, points, delta, gap, n, H, touch, push)
        assert trial.step is not None
        step = Step(*(part[flat] for part in trial.step))
        H = 0.5 * self.shape.curvature(step.middle)
        slope = pressure_slope(points.stiffness, step.before, gap, touch)
        turn = corrected_slope(step.normal, H, step.change, step.factor, n)
        D = step.gradient[:, :, None] * (slope[:, None] * n)[:, None, :]
        D = D + step.pressure[:, None, None] * turn
        if not law.smooth:
            acts = traction(law, points, delta, gap, step.normal, touch, step.pressure)
            dp = slope[:, None] * n
            D = D + shear_derivative(law, points, delta, gap, step.normal, H, touch, acts, dp, n)
        return np.asarray(D)

    # -- What it remembers ------------------------------------------------------------------------

    def commit(self) -> Callable[[], None]:
        """See :meth:`Term.commit`.

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
                least = trial.gap.min(axis=1, initial=np.inf)
                near = np.flatnonzero(least <= NEAR * self._surface.thickness)
                trial = self._exact(trial, near)
            turned = (before.normal * trial.normal).sum(axis=2) < OPPOSITE
            flipped = before.touched & trial.touched & turned
            if flipped.any() or self._passes(before, trial.outcome.positions, trial.pose):
                failure = ConvergenceError(
                    "A body goes through the obstacle of a Rigid in one step; take smaller steps"
                )
        except MPMError as error:
            failure = error
        if (failure := agreed(self._comm, failure)) is not None:
            raise failure
        self._memory = replace(trial, step=None)
        self._near = self._stretch = None

        def undo() -> None:
            self._memory = before

        return undo

    def _exact(self, memory: Memory, which: NDArray[np.int64] | None = None) -> Memory:
        """Return what is known with the gaps of all points of some facets, or of all facets."""
        chosen = slice(None) if which is None else which
        x = memory.outcome.positions[chosen]
        phi, n = self.shape.distance(self._framed(x, memory.pose).reshape(-1, x.shape[2]))
        gap, normal = memory.gap.copy(), memory.normal.copy()
        gap[chosen], normal[chosen] = phi.reshape(x.shape[:2]), n.reshape(x.shape)
        outcome = replace(memory.outcome, gap=gap)
        return replace(memory, gap=gap, normal=normal, outcome=outcome, exact=which is None)

    @property
    def gap(self) -> NDArray[np.float64]:
        """See :class:`Contact`."""
        self._outcome()
        assert self._memory is not None
        if not self._memory.exact:
            self._memory = self._exact(self._memory)
        return super().gap

    def roll_back(self) -> None:
        """See :meth:`Term.roll_back`."""
        assert self._memory is not None
        self._trial = self._memory
        self._pose = self._memory.pose
        self._near = self._stretch = None

    def _outcome(self) -> tuple[Surface, Outcome]:
        if self._memory is None:
            raise MPMError("A contact belongs to no problem yet; give it as terms=[contact].")
        return self._surface, self._memory.outcome

    def columns(self, body: int | None) -> dict[str, Column]:
        """Return what is kept on a body, by its number in the problem."""
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
        if self._tells_more:
            known["pressure"] = surface.column(memory.outcome.pressure)
            known["traction"] = surface.column(memory.outcome.traction)
        return known

    def numbers(self) -> dict[str, Any]:
        """Return where the obstacle was."""
        assert self._memory is not None
        pose = self._memory.pose
        return {"offset": pose.offset.tolist(), "angle": pose.angle.tolist()}

    def take(self, taken: Taken) -> None:
        """Take what was kept (collective)."""
        columns = taken.columns[self._places[0]]
        pose = Pose(*(np.array(taken.numbers[name]) for name in ("offset", "angle")))
        surface = self._surface
        self._settle()
        surface.restore(columns)
        self._behind = self._groups = None
        k = stiffness(surface, self._modulus, self._materials[0], "A Rigid")
        self._stiffness = np.repeat(k[:, None], surface.nq, axis=1)
        self._pose = self._aim = pose
        self._begin_anew(pose)
        assert self._memory is not None
        touched = surface.of_column(columns["touches"])
        anchor = np.where(
            touched[:, :, None], surface.of_column(columns["anchor"]), self._memory.anchor
        )
        found = self._memory
        self._memory = Memory(pose, touched, anchor, found.gap, found.normal, found.outcome)
        outcome = found.outcome
        if self._tells_more:
            told = {name: surface.of_column(columns[name]) for name in ("pressure", "traction")}
            outcome = replace(outcome, **told)
        else:
            outcome = self._evaluated_at_converged().outcome
        outcome = replace(outcome, inside=touched, slips=surface.of_column(columns["slips"]))
        self._memory = self._trial = replace(self._memory, outcome=outcome)

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
