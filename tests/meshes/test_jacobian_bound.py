# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Folding is found wherever it is in a domain."""

import numpy as np
import pytest
import scenes
from scenes import HEXAHEDRON, QUADRILATERAL, TETRAHEDRON, TRIANGLE, box, vectors

import basix
import basix.ufl

import mpm_dolfinx as mpm
from mpm_dolfinx.meshes.jacobian_bound import JacobianBound, _halves


@pytest.mark.parametrize(
    ("degree", "cell"),
    [
        pytest.param(3, HEXAHEDRON, marks=pytest.mark.slow)
        if (d, cell) == (3, HEXAHEDRON)
        else (d, cell)
        for d in (1, 2, 3)
        for cell in (TRIANGLE, QUADRILATERAL, TETRAHEDRON, HEXAHEDRON)
    ],
)
def test_folding_is_never_missed(cell, degree):
    kind = getattr(basix.CellType, cell.name)
    element = basix.ufl.element("Lagrange", cell.name, degree).basix_element
    bound = JacobianBound(kind, element)
    corners = basix.geometry(kind)
    volumes = [abs(np.linalg.det(axes)) for _, axes in _halves(kind, corners)]
    assert np.isclose(sum(volumes), 1.0)
    rng = np.random.default_rng(3)
    size = rng.uniform(0.0, 0.3 / degree, 60)
    nodes = element.points + size[:, None, None] * rng.standard_normal((60, *element.points.shape))
    sample = rng.uniform(size=(1000, corners.shape[1]))
    if cell in (TRIANGLE, TETRAHEDRON):
        sample = sample[sample.sum(axis=1) <= 1.0]
    slopes = element.tabulate(1, np.vstack([sample, corners]))[1:, :, :, 0]
    least = np.linalg.det(np.einsum("jqk,nki->nqij", slopes, nodes)).min(axis=1)
    folded = bound.vanishes(nodes, np.ones(60))
    assert np.all(folded[least <= 0.0])
    assert not np.any(folded[least > 0.2])
    assert 0 < folded.sum() < 60 or degree == 1
    lower = bound.lower_bound(nodes, np.ones(60))
    assert np.all(lower <= least + 1e-12)


def test_folded_domain_between_good_points():
    # The middle of an edge is pushed past the opposite one: det F stays positive at the points.
    V = vectors(box([-1.0, -1.0], [2.0, 2.0], [3, 3], QUADRILATERAL), 2)
    particles = mpm.Particles(scenes.unit(1, QUADRILATERAL), V, degree=2)
    assert len(particles.folded()) == 0
    assert np.allclose(particles.domain_distortion(), 1.0)

    def push(X):
        edge = np.isclose(X[:, 1], 0.0) & np.isclose(X[:, 0], 0.5)
        return np.column_stack([np.zeros(len(X)), np.where(edge, 0.4, 0.0)])

    scenes.move(particles, push)
    assert len(scenes.gather(particles.inverted())) == 0
    assert len(scenes.gather(particles.folded())) == 1
    assert scenes.gather(particles.domain_distortion()).min() < 0.0
