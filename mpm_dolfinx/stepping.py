# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Load steps: equal steps, cut back where they fail, grown again where they are easy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from .errors import MPMError

__all__ = ["Run", "StepControl"]

#: How often a step may be halved, and the linear solves of a step that is easy.
MOST_HALVINGS = 10
EASY = 8
#: Halvings, and width of a bracket relative to the load, from which a load that no step gets
#: over counts as a limit.
LIMIT_HALVINGS = 6
LIMIT_WIDTH = 1e-3


class StepControl:
    """Chooses the end of the next step between 0 and 1.

    Loads are whole numbers of ticks, so that a run without cutback ends its steps at k / n
    to the last bit.

    Args:
        steps: Number of equal steps; also the largest step.

    Attributes:
        steps: As given.
    """

    def __init__(self, steps: int) -> None:
        self.steps = steps
        self._largest: int = 2**MOST_HALVINGS
        self._end: int = steps * self._largest
        self._now: int = 0
        self._size: int = self._largest
        self._failed: int | None = None
        self._moved = self._wary = False

    @property
    def finished(self) -> bool:
        """Whether the whole load is reached."""
        return self._now == self._end

    @property
    def share(self) -> float:
        """How much is done."""
        return self._now / self._end

    @property
    def target(self) -> float:
        """End of the step to try."""
        return min(self._now + self._size, self._end) / self._end

    def accept(self, iterations: int) -> None:
        """Go to the target; double the next step if this one took few linear solves.

        Where a step failed again after it had been doubled, it is not until that load is passed.
        """
        self._now = min(self._now + self._size, self._end)
        self._moved = True
        if self._failed is not None and self._now >= self._failed:
            self._failed, self._wary = None, False
        if iterations <= EASY and not self._wary:
            self._size = min(2 * self._size, self._largest)

    def begin_anew(self) -> None:
        """Try whole steps again, after what made them fail has changed."""
        self._size, self._failed = self._largest, None
        self._moved = self._wary = False

    def cut_back(self, no_equilibrium: bool = False) -> bool:
        """Halve the step; return False where it is at its smallest, or a limit is found.

        Args:
            no_equilibrium: Whether Newton's method found none. Then a step of 1/64 of a full one
                and of 1/1000 of the load reached is the smallest.
        """
        limit = self._size <= max(1, self._largest >> LIMIT_HALVINGS) and (
            self._size <= LIMIT_WIDTH * self._now
        )
        self._wary = self._wary or (self._failed is not None and self._moved)
        end = self._now + self._size
        self._failed = end if self._failed is None else min(end, self._failed)
        self._moved = False
        if self._size == 1 or (no_equilibrium and limit):
            return False
        self._size //= 2
        return True


@dataclass
class Run:
    """A run of load steps: where it began, and how far it is.

    Attributes:
        control: The steps.
        path: Whether it follows a path of the user's.
        start: Load factor, or the displacement that is controlled, at its beginning.
        base: Dirichlet values at its beginning, on the local dofs of V.
        goal: The controlled displacement at its end, ``None`` where the load is given.
    """

    control: StepControl
    path: bool
    start: float
    base: NDArray[np.float64]
    goal: float | None = None

    @property
    def parameter(self) -> float:
        """Load factor, parameter of the path or displacement at the end of the step to try."""
        t = self.control.target
        goal = 1.0 if self.goal is None else self.goal
        return t if self.path else self.start + (goal - self.start) * t

    @property
    def limit(self) -> str:
        """What it means, and what to do, if there is no equilibrium up to the end of this step."""
        found = "no equilibrium was found up to"
        if self.goal is not None:
            return (
                f"{found} a controlled displacement of {self.parameter:.6g}, where it may turn "
                "back; control another one, or take more steps"
            )
        return (
            f"{found} {self.control.target:.6g}, which is a limit load unless more steps get over "
            "it; displacement control (control=...) goes on beyond it"
        )

    def dirichlet_values(self, totals: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the Dirichlet values at the end of the step to try.

        Args:
            totals: Those at full load, or on a path those that it has set for this step.
        """
        if self.path:
            return totals
        return self.base + (totals - self.base) * self.control.target

    def require(self, steps: int, path: bool, goal: float | None) -> None:
        """Raise an error unless this run has so many steps, and such a path or control."""
        if (steps, path, goal) != (self.control.steps, self.path, self.goal):
            kind = "update=..." if self.path else "no path (update=None)"
            if self.goal is not None:
                kind = f"displacement control to {self.goal:g}"
            raise MPMError(
                f"The checkpoint was made in a run of {self.control.steps} steps with {kind}; "
                "go on with these, or restore it with resume=False to begin a new run."
            )

    def numbers(self) -> dict[str, Any]:
        """Return all but the Dirichlet values, for a checkpoint."""
        return {
            "control": dict(vars(self.control)),
            "path": self.path,
            "start": self.start,
            "goal": self.goal,
        }

    @classmethod
    def of(cls, numbers: dict[str, Any], base: NDArray[np.float64]) -> Self:
        """Return the run that gave these numbers."""
        control = StepControl(numbers["control"]["steps"])
        vars(control).update(numbers["control"])
        return cls(control, numbers["path"], numbers["start"], base, numbers.get("goal"))
