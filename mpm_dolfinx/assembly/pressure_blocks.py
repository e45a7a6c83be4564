# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The blocks of a pressure at a body's points, reduced domain by domain."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from .._core import loops
from ..constitutive.pressure import VolumeStrain
from ..constitutive.strain import Strain
from ..particles.field import CarriedField
from ..particles.particles import Particles
from .blocks import CoupledBlocks
from .body_forms import no_values

__all__ = ["PressureBlocks", "PressurePoints"]


class PressurePoints(Protocol):
    """A material whose mean stress is a pressure of its own."""

    @property
    def strain(self) -> Strain:
        """Strain of the points."""

    @property
    def volume_strain(self) -> VolumeStrain:
        """Volume strain, its derivative and the compliance, as they were seen last."""

    @property
    def by_pressure(self) -> NDArray[np.float64]:
        """Derivative of the acting first Piola stress by the pressure, ``(n nq, dim, dim)``."""

    @property
    def symmetric(self) -> bool:
        """Whether the tangents of all materials are symmetric."""


class PressureBlocks:
    """Blocks of the tangent that couple a pressure and the displacement of its body.

    Args:
        particles: The body.
        pressure: The pressure, at its points.
        material: The material at its points.
    """

    def __init__(
        self, particles: Particles, pressure: CarriedField, material: PressurePoints
    ) -> None:
        self._particles, self._pressure, self._material = particles, pressure, material
        self._change = fem.Function(particles.W)

    @property
    def places(self) -> tuple[Particles, CarriedField]:
        """The body and the pressure."""
        return self._particles, self._pressure

    @property
    def _domains(self) -> tuple[NDArray[np.int32], *tuple[NDArray[np.float64], ...]]:
        """Data of the domains for the compiled loops."""
        hoop = self._material.strain.hoop
        return (
            self._particles.domain_nodes,
            self._particles.undeformed.rule.gradients,
            self._material.strain.weights,
            no_values if hoop is None else hoop,
        )

    def add(self, blocks: CoupledBlocks) -> None:
        """Add the blocks (see :class:`~mpm_dolfinx.assembly.fused.Coupling`)."""
        found, places = self._material.volume_strain, (blocks.displacement, blocks.field)
        beside = None if not self._material.symmetric else blocks.of_displacement
        loops.assemble_slopes(*self._domains, found.slope, *places, blocks.of_field, beside)
        if not self._material.symmetric:
            slope = np.ascontiguousarray(self._material.by_pressure)
            loops.assemble_slopes(*self._domains, slope, *places, None, blocks.of_displacement)
        weights = self._material.strain.weights
        factors = -weights * found.compliance.reshape(weights.shape)
        loops.assemble_diagonal(factors, blocks.field, blocks.alone)

    def sizes(
        self, moved: NDArray[np.float64], pressed: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the sizes of changes of the constraint at each point (collective).

        Args:
            moved: Sizes of changes of displacement, on own dofs of W.
            pressed: Those of changes of the pressure at own points.

        Returns:
            Shape ``(n nq,)``.
        """
        found, weights = self._material.volume_strain, self._material.strain.weights
        values = self._change.x
        values.array[: len(moved)] = moved
        values.scatter_forward()
        result = np.empty(weights.size)
        loops.slope_sizes(*self._domains, found.slope, values.array, result)
        of_pressure = weights.ravel() * found.compliance * pressed[: weights.size]
        return np.asarray(result + np.abs(of_pressure))
