# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Materials at the quadrature points of particles: trial update, commit, roll back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem, mesh

from . import _compat
from .errors import ConvergenceError, MPMError, agree
from .f_bar import LowRankTerm, VolumeAveraging
from .materials import IsotropicElastic, Material, State
from .materials.base import Refused
from .particles import Particles

__all__ = ["ConstitutiveHistory"]

type Assignment = Material | Mapping[int, Material]


class _Group(NamedTuple):
    """A material and the points (of all of this rank's points) that it governs."""

    material: Material
    points: NDArray[np.int64]


class ConstitutiveHistory:
    """The history of all points of a body, kept apart from the update being tried.

    Args:
        particles: The body.
        assignment: One material, or one for each tag of ``cell_tags``.
        cell_tags: Tags of the body's cells.
        axisymmetric: Whether the body is one of revolution; its points are then strained in
            three dimensions.
        f_bar: Kind of average of the volume ratio, or ``"none"``.
        compiled: Whether materials may use their compiled updates.

    Attributes:
        dim: Dimension of stress and strain, 2 in plane strain.
        axisymmetric: As given.
        averaging: F-bar, or ``None``; the material then sees Fbar, and what follows is what
            does work on F.
        first_piola: First Piola stress of the last update, shape ``(n nq, dim, dim)``.
        tangent: Its derivative by F, shape ``(n nq, dim, dim, dim, dim)``; with F-bar the
            pointwise part of it.
        recovery: What the recovery of averaged stresses adds to the particles' Cauchy stress,
            shape ``(n, 3, 3)``, or 0.

    Raises:
        MPMError: Materials, tags or parameters that do not go together.
    """

    def __init__(
        self,
        particles: Particles,
        assignment: Assignment,
        cell_tags: mesh.MeshTags | None,
        axisymmetric: bool,
        f_bar: str = "none",
        compiled: bool = True,
    ) -> None:
        self._particles = particles
        self._compiled = compiled
        self.axisymmetric = axisymmetric
        self.dim = 3 if axisymmetric else particles.mesh.geometry.dim
        if axisymmetric:
            particles.require_radius()
        self._points = particles.num_local * particles.num_points
        with agree(particles.mesh.comm):
            self._groups = self._group(assignment, cell_tags)
        shape = (self._points, self.dim, self.dim)
        self._gradient = np.zeros(shape)
        self._states = [g.material.initial_state(len(g.points), self.dim) for g in self._groups]
        self.first_piola = np.zeros(shape)
        self.tangent = np.zeros((*shape, self.dim, self.dim))
        self._trial: list[State] = self._states
        self._trial_gradient = self._gradient
        self._stress = self.first_piola.copy()
        self.recovery: NDArray[np.float64] | float = 0.0
        self.averaging: VolumeAveraging | None = None
        if f_bar != "none":
            material = np.zeros(particles.num_local, dtype=np.int64)
            modulus = np.zeros(particles.num_local)  # three times that of shear
            for number, (group, state) in enumerate(zip(self._groups, self._states, strict=True)):
                domains = group.points // particles.num_points
                material[domains] = number
                answer = group.material.update(self._gradient[group.points], state)
                assert answer.tangent is not None
                modulus[domains] = 3.0 * answer.tangent[:, 0, 1, 0, 1]
            self.averaging = VolumeAveraging(
                particles, f_bar, self.dim, material, modulus, self.symmetric
            )

    @property
    def symmetric(self) -> bool:
        """Whether the tangents of all materials are symmetric."""
        return all(group.material.symmetric for group in self._groups)

    @property
    def low_rank(self) -> list[LowRankTerm]:
        """What the tangent has besides the pointwise one: terms of F-bar."""
        return [] if self.averaging is None else self.averaging.low_rank

    def _group(self, assignment: Assignment, cell_tags: mesh.MeshTags | None) -> list[_Group]:
        if isinstance(assignment, Material):
            everywhere = np.arange(self._points)
            return [_Group(self._resolve(assignment, everywhere), everywhere)]
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
            groups.append(_Group(self._resolve(material, points), points))
        return groups

    def _resolve(self, material: Material, points: NDArray[np.int64]) -> Material:
        """Return the material with its parameters at the points."""
        replaced: dict[str, NDArray[np.float64]] = {}
        for name, value in material.parameters.items():
            if not isinstance(value, fem.Function | np.ndarray):
                continue
            values = self._per_cell(name, value)
            replaced[name] = np.repeat(values, self._particles.num_points)
        if replaced:
            material = material.with_parameters(**replaced).at(points)
        if not self._compiled and isinstance(material, IsotropicElastic):
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
        """Return the largest modulus of the undeformed domains in one direction, shape ``(n,)``."""
        result = np.zeros(self._points)
        for group in self._groups:
            count = len(group.points)
            state = group.material.initial_state(count, self.dim)
            answer = group.material.update(np.zeros((count, self.dim, self.dim)), state)
            assert answer.tangent is not None
            result[group.points] = np.einsum("niiii->ni", answer.tangent).max(axis=1, initial=0.0)
        return result.reshape(self._particles.num_local, -1).mean(axis=1)

    def update(self) -> None:
        """Update all points for the present displacement; the history stays as it is.

        With F-bar this is collective, also where it fails.

        Raises:
            MPMError: An update fails; ``particles`` are global indices.
        """
        gradient = self._particles.displacement_gradient(self.axisymmetric)
        if self.averaging is None:
            self._update_materials(gradient.reshape(-1, self.dim, self.dim))
            return
        gradient = self.averaging.average(gradient)
        try:
            self._update_materials(gradient.reshape(-1, self.dim, self.dim))
        except MPMError:
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
        if not self._particles.rebased:
            return self.first_piola, self.tangent
        gdim = self._particles.mesh.geometry.dim
        G = (np.eye(gdim) + self._particles.reference.gradient).reshape(-1, gdim, gdim)
        volume = np.linalg.det(G)[:, None, None]
        stress = np.einsum("niJ,nMJ->niM", self.first_piola, G) / volume
        tangent = np.einsum("niJkL,nMJ,nNL->niMkN", self.tangent, G, G, optimize=True)
        return stress, tangent / volume[:, :, :, None, None]

    def _update_materials(self, gradient: NDArray[np.float64]) -> None:
        trial = []
        for group, state in zip(self._groups, self._states, strict=True):
            everywhere = len(group.points) == self._points
            part = gradient if everywhere else gradient[group.points]
            try:
                answer = group.material.update(part, state)
            except MPMError as error:
                raise self._named(error, group) from None
            except np.linalg.LinAlgError as error:
                raise ConvergenceError(
                    f"The update of {type(group.material).__name__} broke down ({error})"
                ) from error
            except Exception as error:
                raise MPMError(
                    f"The update of {type(group.material).__name__} failed with "
                    f"{type(error).__name__}: {error}"
                ) from error
            assert answer.tangent is not None
            if everywhere:
                self.first_piola, self.tangent = answer.first_piola, answer.tangent
            else:
                self.first_piola[group.points] = answer.first_piola
                self.tangent[group.points] = answer.tangent
            trial.append(answer.state)
        self._trial, self._trial_gradient = trial, gradient

    def _named(self, error: MPMError, group: _Group) -> MPMError:
        points = group.points[error.particles]
        particles = np.unique(self._particles.global_index[points // self._particles.num_points])
        return type(error)(error.message.rstrip(".") + " (at {particles})", particles)

    def elastic(self) -> bool:
        """Return whether no internal variable has changed in the last update: nothing yields."""
        for group, before, after in zip(self._groups, self._states, self._trial, strict=True):
            if before.keys() == {"stress"}:
                continue
            variables = getattr(group.material, "internal_variables", ())
            if not variables or not all(np.array_equal(before[v], after[v]) for v in variables):
                return False
        return True

    def commit(self) -> None:
        """Make the last update the history (collective with F-bar)."""
        self._states, self._gradient = self._trial, self._trial_gradient
        self._stress = self.first_piola if len(self._groups) == 1 else self.first_piola.copy()
        if self.averaging is not None:
            weights = self._particles.point_volumes(self.axisymmetric)
            share = weights / weights.sum(axis=1, keepdims=True)
            stress = np.einsum("nq,nqij->nij", share, self.cauchy_stress())
            self.recovery = self.averaging.recover(stress) - stress

    def roll_back(self) -> None:
        """Forget the last update."""
        self._trial, self._trial_gradient = self._states, self._gradient
        self.first_piola = self._stress.copy()

    def converged_state(self) -> dict[str, NDArray[Any]]:
        """Return the history of the last converged step.

        Returns:
            Arrays ``(n, nq, ...)`` by name (``recovery``: ``(n, 3, 3)``); a variable of the
            materials has the numbers of those that have it in its name.
        """
        whole = {"gradient": self._gradient, "first_piola": self._stress}
        owners: dict[tuple[str, tuple[int, ...], np.dtype[Any]], list[int]] = {}
        for number, state in enumerate(self._states):
            for name, values in state.items():
                owners.setdefault((name, values.shape[1:], values.dtype), []).append(number)
        for (name, shape, dtype), numbers in owners.items():
            values = np.zeros((self._points, *shape), dtype)
            for number in numbers:
                values[self._groups[number].points] = self._states[number][name]
            whole[f"{name}@{','.join(map(str, numbers))}"] = values
        n, nq = self._particles.num_local, self._particles.num_points
        arrays = {name: v.reshape(n, nq, *v.shape[1:]) for name, v in whole.items()}
        if self.averaging is not None:
            arrays["recovery"] = np.broadcast_to(self.recovery, (n, 3, 3))
        return arrays

    def set_converged_state(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Make what :meth:`converged_state` once returned the history of the last step."""
        flat = {
            name: v.reshape(self._points, *v.shape[2:])
            for name, v in arrays.items()
            if name != "recovery"
        }
        self.recovery = arrays.get("recovery", 0.0)
        self._gradient, self._stress = flat.pop("gradient"), flat.pop("first_piola")
        self._states = [{} for _ in self._groups]
        for key, values in flat.items():
            name, numbers = key.rsplit("@", 1)
            for number in map(int, numbers.split(",")):
                self._states[number][name] = values[self._groups[number].points]

    def laws(self) -> list[tuple[str, dict[str, Any]]]:
        """Return name and parameters of each material; arrays with the indices of their points."""
        nq = self._particles.num_points
        index = self._particles.global_index[:, None] * nq + np.arange(nq)
        laws = []
        for group in self._groups:
            where = index.ravel()[group.points]
            parameters: dict[str, Any] = {
                name: (where, value) if isinstance(value, np.ndarray) else value
                for name, value in group.material.parameters.items()
            }
            parameters["points"] = (where, np.ones(len(where)))
            parameters["f_bar"] = "none" if self.averaging is None else self.averaging.kind
            laws.append((type(group.material).__name__, parameters))
        return laws

    def cauchy_stress(self) -> NDArray[np.float64]:
        """Cauchy stress of the last converged step, shape ``(n, nq, 3, 3)``."""
        return self._collect(
            (3, 3),
            lambda group, state: group.material.cauchy_stress(self._gradient[group.points], state),
        )

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
        shapes = {s[name].shape[1:] for s in self._states if name in s}
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
            return -1.0 if rule is None else rule(state["stress"], state["plastic_strain"])

        return self._collect((), value)

    def _collect(self, shape: tuple[int, ...], value: Any) -> NDArray[np.float64]:
        result = np.zeros((self._points, *shape))
        for group, state in zip(self._groups, self._states, strict=True):
            result[group.points] = value(group, state)
        return result.reshape(self._particles.num_local, self._particles.num_points, *shape)
