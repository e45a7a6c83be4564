# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Modified Cam clay at finite strain."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, Literal, NamedTuple, Self, override

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import MPMError
from ..tolerances import LOCAL_ITERATIONS, NEGLIGIBLE
from .base import (
    Field,
    Integration,
    Parameter,
    State,
    check_parameter,
    per_row,
)
from .compiled import CompiledMaterial
from .mandel import deviator, deviatoric_projector, identity, norm, trace

__all__ = ["ModifiedCamClay"]

Array = NDArray[np.float64]

#: Newton steps before the bounded search.
STEPS = 40


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
    )
    yield_tolerance: ClassVar[float] = 1e-13
    _loop: ClassVar[str] = "cam_clay"

    def __init__(
        self,
        compression: ArrayLike | Field,
        swelling: ArrayLike | Field,
        critical_ratio: ArrayLike | Field,
        shear_modulus: ArrayLike | Field,
        preconsolidation: ArrayLike | Field,
        reference_pressure: ArrayLike | Field,
    ) -> None:
        """Set the parameters.

        Args:
            compression: lambda, d eps_v/d ln p of normal compression, in logarithmic strain.
            swelling: kappa, the same of swelling and recompression; less than lambda.
            critical_ratio: M = q/p at the critical state.
            shear_modulus: G, in units of stress.
            preconsolidation: Initial p_c, in units of stress.
            reference_pressure: p_r, the pressure of the body that has not moved, at most p_c.

        Raises:
            MPMError: A value is out of range.
        """
        given: dict[str, Any] = {
            "compression": compression,
            "swelling": swelling,
            "critical_ratio": critical_ratio,
            "shear_modulus": shear_modulus,
            "preconsolidation": preconsolidation,
            "reference_pressure": reference_pressure,
        }
        self.parameters = {
            name: check_parameter(name, value, **self.limits[name]) for name, value in given.items()
        }
        self._require_order()

    def _require_order(self) -> None:
        """Raise an error where values that are known are not in order."""
        for less, more in (
            ("swelling", "compression"),
            ("reference_pressure", "preconsolidation"),
        ):
            small, large = self.parameters[less], self.parameters[more]
            if not all(isinstance(value, float | np.ndarray) for value in (small, large)):
                continue
            shapes = {np.shape(small), np.shape(large)} - {()}
            wrong = np.greater_equal if less == "swelling" else np.greater
            if len(shapes) < 2 and np.any(wrong(small, large)):
                order = "less than" if less == "swelling" else "at most"
                raise MPMError(f"{less} must be {order} {more}, at each point.")

    @override
    def initial_state(self, n: int, dim: int) -> State:
        """State of points under the reference pressure."""
        state = super().initial_state(n, dim)
        self._require_order()
        state["stress"][:, :3] = -per_row(self.parameters["reference_pressure"])
        state["preconsolidation"] = np.array(
            np.broadcast_to(self.parameters["preconsolidation"], n), dtype=np.float64
        )
        return state

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

    @override
    def integrate(self, trial_strain: Array, variables: State, tangent: bool) -> Integration:
        n, m = trial_strain.shape
        p_c = variables["preconsolidation"]
        law = _Law.of(self.parameters, p_c)
        dev = deviator(trial_strain)
        size = norm(dev)
        volume, shape = -trace(trial_strain), np.sqrt(2.0 / 3.0) * size
        x, y = volume.copy(), np.zeros(n)
        residual = law.residual(volume, shape, x, y)[1]
        points = np.flatnonzero(residual > self.yield_tolerance)
        if len(points):
            x[points], y[points] = law.at(points).solve(volume[points], shape[points])
        ratio = 1.0 / (1.0 + law.softness * y)
        pressure = law.pressure(x)
        stress = (2.0 * law.shear * p_c * ratio)[:, None] * dev
        stress[:, :3] -= (pressure * p_c)[:, None]
        elastic = trial_strain.copy()
        elastic[points] = ratio[points, None] * dev[points]
        elastic[points, :3] -= (x[points] / 3.0)[:, None]
        new = {name: values.copy() for name, values in variables.items()}
        new["plastic_strain"] += np.sqrt(2.0 / 3.0) * norm(trial_strain - elastic)
        new["preconsolidation"][points] *= law.at(points).growth(volume[points], x[points])
        if not tangent:
            return Integration(stress, None, elastic, new)

        plastic = np.zeros(n, dtype=bool)
        plastic[points] = True
        p_v, p_s, q_v, q_s = law.slopes(volume, shape, x, y, plastic) * p_c
        direction = np.divide(dev, size[:, None], out=np.zeros_like(dev), where=size[:, None] > 0.0)
        one, secant = identity(m), 2.0 * law.shear * p_c * ratio
        D = np.einsum("n,ij->nij", secant, deviatoric_projector(m))
        D += np.einsum("n,ni,nj->nij", 2.0 / 3.0 * q_s - secant, direction, direction)
        D += np.einsum("n,i,j->nij", p_v, one, one)
        D -= np.einsum("n,i,nj->nij", np.sqrt(2.0 / 3.0) * p_s, one, direction)
        D -= np.einsum("n,ni,j->nij", np.sqrt(2.0 / 3.0) * q_v, direction, one)
        return Integration(stress, D, elastic, new)

    def _constants(self) -> tuple[Parameter, ...]:
        names = ("compression", "swelling", "critical_ratio", "shear_modulus", "reference_pressure")
        return tuple(self.parameters[name] for name in names)


