# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What an obstacle knows of the points of a body: at a converged step, and at one that is tried."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .contact import Outcome
from .rotation import Pose

__all__ = ["Memory", "Near", "Step"]


class Step(NamedTuple):
    """A step of a motion, at some points, in the frame of the shape.

    Attributes:
        change: Of positions, shape ``(n, gdim)``.
        middle: Positions in the middle.
        normal: Normals there.
        gradient: That by which the change of the gap is the one of positions.
        factor: What of the change is in it.
        before: Gap at the beginning, shape ``(n,)``.
        pressure: Mean pressure.
    """

    change: NDArray[np.float64]
    middle: NDArray[np.float64]
    normal: NDArray[np.float64]
    gradient: NDArray[np.float64]
    factor: NDArray[np.float64]
    before: NDArray[np.float64]
    pressure: NDArray[np.float64]


@dataclass(frozen=True)
class Memory:
    """What is known of the last converged step.

    Attributes:
        pose: Where the shape was.
        touched: Which points were in contact, shape ``(m, nq)``.
        anchor: Their anchors, or where points were, in the frame of the shape, ``(m, nq, gdim)``.
        gap: Shape ``(m, nq)``.
        normal: Normals, in the frame of the shape.
        outcome: What acted.
        works: What was done against pressure and against friction in the step, if there is motion.
        step: The step of a motion, at all points, by whose middle the forces are.
        behind: Tractions by the stress behind the facets, where these count, ``(m, nq, gdim)``.
        pressed: Which points that stress presses, or is about to, where it counts, ``(m, nq)``.
        whole: Whether all facets were looked at, not those alone that may touch.
        exact: Whether all gaps are known, and not only what some are at least.
    """

    pose: Pose
    touched: NDArray[np.bool_]
    anchor: NDArray[np.float64]
    gap: NDArray[np.float64]
    normal: NDArray[np.float64]
    outcome: Outcome
    works: tuple[float, float] = (0.0, 0.0)
    step: Step | None = None
    behind: NDArray[np.float64] | None = None
    pressed: NDArray[np.bool_] | None = None
    whole: bool = True
    exact: bool = True

    def of(self, which: NDArray[np.int64]) -> Memory:
        """Return what is known of some facets."""
        outcome = Outcome(*(getattr(self.outcome, field.name)[which] for field in fields(Outcome)))
        return Memory(
            self.pose,
            self.touched[which],
            self.anchor[which],
            self.gap[which],
            self.normal[which],
            outcome,
        )

    def among(self, which: NDArray[np.int64], last: Memory) -> Memory:
        """Return it as what acts on some facets, with nothing that acts on the others.

        Args:
            which: Their numbers.
            last: What is known of all of them.
        """
        m, nq = last.gap.shape

        def spread(values: Any, base: Any) -> Any:
            """Return values in their places, and others elsewhere."""
            found = np.zeros((m, *values.shape[1:]), values.dtype) if base is None else base.copy()
            found[which] = values
            return found

        mine, its = self.outcome, last.outcome
        outcome = Outcome(
            spread(mine.positions, its.positions),
            spread(mine.gap, last.gap),
            *(spread(v, None) for v in (mine.pressure, mine.traction, mine.inside, mine.slips)),
        )
        step = self.step
        if step is not None:
            parts = (part.reshape(len(which), nq, *part.shape[1:]) for part in step)
            step = Step(*(spread(p, None).reshape(m * nq, *p.shape[2:]) for p in parts))
        return Memory(
            self.pose,
            outcome.inside,
            spread(self.anchor, last.anchor),
            outcome.gap,
            spread(self.normal, last.normal),
            outcome,
            self.works,
            step,
            whole=False,
        )


class Near(NamedTuple):
    """Facets that may touch in a step.

    Attributes:
        which: Their numbers.
        memory: What is known of them.
        nodes: Where the nodes of all facets begin.
        radius: How much gaps change at most, by the angle that the shape turns by.
        margin: How far points may come nearer until others could touch.
    """

    which: NDArray[np.int64]
    memory: Memory
    nodes: NDArray[np.float64]
    radius: float
    margin: float
