# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Laws whose mean stress is more than a modulus times the volume strain, at a given pressure.

The strain that such a law sees has the shape of the trial strain, and the volume theta' at which
its mean stress m answers the pressure p, the partial inverse of the law:

    m(e, theta') + alpha (theta' - theta) = p,

with the volume theta and the shape e of the trial strain. Where the law has an energy psi, this is
the stationary point over theta' of

    psi(e, theta') + p (theta - theta') + alpha/2 (theta' - theta)^2,

whose other derivatives are the law's own stress, and the constraint ``theta - theta' = 0`` that the
pressure enforces on average (the complementary form of Hellinger and Reissner for the volume alone,
Simo & Hughes 1998, section 1.7; alpha stabilises as in an augmented Lagrangian). Strength follows a
pressure that is a field, not what single points have of volume, so that plastic dilation is a
condition on average too. With alpha > 0 it has an answer at an apex and at a cut-off, beyond which
a law has no mean stress, and stresses are admissible always.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import ConvergenceError
from ..tolerances import HALF_DIGITS, LOCAL_ITERATIONS, ROUND_OFF, SMALL
from .kinematics import KINEMATICS
from .mandel import trace

__all__ = ["ALPHA", "AtPressure", "at_pressure"]

type Array = NDArray[np.float64]

#: Share of the shear modulus that alpha is: no more than lets a pressure beyond an apex have an
#: answer, as limit loads rise with it (by 3 % with 1e-2, where G is 4e5 times the cohesion).
ALPHA = SMALL
#: Largest compression in the first iteration, twice as much in each that follows: stiffness grows
#: under compression, so that Newton's method goes too far then.
STRIDE = 0.05


class AtPressure(NamedTuple):
    """Answer of a law at a given pressure.

    Attributes:
        first_piola: First Piola stress, shape ``(n, dim, dim)``.
        tangent: Its derivative by F at constant pressure, shape ``(n, dim, dim, dim, dim)``.
        by_pressure: Its derivative by the pressure, shape ``(n, dim, dim)``.
        gap: theta - theta', shape ``(n,)``.
        slope: Its derivative by F, shape ``(n, dim, dim)``.
        compliance: Less its derivative by the pressure, shape ``(n,)``.
        state: The new state.
    """

    first_piola: Array
    tangent: Array
    by_pressure: Array
    gap: Array
    slope: Array
    compliance: Array
    state: dict[str, Array]


class StrainLaw(Protocol):
    """Law in strain space, as far as a given pressure needs it."""

    @property
    def kinematics(self) -> str:
        """Its strain."""

    @property
    def internal_variables(self) -> Mapping[str, tuple[int, ...]]:
        """Shape per point of each of its internal variables."""

    def integrate(self, trial_strain: Array, variables: dict[str, Array], tangent: bool) -> Any:
        """Return an Integration."""

    def at(self, points: NDArray[np.integer[Any]]) -> StrainLaw:
        """Return the law restricted to points."""


def at_pressure(
    material: StrainLaw, gradient: Array, state: Mapping[str, Array], pressure: Array, shear: Array
) -> AtPressure:
    """Return the answer of a law at a given pressure.

    Args:
        material: The law.
        gradient: F - I, shape ``(n, dim, dim)``.
        state: State of the last converged step.
        pressure: Mean of the law's own stress, shape ``(n,)``.
        shear: Shear modulus of the unstrained points, shape ``(n,)``.

    Raises:
        MPMError: The law fails; ``particles`` are the numbers of the points.
    """
    remembers = "displacement_gradient" in state
    frame = KINEMATICS[material.kinematics](gradient, state if remembers else None)
    trial = frame.trial_strain
    theta = trace(trial)
    alpha = ALPHA * shear
    variables = {name: state[name] for name in material.internal_variables}
    volume, answer = _solve(material, trial, variables, pressure, alpha)
    stress, D, elastic, variables = answer
    column, row = D[:, :, :3].sum(axis=2) / 3.0, D[:, :3].sum(axis=1) / 3.0
    stiffness = row[:, :3].sum(axis=1) / 3.0 + alpha
    of_pressure, of_strain = column / stiffness[:, None], row / stiffness[:, None]
    new = {"stress": stress, **variables}
    if remembers:
        seen = trial.copy()
        seen[:, :3] += ((volume - theta) / 3.0)[:, None]
        back = elastic.copy()
        back[:, :3] -= ((volume - theta) / 3.0)[:, None]
        moved = (elastic != seen).any(axis=1)
        new |= frame.history(np.where(moved[:, None], back, trial))
    return AtPressure(
        frame.first_piola(stress),
        frame.tangent(stress, D - column[:, :, None] * of_strain[:, None, :]),
        frame.first_piola(of_pressure),
        theta - volume,
        frame.first_piola(of_strain),
        1.0 / stiffness,
        new,
    )


def _solve(
    material: StrainLaw, trial: Array, variables: dict[str, Array], pressure: Array, alpha: Array
) -> tuple[Array, tuple[Array, Array, Array, dict[str, Array]]]:
    """Return the volume strain at which a law answers a pressure, and its answer there.

    Newton's method from the trial strain, within bounds that it finds on its way: the mean stress
    rises with the volume.
    """
    n, m = trial.shape
    theta = trace(trial)
    volume = theta.copy()
    low, high = np.full(n, -np.inf), np.full(n, np.inf)
    stress, D = np.zeros((n, m)), np.zeros((n, m, m))
    elastic = np.zeros((n, m))
    after = {name: values.copy() for name, values in variables.items()}
    active, near = np.arange(n), np.zeros(n, dtype=bool)
    for iteration in range(LOCAL_ITERATIONS):
        law = material.at(active)
        strain = trial[active].copy()
        strain[:, :3] += ((volume - theta)[active] / 3.0)[:, None]
        answer = law.integrate(strain, {k: v[active] for k, v in variables.items()}, True)
        assert answer.tangent is not None
        stress[active], D[active] = answer.stress, answer.tangent
        elastic[active] = answer.elastic_strain
        for name, values in answer.variables.items():
            after[name][active] = values
        mean = trace(answer.stress) / 3.0
        a, p, x = alpha[active], pressure[active], volume[active]
        extra = a * (x - theta[active])
        over = mean + extra - p
        slope = answer.tangent[:, :3, :3].sum(axis=(1, 2)) / 9.0 + a
        size = np.abs(mean) + np.abs(extra) + np.abs(p) + np.abs(slope * x)
        open_ = (np.abs(over) > ROUND_OFF * size) & ~near[active]
        near[active] = np.abs(over) <= HALF_DIGITS * size  # then one step more
        low[active] = np.where(over < 0.0, np.maximum(low[active], x), low[active])
        high[active] = np.where(over > 0.0, np.minimum(high[active], x), high[active])
        stride = min(STRIDE * 2.0**iteration, 1e300)
        new = x - np.minimum(over / slope, stride)
        outside = ~((new > low[active]) & (new < high[active]))
        with np.errstate(invalid="ignore"):
            middle = 0.5 * (low[active] + high[active])
        new = np.where(outside & np.isfinite(middle), middle, new)
        open_ &= new != x
        volume[active] = np.where(open_, new, x)
        active = active[open_]
        if len(active) == 0:
            return volume, (stress, D, elastic, after)
    raise ConvergenceError(
        f"{type(material).__name__} found no volume strain for the pressure", active
    )
