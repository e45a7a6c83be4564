# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Modified Cam clay at finite strain."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, Literal, override

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import MPMError
from .base import Field, Parameter, State, checked, exceeds, per_row
from .compiled import CompiledMaterial
from .mandel import deviator, norm, to_vector, trace

__all__ = ["ModifiedCamClay"]

Array = NDArray[np.float64]


class ModifiedCamClay(CompiledMaterial):
    """Modified Cam clay at finite strain, with a hyperelastic law and logarithmic hardening.

    With pressure p = -tr(tau)/3 and q = sqrt(3/2) |dev tau| of the Kirchhoff stress tau, and
    elastic logarithmic strains of volume eps_v (positive where it shrinks) and shape e,

    - p = p_r exp(eps_v/kappa) and dev tau = 2 G e, which derive from an energy (Houlsby 1985; Borja
      & Tamagnini 1998 with a constant shear modulus): the bulk modulus is p/kappa;
    - f = q^2/M^2 + p (p - p_c) <= 0, with associated flow (Roscoe & Burland 1968);
    - dp_c = p_c d eps_v^p/(lambda - kappa).

    A body that has not moved is under the reference pressure p_r, the same in all directions,
    unless its state is made from another stress (:meth:`stressed_state`). It cannot bear
    tension: p is positive however far it is stretched.

    Backward Euler is two equations, for eps_v and the multiplier. They are solved by Newton's
    method, and where that does not do by bisection: for a given multiplier eps_v is unique,
    between its trial value and that of the critical state, p = p_c/2.

    Ground that was under more is told by its overconsolidation, p_c over that of the ellipse on
    which its first stress lies, p + q^2/(M^2 p); p_c grows with depth as the stress does.

    The state holds p_c as ``"preconsolidation"`` and the accumulated plastic strain, the sum of
    sqrt(2/3) |d eps_p|, as ``"plastic_strain"``, both of shape ``(n,)``.

    Attributes:
        yield_tolerance: Value of f over p_c^2 that counts as round-off.
    """

    symmetric = False
    kinematics: ClassVar[Literal["small", "logarithmic"]] = "logarithmic"
    inelastic: ClassVar[bool] = True
    rises_with_volume: ClassVar[bool] = False
    internal_variables: ClassVar[Mapping[str, tuple[int, ...]]] = MappingProxyType(
        {"plastic_strain": (), "preconsolidation": ()}
    )
    limits: ClassVar[Mapping[str, Mapping[str, float]]] = MappingProxyType(
        {
            name: {"above": 0.0}
            for name in (
                "compression",
                "swelling",
                "critical_ratio",
                "shear_modulus",
                "preconsolidation",
                "reference_pressure",
            )
        }
        | {"overconsolidation": {"least": 1.0}}
    )
    yield_tolerance: ClassVar[float] = 1e-13
    _loop: ClassVar[str] = "cam_clay"

    def __init__(
        self,
        compression: ArrayLike | Field,
        swelling: ArrayLike | Field,
        critical_ratio: ArrayLike | Field,
        shear_modulus: ArrayLike | Field,
        preconsolidation: ArrayLike | Field | None = None,
        reference_pressure: ArrayLike | Field | None = None,
        overconsolidation: ArrayLike | Field | None = None,
    ) -> None:
        """Set the parameters.

        Args:
            compression: lambda, d eps_v/d ln p of normal compression, in logarithmic strain.
            swelling: kappa, the same of swelling and recompression; less than lambda.
            critical_ratio: M = q/p at the critical state.
            shear_modulus: G, in units of stress.
            preconsolidation: Initial p_c, in units of stress.
            reference_pressure: p_r, the pressure of the body that has not moved, at most p_c.
            overconsolidation: Instead of ``preconsolidation``, at least 1: initial p_c over that at
                which the stress would yield that a point begins with, ``initial_stress=`` or p_r.

        Raises:
            MPMError: A value is out of range, or other than one of ``preconsolidation`` and
                ``overconsolidation`` is given.
        """
        if reference_pressure is None or (preconsolidation is None) == (overconsolidation is None):
            raise MPMError(
                "ModifiedCamClay needs a reference_pressure, and either preconsolidation, the "
                "initial p_c, or overconsolidation, its ratio to what the first stress asks for."
            )
        self.parameters = checked(
            self.limits,
            compression=compression,
            swelling=swelling,
            critical_ratio=critical_ratio,
            shear_modulus=shear_modulus,
            reference_pressure=reference_pressure,
            preconsolidation=preconsolidation,
            overconsolidation=overconsolidation,
        )
        self._require_order()

    def _require_order(self) -> None:
        """Raise an error where values that are known are not in order."""
        own = self.parameters
        if exceeds(own, "swelling", "compression", np.greater_equal):
            raise MPMError("swelling must be less than compression, at each point.")
        if {"preconsolidation", "overconsolidation"} <= own.keys():
            raise MPMError("A ModifiedCamClay has preconsolidation or overconsolidation, not both.")
        if "preconsolidation" in own and exceeds(own, "reference_pressure", "preconsolidation"):
            raise MPMError("reference_pressure must be at most preconsolidation, at each point.")

    @override
    def initial_state(self, n: int, dim: int) -> State:
        """State of points under the reference pressure."""
        state = super().initial_state(n, dim)
        self._require_order()
        state["stress"][:, :3] = -per_row(self.parameters["reference_pressure"])
        own = self.parameters.get("preconsolidation")
        if own is None:
            own = self.parameters["overconsolidation"] * self.parameters["reference_pressure"]
        state["preconsolidation"] = np.array(np.broadcast_to(own, n), dtype=np.float64)
        return state

    @override
    def stressed_state(
        self,
        cauchy_stress: Array,
        displacement_gradient: Array,
        variables: Mapping[str, Array] = MappingProxyType({}),
    ) -> State:
        if "overconsolidation" in self.parameters and "preconsolidation" not in variables:
            ratio = self._kinematics.volume_ratio(displacement_gradient)[:, None, None]
            stress = to_vector(ratio * cauchy_stress, displacement_gradient.shape[-1])
            p = -trace(stress) / 3.0
            q = np.sqrt(1.5) * norm(deviator(stress)) / self.parameters["critical_ratio"]
            with np.errstate(invalid="ignore", divide="ignore"):
                p_c = self.parameters["overconsolidation"] * (p + q**2 / p)
            variables = {**variables, "preconsolidation": np.where(p > 0.0, p_c, 1.0)}
        return super().stressed_state(cauchy_stress, displacement_gradient, variables)

    def elastic_strain(self, stress: Array) -> Array:
        """Return the elastic strain, shape ``(n, m)``, of stresses ``(n, m)``.

        Not a number where the pressure is not positive.
        """
        with np.errstate(invalid="ignore", divide="ignore"):
            pressure = -trace(stress) / 3.0
            ratio = np.log(pressure / self.parameters["reference_pressure"])
        volume = self.parameters["swelling"] * ratio
        strain = deviator(stress) / per_row(2.0 * self.parameters["shear_modulus"])
        strain[:, :3] -= (volume / 3.0)[:, None]
        return np.asarray(strain)

    def strain_energy(self, state: State) -> Array:
        """Return the elastic energy per undeformed volume, from the reference pressure on.

        It is ``kappa (p - p_r) + s : s / 4 G``, with the deviator s, as the pressure p derives from
        ``kappa p_r exp(-tr eps / kappa)``.
        """
        pressure = -trace(state["stress"]) / 3.0
        volumetric = self.parameters["swelling"] * (
            pressure - self.parameters["reference_pressure"]
        )
        square = norm(deviator(state["stress"])) ** 2
        return np.asarray(volumetric + square / (4.0 * self.parameters["shear_modulus"]))

    def yield_function(
        self, stress: Array, plastic_strain: Array, preconsolidation: Array
    ) -> Array:
        """Return q^2/M^2 + p (p - p_c) over p_c^2, shape ``(n,)``, of stresses ``(n, m)``."""
        p, p_c = -trace(stress) / 3.0, preconsolidation
        q = np.sqrt(1.5) * norm(deviator(stress)) / self.parameters["critical_ratio"]
        return np.asarray((q / p_c) ** 2 + p / p_c * (p / p_c - 1.0))

    def _constants(self) -> tuple[Parameter, ...]:
        names = ("compression", "swelling", "critical_ratio", "shear_modulus", "reference_pressure")
        return tuple(self.parameters[name] for name in names)
