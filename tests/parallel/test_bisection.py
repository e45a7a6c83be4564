# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Compact parts of equal size, wherever the points are."""

import numpy as np
import pytest
from scenes import WORLD

from mpm_dolfinx.parallel.bisection import bisect


def spread(points, seed=3):
    """Return this rank's points, dealt out at random, and their numbers."""
    home = np.random.default_rng(seed).integers(0, WORLD.size, len(points))
    mine = np.flatnonzero(home == WORLD.rank)
    return points[mine], mine


def gathered(numbers, parts):
    order = np.argsort(np.concatenate(WORLD.allgather(numbers)))
    return np.concatenate(WORLD.allgather(parts))[order]


@pytest.mark.parametrize("parts", [1, 2, 3, 5, 8])
@pytest.mark.parametrize("gdim", [2, 3])
def test_parts_are_even_boxes(parts, gdim):
    points = np.random.default_rng(parts).normal(size=(1000, gdim)) * [1.0, 3.0, 0.5][:gdim]
    own, numbers = spread(points)
    found = gathered(numbers, bisect(WORLD, own, parts))
    counts = np.bincount(found, minlength=parts)
    assert len(counts) == parts and np.ptp(counts) <= np.ceil(np.log2(parts))
    # Boxes that overlap by no more than the slope of the cuts.
    boxes = [points[found == i] for i in range(parts)]
    span = np.ptp(points, axis=0).max()
    for i, one in enumerate(boxes):
        for other in boxes[:i]:
            gap = np.maximum(
                one.min(axis=0) - other.max(axis=0), other.min(axis=0) - one.max(axis=0)
            )
            assert gap.max() > -4e-3 * span


def test_parts_do_not_depend_on_who_has_the_points():
    points = np.random.default_rng(1).uniform(size=(500, 2))
    results = []
    for seed in (1, 2):
        own, numbers = spread(points, seed)
        results.append(gathered(numbers, bisect(WORLD, own, 6)))
    none = points if WORLD.rank == WORLD.size - 1 else points[:0]
    results.append(np.concatenate(WORLD.allgather(bisect(WORLD, none, 6))))
    for result in results[1:]:
        assert np.array_equal(result, results[0])


def test_points_of_a_grid_are_divided_evenly():
    # In line with each other, where a cut at right angles cannot divide them.
    x = np.stack(np.meshgrid(np.arange(9.0), np.arange(5.0)), axis=-1).reshape(-1, 2)
    own, numbers = spread(x)
    for parts in (2, 4, 7):
        counts = np.bincount(gathered(numbers, bisect(WORLD, own, parts)), minlength=parts)
        assert np.ptp(counts) <= np.ceil(np.log2(parts))


def test_a_cut_is_across_the_longest_edge():
    x = np.stack(np.meshgrid(np.arange(40.0), np.arange(10.0)), axis=-1).reshape(-1, 2)
    own, numbers = spread(x)
    found = gathered(numbers, bisect(WORLD, own, 4))
    assert np.array_equal(found, (x[:, 0] // 10).astype(int))


@pytest.mark.parametrize("count", [0, 1, 2])
def test_fewer_points_than_parts(count):
    own, numbers = spread(np.arange(2.0 * count).reshape(count, 2))
    found = gathered(numbers, bisect(WORLD, own, 5))
    assert len(np.unique(found)) == count
    assert np.all((found >= 0) & (found < 5))
    same = bisect(WORLD, np.zeros((3, 2)), 4)
    assert np.all((same >= 0) & (same < 4))
