# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Plasticity of von Mises with linear isotropic hardening, returned in closed form."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, Literal, Self, override

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import MPMError
from .base import Field, Integration, Parameter, State, check_parameter
from .mandel import deviator, deviatoric_projector, identity, norm, trace
from .plastic import PlasticMaterial
from .softening import SofteningMaterial, require_softening

__all__ = ["SmallStrainVonMises", "VonMises"]


class VonMises(SofteningMaterial):
    """Elastoplasticity of von Mises at finite strain (Wang, Coombs, Augarde & Brown, eq. 1).

    Hencky elasticity, yield function f = |dev tau| / rho(kappa) - 1 with the Kirchhoff stress
    tau, associated flow and rho(kappa) = rho_y + sqrt(2/3) hardening kappa; kappa is the sum of
    sqrt(2/3) |d eps_p|, the uniaxial plastic strain. With ``decay`` rho_y softens: see
    :class:`SofteningMaterial`. Backward Euler is the radial return
    (Wilkins 1964), with the consistent tangent of Simo & Taylor (1985, eq. 3.17).

    The state holds kappa as ``"plastic_strain"``, shape ``(n,)``.

    Attributes:
        yield_tolerance: Value of f that counts as round-off of a point on the yield surface.
    """

    kinematics: ClassVar[Literal["small", "logarithmic"]] = "logarithmic"
    linear_in_volume: ClassVar[bool] = True
    limits: ClassVar[Mapping[str, Mapping[str, float]]] = MappingProxyType(
        {
            **PlasticMaterial.limits,
            "rho_y": {"above": 0.0},
            "yield_stress": {"above": 0.0},
            "hardening": {"least": 0.0},
            "residual": {"least": 0.0, "below": 1.0},
            "decay": {"least": 0.0},
        }
    )
    yield_tolerance: ClassVar[float] = 1e-13
    _loop: ClassVar[str] = "von_mises"

    def __init__(
        self,
        young: ArrayLike | Field,
        poisson: ArrayLike | Field,
        rho_y: ArrayLike | Field | None = None,
        yield_stress: ArrayLike | Field | None = None,
        hardening: ArrayLike | Field = 0.0,
        *,
        residual: ArrayLike | Field | None = None,
        decay: ArrayLike | Field | None = None,
        relaxation_time: ArrayLike | Field | None = None,
    ) -> None:
        """Set the parameters.

        Args:
            young: Young's modulus, in units of stress.
            poisson: Poisson's ratio.
            rho_y: Norm of the stress deviator at first yield.
            yield_stress: Uniaxial stress at first yield, sqrt(3/2) rho_y.
            hardening: d(uniaxial stress)/d(plastic strain).
            residual: Share of the stress at first yield that is left after much plastic strain;
                ``None``: all of it.
            decay: How fast it falls: by 1/e in a plastic strain of 1/decay.
            relaxation_time: Time in which stress beyond yield falls by 1/e; ``None``: at once.

        Raises:
            MPMError: A value is out of range, or not exactly one of ``rho_y`` and
                ``yield_stress`` is given; ``residual`` without ``decay``, or the other way.
        """
        super().__init__(young, poisson)
        name, strength = ("rho_y", rho_y) if rho_y is not None else ("yield_stress", yield_stress)
        if strength is None or (rho_y is not None and yield_stress is not None):
            raise MPMError("give exactly one of rho_y and yield_stress, which is sqrt(3/2) rho_y")
        self.parameters = {
            **self.parameters,
            name: check_parameter(name, strength, **self.limits[name]),
            "hardening": check_parameter("hardening", hardening, **self.limits["hardening"]),
        }
        further = {"residual": residual, "decay": decay, "relaxation_time": relaxation_time}
        self.parameters = {**self.parameters} | {
            key: check_parameter(key, value, **self.limits[key])
            for key, value in further.items()
            if value is not None
        }
        require_softening(self.parameters, {"rho_y": "residual"})

    @override
    def weakened(self, factor: float) -> Self:
        names = [name for name in ("rho_y", "yield_stress", "hardening") if name in self.parameters]
        return self.with_parameters(**{name: self.parameters[name] / factor for name in names})

    @override
    def with_share(self, left: NDArray[np.float64]) -> Self:
        values = dict(self.parameters)
        for name in ("decay", "average"):
            values.pop(name, None)
        residual = values.pop("residual", 1.0)
        name = "rho_y" if "rho_y" in values else "yield_stress"
        values[name] = values[name] * (residual + (1.0 - residual) * left)
        other = copy.copy(self)
        other.parameters = values
        return other

    @property
    def rho_y(self) -> Parameter:
        """Norm of the stress deviator at first yield."""
        if "rho_y" in self.parameters:
            return self.parameters["rho_y"]
        return self.parameters["yield_stress"] * float(np.sqrt(2.0 / 3.0))

    def strength(self, plastic_strain: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return rho(kappa), shape ``(n,)``, at plastic strains ``(n,)``."""
        hardening = np.sqrt(2.0 / 3.0) * self.parameters["hardening"]
        return np.asarray(self.rho_y + hardening * plastic_strain)

    def yield_function(
        self, stress: NDArray[np.float64], plastic_strain: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return f, shape ``(n,)``, of a state's stress ``(n, m)`` and plastic strain ``(n,)``."""
        if self.softens:
            return self.softened(plastic_strain).yield_function(stress, plastic_strain)
        return np.asarray(norm(deviator(stress)) / self.strength(plastic_strain) - 1.0)

    @override
    def plastic_work(self, state: State) -> NDArray[np.float64] | None:
        """Work of the uniaxial stress along the plastic strain; not known with softening or lag."""
        if self.softens or self.needs_time:
            return None
        kappa = state["plastic_strain"]
        yields = np.sqrt(1.5) * self.rho_y + 0.5 * self.parameters["hardening"] * kappa
        return np.asarray(yields * kappa)

    @override
    def give_back(
        self, trial_strain: NDArray[np.float64], variables: State, tangent: bool
    ) -> Integration:
        n, m = trial_strain.shape
        stress = self.elastic_stress(trial_strain)
        f = self.yield_function(stress, variables["plastic_strain"])
        D = self.elastic_tangent(n, m) if tangent else None
        (points,) = np.nonzero(f > self.yield_tolerance)
        if len(points) == 0:
            return Integration(stress, D, trial_strain, variables)

        elastic_strain = trial_strain.copy(order="K")
        plastic_strain = variables["plastic_strain"].copy()
        stress.T[:, points], elastic_strain.T[:, points], plastic_strain[points], D_plastic = (
            _radial_return(
                self.at(points), trial_strain.T[:, points], plastic_strain[points], tangent
            )
        )
        if D is not None:
            everywhere = np.empty((m, m, n))
            everywhere[...] = np.moveaxis(D, 0, -1)
            everywhere[:, :, points] = D_plastic
            D = np.moveaxis(everywhere, -1, 0)
        return Integration(stress, D, elastic_strain, {"plastic_strain": plastic_strain})

    def _constants(self) -> tuple[Parameter, ...]:
        if "average" in self.parameters:
            own = self.bulk, self.shear, self.rho_y, self.parameters["hardening"]
            return *own, self.parameters["residual"], *self._driven()
        return self.bulk, self.shear, self.rho_y, self.parameters["hardening"]


class SmallStrainVonMises(VonMises):
    """:class:`VonMises` with infinitesimal strain and the Cauchy stress."""

    linear_in_volume: ClassVar[bool] = True
    kinematics: ClassVar[Literal["small", "logarithmic"]] = "small"


def _radial_return(
    law: VonMises,
    trial_strain: NDArray[np.float64],
    plastic_strain: NDArray[np.float64],
    tangent: bool,
) -> tuple[
    NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64] | None
]:
    """Return plastic points to the yield surface; arrays have their points last."""
    m = len(trial_strain)
    dev, size = deviator(trial_strain.T).T, norm(deviator(trial_strain.T))
    direction = dev / size
    hardening, shear = 2.0 / 3.0 * law.parameters["hardening"], 2.0 * law.shear
    rho = law.strength(plastic_strain)
    flow = (shear * size - rho) / (shear + hardening)
    rho = rho + hardening * flow
    # The deviator is scaled to rho, not reduced by the flow: f = 0 to round-off.
    stress = rho * direction
    stress[:3] += law.bulk * trace(trial_strain.T)
    D = None
    if tangent:
        # K I x I + rho/|e| (P - n x n) + 2 G h/(2 G + h) n x n, with the projector P
        one = identity(m)[:, None, None]
        secant = rho / size
        along = shear * hardening / (shear + hardening) - secant
        D = (along * direction)[:, None] * direction
        D += secant * deviatoric_projector(m)[:, :, None]
        D += law.bulk * (one * one.transpose(1, 0, 2))
    return (
        stress,
        trial_strain - flow * direction,
        plastic_strain + np.sqrt(2.0 / 3.0) * flow,
        D,
    )
