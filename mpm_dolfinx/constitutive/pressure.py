# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A pressure of its own in place of the mean stress of laws, for bodies that hardly change volume.

With the energy ``psi(F) = psi_dev(F) + K theta^2 / 2`` of a law whose mean stress is K times the
elastic volumetric strain theta (``ln J`` of logarithmic kinematics, ``tr eps`` of small strain),
the functional

    int psi_dev(F) + p theta - p^2 / (2 K) dX

is stationary where ``p = K theta`` holds on average and p takes the place of the mean stress
(perturbed Lagrangian: Simo & Hughes 1998, section 7.4; Sussman & Bathe 1987). Nothing in it grows
with K, which may be as large as one likes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._core import loops
from ..errors import MPMError, not_with
from ..materials.base import Material, StrainMaterial, Update
from ..particles.field import ParticleField

__all__ = [
    "MeanStress",
    "VolumeStrain",
    "is_linear_in_volume",
    "is_split",
    "slope_of_volume",
    "with_pressure",
    "without_bulk",
]


class VolumeStrain(NamedTuple):
    """Constraint whose multiplier is a pressure: ``volume - compliance p = 0``.

    Attributes:
        volume: Elastic volumetric strain theta, shape ``(n,)``.
        slope: Its derivative by F, shape ``(n, dim, dim)``.
        compliance: 1/K, shape ``(n,)``.
        by_pressure: Derivative of the stress by the pressure, shape ``(n, dim, dim)``.
    """

    volume: NDArray[np.float64]
    slope: NDArray[np.float64]
    compliance: NDArray[np.float64]
    by_pressure: NDArray[np.float64]


def is_split(material: Material) -> bool:
    """Return whether a law's mean stress is a modulus times the volume strain, and nothing else.

    Raises:
        MPMError: The law is not written in strain space, so no pressure can stand in it.
    """
    if not isinstance(material, StrainMaterial):
        raise MPMError(
            f"mixed='pressure' needs a law in strain space (a StrainMaterial), not "
            f"{type(material).__name__}; use f_bar='patch' for others."
        )
    if not material.rises_with_volume:
        raise not_with(
            "mixed='pressure'",
            f"a {type(material).__name__}, which may soften under a given shape",
            "use f_bar='patch'",
        )
    return is_linear_in_volume(material)


def is_linear_in_volume(material: Material) -> bool:
    """Return whether a law's class says for itself that it is linear in volume."""
    return bool(vars(type(material)).get("linear_in_volume", False))


def without_bulk(material: Material) -> tuple[Material, Any, Any]:
    """Return a law with the same shear response and a bulk modulus of its size.

    Args:
        material: A law for which :func:`is_split` holds.

    Returns:
        The law, the bulk modulus of the given one, and that of the returned one.
    """
    shear: Any = getattr(material, "shear")
    bulk: Any = getattr(material, "bulk")
    other = material.with_parameters(young=2.0 * shear, poisson=0.0 * shear)
    return other, bulk, 2.0 / 3.0 * shear


