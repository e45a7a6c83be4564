# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Plastic laws whose flow may take time."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, Self, override

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .base import Field, Parameter, State
from .elastic import IsotropicElastic

__all__ = ["PlasticMaterial"]

type Array = NDArray[np.float64]


class PlasticMaterial(IsotropicElastic):
    """Base of plastic laws: viscoplastic ones with :meth:`with_relaxation`.

    With the parameter ``"relaxation_time"`` T stress beyond yield falls back in time (Duvaut &
    Lions 1972; Simo & Hughes 1998, section 3.7)::

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

    def with_relaxation(self, time: ArrayLike | Field) -> Self:
        """Return this law as a viscoplastic one.

        Args:
            time: In which stress beyond yield falls by 1/e, the parameter ``"relaxation_time"``.

        Raises:
            MPMError: Not a positive time.
        """
        given: dict[str, Any] = {"relaxation_time": time}
        return self.with_parameters(**given)

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
