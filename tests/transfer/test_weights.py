# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""T and the particles' weights, against dense loops and the published closed forms.

The closed forms are those of Sadeghirad, Brannon & Guilkey, Int. J. Numer. Meth. Engng 95
(2013) 928-952: eqs 15 and 16 for the quadrilateral, and their counterparts for the triangle.
"""

import numpy as np
import pytest
import scenes
from scenes import HEXAHEDRON, PLANE, QUADRILATERAL, TETRAHEDRON
from transfer.reference import PAIRS, SOLID, basis_by_loop, local_positions, scene

import mpm_dolfinx as mpm


def dense_weights(particles):
    """Return particles' weights as dense arrays (n, nodes) and (n, nodes, gdim)."""
    offsets, nodes, S, grad_S = particles.weights()
    n, count = particles.num_local, particles.V.dofmap.index_map.size_global
    assert offsets.shape == (n + 1,) and offsets[0] == 0 and offsets[-1] == len(nodes)
    assert nodes.dtype == np.int64
    dense = np.zeros((n, count)), np.zeros((n, count, particles.mesh.geometry.dim))
    for p in range(n):
        mine = slice(offsets[p], offsets[p + 1])
        assert len(set(nodes[mine])) == len(nodes[mine]), "a node comes twice"
        dense[0][p, nodes[mine]] = S[mine]
        dense[1][p, nodes[mine]] = grad_S[mine]
    return dense


def corners_in_turn(particles):
    """Return local node numbers of each domain's corners, counter-clockwise (plane)."""
    nodes = particles.W.dofmap.list[: particles.num_local]
    if nodes.shape[1] == 4:
        nodes = nodes[:, [0, 1, 3, 2]]
    x = local_positions(particles)[nodes]
    clockwise = areas(x) < 0
    return np.where(clockwise[:, None], nodes[:, ::-1], nodes)


