# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Derivatives of materials in one step.

Those of compiled laws are exact; of others they are central differences, so that a law of a user's
in Python takes part as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..constitutive.governed import Governed
from ..constitutive.points import MaterialPoints
from ..materials.base import State
from ..materials.compiled import CompiledMaterial, Taken
from ..tolerances import DIFFERENCE
from .parameters import Parameter

__all__ = ["Laws"]

type Array = NDArray[np.float64]

#: Second difference from which values bend, relative to the first and to the largest of these; by
#: what differences are smaller then; what tangents may differ by from differences.
BENDS, NOTICED, FINER, TANGENT = 1e-3, 1e-6, 1e-3, 1e-6


class Laws:
    """Derivatives of the materials at the points of a body, in one step.

    Args:
        points: The points, after the update of the step.
    """

    def __init__(self, points: MaterialPoints) -> None:
        self._points = points
        self._gradient = points.trial.gradient.copy()
        self._states = points.last.states
        self._after = points.trial.states
        self._exact = _compiled_laws(points)
        self._strained = points.strain.gradient().copy()
        known = self._exact and points.averaging is None
        self._own = (points.first_piola.copy(), self._after) if known else self.answers()
        particles = points.strain.particles
        self._shape = (particles.num_local, particles.num_points)

    def by_gradient(self, weights: list[State]) -> tuple[Array, Array | None]:
        """Return ``H_F^T m`` at the points, shape ``(n nq, dim, dim)``, and ``P_F^T``.

        A point between two branches of a law has the slope of differences, as in a
        :class:`Sensitivity`, where the tangent that it tells is another one.

        Args:
            weights: m.

        Returns:
            The second is ``None`` where the law's own tangent is as good.
        """
        found = np.zeros(self._gradient.shape)
        weighs = any(np.any(values) for own in weights for values in own.values())
        if not weighs and not any(self.have_history()):
            return found, None
        if self._exact and weighs:
            found = self._together([own.gradient for own in self.pull(weights, found)])
        if self._exact and self._points.symmetric:
            return found, None
        tangent = self._points.laws.tangents(self._gradient, self._states)
        if self._exact:
            return found, np.ascontiguousarray(tangent.transpose(0, 3, 4, 1, 2))
        slopes = np.empty(tangent.shape)
        for i, J in np.ndindex(found.shape[1:]):
            way = np.zeros(found.shape[1:])
            way[i, J] = 1.0

            def at(amount: float, way: Array = way) -> Array:
                P, states = self._points.laws.answers(self._gradient + amount * way, self._states)
                kept = self._weighed(weights, states, self._own[1])
                return np.column_stack([kept, (P - self._own[0]).reshape(len(P), -1)])

            both = _slope_of(at, DIFFERENCE)
            found[:, i, J] = both[:, 0]
            slopes[..., i, J] = both[:, 1:].reshape(found.shape)
        axes = tuple(range(1, tangent.ndim))
        size = np.abs(tangent).max(axis=axes, initial=0.0)
        apart = np.abs(slopes - tangent).max(axis=axes, initial=0.0) > TANGENT * size
        comm = self._points.strain.particles.mesh.comm
        if self._points.symmetric and not comm.allreduce(bool(apart.any())):
            return found, None
        tangent[apart] = slopes[apart]
        return found, np.ascontiguousarray(tangent.transpose(0, 3, 4, 1, 2))

    def pull(self, weights: list[State], work: Array) -> list[Taken]:
        """Return the derivatives of ``m . H - P : W g q`` by all that compiled laws take.

        Args:
            weights: m.
            work: ``W g q``, shape ``(n nq, dim, dim)``.

        Returns:
            Of each material; none where one is not compiled.
        """
        return [
            law.pull(self._gradient[points], state, -work[points], own)
            for (law, points), state, own in zip(self._exact, self._states, weights, strict=False)
        ]

    def by_parameter(
        self, parameter: Parameter, weights: list[State], work: Array, pulled: list[Taken]
    ) -> Array:
        """Return the derivative of ``m . H - P : W g q`` by a parameter at all points (collective).

        Args:
            parameter: On which laws depend.
            weights: m.
            work: ``W g q``.
            pulled: Of these.
        """
        points = self._points
        try:
            if self._exact:
                sides = []
                for sign in (1.0, -1.0):
                    parameter.shift(sign * parameter.change)
                    parameter.govern(points, sign * parameter.change)
                    sides.append(list(points.laws.governed))
                rates = _number_rates(sides, self._states, parameter.change)
                pairs = zip(pulled, rates, strict=True)
                return self._together([(own.numbers * rate).sum(axis=1) for own, rate in pairs])

            def at(amount: float) -> Array:
                parameter.shift(amount)
                parameter.govern(points, amount)
                return self.change(weights, work, self.answers())

            return _slope_of(at, parameter.change)
        finally:
            parameter.shift(0.0)
            parameter.govern(points, 0.0)

    def _together(self, parts: list[Array]) -> Array:
        """Return values at the points of each law as values at all points."""
        found = np.zeros((len(self._gradient), *parts[0].shape[1:]))
        for part, values in zip(self._points.laws.governed, parts, strict=True):
            found[part.points] = values
        return found

    def have_history(self) -> list[bool]:
        """Return whether the answer of each material depends on what it keeps."""
        return [bool(memory) for memory in self._points.last.memories()]

    def by_states(self, weights: list[State], work: Array, pulled: list[Taken]) -> list[State]:
        """Return ``H_h^T m - P_h^T W g q``, as states are.

        Args:
            weights: m.
            work: ``W g q``, shape ``(n nq, dim, dim)``.
            pulled: Of these.
        """
        if pulled:
            return [own.state for own in pulled]
        found = [{name: np.zeros_like(values) for name, values in own.items()} for own in weights]
        for law, own in enumerate(found):
            for name, values in own.items():
                size = max(
                    float(np.abs(side[law][name]).max(initial=0.0))
                    for side in (self._states, self._after)
                )
                amount = DIFFERENCE * (size or 1.0)
                if not self._matters(law, name, amount):
                    continue
                for place in np.ndindex(values.shape[1:]):

                    def at(
                        change: float,
                        law: int = law,
                        name: str = name,
                        place: tuple[int, ...] = place,
                    ) -> Array:
                        states = self._with(law, name, place, change)
                        answer = self._points.laws.answers(self._gradient, states)
                        return self.change(weights, work, answer)

                    slope = _slope_of(at, amount)
                    values[:, *place] = slope[self._points.laws.governed[law].points]
        return found

    def _matters(self, law: int, name: str, amount: float) -> bool:
        """Return whether anything depends on a part of the state, on this rank."""
        whole = self._points.laws.answers(self._gradient, self._with(law, name, (), amount))
        own = self._own
        same = np.array_equal(whole[0], own[0])
        return not same or any(
            not np.array_equal(values, its[key])
            for one, its in zip(whole[1], own[1], strict=True)
            for key, values in one.items()
        )

    def _with(self, law: int, name: str, place: tuple[int, ...], amount: float) -> list[State]:
        """Return the states with one number of each point changed, or all of them."""
        states = list(self._states)
        values = states[law][name].copy()
        every: Any = (slice(None), *place)
        values[every] += amount
        states[law] = states[law] | {name: values}
        return states

    def change(self, weights: list[State], work: Array, answer: tuple[Array, list[State]]) -> Array:
        """Return the change of ``m . H - P : W g q`` to an answer beside the state."""
        found = self._weighed(weights, answer[1], self._own[1])
        return np.asarray(found - np.einsum("niJ,niJ->n", answer[0] - self._own[0], work))

    def answers(self) -> tuple[Array, list[State]]:
        """Return the answers of the laws, with the numbers that they have now."""
        return self._points.laws.answers(self._gradient, self._states)

    def _weighed(self, weights: list[State], after: list[State], before: list[State]) -> Array:
        """Return the products of weights and differences of states, at all points."""
        found = np.zeros(len(self._gradient))
        laws = self._points.laws.governed
        for part, own, one, other in zip(laws, weights, after, before, strict=True):
            points = part.points
            for name, values in own.items():
                product = (one[name] - other[name]) * values
                found[points] += product.reshape(len(points), -1).sum(axis=1)
        return found

    # -- F-bar -----------------------------------------------------------------------------

    def seen(self, motion: fem.Function) -> tuple[Array, Array]:
        """Return a motion as laws see it (collective).

        Args:
            motion: On W.

        Returns:
            ``g q`` at the points, and the derivative of the energy of deviations over its modulus,
            which is zero without F-bar.
        """
        points, d = self._points, self._points.strain.particles.displacement.x
        own, averaging = d.array.copy(), self._points.averaging
        d.array[:] = motion.x.array
        direction = points.strain.gradient().copy()
        d.array[:] = own
        shape = self._gradient.shape
        if averaging is None:
            return direction.reshape(shape), np.zeros(self._shape)
        gradient, sides, energies = self._strained, [], []
        amount = DIFFERENCE / max(float(np.abs(direction).max(initial=0.0)), 1e-300)
        comm = points.strain.particles.mesh.comm
        amount = min(comm.allgather(amount))
        modulus = averaging.modulus[:, None]
        for sign in (1.0, -1.0):
            sides.append(averaging.average(gradient + sign * amount * direction).copy())
            energies.append(averaging.energy() / modulus)
        averaging.average(gradient)
        rate = (sides[0] - sides[1]) / (2.0 * amount)
        return rate.reshape(shape), (energies[0] - energies[1]) / (2.0 * amount)

    def effective(self, stress: Array) -> Array:
        """Return ``g^T`` of a stress that works on what laws see (collective)."""
        averaging = self._points.averaging
        if averaging is None:
            return stress
        shape = (*self._shape, *stress.shape[1:])
        none = np.zeros((*shape, *stress.shape[1:]))
        whole = averaging.effective(stress.reshape(shape), none)[0]
        own = averaging.effective(np.zeros(shape), none)[0]
        return (whole - own).reshape(stress.shape)


