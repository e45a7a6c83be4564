# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Materials at the quadrature points of particles: trial update, commit, roll back."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dolfinx import mesh

from ..errors import agree
from ..materials.base import State, Update
from ..meshes.remesh import Column
from ..particles.field import ParticleField
from .asked import Asked
from .assignment import Assignment, Materials
from .averaging import VolumeAveraging
from .governed import Answer, Governed, no_tangent
from .moduli import axial_modulus, resisting_modulus
from .numbers import Numbers
from .point_state import Converged, PointState
from .pressure import MeanStress, VolumeStrain
from .softening_average import SofteningAverage, softened
from .strain import Strain

__all__ = ["MaterialPoints"]


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
        numbers: The parameters that the materials have now.
        asked: What updates are asked for.
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
            self.laws, self.initial_states(), np.zeros(shape), none, np.zeros(shape), growth=none
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
        self.numbers = Numbers(self.laws, self.averaging)
        self.asked = Asked(f_bar != "none" or pressure is not None)

    def initial_states(self) -> list[State]:
        """Return the states of the materials where nothing is strained yet (collective)."""
        with agree(self._comm):
            return [part.initial_state() for part in self.laws.governed]

    def present(self) -> list[Governed]:
        """Return the materials at their points, softened by the average of the present update."""
        average = None if self.softening is None else self.softening.values
        return [softened(part, average) for part in self.laws.governed]

    # -- The materials ---------------------------------------------------------------------

    @property
    def symmetric(self) -> bool:
        """Whether the tangents of all materials are symmetric."""
        return all(part.material.symmetric for part in self.present())

    def initial_modulus(self) -> NDArray[np.float64]:
        """Return the largest modulus of the undeformed domains in one direction (collective).

        Returns:
            Shape ``(n,)``.
        """
        return axial_modulus(self.laws)

    # -- What steps begin with -----------------------------------------------------------------

    def remember(self, average: NDArray[np.float64], growth: NDArray[np.float64] | None) -> None:
        """Go on with an average over the length, and with its growth."""
        assert self.softening is not None
        self.last = replace(self.last, average=average, growth=growth)
        self.softening.begin(average)

    def go_from(self, states: list[State]) -> None:
        """Take states of the materials for those of the last converged step; all else stays."""
        self.last = replace(self.last, states=states)
        self.trial = self.last

    def begin_at(self, stress: NDArray[np.float64] | None) -> None:
        """Take a Cauchy stress, ``(n nq, 3, 3)``, or none, for that which points begin with."""
        self.last = replace(self.last, begun=stress)

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

    def settle(self, states: list[State]) -> None:
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
    def volume_strain(self) -> VolumeStrain:
        """Constraint whose multiplier is the pressure, in the last update."""
        assert self.mean_stress is not None
        return self.mean_stress.strain

    @property
    def by_pressure(self) -> NDArray[np.float64]:
        """Derivative of the stress by a pressure of its own, ``(n nq, dim, dim)``."""
        return self.volume_strain.by_pressure

    # -- The course of a step ------------------------------------------------------------------

    def update(self) -> None:
        """Update all points for the present displacement; the history stays as it is.

        With F-bar this is collective, also where it fails.

        Raises:
            MPMError: An update fails; ``particles`` are global indices.
        """
        # Two tries, or two tangents, at a time would be the most that a step holds in memory.
        self.trial = self.last
        if self.asked.tangents and len(self.laws.governed) == 1:
            self.tangent = no_tangent
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
        for part, state in zip(self.present(), self.last.states, strict=True):
            everywhere = len(part.points) == self.laws.num_points
            its = gradient if everywhere else gradient[part.points]
            if self.mean_stress is None:
                answer = part.answer(its, state, self.asked.tangents)
            else:
                answer, volume = _at_pressure(self.mean_stress, part, its, state)
                volumes.append((part.points, volume))
            if everywhere:
                self.first_piola = answer.first_piola
            else:
                self.first_piola[part.points] = answer.first_piola
            if self.asked.tangents and everywhere:
                self.tangent = answer.tangent
            elif self.asked.tangents:
                self.tangent[part.points] = answer.tangent
            states.append(answer.state)
        if self.asked.imposed is not None:
            self.tangent = self.asked.imposed
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
