# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Water in a body's pores whose pressure is no unknown: known, in excess of that, or both."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..constitutive.points import MaterialPoints
from ..materials.undrained import EXCESS
from ..meshes.quadrature import quadrature_rule
from ..meshes.values import AtPoints, Value, as_ufl
from ..particles.particles import Particles

__all__ = ["Excess", "PoreWater", "water_in"]

type Array = NDArray[np.float64]


class Excess:
    """The pore pressure that undrained materials have found.

    Args:
        points: The materials.

    Attributes:
        name: Among the fields of the body.
    """

    name = EXCESS

    def __init__(self, points: MaterialPoints) -> None:
        self._points = points

    def at_points(self) -> Array:
        """Return it at the last converged step, shape ``(n, nq)``."""
        return self._points.last.variable(EXCESS)

    def from_nodes(self) -> None:
        """Return nothing: it is known at points."""


class PoreWater:
    """All of the pore pressure of a body.

    Args:
        particles: The body.
        known: The pressure at full load, or ``None``.
        excess: What comes to it, or ``None``.

    Attributes:
        name: Among the fields of the body.
    """

    name = "pore_pressure"

    def __init__(self, particles: Particles, known: Value | None, excess: Excess | None) -> None:
        self._particles, self._excess = particles, excess
        self._known: AtPoints | None = None
        if known is not None:
            body = particles.mesh
            rule, _ = quadrature_rule(body.basix_cell(), particles.geometry.quadrature_degree)
            self._known = AtPoints(as_ufl(known, body, self.name), body, rule)

    def at_points(self) -> Array:
        """Return it at the last converged step, shape ``(n, nq)``."""
        body = self._particles
        found: Array = np.zeros((body.num_local, body.num_points))
        if self._known is not None:
            found += float(body.load.value) * self._known.values()
        return found if self._excess is None else found + self._excess.at_points()

    def from_nodes(self) -> None:
        """Return nothing: it is known at points."""


def water_in(
    particles: Particles, known: Value | None, points: MaterialPoints
) -> list[PoreWater | Excess]:
    """Return the pore pressure of a body and what it has in excess, if it has any (collective).

    Args:
        particles: The body.
        known: A pressure that is given, at full load, or ``None``.
        points: Its materials.
    """
    undrained = any(EXCESS in state for state in points.last.states)
    excess = Excess(points) if undrained else None
    if known is None and excess is None:
        return []
    return [PoreWater(particles, known, excess), *([excess] if excess else [])]
