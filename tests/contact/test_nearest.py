# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The facet that is nearest to a point."""

import numpy as np
import pytest

from mpm_dolfinx.contact.nearest import FacetTree


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
