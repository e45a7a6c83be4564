# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""T and the particles' weights, against dense loops and the published closed forms.

The closed forms are those of Sadeghirad, Brannon & Guilkey, Int. J. Numer. Meth. Engng 95
(2013) 928-952: eqs 15 and 16 for the quadrilateral, and their counterparts for the triangle.
"""

import numpy as np
import pytest
import scenes
from scenes import ALL, HEXAHEDRON, PLANE, QUADRILATERAL, TETRAHEDRON

from dolfinx import geometry

import mpm_dolfinx as mpm

PAIRS = [(b, c) for b in PLANE for c in PLANE]
SOLID = [(b, c) for b in (TETRAHEDRON, HEXAHEDRON) for c in (TETRAHEDRON, HEXAHEDRON)]


def multilinear(vertices, point):
    """Return the shape functions of one cell at a point, by its own vertices."""
    k, dim = vertices.shape
    if k == dim + 1:  # barycentric coordinates
        return np.linalg.solve(np.vstack([vertices.T, np.ones(k)]), [*point, 1.0])
    # In tensor order; the map's inverse by Newton's method.
    corners = (np.arange(k)[:, None] >> np.arange(dim)) & 1
    xi = np.full(dim, 0.5)
    for _ in range(20):
        factors = np.where(corners, xi, 1 - xi)
        slopes = np.array(
            [
                np.prod(np.delete(factors, j, axis=1), axis=1) * (2 * corners[:, j] - 1)
                for j in range(dim)
            ]
        )
        xi = xi + np.linalg.solve((slopes @ vertices).T, point - factors.prod(axis=1) @ vertices)
    return np.where(corners, xi, 1 - xi).prod(axis=1)


def basis_by_loop(V, points):
    """Return the values of all basis functions at points, searching through all cells."""
    dim = V.mesh.geometry.dim
    count = V.mesh.topology.index_map(dim).size_local
    dofs = V.dofmap.list[:count]
    vertices = scenes.gather(V.tabulate_dof_coordinates()[dofs][:, :, :dim])
    nodes = V.dofmap.index_map.local_to_global(dofs.ravel()).reshape(dofs.shape)
    nodes = scenes.gather(nodes)
    values = np.zeros((len(points), V.dofmap.index_map.size_global))
    boxes = vertices.min(axis=1) - 1e-9, vertices.max(axis=1) + 1e-9
    for row, point in zip(values, points, strict=True):
        near = np.flatnonzero(((point >= boxes[0]) & (point <= boxes[1])).all(axis=1))
        N = [multilinear(vertices[c], point) for c in near]
        best = int(np.argmax([n.min() for n in N]))
        assert N[best].min() > -1e-9
        row[nodes[near[best]]] = N[best]
    return values


def local_positions(particles):
    """Return the present positions of this rank's nodes, ghosts too."""
    dim = particles.mesh.geometry.dim
    d = particles.displacement.x.array.reshape(-1, dim)
    return particles.W.tabulate_dof_coordinates()[:, :dim] + d


def distortion(X):
    """A displacement that no background space holds, but for its size."""
    phase = X @ np.array([5.0, 7.0, 3.0])[: X.shape[1]]
    return 0.02 + 0.04 * np.sin(np.outer(phase, [1.0, 1.3, 0.7][: X.shape[1]]))


def scene(background, cell, moved=True):
    """Return particles, distorted if asked, and their background space."""
    dim = 3 if cell in (TETRAHEDRON, HEXAHEDRON) else 2
    domain = scenes.unit(5 if dim == 2 else 2, background)
    V = scenes.vectors(scenes.bend(domain, 0.04))
    lower, upper = [0.1, 0.15, 0.2][:dim], [0.7, 0.8, 0.7][:dim]
    body = scenes.box(lower, upper, [5, 6] if dim == 2 else [2, 2, 2], cell)
    particles = mpm.Particles(body, V)
    if moved:
        scenes.move(particles, distortion)
    return particles


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


