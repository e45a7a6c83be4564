# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Which material governs which points of a body, with which parameters."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem, mesh

from ..errors import MPMError, agree
from ..materials.base import Material, Parameter, Refused, State, check_parameter
from ..meshes.tags import require_tags
from ..particles.particles import Particles
from .governed import Governed
from .pressure import MeanStress, is_split, without_bulk
from .succession import equals

__all__ = ["Assignment", "Materials", "equal_laws", "in_cells", "per_cell"]

type Materials = Material | Mapping[int, Material]


def equal_laws(one: Materials, other: Materials) -> bool:
    """Return whether a body's materials are equal, each for its tag."""
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return one.keys() == other.keys() and all(
            equals(law, other[tag]) for tag, law in one.items()
        )
    return isinstance(one, Material) and isinstance(other, Material) and equals(one, other)


class _Given(NamedTuple):
    """A material as the user gave it, and what its parameters were then."""

    material: Material
    parameters: dict[str, Any]

    def live(self) -> list[tuple[str, Any]]:
        """Return the parameters whose values are followed."""
        kinds = fem.Function | fem.Constant
        return [(n, v) for n, v in self.parameters.items() if isinstance(v, kinds)]

    def require_same(self) -> None:
        """Raise an error where the parameters are other objects now."""
        now = self.material.parameters
        if len(now) != len(self.parameters) or any(
            now.get(name) is not value for name, value in self.parameters.items()
        ):
            raise MPMError(
                f"Parameters of a {type(self.material).__name__} were replaced after the problem "
                "was made, which does not follow that; give DG0 Functions or Constants, whose "
                "values it follows, or make a new problem."
            )


