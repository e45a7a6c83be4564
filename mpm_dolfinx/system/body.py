# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Material and loads of one body, as a term of the reduced system."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, override

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..assembly.body_forms import BodyForms, PointStress
from ..assembly.low_rank import ReducedLowRank
from ..constitutive.averaging import Linearised
from ..constitutive.moduli import undeformed_tangent
from ..constitutive.points import MaterialPoints
from ..errors import MPMError, agree
from ..particles.particles import Particles
from .term import Alternating, Motion, PointMaterial, Term, Transfer

__all__ = ["ActingStress", "BodyTerm", "StepForce"]


class ActingStress(PointMaterial, PointStress, Protocol):
    """The stress that acts at a body's points, with its history."""

    @property
    def grouped(self) -> Linearised | None:
        """The low-rank part of the tangent, from a group's other points; ``None`` without F-bar."""

    def update(self) -> None:
        """Update stress and tangent for the present displacement, or raise an MPMError."""

    def commit(self) -> Callable[[], None]:
        """Make the last update the history; return what takes that back."""

    def roll_back(self) -> None:
        """Return to the stress of the last converged step."""


class StepForce(Protocol):
    """A part of a body's forces that may be one of a whole step; see :meth:`Term.pace`."""

    def pace(self, dt: float, share: float) -> None:
        """Take notice that a step begins."""

    def mute(self, muted: bool) -> None:
        """Leave out, or take in again, what belongs to the whole step."""

    def settle(self) -> None:
        """Take the present state for the beginning of the next step."""

    def beginning(self) -> list[NDArray[np.float64]]:
        """Return the arrays of :meth:`settle` that forces depend on, to be set."""

    def at_end(self) -> list[NDArray[np.float64]]:
        """Return them as :meth:`settle` would leave them after the last update (collective)."""

    def step_work(self) -> tuple[float, float]:
        """Return this rank's work in the last step, internal and damping."""


