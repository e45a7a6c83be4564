# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Laws that come in place of others: what the points of a body go on with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from ..errors import agree
from ..materials.base import Material, State
from .governed import Carried, Governed

__all__ = ["Episode", "equals", "states_after"]


class Episode(NamedTuple):
    """A law of before.

    Attributes:
        given: As the user gave it.
        part: With its parameters at its points.
        state: What it kept of the last converged step.
    """

    given: Material
    part: Governed
    state: State


class _Known(NamedTuple):
    """State of the points of a law.

    Attributes:
        state: Of an equal law, of all of them.
        where: At which it is that, shape ``(n,)``.
        whole: Whether it is at all of them on all ranks.
    """

    state: State
    where: NDArray[np.bool_]
    whole: bool


def equals(one: Material, other: Material) -> bool:
    """Return whether two materials are the same law with the same parameters.

    Functions and Constants among the parameters are the same objects then.
    """
    mine, its = one.parameters, other.parameters
    return one is other or (
        _of_one_law(one, other)
        and mine.keys() == its.keys()
        and all(_same(value, its[name]) for name, value in mine.items())
    )


def _of_one_law(one: Material, other: Material) -> bool:
    """Return whether materials differ in nothing but their parameters."""
    mine, its = (
        {name: value for name, value in vars(m).items() if name != "_parameters"}
        for m in (one, other)
    )
    same = type(one) is type(other) and mine.keys() == its.keys()
    return same and all(_same(value, its[name]) for name, value in mine.items())


def _same(one: Any, other: Any) -> bool:
    """Return whether values are the same object, or equal laws, numbers, words or arrays."""
    if one is other:
        return True
    if isinstance(one, Material) and isinstance(other, Material):
        return equals(one, other)
    plain = int | float | str | np.ndarray | np.number
    return isinstance(one, plain) and isinstance(other, plain) and np.array_equal(one, other)


def states_after(
    before: Sequence[Episode],
    laws: Sequence[tuple[Material, Governed]],
    carried: Carried,
    unchanged: NDArray[np.bool_],
    comm: MPI.Comm,
) -> list[State]:
    """Return the states that laws go on with at their points (collective).

    An equal law goes on with the history. Another carries the stress, and those internal variables
    that the law of before, one of its class, had begun with the same value.

    Args:
        before: The laws of before.
        laws: Each as it was given, and at its points.
        carried: What all points of this rank carry.
        unchanged: Which of them see what was seen before, shape ``(n,)``.
        comm: Communicator.

    Raises:
        MPMError: A law cannot bear its stress; ``particles`` are global indices.
    """
    known = [_known(before, *law, carried, unchanged, comm) for law in laws]
    with agree(comm):
        return [
            its.state if its.whole else _completed(before, part, its, carried)
            for (_, part), its in zip(laws, known, strict=True)
        ]


def _known(
    before: Sequence[Episode],
    given: Material,
    part: Governed,
    carried: Carried,
    unchanged: NDArray[np.bool_],
    comm: MPI.Comm,
) -> _Known:
    """Return the state that equal laws have kept of the points of a law (collective)."""
    count = len(part.points)
    state: State = {}
    where = np.zeros(count, dtype=bool)
    for episode in before:
        mine, its = _in_common(part, episode.part)
        same = np.full(len(mine), given is episode.given)
        if given is not episode.given:
            same = _equal_at(part.material, mine, episode.part.material, its)
        there = bool(comm.allreduce(bool(same.any()), MPI.LOR))
        if not there or (state and state.keys() != episode.state.keys()):
            continue
        where[mine[same]] = True
        for name, values in episode.state.items():
            shape = (count, *values.shape[1:])
            state.setdefault(name, np.zeros(shape, values.dtype))[mine[same]] = values[its[same]]
    anew = where & ~unchanged[part.points]
    remembers = "displacement_gradient" in state
    if remembers:
        state["displacement_gradient"][anew] = carried.gradient[part.points[anew]]
    else:
        where[anew] = False
    whole = bool(state) and bool(comm.allreduce(bool(where.all()), MPI.LAND))
    # a law without memory has none that could be mixed with that of other points
    return _Known(state, where & (whole or remembers), whole)


def _in_common(part: Governed, other: Governed) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the points that two laws govern both, by their numbers among those of each."""
    points = part.points, other.points
    _, mine, its = np.intersect1d(*points, assume_unique=True, return_indices=True)
    return mine, its


def _equal_at(
    one: Material, mine: NDArray[np.int64], other: Material, its: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Return at which of the points of one law another is equal to it, shape ``(m,)``.

    Args:
        one: The law, with its parameters at its points.
        mine: Numbers of ``m`` of those.
        other: The other law.
        its: Their numbers among the points of that.
    """
    names = one.parameters.keys()
    same = np.full(len(mine), _of_one_law(one, other) and names == other.parameters.keys())
    for name in names if same.any() else ():
        values = one.parameters[name], other.parameters[name]
        if any(isinstance(value, np.ndarray) for value in values):
            a, b = (
                value[rows] if isinstance(value, np.ndarray) else value
                for value, rows in zip(values, (mine, its), strict=True)
            )
            same &= a == b
        else:
            same &= _same(*values)
    return same


def _completed(before: Sequence[Episode], part: Governed, known: _Known, carried: Carried) -> State:
    """Return the state of a law, which is known at some points and of a stress at others."""
    new = np.flatnonzero(~known.where)
    state = {}
    for name, values in part.stressed_state(new, carried, _variables(before, part, new)).items():
        state[name] = np.empty((len(known.where), *values.shape[1:]), values.dtype)
        state[name][new] = values
        if known.where.any():
            state[name][known.where] = known.state[name][known.where]
    return state


def _variables(before: Sequence[Episode], part: Governed, rows: NDArray[np.int64]) -> State:
    """Return internal variables of some of the points of a law, which others of its class knew."""
    names = tuple(part.material.internal_variables)
    first = part.initial_state() if names else {}
    variables = {name: first[name].copy() for name in names}
    for episode in before:
        if not names or type(episode.part.material) is not type(part.material):
            continue
        mine, its = _in_common(part, episode.part)
        begun = episode.part.initial_state()
        for name, values in variables.items():
            same = values[mine] == begun[name][its]
            same = same.all(axis=tuple(range(1, same.ndim)))
            values[mine[same]] = episode.state[name][its[same]]
    return {name: values[rows] for name, values in variables.items()}
