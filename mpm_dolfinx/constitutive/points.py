# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Materials at the quadrature points of particles: trial update, commit, roll back."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dolfinx import mesh

from ..errors import agree
from ..materials.base import Material, Parameter, State, Update
from ..meshes.remesh import Column
from ..parallel.given import options_of
from ..particles.field import ParticleField
from .assignment import Assignment, Materials
from .averaging import VolumeAveraging
from .governed import NO_TANGENT, Answer, Carried, Governed
from .moduli import axial_modulus, resisting_modulus
from .point_state import Converged, PointState
from .pressure import MeanStress, VolumeStrain
from .softening_average import SofteningAverage, softened
from .strain import Strain
from .succession import Episode, states_after

__all__ = ["Governing", "MaterialPoints"]


class Governing(NamedTuple):
    """Materials at their points with their present numbers, and F-bar's modulus or ``None``."""

    materials: list[Governed]
    modulus: NDArray[np.float64] | None


class MaterialPoints:
    """The history of all points of a body, kept apart from the update being tried.

    Args:
        strain: What the points of the body are strained in.
        materials: One material, or one for each tag of ``cell_tags``.
        cell_tags: Tags of the body's cells.
        f_bar: Kind of average of the volume ratio, or ``"none"``.
        pressure: A Function at the points that takes the place of the mean stress, if any.
        length: What the plastic strain that softens is averaged over; ``None`` for no average.

    Attributes:
        dim: Dimension of stress and strain, 2 in plane strain.
        strain: As given.
        laws: The materials, each at the points that it governs.
        last: The points at the last converged step.
        trial: The points in the last update; the same as ``last`` before one.
        mean_stress: The pressure in place of the mean stress, or ``None``.
        averaging: F-bar, or ``None``; the material then sees Fbar, and what follows is what
            does work on F.
        softening: The average over a length, or ``None``.
        first_piola: First Piola stress of the last update, shape ``(n nq, dim, dim)``.
        tangent: Its derivative by F, shape ``(n nq, dim, dim, dim, dim)``; with F-bar the
            pointwise part of it.

    Raises:
        MPMError: Materials, tags or parameters that do not go together.
    """

    def __init__(
        self,
        strain: Strain,
        materials: Materials,
        cell_tags: mesh.MeshTags | None,
        f_bar: str = "none",
        pressure: ParticleField | None = None,
        length: float | None = None,
    ) -> None:
        self._particles = particles = strain.particles
        self._comm = particles.mesh.comm
        self.strain = strain
        self.dim = strain.dim
        count = particles.num_local * particles.num_points
        self.mean_stress: MeanStress | None = None
        if pressure is not None:
            self.mean_stress = MeanStress(pressure, (count, self.dim))
        self.laws = Assignment(particles, self.dim, materials, cell_tags, self.mean_stress)
        shape = (count, self.dim, self.dim)
        self.first_piola = np.zeros(shape)
        self.tangent = np.zeros((*shape, self.dim, self.dim))
        self.softening = None if length is None else SofteningAverage(strain, self.laws, length)
        none = None if length is None else np.zeros(count)
        self.last = Converged(
            self.laws, self._initial_states(), np.zeros(shape), none, np.zeros(shape), growth=none
        )
        if pressure is not None:
            self.last = replace(self.last, volume=np.zeros(count), compliance=np.zeros(count))
        self.averaging: VolumeAveraging | None = None
        if f_bar != "none":
            material = self.laws.kinds()[self.laws.numbers]
            modulus = resisting_modulus(self.laws)
            self.averaging = VolumeAveraging(strain, f_bar, material, modulus, self.symmetric)
            self.last = replace(self.last, resisted=np.zeros(count))
        self.trial: PointState = self.last
        self._asks_tangents = True
        self._imposed: NDArray[np.float64] | None = None

    def _initial_states(self) -> list[State]:
        """Return the states of the materials where nothing is strained yet (collective)."""
        with agree(self._comm):
            return [part.initial_state() for part in self.laws.governed]

    def _present(self) -> list[Governed]:
        """Return the materials at their points, softened by the average of the present update."""
        average = None if self.softening is None else self.softening.values
        return [softened(part, average) for part in self.laws.governed]

    # -- The materials ---------------------------------------------------------------------

    def follow_parameters(self) -> None:
        """Take over the present values of parameters that are Functions or Constants (collective).

        Raises:
            MPMError: They are not allowed, or the parameters of a material are other objects than
                when this history was made.
        """
        if self.laws.follow_parameters() and self.averaging is not None:
            self.averaging.modulus = resisting_modulus(self.laws)

    def governing(self) -> Governing:
        """Return the materials with the numbers that they have now, for :meth:`govern_by`."""
        modulus = None if self.averaging is None else self.averaging.modulus
        return Governing(list(self.laws.governed), modulus)

    def govern_by(self, governing: Governing) -> None:
        """Let materials have the numbers again that they once had."""
        self.laws.governed = list(governing.materials)
        if self.averaging is not None and governing.modulus is not None:
            self.averaging.modulus = governing.modulus

    def assume(self, law: Material, name: str, value: Parameter) -> None:
        """Let a material, as it was given, have another number until the next call (collective)."""
        with agree(self._comm):
            self.laws.assume(law, name, value)
        if self.averaging is not None:
            self.averaging.modulus = resisting_modulus(self.laws)

    @property
    def weakening(self) -> float:
        """Factor that divides the strength of all materials."""
        return self.laws.weakening

    def weaken(self, factor: float) -> None:
        """Divide the strength of all materials by a factor from now on, 1 at first (collective).

        Raises:
            MPMError: A material does not say what its strength is.
        """
        self.laws.weaken(factor)

    @property
    def symmetric(self) -> bool:
        """Whether the tangents of all materials are symmetric."""
        return all(part.material.symmetric for part in self._present())

    def initial_modulus(self) -> NDArray[np.float64]:
        """Return the largest modulus of the undeformed domains in one direction (collective).

        Returns:
            Shape ``(n,)``.
        """
        return axial_modulus(self.laws)

    def identity(self) -> list[tuple[str, dict[str, Any]]]:
        """Return name and parameters of each material; arrays with the indices of their points.

        They are those of the material as it was given, whatever its strength is divided by.
        """
        nq = self._particles.num_points
        index = (self._particles.global_index[:, None] * nq + np.arange(nq)).ravel()
        common: dict[str, Any] = {} if self.mean_stress is None else {"mixed": "pressure"}
        common["f_bar"] = "none" if self.averaging is None else self.averaging.kind
        if self.softening is not None:
            common["length"] = self.softening.length
        found = []
        materials = self.laws.as_strong_as_given()
        for material, part in zip(materials, self.laws.governed, strict=True):
            where = index[part.points]
            parameters = {
                name: (where, value) if isinstance(value, np.ndarray) else value
                for name, value in material.parameters.items()
            }
            whole = {**parameters, "points": (where, np.ones(len(where))), **common}
            if options := _told(material):
                whole["options"] = options
            found.append((type(material).__name__, whole))
        return found

    # -- How updates are asked for -----------------------------------------------------------

    @contextmanager
    def without_tangents(self) -> Iterator[None]:
        """Let updates in the block be of stress and history alone, where that is enough."""
        self._asks_tangents = self.averaging is not None or self.mean_stress is not None
        try:
            yield
        finally:
            self._asks_tangents = True

    @contextmanager
    def with_tangent(self, tangent: NDArray[np.float64] | None) -> Iterator[None]:
        """Let the tangent of the materials be another one in the block; ``None``: their own."""
        self._imposed = tangent
        try:
            yield
        finally:
            self._imposed = None

    # -- What steps begin with -----------------------------------------------------------------

    def begin_anew(self) -> None:
        """Let the points, which have not moved, be as they were made (collective)."""
        self.go_from(self._initial_states())
        if self.averaging is not None:
            self.averaging.uneven[:] = 0.0

    def go_from(self, states: list[State]) -> None:
        """Take states of the materials for those of the last converged step; all else stays."""
        self.last = replace(self.last, states=states)
        self.trial = self.last

    def recall(self, memories: list[State]) -> None:
        """Go on from memories of a converged step at the present displacement (collective)."""
        gradient = self.strain.gradient()
        if self.averaging is not None:
            gradient = self.averaging.average(gradient)
        self.go_from(self.last.recalled(memories, gradient.reshape(-1, self.dim, self.dim)))

    def see(self, gradient: NDArray[np.float64]) -> None:
        """Take ``F - I`` for what materials have seen at the last converged step (collective)."""
        self.last = replace(self.last, gradient=gradient)
        if self.averaging is not None:
            average = self.strain.average(self.last.cauchy_stress())
            self.last = replace(self.last, recovery=self.averaging.recover(average) - average)

    def begin_with(self, cauchy_stress: NDArray[np.float64]) -> None:
        """Let the points, which have not moved, carry a stress (collective).

        Args:
            cauchy_stress: Shape ``(n, nq, 3, 3)``.

        Raises:
            MPMError: A material cannot bear it; ``particles`` are global indices.
        """
        stress = cauchy_stress.reshape(-1, 3, 3)
        carried = Carried(stress, np.zeros((len(stress), self.dim, self.dim)))
        if self.mean_stress is not None:
            self.mean_stress.begin_with(np.trace(stress, axis1=1, axis2=2) / 3.0)
        if self.averaging is not None:
            self.averaging.begin_with(cauchy_stress)
        with agree(self._comm):
            states = [
                p.stressed_state(np.arange(len(p.points)), carried, {}) for p in self.laws.governed
            ]
        self._settle(states)

    def take_over(self, before: MaterialPoints) -> None:
        """Go on from the last converged step of the same points with other materials (collective).

        See :func:`states_after`. Strength is divided by what it was divided by.

        Args:
            before: The points, on the same mesh.

        Raises:
            MPMError: A material cannot bear its stress; ``particles`` are global indices.
        """
        if before.weakening != self.weakening:
            self.weaken(before.weakening)
        gradient, unchanged = self.strain.gradient(), np.ones(self.laws.num_points, dtype=bool)
        if self.averaging is not None and before.averaging is not None:
            gradient = self.averaging.average(gradient)
            self.averaging.uneven[:] = before.averaging.uneven
            same = self.averaging.groups.same(before.averaging.groups)
            unchanged = np.repeat(same, self._particles.num_points)
        gap = None
        if self.mean_stress is not None and before.mean_stress is not None:
            self.mean_stress.begin_with(before.mean_stress.values)
            gap = before.mean_stress.gap
        gradient = gradient.reshape(-1, self.dim, self.dim)
        stress = before.last.cauchy_stress(gradient).reshape(-1, 3, 3)
        carried = Carried(stress, gradient, gap)
        if self.softening is not None and before.last.average is not None:
            was = before.last
            self.last = replace(self.last, average=was.average, growth=was.growth)
            self.softening.begin(before.last.average)
        known = zip(before.laws.given, before.laws.governed, before.last.states, strict=True)
        episodes = [Episode(*one) for one in known]
        now = list(zip(self.laws.given, self._present(), strict=True))
        self._settle(states_after(episodes, now, carried, unchanged, self._comm))

    def _settle(self, states: list[State]) -> None:
        """Take states for those of the last converged step, at the present displacement.

        The update that asks for their stress takes no time: what flows goes on to.
        """
        self.last = replace(self.last, states=states)
        agreeing = agree(self._comm) if self.averaging is None else nullcontext()
        with self.laws.in_no_time(), agreeing:
            self.update()
        self._make_last(states, self.first_piola.copy())

    def _make_last(self, states: list[State], stress: NDArray[np.float64]) -> None:
        """Take the last update for the converged one (collective with F-bar).

        Args:
            states: What materials keep of it.
            stress: Its first Piola stress, given away for good.
        """
        now = replace(self.last, states=states, gradient=self.trial.gradient, stress=stress)
        if self.softening is not None:
            now = replace(now, average=self.softening.values)
        if self.mean_stress is not None:
            seen = self.mean_stress.strain
            now = replace(now, volume=seen.volume)
            if not self.laws.comes_apart:
                now = replace(now, compliance=seen.compliance.copy())
        if self.averaging is not None:
            with agree(self._comm):
                average = self.strain.average(now.cauchy_stress())
            recovery = self.averaging.recover(average) - average
            now = replace(now, recovery=recovery, resisted=self.averaging.energy().ravel())
        self.last = self.trial = now

    # -- What assembly asks for ----------------------------------------------------------------

    @property
    def grouped(self) -> VolumeAveraging | None:
        """Part of the tangent from other points of a group; ``None`` without F-bar."""
        return self.averaging

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
        """Constraint whose multiplier is the pressure, in the last update."""
        assert self.mean_stress is not None
        return self.mean_stress.strain

    @property
    def by_pressure(self) -> NDArray[np.float64]:
        """Derivative of the stress by a pressure of its own, ``(n nq, dim, dim)``."""
        return self.volume_strain.by_pressure

    # -- Energies ------------------------------------------------------------------------------

    def strain_energy(self, trial: bool = False) -> NDArray[np.float64]:
        """Return the elastic energy per undeformed volume of all points, ``(n nq,)`` (collective).

        Args:
            trial: Whether it is that of the last update, not of the last converged step. Whoever
                updates lets ranks agree then.

        Returns:
            That of the material, and of what F-bar resists; not a number where a material does not
            know it.
        """
        if trial:
            result = self.trial.strain_energy()
            return result if self.averaging is None else result + self.averaging.energy().ravel()
        with agree(self._comm):
            result = self.last.strain_energy()
        return result if self.last.resisted is None else result + self.last.resisted

    def potential(self, trial: bool = False) -> NDArray[np.float64]:
        """Return elastic energy and, where laws know it, plastic work, ``(n nq,)`` (collective).

        Args:
            trial: As for :meth:`strain_energy`.
        """
        result = self.strain_energy(trial)
        if trial:
            return result + self.trial.plastic_work()[0]
        with agree(self._comm):
            return result + self.last.plastic_work()[0]

    @property
    def has_potential(self) -> NDArray[np.bool_]:
        """Whether stresses derive from :meth:`potential` over a step, ``(n nq,)`` (collective).

        That is one of F there; with F-bar, of F at the points of a group, which has one material.
        With a pressure of its own that is the stress without it.
        """
        elastic = self.laws.where(lambda part: not getattr(part.material, "inelastic", True))
        with agree(self._comm):
            known = self.last.plastic_work()[1]
        return (elastic | known) & np.isfinite(self.strain_energy())

    # -- The course of a step ------------------------------------------------------------------

    def update(self) -> None:
        """Update all points for the present displacement; the history stays as it is.

        With F-bar this is collective, also where it fails.

        Raises:
            MPMError: An update fails; ``particles`` are global indices.
        """
        # Two tries, or two tangents, at a time would be the most that a step holds in memory.
        self.trial = self.last
        if self._asks_tangents and len(self.laws.governed) == 1:
            self.tangent = NO_TANGENT
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

    def _update_materials(self, gradient: NDArray[np.float64]) -> None:
        states, volumes = [], []
        for part, state in zip(self._present(), self.last.states, strict=True):
            everywhere = len(part.points) == self.laws.num_points
            its = gradient if everywhere else gradient[part.points]
            if self.mean_stress is None:
                answer = part.answer(its, state, self._asks_tangents)
            else:
                answer, volume = _at_pressure(self.mean_stress, part, its, state)
                volumes.append((part.points, volume))
            if everywhere:
                self.first_piola = answer.first_piola
            else:
                self.first_piola[part.points] = answer.first_piola
            if self._asks_tangents and everywhere:
                self.tangent = answer.tangent
            elif self._asks_tangents:
                self.tangent[part.points] = answer.tangent
            states.append(answer.state)
        if self._imposed is not None:
            self.tangent = self._imposed
        average = None if self.softening is None else self.softening.values
        self.trial = PointState(self.laws, states, gradient, average)
        if self.mean_stress is not None:
            self.mean_stress.see(volumes)

    def expect(self) -> None:
        """Begin a step with the average that is expected at its end."""
        last = self.last
        if self.softening is not None and last.average is not None and last.growth is not None:
            self.softening.expect(last.average + last.growth)

    def miss(self) -> None:
        """Expect no growth of the average in the next try of a step, which has failed with it."""
        if self.last.growth is not None:
            self.last = self.trial = replace(self.last, growth=np.zeros_like(self.last.growth))

    def alternate(self) -> int:
        """Average what softens; return the linear solves that it took (collective)."""
        return 0 if self.softening is None else self.softening.alternate(self.trial.states)

    def elastic(self) -> bool:
        """Return whether no internal variable has changed in the last update: nothing yields."""
        return self.trial.is_elastic_since(self.last)

    def yielding(self) -> NDArray[np.bool_]:
        """Return whether an internal variable of each particle has changed in the last update."""
        return self.trial.has_yielded_since(self.last)

    def commit(self) -> Callable[[], None]:
        """Make the last update the history (collective with F-bar).

        Returns:
            A function that makes the history of before that again.
        """
        before, trial, stress = self.last, self.trial, self.first_piola

        def undo() -> None:
            self.last, self.trial, self.first_piola = before, trial, stress
            if self.softening is not None and before.average is not None:
                self.softening.begin(before.average)

        laws = self.laws.governed
        states = [part.given_away(s) for part, s in zip(laws, trial.states, strict=True)]
        alone = len(laws) == 1 and laws[0].is_own
        self._make_last(states, stress if alone else stress.copy())
        now = self.last.average
        if self.softening is not None and now is not None and before.average is not None:
            self.last = self.trial = replace(self.last, growth=now - before.average)
            self.softening.begin(now)
        return undo

    def roll_back(self) -> None:
        """Forget the last update."""
        last = self.last
        if self.softening is not None and last.average is not None:
            self.softening.begin(last.average)
        self.trial = last
        self.first_piola = last.stress.copy()
        if self.mean_stress is not None:
            assert last.volume is not None and last.compliance is not None
            self.mean_stress.return_to(last.volume, last.compliance, last.gradient)

    def columns(self) -> dict[str, Column]:
        """Return the history of the last converged step; see :meth:`Converged.columns`."""
        columns = self.last.columns()
        if self.averaging is not None:
            columns["uneven"] = Column(self.averaging.uneven, "points")
        return columns

    def restore(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Make what :meth:`columns` once returned the history of the last step."""
        rest = {name: values for name, values in arrays.items() if name != "uneven"}
        if self.averaging is not None and len(rest) < len(arrays):
            self.averaging.uneven[:] = arrays["uneven"].reshape(self.averaging.uneven.shape)
        self.last = self.trial = now = self.last.with_columns(rest)
        if self.softening is not None and now.average is not None:
            self.softening.begin(now.average)


def _at_pressure(
    mean_stress: MeanStress, part: Governed, gradient: NDArray[np.float64], state: State
) -> tuple[Answer, VolumeStrain]:
    """Return a material's answer at the pressure of its points, and its volume strain."""
    points = part.points
    if part.at_pressure:
        return part.answer_at(
            mean_stress.values[points], mean_stress.shear[points], gradient, state
        )
    own = Update(*part.answer(gradient, state))
    (stress, tangent, new), strain = mean_stress.replace(points, gradient, own)
    assert tangent is not None
    return Answer(stress, tangent, new), strain


def _told(law: Material) -> str:
    """Return the traits of a law besides its class and its parameters, in words."""
    found = options_of(law).items()
    return ", ".join(
        f"{name}={type(one).__name__}({_told(one)})"
        if isinstance(one, Material)
        else f"{name}={one}"
        for name, one in found
    )
