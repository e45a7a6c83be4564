# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Dense flow of grains: friction that rises with the rate of shear, returned in closed form."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, Literal, Self, override

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import MPMError
from .base import Field, Integration, Parameter, State, checked, exceeds
from .compiled import CompiledMaterial
from .elastic import IsotropicElastic
from .mandel import deviator, norm, trace

__all__ = ["MuIRheology"]

Array = NDArray[np.float64]


class MuIRheology(IsotropicElastic):
    """Elastoplasticity of dry grains in flow, with friction by the inertial number (mu(I)).

    Hencky elasticity at finite strain. The root of J2 of the Kirchhoff stress is at most mu(I) P, P
    the pressure, with (Jop, Forterre & Pouliquen 2006, Nature 441, eqs. 2 and 3)::

        mu(I) = mu_s + (mu_2 - mu_s) I / (I_0 + I),    I = d gamma_dot / sqrt(P / rho_s)

    d the diameter of the grains, rho_s their density and gamma_dot the rate of plastic shear,
    sqrt(2 D : D) in simple shear. Flow keeps the volume. Grains that are pulled apart carry no
    stress; what has opened closes again without resistance, and bears pressure then as before.

    Backward Euler in closed form: P does not change in a return without dilation, so that the
    plastic shear of a step solves a quadratic equation (Dunatunga & Kamrin 2015, J. Fluid Mech.
    779, section 3). The work of a return is mu(I) P times that shear and never negative. Where no
    time passes, as in a :class:`~mpm_dolfinx.QuasiStaticProblem`, friction is mu_s: the law is then
    :class:`DruckerPrager` with ``match="plane_strain"``, the angle arcsin(mu_s) and
    ``volume_correction=True``; in plane strain it flows under the stress of Mohr-Coulomb's.

    Attributes:
        duration: Of a step, from which strains make rates; infinite where no time passes.
        yield_tolerance: Excess of the yield function over the stress that counts as round-off.
    """

    symmetric = False
    kinematics: ClassVar[Literal["small", "logarithmic"]] = "logarithmic"
    inelastic: ClassVar[bool] = True
    internal_variables: ClassVar[Mapping[str, tuple[int, ...]]] = MappingProxyType(
        {"plastic_strain": ()}
    )
    limits: ClassVar[Mapping[str, Mapping[str, float]]] = MappingProxyType(
        {
            **IsotropicElastic.limits,
            "static_friction": {"above": 0.0},
            "limit_friction": {"above": 0.0},
            "grain_size": {"least": 0.0},
            "grain_density": {"above": 0.0},
            "inertial_number": {"above": 0.0},
        }
    )
    yield_tolerance: ClassVar[float] = 1e-13
    _loop: ClassVar[str] = "mu_i"

    def __init__(
        self,
        young: ArrayLike | Field,
        poisson: ArrayLike | Field,
        static_friction: ArrayLike | Field,
        limit_friction: ArrayLike | Field,
        grain_size: ArrayLike | Field,
        grain_density: ArrayLike | Field,
        inertial_number: ArrayLike | Field = 0.279,
    ) -> None:
        """Set the parameters.

        Args:
            young: Young's modulus, in units of stress.
            poisson: Poisson's ratio.
            static_friction: mu_s, the coefficient of friction of slow flow; the sine of an angle of
                Mohr-Coulomb's law.
            limit_friction: mu_2, that of flow without end in rate; at least ``static_friction``.
            grain_size: Diameter d of the grains, a length; 0: friction without rates.
            grain_density: Density rho_s of what the grains are made of, without their pores.
            inertial_number: I_0, at which friction is half way between the two; by default that
                of glass beads.

        Raises:
            MPMError: A value is out of range, or the friction at the limit is the smaller one.
        """
        super().__init__(young, poisson)
        own = checked(
            self.limits,
            static_friction=static_friction,
            limit_friction=limit_friction,
            grain_size=grain_size,
            grain_density=grain_density,
            inertial_number=inertial_number,
        )
        self.parameters = {**self.parameters, **own}
        self.duration = math.inf
        _require_rising(self.parameters)

    @override
    def in_time(self, duration: float) -> Self:
        if duration == self.duration:
            return self
        other = copy.copy(self)
        other.duration = duration
        return other

    @override
    def weakened(self, factor: float) -> Self:
        """Divide both coefficients."""
        values = {n: self.parameters[n] / factor for n in ("static_friction", "limit_friction")}
        known = {n: v if isinstance(v, np.ndarray) else float(v) for n, v in values.items()}
        return self.with_parameters(**known)

    @override
    def initial_state(self, n: int, dim: int) -> State:
        _require_rising(self.parameters)
        return super().initial_state(n, dim)

    def yield_function(self, stress: Array, plastic_strain: Array) -> Array:
        """Return the root of J2 less mu_s P, shape ``(n,)``; positive in flow that is fast."""
        root = np.sqrt(0.5) * norm(deviator(stress))
        return np.asarray(root + self.parameters["static_friction"] * trace(stress) / 3.0)

    def _constants(self) -> tuple[Parameter, ...]:
        """Return moduli, mu_s, mu_2 - mu_s, d sqrt(rho_s)/I_0 and the duration.

        Where there are no rates the last two are 0 and 1.
        """
        values = self.parameters
        friction = values["static_friction"]
        span = values["limit_friction"] - friction
        if math.isinf(self.duration):
            return self.bulk, self.shear, friction, span, 0.0, 1.0
        lag = values["grain_size"] * np.sqrt(values["grain_density"]) / values["inertial_number"]
        time = np.where(np.equal(lag, 0.0), 1.0, self.duration)
        return self.bulk, self.shear, friction, span, lag, time

    @override
    def integrate(self, trial_strain: Array, variables: State, tangent: bool) -> Integration:
        return CompiledMaterial.integrate(self, trial_strain, variables, tangent)


def _require_rising(parameters: Mapping[str, Any]) -> None:
    """Raise an error where values that are known have friction that falls with the rate."""
    if exceeds(parameters, "static_friction", "limit_friction"):
        raise MPMError("limit_friction is less than static_friction; give at least that.")
