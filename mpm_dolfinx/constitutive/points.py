# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Materials at the quadrature points of particles: trial update, commit, roll back."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem, mesh

from .. import _compat
from ..errors import ConvergenceError, MPMError, agree, as_ours
from ..materials.base import (
    Material,
    Refused,
    State,
    StrainMaterial,
    Update,
    check_parameter,
)
from ..materials.compiled import CompiledMaterial
from ..materials.mandel import num_components
from ..meshes.remesh import Column
from ..particles.field import ParticleField
from .averaging import VolumeAveraging
from .pressure import MeanStress, VolumeStrain, is_split, without_bulk
from .strain import Strain

__all__ = ["MaterialPoints"]

FLOAT = np.dtype(np.float64)
#: What a law answers first of all.
STRESS = "stress P"

type Assignment = Material | Mapping[int, Material]


class _Group(NamedTuple):
    """A material and the points (of all of this rank's points) that it governs."""

    material: Material
    points: NDArray[np.int64]
    law: Material  # what is evaluated: the material, or it without its bulk modulus
    at_pressure: bool = False  # whether it is evaluated at a pressure, as it does not come apart


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
        if now.keys() != self.parameters.keys() or any(
            now[name] is not value for name, value in self.parameters.items()
        ):
            raise MPMError(
                f"Parameters of a {type(self.material).__name__} were replaced after the problem "
                "was made, which does not follow that; give DG0 Functions or Constants, whose "
                "values it follows, or make a new problem."
            )


class _Answer(NamedTuple):
    """What a material answers, with a tangent."""

    first_piola: NDArray[np.float64]
    tangent: NDArray[np.float64]
    state: State


class _Converged(NamedTuple):
    """What is known of the points at the last converged step.

    Attributes:
        states: What the material of each group keeps.
        gradient: ``F - I`` that the materials have seen, shape ``(n nq, dim, dim)``.
        stress: First Piola stress, of the same shape.
        volume: Volume strain, where a pressure takes the place of the mean stress.
        compliance: Its own, where a law is evaluated at the pressure.
        recovery: See :attr:`MaterialPoints.recovery`.
        resisted: Energy that F-bar resists, shape ``(n nq,)``.
    """

    states: list[State]
    gradient: NDArray[np.float64]
    stress: NDArray[np.float64]
    volume: NDArray[np.float64]
    compliance: NDArray[np.float64]
    recovery: NDArray[np.float64] | float
    resisted: NDArray[np.float64]


