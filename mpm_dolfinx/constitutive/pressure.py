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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..errors import MPMError
from ..materials.base import Material, StrainMaterial

__all__ = ["MeanStress", "require_split", "without_bulk"]


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
        pressure: A Function at the points.
        shape: Number of points, and the dimension of the deformation gradient.

    Attributes:
        volume: Elastic volumetric strain theta of the last update, shape ``(n,)``.
        slope: Its derivative by F, shape ``(n, dim, dim)``.
        compliance: 1/K, shape ``(n,)``.
    """

    def __init__(self, pressure: fem.Function, shape: tuple[int, int]) -> None:
        self._pressure = pressure
        count, dim = shape
        self.volume = np.zeros(count)
        self.slope: NDArray[np.float64] = np.zeros((count, dim, dim))
        self.compliance = np.zeros(count)
        self._soft = np.zeros(count)
        self._small = np.zeros(count, dtype=bool)

    def follow(self, points: NDArray[np.int64], material: Material, bulk: Any, soft: Any) -> None:
        """Take over a law's moduli at some points.

        Args:
            points: Their numbers.
            material: The law.
            bulk: Its bulk modulus, a number or ``(n,)``.
            soft: That of the law in use.
        """
        self.compliance[points], self._soft[points] = 1.0 / np.asarray(bulk), soft
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
        count = len(self.volume)
        mean = np.zeros(count)
        for points, stress in stresses:
            mean[points] = stress[:, :3].sum(axis=1) / 3.0
        change = self._pressure.x.array[:count] - mean
        self.volume = mean / self._soft
        eye = np.eye(gradient.shape[-1])
        slope = np.linalg.inv(gradient + eye).swapaxes(1, 2)
        slope[self._small] = eye
        self.slope = slope
        stress = first_piola + change[:, None, None] * slope
        turning = np.where(self._small, 0.0, change)
        whole = tangent - np.einsum("n,niL,nkJ->niJkL", turning, slope, slope, optimize=True)
        whole -= np.einsum("n,niJ,nkL->niJkL", self._soft, slope, slope, optimize=True)
        own = []
        for points, before in stresses:
            after = before.copy()
            after[:, :3] += change[points, None]
            own.append(after)
        return stress, np.ascontiguousarray(whole), own
