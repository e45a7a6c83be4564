# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Curves of a run: numbers that are noted at its beginning and after each step."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError, agree
from ..history import Step
from ..parallel.boundary import collective, of_user
from ..parallel.given import require_same
from ..reals import as_reals

__all__ = ["Record"]


class Record(Mapping[str, NDArray[np.float64]]):
    """Curves of a run, as arrays and as a table: time, load, and what functions return.

    The functions are called at the beginning of a run and after each step, on all ranks, and return
    the same on each, as :func:`probe` and ``problem.reaction`` do::

        curve = mpm.Record(
            problem,
            settlement=lambda: -mpm.probe(soil, (0.0, 4.0))[1],
            force=lambda: problem.reaction(footing)[1],
        )
        for step in curve.follow(problem.steps(20)):
            print(step.load)
        plt.plot(curve["settlement"], curve["force"])
        curve.write("curve.csv")

    Runs that are followed one after the other make one curve, in which no state stands twice. What
    a function cannot tell before the first step, when ``history.steps`` is empty, is not a number
    there. A record is not part of a checkpoint; that of a run that goes on from one begins with the
    state restored.

    Args:
        problem: The problem that is run.
        **functions: By the names of their columns: functions without arguments that return a number
            or an array, of the same shape each time.

    Raises:
        MPMError: No function, or a column called ``time`` or ``load``, which are there anyway.
    """

    def __init__(self, problem: Any, **functions: Callable[[], Any]) -> None:
        taken = [name for name in ("time", "load") if name in functions]
        wrong = [name for name, function in functions.items() if not callable(function)]
        if taken or wrong or not functions:
            raise MPMError(
                "A record has functions without arguments by the names of its columns, besides "
                f"'time' and 'load', which are there: not {', '.join(taken or wrong) or 'none'}."
            )
        self._problem = problem
        self._comm: MPI.Comm = problem.bodies[0].mesh.comm
        self._functions = {name: of_user(self._comm, f) for name, f in functions.items()}
        self._columns: dict[str, list[NDArray[np.float64]]] = {
            name: [] for name in ("time", "load", *functions)
        }

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        """Return a column, shape ``(states, ...)``."""
        return np.array(self._columns[name])

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        return len(self._columns)

    def __repr__(self) -> str:
        return f"<Record: {', '.join(self)}; {len(self._columns['time'])} states>"

    def follow(self, steps: Iterable[Step]) -> Iterator[Step]:
        """Yield the steps of a run, each after it was noted, and note where it begins (collective).

        Args:
            steps: ``problem.steps(...)``, of whatever problem.

        Raises:
            MPMError: A function returns no numbers, another shape than before, or something else on
                other ranks.
        """
        history, times = self._problem.history, self._columns["time"]
        if not times or times[-1] != history.time:
            last = history.steps[-1:]
            load = last[0].load if last else float(self._problem.bodies[0].load.value)
            self._note(history.time, load)
        for step in steps:
            self._note(step.time, step.load)
            yield step

    def _note(self, time: float, load: float) -> None:
        values = {name: self._value(function) for name, function in self._functions.items()}
        row = {"time": np.array(time), "load": np.array(load)}
        with agree(self._comm):
            for name, value in values.items():
                try:
                    row[name] = as_reals(value)
                except (TypeError, ValueError):
                    raise MPMError(f"{name} of a record is {value!r}, and no number.") from None
                before = self._columns[name]
                if len(before) == 1 and np.all(np.isnan(before[0])):
                    before[0] = np.full(row[name].shape, np.nan)
                if before and before[0].shape != row[name].shape:
                    raise MPMError(
                        f"{name} of a record has the shape {row[name].shape}, and had "
                        f"{before[0].shape} before; it must keep its shape."
                    )
        require_same(self._comm, **{name: row[name].tolist() for name in self._functions})
        for name, value in row.items():
            self._columns[name].append(value)

    def _value(self, function: Callable[[], Any]) -> Any:
        """Return the value of a function, not a number where it cannot be known yet."""
        try:
            return function()
        except Exception:  # of a user's function, on all ranks
            if self._problem.history.steps:
                raise
            return np.nan

    @collective()
    def write(self, path: str | Path) -> None:
        """Write a table of comma-separated values, a line for each state (collective).

        Entries of arrays have a column each: ``reaction_0``, ``reaction_1``. NumPy reads it by
        ``np.genfromtxt(path, delimiter=",", names=True)``.

        Args:
            path: The file, which is replaced.

        Raises:
            OSError: It cannot be written.
        """
        names, columns = [], []
        for name, values in self.items():
            for place in np.ndindex(values.shape[1:]):
                names.append("_".join([name, *map(str, place)]))
                columns.append(values[(slice(None), *place)])
        with agree(self._comm):
            if self._comm.rank == 0:
                table = np.column_stack(columns)
                np.savetxt(path, table, "%.17g", ",", header=",".join(names), comments="")
