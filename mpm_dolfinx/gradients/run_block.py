# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The block of a run on the tape of pyadjoint; imported where that is installed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, override

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray
from pyadjoint import AdjFloat, Block, OverloadedType, create_overloaded_object

from dolfinx import fem

from ..errors import MPMError, warn
from ..parallel.totals import over_ranks
from ..problems.quasistatic import QuasiStaticProblem
from ..stepping.trial import Trial
from .adjoint import Adjoint
from .sensitivity import Sensitivity

__all__ = ["RunBlock"]

type Array = NDArray[np.float64]


class _Tangent(Sensitivity):
    """Derivatives of displacements after each step, in one direction of all parameters.

    Args:
        problem: As for :class:`Sensitivity`.
        ways: Parameters with their directions.
    """

    def __init__(self, problem: QuasiStaticProblem, ways: Sequence[Any]) -> None:
        super().__init__(problem, ways)
        self.displacements: list[list[Array]] = []

    @override
    def solved(self, trial: Trial) -> Callable[[], None]:
        take = super().solved(trial)

        def take_and_keep() -> None:
            take()
            rates = [one if isinstance(one, list) else [one] for one in self.displacement]
            of_bodies = [
                [function.x.array for function in body] for body in zip(*rates, strict=True)
            ]
            self.displacements.append([np.sum(each, axis=0) for each in of_bodies])

        return take_and_keep


