# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A neo-Hookean solid."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, override

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..tolerances import LOCAL_ITERATIONS
from .base import Field, Parameter, State, checked, per_row
from .compiled import CompiledMaterial
from .mandel import to_tensor, to_vector, trace

__all__ = ["NeoHooke"]

type Array = NDArray[np.float64]


class NeoHooke(CompiledMaterial):
    """Rubber and other soft solids: tau = G (b - I) + lambda ln J I, with b = F F^T.

    The stored energy is G/2 (tr b - 3) - G ln J + lambda/2 (ln J)^2 (Simo & Pister 1984), that of
    DOLFINx's own demo of hyperelasticity. With ``mixed="pressure"`` it goes to the incompressible
    limit.
    """

    symmetric = True
    limits: ClassVar[Mapping[str, Mapping[str, float]]] = MappingProxyType(
        {"young": {"above": 0.0}, "poisson": {"least": 0.0, "below": 0.5}}
    )
    _loop: ClassVar[str] = "neo_hooke"

    def __init__(self, young: ArrayLike | Field, poisson: ArrayLike | Field) -> None:
        """Set the elastic constants of small strains.

        Args:
            young: Young's modulus, in units of stress.
            poisson: Poisson's ratio. Below 0 the solid would soften without end as it is pressed.

        Raises:
            MPMError: Not ``young > 0`` or not ``0 <= poisson < 0.5``.
        """
        self.parameters = checked(self.limits, young=young, poisson=poisson)

    @property
    def shear(self) -> Parameter:
        """Shear modulus G."""
        return self.parameters["young"] / (2.0 * (1.0 + self.parameters["poisson"]))

    @property
    def lame(self) -> Parameter:
        """Lame's first constant lambda."""
        poisson = self.parameters["poisson"]
        return self.shear * 2.0 * poisson / (1.0 - 2.0 * poisson)

    @override
    def _constants(self) -> tuple[Parameter, ...]:
        return self.lame, self.shear

    @override
    def elastic_strain(self, stress: Array) -> Array:
        tau, axes = np.linalg.eigh(to_tensor(stress))
        shear, lame = per_row(self.shear), per_row(self.lame)
        with np.errstate(all="ignore"):
            strains = _strains(tau / shear, np.broadcast_to(lame / shear, (len(tau), 1)))
        return _spectral(strains, axes, stress.shape[1])

    def strain_energy(self, state: State) -> Array:
        """Stored energy per undeformed volume."""
        return self.stored_energy(self.elastic_strain(state["stress"]))

    @override
    def stored_energy(self, elastic_strain: Array) -> Array:
        volume = trace(elastic_strain)
        growth = np.expm1(2.0 * np.linalg.eigvalsh(to_tensor(elastic_strain))).sum(axis=1)
        return np.asarray(self.shear * (0.5 * growth - volume) + 0.5 * self.lame * volume**2)


def _strains(tau: Array, ratio: Array) -> Array:
    """Logarithmic strains of principal stresses.

    With x = ln J, ``b_a = 1 + tau_a - ratio x``, and x is the root of ``1/2 sum ln b_a = x``. The
    difference of both sides is concave, so that Newton's method comes down to the root from beyond
    it; a step out of the interval in which the root must be is halved.

    Args:
        tau: Stresses over the shear modulus, shape ``(n, 3)``.
        ratio: lambda/G, shape ``(n, 1)``.

    Returns:
        Shape ``(n, 3)``; not a number where no strain has this stress.
    """
    beyond = 0.5 * np.log1p(np.maximum(tau, 0.0)).sum(axis=1, keepdims=True)
    end = np.where(ratio > 0.0, (1.0 + tau.min(axis=1, keepdims=True)) / ratio, np.inf)
    low, high = np.full_like(end, -np.inf), end
    x = np.where(beyond < end, beyond, end - 0.5 * (1.0 + np.abs(end)))
    for _ in range(LOCAL_ITERATIONS):
        growth = tau - ratio * x
        wrong = 0.5 * np.log1p(growth).sum(axis=1, keepdims=True) - x
        low, high = np.where(wrong > 0.0, x, low), np.where(wrong < 0.0, x, high)
        after = x + wrong / (1.0 + 0.5 * (ratio / (1.0 + growth)).sum(axis=1, keepdims=True))
        before, x = x, np.where((after >= low) & (after <= high), after, 0.5 * (x + high))
        if np.array_equal(before, x, equal_nan=True):
            break
    return np.asarray(0.5 * np.log1p(tau - ratio * x))


def _spectral(values: Array, axes: Array, m: int) -> Array:
    """Mandel vectors, shape ``(n, m)``, of principal values ``(n, 3)`` and axes ``(n, 3, 3)``."""
    tensor = np.einsum("nia,na,nja->nij", axes, values, axes)
    return to_vector(tensor, 2 if m == 4 else 3)
