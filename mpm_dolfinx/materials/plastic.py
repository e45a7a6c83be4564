# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Plastic laws whose flow may take time."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar, Self, override

import numpy as np
from numpy.typing import NDArray

from .base import Integration, Parameter, State
from .elastic import IsotropicElastic

__all__ = ["PlasticMaterial"]

type Array = NDArray[np.float64]


class PlasticMaterial(IsotropicElastic):
    """Base of plastic laws: viscoplastic ones where the parameters have a ``relaxation_time`` T.

    Stress beyond yield falls back in time (Duvaut & Lions 1972; Simo & Hughes 1998, section 3.7)::

        d eps_p/dt = C^-1 (stress - stress_0)/T,    d kappa/dt = (kappa_0 - kappa)/T

    towards the stress and plastic strain to which the law without time returns. Backward Euler
    leaves stress, elastic strain, kappa and tangent between those of the trial state and of that
    return, by the share dt/(dt + T) of the way, whatever the law. For von Mises with hardening H it
    is the law of Perzyna (1966) with a linear overstress: d kappa/dt = sqrt(2/3) <f>/eta, where f
    is the excess of |dev tau| and ``eta = (2 G + 2/3 H) T``.

    Attributes:
        duration: Of a step; infinite where no time passes.
    """

    inelastic: ClassVar[bool] = True
    internal_variables: ClassVar[Mapping[str, tuple[int, ...]]] = MappingProxyType(
        {"plastic_strain": ()}
    )
    limits: ClassVar[Mapping[str, Mapping[str, float]]] = MappingProxyType(
        {**IsotropicElastic.limits, "relaxation_time": {"above": 0.0}}
    )
    duration = math.inf

    @property
    @override
    def needs_time(self) -> bool:
        return "relaxation_time" in self.parameters

    @override
    def in_time(self, duration: float) -> Self:
        if not self.needs_time or duration == self.duration:
            return self
        other = copy.copy(self)
        other.duration = duration
        return other

    @override
    def _share(self) -> Parameter:
        if not self.needs_time or math.isinf(self.duration):
            return 1.0
        return self.duration / (self.duration + self.parameters["relaxation_time"])

    def over_time(self, answer: Integration, trial_strain: Array, variables: State) -> Integration:
        """Return the answer of the law over a step from that without time.

        Args:
            answer: Of the law without time.
            trial_strain: As in :meth:`integrate`.
            variables: As there.
        """
        share = self._share()
        if isinstance(share, float) and share == 1.0:
            return answer

        def left(before: Array, after: Array) -> Array:
            part = np.reshape(share, (-1,) + (1,) * (after.ndim - 1))
            return np.asarray(before + part * (after - before))

        D = answer.tangent
        if D is not None:
            D = left(self.elastic_tangent(*trial_strain.shape), D)
        return Integration(
            left(self.elastic_stress(trial_strain), answer.stress),
            D,
            left(trial_strain, answer.elastic_strain),
            {name: left(variables[name], values) for name, values in answer.variables.items()},
        )

    @override
    def stressed_state(
        self,
        cauchy_stress: Array,
        displacement_gradient: Array,
        variables: Mapping[str, Array] = MappingProxyType({}),
    ) -> State:
        """Return the state with the elastic strain of a stress, beyond yield where that lasts."""
        law = self.in_time(0.0)
        return IsotropicElastic.stressed_state(law, cauchy_stress, displacement_gradient, variables)
