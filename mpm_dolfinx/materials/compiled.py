# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The compiled updates of the laws at finite strain."""

from __future__ import annotations

from typing import ClassVar, NamedTuple, override

import numpy as np
from numpy.typing import NDArray

from .._core import is_as_inherited, loops
from ..errors import ConvergenceError, MPMError
from .base import Integration, Parameter, State, StrainMaterial, Update
from .given_pressure import ALPHA, AtPressure
from .kinematics import require_valid
from .mandel import num_components

__all__ = ["CompiledMaterial", "Taken"]

type Array = NDArray[np.float64]


class Taken(NamedTuple):
    """Derivatives of something by what an update takes.

    Attributes:
        gradient: For the displacement gradient, shape ``(n, dim, dim)``.
        state: For the state at the beginning of the step.
        numbers: For :meth:`CompiledMaterial.numbers`, shape ``(n, k)``.
    """

    gradient: Array
    state: State
    numbers: Array


#: What a compiled return has of a law by heart.
BY_HEART = frozenset({"yield_function", "strength", "elastic_stress", "elastic_tangent"})


class CompiledMaterial(StrainMaterial):
    """A law with a compiled return, which its class names in ``_loop``.

    Where a law derived from it overrides nothing, the whole update is compiled too.
    """

    _loop: ClassVar[str] = ""
    yield_tolerance: ClassVar[float] = 0.0

    def _has_compiled_update(self) -> bool:
        """Return whether updates are compiled as a whole."""
        return self._loop != "" and is_as_inherited(self, "_loop")

    def _return(self) -> str:
        """Return the name of the compiled return."""
        return self._loop

    def _constants(self) -> tuple[Parameter, ...]:
        """Return the parameters of the compiled law, in the order of ``material.h``."""
        raise NotImplementedError

    def _share(self) -> Parameter:
        """Return which share of a return is done in the time of a step."""
        return 1.0

    @override
    def integrate(self, trial_strain: Array, variables: State, tangent: bool) -> Integration:
        owner = self._owner()
        n, m = trial_strain.shape
        stress, elastic = np.empty((n, m)), np.empty((n, m))
        D, new = np.empty((n if tangent else 0, m, m)), {}
        for name in owner.internal_variables:
            new[name] = np.empty(n)
        loops.integrate(
            self._return(),
            np.ascontiguousarray(trial_strain),
            [np.ascontiguousarray(variables[name]) for name in new],
            [_values(parameter) for parameter in self._constants()],
            _values(self._share()),
            self.yield_tolerance,
            stress,
            D,
            elastic,
            list(new.values()),
        )
        return Integration(stress, D if tangent else None, elastic, new)

    def _owner(self) -> type[CompiledMaterial]:
        """Return the class that names the return.

        Raises:
            MPMError: A law derived from it overrides what the return does not ask.
        """
        changed: set[str] = set()
        for its in type(self).__mro__:
            if "_loop" in vars(its) and issubclass(its, CompiledMaterial):
                break
            changed |= vars(its).keys()
        if BY_HEART & changed and "integrate" not in changed:
            raise MPMError(
                f"{type(self).__name__} overrides {', '.join(sorted(BY_HEART & changed))} of "
                f"{its.__name__}, whose return does not ask it; override integrate, or write a "
                "ReturnMapping."
            )
        return its

    @override
    def update(self, displacement_gradient: Array, state: State, tangent: bool = True) -> Update:
        if not self._has_compiled_update():
            return super().update(displacement_gradient, state, tangent)
        H = np.ascontiguousarray(displacement_gradient)
        n, dim, _ = H.shape
        P, A = np.empty_like(H), np.empty((n if tangent else 0, dim, dim, dim, dim))
        parameters = [_values(parameter) for parameter in self._constants()]
        if "displacement_gradient" in state:
            new, invalid = self._with_history(parameters, H, state, P, A)
        else:
            new = {"stress": np.empty((n, num_components(dim)))}
            invalid = loops.update_elastic(self._return(), H, parameters, P, A, new["stress"])
        valid = np.ones(n, dtype=bool)
        valid[invalid] = False
        require_valid(valid)
        return Update(P, A if tangent else None, new)

    @override
    def at_pressure(
        self, displacement_gradient: Array, state: State, pressure: Array, shear: Array
    ) -> AtPressure:
        if not self._has_compiled_update() or "displacement_gradient" not in state:
            return super().at_pressure(displacement_gradient, state, pressure, shear)
        H = np.ascontiguousarray(displacement_gradient)
        n, dim, _ = H.shape
        P, A = np.empty_like(H), np.empty((n, dim, dim, dim, dim))
        gap, compliance = np.zeros(n), np.zeros(n)
        slope, by_pressure = np.zeros_like(H), np.zeros_like(H)
        given = np.ascontiguousarray(pressure), ALPHA * shear
        seen = gap, compliance, slope, by_pressure
        parameters = [_values(parameter) for parameter in self._constants()]
        new, invalid = self._with_history(parameters, H, state, P, A, given, seen)
        lost = invalid[np.isnan(gap[invalid])]
        if len(lost):
            raise ConvergenceError(
                f"{type(self).__name__} found no volume strain for the pressure", lost
            )
        valid = np.ones(n, dtype=bool)
        valid[invalid] = False
        require_valid(valid)
        return AtPressure(P, A, by_pressure, gap, slope, compliance, new)

    # -- Derivatives -------------------------------------------------------------------------

    @property
    def is_differentiable(self) -> bool:
        """Whether there is :meth:`pull` of its updates."""
        return self._has_compiled_update() and self._return() == self._loop

    def numbers(self, state: State) -> Array:
        """Return the numbers of the compiled law, shape ``(k, n)``, or ``(k, 1)`` if all alike.

        The last is the share of a return that there is time for.

        Args:
            state: That from which the law goes on.
        """
        return np.stack(np.broadcast_arrays(*map(_values, (*self._constants(), self._share()))))

    def pull(
        self, displacement_gradient: Array, state: State, first_piola: Array, weights: State
    ) -> Taken:
        """Return the derivatives by all that an update takes of something, exactly.

        Args:
            displacement_gradient: As in :meth:`update`.
            state: As there.
            first_piola: Derivatives of it by the stress, shape ``(n, dim, dim)``.
            weights: Those by the new state.
        """
        taken = [np.empty_like(own) for own in self._in_order(first_piola, weights, state)]
        taken.append(np.empty((len(first_piola), len(self.numbers(state)))))
        seen = self._in_order(first_piola, weights, state)
        given = [seen[0], np.array(weights["stress"]), seen[2], seen[3]]
        loops.pull(*self._step(displacement_gradient, state), taken, given)
        by = {"stress": np.zeros_like(given[1])}
        if "displacement_gradient" in state:
            by |= {"displacement_gradient": taken[1], "elastic_b_minus_identity": taken[2]}
            taken[0] += weights["displacement_gradient"]
        return Taken(taken[0], by | self._by_name(taken[3]), taken[4])

    def _step(
        self, H: Array, state: State
    ) -> tuple[str, list[Array], list[Array], list[Array], Array, float]:
        """Return the step that was made as compiled derivatives take it."""
        before = [np.ascontiguousarray(H), np.empty(0), np.empty(0)]
        if "displacement_gradient" in state:
            names = "displacement_gradient", "elastic_b_minus_identity"
            before[1:] = (np.ascontiguousarray(state[name]) for name in names)
        variables = [np.ascontiguousarray(state[name]) for name in self.internal_variables]
        parameters = [_values(parameter) for parameter in self._constants()]
        tolerance = self.yield_tolerance
        return self._loop, before, variables, parameters, _values(self._share()), tolerance

    def _in_order(self, gradient: Array, values: State, state: State) -> list[Array]:
        """Return numbers for the gradient, the old one, the elastic b and the variables."""
        history = [np.empty(0), np.empty(0)]
        if "displacement_gradient" in state:
            names = "displacement_gradient", "elastic_b_minus_identity"
            history = [np.array(values[name], order="C") for name in names]
        own = [values[name] for name in self.internal_variables]
        variables = np.column_stack(own) if own else np.empty((len(gradient), 0))
        return [np.array(gradient, order="C"), *history, np.array(variables, order="C")]

    def _by_name(self, variables: Array) -> State:
        """Return columns of numbers for the internal variables by name."""
        return {name: variables[:, k] for k, name in enumerate(self.internal_variables)}

    def _with_history(
        self,
        parameters: list[Array],
        H: Array,
        state: State,
        P: Array,
        A: Array,
        given: tuple[Array, ...] = (),
        seen: tuple[Array, ...] = (),
    ) -> tuple[State, NDArray[np.int64]]:
        """Set P, A, and at a given pressure what is seen then.

        Returns:
            The new state, and the points that are impossible.
        """
        n, dim, _ = H.shape
        names, m = tuple(self.internal_variables), num_components(dim)
        stress, b = np.empty((n, m)), np.empty((n, m))
        variables = [np.empty(n) for _ in names]
        run = loops.update_at_pressure if given else loops.update_plastic
        invalid = run(
            self._return(),
            H,
            np.ascontiguousarray(state["displacement_gradient"]),
            np.ascontiguousarray(state["elastic_b_minus_identity"]),
            [np.ascontiguousarray(state[name]) for name in names],
            parameters,
            _values(self._share()),
            self.yield_tolerance,
            *given,
            P,
            A,
            stress,
            b,
            variables,
            *seen,
        )
        # What cannot be written to is kept as it is: it is given away for good.
        gradient = H.copy() if H.flags.writeable else H
        new = {"stress": stress, "displacement_gradient": gradient, "elastic_b_minus_identity": b}
        return new | dict(zip(names, variables, strict=True)), invalid


def _values(parameter: Parameter) -> Array:
    return np.ascontiguousarray(np.atleast_1d(parameter), dtype=np.float64)