class MeanStress:
    """The pressure at a body's points, which replaces the mean stress of its laws.

    Args:
        pressure: A field at the points.
        shape: Number of points, and the dimension of the deformation gradient.

    Attributes:
        strain: Volume strain of the last update, and the compliance.
        shear: Shear modulus of unstrained points whose law is evaluated at the pressure, ``(n,)``.
    """

    def __init__(self, pressure: ParticleField, shape: tuple[int, int]) -> None:
        self._pressure = pressure
        count, dim = shape
        zero = np.zeros((count, dim, dim))
        self.strain = VolumeStrain(np.zeros(count), zero, np.zeros(count), zero)
        self.shear = np.zeros(count)
        self._soft = np.zeros(count)
        self._small = np.zeros(count, dtype=bool)

    @property
    def values(self) -> NDArray[np.float64]:
        """The pressure at the points, shape ``(n,)``."""
        return np.asarray(self._pressure.x.array[: len(self._soft)])

    @property
    def gap(self) -> NDArray[np.float64]:
        """Volume strain less the one of the pressure, as seen last, shape ``(n,)``."""
        return np.asarray(self.strain.volume - self.strain.compliance * self.values)

    def begin_with(self, values: NDArray[np.float64]) -> None:
        """Let a body that has not moved have a pressure, shape ``(n,)`` (collective)."""
        whole = np.zeros(len(self._pressure.x.array))
        whole[: len(values)] = values
        self._pressure.set(whole)

    def return_to(
        self,
        volume: NDArray[np.float64],
        compliance: NDArray[np.float64],
        gradient: NDArray[np.float64],
    ) -> None:
        """Return to what was seen before.

        The slope is that of laws whose mean stress comes apart; others say theirs in an update.

        Args:
            volume: Volume strain, shape ``(n,)``.
            compliance: That of laws that are evaluated at the pressure, shape ``(n,)``; for others
                it is that of their moduli.
            gradient: ``F - I``, shape ``(n, dim, dim)``.
        """
        # by what updates it, so that a run goes on bit for bit
        n, dim, _ = gradient.shape
        none = np.zeros_like(gradient), np.zeros((n, *(dim,) * 4)), np.zeros((n, 3))
        answer = np.ascontiguousarray(gradient), *none
        slope = with_pressure(answer, np.zeros(n), np.ones(n), self._small).slope
        own = np.where(self.shear > 0.0, compliance, self.strain.compliance)
        self.strain = VolumeStrain(volume, slope, own, slope)

    def follow(self, points: NDArray[np.int64], material: Material, bulk: Any, soft: Any) -> None:
        """Take over a law's moduli at some points.

        Args:
            points: Their numbers.
            material: The law.
            bulk: Its bulk modulus, a number or ``(n,)``.
            soft: That of the law in use.
        """
        self.strain.compliance[points], self._soft[points] = 1.0 / np.asarray(bulk), soft
        self._small[points] = material.kinematics == "small"

    def replace(
        self,
        points: NDArray[np.int64],
        gradient: NDArray[np.float64],
        answer: Update,
    ) -> tuple[Update, VolumeStrain]:
        """Return the answer of a law with the pressure in place of its mean stress.

        Args:
            points: Where the law governs, ``n`` of them.
            gradient: ``F - I``, shape ``(n, dim, dim)``.
            answer: Of the law in use, with a tangent.

        Returns:
            The answer, whose tangent is that at constant pressure, and the volume strain.
        """
        assert answer.tangent is not None
        values = gradient, answer.first_piola, answer.tangent, answer.state["stress"]
        found = with_pressure(values, self.values[points], self._soft[points], self._small[points])
        compliance = self.strain.compliance[points]
        seen = VolumeStrain(found.volume, found.slope, compliance, found.slope)
        state = {**answer.state, "stress": found.stress}
        return Update(found.first_piola, found.tangent, state), seen

    def see(self, parts: Sequence[tuple[NDArray[np.int64], VolumeStrain]]) -> None:
        """Take the volume strains of the laws, each with its points, for those of the update."""
        if len(parts) == 1:
            self.strain = parts[0][1]
            return
        whole = VolumeStrain(*(np.empty_like(values) for values in self.strain))
        for points, part in parts:
            for values, its in zip(whole, part, strict=True):
                values[points] = its
        self.strain = whole


class Pressed(NamedTuple):
    """The answer of a law with a pressure in place of its mean stress.

    Attributes:
        first_piola: Shape ``(n, dim, dim)``.
        tangent: Its derivative at constant pressure.
        stress: Mandel vectors, shape ``(n, components)``.
        volume: Volume strain, shape ``(n,)``.
        slope: Its derivative by F, shape ``(n, dim, dim)``.
    """

    first_piola: NDArray[np.float64]
    tangent: NDArray[np.float64]
    stress: NDArray[np.float64]
    volume: NDArray[np.float64]
    slope: NDArray[np.float64]


def with_pressure(
    answer: tuple[NDArray[np.float64], ...],
    pressure: NDArray[np.float64],
    bulk: NDArray[np.float64],
    small: NDArray[np.bool_],
) -> Pressed:
    """Let a pressure take the place of the mean stress of a law that is linear in volume.

    Args:
        answer: ``F - I``, first Piola stress and tangent of the law, and its Mandel stress.
        pressure: Shape ``(n,)``.
        bulk: Bulk modulus of the law, shape ``(n,)``.
        small: Whether it is one of small strains, shape ``(n,)``.
    """
    gradient, first_piola, tangent, stress = answer
    shapes = (first_piola.shape, tangent.shape, stress.shape, pressure.shape, gradient.shape)
    found = Pressed(*(np.empty(shape) for shape in shapes))
    loops.replace_mean_stress(*answer, pressure, bulk, small.view(np.uint8), *found)
    return found


def slope_of_volume(gradient: NDArray[np.float64], small: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the derivative of the volume strain by F, shape ``(n, dim, dim)``.

    Args:
        gradient: ``F - I``, shape ``(n, dim, dim)``.
        small: Whether the strain is small, shape ``(n,)``.
    """
    eye = np.eye(gradient.shape[-1])
    slope = np.linalg.inv(gradient + eye).swapaxes(1, 2)
    slope[small] = eye
    return np.asarray(slope)
