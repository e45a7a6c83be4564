# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Isotropic linear elasticity in the strain of either kinematics."""

from __future__ import annotations

from typing import ClassVar, Literal, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mpm_dolfinx._core import loops
from mpm_dolfinx.materials.base import (
    Field,
    Integration,
    Parameter,
    State,
    StrainMaterial,
    Update,
    check_parameter,
    per_row,
)
from mpm_dolfinx.materials.compiled import CompiledUpdate, update_hencky
from mpm_dolfinx.materials.mandel import deviator, deviatoric_projector, identity, trace

__all__ = ["Hencky", "IsotropicElastic", "LinearElastic"]


class IsotropicElastic(StrainMaterial):
    """Stress K tr(eps) I + 2 G dev(eps), the elastic part of the laws of this package.

    Attributes:
        compiled: Whether a compiled update is used where the law itself (not a law derived from
            it) has one and the package was built with it; its answer differs from
            :meth:`StrainMaterial.update` by round-off alone.
    """

    symmetric = True
    compiled: bool = True
    _compiled_update: ClassVar[CompiledUpdate]

    def __init__(self, young: ArrayLike | Field, poisson: ArrayLike | Field) -> None:
        """Set the elastic constants.

        Args:
            young: Young's modulus, in units of stress.
            poisson: Poisson's ratio.

        Raises:
            MPMError: Not ``young > 0`` or not ``-1 < poisson < 0.5``.
        """
        self.parameters = {
            "young": check_parameter("young", young, above=0.0),
            "poisson": check_parameter("poisson", poisson, above=-1.0, below=0.5),
        }

    def update(
        self, displacement_gradient: NDArray[np.float64], state: State, tangent: bool = True
    ) -> Update:
        """See :meth:`Material.update`."""
        rule = vars(type(self)).get("_compiled_update")
        if rule is None or loops is None or not self.compiled:
            return super().update(displacement_gradient, state, tangent)
        return cast(Update, rule(self, displacement_gradient, state, tangent))

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

    def elastic_tangent(self, n: int, m: int) -> NDArray[np.float64]:
        """Return the elastic stiffness of ``n`` points, shape ``(n, m, m)``, read-only."""
        bulk, shear = (np.reshape(p, (-1, 1, 1)) for p in (self.bulk, self.shear))
        one = identity(m)
        D = bulk * np.outer(one, one) + 2.0 * shear * deviatoric_projector(m)
        return np.broadcast_to(D, (n, m, m))

    def integrate(
        self, trial_strain: NDArray[np.float64], variables: State, tangent: bool
    ) -> Integration:
        """See :meth:`StrainMaterial.integrate`."""
        D = self.elastic_tangent(*trial_strain.shape) if tangent else None
        return Integration(self.elastic_stress(trial_strain), D, trial_strain, variables)


class LinearElastic(IsotropicElastic):
    """Linear elasticity of small strains."""

    kinematics: ClassVar[Literal["small", "logarithmic"]] = "small"


class Hencky(IsotropicElastic):
    """Hyperelasticity of Hencky: tau = K tr(eps) I + 2 G dev(eps), eps = 1/2 ln(F F^T).

    The Kirchhoff stress tau derives from the energy K/2 tr(eps)^2 + G dev(eps) : dev(eps) per
    unit of undeformed volume (Hencky 1928; Anand 1979).
    """

    kinematics: ClassVar[Literal["small", "logarithmic"]] = "logarithmic"
    _compiled_update = update_hencky
