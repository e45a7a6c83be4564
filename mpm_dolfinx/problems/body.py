# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A body of a problem: its particles, what they are made of, and what acts on them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

import ufl
from dolfinx import mesh

from ..constitutive.averaging import F_BARS
from ..errors import MPMError
from ..materials.fracture import Fracture
from ..materials.undrained import Undrained
from ..meshes.values import Value
from ..parallel.boundary import collective
from ..parallel.given import is_number, require_same
from ..parallel.kinds import explaining
from ..particles.particles import Particles
from ..reals import is_one_of
from .arguments import as_pairs, carried, holds
from .summary import counted

__all__ = ["Body", "PoreFluid", "as_given", "stays"]

#: What a body begins with, which a stage cannot change.
INITIAL = ("initial_stress", "velocity")


def stays(what: str, consequence: str) -> MPMError:
    """Return the error that something does not follow a body to another mesh."""
    return MPMError(f"{what} lives on the present body mesh, so {consequence}.")


@explaining
@dataclass(frozen=True, eq=False)
class PoreFluid:
    """The water in the pores of a body, for :class:`PorousProblem`.

    Args:
        permeability: Hydraulic conductivity over the specific weight of water (length^2 over
            pressure and time), not negative anywhere when a step begins: a
            :data:`~mpm_dolfinx.meshes.values.Value`, whose function is one of the volume ratio J
            that returns UFL, ``lambda J: k * J**3``.
        storage: Change of the water's volume by its pressure, per undeformed volume (one over a
            pressure): the porosity times the compressibility of water.
        density: Mass per volume of the water, on which the ``body_force`` of the body acts as well;
            0 where the pore pressure is the excess over the hydrostatic one.
        drained: Pairs of a pore pressure and a tag of the body's ``facet_tags``,
            where water comes and goes at this pressure; the rest of the boundary is impervious.
        inflow: Pairs of a volume of water that flows in per undeformed area and time, and a tag.
        pressure: Pore pressure at the beginning.

    Raises:
        MPMError: Numbers or lists that make no sense.
    """

    permeability: Value
    storage: Value = 0.0
    density: float = 0.0
    drained: Sequence[tuple[Value, int]] = ()
    inflow: Sequence[tuple[Value, int]] = ()
    pressure: Value = 0.0

    def __post_init__(self) -> None:
        """Say so where something makes no sense."""
        for name in ("drained", "inflow"):
            object.__setattr__(self, name, as_pairs(name, getattr(self, name)))
        for name, least in (("permeability", True), ("storage", False), ("density", False)):
            value = getattr(self, name)
            if name == "density" and not is_number(value):
                raise MPMError(f"density of a PoreFluid must be a number, not {value!r}.")
            if value is not None and not is_number(value):
                continue  # left to the problem, which knows the mesh
            if value is None or not (value > 0.0 if least else value >= 0.0):
                how = "positive" if least else "not negative"
                raise MPMError(f"{name} of a PoreFluid must be {how}, not {value!r}.")
            if value == np.inf:
                raise MPMError(f"{name} of a PoreFluid must be finite, not {value!r}.")


