# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The account of a motion's energies."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ..history import Energy

__all__ = ["Account"]

#: What is summed over steps: attributes of Energy.
TOTALS = (
    "internal", "external", "lost", "damping", "stabilisation", "prescribed", "residual",
)  # fmt: skip
#: Those among them that are given to the bodies.
GIVEN = ("external", "prescribed")


class Account:
    """Kinetic energy, and works summed over the steps.

    Args:
        entries: Where it is kept, one entry for the beginning and for each step.

    Attributes:
        kinetic: Kinetic energy at the last converged step.
    """

    def __init__(self, entries: list[Energy]) -> None:
        self._entries = entries
        self.kinetic = 0.0
        self._totals = np.zeros(len(TOTALS))
        self._stress_work = 0.0
        self._strain = math.nan  # at the beginning

    def begin(self, time: float, kinetic: float, strain: float) -> None:
        """Add the entry of the beginning, unless there is one."""
        if not self._entries:
            self.kinetic, self._strain = kinetic, strain
            self.note(time, strain)

    def remesh(self, kinetic: float) -> None:
        """Book as lost how other meshes or domains change the kinetic energy between steps."""
        if self._entries:
            self._totals[TOTALS.index("lost")] += self.kinetic - kinetic
        self.kinetic = kinetic

    def book(self, works: Mapping[str, float], kinetic: float, stress_work: float) -> None:
        """Book a step.

        Args:
            works: By the names of :class:`Energy`.
            kinetic: Kinetic energy at its end.
            stress_work: Work done in it against stress.
        """
        self._totals += [works[name] for name in TOTALS]
        self._stress_work += stress_work
        self.kinetic = kinetic

    def missing(self, works: Mapping[str, float], kinetic: float) -> float:
        """Return the work of a step less what it used and the change of kinetic energy."""
        used = sum(work for name, work in works.items() if name not in GIVEN)
        given = sum(works[name] for name in GIVEN)
        return given - used - (kinetic - self.kinetic)

    def note(self, time: float, strain: float) -> None:
        """Add an entry of the last converged step, with the elastic energy at its end."""
        sums = {name: float(total) for name, total in zip(TOTALS, self._totals, strict=True)}
        dissipated = self._stress_work - (strain - self._strain)
        self._entries.append(
            Energy(time, self.kinetic, strain=strain, dissipated=dissipated, **sums)
        )

    def undo(self) -> Callable[[], None]:
        """Return a function that takes back all that is booked from now on."""
        before = self.kinetic, self._stress_work, self._totals.copy()
        entries = len(self._entries)

        def undo() -> None:
            self.kinetic, self._stress_work, self._totals = before
            del self._entries[entries:]

        return undo

    def numbers(self) -> dict[str, Any]:
        """Return the account for a checkpoint."""
        return {
            "energies": [list(vars(energy).values()) for energy in self._entries],
            "totals": self._totals.tolist(),
            "stress": [self.kinetic, self._stress_work, self._strain],
        }

    def restore(self, numbers: Mapping[str, Any]) -> None:
        """Take over what :meth:`numbers` returned."""
        self._entries[:] = [Energy(*entries) for entries in numbers["energies"]]
        self._totals = np.array(numbers["totals"], dtype=np.float64)
        self.kinetic, self._stress_work, self._strain = numbers["stress"]