def cross(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def areas(x):
    """Return areas of polygons (n, k, 2), by the shoelace formula."""
    return 0.5 * cross(x, np.roll(x, -1, axis=1)).sum(axis=1)


def centroids(x):
    """Return the centres of area of polygons (n, k, 2)."""
    after = np.roll(x, -1, axis=1)
    part = cross(x, after)[..., None]
    return (part * (x + after)).sum(axis=1) / (6 * areas(x)[:, None])


def quadrilateral_weights(x):
    """Return w (n, 4) and the gradients' factors (n, 4, 2) of quadrilaterals."""
    x1, x2, x3, x4 = x.swapaxes(0, 1)
    V = areas(x)
    a = (x4 - x1)[:, 0] * (x2 - x3)[:, 1] - (x2 - x3)[:, 0] * (x4 - x1)[:, 1]
    b = (x3 - x4)[:, 0] * (x1 - x2)[:, 1] - (x1 - x2)[:, 0] * (x3 - x4)[:, 1]
    w = np.stack([6 * V - a - b, 6 * V - a + b, 6 * V + a + b, 6 * V + a - b], axis=1)
    sides = np.stack([x2 - x4, x3 - x1, x4 - x2, x1 - x3], axis=1)
    turned = np.stack([sides[..., 1], -sides[..., 0]], axis=2)
    return w / (24 * V)[:, None], turned / (2 * V)[:, None, None]


def triangle_weights(x):
    """Return w (n, 3) and the gradients' factors (n, 3, 2) of triangles."""
    opposite = np.roll(x, -1, axis=1) - np.roll(x, -2, axis=1)
    turned = np.stack([opposite[..., 1], -opposite[..., 0]], axis=2)
    return np.full(x.shape[:2], 1 / 3), turned / (2 * areas(x))[:, None, None]


@pytest.mark.parametrize("background", PLANE, ids=scenes.name)
@pytest.mark.parametrize("cell", PLANE, ids=scenes.name)
@pytest.mark.parametrize("moved", [False, True])
def test_weights_against_closed_forms(background, cell, moved):
    particles = scene(background, cell, moved)
    S, grad_S = dense_weights(particles)
    nodes = corners_in_turn(particles)
    x = local_positions(particles)
    N = basis_by_loop(particles.V, x)[nodes]
    formula = quadrilateral_weights if cell is QUADRILATERAL else triangle_weights
    w, g = formula(x[nodes])
    np.testing.assert_allclose(S, np.einsum("pc,pci->pi", w, N), atol=1e-13)
    np.testing.assert_allclose(grad_S, np.einsum("pcx,pci->pix", g, N), atol=1e-11)


@pytest.mark.parametrize("background", [TETRAHEDRON, HEXAHEDRON], ids=scenes.name)
def test_weights_of_tetrahedra(background):
    particles = scene(background, TETRAHEDRON)
    S, grad_S = dense_weights(particles)
    x = local_positions(particles)
    nodes = particles.W.dofmap.list[: particles.num_local]
    N = basis_by_loop(particles.V, x)[nodes]
    np.testing.assert_allclose(S, N.mean(axis=1), atol=1e-13)
    rows = np.concatenate([x[nodes], np.ones((*nodes.shape, 1))], axis=2)
    g = np.linalg.inv(rows)[:, :3].swapaxes(1, 2)
    np.testing.assert_allclose(grad_S, np.einsum("pcx,pci->pix", g, N), atol=1e-11)


@pytest.mark.parametrize(("background", "cell"), [*PAIRS, *SOLID], ids=scenes.name)
def test_sums_of_weights(background, cell):
    particles = scene(background, cell)
    dim = particles.mesh.geometry.dim
    S, grad_S = dense_weights(particles)
    nodes = scenes.coordinates(particles.V)
    np.testing.assert_allclose(S.sum(axis=1), 1.0, atol=1e-13)
    np.testing.assert_allclose(grad_S.sum(axis=1), 0.0, atol=1e-11)
    gradients = np.einsum("pix,iy->pyx", grad_S, nodes)
    np.testing.assert_allclose(gradients, np.tile(np.eye(dim), (len(S), 1, 1)), atol=1e-11)
    if dim == 2:
        centres = centroids(local_positions(particles)[corners_in_turn(particles)])
        np.testing.assert_allclose(S @ nodes, centres, atol=1e-13)


@pytest.mark.parametrize(
    ("background", "cell", "same"),
    [
        *[(b, c, True) for b, c in PAIRS],
        (HEXAHEDRON, TETRAHEDRON, True),
        (HEXAHEDRON, HEXAHEDRON, False),
    ],
    ids=scenes.name,
)
def test_increment_of_F_by_published_gradients(background, cell, same):
    # F = (I + sum_i u_i grad S_ip) F_n: exact but for distorted hexahedra, where the published
    # gradient is the mean over the domain and that of the body mesh the one at its centre.
    particles = scene(background, cell)
    dim = particles.mesh.geometry.dim
    _, grad_S = dense_weights(particles)
    F_n = particles.deformation_gradient[:, :dim, :dim]
    u = np.random.default_rng(4).normal(size=(len(scenes.coordinates(particles.V)), dim)) * 0.1
    first, last = particles.V.dofmap.index_map.local_range
    scenes.own(particles.increment)[:] = u[first:last].ravel()
    result = particles.T.createVecLeft()
    particles.T.mult(particles.increment.x.petsc_vec, result)
    scenes.own(particles.displacement)[:] += result.array_r
    particles.displacement.x.scatter_forward()
    F = particles.deformation_gradient[:, :dim, :dim]
    published = (np.eye(dim) + np.einsum("ix,piy->pxy", u, grad_S)) @ F_n
    gap = scenes.largest(F - published)
    assert gap < 1e-12 if same else 1e-6 < gap < 0.1


def test_weights_of_domains_on_nodes_of_the_background():
    V = scenes.vectors(scenes.unit(4, QUADRILATERAL))
    particles = mpm.Particles(scenes.unit(4, QUADRILATERAL), V)
    offsets, _, S, grad_S = particles.weights()
    assert (np.diff(offsets) == 4).all()  # its own corners, nothing that is zero
    np.testing.assert_allclose(S, 0.25, atol=1e-14)
    np.testing.assert_allclose(np.abs(grad_S), 2.0, atol=1e-12)
