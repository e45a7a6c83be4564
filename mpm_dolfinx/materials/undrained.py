# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Saturated ground that is loaded faster than water leaves it: a law of effective stress."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, Self, override

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import MPMError
from .base import Field, Material, Parameter, State, Update, check_parameter
from .kinematics import require_valid
from .tensors import growth

__all__ = ["EXCESS", "Undrained"]

type Array = NDArray[np.float64]

#: The pore pressure beyond that before, and the volume strain that it goes on from.
EXCESS, VOLUME = "excess_pore_pressure", "volume_of_water"


class Undrained(Material):
    """Ground whose water cannot leave: a law of effective stress beside a stiff fluid.

    Total stress is that of the law less the pore pressure (Terzaghi 1943), and the pressure rises
    where the volume falls, ``dp = -bulk d ln J`` (Naylor 1974): analysis A, with strength by
    effective stress. A stage begins with it without an excess pressure, and
    keeps what there is as long as its material is an ``Undrained``; another law has drained it.

    ``stress`` of the particles is the effective stress; their fields have
    ``"excess_pore_pressure"``, ``"pore_pressure"`` (with that of ``pore_pressure=`` of the body),
    ``"total_stress"`` and ``"mean_effective_stress"``. The body hardly changes volume, so it needs
    ``f_bar="patch"`` or degree 2.

    Args:
        law: Law of the effective stress.
        water_bulk: Bulk modulus of water over the porosity; as any parameter. With ``nu_u`` = 0.495
            for Poisson's ratio of the whole it is ``2 G (1 + nu_u) / (3 (1 - 2 nu_u))``, 99.7 G,
            less the bulk modulus of the law.

    Raises:
        MPMError: Something else than a law, or a modulus that is not positive.
    """

    limits: ClassVar[Mapping[str, Mapping[str, float]]] = MappingProxyType(
        {"water_bulk": {"above": 0.0}}
    )
    reversible = (EXCESS, VOLUME)

    def __init__(self, law: Material, water_bulk: ArrayLike | Field) -> None:
        if not isinstance(law, Material) or isinstance(law, Undrained):
            raise MPMError(f"Undrained is of a law of effective stress, not of {law!r}.")
        own = check_parameter("water_bulk", water_bulk, **self.limits["water_bulk"])
        self.law = law
        self.symmetric = law.symmetric
        self.kinematics = law.kinematics  # type: ignore[misc]
        known = law.internal_variables
        own_variables = MappingProxyType({**known, EXCESS: (), VOLUME: ()})
        self.internal_variables = own_variables  # type: ignore[misc]
        self.parameters = {**law.parameters, "water_bulk": own}

    def _with(self, law: Material) -> Self:
        """Return the same of another law."""
        return type(self)(law, self.parameters["water_bulk"])

    @property
    def yield_function(self) -> Any:
        """That of the law, ``None`` where it has none."""
        return getattr(self.law, "yield_function", None)

    def __repr__(self) -> str:
        own = self.parameters["water_bulk"]
        told = f"{own:g}" if isinstance(own, float) else type(own).__name__
        return f"Undrained({self.law!r}, water_bulk={told})"

    @override
    def with_parameters(self, **parameters: Parameter) -> Self:
        own = parameters.pop("water_bulk", self.parameters["water_bulk"])
        law = self.law.with_parameters(**parameters) if parameters else self.law
        return type(self)(law, own)

    @override
    def weakened(self, factor: float) -> Self:
        return self._with(self.law.weakened(factor))

    @override
    def in_time(self, duration: float) -> Self:
        law = self.law.in_time(duration)
        return self if law is self.law else self._with(law)

    @property
    @override
    def needs_time(self) -> bool:
        return self.law.needs_time

    @property
    @override
    def softens(self) -> bool:
        return self.law.softens

    @override
    def softening_by(self, average: Array) -> Self:
        return self._with(self.law.softening_by(average))

    @override
    def initial_state(self, n: int, dim: int) -> State:
        return self.law.initial_state(n, dim) | {EXCESS: np.zeros(n), VOLUME: np.zeros(n)}

    @override
    def stressed_state(
        self,
        cauchy_stress: Array,
        displacement_gradient: Array,
        variables: Mapping[str, Array] = MappingProxyType({}),
    ) -> State:
        rest = {name: v for name, v in variables.items() if name not in (EXCESS, VOLUME)}
        state = self.law.stressed_state(cauchy_stress, displacement_gradient, rest)
        zero = np.zeros(len(cauchy_stress))
        volume, _, _ = self._volume(displacement_gradient)
        return state | {EXCESS: variables.get(EXCESS, zero), VOLUME: volume}

    @override
    def update(self, displacement_gradient: Array, state: State, tangent: bool = True) -> Update:
        P, A, new = self.law.update(displacement_gradient, self._own(state), tangent)
        volume, J, Z = self._volume(displacement_gradient)
        bulk = self.parameters["water_bulk"]
        p = state[EXCESS] - bulk * (volume - state[VOLUME])
        P = P - (p * J)[:, None, None] * Z
        if A is not None:
            ZZ = np.einsum("niJ,nkL->niJkL", Z, Z)
            stiff = (bulk * np.ones_like(p)) * J
            if self.kinematics != "small":
                stiff -= p * J
                A = A + (p * J)[:, None, None, None, None] * ZZ.transpose(0, 1, 4, 3, 2)
            A = A + stiff[:, None, None, None, None] * ZZ
        return Update(P, A, new | {EXCESS: p, VOLUME: volume})

    def _volume(self, gradient: Array) -> tuple[Array, Array, Array]:
        """Return ln J, J and the transpose of the inverse of F; tr H, 1 and the unit tensor."""
        n, dim, _ = gradient.shape
        if self.kinematics == "small":
            one = np.broadcast_to(np.eye(dim), gradient.shape)
            return np.trace(gradient, axis1=1, axis2=2), np.ones(n), one
        grown = growth(gradient)
        require_valid(grown > -1.0)
        Z = np.linalg.inv(np.eye(dim) + gradient).transpose(0, 2, 1)
        return np.log1p(grown), 1.0 + grown, Z

    def _own(self, state: State) -> State:
        """Return the state of the law."""
        return {name: v for name, v in state.items() if name not in (EXCESS, VOLUME)}

    @override
    def cauchy_stress(self, displacement_gradient: Array, state: State) -> Array:
        return self.law.cauchy_stress(displacement_gradient, self._own(state))

    @override
    def strain_energy(self, state: State) -> Array | None:
        energy = self.law.strain_energy(self._own(state))
        if energy is None:
            return None
        bulk: Any = self.parameters["water_bulk"]
        x = -state[EXCESS] / bulk
        if self.kinematics == "small":
            return np.asarray(energy + 0.5 * bulk * x**2)
        return np.asarray(energy + bulk * np.exp(state[VOLUME]) * (x + np.expm1(-x)))

    @override
    def plastic_work(self, state: State) -> Array | None:
        return self.law.plastic_work(self._own(state))
