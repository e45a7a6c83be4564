# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Memory of points of one body that may meet facets of another."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .contact import Outcome
from .facets import Closest
from .law import Friction, unworn

__all__ = ["Memory", "State", "no_memory", "spread"]


class Memory(NamedTuple):
    """State of a pass at the last converged step.

    Attributes:
        touched: Which points were in contact, shape ``(n,)``.
        facet: Number of the facet of their anchors, or of the closest where they touched nothing,
            -1 where none was near, shape ``(n,)``.
        place: Place on it, shape ``(n, gdim - 1)``.
        closest: Number of the closest facet, shape ``(n,)``.
        gap: Shape ``(n,)``.
        within: Which points were behind their facets, shape ``(n,)``.
        offset: Gap at which each begins to be pressed in a motion, shape ``(n,)``: negative for
            points that came there from the side and not through a facet, or they would gain energy.
        points: Where they were, shape ``(n, gdim)``.
        anchors: Where their anchors were, shape ``(n, gdim)``.
        friction: What the law of friction remembers, shape ``(n, k)``.
    """

    touched: NDArray[np.bool_]
    facet: NDArray[np.int64]
    place: NDArray[np.float64]
    closest: NDArray[np.int64]
    gap: NDArray[np.float64]
    within: NDArray[np.bool_]
    offset: NDArray[np.float64]
    points: NDArray[np.float64]
    anchors: NDArray[np.float64]
    friction: NDArray[np.float64]

    def of(self, points: NDArray[np.int64]) -> Memory:
        """Return the memory of some points."""
        parts: list[Any] = [part[points] for part in self]
        return Memory(*parts)

    def with_some(self, points: NDArray[np.int64], known: Memory) -> Memory:
        """Return the memory of all points where some have another one."""
        parts: list[Any] = [spread(new, points, old) for new, old in zip(known, self, strict=True)]
        return Memory(*parts)


class State(NamedTuple):
    """A pass at the last converged step.

    Attributes:
        memory: What is known of all points.
        outcome: What acted on them.
    """

    memory: Memory
    outcome: Outcome


def no_memory(law: Friction, x: NDArray[np.float64]) -> Memory:
    """Return the memory of points at x ``(n, gdim)`` that nothing has touched or was near."""
    n, gdim = x.shape
    facet, place, gap, near, beside = Closest.none(n, gdim - 1)
    return Memory(near, facet, place, facet, gap, near, beside, x, x, unworn(law, (n,)))


def spread(part: NDArray[Any], which: NDArray[np.int64], base: NDArray[Any]) -> NDArray[Any]:
    """Return an array with others in some places."""
    whole = base.copy()
    whole[which] = part
    return whole
