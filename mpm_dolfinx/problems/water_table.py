# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Water at rest in the ground, or beside it, below a given level."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import mesh

from ..errors import MPMError

__all__ = ["WaterTable"]

type Array = NDArray[np.float64]


@dataclass(frozen=True)
class WaterTable:
    """The pore pressure of water below a level: its weight times the depth below it.

    For ``pore_pressure=`` of a :class:`Body`, and for ``water=`` of :func:`geostatic`. Above the
    level there is none, and no suction. Where the level is above the ground, open water stands
    on it.

    Args:
        level: Height of the level along the last axis, or a function of coordinates that returns it
            by arithmetic, which takes UFL and NumPy alike: ``lambda x: 8.0 - 0.2 * x[0]``.
        weight: Weight of water, force per volume.

    Raises:
        MPMError: Numbers that make no sense.
    """

    level: float | Callable[[Any], Any]
    weight: float

    def __post_init__(self) -> None:
        """Say so where something makes no sense."""
        numbers = [self.weight] if callable(self.level) else [self.weight, self.level]
        if not all(
            isinstance(n, float | int | np.number) and not isinstance(n, bool) and np.isfinite(n)
            for n in numbers
        ):
            raise MPMError("WaterTable needs a finite level, or a function of it, and a weight.")
        if not self.weight > 0.0:
            raise MPMError(f"The weight of water must be positive, not {self.weight:g}.")

    def level_at(self, x: Any) -> Any:
        """Return the level at coordinates, UFL or arrays."""
        return self.level(x) if callable(self.level) else self.level

    def __call__(self, domain: mesh.Mesh) -> Any:
        """Return the pore pressure on a mesh, in UFL."""
        x = ufl.SpatialCoordinate(domain)
        below = self.level_at(x) - x[domain.geometry.dim - 1]
        return ufl.conditional(ufl.gt(below, 0.0), self.weight * below, 0.0)

    def on(self, height: Any, x: Array) -> Array:
        """Return the pressure of water at heights above places ``x``, shape ``(3, n)``."""
        return np.asarray(self.weight * np.maximum(self.level_at(x) - height, 0.0))
