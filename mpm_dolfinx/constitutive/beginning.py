# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Points that begin unstrained, with a stress, or where other materials had come to."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import agree
from .governed import Carried
from .points import MaterialPoints
from .succession import Episode, states_after

__all__ = ["begin_unstrained", "begin_with_stress", "take_over"]


def begin_unstrained(points: MaterialPoints) -> None:
    """Let the points, which have not moved, be as they were made (collective)."""
    points.begin_at(None)
    points.go_from(points.initial_states())
    if points.averaging is not None:
        points.averaging.uneven[:] = 0.0


def begin_with_stress(points: MaterialPoints, cauchy_stress: NDArray[np.float64]) -> None:
    """Let the points, which have not moved, carry a stress (collective).

    Args:
        points: The points.
        cauchy_stress: Shape ``(n, nq, 3, 3)``.

    Raises:
        MPMError: A material cannot bear it; ``particles`` are global indices.
    """
    stress = cauchy_stress.reshape(-1, 3, 3)
    carried = Carried(stress, np.zeros((len(stress), points.dim, points.dim)))
    if points.mean_stress is not None:
        points.mean_stress.begin_with(np.trace(stress, axis1=1, axis2=2) / 3.0)
    if points.averaging is not None:
        points.averaging.begin_with(cauchy_stress)
    points.begin_at(stress)
    with agree(points.strain.particles.mesh.comm):
        states = [
            p.stressed_state(np.arange(len(p.points)), carried, {}) for p in points.laws.governed
        ]
    points.settle(states)


def take_over(points: MaterialPoints, before: MaterialPoints) -> None:
    """Go on from the last converged step of the same points with other materials (collective).

    See :func:`states_after`. Strength is divided by what it was divided by.

    Args:
        points: The points.
        before: Those of before, on the same mesh.

    Raises:
        MPMError: A material cannot bear its stress; ``particles`` are global indices.
    """
    if before.laws.weakening != points.laws.weakening:
        points.laws.weaken(before.laws.weakening)
    gradient, unchanged = points.strain.gradient(), np.ones(points.laws.num_points, dtype=bool)
    if points.averaging is not None and before.averaging is not None:
        gradient = points.averaging.average(gradient)
        points.averaging.uneven[:] = before.averaging.uneven
        same = points.averaging.groups.same(before.averaging.groups)
        unchanged = np.repeat(same, points.strain.particles.num_points)
    gap = None
    if points.mean_stress is not None and before.mean_stress is not None:
        points.mean_stress.begin_with(before.mean_stress.values)
        gap = before.mean_stress.gap
    gradient = gradient.reshape(-1, points.dim, points.dim)
    stress = before.last.cauchy_stress(gradient).reshape(-1, 3, 3)
    carried = Carried(stress, gradient, gap)
    points.begin_at(before.last.begun)
    if points.softening is not None and before.last.average is not None:
        points.remember(before.last.average, before.last.growth)
    known = zip(before.laws.given, before.laws.governed, before.last.states, strict=True)
    episodes = [Episode(*one) for one in known]
    now = list(zip(points.laws.given, points.present(), strict=True))
    points.settle(
        states_after(episodes, now, carried, unchanged, points.strain.particles.mesh.comm)
    )
