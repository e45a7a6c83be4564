# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Water at rest in the ground, or beside it, below a given level."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import ufl

from ..errors import MPMError
from ..parallel.given import is_number
from ..parallel.kinds import explaining
from ..reals import as_finite, holds_ufl

__all__ = ["WaterTable"]

type Array = NDArray[np.float64]


@explaining
@dataclass(frozen=True)
class WaterTable:
    """The pore pressure of water below a level: its weight times the depth below it.

    For ``pore_pressure=`` of a :class:`Body`, and for ``water=`` of :func:`geostatic`. Above the
    level there is none, and no suction. Where the level is above the ground, open water stands
    on it.

    Args:
        level: Height of the level along the last axis; or points ``[(x, height), ...]`` of it in
            ascending order of ``x[0]``, straight in between and level beyond; or a function of
            coordinates that returns it by arithmetic, which takes UFL and NumPy alike:
            ``lambda x: 8.0 - 0.2 * x[0]``.
        weight: Weight of water, force per volume.

    Raises:
        MPMError: Numbers that make no sense.
    """

    level: float | Sequence[tuple[float, float]] | Callable[[Any], Any]
    weight: float

    def __post_init__(self) -> None:
        """Say so where something makes no sense."""
        points = isinstance(self.level, list | tuple | np.ndarray)
        numbers: list[Any] = [self.weight, *([] if points or self._function else [self.level])]
        if not all(is_number(n) and np.isfinite(n) for n in numbers):
            raise MPMError(
                "WaterTable needs a finite level, points (x, height) or a function of it, and a "
                "weight."
            )
        if not self.weight > 0.0:
            raise MPMError(f"The weight of water must be positive, not {self.weight:g}.")
        if points:
            corners = as_finite(self.level, None, 2)
            if corners is None or (np.diff(corners[:, 0]) <= 0.0).any():
                raise MPMError(
                    "The points of a WaterTable's level must be pairs (x, height) of finite "
                    f"numbers, each x larger than the one before, not {self.level!r}."
                )
            object.__setattr__(self, "level", tuple(map(tuple, corners.tolist())))

    def level_at(self, x: Any) -> Any:
        """Return the level at coordinates, UFL or arrays."""
        if self._function is not None:
            return self._function(x)
        if is_number(self.level):
            return self.level
        # the sum of what the slope changes by at each point takes UFL and arrays alike
        points: Any = self.level
        along, heights = np.transpose(points)
        changes = np.diff(np.diff(heights) / np.diff(along), prepend=0.0, append=0.0)
        beyond = [(x[0] - a + abs(x[0] - a)) / 2 for a in map(float, along)]
        bends = zip(changes, beyond, strict=True)
        return sum((float(c) * b for c, b in bends), float(heights[0]))

    @property
    def _function(self) -> Callable[[Any], Any] | None:
        """The function of the level, if it is one; UFL can be called too."""
        return self.level if callable(self.level) and not holds_ufl(self.level) else None

    def __call__(self, x: Any) -> Any:
        """Return the pore pressure at coordinates, in UFL.

        Raises:
            MPMError: The function of the level returns no level.
        """
        level = self.level_at(x)
        if not (holds_ufl(level) or (is_number(level) and np.isfinite(level))):
            raise MPMError(
                "The level of a WaterTable must be a finite number, or UFL by arithmetic with the "
                f"coordinates, not {level!r}."
            )
        below = level - x[len(x) - 1]
        return ufl.conditional(ufl.gt(below, 0.0), self.weight * below, 0.0)

    def on(self, height: Any, x: Array) -> Array:
        """Return the pressure of water at heights above places ``x``, shape ``(3, n)``."""
        return np.asarray(self.weight * np.maximum(self.level_at(x) - height, 0.0))