class MaterialPoints:
    """The history of all points of a body, kept apart from the update being tried.

    Args:
        strain: What the points of the body are strained in.
        assignment: One material, or one for each tag of ``cell_tags``.
        cell_tags: Tags of the body's cells.
        f_bar: Kind of average of the volume ratio, or ``"none"``.
        compiled: Whether materials may use their compiled updates.
        pressure: A Function at the points that takes the place of the mean stress, if any.

    Attributes:
        dim: Dimension of stress and strain, 2 in plane strain.
        strain: As given.
        compiled: As given.
        mean_stress: The pressure in place of the mean stress, or ``None``.
        averaging: F-bar, or ``None``; the material then sees Fbar, and what follows is what
            does work on F.
        first_piola: First Piola stress of the last update, shape ``(n nq, dim, dim)``.
        tangent: Its derivative by F, shape ``(n nq, dim, dim, dim, dim)``; with F-bar the
            pointwise part of it.

    Raises:
        MPMError: Materials, tags or parameters that do not go together.
    """

    def __init__(
        self,
        strain: Strain,
        assignment: Assignment,
        cell_tags: mesh.MeshTags | None,
        f_bar: str = "none",
        compiled: bool = True,
        pressure: ParticleField | None = None,
    ) -> None:
        self._particles = particles = strain.particles
        self.compiled = compiled
        self.strain = strain
        self.dim = strain.dim
        self._points = particles.num_local * particles.num_points
        self._given: list[_Given] = []
        self.mean_stress: MeanStress | None = None
        if pressure is not None:
            self.mean_stress = MeanStress(pressure, (self._points, self.dim))
        self._weakening = 1.0
        with agree(particles.mesh.comm):
            self._groups = self._group(assignment, cell_tags)
            states = [self._initial_state(group) for group in self._groups]
        shape = (self._points, self.dim, self.dim)
        none = np.zeros(self._points)
        self._last = _Converged(states, np.zeros(shape), np.zeros(shape), none, none, 0.0, none)
        self.first_piola = np.zeros(shape)
        self.tangent = np.zeros((*shape, self.dim, self.dim))
        self._trial, self._trial_gradient = states, self._last.gradient
        self.averaging: VolumeAveraging | None = None
        if f_bar != "none":
            material = np.zeros(particles.num_local, dtype=np.int64)
            for number, group in enumerate(self._groups):
                material[group.points // particles.num_points] = number
            self.averaging = VolumeAveraging(
                strain, f_bar, material, self._resistance(), self.symmetric
            )

    def _resistance(self) -> NDArray[np.float64]:
        """Return three times the shear modulus of each undeformed domain (collective)."""
        modulus = np.zeros(self._particles.num_local)
        with agree(self._particles.mesh.comm):
            for group in self._groups:
                shear = self._undeformed_tangent(group)[:, 0, 1, 0, 1]
                modulus[group.points // self._particles.num_points] = 3.0 * shear
        return modulus

    def _undeformed_tangent(self, group: _Group) -> NDArray[np.float64]:
        undeformed = np.zeros((len(group.points), self.dim, self.dim))
        return self._answer(group, undeformed, self._initial_state(group)).tangent

    def follow_parameters(self) -> None:
        """Take over the present values of parameters that are Functions or Constants (collective).

        Raises:
            MPMError: They are not allowed, or the parameters of a material are other objects than
                when this history was made.
        """
        with agree(self._particles.mesh.comm):
            for given in self._given:
                given.require_same()
        for given in self._given:
            limits = given.material.limits
            for name, value in given.live():
                check_parameter(name, value, **limits.get(name, {}))
        changed = False
        for number, (given, group) in enumerate(zip(self._given, self._groups, strict=True)):
            if not given.live():
                continue
            present = self._resolve(given.material, group.points)
            if any(
                not np.array_equal(present.parameters[name], group.material.parameters[name])
                for name, _ in given.live()
            ):
                self._groups[number] = self._governing(present, group.points)
                changed = True
        if changed and self.averaging is not None:
            self.averaging.modulus = self._resistance()

    @property
    def weakening(self) -> float:
        """What the strength of all materials is divided by."""
        return self._weakening

    def weaken(self, factor: float) -> None:
        """Divide the strength of all materials by a factor from now on, 1 at first (collective).

        Raises:
            MPMError: A material does not say what its strength is.
        """
        self._weakening = factor
        with agree(self._particles.mesh.comm):
            self._groups = [
                self._governing(self._resolve(given.material, group.points), group.points)
                for given, group in zip(self._given, self._groups, strict=True)
            ]

    # -- A stress that is there at first ---------------------------------------------------

    def begin_with_pressure(self) -> None:
        """Let the pressure be that of materials where nothing is strained yet (collective)."""
        assert self.mean_stress is not None
        self.mean_stress.begin_with(self.converged_pressure)

    def begin_with(self, cauchy_stress: NDArray[np.float64]) -> None:
        """Let the points, which have not moved, carry a stress (collective).

        Args:
            cauchy_stress: Shape ``(n, nq, 3, 3)``.

        Raises:
            MPMError: A material cannot bear it; ``particles`` are global indices.
        """
        stress = cauchy_stress.reshape(self._points, 3, 3)
        if self.mean_stress is not None:
            self.mean_stress.begin_with(np.trace(stress, axis1=1, axis2=2) / 3.0)
        with agree(self._particles.mesh.comm):
            states = [self._stressed(g, np.arange(len(g.points)), stress) for g in self._groups]
        self._settle(states)

    def take_over(self, before: MaterialPoints) -> None:
        """Go on from the last converged step of the same points with other materials (collective).

        Points whose material is the same object go on with its history; the others carry the
        stress that they had, and no other history. Strength is divided by what it was divided by.

        Args:
            before: The points, on the same mesh.

        Raises:
            MPMError: A material cannot bear its stress; ``particles`` are global indices.
        """
        if before.weakening != self._weakening:
            self.weaken(before.weakening)
        gradient = before.strain.gradient().reshape(-1, self.dim, self.dim)
        kirchhoff = before.cauchy_stress().reshape(self._points, 3, 3)
        kirchhoff *= np.linalg.det(np.eye(self.dim) + gradient)[:, None, None]
        comm, histories = self._particles.mesh.comm, before.histories()
        known = []
        for given, group in zip(self._given, self._groups, strict=True):
            there = np.zeros(self._points, dtype=bool)
            state: State = {}
            for material, points, its in histories:
                if material is given.material and (not state or state.keys() == its.keys()):
                    there[points] = True
                    for name, values in its.items():
                        shape = (self._points, *values.shape[1:])
                        state.setdefault(name, np.zeros(shape, values.dtype))[points] = values
            kept = there[group.points]
            whole = bool(state) and bool(comm.allreduce(bool(kept.all()), MPI.LAND))
            if not whole:
                # a law without memory has none that could be mixed with that of other points
                kept &= "displacement_gradient" in state
            known.append((whole, kept, {name: v[group.points] for name, v in state.items()}))
        with agree(comm):
            states = [
                state if whole else self._mixed(group, kept, state, kirchhoff, gradient)
                for group, (whole, kept, state) in zip(self._groups, known, strict=True)
            ]
        if self.mean_stress is not None and before.mean_stress is not None:
            self.mean_stress.begin_with(before.mean_stress.values)
        self._settle(states)

    def histories(self) -> list[tuple[Material, NDArray[np.int64], State]]:
        """Return each material as given, its points and their last converged state."""
        return [
            (given.material, group.points, state)
            for given, group, state in zip(
                self._given, self._groups, self._last.states, strict=True
            )
        ]

    def _mixed(
        self,
        group: _Group,
        kept: NDArray[np.bool_],
        known: State,
        kirchhoff: NDArray[np.float64],
        gradient: NDArray[np.float64],
    ) -> State:
        """Return the state of a group, which is known where it is kept, elsewhere of a stress."""
        new = np.flatnonzero(~kept)
        state = {}
        for name, values in self._stressed(group, new, kirchhoff).items():
            state[name] = np.empty((len(kept), *values.shape[1:]), values.dtype)
            state[name][new] = values
            if name == "displacement_gradient":
                state[name][new] = gradient[group.points[new]]
            if kept.any():
                state[name][kept] = known[name][kept]
        return state

    def _stressed(
        self, group: _Group, rows: NDArray[np.integer[Any]], stress: NDArray[np.float64]
    ) -> State:
        """Return the state of some points of a group under a stress."""
        try:
            return group.material.at(rows).stressed_state(stress[group.points[rows]], self.dim)
        except MPMError as error:
            part = _Group(group.material, group.points[rows], group.law)
            raise self._named(error, part) from None
        except Exception as error:
            what = f"stressed_state of {type(group.material).__name__}"
            raise as_ours(error, what) from error

    def _settle(self, states: list[State]) -> None:
        """Take states for those of the last converged step, at the present displacement."""
        self._last = self._last._replace(states=states)
        with agree(self._particles.mesh.comm) if self.averaging is None else nullcontext():
            self.update()
        self._trial = states
        self._make_last(states, self.first_piola.copy())

    def _make_last(self, states: list[State], stress: NDArray[np.float64]) -> None:
        """Take the last update for the converged one (collective with F-bar).

        Args:
            states: What materials keep of it.
            stress: Its first Piola stress, given away for good.
        """
        before = self._last
        self._last = before._replace(states=states, gradient=self._trial_gradient, stress=stress)
        if self.mean_stress is not None:
            seen = self.mean_stress.strain
            self._last = self._last._replace(volume=seen.volume)
            if not self.comes_apart:
                self._last = self._last._replace(compliance=seen.compliance.copy())
        if self.averaging is None:
            return
        try:
            with agree(self._particles.mesh.comm):
                average = self.strain.average(self.cauchy_stress())
            recovery = self.averaging.recover(average) - average
            resisted = self.averaging.energy().ravel()
        except BaseException:
            self._last = before
            raise
        self._last = self._last._replace(recovery=recovery, resisted=resisted)

    @property
    def recovery(self) -> NDArray[np.float64] | float:
        """What the recovery of averaged stresses adds to the particles' Cauchy stress.

        Shape ``(n, 3, 3)``, or 0.
        """
        return self._last.recovery

    @property
    def comes_apart(self) -> bool:
        """Whether mean stresses depend on the volume alone, so that a pressure can replace them."""
        return not any(group.at_pressure for group in self._groups)

    @property
    def grouped(self) -> VolumeAveraging | None:
        """What knows what the tangent has from other points of a group; ``None`` without F-bar."""
        return self.averaging

    @property
    def symmetric(self) -> bool:
        """Whether the tangents of all materials are symmetric."""
        return all(group.material.symmetric for group in self._groups)

    @property
    def weights(self) -> NDArray[np.float64]:
        """Undeformed volume of each point, shape ``(n, nq)``; 0 where deleted."""
        return self.strain.present_volumes()

    @property
    def hoop(self) -> NDArray[np.float64] | None:
        """Hoop strains of a body of revolution's nodes, shape ``(n, nq, k)``, or ``None``."""
        return self.strain.hoop

    @property
    def volume_strain(self) -> VolumeStrain:
        """What a pressure of its own is the multiplier of, in the last update."""
        assert self.mean_stress is not None
        return self.mean_stress.strain

    @property
    def converged_pressure(self) -> NDArray[np.float64]:
        """Mean of the laws' own stress at the last converged step, shape ``(n nq,)``."""
        result = np.zeros(self._points)
        for group, state in zip(self._groups, self._last.states, strict=True):
            result[group.points] = state["stress"][:, :3].sum(axis=1) / 3.0
        return result

    @property
    def by_pressure(self) -> NDArray[np.float64]:
        """Derivative of the stress by a pressure of its own, ``(n nq, dim, dim)``."""
        return self.volume_strain.by_pressure

    def _group(self, assignment: Assignment, cell_tags: mesh.MeshTags | None) -> list[_Group]:
        if isinstance(assignment, Material):
            everywhere = np.arange(self._points)
            self._given = [_Given(assignment, dict(assignment.parameters))]
            return [self._governing(self._resolve(assignment, everywhere), everywhere)]
        if not isinstance(assignment, Mapping) or not all(
            isinstance(m, Material) for m in assignment.values()
        ):
            raise MPMError(
                "material must be a material of mpm.materials or a dictionary "
                f"{{cell tag: material}}, not {type(assignment).__name__}."
            )
        body = self._particles.mesh
        if cell_tags is None or cell_tags.dim != body.topology.dim:
            raise MPMError("A dictionary of materials needs cell_tags=, tags of the body's cells.")
        if not _compat.are_tags_of(cell_tags, body):
            raise MPMError("cell_tags are those of another mesh than the body's.")
        tags = np.full(self._particles.num_local, -1, dtype=np.int64)
        own = cell_tags.indices < self._particles.num_local
        tags[cell_tags.indices[own]] = cell_tags.values[own]
        known = np.isin(tags, list(assignment))
        without = self._particles.global_index[~known]
        if len(without):
            missing = ", ".join(str(tag) if tag >= 0 else "none" for tag in np.unique(tags[~known]))
            raise MPMError(
                f"The cell tags of {{particles}} ({missing}) have no material, as there are "
                f"materials for {', '.join(map(str, assignment))} alone; give one for each tag.",
                without,
            )
        tags = np.repeat(tags, self._particles.num_points)
        groups = []
        for tag, material in assignment.items():
            points = np.flatnonzero(tags == tag)
            groups.append(self._governing(self._resolve(material, points), points))
            self._given.append(_Given(material, dict(material.parameters)))
        return groups

    def _governing(self, material: Material, points: NDArray[np.int64]) -> _Group:
        """Return a material with its points, without its mean stress where a pressure is that."""
        if self.mean_stress is None:
            return _Group(material, points, material)
        if not is_split(material):
            group = _Group(material, points, material, at_pressure=True)
            self.mean_stress.shear[points] = self._undeformed_tangent(group)[:, 0, 1, 0, 1]
            return group
        law, bulk, soft = without_bulk(material)
        self.mean_stress.follow(points, material, bulk, soft)
        return _Group(material, points, law)

    def _resolve(
        self, material: Material, points: NDArray[np.int64], weakened: bool = True
    ) -> Material:
        """Return the material with its parameters at the points, weakened or as given."""
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
            values = self._per_cell(name, value)
            replaced[name] = _read_only(np.repeat(values, self._particles.num_points))
        if replaced:
            material = material.with_parameters(**replaced).at(points)
        if weakened and self._weakening != 1.0:
            material = material.weakened(self._weakening)
        if not self.compiled and isinstance(material, CompiledMaterial):
            material = material.with_parameters()
            material.compiled = False
        return material

    def _per_cell(self, name: str, value: Any) -> NDArray[np.float64]:
        n = self._particles.num_local
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
        if space.mesh is not self._particles.mesh or element.degree != 0 or space.value_size != 1:
            raise MPMError(f"The parameter {name} must be a scalar DG0 Function on the body mesh.")
        return np.asarray(value.x.array[space.dofmap.list[:n, 0]])

    def initial_modulus(self) -> NDArray[np.float64]:
        """Return the largest modulus of the undeformed domains in one direction (collective).

        Returns:
            Shape ``(n,)``.
        """
        result = np.zeros(self._points)
        with agree(self._particles.mesh.comm):
            for group in self._groups:
                tangent = self._undeformed_tangent(group)
                result[group.points] = np.einsum("niiii->ni", tangent).max(axis=1, initial=0.0)
        shape = (self._particles.num_local, self._particles.num_points)
        return result.reshape(shape).mean(axis=1)

    def undeformed_tangent(self) -> NDArray[np.float64]:
        """Return dP/dF of all points where nothing is strained, ``(n nq, dim, dim, dim, dim)``."""
        result = np.zeros(self.tangent.shape)
        for group in self._groups:
            result[group.points] = self._undeformed_tangent(group)
        return result

    def strain_energy(self, trial: bool = False) -> NDArray[np.float64]:
        """Return the elastic energy per undeformed volume of all points, shape ``(n nq,)``.

        Args:
            trial: Whether it is that of the last update, not of the last converged step.

        Returns:
            That of the material, and of what F-bar resists; not a number where a material does not
            know it.
        """
        result = np.full(self._points, np.nan)
        for group, state in self._states(trial):
            energy = group.material.strain_energy(state)
            if energy is not None:
                self._require(group, "strain energy", energy, (len(group.points),))
                result[group.points] = energy
        if self.averaging is not None:
            result += self.averaging.energy().ravel() if trial else self._last.resisted
        return result

    def _states(self, trial: bool) -> Iterator[tuple[_Group, State]]:
        """Return the groups with their states in the last update, or at the converged step."""
        return zip(self._groups, self._trial if trial else self._last.states, strict=True)

    def potential(self, trial: bool = False) -> NDArray[np.float64]:
        """Return the elastic energy and, where a law knows it, the plastic work, ``(n nq,)``.

        Args:
            trial: As for :meth:`strain_energy`.
        """
        result = self.strain_energy(trial)
        for group, state in self._states(trial):
            work = group.material.plastic_work(state)
            if work is not None:
                self._require(group, "plastic work", work, (len(group.points),))
                result[group.points] += work
        return result

    @property
    def has_small_strain(self) -> NDArray[np.bool_]:
        """Which points have a law of small strains, shape ``(n nq,)``."""
        return self._where(lambda law: getattr(law, "kinematics", None) == "small")

    @property
    def may_part(self) -> NDArray[np.bool_]:
        """Which points have a law whose pressure may vanish by yielding, shape ``(n nq,)``."""
        return self._where(lambda law: not vars(type(law)).get("linear_in_volume", False))

    @property
    def has_potential(self) -> NDArray[np.bool_]:
        """Which points have a stress that derives from :meth:`potential` over a step, ``(n nq,)``.

        That is one of F there; with F-bar, of F at the points of a group, which has one material.
        With a pressure of its own that is the stress without it.
        """
        found = self._where(lambda law: not getattr(law, "inelastic", True))
        for group, state in self._states(False):
            if group.material.plastic_work(state) is not None:
                found[group.points] = True
        return found & np.isfinite(self.strain_energy())

    def _where(self, holds: Callable[[Material], bool]) -> NDArray[np.bool_]:
        result = np.zeros(self._points, dtype=bool)
        for group in self._groups:
            result[group.points] = holds(group.material)
        return result

    def update(self) -> None:
        """Update all points for the present displacement; the history stays as it is.

        With F-bar this is collective, also where it fails.

        Raises:
            MPMError: An update fails; ``particles`` are global indices.
        """
        # Two tries at a time would be the most that a step holds in memory.
        self._forget_trial()
        gradient = self.strain.gradient()
        if self.averaging is None:
            gradient = gradient.reshape(-1, self.dim, self.dim)
            self._update_materials(gradient)
            return
        gradient = self.averaging.average(gradient)
        try:
            self._update_materials(gradient.reshape(-1, self.dim, self.dim))
        except BaseException:
            self.averaging.abandon()
            raise
        shape = gradient.shape
        stress, tangent = self.averaging.effective(
            self.first_piola.reshape(shape), self.tangent.reshape(*shape, self.dim, self.dim)
        )
        self.first_piola = stress.reshape(self.first_piola.shape)
        self.tangent = tangent.reshape(self.tangent.shape)

    def on_mesh(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return first Piola stress and tangent with respect to the body mesh, as it is.

        They differ from :attr:`first_piola` and :attr:`tangent` where the mesh is not the
        undeformed body: ``P G^T / det G`` where it has G behind it.
        """
        return self.taken_to_mesh(self.first_piola, self.tangent)

    def taken_to_mesh(
        self, stress: NDArray[np.float64], tangent: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return a first Piola stress at all points and its tangent as :meth:`on_mesh` does."""
        if not self._particles.rebased:
            return stress, tangent
        gdim = self._particles.mesh.geometry.dim
        G = (np.eye(gdim) + self._particles.reference.gradient).reshape(-1, gdim, gdim)
        volume = np.linalg.det(G)[:, None, None]
        stress = np.einsum("niJ,nMJ->niM", stress, G) / volume
        tangent = np.einsum("niJkL,nMJ,nNL->niMkN", tangent, G, G, optimize=True)
        return stress, tangent / volume[:, :, :, None, None]

    def _update_materials(self, gradient: NDArray[np.float64]) -> None:
        trial, volumes = [], []
        for group, state in zip(self._groups, self._last.states, strict=True):
            everywhere = len(group.points) == self._points
            part = gradient if everywhere else gradient[group.points]
            if self.mean_stress is None:
                answer = self._answer(group, part, state)
            else:
                answer, volume = self._at_pressure(group, part, state)
                volumes.append((group.points, volume))
            if everywhere:
                self.first_piola, self.tangent = answer.first_piola, answer.tangent
            else:
                self.first_piola[group.points] = answer.first_piola
                self.tangent[group.points] = answer.tangent
            trial.append(answer.state)
        self._trial, self._trial_gradient = trial, gradient
        if self.mean_stress is not None:
            self.mean_stress.see(volumes)

    def _at_pressure(
        self, group: _Group, gradient: NDArray[np.float64], state: State
    ) -> tuple[_Answer, VolumeStrain]:
        """Return what a material answers at the pressure of its points, and its volume strain."""
        assert self.mean_stress is not None
        if not group.at_pressure:
            own = Update(*self._answer(group, gradient, state))
            replaced, strain = self.mean_stress.replace(group.points, gradient, own)
            P, A, new = replaced
            assert A is not None
            return _Answer(P, A, new), strain
        assert isinstance(group.law, StrainMaterial)
        p = self.mean_stress.values[group.points]
        law, shear = type(group.law).__name__, self.mean_stress.shear[group.points]
        received = {name: _read_only(values) for name, values in state.items()}
        try:
            found = group.law.at_pressure(_read_only(gradient), received, p, shear)
        except MPMError as error:
            raise self._named(error, group) from None
        except np.linalg.LinAlgError as error:
            raise ConvergenceError(f"The update of {law} broke down ({error})") from error
        except Exception as error:
            raise as_ours(error, f"The update of {law}") from error
        answer = self._checked(group, state, Update(*found[:2], found.state))
        volume = found.gap + found.compliance * p
        return answer, VolumeStrain(volume, found.slope, found.compliance, found.by_pressure)

    def _initial_state(self, group: _Group) -> State:
        """Return the state of a material's points where nothing is strained yet.

        Raises:
            MPMError: The law fails, or gives something else than a state.
        """
        what, count = f"initial_state of {type(group.material).__name__}", len(group.points)
        try:
            state = group.material.initial_state(count, self.dim)
        except MPMError:
            raise
        except Exception as error:
            raise as_ours(error, what) from error
        if not isinstance(state, dict) or "stress" not in state:
            raise MPMError(f"{what} must return a dictionary of arrays with 'stress' among them.")
        for name, values in state.items():
            if not isinstance(values, np.ndarray) or values.shape[:1] != (count,):
                raise MPMError(
                    f"{what} must return arrays of {count} rows, one for each point, but "
                    f"{name!r} is {_told(values)}."
                )
        stress = (count, num_components(self.dim))
        if state["stress"].shape != stress or state["stress"].dtype != np.float64:
            raise MPMError(
                f"{what} must return a 'stress' of shape {stress} and type float64, not "
                f"{_told(state['stress'])}."
            )
        return state

    def _answer(self, group: _Group, gradient: NDArray[np.float64], state: State) -> _Answer:
        """Return what a material answers, which is as it must be; it cannot write into its input.

        Raises:
            MPMError: The law fails, or its answer is not finite or of another shape or type;
                ``particles`` are global indices.
        """
        law = type(group.material).__name__
        received = {name: _read_only(values) for name, values in state.items()}
        try:
            answer = group.law.update(_read_only(gradient), received)
        except MPMError as error:
            raise self._named(error, group) from None
        except np.linalg.LinAlgError as error:
            raise ConvergenceError(f"The update of {law} broke down ({error})") from error
        except Exception as error:
            ours = as_ours(error, f"The update of {law}")
            if "read-only" in str(error):
                ours = MPMError(f"{ours.message}; a law must not write into what it receives.")
            raise ours from error
        if not isinstance(answer, Update):
            raise MPMError(
                f"The update of {law} must return a materials.Update, not a "
                f"{type(answer).__name__}."
            )
        return self._checked(group, state, answer)

    def _checked(self, group: _Group, state: State, answer: Update) -> _Answer:
        """Return what a law answered to a state, if it is finite and of the right shape and type.

        Raises:
            MPMError: It is not.
        """
        law = type(group.material).__name__
        n, dim = len(group.points), self.dim
        self._require(group, STRESS, answer.first_piola, (n, dim, dim))
        self._require(group, "tangent", answer.tangent, (n, dim, dim, dim, dim))
        assert answer.tangent is not None
        if not isinstance(answer.state, dict) or answer.state.keys() != state.keys():
            raise MPMError(
                f"The update of {law} must return a state with the variables of initial_state: "
                f"{', '.join(state)}."
            )
        for name, values in answer.state.items():
            before = state[name]
            self._require(group, f"state {name!r}", values, before.shape, before.dtype)
        P, A = np.ascontiguousarray(answer.first_piola), np.ascontiguousarray(answer.tangent)
        return _Answer(P, A, answer.state)

    def _require(
        self,
        group: _Group,
        what: str,
        values: Any,
        shape: tuple[int, ...],
        dtype: np.dtype[Any] = FLOAT,
    ) -> None:
        """Raise an error unless a part of a material's answer is finite, of a shape and type."""
        answered = f"The update of {type(group.material).__name__} gave a {what} that is"
        if not isinstance(values, np.ndarray) or values.shape != shape or values.dtype != dtype:
            raise MPMError(
                f"{answered} {_told(values)}; it must have the shape {shape} and the type {dtype}."
            )
        # The laws of this package are tested; their stress, a small part, is looked at all the
        # same. To read the rest takes a tenth of a step.
        known = _is_own(group.material) and what != STRESS
        if values.dtype.kind != "f" or known or _all_finite(values):
            return
        bad = np.flatnonzero(~np.isfinite(values).reshape(len(values), -1).all(axis=1))
        if len(bad):
            raise self._named(ConvergenceError(f"{answered} not finite", bad), group)

    def _named(self, error: MPMError, group: _Group) -> MPMError:
        """Return an error of a material with global indices for the numbers of its points."""
        own = np.array([p for p in error.particles if 0 <= p < len(group.points)], dtype=np.int64)
        domains = group.points[own] // self._particles.num_points
        particles = np.unique(self._particles.global_index[domains])
        where = " (at {particles})" if len(particles) else ""
        return type(error)(error.message.rstrip(".") + where, particles)

    def elastic(self) -> bool:
        """Return whether no internal variable has changed in the last update: nothing yields."""
        for group, before, after in zip(self._groups, self._last.states, self._trial, strict=True):
            if before.keys() == {"stress"} or not getattr(group.material, "inelastic", True):
                continue
            variables = getattr(group.material, "internal_variables", ())
            if not variables or not all(np.array_equal(before[v], after[v]) for v in variables):
                return False
        return True

    def commit(self) -> Callable[[], None]:
        """Make the last update the history (collective with F-bar).

        Returns:
            A function that makes the history of before that again.
        """
        before = self._last
        tried = self._trial, self._trial_gradient, self.first_piola

        def undo() -> None:
            self._last = before
            self._trial, self._trial_gradient, self.first_piola = tried

        self._trial = [
            state if _is_own(group.material) else {k: v.copy() for k, v in state.items()}
            for group, state in zip(self._groups, self._trial, strict=True)
        ]
        alone = len(self._groups) == 1 and _is_own(self._groups[0].material)
        self._make_last(self._trial, self.first_piola if alone else self.first_piola.copy())
        return undo

    def roll_back(self) -> None:
        """Forget the last update."""
        self._forget_trial()
        self.first_piola = self._last.stress.copy()
        if self.mean_stress is not None:
            last = self._last
            self.mean_stress.return_to(last.volume, last.compliance, last.gradient)

    def _forget_trial(self) -> None:
        self._trial, self._trial_gradient = self._last.states, self._last.gradient

    def converged_state(self) -> dict[str, Column]:
        """Return the history of the last converged step.

        Returns:
            Columns ``(n, nq, ...)`` by name (``recovery``: ``(n, 3, 3)``); a variable of the
            materials has the numbers of those that have it in its name.
        """
        whole: dict[str, NDArray[Any]] = {"gradient": self._last.gradient}
        whole["first_piola"] = self._last.stress
        if self.mean_stress is not None:
            whole["volume_strain"] = self._last.volume
            if not self.comes_apart:
                whole["compliance"] = self._last.compliance
        owners: dict[tuple[str, tuple[int, ...], np.dtype[Any]], list[int]] = {}
        for number, state in enumerate(self._last.states):
            for name, values in state.items():
                owners.setdefault((name, values.shape[1:], values.dtype), []).append(number)
        for (name, shape, dtype), numbers in owners.items():
            values = np.zeros((self._points, *shape), dtype)
            for number in numbers:
                values[self._groups[number].points] = self._last.states[number][name]
            whole[f"{name}@{','.join(map(str, numbers))}"] = values
        n, nq = self._particles.num_local, self._particles.num_points
        columns = {
            name: Column(v.reshape(n, nq, *v.shape[1:]), "points") for name, v in whole.items()
        }
        if self.averaging is not None:
            columns["recovery"] = Column(np.broadcast_to(self._last.recovery, (n, 3, 3)), "cells")
            columns["resisted"] = Column(self._last.resisted.reshape(n, nq), "points")
        return columns

    def set_converged_state(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Make what :meth:`converged_state` once returned the history of the last step."""
        flat = {
            name: v.reshape(self._points, *v.shape[2:])
            for name, v in arrays.items()
            if name not in ("recovery", "resisted")
        }
        states: list[State] = [{} for _ in self._groups]
        last = self._last._replace(
            states=states,
            gradient=flat.pop("gradient"),
            stress=flat.pop("first_piola"),
            volume=flat.pop("volume_strain", self._last.volume),
            compliance=flat.pop("compliance", self._last.compliance),
            recovery=arrays.get("recovery", 0.0),
            resisted=arrays.get("resisted", self._last.resisted).reshape(self._points),
        )
        for key, values in flat.items():
            name, numbers = key.rsplit("@", 1)
            for number in map(int, numbers.split(",")):
                states[number][name] = values[self._groups[number].points]
        self._last = last

    def laws(self) -> list[tuple[str, dict[str, Any]]]:
        """Return name and parameters of each material; arrays with the indices of their points.

        They are those of the material as it was given, whatever its strength is divided by.
        """
        nq = self._particles.num_points
        index = self._particles.global_index[:, None] * nq + np.arange(nq)
        laws = []
        for given, group in zip(self._given, self._groups, strict=True):
            where = index.ravel()[group.points]
            material = group.material
            if self._weakening != 1.0:
                material = self._resolve(given.material, group.points, weakened=False)
            parameters: dict[str, Any] = {
                name: (where, value) if isinstance(value, np.ndarray) else value
                for name, value in material.parameters.items()
            }
            parameters["points"] = (where, np.ones(len(where)))
            if self.mean_stress is not None:
                parameters["mixed"] = "pressure"
            parameters["f_bar"] = "none" if self.averaging is None else self.averaging.kind
            laws.append((type(group.material).__name__, parameters))
        return laws

    def cauchy_stress(self) -> NDArray[np.float64]:
        """Cauchy stress of the last converged step, shape ``(n, nq, 3, 3)``."""

        def value(group: _Group, state: State) -> Any:
            received = {name: _read_only(values) for name, values in state.items()}
            stress = group.material.cauchy_stress(
                _read_only(self._last.gradient[group.points]), received
            )
            shape = (len(group.points), 3, 3)
            if np.shape(stress) != shape:
                raise MPMError(
                    f"cauchy_stress of {type(group.material).__name__} gave {_told(stress)}; it "
                    f"must have the shape {shape}."
                )
            return stress

        return self._collect((3, 3), value, "cauchy_stress")

    def plastic_strain(self) -> NDArray[np.float64]:
        """Accumulated plastic strain of the last converged step, shape ``(n, nq)``."""
        return self.variable("plastic_strain")

    def variable(self, name: str) -> NDArray[np.float64]:
        """Return an internal variable of the last converged step, zero where there is none.

        Args:
            name: Key of the materials' states.

        Returns:
            Its values, shape ``(n, nq, ...)``.

        Raises:
            MPMError: No material has it.
        """
        shapes = {s[name].shape[1:] for s in self._last.states if name in s}
        if not shapes:
            if name == "plastic_strain":
                shapes = {()}
            else:
                raise MPMError(f"No material of these particles has a variable {name!r}.")
        return self._collect(shapes.pop(), lambda group, state: state.get(name, 0.0))

    def yield_function(self) -> NDArray[np.float64]:
        """Yield function of the last converged step, shape ``(n, nq)``; -1 where elastic."""

        def value(group: _Group, state: State) -> Any:
            rule = getattr(group.material, "yield_function", None)
            if rule is None:
                return -1.0
            names = getattr(group.material, "internal_variables", ()) or ("plastic_strain",)
            return rule(state["stress"], *(state[name] for name in names))

        return self._collect((), value, "yield_function")

    def _collect(self, shape: tuple[int, ...], value: Any, what: str = "") -> NDArray[np.float64]:
        result = np.zeros((self._points, *shape))
        for group, state in zip(self._groups, self._last.states, strict=True):
            try:
                result[group.points] = value(group, state)
            except MPMError:
                raise
            except Exception as error:
                raise as_ours(error, f"{what} of {type(group.material).__name__}") from error
        return result.reshape(self._particles.num_local, self._particles.num_points, *shape)


def _read_only(values: NDArray[Any]) -> NDArray[Any]:
    """Return a view of an array through which it cannot be changed."""
    view = values.view()
    view.flags.writeable = False
    return view


def _is_own(material: Material) -> bool:
    """Return whether a law is one of this package, which gives its answers away for good."""
    return type(material).__module__.startswith(Material.__module__.rpartition(".")[0] + ".")


def _all_finite(values: NDArray[np.float64]) -> bool:
    """Return whether all values are finite for sure, at the cost of reading them."""
    if not values.flags.c_contiguous:
        return bool(np.isfinite(values).all())
    flat = values.reshape(-1)
    with np.errstate(all="ignore"):
        return bool(np.isfinite(flat @ flat))


def _told(values: Any) -> str:
    """Return what a value is, for an error."""
    if not isinstance(values, np.ndarray):
        return "None" if values is None else f"a {type(values).__name__}"
    return f"an array of shape {values.shape} and type {values.dtype}"