@explaining
@dataclass(frozen=True, eq=False)
class Body:
    """A body: its particles, what they are made of, and what acts on them (collective).

    Density, loads, pore pressure, and what it begins with are each a
    :data:`~mpm_dolfinx.meshes.values.Value`: numbers, UFL on the body mesh, or a function of
    coordinates.

    Args:
        particles: The particles.
        material: A material, or ``{cell tag: material}`` with ``cell_tags``.
        density: Mass per undeformed volume; in a :class:`PorousProblem` that of soil and water
            together. ``None`` is one where the body is at rest, and missing where it moves.
        body_force: Force per mass at full load, shape ``(gdim,)``.
        tractions: Pairs of a dead load per undeformed area at full load, shape ``(gdim,)``, and a
            tag of ``facet_tags``.
        pressures: Pairs of a pressure at full load and a tag of ``facet_tags``; it acts on the
            deformed facets, against their normal, per deformed area (a follower load, whose
            tangent is not symmetric).
        cell_tags: Tags of the cells of ``particles.mesh``.
        facet_tags: Tags of its facets.
        f_bar: Average of the volume ratio that the material sees, against hourglass modes and
            locking: ``"none"``, ``"domain"`` (over a domain's points) or ``"patch"`` (over the
            domains of about one background cell).
        length: What plastic strain is averaged over where it softens the law (``decay``), so that
            a band of it is as wide on any mesh: about five lengths, for which the domains must be
            smaller than half of it. ``None``: each point softens by its own.
        initial_stress: Cauchy stress that the body carries before it has moved, which its material
            must be able to bear, shape ``(3, 3)`` with the direction out of the plane (or around
            the axis) at last, such as :func:`mpm_dolfinx.geostatic`; also one for each owned
            particle or point, ``(n, 3, 3)`` or ``(n, nq, 3, 3)``.
            What it is not in equilibrium with goes in proportion, as loads come, in the first run.
        velocity: At the beginning, in a :class:`DynamicProblem`, shape ``(gdim,)``.
        pore_fluid: The water in its pores, in a :class:`PorousProblem`.
        pore_pressure: A pore pressure that is known, at full load, such as a :class:`WaterTable` or
            a Function of steady seepage. The material is then the law of the effective stress, the
            density that of soil and water together, and the pressure acts by its gradient in the
            undeformed body: as buoyancy and seepage. On its boundary it is held, or open water has
            the same pressure.

    Raises:
        MPMError: Something that is none of these, or differs between ranks.
    """

    particles: Particles
    material: Any
    density: Value | None = None
    body_force: Value | None = None
    tractions: Sequence[tuple[Value, int]] = ()
    pressures: Sequence[tuple[Value, int]] = ()
    cell_tags: Any = None
    facet_tags: Any = None
    f_bar: str = "none"
    length: float | None = None
    initial_stress: Value | None = None
    velocity: Value | None = None
    pore_fluid: PoreFluid | None = None
    pore_pressure: Value | None = None

    @collective()
    def __post_init__(self) -> None:
        """Say so where something makes no sense."""
        if not isinstance(self.particles, Particles):
            raise MPMError(
                f"A Body is made of mpm.Particles, not of a {type(self.particles).__name__}."
            )
        given = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "particles"}
        require_same(self.particles.V.mesh.comm, **given)
        for name in ("tractions", "pressures"):
            object.__setattr__(self, name, as_pairs(name, getattr(self, name)))
        for name in ("cell_tags", "facet_tags"):
            tags = getattr(self, name)
            if tags is not None and not isinstance(tags, mesh.MeshTags):
                raise MPMError(f"{name} must be dolfinx MeshTags, not {type(tags).__name__}.")
        if not is_one_of(self.f_bar, F_BARS):
            raise MPMError(
                f"Unknown f_bar={self.f_bar!r}; choose one of {', '.join(map(repr, F_BARS))}."
            )
        if self.length is not None and not (is_number(self.length) and 0.0 < self.length < np.inf):
            raise MPMError(f"length must be a positive number or None, not {self.length!r}.")
        if self.pore_fluid is not None and not isinstance(self.pore_fluid, PoreFluid):
            raise MPMError(
                f"pore_fluid must be an mpm.PoreFluid, not a {type(self.pore_fluid).__name__}."
            )
        if self.pore_fluid is not None and self.pore_pressure is not None:
            raise MPMError(
                "A body has a pore_fluid=, whose pressure is found, or a pore_pressure=."
            )
        if self.pore_fluid is not None and any(isinstance(law, Undrained) for law in self.laws):
            raise MPMError(
                "A body has a pore_fluid=, or a law that is Undrained: both are the same water; "
                "give the law of effective stress alone beside a pore_fluid."
            )

    @property
    def laws(self) -> list[Any]:
        """Its laws, as they are given."""
        each = isinstance(self.material, Mapping)
        return list(self.material.values()) if each else [self.material]

    @property
    def may_crack(self) -> bool:
        """Whether a law of it is a :class:`mpm_dolfinx.materials.Fracture`."""
        return any(isinstance(law, Fracture) for law in self.laws)

    @property
    def takes_time(self) -> bool:
        """Whether a law of it has a ``relaxation_time``."""
        return any(getattr(law, "needs_time", False) for law in self.laws)

    def replace(self, **changes: Any) -> Body:
        """Return the same body with some things changed, such as ``tractions=[...]`` for a stage.

        Args:
            **changes: By the names of the arguments.
        """
        return replace(self, **changes)

    def changed_from(self, other: Body) -> dict[str, Any]:
        """Return the attributes that are another object than in another body, by name."""
        return {
            f.name: getattr(self, f.name)
            for f in fields(self)
            if getattr(self, f.name) is not getattr(other, f.name)
        }

    def in_words(self) -> str:
        """Return the laws, and what loads the body."""
        laws = self.material
        if isinstance(laws, Mapping):
            words = "; ".join(f"tag {tag}: {law!r}" for tag, law in laws.items())
        else:
            words = repr(laws)
        acts = ["body force"] if self.body_force is not None else []
        for loads, noun in ((self.tractions, "traction"), (self.pressures, "pressure")):
            if loads:
                acts.append(counted(len(loads), noun))
        more = [] if self.f_bar == "none" else [f"F-bar over each {self.f_bar}"]
        more += [] if self.length is None else [f"softening over a length of {self.length:g}"]
        more += [] if self.pore_fluid is None and self.pore_pressure is None else ["water"]
        return "; ".join([words, ", ".join(acts) or "no loads", *more])

    def carried(self) -> Body:
        """Return the same on the present mesh of the particles (collective)."""
        return replace(
            self,
            material=carried(self.particles, self.material),
            cell_tags=self.particles.carry(self.cell_tags),
            facet_tags=self.particles.carry(self.facet_tags),
        )

    def require_movable(self, consequence: str = "the particles cannot move") -> None:
        """Raise an error unless the body can be taken to another mesh.

        Args:
            consequence: What else cannot be.

        Raises:
            MPMError: Something lives on its present mesh.
        """
        for name, value in self._acting():
            if holds(value, ufl.core.expr.Expr):
                raise MPMError(
                    f"{name} is written on the present body mesh, so {consequence}; give numbers, "
                    "or a function of coordinates such as lambda x: 2.0 * x[1]."
                )
        laws = self.material.values() if isinstance(self.material, Mapping) else [self.material]
        for law in laws:
            if any(isinstance(value, np.ndarray) for value in law.parameters.values()):
                raise MPMError(
                    "A material has arrays of parameters, one value for each particle of a rank, "
                    f"so {consequence}; use DG0 Functions."
                )

    def require_movable_nodes(self, consequence: str) -> None:
        """Raise an error unless the nodes of the body's mesh can be moved; see above."""
        self.require_movable(consequence)
        if self.length is not None:
            raise stays("length=", consequence)
        for name, value in self._acting():
            if name != "permeability" and holds(value, Callable):
                raise MPMError(
                    f"{name} is a function of coordinates, which change, so {consequence}."
                )

    def _acting(self) -> Iterator[tuple[str, Any]]:
        """Yield the values that act on it in a run, by name."""
        for name in ("density", "body_force", "tractions", "pressures", "pore_pressure"):
            yield name, getattr(self, name)
        fluid = {} if self.pore_fluid is None else vars(self.pore_fluid)
        yield from ((name, value) for name, value in fluid.items() if name != "pressure")


def as_given(bodies: Body | Sequence[Body]) -> list[Body]:
    """Return the bodies of a problem as a list.

    Raises:
        MPMError: Something else than bodies.
    """
    every: list[Any] = list(bodies) if isinstance(bodies, list | tuple) else [bodies]
    for body in every:
        if not isinstance(body, Body):
            raise MPMError(
                "A problem is made of an mpm.Body(particles, material, ...) or a list of them, not "
                f"of a {type(body).__name__}."
            )
    if not every:
        raise MPMError("A problem is made of one mpm.Body at least; the list is empty.")
    return every
