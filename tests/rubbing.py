# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Coulomb's law by NumPy, for real and complex positions: what compiled loops are compared with."""

import numpy as np


def traction(law, points, at):
    """Return pressure, shear, which points touch, and which slip."""
    gap, n, delta, touch, behind, p = at
    k = points.stiffness
    if p is None:
        p = -k * gap
        acts = gap.real <= touch
        if behind is not None:
            p = p + (n * behind).sum(axis=1)
            acts = p.real >= -k * touch
        p = np.where(acts, p, 0.0)
    inside = (gap.real <= touch) | (p.real != 0.0)
    came = ~points.touched & (points.gap > 10.0 * touch)
    pressed = came & (gap.real < 0.0)
    share = -gap / np.where(pressed, points.gap - gap, 1.0)
    share = np.where(pressed, share, np.where(came, 0.0, 1.0))
    along = delta - n * (n * delta).sum(axis=1)[:, None]
    tried = -(points.tangential * share * inside)[:, None] * along
    size = np.sqrt((tried * tried).sum(axis=1))
    bound = law.friction * np.where(p.real > 0.0, p, 0.0) + law.cohesion * points.stretch
    limit = law.limit * points.stretch
    bound = np.where(bound.real < limit, bound, limit)
    slips = inside & (size.real > bound.real + points.tangential * touch) & (not law.smooth)
    factor = np.where(slips, bound / np.where(slips, size, 1.0), 0.0 if law.smooth else 1.0)
    return p, factor[:, None] * tried, inside, slips
