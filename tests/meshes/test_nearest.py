# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The facet that is nearest to a point."""

from itertools import product

import numpy as np
import pytest
from marks import thinned

from dolfinx.geometry import compute_distance_gjk

from mpm_dolfinx.meshes.nearest import FacetTree


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("beside", [1e-12, 1e-9, 1e-3])
def test_a_point_just_beside_a_corner_is_nearest_to_the_facet_there(size, beside):
    x = np.linspace(0.0, 1.0, 11)
    line = np.stack([x, np.zeros(11)], axis=1)
    tree = FacetTree(size * np.stack([line[:-1], line[1:]], axis=1))
    points = size * np.stack([x[1:-1] + beside, np.zeros(9)], axis=1)
    for _ in range(2):  # with hints of the call before, too
        found = tree(points)
        assert np.array_equal(found.facet, np.arange(1, 10))
        assert np.array_equal(tree(points - (2.0 * size * beside, 0.0)).facet, np.arange(9))
    # Among equals it is the first.
    assert np.array_equal(tree(size * line[1:-1]).facet, np.arange(9))


@pytest.mark.parametrize(("dim", "size"), thinned(4, product([2, 3], [1e-9, 1.0, 1e9])))
def test_the_way_to_the_nearest_place_is_the_shortest_of_all(dim, size):
    random = np.random.default_rng(3)
    corners, points = random.random((30, dim, dim)), 2.0 * random.random((100, dim)) - 0.5
    facets, ways = FacetTree(size * corners).ways(size * points)
    found = ways / size
    padding = ((0, 0), (0, 3 - dim))
    for point, facet, way in zip(points, facets, found, strict=True):
        shortest = [
            compute_distance_gjk(np.pad(one, padding), np.pad(point[None], padding))[:dim]
            for one in corners
        ]
        assert np.allclose(way, shortest[facet], rtol=0.0, atol=1e-6)
        least = min(np.linalg.norm(one) for one in shortest)
        assert np.isclose(np.linalg.norm(way), least, rtol=0.0, atol=1e-6)
