# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The order in which neighbours come one after the other."""

import numpy as np
import pytest

from mpm_dolfinx.meshes.order import morton_order


@pytest.mark.parametrize("dim", [2, 3])
def test_boxes_come_one_after_the_other(dim):
    lines = np.meshgrid(*[np.arange(8.0) - 3.0] * dim, indexing="ij")
    points = np.stack([line.ravel() for line in lines], axis=1)
    points = points[np.random.default_rng(0).permutation(len(points))]
    order = morton_order(points)
    assert np.array_equal(np.sort(order), np.arange(8**dim))
    for size in (2, 4):
        boxes = points[order].reshape(-1, size**dim, dim)
        assert np.all(np.ptp(boxes, axis=1) == size - 1)


def test_points_in_one_place_keep_their_order():
    assert morton_order(np.ones((3, 2))).tolist() == [0, 1, 2]
    assert len(morton_order(np.zeros((0, 3)))) == 0