def _compiled_laws(points: MaterialPoints) -> list[tuple[CompiledMaterial, NDArray[np.int64]]]:
    """Return the laws at points with their points, or none where one has no exact derivatives."""
    found = [
        (part.law, part.points)
        for part in points.laws.governed
        if isinstance(part.law, CompiledMaterial) and part.law.is_differentiable
    ]
    return found if len(found) == len(points.laws.governed) else []


def _number_rates(
    sides: Sequence[Sequence[Governed]], states: Sequence[State], change: float
) -> list[Array]:
    """Return the derivatives of the numbers of compiled laws by a parameter.

    Args:
        sides: The materials with the parameter at its change, and at minus that.
        states: What they go on from.
        change: The change.

    Returns:
        For each law, shape ``(n, k)`` or ``(1, k)``.
    """
    found = []
    for state, *pair in zip(states, *sides, strict=True):
        laws = [part.law for part in pair if isinstance(part.law, CompiledMaterial)]
        a, b = (law.numbers(state) for law in laws)
        gap = np.subtract(a, b, where=a != b, out=np.zeros_like(a))  # (some may be infinite)
        found.append((gap / (2.0 * change)).T)
    return found


def _slope_of(at: Callable[[float], Array], amount: float) -> Array:
    """Return the derivative of values at points, which may be near another branch of a law.

    Args:
        at: Returns the change of values by an amount, shape ``(n, ...)``, not collective.
        amount: For the difference; points that bend within it have a smaller one.
    """
    plus, minus = at(amount), at(-amount)
    slope = (plus - minus) / (2.0 * amount)
    first, second = np.abs(plus - minus), np.abs(plus + minus)
    bends = (second > BENDS * first) & (second > NOTICED * first.max(axis=0, initial=0.0))
    if bends.any():
        finer = FINER * amount
        fine = (at(finer) - at(-finer)) / (2.0 * finer)
        slope[bends] = fine[bends]
    return np.asarray(slope)
