# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a run did: steps, counters and seconds per phase."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

__all__ = ["History", "Statistics", "Step"]

PHASES = ("locate", "transfer", "constitutive", "assemble", "factorise", "solve", "commit")


class Statistics(dict[str, float]):
    """Counters of a run, and its seconds per phase in ``seconds``.

    Attributes:
        seconds: Seconds of this rank in each phase: locate, transfer, constitutive, assemble,
            factorise, solve, commit. Phases do not overlap.
    """

    def __init__(self) -> None:
        super().__init__()
        self.seconds: dict[str, float] = dict.fromkeys(PHASES, 0.0)
        self._running: list[str] = []
        self._since = 0.0

    def count(self, name: str, by: float = 1) -> None:
        """Add to a counter."""
        self[name] = self.get(name, 0) + by

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Account the block's seconds to a phase, and not to the phase around it."""
        self._switch()
        self._running.append(name)
        try:
            yield
        finally:
            self._switch()
            self._running.pop()

    def _switch(self) -> None:
        now = time.perf_counter()
        if self._running:
            self.seconds[self._running[-1]] += now - self._since
        self._since = now


@dataclass(frozen=True)
class Step:
    """One converged step.

    Attributes:
        load: Load factor (or the parameter t of a path) at its end.
        iterations: Linear solves it took.
        residuals: Relative residual before each of Newton's iterations and at the end.
    """

    load: float
    iterations: int
    residuals: list[float]


@dataclass
class History:
    """The steps of a run; it grows as the run goes on and stays after an error.

    Attributes:
        steps: The converged steps.
        cutbacks: How often a step was halved.
        failed_iterations: Linear solves of attempts that did not converge.
        statistics: Counters and seconds per phase.
    """

    steps: list[Step] = field(default_factory=list)
    cutbacks: int = 0
    failed_iterations: int = 0
    statistics: Statistics = field(default_factory=Statistics)

    @property
    def iterations(self) -> list[int]:
        """Linear solves of each converged step."""
        return [step.iterations for step in self.steps]

    @property
    def load(self) -> list[float]:
        """Load factor at the end of each converged step."""
        return [step.load for step in self.steps]

    @property
    def total_iterations(self) -> int:
        """All linear solves, those of failed attempts too."""
        return sum(self.iterations) + self.failed_iterations
