# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Laws that soften by an average of their plastic strain over a length."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError
from ..materials.base import State
from .assignment import Assignment
from .governed import Governed
from .gradient_average import GradientAverage
from .strain import Strain

__all__ = ["SofteningAverage", "softened"]

type Array = NDArray[np.float64]


def softened(part: Governed, average: Array | None) -> Governed:
    """Return a material at its points with an average, where that softens it.

    Args:
        part: The material.
        average: At all points of this rank, shape ``(n nq,)``, or ``None``.
    """
    if average is None or not part.material.softens:
        return part
    own = average[part.points]
    return replace(part, material=part.material.softening_by(own), law=part.law.softening_by(own))


class SofteningAverage:
    """The average by which laws soften, found in turn with the displacements (collective).

    Args:
        strain: What the points of the body are strained in.
        laws: The materials at them.
        length: What the average is over.

    Attributes:
        length: As given.
        values: That of the present update, at all points, shape ``(n nq,)``.

    Raises:
        MPMError: No law softens, one does as no average can make it, or domains do not share their
            nodes.
    """

    def __init__(self, strain: Strain, laws: Assignment, length: float) -> None:
        self._laws, self.length = laws, length
        counts = np.zeros(laws.num_points, dtype=bool)
        for part in laws.governed:
            counts[part.points] = part.material.softens
        if not any(part.material.softens for part in laws.governed):
            names = ", ".join(type(law).__name__ for law in laws.given)
            raise MPMError(
                "length= is for laws that soften with their plastic strain (with_softening), which "
                f"{names} does not; omit it, or give the law a residual strength and decay."
            )
        for law in laws.given:
            law.softening_by(np.zeros(1))  # which may be refused
        self._over = GradientAverage(strain, length, laws.by_domain(counts).any(axis=1))
        self.values = np.zeros(laws.num_points)
        self._turns = 0

    def of(self, states: list[State]) -> Array:
        """Return the average of the plastic strain of states, shape ``(n nq,)`` (collective)."""
        values = np.zeros(self._laws.num_points)
        for part, state in zip(self._laws.governed, states, strict=True):
            if part.material.softens:
                values[part.points] = state["plastic_strain"]
        return self._over.of(self._laws.by_domain(values)).ravel()

    def begin(self, values: Array) -> None:
        """Let updates have the average of a converged step."""
        self.values, self._turns = values, 0

    def expect(self, values: Array) -> None:
        """Let updates begin with an average that is expected at the end of a step."""
        self.values = values

    def alternate(self, states: list[State]) -> int:
        """Average the plastic strain of the last update for the next one (collective).

        Each second time it goes twice as far: what converges slowly changes by little each time and
        in one direction, so that this halves the number of alternations, and what grows goes on
        to.

        Args:
            states: Of the last update.

        Returns:
            The linear solves that it took.
        """
        self._turns += 1
        ahead = 2.0 if self._turns % 2 == 0 else 1.0
        self.values = self.values + ahead * (self.of(states) - self.values)
        return 1