class _Law(NamedTuple):
    """Constants of a number of points, shape ``(n,)`` each; stresses over the old p_c.

    The unknowns are the elastic strain of volume x and the multiplier y (times the old p_c).
    """

    plastic: Array
    swelling: Array
    ratio: Array
    shear: Array
    reference: Array

    @classmethod
    def of(cls, parameters: Mapping[str, Parameter], p_c: Array) -> Self:
        """Return the constants of points with preconsolidation p_c."""
        plastic = parameters["compression"] - parameters["swelling"]
        names = ("swelling", "critical_ratio")
        values = (plastic, *(parameters[name] for name in names))
        stresses = (parameters["shear_modulus"] / p_c, parameters["reference_pressure"] / p_c)
        return cls(*(np.broadcast_to(value, len(p_c)) for value in (*values, *stresses)))

    def at(self, points: NDArray[np.integer[Any]]) -> Self:
        """Return the constants of some of the points."""
        return type(self)(*(value[points] for value in self))

    @property
    def softness(self) -> Array:
        """The strain of shape is 1/(1 + softness y) of its trial value."""
        return 6.0 * self.shear / self.ratio**2

    def pressure(self, x: Array) -> Array:
        """Return p."""
        return np.asarray(self.reference * np.exp(x / self.swelling))

    def growth(self, volume: Array, x: Array) -> Array:
        """Return p_c."""
        return np.asarray(np.exp((volume - x) / self.plastic))

    def residual(self, volume: Array, shape: Array, x: Array, y: Array) -> tuple[Array, Array]:
        """Return the residuals of the flow rule and of the yield function."""
        p, p_c = self.pressure(x), self.growth(volume, x)
        q = 3.0 * self.shear * shape / (1.0 + self.softness * y) / self.ratio
        return x - volume + y * (2.0 * p - p_c), q**2 + p * (p - p_c)

    def jacobian(self, volume: Array, shape: Array, x: Array, y: Array) -> tuple[Array, ...]:
        """Return the derivatives of the residuals: flow by x, by y, yield by x, by y."""
        p, p_c = self.pressure(x), self.growth(volume, x)
        q = 3.0 * self.shear * shape / (1.0 + self.softness * y) / self.ratio
        slope, hardening = p / self.swelling, p_c / self.plastic
        return (
            1.0 + y * (2.0 * slope + hardening),
            2.0 * p - p_c,
            (2.0 * p - p_c) * slope + p * hardening,
            -2.0 * q**2 * self.softness / (1.0 + self.softness * y),
        )

    def step(self, volume: Array, shape: Array, x: Array, y: Array) -> tuple[Array, Array]:
        """Return Newton's step."""
        flow, f = self.residual(volume, shape, x, y)
        a, b, c, d = self.jacobian(volume, shape, x, y)
        with np.errstate(divide="ignore", invalid="ignore"):
            det = a * d - b * c
            return -(d * flow - b * f) / det, -(a * f - c * flow) / det

    def range(self, volume: Array) -> tuple[Array, Array]:
        """Return the bounds of x: the trial value and that of the critical state."""
        rates = 1.0 / self.swelling + 1.0 / self.plastic
        critical = (volume / self.plastic - np.log(2.0 * self.reference)) / rates
        return np.minimum(volume, critical), np.maximum(volume, critical)

    def solve(self, volume: Array, shape: Array) -> tuple[Array, Array]:
        """Return the unknowns of points that yield."""
        low, high = self.range(volume)
        x, y = volume.copy(), np.zeros_like(volume)
        active = np.arange(len(x))
        for _ in range(STEPS):
            law, there = self.at(active), (volume[active], shape[active], x[active], y[active])
            dx, dy = law.step(*there)
            x[active] = np.clip(x[active] + dx, low[active], high[active])
            y[active] = np.maximum(y[active] + dy, 0.0)
            flow, f = law.residual(volume[active], shape[active], x[active], y[active])
            size = law.pressure(x[active]) + law.growth(volume[active], x[active])
            done = (np.abs(flow) <= NEGLIGIBLE * self.swelling[active]) & (
                np.abs(f) <= NEGLIGIBLE * size**2
            )
            active = active[~(done & (y[active] > 0.0))]
            if len(active) == 0:
                break
        if len(active):
            x[active], y[active] = self.at(active).search(volume[active], shape[active])
        dx, dy = self.step(volume, shape, x, y)
        finite = np.isfinite(dx) & np.isfinite(dy)
        return np.where(finite, x + dx, x), np.where(finite, y + dy, y)

    def search(self, volume: Array, shape: Array) -> tuple[Array, Array]:
        """Return the unknowns by bisection of y, with x by bisection for each."""
        largest = np.ones_like(volume)
        for _ in range(LOCAL_ITERATIONS):
            x = self.volume_at(volume, shape, largest)
            largest = np.where(
                self.residual(volume, shape, x, largest)[1] > 0.0, 4.0 * largest, largest
            )
        least = np.zeros_like(volume)
        for _ in range(LOCAL_ITERATIONS):
            middle = 0.5 * (least + largest)
            x = self.volume_at(volume, shape, middle)
            beyond = self.residual(volume, shape, x, middle)[1] > 0.0
            least, largest = np.where(beyond, middle, least), np.where(beyond, largest, middle)
        return self.volume_at(volume, shape, largest), largest

    def volume_at(self, volume: Array, shape: Array, y: Array) -> Array:
        """Return x for a given y."""
        low, high = self.range(volume)
        for _ in range(LOCAL_ITERATIONS):
            middle = 0.5 * (low + high)
            above = self.residual(volume, shape, middle, y)[0] > 0.0
            low, high = np.where(above, low, middle), np.where(above, middle, high)
        return 0.5 * (low + high)

    def slopes(
        self, volume: Array, shape: Array, x: Array, y: Array, plastic: NDArray[np.bool_]
    ) -> Array:
        """Return the derivatives of p and q by the trial strains of volume and shape, (4, n)."""
        p, p_c = self.pressure(x), self.growth(volume, x)
        left = 1.0 + self.softness * y
        q, hardening = 3.0 * self.shear * shape / left, p_c / self.plastic
        a, b, c, d = self.jacobian(volume, shape, x, y)
        det = np.where(plastic, a * d - b * c, 1.0)
        # What the residuals change by with the trial strains, with the sign turned.
        flow_v, f_v = 1.0 + y * hardening, p * hardening
        f_s = -2.0 * q / self.ratio**2 * 3.0 * self.shear / left
        x_v, y_v = (d * flow_v - b * f_v) / det, (a * f_v - c * flow_v) / det
        x_s, y_s = -b * f_s / det, a * f_s / det
        slope, fall = p / self.swelling, -q * self.softness / left
        result = np.stack(
            (slope * x_v, slope * x_s, fall * y_v, 3.0 * self.shear / left + fall * y_s)
        )
        zero = np.zeros_like(p)
        return np.where(plastic, result, np.stack((slope, zero, zero, 3.0 * self.shear)))
