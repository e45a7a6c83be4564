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

from ..errors import MPMError, agree, as_ours
from ..materials.base import Material, Parameter, State, Update
from ..meshes.remesh import Column
from ..particles.field import ParticleField
from .assignment import Assignment, Materials
from .averaging import VolumeAveraging
from .governed import Answer, Carried, Governed
from .gradient_average import GradientAverage
from .pressure import MeanStress, VolumeStrain
from .strain import Strain
from .succession import Episode, states_after

__all__ = ["Governing", "MaterialPoints"]


class _Converged(NamedTuple):
    """Points at the last converged step.

    Attributes:
        states: What the material of each group keeps.
        gradient: ``F - I`` that the materials have seen, shape ``(n nq, dim, dim)``.
        stress: First Piola stress, of the same shape.
        volume: Volume strain, where a pressure takes the place of the mean stress.
        compliance: Its own, where a law is evaluated at the pressure.
        recovery: See :attr:`MaterialPoints.recovery`.
        resisted: Energy that F-bar resists, shape ``(n nq,)``.
        average: That of the plastic strain over the length of the body, with which its stress was
            found, of the same shape.
        growth: Its change in the last step, by which it is expected to change in the next.
    """

    states: list[State]
    gradient: NDArray[np.float64]
    stress: NDArray[np.float64]
    volume: NDArray[np.float64]
    compliance: NDArray[np.float64]
    recovery: NDArray[np.float64] | float
    resisted: NDArray[np.float64]
    average: NDArray[np.float64]
    growth: NDArray[np.float64]


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
        materials: Materials,
        cell_tags: mesh.MeshTags | None,
        f_bar: str = "none",
        pressure: ParticleField | None = None,
        length: float | None = None,
    ) -> None:
        self._particles = particles = strain.particles
        self.strain = strain
        self.dim = strain.dim
        self._points = particles.num_local * particles.num_points
        self.mean_stress: MeanStress | None = None
        if pressure is not None:
            self.mean_stress = MeanStress(pressure, (self._points, self.dim))
        self._assignment = Assignment(particles, self.dim, materials, cell_tags, self.mean_stress)
        with agree(particles.mesh.comm):
            states = [part.initial_state() for part in self._governed]
        shape = (self._points, self.dim, self.dim)
        none = np.zeros(self._points)
        zero = np.zeros(shape)
        self._last = _Converged(states, zero, zero.copy(), none, none, 0.0, *[none] * 3)
        self._spread = None if length is None else self._spread_over(length)
        self._average = none
        self._turns, self._expecting = 0, False
        self.first_piola = np.zeros(shape)
        self.tangent = np.zeros((*shape, self.dim, self.dim))
        self._trial, self._trial_gradient = states, self._last.gradient
        self._asks_tangents = True
        self._imposed: NDArray[np.float64] | None = None
        self.averaging: VolumeAveraging | None = None
        if f_bar != "none":
            material = np.zeros(particles.num_local, dtype=np.int64)
            for kind, part in zip(self._assignment.kinds(), self._governed, strict=True):
                material[part.points // particles.num_points] = kind
            self.averaging = VolumeAveraging(
                strain, f_bar, material, self._resistance(), self.symmetric
            )

    @property
    def _governed(self) -> list[Governed]:
        return self._assignment.governed

    # -- An average over a length ------------------------------------------------------------

    def _spread_over(self, length: float) -> GradientAverage:
        """Return the average over a length of points whose laws soften (collective)."""
        particles, counts = self._particles, np.zeros(self._points, dtype=bool)
        for part in self._governed:
            counts[part.points] = part.material.softens
        if not any(part.material.softens for part in self._governed):
            laws = ", ".join(type(law).__name__ for law in self.given)
            raise MPMError(
                f"length= is for laws that soften with their plastic strain (decay=), which {laws} "
                "does not; omit it, or give the law a residual strength and decay."
            )
        counts = counts.reshape(particles.num_local, particles.num_points).any(axis=1)
        return GradientAverage(self.strain, length, counts)

    @property
    def average(self) -> NDArray[np.float64]:
        """The average that softens, at the last converged step, shape ``(n nq,)``."""
        return self._last.average

    @property
    def growth(self) -> NDArray[np.float64]:
        """By how much the average is expected to change in the next step, shape ``(n nq,)``."""
        return self._last.growth

    @property
    def averages(self) -> bool:
        """Whether laws soften by an average over a length."""
        return self._spread is not None

    def _averaged(self, states: list[State]) -> NDArray[np.float64]:
        """Return the average of the plastic strain of states, shape ``(n nq,)`` (collective)."""
        assert self._spread is not None
        values = np.zeros(self._points)
        for part, state in zip(self._governed, states, strict=True):
            if part.material.softens:
                values[part.points] = state["plastic_strain"]
        shape = self._particles.num_local, self._particles.num_points
        return self._spread.of(values.reshape(shape)).ravel()

    def expect(self) -> None:
        """Begin a step with the average that is expected at its end."""
        self._average, self._expecting = self._last.average + self._last.growth, True

    def alternate(self) -> int:
        """Average the plastic strain of the last update for the next one (collective).

        Each second time it goes twice as far: what converges slowly changes by little each time and
        in one direction, so that this halves the number of alternations, and what grows goes on
        to.

        Returns:
            The linear solves that it took.
        """
        if self._spread is None:
            return 0
        self._turns += 1
        ahead = 2.0 if self._turns % 2 == 0 else 1.0
        self._average = self._average + ahead * (self._averaged(self._trial) - self._average)
        return 1

    def _present(self, part: Governed, trial: bool = True) -> Governed:
        """Return a material at its points with an average, where that softens it.

        Args:
            part: The material.
            trial: Whether it is that of the present update, not of the last converged step.
        """
        if self._spread is None or not part.material.softens:
            return part
        average = (self._average if trial else self._last.average)[part.points]
        law = part.law.softening_by(average)
        return replace(part, material=part.material.softening_by(average), law=law)

    def _resistance(self) -> NDArray[np.float64]:
        """Return three times the shear modulus of each undeformed domain (collective)."""
        modulus = np.zeros(self._particles.num_local)
        with agree(self._particles.mesh.comm):
            for part in self._governed:
                shear = part.undeformed_tangent()[:, 0, 1, 0, 1]
                modulus[part.points // self._particles.num_points] = 3.0 * shear
        return modulus

    def follow_parameters(self) -> None:
        """Take over the present values of parameters that are Functions or Constants (collective).

        Raises:
            MPMError: They are not allowed, or the parameters of a material are other objects than
                when this history was made.
        """
        if self._assignment.follow_parameters() and self.averaging is not None:
            self.averaging.modulus = self._resistance()

    @property
    def are_own(self) -> bool:
        """Whether all materials are of this package, which have no numbers but parameters."""
        return all(part.is_own for part in self._governed)

    @property
    def given(self) -> list[Material]:
        """The materials as they were given."""
        return self._assignment.given

    def governing(self) -> Governing:
        """Return the materials with the numbers that they have now, for :meth:`govern_by`."""
        modulus = None if self.averaging is None else self.averaging.modulus
        return Governing(list(self._governed), modulus)

    def govern_by(self, governing: Governing) -> None:
        """Let materials have the numbers again that they once had."""
        self._assignment.governed = list(governing.materials)
        if self.averaging is not None and governing.modulus is not None:
            self.averaging.modulus = governing.modulus

    def assume(self, law: Material, name: str, value: Parameter) -> None:
        """Let a material, as it was given, have another number until the next call (collective)."""
        with agree(self._particles.mesh.comm):
            self._assignment.assume(law, name, value)
        if self.averaging is not None:
            self.averaging.modulus = self._resistance()

    @property
    def weakening(self) -> float:
        """Factor that divides the strength of all materials."""
        return self._assignment.weakening

    def weaken(self, factor: float) -> None:
        """Divide the strength of all materials by a factor from now on, 1 at first (collective).

        Raises:
            MPMError: A material does not say what its strength is.
        """
        self._assignment.weaken(factor)

    @contextmanager
    def without_tangents(self) -> Iterator[None]:
        """Let updates in the block be of stress and history alone, where that is enough."""
        self._asks_tangents = self.averaging is not None or self.mean_stress is not None
        try:
            yield
        finally:
            self._asks_tangents = True

    def answers(
        self, gradient: NDArray[np.float64], states: list[State]
    ) -> tuple[NDArray[np.float64], list[State]]:
        """Return the answers of the materials, and leave all as it is (not collective).

        Args:
            gradient: ``F - I`` that they see, shape ``(n nq, dim, dim)``.
            states: Of each material at the beginning of the step.

        Returns:
            Their first Piola stress, of the same shape, and their states.
        """
        stress, found = np.zeros(gradient.shape), []
        for part, state in zip(self._governed, states, strict=True):
            everywhere = len(part.points) == self._points
            its = gradient if everywhere else gradient[part.points]
            answer = part.answer(its, state, tangent=False)
            if everywhere and part.is_own:
                stress = answer.first_piola
            else:
                stress[part.points] = answer.first_piola
            own = answer.state
            found.append(own if part.is_own else {name: v.copy() for name, v in own.items()})
        return stress, found

    def points_of_laws(self) -> list[NDArray[np.int64]]:
        """Return the numbers of the points of each material."""
        return [part.points for part in self._governed]

    def tangents(self, gradient: NDArray[np.float64], states: list[State]) -> NDArray[np.float64]:
        """Return derivatives of :meth:`answers` as the materials tell them (not collective)."""
        found = np.zeros(self.tangent.shape)
        for part, state in zip(self._governed, states, strict=True):
            found[part.points] = part.answer(gradient[part.points], state).tangent
        return found

    @contextmanager
    def with_tangent(self, tangent: NDArray[np.float64] | None) -> Iterator[None]:
        """Let the tangent of the materials be another one in the block; ``None``: their own."""
        self._imposed = tangent
        try:
            yield
        finally:
            self._imposed = None

    @contextmanager
    def in_no_time(self) -> Iterator[None]:
        """Let no time pass in updates in the block."""
        duration = self._assignment.duration
        self.pace(0.0)
        try:
            yield
        finally:
            self.pace(duration)

    def pace(self, duration: float) -> None:
        """Let updates be those of steps of a duration; without a call no time passes."""
        self._assignment.pace(duration)

    # -- A stress that is there at first ---------------------------------------------------

    def begin_with_pressure(self) -> None:
        """Let the pressure be that of materials where nothing is strained yet (collective)."""
        assert self.mean_stress is not None
        self.mean_stress.begin_with(self.converged_pressure)

    def begin_anew(self) -> None:
        """Let the points, which have not moved, be as they were made (collective)."""
        with agree(self._particles.mesh.comm):
            states = [part.initial_state() for part in self._governed]
        self.go_from(states)

    def go_from(self, states: list[State]) -> None:
        """Take states of the materials for those of the last converged step; all else stays."""
        average = self._last.average if self._spread is None else self._averaged(states)
        self._last = self._last._replace(states=states, average=average)
        self._forget_trial()

    def memories(self) -> list[State]:
        """Return the part of each material's converged state that :meth:`recall` needs."""
        pairs = zip(self._governed, self._last.states, strict=True)
        return [part.memory(state) for part, state in pairs]

    def recall(self, memories: list[State]) -> None:
        """Go on from memories of a converged step at the present displacement (collective)."""
        gradient = self.strain.gradient()
        if self.averaging is not None:
            gradient = self.averaging.average(gradient)
        gradient = gradient.reshape(-1, self.dim, self.dim)
        known = zip(self._governed, memories, self._last.states, strict=True)
        self.go_from([part.recalled(own, gradient[part.points], s) for part, own, s in known])

    def states(self, trial: bool = False) -> list[State]:
        """Return the state of each material, converged or of the last update."""
        return self._trial if trial else self._last.states

    def seen_gradient(self, trial: bool = False) -> NDArray[np.float64]:
        """Return ``F - I`` that the materials have seen, converged or in the last update."""
        return self._trial_gradient if trial else self._last.gradient

    def see(self, gradient: NDArray[np.float64]) -> None:
        """Take ``F - I`` for what materials have seen at the last converged step (collective)."""
        self._last = self._last._replace(gradient=gradient)
        if self.averaging is not None:
            average = self.strain.average(self.cauchy_stress())
            recovery = self.averaging.recover(average) - average
            self._last = self._last._replace(recovery=recovery)

    def begin_with(self, cauchy_stress: NDArray[np.float64]) -> None:
        """Let the points, which have not moved, carry a stress (collective).

        Args:
            cauchy_stress: Shape ``(n, nq, 3, 3)``.

        Raises:
            MPMError: A material cannot bear it; ``particles`` are global indices.
        """
        stress = cauchy_stress.reshape(self._points, 3, 3)
        carried = Carried(stress, np.zeros((self._points, self.dim, self.dim)))
        if self.mean_stress is not None:
            self.mean_stress.begin_with(np.trace(stress, axis1=1, axis2=2) / 3.0)
        with agree(self._particles.mesh.comm):
            states = [
                p.stressed_state(np.arange(len(p.points)), carried, {}) for p in self._governed
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
        gradient, unchanged = self.strain.gradient(), np.ones(self._points, dtype=bool)
        if self.averaging is not None and before.averaging is not None:
            gradient = self.averaging.average(gradient)
            same = self.averaging.groups.same(before.averaging.groups)
            unchanged = np.repeat(same, self._particles.num_points)
        gap = None
        if self.mean_stress is not None and before.mean_stress is not None:
            pressure, seen = before.mean_stress.values, before.volume_strain
            self.mean_stress.begin_with(pressure)
            gap = seen.volume - seen.compliance * pressure
        gradient = gradient.reshape(-1, self.dim, self.dim)
        stress = before.cauchy_stress(gradient).reshape(self._points, 3, 3)
        carried = Carried(stress, gradient, gap)
        episodes = before.episodes()
        self._last = self._last._replace(average=before.average, growth=before.growth)
        self._average = before.average
        laws = list(zip(self._assignment.given, map(self._present, self._governed), strict=True))
        self._settle(states_after(episodes, laws, carried, unchanged, self._particles.mesh.comm))

    def episodes(self) -> list[Episode]:
        """Return each material as given, with its points and their last converged state."""
        return [
            Episode(*known)
            for known in zip(self._assignment.given, self._governed, self._last.states, strict=True)
        ]

    def _settle(self, states: list[State]) -> None:
        """Take states for those of the last converged step, at the present displacement.

        The update that asks for their stress takes no time: what flows goes on to.
        """
        self._last = self._last._replace(states=states)
        with (
            self.in_no_time(),
            agree(self._particles.mesh.comm) if self.averaging is None else nullcontext(),
        ):
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
        now = before._replace(states=states, gradient=self._trial_gradient, stress=stress)
        now = now._replace(average=self._average)
        if self.mean_stress is not None:
            seen = self.mean_stress.strain
            now = now._replace(volume=seen.volume)
            if not self.comes_apart:
                now = now._replace(compliance=seen.compliance.copy())
        self._last = now
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
        self._last = now._replace(recovery=recovery, resisted=resisted)

    @property
    def recovery(self) -> NDArray[np.float64] | float:
        """Correction of the particles' Cauchy stress by the recovery of averaged stresses.

        Shape ``(n, 3, 3)``, or 0.
        """
        return self._last.recovery

    @property
    def comes_apart(self) -> bool:
        """Whether mean stresses depend on the volume alone, so that a pressure can replace them."""
        return not any(part.at_pressure for part in self._governed)

    @property
    def at_pressure(self) -> NDArray[np.bool_]:
        """Whether the law of each point is evaluated at its pressure, shape ``(n nq,)``."""
        result = np.zeros(self._points, dtype=bool)
        for part in self._governed:
            result[part.points] = part.at_pressure
        return result

    @property
    def grouped(self) -> VolumeAveraging | None:
        """Part of the tangent from other points of a group; ``None`` without F-bar."""
        return self.averaging

    @property
    def symmetric(self) -> bool:
        """Whether the tangents of all materials are symmetric."""
        return all(self._present(part).material.symmetric for part in self._governed)

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
    def converged_pressure(self) -> NDArray[np.float64]:
        """Mean of the laws' own stress at the last converged step, shape ``(n nq,)``."""
        result = np.zeros(self._points)
        for part, state in zip(self._governed, self._last.states, strict=True):
            result[part.points] = state["stress"][:, :3].sum(axis=1) / 3.0
        return result

    @property
    def by_pressure(self) -> NDArray[np.float64]:
        """Derivative of the stress by a pressure of its own, ``(n nq, dim, dim)``."""
        return self.volume_strain.by_pressure

    def initial_modulus(self) -> NDArray[np.float64]:
        """Return the largest modulus of the undeformed domains in one direction (collective).

        Returns:
            Shape ``(n,)``.
        """
        result = np.zeros(self._points)
        with agree(self._particles.mesh.comm):
            for part in self._governed:
                tangent = part.undeformed_tangent()
                result[part.points] = np.einsum("niiii->ni", tangent).max(axis=1, initial=0.0)
        shape = (self._particles.num_local, self._particles.num_points)
        return result.reshape(shape).mean(axis=1)

    def shear_modulus(self) -> float:
        """Return the mean shear modulus of the unstrained body (collective)."""
        volumes = self.strain.volumes().ravel()
        shear = self.undeformed_moduli()[1]
        whole, volume = self._particles.mesh.comm.allreduce(
            np.array([volumes @ shear, volumes.sum()])
        )
        return float(whole / volume)

    def undeformed_moduli(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return bulk and shear modulus of all unstrained points, ``(n nq,)`` each (collective)."""
        with agree(self._particles.mesh.comm):
            tangent = self.undeformed_tangent()
        shear = tangent[:, 0, 1, 0, 1]
        return tangent[:, 0, 0, 0, 0] - 4.0 / 3.0 * shear, shear

    @property
    def num_laws(self) -> int:
        """Number of laws, the same on all ranks."""
        return len(self._governed)

    @property
    def law_numbers(self) -> NDArray[np.int64]:
        """Number of the law of each domain, shape ``(n,)``."""
        result = np.zeros(self._points, dtype=np.int64)
        for number, part in enumerate(self._governed):
            result[part.points] = number
        return result.reshape(self._particles.num_local, -1)[:, 0]

    def undeformed_tangent(self) -> NDArray[np.float64]:
        """Return dP/dF of all points where nothing is strained, ``(n nq, dim, dim, dim, dim)``."""
        result = np.zeros(self.tangent.shape)
        for part in self._governed:
            result[part.points] = part.undeformed_tangent()
        return result

    def strain_energy(self, trial: bool = False) -> NDArray[np.float64]:
        """Return the elastic energy per undeformed volume of all points, ``(n nq,)`` (collective).

        Args:
            trial: Whether it is that of the last update, not of the last converged step.

        Returns:
            That of the material, and of what F-bar resists; not a number where a material does not
            know it.
        """
        result = np.full(self._points, np.nan)
        for part, energy in self._told(Governed.strain_energy, trial):
            if energy is not None:
                result[part.points] = energy
        if self.averaging is not None:
            result += self.averaging.energy().ravel() if trial else self._last.resisted
        return result

    def _told[T](
        self, ask: Callable[[Governed, State], T], trial: bool
    ) -> list[tuple[Governed, T]]:
        """Return the answers of materials about their last update, or about the converged step.

        An error of one of them on one rank is one on all (collective); in a trial whoever updates
        lets ranks agree.
        """
        states = self._trial if trial else self._last.states
        with nullcontext() if trial else agree(self._particles.mesh.comm):
            return [(p, ask(p, its)) for p, its in zip(self._governed, states, strict=True)]

    def potential(self, trial: bool = False) -> NDArray[np.float64]:
        """Return elastic energy and, where laws know it, plastic work, ``(n nq,)`` (collective).

        Args:
            trial: As for :meth:`strain_energy`.
        """
        result = self.strain_energy(trial)
        for part, work in self._told(Governed.plastic_work, trial):
            if work is not None:
                result[part.points] += work
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
        """Whether stresses derive from :meth:`potential` over a step, ``(n nq,)`` (collective).

        That is one of F there; with F-bar, of F at the points of a group, which has one material.
        With a pressure of its own that is the stress without it.
        """
        found = self._where(lambda law: not getattr(law, "inelastic", True))
        for part, work in self._told(Governed.plastic_work, False):
            if work is not None:
                found[part.points] = True
        return found & np.isfinite(self.strain_energy())

    def _where(self, holds: Callable[[Material], bool]) -> NDArray[np.bool_]:
        result = np.zeros(self._points, dtype=bool)
        for part in self._governed:
            result[part.points] = holds(part.material)
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

    def _update_materials(self, gradient: NDArray[np.float64]) -> None:
        trial, volumes = [], []
        laws = map(self._present, self._governed)
        for part, state in zip(laws, self._last.states, strict=True):
            everywhere = len(part.points) == self._points
            its = gradient if everywhere else gradient[part.points]
            if self.mean_stress is None:
                answer = part.answer(its, state, self._asks_tangents)
            else:
                answer, volume = self._at_pressure(self.mean_stress, part, its, state)
                volumes.append((part.points, volume))
            if everywhere:
                self.first_piola = answer.first_piola
            else:
                self.first_piola[part.points] = answer.first_piola
            if self._asks_tangents and everywhere:
                self.tangent = answer.tangent
            elif self._asks_tangents:
                self.tangent[part.points] = answer.tangent
            trial.append(answer.state)
        if self._imposed is not None:
            self.tangent = self._imposed
        self._trial, self._trial_gradient = trial, gradient
        if self.mean_stress is not None:
            self.mean_stress.see(volumes)

    @staticmethod
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

    def elastic(self) -> bool:
        """Return whether no internal variable has changed in the last update: nothing yields."""
        for part, before, after in zip(self._governed, self._last.states, self._trial, strict=True):
            if before.keys() == {"stress"} or not getattr(part.material, "inelastic", True):
                continue
            variables = getattr(part.material, "internal_variables", ())
            if not variables or not all(np.array_equal(before[v], after[v]) for v in variables):
                return False
        return True

    def yielding(self) -> NDArray[np.bool_]:
        """Return whether an internal variable of each particle has changed in the last update."""
        result = np.zeros(self._points, dtype=bool)
        for part, before, after in zip(self._governed, self._last.states, self._trial, strict=True):
            for name in getattr(part.material, "internal_variables", ()):
                changed = before[name] != after[name]
                result[part.points] |= changed.any(axis=tuple(range(1, changed.ndim)))
        return result.reshape(self._particles.num_local, self._particles.num_points).any(axis=1)

    def commit(self) -> Callable[[], None]:
        """Make the last update the history (collective with F-bar).

        Returns:
            A function that makes the history of before that again.
        """
        before = self._last
        tried = self._trial, self._trial_gradient, self.first_piola

        def undo() -> None:
            self._last, self._average = before, before.average
            self._trial, self._trial_gradient, self.first_piola = tried

        self._trial = [
            state if part.is_own else {k: v.copy() for k, v in state.items()}
            for part, state in zip(self._governed, self._trial, strict=True)
        ]
        alone = len(self._governed) == 1 and self._governed[0].is_own
        self._make_last(self._trial, self.first_piola if alone else self.first_piola.copy())
        if self._spread is not None:
            self._last = self._last._replace(growth=self._last.average - before.average)
        self._turns, self._expecting = 0, False
        return undo

    def roll_back(self) -> None:
        """Forget the last update."""
        if self._expecting:  # what was not found is not expected again
            self._last = self._last._replace(growth=np.zeros(self._points))
        self._average = self._last.average
        self._turns, self._expecting = 0, False
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
                values[self._governed[number].points] = self._last.states[number][name]
            whole[f"{name}@{','.join(map(str, numbers))}"] = values
        n, nq = self._particles.num_local, self._particles.num_points
        columns = {
            name: Column(v.reshape(n, nq, *v.shape[1:]), "points") for name, v in whole.items()
        }
        if self._spread is not None:
            columns["average"] = Column(self._last.average.reshape(n, nq), "points")
            columns["growth"] = Column(self._last.growth.reshape(n, nq), "points")
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
        states: list[State] = [{} for _ in self._governed]
        last = self._last._replace(
            states=states,
            gradient=flat.pop("gradient"),
            stress=flat.pop("first_piola"),
            volume=flat.pop("volume_strain", self._last.volume),
            compliance=flat.pop("compliance", self._last.compliance),
            average=flat.pop("average", self._last.average),
            growth=flat.pop("growth", self._last.growth),
            recovery=arrays.get("recovery", 0.0),
            resisted=arrays.get("resisted", self._last.resisted).reshape(self._points),
        )
        for key, values in flat.items():
            name, numbers = key.rsplit("@", 1)
            for number in map(int, numbers.split(",")):
                states[number][name] = values[self._governed[number].points]
        self._last, self._average, self._expecting = last, last.average, False
        self._forget_trial()

    def laws(self) -> list[tuple[str, dict[str, Any]]]:
        """Return name and parameters of each material; arrays with the indices of their points.

        They are those of the material as it was given, whatever its strength is divided by.
        """
        nq = self._particles.num_points
        index = self._particles.global_index[:, None] * nq + np.arange(nq)
        laws = []
        materials = self._assignment.as_strong_as_given()
        for material, part in zip(materials, self._governed, strict=True):
            where = index.ravel()[part.points]
            parameters: dict[str, Any] = {
                name: (where, value) if isinstance(value, np.ndarray) else value
                for name, value in material.parameters.items()
            }
            parameters["points"] = (where, np.ones(len(where)))
            if self.mean_stress is not None:
                parameters["mixed"] = "pressure"
            parameters["f_bar"] = "none" if self.averaging is None else self.averaging.kind
            if self._spread is not None:
                parameters["length"] = self._spread.length
            laws.append((type(material).__name__, parameters))
        return laws

    def cauchy_stress(self, gradient: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """Return the Cauchy stress of the last converged step, shape ``(n, nq, 3, 3)``.

        Args:
            gradient: ``F - I`` to take it at, ``(n nq, dim, dim)``; ``None``: that which laws saw.
        """
        seen = self._last.gradient if gradient is None else gradient

        def value(part: Governed, state: State) -> Any:
            return part.cauchy_stress(seen[part.points], state)

        return self._collect((3, 3), value, "cauchy_stress")

    def plastic_strain(self) -> NDArray[np.float64]:
        """Accumulated plastic strain of the last converged step, shape ``(n, nq)``."""
        return self.variable("plastic_strain")

    def suppose(self, name: str, values: NDArray[np.float64]) -> None:
        """Let an internal variable that comes from outside have other values; all else stays.

        Args:
            name: Key of the materials' states; those without it are left as they are.
            values: At all points, shape ``(n, nq)``.
        """
        flat = values.reshape(self._points)
        self.go_from(
            [
                state | {name: flat[part.points]} if name in state else state
                for part, state in zip(self._governed, self._last.states, strict=True)
            ]
        )

    def variable(self, name: str, trial: bool = False) -> NDArray[np.float64]:
        """Return an internal variable of the last converged step, zero where there is none.

        Args:
            name: Key of the materials' states.
            trial: Whether it is that of the last update.

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
        states = self._trial if trial else None
        return self._collect(shapes.pop(), lambda _, state: state.get(name, 0.0), states=states)

    def yield_function(self) -> NDArray[np.float64]:
        """Yield function of the last converged step, shape ``(n, nq)``; -1 where elastic."""

        def value(part: Governed, state: State) -> Any:
            rule = getattr(self._present(part, trial=False).material, "yield_function", None)
            if rule is None:
                return -1.0
            names = getattr(part.material, "internal_variables", ()) or ("plastic_strain",)
            return rule(state["stress"], *(state[name] for name in names))

        return self._collect((), value, "yield_function")

    def _collect(
        self,
        shape: tuple[int, ...],
        value: Any,
        what: str = "",
        states: list[State] | None = None,
    ) -> NDArray[np.float64]:
        result = np.zeros((self._points, *shape))
        states = self._last.states if states is None else states
        for part, state in zip(self._governed, states, strict=True):
            try:
                result[part.points] = value(part, state)
            except MPMError:
                raise
            except Exception as error:
                raise as_ours(error, f"{what} of {type(part.material).__name__}") from error
        return result.reshape(self._particles.num_local, self._particles.num_points, *shape)
