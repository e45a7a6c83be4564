# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Isotropic linear elasticity in the strain of either kinematics."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, Literal, override

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .base import (
    Field,
    Integration,
    Parameter,
    State,
    checked,
    per_row,
)
from .compiled import CompiledMaterial
from .mandel import deviator, deviatoric_projector, identity, trace

__all__ = ["Hencky", "IsotropicElastic", "LinearElastic"]


class IsotropicElastic(CompiledMaterial):
    """Stress K tr(eps) I + 2 G dev(eps), the elastic part of most laws of this package."""

    symmetric = True
    limits: ClassVar[Mapping[str, Mapping[str, float]]] = MappingProxyType(
        {"young": {"above": 0.0}, "poisson": {"above": -1.0, "below": 0.5}}
    )

    def __init__(self, young: ArrayLike | Field, poisson: ArrayLike | Field) -> None:
        """Set the elastic constants.

        Args:
            young: Young's modulus, in units of stress.
            poisson: Poisson's ratio.

        Raises:
            MPMError: Not ``young > 0`` or not ``-1 < poisson < 0.5``.
        """
        self.parameters = checked(self.limits, young=young, poisson=poisson)

    @property
    def bulk(self) -> Parameter:
        """Bulk modulus K."""
        return self.parameters["young"] / (3.0 * (1.0 - 2.0 * self.parameters["poisson"]))

    @property
    def shear(self) -> Parameter:
        """Shear modulus G."""
        return self.parameters["young"] / (2.0 * (1.0 + self.parameters["poisson"]))

    def elastic_stress(self, strain: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the stress, shape ``(n, m)``, of elastic strains ``(n, m)``."""
        stress = deviator(strain)
        stress *= per_row(2.0 * self.shear)
        stress[:, :3] += (self.bulk * trace(strain))[:, None]
        return stress

    def elastic_strain(self, stress: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the elastic strain, shape ``(n, m)``, of stresses ``(n, m)``."""
        strain = deviator(stress)
        strain /= per_row(2.0 * self.shear)
        strain[:, :3] += (trace(stress) / (9.0 * self.bulk))[:, None]
        return strain

    def strain_energy(self, state: State) -> NDArray[np.float64]:
        """Return the elastic energy per undeformed volume, ``1/2 stress : strain``."""
        return self.stored_energy(self.elastic_strain(state["stress"]))

    @override
    def stored_energy(self, elastic_strain: NDArray[np.float64]) -> NDArray[np.float64]:
        stress = self.elastic_stress(elastic_strain)
        return np.asarray(0.5 * np.einsum("nm,nm->n", stress, elastic_strain))

    def elastic_tangent(self, n: int, m: int) -> NDArray[np.float64]:
        """Return the elastic stiffness of ``n`` points, shape ``(n, m, m)``, read-only."""
        bulk, shear = (np.reshape(p, (-1, 1, 1)) for p in (self.bulk, self.shear))
        one = identity(m)
        D = bulk * np.outer(one, one) + 2.0 * shear * deviatoric_projector(m)
        return np.broadcast_to(D, (n, m, m))

    @override
    def integrate(
        self, trial_strain: NDArray[np.float64], variables: State, tangent: bool
    ) -> Integration:
        D = self.elastic_tangent(*trial_strain.shape) if tangent else None
        return Integration(self.elastic_stress(trial_strain), D, trial_strain, variables)


class LinearElastic(IsotropicElastic):
    """Linear elasticity of small strains."""

    linear_in_volume: ClassVar[bool] = True
    kinematics: ClassVar[Literal["small", "logarithmic"]] = "small"


class Hencky(IsotropicElastic):
    """Hyperelasticity of Hencky: tau = K tr(eps) I + 2 G dev(eps), eps = 1/2 ln(F F^T).

    The Kirchhoff stress tau derives from the energy K/2 tr(eps)^2 + G dev(eps) : dev(eps) per
    unit of undeformed volume (Hencky 1928; Anand 1979).
    """

    linear_in_volume: ClassVar[bool] = True
    kinematics: ClassVar[Literal["small", "logarithmic"]] = "logarithmic"
    _loop: ClassVar[str] = "hencky"

    def _constants(self) -> tuple[Parameter, ...]:
        return self.bulk, self.shear
