# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Elastoplasticity from a yield function alone: implicit return mapping."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, NamedTuple, Self, override

import numpy as np
from numpy.typing import NDArray

from ..errors import ConvergenceError
from ..tolerances import LAST_PLACES, ROUND_OFF, SLIGHT, SOLVED
from .base import Integration, State
from .derivatives import difference_by_stress, slope_by_plastic_strain, slope_by_stress
from .mandel import norm
from .plastic import PlasticMaterial

__all__ = ["ReturnMapping"]


class ReturnMapping(PlasticMaterial):
    """Elastoplasticity by backward Euler for any yield function.

    Isotropic linear elasticity in the elastic strain eps, yield function f and plastic
    potential g of stress and accumulated plastic strain kappa. A step from the trial strain
    solves (Wang, Coombs, Augarde & Brown, eqs. 2-5; Simo & Hughes 1998, box 3.5)::

        eps - eps_trial + dgamma dg/dstress = 0
        kappa - kappa_n - sqrt(2/3) |dgamma dg/dstress| = 0
        f = 0

    by Newton's method with a line search in all plastic points at once; the tangent is the
    derivative of the solution. A subclass gives the yield function::

        class DruckerPrager(ReturnMapping):
            def __init__(self, young, poisson, slope, strength):
                super().__init__(young, poisson)
                own = {"slope": slope, "strength": strength}
                self.parameters = {**self.parameters, **own}

            def yield_function(self, stress, plastic_strain):
                pressure_part = self.parameters["slope"] * mandel.trace(stress)
                size = mandel.norm(mandel.deviator(stress))
                return size + pressure_part - self.parameters["strength"]

    and, if it likes, :meth:`plastic_potential` for flow that is not associated and any of the
    derivatives, which is faster. All of them get stress in Mandel vectors ``(n, m)`` and plastic
    strain ``(n,)``, of which one may be complex, and must be analytic in them: no ``abs``. The
    yield function may have any unit. The scheme needs a smooth surface: a trial stress whose
    return is the apex of a cone ends in an error, unless the cone is rounded off.

    Attributes:
        symmetric: False unless a subclass knows better: the tangent is symmetric for
            associated flow without hardening.
        max_iterations: Newton iterations per step.
    """

    symmetric = False
    max_iterations: int = 50

    @abstractmethod
    def yield_function(self, stress: NDArray[Any], plastic_strain: NDArray[Any]) -> NDArray[Any]:
        """Return f, shape ``(n,)``: negative where the stress is elastic."""

    def plastic_potential(self, stress: NDArray[Any], plastic_strain: NDArray[Any]) -> NDArray[Any]:
        """Return g, shape ``(n,)``; by default f."""
        return self.yield_function(stress, plastic_strain)

    def yield_gradient(self, stress: NDArray[Any], plastic_strain: NDArray[Any]) -> NDArray[Any]:
        """Return df/dstress, shape ``(n, m)``; by default through complex steps."""
        return slope_by_stress(self.yield_function, stress, plastic_strain)

    def potential_gradient(
        self, stress: NDArray[Any], plastic_strain: NDArray[Any]
    ) -> NDArray[Any]:
        """Return dg/dstress, shape ``(n, m)``; by default through complex steps."""
        if _is_associated(self):
            return self.yield_gradient(stress, plastic_strain)
        return slope_by_stress(self.plastic_potential, stress, plastic_strain)

    def potential_hessian(
        self, stress: NDArray[np.float64], plastic_strain: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return d2g/dstress2, shape ``(n, m, m)``.

        By default through complex steps of a subclass's gradient, or through differences.
        """
        slope = slope_by_stress if _has_analytic_gradient(self) else difference_by_stress
        return slope(self.potential_gradient, stress, plastic_strain)

    @override
    def integrate(
        self, trial_strain: NDArray[np.float64], variables: State, tangent: bool
    ) -> Integration:
        """Integrate by a return map.

        Raises:
            ConvergenceError: Newton's method fails; ``particles`` are the numbers of the points.
        """
        plastic_strain = variables["plastic_strain"]
        stress = self.elastic_stress(trial_strain)
        D = self.elastic_tangent(*trial_strain.shape) if tangent else None
        points = self._yielding(stress, plastic_strain)
        if len(points) == 0:
            return Integration(stress, D, trial_strain, variables)

        law = self.at(points)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            system = _System.of(law, trial_strain[points], plastic_strain[points])
            solution, failed = _solve(system, self.max_iterations)
        if len(failed):
            raise ConvergenceError(
                f"the return mapping of {type(self).__name__} failed at {len(failed)} of "
                f"{len(stress)} points: take smaller steps, or round off edges and apexes of the "
                "yield surface",
                particles=points[failed],
            )
        m = stress.shape[1]
        elastic_strain, plastic_strain = trial_strain.copy(), plastic_strain.copy()
        elastic_strain[points], plastic_strain[points] = solution[:, :m], solution[:, m]
        stress[points] = law.elastic_stress(elastic_strain[points])
        if D is not None:
            right = np.broadcast_to(np.eye(m + 2, m), (len(points), m + 2, m))
            moved = np.linalg.solve(system.jacobian(solution), right)[:, :m]
            D = D.copy()
            D[points] = law.elastic_tangent(len(points), m) @ moved
        answer = Integration(stress, D, elastic_strain, {"plastic_strain": plastic_strain})
        return self._over_time(answer, trial_strain, variables)

    def _over_time(
        self, answer: Integration, trial_strain: NDArray[np.float64], variables: State
    ) -> Integration:
        """Return the answer of the law over a step from that without time."""
        share = self._share()
        if isinstance(share, float) and share == 1.0:
            return answer

        def left(before: NDArray[np.float64], after: NDArray[np.float64]) -> NDArray[np.float64]:
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

    def _yielding(
        self, stress: NDArray[np.float64], plastic_strain: NDArray[np.float64]
    ) -> NDArray[np.intp]:
        """Return the numbers of the points whose trial stress is beyond yield."""
        f = self.yield_function(stress, plastic_strain)
        (points,) = np.nonzero(~(f <= 0.0))
        slope = norm(self.at(points).yield_gradient(stress[points], plastic_strain[points]))
        excess = f[points] > ROUND_OFF * slope * norm(stress[points])
        return np.asarray(points[excess | ~np.isfinite(slope)])


def _is_associated(law: ReturnMapping) -> bool:
    return type(law).plastic_potential is ReturnMapping.plastic_potential


def _has_analytic_gradient(law: ReturnMapping) -> bool:
    """Return whether a subclass has given dg/dstress."""
    kind = type(law)
    if kind.potential_gradient is not ReturnMapping.potential_gradient:
        return True
    return _is_associated(law) and kind.yield_gradient is not ReturnMapping.yield_gradient


def _potential_gradient_by_plastic_strain(
    law: ReturnMapping, stress: NDArray[np.float64], plastic_strain: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return d2g/dstress dkappa, shape ``(n, m)``."""
    if _has_analytic_gradient(law):
        return slope_by_plastic_strain(law.potential_gradient, stress, plastic_strain)
    return difference_by_stress(
        lambda s, k: slope_by_plastic_strain(law.plastic_potential, s, k),
        stress,
        plastic_strain,
    )


class _System(NamedTuple):
    """Equations of plastic points, with all unknowns and residuals in units of strain.

    The unknowns, shape ``(n, m + 2)``, are elastic strain, plastic strain, and the multiplier
    times the norm of dg/dstress at the trial stress.
    """

    law: ReturnMapping
    trial_strain: NDArray[np.float64]
    plastic_strain: NDArray[np.float64]
    yield_scale: NDArray[np.float64]
    flow_scale: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        law: ReturnMapping,
        trial_strain: NDArray[np.float64],
        plastic_strain: NDArray[np.float64],
    ) -> Self:
        """Return the equations of a step."""
        stress = law.elastic_stress(trial_strain)
        slope = norm(law.yield_gradient(stress, plastic_strain))
        flow = norm(law.potential_gradient(stress, plastic_strain))
        return cls(law, trial_strain, plastic_strain, 0.5 / (law.shear * slope), 1.0 / flow)

    def at(self, points: NDArray[np.intp]) -> Self:
        """Return the equations of some of the points."""
        return type(self)(self.law.at(points), *(array[points] for array in self[1:]))

    def start(self) -> NDArray[np.float64]:
        """Return the unknowns of the elastic trial state."""
        zero = np.zeros((len(self.trial_strain), 1))
        return np.hstack((self.trial_strain, self.plastic_strain[:, None], zero))

    def residual(self, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the residuals, shape ``(n, m + 2)``."""
        strain, kappa, multiplier = self._split(unknowns)
        stress = self.law.elastic_stress(strain)
        flow = multiplier[:, None] * self.law.potential_gradient(stress, kappa)
        f = self.law.yield_function(stress, kappa) * self.yield_scale
        hardening = kappa - self.plastic_strain - np.sqrt(2.0 / 3.0) * norm(flow)
        return np.hstack((strain - self.trial_strain + flow, hardening[:, None], f[:, None]))

    def jacobian(self, unknowns: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivatives of the residuals, shape ``(n, m + 2, m + 2)``."""
        law = self.law
        strain, kappa, multiplier = self._split(unknowns)
        n, m = strain.shape
        stress, D = law.elastic_stress(strain), law.elastic_tangent(n, m)
        g = law.potential_gradient(stress, kappa)
        direction = g / norm(g)[:, None]
        by_strain = multiplier[:, None, None] * (law.potential_hessian(stress, kappa) @ D)
        by_kappa = multiplier[:, None] * _potential_gradient_by_plastic_strain(law, stress, kappa)
        f_slope = law.yield_gradient(stress, kappa)

        J = np.empty((n, m + 2, m + 2))
        J[:, :m, :m] = np.eye(m) + by_strain
        J[:, :m, m] = by_kappa
        J[:, :m, m + 1] = g * self.flow_scale[:, None]
        J[:, m] = -np.sqrt(2.0 / 3.0) * np.einsum("ni,nij->nj", direction, J[:, :m])
        J[:, m, :m] += np.sqrt(2.0 / 3.0) * direction
        J[:, m, m] += 1.0
        J[:, m + 1, :m] = np.einsum("ni,nij->nj", f_slope, D) * self.yield_scale[:, None]
        J[:, m + 1, m] = (
            slope_by_plastic_strain(law.yield_function, stress, kappa) * self.yield_scale
        )
        J[:, m + 1, m + 1] = 0.0
        return J

    def _split(
        self, unknowns: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return elastic strain, plastic strain and multiplier."""
        return unknowns[:, :-2], unknowns[:, -2], unknowns[:, -1] * self.flow_scale


def _newton_step(
    system: _System, unknowns: NDArray[np.float64], residual: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the Newton steps; not a number where the Jacobian is singular."""
    J = system.jacobian(unknowns)
    J[~np.isfinite(np.linalg.slogdet(J).logabsdet)] = np.nan
    return np.asarray(np.linalg.solve(J, -residual[:, :, None])[:, :, 0])


def _solve(system: _System, max_iterations: int) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Solve the equations of all points; points that converged or failed drop out.

    Returns:
        The unknowns, and the numbers of the points that failed.
    """
    unknowns = system.start()
    goal = norm(system.trial_strain)
    residual = system.residual(unknowns)
    converged = np.zeros(len(unknowns), dtype=bool)
    active = np.arange(len(unknowns))
    for _ in range(max_iterations):
        now = system.at(active)
        old, old_size = unknowns[active], norm(residual[active]) / goal[active]
        step = _newton_step(now, old, residual[active])
        new = old + step
        new_residual = now.residual(new)
        new_size = norm(new_residual) / goal[active]
        at_floor = old_size <= SOLVED  # round-off may be what stops the decrease
        share = 1.0
        while share > SLIGHT:  # (less creeps where nothing is found)
            (rising,) = np.nonzero(~(new_size < old_size) & ~at_floor)
            if len(rising) == 0:
                break
            share, step[rising] = 0.5 * share, 0.5 * step[rising]
            new[rising] = old[rising] + step[rising]
            new_residual[rising] = now.at(rising).residual(new[rising])
            new_size[rising] = norm(new_residual[rising]) / goal[active[rising]]
        falls = new_size < old_size
        unknowns[active[falls]], residual[active[falls]] = new[falls], new_residual[falls]
        done = (new_size <= LAST_PLACES) | (at_floor & ~(new_size < 0.5 * old_size))
        converged[active[done]] = True
        active = active[falls & ~done]
        if len(active) == 0:
            break
    # A negative multiplier solves the equations on the wrong side of the surface.
    return unknowns, np.flatnonzero(~(converged & (unknowns[:, -1] >= 0.0)))