class RunBlock(Block):  # type: ignore[misc]
    """A run from its controls to displacements; the arguments are those of :func:`taped`."""

    def __init__(
        self,
        made: Callable[[], QuasiStaticProblem],
        controls: Sequence[Any],
        run: Callable[[QuasiStaticProblem], Any],
        steps: Sequence[int],
    ) -> None:
        super().__init__()
        self._made, self._run, self._steps = made, run, list(steps)
        self._values: list[Array] = []
        self._parameters: list[fem.Function | fem.Constant] = []
        self._adjoint: Adjoint | None = None
        self._of: list[Array] = []
        self._times: list[float] | None = None
        for given in controls:
            control, parameter = given if isinstance(given, tuple) else (given, given)
            follows = (fem.Constant, AdjFloat) if isinstance(given, tuple) else (fem.Function,) * 2
            if not (
                isinstance(parameter, follows[0])
                and isinstance(control, follows[1])
                and isinstance(control, OverloadedType)
            ):
                raise MPMError(
                    "A control is a Function of dolfinx_adjoint, or a pair of an AdjFloat and the "
                    f"dolfinx Constant that has its value, not {given!r}."
                )
            self._parameters.append(parameter)
            self.add_dependency(control)

    def first(self) -> list[fem.Function]:
        """Return displacements of the first run, Functions of dolfinx_adjoint (collective)."""
        found = self._displacements([one.saved_output for one in self.get_dependencies()])
        assert self._adjoint is not None
        bodies = self._adjoint.problem.bodies
        outputs = []
        for place, values in enumerate(found):
            body = bodies[place % len(bodies)]
            outputs.append(create_overloaded_object(fem.Function(body.W, name="displacement")))
            outputs[-1].x.array[:] = values
        return outputs

    @contextmanager
    def _with(self, inputs: Sequence[Any]) -> Iterator[None]:
        """Let parameters have values of the tape."""
        arrays = [
            one.x.array if isinstance(one, fem.Function) else one.value for one in self._parameters
        ]
        own = [array.copy() for array in arrays]
        for array, value in zip(arrays, inputs, strict=True):
            array[...] = value.x.array if isinstance(value, fem.Function) else float(value)
        try:
            yield
        finally:
            for array, values in zip(arrays, own, strict=True):
                array[...] = values

    def _displacements(self, inputs: Sequence[Any]) -> list[Array]:
        """Run with values of the tape, unless that was the last run (collective)."""
        values = [
            np.array(one.x.array if isinstance(one, fem.Function) else float(one)) for one in inputs
        ]
        known = self._adjoint is not None and all(map(np.array_equal, values, self._values))
        comm = None if self._adjoint is None else self._adjoint.problem.bodies[0].mesh.comm
        if comm is None or comm.allreduce(not known):
            self._adjoint = None
            with self._with(inputs):
                problem = self._made()
                adjoint = Adjoint(problem, self._parameters)
                self._run(problem)
                self._of = self._chosen(adjoint.displacements)
            self._compare_steps(problem)
            self._adjoint, self._values = adjoint, values
        return self._of

    def _compare_steps(self, problem: QuasiStaticProblem) -> None:
        """Warn where a run has made other steps than the first (collective)."""
        times = [step.time for step in problem.history.steps]
        if self._times not in (None, times):
            warn(
                problem.bodies[0].mesh.comm,
                "A run on the tape has made other steps than the first time, as those are that "
                "steps='auto' chooses and failures halve. Derivatives are of the steps of the last "
                "run, and do not see what else they might be; give a number of steps, and enough.",
            )
        self._times = self._times or times

    def _chosen(self, displacements: Sequence[Sequence[Array]]) -> list[Array]:
        """Return the displacements, of all bodies, of the steps that are asked for."""
        count = len(displacements)
        if not self._steps or any(number not in range(-count, count) for number in self._steps):
            raise MPMError(
                f"The run made {count} steps: steps={self._steps} must be numbers from 0 to "
                f"{count - 1}, or back from -1."
            )
        self._steps = [number % count if number >= 0 else number for number in self._steps]
        return [values for number in self._steps for values in displacements[number]]

    @override
    def prepare_recompute_component(self, inputs: Any, relevant_outputs: Any) -> list[Array]:
        return self._displacements(inputs)

    @override
    def recompute_component(
        self, inputs: Any, block_variable: Any, idx: int, prepared: list[Array]
    ) -> Any:
        displacement = create_overloaded_object(fem.Function(block_variable.output.function_space))
        displacement.x.array[:] = prepared[idx]
        return displacement

    @override
    def prepare_evaluate_tlm(
        self, inputs: Any, tlm_inputs: Any, relevant_outputs: Any
    ) -> list[Array] | None:
        assert self._adjoint is not None
        comm = self._adjoint.problem.bodies[0].mesh.comm
        ways = []
        for parameter, given in zip(self._parameters, tlm_inputs, strict=True):
            if isinstance(parameter, fem.Function):
                way = np.zeros(1) if given is None else np.array(getattr(given, "x", given).array)
            else:
                way = np.array(0.0 if given is None else float(given))
            if over_ranks(comm, bool(np.any(way)), MPI.LOR):
                ways.append((parameter, way))
        if not ways:
            return None
        with self._with(inputs):
            problem = self._made()
            tangent = _Tangent(problem, ways)
            self._run(problem)
            return self._chosen(tangent.displacements)

    @override
    def evaluate_tlm_component(
        self,
        inputs: Any,
        tlm_inputs: Any,
        block_variable: Any,
        idx: int,
        prepared: list[Array] | None = None,
    ) -> Any:
        return (
            None
            if prepared is None
            else self.recompute_component(inputs, block_variable, idx, prepared)
        )

    @override
    def prepare_evaluate_adj(
        self, inputs: Any, adj_inputs: Any, relevant_dependencies: Any
    ) -> list[Array]:
        self._displacements(inputs)
        assert self._adjoint is not None
        bodies, count = self._adjoint.problem.bodies, len(self._adjoint.displacements)
        given = [
            np.zeros_like(values) if one is None else getattr(one, "x", one).array
            for one, values in zip(adj_inputs, self._of, strict=True)
        ]

        def weights(number: int) -> list[dict[str, Array]]:
            total = [np.zeros(body.displacement.x.array.shape) for body in bodies]
            for place, values in enumerate(given):
                if self._steps[place // len(bodies)] % count == number:
                    total[place % len(bodies)] += values
            return [{"displacement": values} for values in total]

        with self._with(inputs):
            return self._adjoint.of(weights)

    @override
    def evaluate_adj_component(
        self,
        inputs: Any,
        adj_inputs: Any,
        block_variable: Any,
        idx: int,
        prepared: list[Array] | None = None,
    ) -> Any:
        assert prepared is not None
        if not isinstance(block_variable.output, fem.Function):
            return float(prepared[idx])
        slope = create_overloaded_object(fem.Function(block_variable.output.function_space))
        slope.x.array[:] = prepared[idx]
        return slope.x  # the tape adds vectors up
