# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Memory of an obstacle at the points of a body: of a converged step, and of a trial."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .contact import Outcome
from .law import Begun
from .rotation import Pose
from .surface import Surface

__all__ = ["Grip", "Memory", "Step"]


class Grip(NamedTuple):
    """How points of a body hold on to an obstacle at a converged step.

    Attributes:
        surface: Where the points are.
        touched: Which were in contact, shape ``(m, nq)``.
        gap: Shape ``(m, nq)``.
        normal: Normals, shape ``(m, nq, gdim)``.
        anchor: Their anchors.
        outcome: What acted.
        friction: What the law of friction remembers, shape ``(m, nq, k)``.
    """

    surface: Surface
    touched: NDArray[np.bool_]
    gap: NDArray[np.float64]
    normal: NDArray[np.float64]
    anchor: NDArray[np.float64]
    outcome: Outcome
    friction: NDArray[np.float64]


class Step(NamedTuple):
    """A step of a motion, at some points, in the frame of the shape.

    Attributes:
        middle: Positions in the middle, shape ``(n, gdim)``.
        normal: Normals there.
        begun: How it began.
        push: Traction by pressure; ``None``: not known yet.
    """

    middle: NDArray[np.float64]
    normal: NDArray[np.float64]
    begun: Begun
    push: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class Memory:
    """State of the points at the last converged step.

    Attributes:
        pose: Where the shape was.
        touched: Which points were in contact, shape ``(m, nq)``.
        anchor: Their anchors, or where points were, in the frame of the shape, ``(m, nq, gdim)``.
        gap: Shape ``(m, nq)``.
        normal: Normals, in the frame of the shape.
        outcome: What acted.
        friction: What the law of friction remembers, shape ``(m, nq, k)``.
        works: What was done against pressure and against friction in the step, if there is motion.
        step: The step of a motion, at all points, by whose middle the forces are.
        behind: Tractions by the stress behind the facets, where these count, ``(m, nq, gdim)``.
        facets: Numbers of the facets that were looked at, as nothing acts on others; ``None``: all.
        exact: Whether all gaps are known, and not only what some are at least.
    """

    pose: Pose
    touched: NDArray[np.bool_]
    anchor: NDArray[np.float64]
    gap: NDArray[np.float64]
    normal: NDArray[np.float64]
    outcome: Outcome
    friction: NDArray[np.float64]
    works: tuple[float, float] = (0.0, 0.0)
    step: Step | None = None
    behind: NDArray[np.float64] | None = None
    facets: NDArray[np.int64] | None = None
    exact: bool = True

    def numbers(self, here: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the numbers of facets by their places among those that were looked at."""
        return here if self.facets is None else self.facets[here]

    def of(self, which: NDArray[np.int64]) -> Memory:
        """Return the memory of some facets."""
        return Memory(
            self.pose,
            self.touched[which],
            self.anchor[which],
            self.gap[which],
            self.normal[which],
            self.outcome.of(which),
            self.friction[which],
            facets=which,
        )
