# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Plasticity that softens with its plastic strain, at a point or by an average over a length."""

from __future__ import annotations

import copy
from abc import abstractmethod
from typing import Self, override

import numpy as np
from numpy.typing import NDArray

from ..tolerances import DIFFERENCE
from .base import Integration, Parameter, State, Update
from .compiled import CompiledMaterial, Taken
from .given_pressure import AtPressure
from .plastic import PlasticMaterial

__all__ = ["SofteningMaterial"]

type Array = NDArray[np.float64]

#: Part of the average in the strain that softens; above one, so that bands are as wide on any mesh.
MIXTURE = 2.0


class SofteningMaterial(PlasticMaterial):
    """Base of laws whose strength may fall with the accumulated plastic strain kappa.

    With ``decay`` among the parameters strength falls from that at first to a residual one as
    exp(-decay kappa). A step has the strength of its beginning, so that returns stay closed forms.

    In a body with a length, 2 k - kappa stands for kappa, with the average k of kappa over that
    length (Vermeer & Brinkgreve 1994; Engelen, Geers & Baaijens 2003). A point by itself then
    hardens, and the strength is that of the step's end: the root of one equation for kappa, in
    which each law's own return stands. Below zero strength goes on growing as
    2 - exp(decay (2 k - kappa)), up to twice what it falls by.
    """

    @property
    @override
    def softens(self) -> bool:
        return "decay" in self.parameters

    @override
    def softening_by(self, average: Array) -> Self:
        if not self.softens:
            return self
        other = copy.copy(self)
        other.parameters = {**self.parameters, "average": average}
        return other

    @abstractmethod
    def with_share(self, left: Array) -> Self:
        """Return the law with a share ``(n,)`` left of what its strength falls by, for good."""

    def softened(self, plastic_strain: Array) -> Self:
        """Return the law with the strength after accumulated plastic strains, shape ``(n,)``.

        It does not soften any more; a law that does not soften is returned as it is.
        """
        if not self.softens:
            return self
        decay = self.parameters["decay"]
        if "average" not in self.parameters:
            return self.with_share(np.exp(-decay * plastic_strain))
        driving = decay * (MIXTURE * self.parameters["average"] - (MIXTURE - 1.0) * plastic_strain)
        falls = np.exp(-np.maximum(driving, 0.0))
        return self.with_share(np.where(driving > 0.0, falls, 2.0 - np.exp(np.minimum(driving, 0))))

    def _softens_at_once(self) -> bool:
        """Whether the strength of a step is that of its beginning."""
        return self.softens and "average" not in self.parameters

    @override
    def _return(self) -> str:
        return f"{self._loop}_averaged" if "average" in self.parameters else self._loop

    def _driven(self) -> tuple[Parameter, ...]:
        """Return the last parameters of a compiled law that softens by an average."""
        return self.parameters["decay"], MIXTURE * self.parameters["average"], MIXTURE - 1.0

    @override
    def numbers(self, state: State) -> Array:
        if self._softens_at_once():
            return self.softened(state["plastic_strain"]).numbers(state)
        return super().numbers(state)

    @override
    def pull(
        self, displacement_gradient: Array, state: State, first_piola: Array, weights: State
    ) -> Taken:
        if not self._softens_at_once():
            return super().pull(displacement_gradient, state, first_piola, weights)
        strain = state["plastic_strain"]
        law = self.softened(strain)
        found = law.pull(displacement_gradient, state, first_piola, weights)
        amount = DIFFERENCE / self.parameters["decay"]
        sides = (self.softened(strain + change).numbers(state) for change in (amount, -amount))
        after, before = sides
        gap = np.subtract(after, before, where=after != before, out=np.zeros_like(after))
        found.state["plastic_strain"] += (found.numbers * (gap / (2.0 * amount)).T).sum(axis=1)
        return found

    @override
    def update(self, displacement_gradient: Array, state: State, tangent: bool = True) -> Update:
        if self._softens_at_once():
            law = self.softened(state["plastic_strain"])
            return law.update(displacement_gradient, state, tangent)
        return super().update(displacement_gradient, state, tangent)

    @override
    def at_pressure(
        self, displacement_gradient: Array, state: State, pressure: Array, shear: Array
    ) -> AtPressure:
        if self._softens_at_once():
            law = self.softened(state["plastic_strain"])
            return law.at_pressure(displacement_gradient, state, pressure, shear)
        return super().at_pressure(displacement_gradient, state, pressure, shear)

    @override
    def integrate(self, trial_strain: Array, variables: State, tangent: bool) -> Integration:
        if self._softens_at_once():
            law = self.softened(variables["plastic_strain"])
            return law.integrate(trial_strain, variables, tangent)
        return CompiledMaterial.integrate(self, trial_strain, variables, tangent)
