# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What rules of quadrature make of values at nodes, against plain linear algebra."""

import numpy as np
import pytest
import scenes
from scenes import QUADRILATERAL

import basix

from mpm_dolfinx.meshes.quadrature import DomainQuadrature, volume_ratio, with_hoop


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


@pytest.mark.parametrize("unit", [1e-15, 1.0, 1e15])
@pytest.mark.parametrize("height", [1.0, 1e-9])
def test_a_domain_is_flat_in_no_unit_unless_it_has_no_volume(unit, height):
    body = scenes.box([0.0, 0.0], [1.0, 1.0], [3, 2], QUADRILATERAL)
    body.geometry.x[:] *= unit * np.array([1.0, height, 1.0])
    rule = DomainQuadrature(body, bilinear(), 2)
    assert not rule.flat.any()
    whole = scenes.WORLD.allreduce(float(rule.weights.sum()))
    assert whole == pytest.approx(height * unit**2)
    body.geometry.x[:, 1] = 0.0
    assert DomainQuadrature(body, bilinear(), 2).flat.all()


def bilinear():
    return basix.ufl.element("Lagrange", "quadrilateral", 1).basix_element
