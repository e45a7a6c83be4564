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
from ..parallel.given import is_number
from ..reals import holds_ufl

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
        numbers: list[Any] = [self.weight, *([] if self._function else [self.level])]
        if not all(is_number(n) and np.isfinite(n) for n in numbers):
            raise MPMError("WaterTable needs a finite level, or a function of it, and a weight.")
        if not self.weight > 0.0:
            raise MPMError(f"The weight of water must be positive, not {self.weight:g}.")

    def level_at(self, x: Any) -> Any:
        """Return the level at coordinates, UFL or arrays."""
        return self._function(x) if self._function else self.level

    @property
    def _function(self) -> Callable[[Any], Any] | None:
        """The function of the level, if it is one; UFL can be called too."""
        return self.level if callable(self.level) and not holds_ufl(self.level) else None

    def __call__(self, domain: mesh.Mesh) -> Any:
        """Return the pore pressure on a mesh, in UFL.

        Raises:
            MPMError: The function of the level returns no level.
        """
        x = ufl.SpatialCoordinate(domain)
        level = self.level_at(x)
        if not (holds_ufl(level) or (is_number(level) and np.isfinite(level))):
            raise MPMError(
                "The level of a WaterTable must be a finite number, or UFL by arithmetic with the "
                f"coordinates, not {level!r}."
            )
        below = level - x[domain.geometry.dim - 1]
        return ufl.conditional(ufl.gt(below, 0.0), self.weight * below, 0.0)

    def on(self, height: Any, x: Array) -> Array:
        """Return the pressure of water at heights above places ``x``, shape ``(3, n)``."""
        return np.asarray(self.weight * np.maximum(self.level_at(x) - height, 0.0))
