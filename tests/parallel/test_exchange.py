# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Rows of arrays find the ranks that ask for them."""

import numpy as np
from scenes import WORLD

from mpm_dolfinx.parallel.exchange import RowExchange, swap


def test_rows_find_the_ranks_that_want_them():
    dice = np.random.default_rng(5)
    number = 1000
    order, home = dice.permutation(number), dice.integers(0, WORLD.size, number)
    have = order[home[order] == WORLD.rank]
    have = have[have % 7 != 3]
    want = dice.integers(0, number, 50 * (WORLD.rank + 1)) if WORLD.rank != 1 else have[:0]
    exchange = RowExchange(WORLD, have, want)
    assert np.array_equal(exchange.found, want % 7 != 3)
    for values in (have.astype(float), np.stack([have, -have], axis=1)):
        rows = exchange(values)
        assert rows.dtype == values.dtype and rows.shape == (len(want), *values.shape[1:])
        expected = np.where(want % 7 != 3, want, 0)
        assert np.array_equal(rows if rows.ndim == 1 else rows[:, 0], expected)


def test_parts_go_to_the_ranks_that_they_are_for():
    parts = [np.full((to + 1, 2), 10 * WORLD.rank + to) for to in range(WORLD.size)]
    received = swap(WORLD, parts)
    assert len(received) == WORLD.size
    for sender, part in enumerate(received):
        assert np.array_equal(part, np.full((WORLD.rank + 1, 2), 10 * sender + WORLD.rank))
    # (what is sent may change then)
    parts[WORLD.rank][:] = -1
    assert received[WORLD.rank].min() >= 0