@pytest.mark.parametrize(("background", "cell"), [*PAIRS, *SOLID], ids=scenes.name)
@pytest.mark.parametrize("moved", [False, True])
def test_T_against_loop_over_cells(background, cell, moved):
    particles = scene(background, cell, moved)
    dim = particles.mesh.geometry.dim
    owned = particles.W.dofmap.index_map.size_local
    N = scenes.gather(basis_by_loop(particles.V, local_positions(particles)[:owned]))
    T = scenes.dense(particles.T)
    np.testing.assert_allclose(T, np.kron(N, np.eye(dim)), atol=1e-12)
    # partition of unity and linear reproduction
    np.testing.assert_allclose(T.sum(axis=1), 1.0, atol=1e-12)
    u = (scenes.coordinates(particles.V) @ np.arange(1, dim * dim + 1).reshape(dim, dim)).ravel()
    x = scenes.gather(local_positions(particles)[:owned])
    expected = (x @ np.arange(1, dim * dim + 1).reshape(dim, dim)).ravel()
    np.testing.assert_allclose(T @ u, expected, atol=1e-12)


@pytest.mark.parametrize(("background", "cell"), [*PAIRS, *SOLID[:2]], ids=scenes.name)
def test_T_by_functions_of_the_background(background, cell):
    # T u is the background Function u at the body's nodes, for any u.
    particles = scene(background, cell)
    u = particles.increment
    u.interpolate(lambda x: np.sin(np.outer([1.0, 2.0, 3.0][: len(u)], 3 * x[0] + 2 * x[1])))
    result = particles.T.createVecLeft()
    particles.T.mult(u.x.petsc_vec, result)
    owned = particles.W.dofmap.index_map.size_local
    dim = particles.mesh.geometry.dim
    x = scenes.gather(local_positions(particles)[:owned])
    padded = np.zeros((len(x), 3))
    padded[:, :dim] = x
    domain = particles.V.mesh
    tree = geometry.bb_tree(domain, domain.topology.dim)
    near = geometry.compute_collisions_points(tree, padded)
    cells = geometry.compute_colliding_cells(domain, near, padded)
    mine = np.flatnonzero(np.diff(cells.offsets))
    values = np.full((len(x), dim), -np.inf)
    if len(mine):
        values[mine] = u.eval(padded[mine], cells.array[cells.offsets[mine]])
    expected = np.max(scenes.WORLD.allgather(values), axis=0)
    np.testing.assert_allclose(scenes.gather(result.array_r.reshape(-1, dim)), expected, atol=1e-12)


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


@pytest.mark.parametrize(("background", "cell"), [*PAIRS, *SOLID], ids=scenes.name)
def test_active_dofs_are_the_columns_of_T(background, cell):
    particles = scene(background, cell)
    columns = np.flatnonzero(np.abs(scenes.dense(particles.T)).max(axis=0))
    bs = particles.V.dofmap.index_map_bs
    first, last = np.array(particles.V.dofmap.index_map.local_range) * bs
    mine = columns[(columns >= first) & (columns < last)]
    assert np.array_equal(particles.active_dofs, mine)
    if (background, cell) in PAIRS:
        assert 0 < len(columns) < particles.T.getSize()[1]


@pytest.mark.parametrize("cell", ALL, ids=scenes.name)
def test_T_is_the_identity_where_particles_are_cells(cell):
    V = scenes.vectors(scenes.bend(scenes.unit(3, cell), 0.04))
    particles = mpm.Particles(scenes.bend(scenes.unit(3, cell), 0.04), V)
    same = scenes.coordinates(particles.W)[:, None] == scenes.coordinates(V)[None]
    identity = np.kron(same.all(axis=2), np.eye(V.mesh.geometry.dim))
    np.testing.assert_allclose(scenes.dense(particles.T), identity, atol=1e-12)
    assert scenes.WORLD.allreduce(len(particles.active_dofs)) == particles.T.getSize()[1]
