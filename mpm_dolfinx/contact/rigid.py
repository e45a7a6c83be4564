# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Contact of a body with a rigid obstacle on a path."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, override

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import mesh

from ..errors import MPMError
from ..io.snapshot import Taken
from ..parallel.boundary import collective
from ..parallel.given import as_positive, require_same
from ..particles.particles import Particles
from ..reals import as_reals
from ..tolerances import NEGLIGIBLE
from .contact import Contact
from .law import Friction, as_friction
from .passes import Kept
from .placed import Placed, placed
from .rotation import Pose
from .shape_pass import ShapePass
from .shapes import Shape, as_point, as_rotation
from .surface import Surface

__all__ = ["Rigid"]


class Rigid(Contact):
    """Contact of a body with a rigid obstacle, with friction.

    Points on the body's facets may touch the obstacle, stick, slide and lift off. The pressure is
    ``penalty M / h`` times the penetration, M a modulus of the material and h the height of the
    domain behind over the facet (and over the square of its degree), so that ``penalty`` is a
    number without unit. It makes the
    body softer by about one layer of domains, and should stay near 1: where facets
    are chords of a curved surface, a larger one puts all load on their ends. It acts on the area
    that facets have at a step's beginning; by Nitsche's method, and in a motion that keeps energy,
    on the undeformed one. Friction remembers where each point has stuck to the obstacle.

    Give it to ``QuasiStaticProblem(..., terms=[contact])``, and move the obstacle along a path::

        shape = mpm.contact.polygon(corners, radius=0.05)
        pile = mpm.contact.Rigid(soil, shape, friction=0.3)
        problem = mpm.QuasiStaticProblem(mpm.Body(soil, law), bcs, terms=[pile])
        problem.solve(40, update=lambda t: pile.move((0.0, -0.5 * t)))

    Args:
        particles: The body.
        shape: The obstacle, of :mod:`mpm_dolfinx.contact`, as it lies at the beginning.
        friction: Coefficient of friction, a :class:`Coulomb` with cohesion and a limit, or another
            law of :class:`Friction`.
        facets: Tags of the body's facets and the tag of those that may touch, ``(tags, 1)``, where
            not all of its boundary may.
        modulus: Modulus of the body; that of the material by default.
        penalty: Stiffness in the normal direction, without unit.
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
        facets: tuple[mesh.MeshTags, int] | None = None,
        modulus: float | None = None,
        penalty: float = 1.0,
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
        self._penalty = as_positive(penalty, "penalty")
        surface = Surface(particles, facets, None, axisymmetric, "A Rigid")
        super().__init__([surface], rubs, law, own, self._made)
        self.shape = shape
        self._pose = self._aim = Pose(np.zeros(gdim), np.zeros(1 if gdim == 2 else 3))

    def _made(self, stiffnesses: Sequence[NDArray[np.float64]]) -> list[ShapePass]:
        """Return its pass."""
        self._pass = ShapePass(
            self._passes.surfaces[0],
            self.friction,
            self._penalty,
            stiffnesses[0],
            self.shape,
            self._pose,
            self._counts_turns,
        )
        return [self._pass]

    @property
    def _counts_turns(self) -> bool:
        """Whether whole turns count in its angle."""
        return True

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

    # -- The term -------------------------------------------------------------------------------

    @override
    def begin(self) -> Sequence[PETSc.Vec]:
        super().begin()
        self._pose = self._pass.pose = self._aim
        require_same(self.bodies[0].mesh.comm, offset=self._pose.offset, angle=self._pose.angle)
        self._pass.require_free_way()
        return ()

    @override
    def drives(self) -> bool:
        return not self._pose.same_as(self._pass.state.pose) and not self.smooth()

    @override
    def roll_back(self) -> None:
        super().roll_back()
        self._pose = self._pass.pose

    @override
    def _held_by(self, before: Contact) -> list[Kept] | None:
        if not isinstance(before, Rigid) or before.bodies != self.bodies:
            return None
        kept = before.held()
        if kept is None or not self._passes.fits(kept):
            return None
        mine, surface, held = self._pass, self._passes.surfaces[0], kept[0]
        gap, normal = (surface.of_column(held[name]) for name in ("gap", "normal"))
        there = np.abs(gap - mine.gap) <= NEGLIGIBLE * surface.layout.extent
        alike = there & (np.abs(normal - mine.normals).max(axis=2) <= NEGLIGIBLE)
        whole = surface.column(there & there.all(axis=1)[:, None]).values
        same = surface.column(alike).values
        for name, values in held.items():
            here = whole if name in ("area", "thickness") else same
            more = (1,) * (values.ndim - here.ndim)
            none = np.zeros_like(values)
            held[name] = np.where(here.reshape(*here.shape, *more), values, none)
        return kept

    @override
    def held(self) -> list[Kept] | None:
        """Return the columns of its body, with gaps and normals; ``None``: it has no problem."""
        kept, surface = super().held(), self._passes.surfaces[0]
        if kept is not None:
            kept[0]["gap"] = surface.column(self._pass.gap).values
            kept[0]["normal"] = surface.column(self._pass.normals).values
        return kept

    # -- What is kept ---------------------------------------------------------------------------

    @override
    def numbers(self) -> dict[str, Any]:
        """Return where the obstacle was."""
        pose, aim = self._pass.state.pose, self._aim
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
        return [*super().known_by(), kind, pivot.tolist(), depth]

    @override
    def take(self, taken: Taken) -> None:
        pose = Pose(*(np.array(taken.numbers[name]) for name in ("offset", "angle")))
        aim = taken.numbers.get("aim", (pose.offset, pose.angle))
        self._pose, self._aim = pose, Pose(*map(np.array, aim))
        super().take(taken)