class BodyTerm(Term):
    """The forms on one body's mesh, and the material at its points.

    Args:
        particles: The body.
        forms: Its residual and tangent.
        stress: The stress that acts on it, if the forms hold one.
        points: The material at its points, of which that is.
        of_step: What among its forces may be of a whole step.
        static: Whether, in a motion of others, the body is in equilibrium at each step's end: its
            forces there count for the whole step.

    Attributes:
        particles: As given.
        forms: As given.
    """

    from_outside = False
    one_sided = False

    def __init__(
        self,
        particles: Particles,
        forms: BodyForms,
        stress: ActingStress | None = None,
        points: MaterialPoints | None = None,
        of_step: Sequence[StepForce] = (),
        static: bool = False,
    ) -> None:
        super().__init__([particles])
        self._static, self._work = static, 0.0
        self._of_step = tuple(of_step)
        self.particles = particles
        self.forms = forms
        self._stress, self._points = stress, points
        self.follows_load = forms.follows_load
        if forms.internal is not None or forms.fused:
            self.fused = [(particles, forms)]
        self._T: PETSc.Mat | None = None
        self._low_rank: ReducedLowRank | None = None

    @override
    def begin(self) -> Sequence[PETSc.Vec]:
        self.forms.assemble_external()
        return [self.forms.external]

    @override
    def start(self, transfer: Transfer, prescribed: Motion) -> None:
        if self._points is not None:
            self._points.expect()

    def miss(self) -> None:
        """Expect nothing in the next try of a step: from what was expected it has failed."""
        if self._points is not None:
            self._points.miss()

    @override
    def pace(self, dt: float, share: float) -> None:
        if self._static:
            self.forms.factor, share = 1.0 / share, 1.0
        for part in self._of_step:
            part.pace(dt, share)

    @override
    def end_forces(self) -> Sequence[PETSc.Vec]:
        if self._static:
            for part in self._of_step:
                part.settle()
            return ()
        found = self.forces_at_end()
        for part in self._of_step:
            part.settle()
        return found

    def forces_at_end(self) -> Sequence[PETSc.Vec]:
        """Return :meth:`end_forces` of the last update, and leave the beginning as it is."""
        if self._static:
            return ()
        for part in self._of_step:
            part.mute(True)
        force = self.forms.assemble_residual().copy()
        for part in self._of_step:
            part.mute(False)
        return [force]

    def beginning(self) -> list[NDArray[np.float64]]:
        """Return the arrays that forces of a whole step begin with, to be set."""
        return [array for part in self._of_step for array in part.beginning()]

    def at_end(self) -> list[NDArray[np.float64]]:
        """Return :meth:`beginning` of the next step after the last update (collective)."""
        return [array for part in self._of_step for array in part.at_end()]

    @override
    def step_work(self) -> tuple[float, float]:
        works = np.array([part.step_work() for part in self._of_step]).reshape(-1, 2)
        total = self.particles.mesh.comm.allreduce(works.sum(axis=0))
        done = self._work - total[1] if self._static else total[0]
        return float(done), float(total[1])

    @override
    def update(self) -> MPMError | None:
        if self._stress is None:
            return None
        try:
            self._stress.update()
        except MPMError as error:
            return error
        return None

    @property
    @override
    def equation(self) -> Alternating | None:
        points = self._points
        return None if points is None or points.softening is None else points

    @override
    def smooth(self) -> bool:
        """Whether all points are smooth; it may differ between ranks."""
        points = self._points
        return points is None or points.trial.is_elastic_since(points.last)

    def yielding(self) -> NDArray[np.bool_] | None:
        """Return whether each particle yields in the last update, if the material says so."""
        points = self._points
        return None if points is None else points.trial.has_yielded_since(points.last)

    @override
    def residuals(self) -> Sequence[PETSc.Vec]:
        force = self.forms.assemble_residual()
        if self._static:
            motion = force.duplicate()
            own = slice(0, motion.getLocalSize())
            displacement = self.particles.displacement.x.array[own]
            motion.array_w[:] = displacement - self.particles.converged_displacement[own]
            self._work = float(force.dot(motion))
        return [self._counted(force)]

    def _counted(self, result: Any) -> Any:
        """Return forces, or a part of the tangent, as often as they count (in place)."""
        if self.forms.factor != 1.0:
            result.scale(self.forms.factor)
        return result

    @override
    def tangents(self) -> Mapping[tuple[int, int], PETSc.Mat]:
        return {(0, 0): self._counted(self.forms.assemble_tangent())} if self.forms.stock else {}

    @override
    def reduced_tangents(self, transfer: Transfer) -> Sequence[PETSc.Mat]:
        """Tangents at the unknowns, low-rank parts apart from others."""
        if self.forms.low_rank is None:
            return []
        T = transfer(self.particles)
        if T is not self._T:
            self._T, self._low_rank = T, None
        self._low_rank = self.forms.low_rank.reduced(T, self._low_rank)
        return [self._counted(part) for part in self._low_rank.parts]

    @override
    def absolute_contributions(self) -> Sequence[PETSc.Vec]:
        return [self._counted(self.forms.absolute_contributions(self.particles.domain_nodes))]

    @override
    def load_derivative(self, order: int) -> tuple[Sequence[PETSc.Vec], float]:
        part, size = self.forms.load_derivative(order)
        return [part], size

    @override
    def stiffness_force(self, motions: Sequence[PETSc.Vec]) -> Sequence[PETSc.Vec]:
        return [self._counted(self.forms.stiffness_force(motions[0]))]

    def shear_modulus(self) -> float:
        """Return the stiffness of the body to simple shear, undeformed where the law is known.

        It is the smallest positive energy ``g : C : g`` over uniform gradients g with one entry,
        for an isotropic elastic body its shear modulus, or the mean of it. What acts on facets,
        supports and follower loads, is no stiffness of the body, and where the origin of
        coordinates is does not matter.
        """
        particles = self.particles
        if self._points is None:
            energy = self.forms.energies_of_gradients()
        else:
            # (not around an axis, where a shear strains hoops by what is far from the middle)
            plane = (slice(particles.mesh.geometry.dim),) * 4
            with agree(particles.mesh.comm):
                tangent = undeformed_tangent(self._points.laws)[:, *plane]
            energy = np.einsum("n,niJiJ->iJ", self._points.strain.weights.ravel(), tangent)
        own = [particles.initial_volume.sum(), *energy.ravel()]
        volume, *energies = particles.mesh.comm.allreduce(np.array(own))
        positive = [float(energy / volume) for energy in energies if energy > 0.0]
        return self.forms.factor * min(positive, default=0.0)

    @override
    def commit(self) -> Callable[[], None] | None:
        return None if self._stress is None else self._stress.commit()

    @override
    def roll_back(self) -> None:
        self.forms.update_average()
        if self._stress is not None:
            self._stress.roll_back()
