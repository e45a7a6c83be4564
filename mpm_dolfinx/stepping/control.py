# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Load steps: equal steps, cut back where they fail, grown again where they are easy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError
from ..tolerances import SLIGHT
from .adaptivity import Adaptivity

__all__ = ["Control", "Converged", "Progress", "Run", "StepControl"]

#: How often a step may be halved, and the linear solves of a step that is easy.
MOST_HALVINGS = 10
EASY = 8
#: Steps of one size after which a larger one is tried, however many linear solves they took; twice
#: as many each time that such a try has failed.
PATIENCE = 3
#: Halvings from which a load that no step gets over counts as a limit, where its bracket is narrow.
LIMIT_HALVINGS = 6


class Control(Protocol):
    """Chooses the end of the next step between 0 and 1.

    Attributes:
        steps: What :meth:`Problem.solve` was given.
    """

    steps: Any

    @property
    def asked(self) -> list[Any]:
        """Options that a run from a checkpoint must share with the one before."""

    @property
    def finished(self) -> bool:
        """Whether the whole load is reached."""

    @property
    def share(self) -> float:
        """How much is done."""

    @property
    def target(self) -> float:
        """End of the step to try."""

    @property
    def lands(self) -> bool:
        """Whether the step to try ends at a level that was asked for."""

    def accept(self, iterations: int) -> None:
        """Go to the target, in so many linear solves."""

    def begin_anew(self) -> None:
        """Begin anew, after what made steps fail has changed."""

    def cut_back(self, gave_up: bool = False) -> bool:
        """Make the step smaller; return False where it is at its smallest, or a limit is found."""


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
        self._moved = self._wary = self._trying = False
        self._taken, self._patience = 0, PATIENCE

    @property
    def asked(self) -> list[Any]:
        """Options that a run from a checkpoint must share with the one before."""
        return [self.steps]

    def __str__(self) -> str:
        """Return how many steps there are, for a sentence."""
        return f"{self.steps} steps"

    @property
    def lands(self) -> bool:
        """Whether the step to try ends at a level that was asked for: at the end."""
        return self.target == 1.0

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

        A body that flows may need many in steps of any size, so after some steps of one size a
        larger one is tried all the same. Where a step failed again after it had been doubled,
        it is not until that load is passed.
        """
        self._now = min(self._now + self._size, self._end)
        self._moved, self._trying = True, False
        self._taken += 1
        if self._failed is not None and self._now >= self._failed:
            self._failed, self._wary = None, False
        easy = iterations <= EASY
        if (
            self._size < self._largest
            and not self._wary
            and (easy or self._taken >= self._patience)
        ):
            self._size, self._taken, self._trying = 2 * self._size, 0, not easy

    def begin_anew(self) -> None:
        """Try whole steps again, after what made them fail has changed."""
        self._size, self._failed = self._largest, None
        self._moved = self._wary = self._trying = False
        self._taken, self._patience = 0, PATIENCE

    def cut_back(self, gave_up: bool = False) -> bool:
        """Halve the step; return False where it is at its smallest, or a limit is found.

        Args:
            gave_up: Whether Newton's iterations came to nothing. Then a step of 1/64 of a full
                one and of 1/1000 of the load reached is the smallest.
        """
        limit = self._size <= max(1, self._largest >> LIMIT_HALVINGS) and (
            self._size <= SLIGHT * self._now
        )
        self._wary = self._wary or (self._failed is not None and self._moved)
        end = self._now + self._size
        self._failed = end if self._failed is None else min(end, self._failed)
        self._moved = False
        if self._trying:
            self._patience *= 2
        self._taken, self._trying = 0, False
        if self._size == 1 or (gave_up and limit):
            return False
        self._size //= 2
        return True


@dataclass
class Converged:
    """Last converged step of a problem, besides its bodies and their histories.

    Attributes:
        load: Load factor.
        parameter: Load factor, or parameter of the path.
        prescribed: Dirichlet values, on the local dofs of V, for each field.
        reactions: Residual on this rank's own dofs of V (at supports, their force), for each
            field; ``None`` where there was no step.
        followed: What free nodes add to these, for each field, or ``None`` for none; see
            :meth:`.Balance.followed`.
        proportional: Whether supports have moved in proportion to the load, else to totals.
        supports: Forces of the supports that the problem was given, in their order; ``None`` where
            there was no step with them.
        force: Size of the forces of all on the bodies' nodes; ``None`` where there was no step, or
            what was deleted after it has taken its own away.
    """

    load: float
    parameter: float
    prescribed: list[NDArray[np.float64]]
    reactions: list[NDArray[np.float64]] | None = None
    proportional: bool = True
    followed: Sequence[NDArray[np.float64] | None] = ()
    supports: list[NDArray[np.float64]] | None = None
    force: float | None = None

    def reaction(self, number: int) -> NDArray[np.float64] | None:
        """Return the forces at supports on own dofs of V of a field, if any are known."""
        if self.reactions is None:
            return None
        added = self.followed[number] if self.followed else None
        return self.reactions[number] if added is None else self.reactions[number] + added


@dataclass
class Run:
    """A run of load steps: where it began, and how far it is.

    Attributes:
        control: The steps.
        path: Whether it follows a path of the user's.
        start: Load factor, or the displacement that is controlled, at its beginning.
        base: Dirichlet values at its beginning, on the local dofs of V, for each field.
        goal: The controlled displacement at its end, ``None`` where the load is given.
        began: Time at its beginning: the number of the stages before it, unless it is through time.
        end: Time at its end, ``None`` unless it is through time.
        held: How much of what a stage changes was held back at its beginning.
        warned: Whether it has warned of loads that its path sets.
        adaptivity: Frees nodes at the end of steps; ``None``: nothing does.
        doubt: A warning about its errors, as far as the last step is concerned.
    """

    control: Control
    path: bool
    start: float
    base: list[NDArray[np.float64]]
    goal: float | None = None
    began: float = 0.0
    end: float | None = None
    held: float = 0.0
    warned: bool = False
    adaptivity: Adaptivity | None = None
    doubt: str | None = None

    @property
    def remaining(self) -> float:
        """How much of what a stage changes is held back at the end of the step to try."""
        return self.held * (1.0 - self.control.target)

    @property
    def time(self) -> float:
        """Time at the end of the step to try."""
        t = self.control.target
        if self.end is None:
            return self.began + t
        return self.end if t == 1.0 else self.began + (self.end - self.began) * t

    @property
    def parameter(self) -> float:
        """Load factor, parameter of the path or displacement at the end of the step to try.

        The parameter of a path through time is the time; a run that begins at the whole load has
        a parameter like a path.
        """
        if self.end is not None:
            return self.time
        return self.control.target if self.shares else self.aim

    @property
    def shares(self) -> bool:
        """Whether its parameter is how much of it is done, and no load or displacement."""
        return self.path or (self.goal is None and self.start >= 1.0)

    @property
    def aim(self) -> float:
        """Load factor, unless a path sets it, or displacement at the end of the step to try."""
        goal = 1.0 if self.goal is None else self.goal
        return self.start + (goal - self.start) * self.control.target

    @property
    def size(self) -> float:
        """How much the step to try is of the load, the time or the controlled displacement."""
        share = self.control.target - self.control.share
        if self.end is not None:
            return share * (self.end - self.began)
        if self.shares:
            return share
        return share * ((1.0 if self.goal is None else self.goal) - self.start)

    @property
    def limit(self) -> str:
        """Where Newton's method gets no further, and what to do, if this step is the smallest."""
        found = "no step, however small, gets to"
        if self.end is not None:
            return f"{found} the time {self.time:.6g}"
        if self.goal is not None:
            return (
                f"{found} a controlled displacement of {self.parameter:.6g}, where it may turn "
                "back; control another one, or take more steps"
            )
        return (
            f"{found} {self.control.target:.6g}; if that is a limit load, displacement control "
            "(control=...) or a motion (DynamicProblem) goes on beyond it"
        )

    def dirichlet_values(self, totals: list[NDArray[np.float64]]) -> list[NDArray[np.float64]]:
        """Return the Dirichlet values at the end of the step to try.

        Args:
            totals: Those at full load, or on a path those that it has set for this step, for each
                field.
        """
        if self.path:
            return totals
        t = self.control.target
        return [base + (total - base) * t for base, total in zip(self.base, totals, strict=True)]

    def require(
        self,
        control: Control,
        path: bool,
        goal: float | None,
        end: float | None = None,
        adaptivity: Adaptivity | None = None,
    ) -> None:
        """Raise an error unless this run has such steps, and such a path, control or end."""
        adapt = None if adaptivity is None else adaptivity.tolerance
        asked = control.asked, path, goal, end, adapt
        if asked != (self.control.asked, self.path, self.goal, self.end, self.adapt):
            kind = "update=..." if self.path else "no path (update=None)"
            if self.goal is not None:
                kind = f"displacement control to {self.goal:g}"
            if self.adapt is not None:
                kind += f" and adapt={self.adapt:g}"
            raise MPMError(
                f"The checkpoint was made in a run of {self.control!s} with {kind}; "
                "go on with these, or restore it with resume=False to begin a new run."
            )

    @property
    def adapt(self) -> float | None:
        """The error that is allowed, ``None`` where no nodes are freed."""
        return None if self.adaptivity is None else self.adaptivity.tolerance

    def numbers(self) -> dict[str, Any]:
        """Return all but the Dirichlet values, for a checkpoint."""
        return {
            "control": dict(vars(self.control)),
            "path": self.path,
            "start": self.start,
            "goal": self.goal,
            "began": self.began,
            "end": self.end,
            "held": self.held,
            "adapt": self.adapt,
        }

    @classmethod
    def of(
        cls,
        numbers: dict[str, Any],
        base: list[NDArray[np.float64]],
        make: Callable[[dict[str, Any]], Control],
    ) -> Self:
        """Return the run that gave these numbers.

        Args:
            numbers: What :meth:`numbers` returned.
            base: The Dirichlet values, for each field.
            make: Makes the control of its attributes.
        """
        adapt = numbers["adapt"]
        return cls(
            make(numbers["control"]),
            base=base,
            adaptivity=None if adapt is None else Adaptivity(adapt),
            **{name: numbers[name] for name in ("path", "start", "goal", "began", "end", "held")},
        )


@dataclass
class Progress:
    """How far a problem is.

    Attributes:
        converged: The last converged step.
        experience: What earlier steps have taught about predictions.
        run: The run that is going on, ``None`` between runs.
    """

    converged: Converged
    experience: tuple[float, int]
    run: Run | None
