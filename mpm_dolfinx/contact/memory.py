# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Memory of points at the last converged step: of a shape, and of facets of another body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .facets import Closest
from .law import Friction, unworn
from .outcome import Outcome
from .rotation import Pose

__all__ = ["FacetMemory", "ShapeMemory", "no_memory", "spread"]


@dataclass(frozen=True)
class ShapeMemory:
    """Points that a shape may touch.

    Attributes:
        pose: Where the shape was.
        anchor: Their anchors, or where points were, in the frame of the shape, ``(m, nq, gdim)``.
        normal: Normals, in the frame of the shape.
        outcome: What acted.
        friction: What the law of friction remembers, shape ``(m, nq, k)``.
        facets: Numbers of their facets; ``None``: all.
        exact: Whether all gaps are known, and not only what some are at least.
    """

    pose: Pose
    anchor: NDArray[np.float64]
    normal: NDArray[np.float64]
    outcome: Outcome
    friction: NDArray[np.float64]
    facets: NDArray[np.int64] | None = None
    exact: bool = True

    @property
    def gap(self) -> NDArray[np.float64]:
        """Gaps, shape ``(m, nq)``."""
        return self.outcome.gap

    def of(self, which: NDArray[np.int64]) -> ShapeMemory:
        """Return the memory of some facets."""
        return ShapeMemory(
            self.pose,
            self.anchor[which],
            self.normal[which],
            self.outcome.of(which),
            self.friction[which],
            which,
        )


class FacetMemory(NamedTuple):
    """Points that may meet facets of another body.

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

    def of(self, points: NDArray[np.int64]) -> FacetMemory:
        """Return the memory of some points."""
        parts: list[Any] = [part[points] for part in self]
        return FacetMemory(*parts)

    def with_some(self, points: NDArray[np.int64], known: FacetMemory) -> FacetMemory:
        """Return the memory of all points where some have another one."""
        parts: list[Any] = [spread(new, points, old) for new, old in zip(known, self, strict=True)]
        return FacetMemory(*parts)


def no_memory(law: Friction, x: NDArray[np.float64]) -> FacetMemory:
    """Return the memory of points at x ``(n, gdim)`` that nothing has touched or was near."""
    n, gdim = x.shape
    facet, place, gap, near, beside = Closest.none(n, gdim - 1)
    return FacetMemory(near, facet, place, facet, gap, near, beside, x, x, unworn(law, (n,)))


def spread(part: NDArray[Any], which: NDArray[np.int64], base: NDArray[Any]) -> NDArray[Any]:
    """Return an array with others in some places."""
    whole = base.copy()
    whole[which] = part
    return whole
