# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A rigid obstacle on a path, and what points of a body remember of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, override

import numpy as np
from numpy.typing import NDArray

from ..assembly.petsc import MatrixSum
from ..errors import MPMError, agree
from ..io.snapshot import Taken
from ..meshes.remesh import Column
from ..reals import as_reals
from ..tolerances import NEGLIGIBLE
from .contact import Contact, Outcome, stiffness
from .law import Friction, unworn
from .memory import Grip, Memory
from .nitsche import Nitsche
from .obstacle_tractions import ObstacleTractions
from .placed import Placed, framed, placed, unframed
from .reach import Reach
from .rotation import Pose
from .shapes import Shape, as_point, as_rotation
from .surface import PointMatrix, Surface

__all__ = ["Obstacle"]


class Obstacle(Contact):
    """A rigid obstacle on a path, with the memory of a body's points that touch it.

    Args:
        surface: The points.
        tractions: What acts on them.
        shape: The obstacle.
        friction: The law of friction.
        modulus: Modulus of the body; ``None``: that of the material.
        law: What the pressure is made of.
    """

    def __init__(
        self,
        surface: Surface,
        tractions: ObstacleTractions,
        shape: Shape,
        friction: Friction,
        modulus: float | None,
        law: str,
    ) -> None:
        super().__init__([surface.particles], friction, surface.axisymmetric, law)
        self.shape = shape
        self._modulus = modulus
        self._surface, self._tractions = surface, tractions
        self._reach = Reach(surface, shape)
        gdim = shape.dim
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
        gdim = self.shape.dim
        to = as_point(offset, "offset of an obstacle", gdim)
        self._pose = self._aim = Pose(to, as_rotation(angle, "angle of an obstacle", gdim))

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
        points = as_reals(x)
        if points.ndim != 2 or points.shape[1] != self.shape.dim:
            raise MPMError(f"Points have the shape (n, {self.shape.dim}), not {points.shape}.")
        return self.placed().distance(points)

    # -- Its points --------------------------------------------------------------------------------

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

    def _forget_step(self) -> None:
        """Forget what is noted for a step alone."""
        self._reach.forget()
        self._tractions.forget_stretch()

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

    # -- What it remembers -------------------------------------------------------------------------

    def _known(self, trial: Memory) -> Memory:
        """Return the memory of the facets that were looked at in a trial."""
        assert self._memory is not None
        return self._reach.known(trial, self._memory)

    def _exact(self, memory: Memory, which: NDArray[np.int64] | None = None) -> Memory:
        """Return the memory with the gaps of all points of some facets, or of all facets."""
        chosen = slice(None) if which is None else which
        x = memory.outcome.positions[chosen]
        phi, n = self.shape.distance(framed(self.shape, memory.pose, x).reshape(-1, x.shape[2]))
        gap, normal = memory.gap.copy(), memory.normal.copy()
        gap[chosen], normal[chosen] = phi.reshape(x.shape[:2]), n.reshape(x.shape)
        outcome = memory.outcome._replace(gap=gap)
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
            outcome = outcome._replace(**told)
        else:
            outcome = self._evaluated_at_converged().outcome
        outcome = outcome._replace(inside=touched, slips=surface.of_column(columns["slips"]))
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
        there = np.abs(seen(before.gap) - memory.gap) <= NEGLIGIBLE * surface.layout.extent
        whole = surface.column(there & there.all(axis=1)[:, None]).values
        known = before.surface.columns().items()
        surface.restore({name: np.where(whole, c.values, 0.0) for name, c in known})
        self._take_stiffness()
        same = seen(before.touched) & there
        same &= np.abs(seen(before.normal) - n).max(axis=2) <= NEGLIGIBLE
        anchor = framed(self.shape, memory.pose, seen(before.anchor))
        acts, mine, rubbed = before.outcome, memory.outcome, memory.friction
        if before.friction.shape[2] == rubbed.shape[2]:
            rubbed = np.where(same[:, :, None], seen(before.friction), rubbed)
        outcome = mine._replace(
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
