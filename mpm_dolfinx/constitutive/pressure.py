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
from ..errors import MPMError
from ..materials.base import Material, StrainMaterial
from ..particles.field import ParticleField

__all__ = ["MeanStress", "VolumeStrain", "require_split", "with_pressure", "without_bulk"]


class VolumeStrain(NamedTuple):
    """What a pressure is the multiplier of: ``volume - compliance p = 0``.

    Attributes:
        volume: Elastic volumetric strain theta, shape ``(n,)``.
        slope: Its derivative by F, shape ``(n, dim, dim)``.
        compliance: 1/K, shape ``(n,)``.
    """

    volume: NDArray[np.float64]
    slope: NDArray[np.float64]
    compliance: NDArray[np.float64]


def require_split(material: Any) -> None:
    """Raise an error unless a law's mean stress can be replaced by a pressure.

    Raises:
        MPMError: Its mean stress does not depend on the volume alone, or it does not say so.
    """
    known = isinstance(material, StrainMaterial)
    if not known or not vars(type(material)).get("linear_in_volume", False):
        raise MPMError(
            f"mixed='pressure' needs a law whose mean stress is the bulk modulus times the volume "
            f"strain, such as Hencky or VonMises, not {type(material).__name__}; use f_bar='patch' "
            "for others."
        )


def without_bulk(material: Material) -> tuple[Material, Any, Any]:
    """Return a law with the same shear response and a bulk modulus of its size.

    Args:
        material: A law for which :func:`require_split` holds.

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
    """

    def __init__(self, pressure: ParticleField, shape: tuple[int, int]) -> None:
        self._pressure = pressure
        count, dim = shape
        self.strain = VolumeStrain(np.zeros(count), np.zeros((count, dim, dim)), np.zeros(count))
        self._soft = np.zeros(count)
        self._small = np.zeros(count, dtype=bool)

    @property
    def values(self) -> NDArray[np.float64]:
        """The pressure at the points, shape ``(n,)``."""
        return np.asarray(self._pressure.x.array[: len(self._soft)])

    def begin_with(self, values: NDArray[np.float64]) -> None:
        """Let a body that has not moved have a pressure, shape ``(n,)`` (collective)."""
        whole = np.zeros(len(self._pressure.x.array))
        whole[: len(values)] = values
        self._pressure.set(whole)

    def return_to(self, volume: NDArray[np.float64], gradient: NDArray[np.float64]) -> None:
        """Return to what was seen before.

        Args:
            volume: Volume strain, shape ``(n,)``.
            gradient: ``F - I``, shape ``(n, dim, dim)``.
        """
        self.strain = self.strain._replace(volume=volume, slope=_slope(gradient, self._small))

    def follow(self, points: NDArray[np.int64], material: Material, bulk: Any, soft: Any) -> None:
        """Take over a law's moduli at some points.

        Args:
            points: Their numbers.
            material: The law.
            bulk: Its bulk modulus, a number or ``(n,)``.
            soft: That of the law in use.
        """
        self.strain.compliance[points], self._soft[points] = 1.0 / np.asarray(bulk), soft
        self._small[points] = getattr(material, "kinematics", "") == "small"

    def replace(
        self,
        gradient: NDArray[np.float64],
        first_piola: NDArray[np.float64],
        tangent: NDArray[np.float64],
        stresses: Sequence[tuple[NDArray[np.int64], NDArray[np.float64]]],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], list[NDArray[np.float64]]]:
        """Return stress and tangent with the pressure in place of the mean stress.

        Args:
            gradient: ``F - I``, shape ``(n, dim, dim)``.
            first_piola: Of the laws in use.
            tangent: Its derivative.
            stresses: Their own stresses, Mandel vectors, with the points where they are.

        Returns:
            First Piola stress and derivative at constant pressure, and the laws' own stresses.
        """
        whole = stresses[0][1]
        if len(stresses) > 1:
            whole = np.empty((len(self._soft), whole.shape[1]))
            for points, stress in stresses:
                whole[points] = stress
        answer = (gradient, first_piola, tangent, whole)
        found = with_pressure(answer, self.values, self._soft, self._small)
        self.strain = self.strain._replace(volume=found.volume, slope=found.slope)
        own = [found.stress[points] for points, _ in stresses]
        return found.first_piola, found.tangent, own if len(own) > 1 else [found.stress]


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
    compiled: bool = True,
) -> Pressed:
    """Let a pressure take the place of the mean stress of a law that is linear in volume.

    Args:
        answer: ``F - I``, first Piola stress and tangent of the law, and its Mandel stress.
        pressure: Shape ``(n,)``.
        bulk: Bulk modulus of the law, shape ``(n,)``.
        small: Whether it is one of small strains, shape ``(n,)``.
        compiled: Whether to use the compiled loop, where it was built.
    """
    gradient, first_piola, tangent, stress = answer
    if compiled and loops is not None:
        shapes = (first_piola.shape, tangent.shape, stress.shape, pressure.shape, gradient.shape)
        found = Pressed(*(np.empty(shape) for shape in shapes))
        loops.replace_mean_stress(*answer, pressure, bulk, small.view(np.uint8), *found)
        return found
    mean = stress[:, :3].sum(axis=1) / 3.0
    change = pressure - mean
    slope = _slope(gradient, small)
    turning = np.where(small, 0.0, change)[:, None, None, None, None]
    product = slope[:, :, :, None, None] * slope[:, None, None, :, :]
    whole = tangent - bulk[:, None, None, None, None] * product
    whole -= turning * product.swapaxes(2, 4)
    own = stress.copy()
    own[:, :3] += change[:, None]
    return Pressed(first_piola + change[:, None, None] * slope, whole, own, mean / bulk, slope)


def _slope(gradient: NDArray[np.float64], small: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the derivative of the volume strain by F."""
    eye = np.eye(gradient.shape[-1])
    slope = np.linalg.inv(gradient + eye).swapaxes(1, 2)
    slope[small] = eye
    return np.asarray(slope)