class Assignment:
    """The materials of a body, each at the points that it governs (collective).

    Args:
        particles: The body.
        dim: Dimension of stress and strain.
        materials: One material, or one for each tag of ``cell_tags``.
        cell_tags: Tags of the body's cells.
        mean_stress: The pressure in place of the mean stress, if there is one.

    Attributes:
        particles: As given.
        dim: As given.
        num_points: Number of points of this rank.
        governed: The materials at their points.
        weakening: What the strength of all of them is divided by.
        duration: Of the steps of which updates are; infinite where no time passes.

    Raises:
        MPMError: Materials, tags or parameters that do not go together.
    """

    def __init__(
        self,
        particles: Particles,
        dim: int,
        materials: Materials,
        cell_tags: mesh.MeshTags | None,
        mean_stress: MeanStress | None,
    ) -> None:
        self.particles = particles
        self.dim = dim
        self.num_points = particles.num_local * particles.num_points
        self._mean_stress = mean_stress
        self.weakening = 1.0
        self.duration = math.inf
        with agree(particles.mesh.comm):
            chosen = self._chosen(materials, cell_tags)
            self._given = [_Given(material, dict(material.parameters)) for material, _ in chosen]
            self.governed = [self._governing(material, points) for material, points in chosen]

    def kinds(self) -> NDArray[np.int64]:
        """Return for each material the number of the first that equals it (collective)."""
        given = self.given
        equal = np.array([[equals(one, other) for other in given] for one in given])
        self.particles.mesh.comm.Allreduce(MPI.IN_PLACE, equal, MPI.LAND)
        return np.asarray(equal.argmax(axis=1))

    @property
    def given(self) -> list[Material]:
        """The materials as they were given."""
        return [given.material for given in self._given]

    def as_strong_as_given(self) -> list[Material]:
        """Return the materials at their points, whatever their strength is divided by."""
        if self.weakening == 1.0:
            return [part.material for part in self.governed]
        return [
            self._resolved(material, part.points, weakened=False)
            for material, part in zip(self.given, self.governed, strict=True)
        ]

    def follow_parameters(self) -> bool:
        """Take over the present values of parameters that are Functions or Constants (collective).

        Returns:
            Whether some have changed on this rank.

        Raises:
            MPMError: They are not allowed, or the parameters of a material are other objects than
                when this was made.
        """
        with agree(self.particles.mesh.comm):
            for given in self._given:
                given.require_same()
        for given in self._given:
            limits = given.material.limits
            for name, value in given.live():
                check_parameter(name, value, **limits.get(name, {}))
        changed = False
        for number, (given, part) in enumerate(zip(self._given, self.governed, strict=True)):
            if not given.live():
                continue
            present = self._resolved(given.material, part.points)
            if any(
                not np.array_equal(present.parameters[name], part.material.parameters[name])
                for name, _ in given.live()
            ):
                self.governed[number] = self._taken(present, part.points)
                changed = True
        return changed

    def assume(self, law: Material, name: str, value: Parameter) -> None:
        """Let a material, as it was given, have another number until the next call."""
        for number, material in enumerate(self.given):
            if material is law:
                other = law.with_parameters(**{name: value})
                self.governed[number] = self._governing(other, self.governed[number].points)

    def weaken(self, factor: float) -> None:
        """Divide the strength of all materials by a factor from now on, 1 at first (collective).

        Raises:
            MPMError: A material does not say what its strength is.
        """
        self.weakening = factor
        with agree(self.particles.mesh.comm):
            self.governed = [
                self._governing(material, part.points)
                for material, part in zip(self.given, self.governed, strict=True)
            ]

    def pace(self, duration: float) -> None:
        """Let updates be those of steps of a duration, infinite at first."""
        if duration == self.duration:
            return
        self.duration = duration
        for number, part in enumerate(self.governed):
            law = part.law.in_time(duration)
            if law is not part.law:
                self.governed[number] = replace(part, law=law)

    @contextmanager
    def in_no_time(self) -> Iterator[None]:
        """Let no time pass in updates in the block."""
        duration = self.duration
        self.pace(0.0)
        try:
            yield
        finally:
            self.pace(duration)

    # -- What is known of the laws -------------------------------------------------------------

    def by_domain[T: np.generic](self, values: NDArray[T]) -> NDArray[T]:
        """Return values at all points, shape ``(n nq, ...)``, as ``(n, nq, ...)``."""
        shape = self.particles.num_local, self.particles.num_points
        return values.reshape(*shape, *values.shape[1:])

    def where(self, holds: Callable[[Governed], bool]) -> NDArray[np.bool_]:
        """Return which points have a law for which something holds, shape ``(n nq,)``."""
        result = np.zeros(self.num_points, dtype=bool)
        for part in self.governed:
            result[part.points] = holds(part)
        return result

    @property
    def numbers(self) -> NDArray[np.int64]:
        """Number of the law of each domain, shape ``(n,)``."""
        result = np.zeros(self.particles.num_local, dtype=np.int64)
        for number, part in enumerate(self.governed):
            result[part.points // self.particles.num_points] = number
        return result

    @property
    def are_own(self) -> bool:
        """Whether all are of this package, which have no numbers but parameters."""
        return all(part.is_own for part in self.governed)

    @property
    def comes_apart(self) -> bool:
        """Whether mean stresses depend on the volume alone, so that a pressure can replace them."""
        return not any(part.at_pressure for part in self.governed)

    @property
    def at_pressure(self) -> NDArray[np.bool_]:
        """Whether the law of each point is evaluated at its pressure, shape ``(n nq,)``."""
        return self.where(lambda part: part.at_pressure)

    @property
    def has_small_strain(self) -> NDArray[np.bool_]:
        """Which points have a law of small strains, shape ``(n nq,)``."""
        return self.where(lambda part: part.material.kinematics == "small")

    def answers(
        self, gradient: NDArray[np.float64], states: list[State]
    ) -> tuple[NDArray[np.float64], list[State]]:
        """Return the answers of the materials (not collective).

        Args:
            gradient: ``F - I`` that they see, shape ``(n nq, dim, dim)``.
            states: Of each material at the beginning of the step.

        Returns:
            Their first Piola stress, of the same shape, and their states.
        """
        stress, found = np.zeros(gradient.shape), []
        for part, state in zip(self.governed, states, strict=True):
            everywhere = len(part.points) == self.num_points
            its = gradient if everywhere else gradient[part.points]
            answer = part.answer(its, state, tangent=False)
            if everywhere and part.is_own:
                stress = answer.first_piola
            else:
                stress[part.points] = answer.first_piola
            found.append(part.given_away(answer.state))
        return stress, found

    def tangents(self, gradient: NDArray[np.float64], states: list[State]) -> NDArray[np.float64]:
        """Return derivatives of :meth:`answers` as the materials tell them (not collective)."""
        found = np.zeros((self.num_points, *(self.dim,) * 4))
        for part, state in zip(self.governed, states, strict=True):
            found[part.points] = part.answer(gradient[part.points], state).tangent
        return found

    # -- How it is made --------------------------------------------------------------------------

    def _chosen(
        self, materials: Materials, cell_tags: mesh.MeshTags | None
    ) -> list[tuple[Material, NDArray[np.int64]]]:
        """Return each material with the points it is for."""
        each = np.arange(self.particles.num_points)
        return [
            (material, (cells[:, None] * len(each) + each).ravel())
            for material, cells in in_cells(self.particles, materials, cell_tags)
        ]

    def _governing(self, material: Material, points: NDArray[np.int64]) -> Governed:
        """Return a material as it was given at points."""
        return self._taken(self._resolved(material, points), points)

    def _taken(self, material: Material, points: NDArray[np.int64]) -> Governed:
        """Return a material at its points, without its mean stress where a pressure is that."""
        law = material.in_time(self.duration)
        whole = Governed(self.particles, self.dim, material, points, law)
        if self._mean_stress is None:
            return whole
        if not is_split(material):
            shear = whole.undeformed_tangent()[:, 0, 1, 0, 1]
            self._mean_stress.shear[points] = shear
            return replace(whole, at_pressure=True)
        law, bulk, soft = without_bulk(material)
        self._mean_stress.follow(points, material, bulk, soft)
        return replace(whole, law=law)

    def _resolved(
        self, material: Material, points: NDArray[np.int64], weakened: bool = True
    ) -> Material:
        """Return a material with its parameters at points, weakened or as given."""
        law = type(material).__name__
        if not isinstance(getattr(material, "symmetric", None), bool | np.bool_):
            raise MPMError(
                f"{law} does not say whether its tangent is symmetric; write symmetric = True (or "
                "False) into the class."
            )
        replaced: dict[str, float | NDArray[np.float64]] = {}
        for name, value in material.parameters.items():
            if isinstance(value, fem.Constant):
                replaced[name] = float(value.value)
            if not isinstance(value, fem.Function | np.ndarray):
                continue
            values = np.repeat(per_cell(self.particles, name, value), self.particles.num_points)
            values.flags.writeable = False
            replaced[name] = values
        if replaced:
            material = material.with_parameters(**replaced).at(points)
        if weakened and self.weakening != 1.0:
            material = material.weakened(self.weakening)
        return material


def in_cells(
    particles: Particles, materials: Materials, cell_tags: mesh.MeshTags | None
) -> list[tuple[Material, NDArray[np.int64]]]:
    """Return the materials of a body, each with the owned cells that it is for.

    Args:
        particles: The body.
        materials: A material, or one for each tag.
        cell_tags: Tags of the body's cells.

    Raises:
        MPMError: Something else, or cells without a material.
    """
    count = particles.num_local
    if isinstance(materials, Material):
        return [(materials, np.arange(count))]
    if not isinstance(materials, Mapping) or not all(
        isinstance(m, Material) for m in materials.values()
    ):
        raise MPMError(
            "material must be a material of mpm.materials or a dictionary "
            f"{{cell tag: material}}, not {type(materials).__name__}."
        )
    body = particles.mesh
    require_tags(body, cell_tags, "cells", "a material")
    assert cell_tags is not None
    tags = np.full(count, -1, dtype=np.int64)
    own = cell_tags.indices < count
    tags[cell_tags.indices[own]] = cell_tags.values[own]
    known = np.isin(tags, list(materials))
    without = particles.global_index[~known]
    if len(without):
        missing = ", ".join(str(tag) if tag >= 0 else "none" for tag in np.unique(tags[~known]))
        raise MPMError(
            f"The cell tags of {{particles}} ({missing}) have no material, as there are "
            f"materials for {', '.join(map(str, materials))} alone; give one for each tag.",
            without,
        )
    return [(material, np.flatnonzero(tags == tag)) for tag, material in materials.items()]


def per_cell(particles: Particles, name: str, value: Any) -> NDArray[np.float64]:
    """Return a parameter's values in the owned cells of a body, shape ``(n,)``.

    Args:
        particles: The body.
        name: Name of the parameter.
        value: A number for each owned cell, or a DG0 Function on the body's mesh.

    Raises:
        MPMError: Something else.
    """
    n = particles.num_local
    if isinstance(value, Refused):
        raise MPMError(value.message)
    if isinstance(value, np.ndarray):
        if value.shape != (n,):
            raise MPMError(
                f"The parameter {name} has {len(value)} values for {n} particles; give a "
                "number, a DG0 Function on the body, or one value for each owned particle."
            )
        return value
    space = value.function_space
    element = space.ufl_element()
    if space.mesh is not particles.mesh or element.degree != 0 or space.value_size != 1:
        raise MPMError(f"The parameter {name} must be a scalar DG0 Function on the body mesh.")
    return np.asarray(value.x.array[space.dofmap.list[:n, 0]])
