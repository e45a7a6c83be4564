# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Even shares of a count."""

import numpy as np
import pytest
from scenes import WORLD

from mpm_dolfinx.parallel.balance import even, imbalance


@pytest.mark.parametrize("slack", [0.0, 0.1])
def test_no_rank_has_more_than_its_share(slack):
    dice = np.random.default_rng(WORLD.rank)
    homes = np.minimum(dice.integers(0, 2 * WORLD.size, 200 + WORLD.rank), WORLD.size - 1)
    ranks = even(WORLD, homes, slack)
    counts = WORLD.allreduce(np.bincount(ranks, minlength=WORLD.size))
    total = WORLD.allreduce(len(homes))
    most = np.ceil((1.0 + slack) * total / WORLD.size)
    assert counts.sum() == total and counts.max() <= most
    # Who has room keeps its own; who has not keeps as many as it may.
    wanted = WORLD.allreduce(np.bincount(homes, minlength=WORLD.size))
    kept = WORLD.allreduce(np.bincount(homes[ranks == homes], minlength=WORLD.size))
    assert np.array_equal(kept, np.minimum(wanted, most))


def test_imbalance():
    assert imbalance(WORLD, 3) == 1.0
    assert imbalance(WORLD, 4 if WORLD.rank == 0 else 0) == WORLD.size
    assert imbalance(WORLD, 0) == 0.0


def test_one_item_is_as_uneven_as_there_are_ranks():
    assert imbalance(WORLD, int(WORLD.rank == 0)) == WORLD.size
