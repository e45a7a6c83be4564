# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Time schemes as users write them."""

import numpy as np

import mpm_dolfinx as mpm


class BDF2(mpm.Scheme):
    """Backward differences of second order, for any steps; the first one is backward Euler's."""

    name = "bdf2"
    keeps = ("increment", "change of velocity")

    def rates(self, dt, last):
        ratio = dt / last if last > 0.0 else 0.0
        now, before = (1 + 2 * ratio) / (1 + ratio) / dt, ratio**2 / (1 + ratio) / dt
        increment, begin, last_increment, last_change = np.eye(4)
        velocity = now * increment - before * last_increment
        change = velocity - begin
        acceleration = now * change - before * last_change
        return mpm.Rates(acceleration, velocity, velocity, (increment, change))


class Theta(mpm.Scheme):
    """From the midpoint rule (0.5) to backward Euler (1)."""

    name = "theta"

    def __init__(self, share):
        super().__init__()
        self.share = share

    def rates(self, dt, last):
        mean, begin = np.array([1.0 / dt, 0.0]), np.array([0.0, 1.0])
        velocity = (mean - (1.0 - self.share) * begin) / self.share
        return mpm.Rates((velocity - begin) / dt, mean, velocity)
