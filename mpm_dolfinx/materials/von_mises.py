# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Plasticity of von Mises with linear isotropic hardening, returned in closed form."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, Literal, Self, override

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import MPMError
from .base import Field, Parameter, State, checked
from .mandel import deviator, norm
from .plastic import PlasticMaterial
from .softening import SofteningMaterial

__all__ = ["SmallStrainVonMises", "VonMises"]


class VonMises(SofteningMaterial):
    """Elastoplasticity of von Mises at finite strain (Wang, Coombs, Augarde & Brown, eq. 1).

    Hencky elasticity, yield function f = |dev tau| / rho(kappa) - 1 with the Kirchhoff stress
    tau, associated flow and rho(kappa) = rho_y + sqrt(2/3) hardening kappa; kappa is the sum of
    sqrt(2/3) |d eps_p|, the uniaxial plastic strain. It may soften:
    :meth:`with_softening`. Backward Euler is the radial return
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
    ) -> None:
        """Set the parameters.

        Args:
            young: Young's modulus, in units of stress.
            poisson: Poisson's ratio.
            rho_y: Norm of the stress deviator at first yield.
            yield_stress: Uniaxial stress at first yield, sqrt(3/2) rho_y.
            hardening: d(uniaxial stress)/d(plastic strain).

        Raises:
            MPMError: A value is out of range, or not exactly one of ``rho_y`` and
                ``yield_stress`` is given.
        """
        super().__init__(young, poisson)
        name, strength = ("rho_y", rho_y) if rho_y is not None else ("yield_stress", yield_stress)
        if strength is None or (rho_y is not None and yield_stress is not None):
            raise MPMError("give exactly one of rho_y and yield_stress, which is sqrt(3/2) rho_y")
        own = checked(self.limits, **{name: strength}, hardening=hardening)
        self.parameters = {**self.parameters, **own}

    def with_softening(self, decay: ArrayLike | Field, *, residual: ArrayLike | Field) -> Self:
        """Return this law with a stress at first yield that falls with the plastic strain.

        Args:
            decay: How fast: by 1/e in a plastic strain of 1/decay.
            residual: Share of it that is left after much plastic strain.

        Raises:
            MPMError: A value is out of range.
        """
        given: dict[str, Any] = {"decay": decay, "residual": residual}
        return self.with_parameters(**given)

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

    def _constants(self) -> tuple[Parameter, ...]:
        if "average" in self.parameters:
            own = self.bulk, self.shear, self.rho_y, self.parameters["hardening"]
            return *own, self.parameters["residual"], *self._driven()
        return self.bulk, self.shear, self.rho_y, self.parameters["hardening"]


class SmallStrainVonMises(VonMises):
    """:class:`VonMises` with infinitesimal strain and the Cauchy stress."""

    linear_in_volume: ClassVar[bool] = True
    kinematics: ClassVar[Literal["small", "logarithmic"]] = "small"
