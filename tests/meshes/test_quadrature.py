# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What rules of quadrature make of values at nodes, against plain linear algebra."""

import numpy as np
import pytest

from mpm_dolfinx.meshes.quadrature import volume_ratio, with_hoop


@pytest.mark.parametrize("dim", [2, 3])
def test_volume_ratio_is_the_determinant(dim):
    H = np.random.default_rng(dim).uniform(-1.0, 1.0, (7, 3, dim, dim))
    np.testing.assert_allclose(volume_ratio(H), np.linalg.det(np.eye(dim) + H), atol=1e-14)
    assert volume_ratio(np.full((1, dim, dim), np.nan)).shape == (1,)


def test_hoop_strains_stand_beside_those_in_the_plane():
    rng = np.random.default_rng(5)
    gradient, hoop, nodal = rng.random((4, 2, 2, 2)), rng.random((4, 2, 3)), rng.random((4, 3, 2))
    whole = with_hoop(gradient, hoop, nodal)
    assert np.array_equal(whole[:, :, :2, :2], gradient)
    around = [[hoop[n, q] @ nodal[n, :, 0] for q in range(2)] for n in range(4)]
    np.testing.assert_allclose(whole[:, :, 2, 2], around, rtol=1e-14)
    assert not whole[:, :, 2, :2].any() and not whole[:, :, :2, 2].any()
