# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Plasticity that softens with its plastic strain, at a point or by an average over a length."""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, Self, override

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError
from ..tolerances import LAST_PLACES, LOCAL_ITERATIONS
from .base import Integration, Parameter, State, Update
from .given_pressure import AtPressure
from .plastic import PlasticMaterial

__all__ = ["SofteningMaterial"]

type Array = NDArray[np.float64]

#: Part of the average in the strain that softens; above one, so that bands are as wide on any mesh.
MIXTURE = 2.0
#: Step of the derivatives by the strain that softens, over that in which strength falls by 1/e.
STRIDE = 1e-5


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
    def _known_loop(self) -> str:
        loop = super()._known_loop()
        return f"{loop}_averaged" if loop and "average" in self.parameters else loop

    def _driven(self) -> tuple[Parameter, ...]:
        """Return the last parameters of a compiled law that softens by an average."""
        return self.parameters["decay"], MIXTURE * self.parameters["average"], MIXTURE - 1.0

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
        before = variables["plastic_strain"]
        if self._softens_at_once():
            return self.softened(before).integrate(trial_strain, variables, tangent)
        if self.softens:
            answer = _averaged(self, trial_strain, variables, tangent)
        else:
            answer = self.give_back(trial_strain, variables, tangent)
        return self.over_time(answer, trial_strain, variables)

    @abstractmethod
    def give_back(self, trial_strain: Array, variables: State, tangent: bool) -> Integration:
        """Return the stress of a law that does not soften, without time; see `integrate`."""


def require_softening(parameters: Mapping[str, Any], residuals: Mapping[str, str]) -> None:
    """Raise an error where what is said of softening is not whole.

    Args:
        parameters: Parameters of a law by name.
        residuals: Names of residual strengths by those of the strengths.

    Raises:
        MPMError: A residual strength without decay, or decay without one.
    """
    given = [name for name in residuals.values() if name in parameters]
    if ("decay" in parameters) != bool(given):
        raise MPMError(
            f"Softening needs decay and a residual strength, {' or '.join(residuals.values())}; "
            f"given: {', '.join(given) or 'decay'}."
        )


def _averaged(law: SofteningMaterial, trial: Array, variables: State, tangent: bool) -> Integration:
    """Return the stress of a law that softens by an average; see `SofteningMaterial`."""
    before = variables["plastic_strain"]

    def returned(rows: NDArray[np.int64], kappa: Array, tangent: bool = False) -> Integration:
        softer = law.at(rows).softened(kappa)
        return softer.give_back(trial[rows], {"plastic_strain": before[rows]}, tangent)

    every = np.arange(len(trial))
    answer = returned(every, before, tangent)
    points = np.flatnonzero(answer.variables["plastic_strain"] > before)
    if len(points) == 0:
        return answer

    def excess(rows: NDArray[np.int64], kappa: Array) -> Array:
        return returned(points[rows], kappa).variables["plastic_strain"] - kappa

    kappa = _root(excess, before[points], answer.variables["plastic_strain"][points])
    found = returned(points, kappa, tangent)
    stress, elastic = answer.stress.copy(), answer.elastic_strain.copy()
    plastic_strain, D = before.copy(), answer.tangent
    stress[points], elastic[points] = found.stress, found.elastic_strain
    plastic_strain[points] = found.variables["plastic_strain"]
    if D is not None:
        decay = np.broadcast_to(law.parameters["decay"], len(trial))[points]
        stride = STRIDE / np.maximum(decay, 1.0)
        sides = [returned(points, kappa - k * stride) for k in (1, 2)]
        by_kappa, growth = (
            (3.0 * a - 4.0 * b + c) / (2.0 * stride[:, None])
            for a, b, c in (
                [one.stress for one in (found, *sides)],
                [one.variables["plastic_strain"][:, None] for one in (found, *sides)],
            )
        )
        assert found.tangent is not None
        D = D.copy()
        flow = trial[points] - found.elastic_strain
        size = np.sqrt(np.einsum("ni,ni->n", flow, flow))
        direction = np.sqrt(2.0 / 3.0) * flow / size[:, None]
        rows = found.tangent.swapaxes(1, 2).reshape(-1, trial.shape[1])
        local = law.at(np.repeat(points, trial.shape[1])).elastic_strain(rows)
        compliant = local.reshape(len(points), trial.shape[1], -1).swapaxes(1, 2)
        slope = direction - np.einsum("ni,nij->nj", direction, compliant)
        D[points] = found.tangent + np.einsum("ni,nj->nij", by_kappa, slope / (1.0 - growth))
    return Integration(stress, D, elastic, {"plastic_strain": plastic_strain})


def _root(excess: Callable[[NDArray[np.int64], Array], Array], low: Array, high: Array) -> Array:
    """Return where functions vanish that are positive at first, by regula falsi with halvings.

    Args:
        excess: Returns the values of some of them, by their numbers.
        low: Where they are positive, shape ``(n,)``.
        high: By how much beyond that they are there, as they fall; looked further where not.
    """
    low, high = low.copy(), high.copy()
    size = LAST_PLACES * high
    rows = np.arange(len(low))
    f_low, f_high = high - low, excess(rows, high)
    for _ in range(LOCAL_ITERATIONS):
        far = np.flatnonzero(f_high > 0.0)
        if len(far) == 0:
            break
        low[far], f_low[far] = high[far], f_high[far]
        high[far] += 2.0 * f_high[far]
        f_high[far] = excess(far, high[far])
    best, least = high.copy(), np.abs(f_high)
    side = np.zeros(len(low), dtype=np.int64)
    for _ in range(LOCAL_ITERATIONS):
        rows = np.flatnonzero((least > size) & (high - low > size))
        if len(rows) == 0:
            break
        a, b, fa, fb = low[rows], high[rows], f_low[rows], f_high[rows]
        x = (a * fb - b * fa) / (fb - fa)
        f = excess(rows, x)
        closer = np.abs(f) < least[rows]
        best[rows[closer]], least[rows[closer]] = x[closer], np.abs(f[closer])
        up = f > 0.0
        low[rows], f_low[rows] = np.where(up, x, a), np.where(up, f, fa)
        high[rows], f_high[rows] = np.where(up, b, x), np.where(up, fb, f)
        f_high[rows[up & (side[rows] == 1)]] *= 0.5
        f_low[rows[~up & (side[rows] == -1)]] *= 0.5
        side[rows] = np.where(up, 1, -1)
    return best
