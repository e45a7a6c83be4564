# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The background basis at points, against forward maps and hat functions."""

from itertools import product

import numpy as np
import pytest
import scenes
from scenes import ALL, HEXAHEDRON, PLANE, QUADRILATERAL, TETRAHEDRON, TRIANGLE, WORLD

from mpm_dolfinx.background import cells
from mpm_dolfinx.background.basis import BackgroundBasis
from mpm_dolfinx.tolerances import EQUAL, LAST_PLACES

MESHES = {
    **{f"structured {c.name}": (lambda c=c: scenes.unit(4, c)) for c in ALL},
    "unstructured triangle": lambda: scenes.bend(scenes.unit(5, TRIANGLE), 0.05),
    "unstructured tetrahedron": lambda: scenes.bend(scenes.unit(3, TETRAHEDRON), 0.05),
    **{f"sheared {c.name}": (lambda c=c: scenes.shear(scenes.unit(4, c))) for c in ALL},
    "distorted quadrilateral": lambda: scenes.bend(scenes.unit(5, QUADRILATERAL), 0.04),
    "distorted hexahedron": lambda: scenes.bend(scenes.unit(3, HEXAHEDRON), 0.04),
}


def shape_functions(simplex, reference):
    """Return linear or multilinear shape functions in tensor order, (n, k)."""
    if simplex:
        return np.column_stack([1 - reference.sum(axis=1), reference])
    corners = [c[::-1] for c in product((0, 1), repeat=reference.shape[1])]
    return np.column_stack([np.prod(np.where(c, reference, 1 - reference), 1) for c in corners])


def reference_points(simplex, dim):
    """Return points inside a reference cell, on its facets, edges and vertices."""
    random = np.random.default_rng(1)
    inside = random.dirichlet(np.ones(dim + 1), 4)[:, 1:] if simplex else random.random((4, dim))
    lattice = np.array(list(product((0.0, 0.5, 1.0), repeat=dim)))
    return np.vstack([inside, lattice[lattice.sum(axis=1) <= 1] if simplex else lattice])


def points_of_cells(V):
    """Return points in all cells of all ranks, and the dense values of the basis there."""
    dim = V.mesh.geometry.dim
    simplex = V.mesh.topology.cell_name() in ("triangle", "tetrahedron")
    N = shape_functions(simplex, reference_points(simplex, dim))
    count = V.mesh.topology.index_map(dim).size_local
    dofs = V.dofmap.list[:count]
    vertices = V.tabulate_dof_coordinates()[dofs][:, :, :dim]
    points = np.einsum("qk,cki->cqi", N, vertices).reshape(-1, dim)
    nodes = V.dofmap.index_map.local_to_global(dofs.ravel()).reshape(dofs.shape)
    values = np.zeros((count, len(N), V.dofmap.index_map.size_global))
    for c in range(count):
        values[c, :, nodes[c]] = N.T
    return scenes.gather(points), scenes.gather(values.reshape(len(points), -1))


def to_dense(basis, V):
    """Return the values of all basis functions at all points, (n, nodes of V)."""
    values = np.zeros((len(basis.nodes), V.dofmap.index_map.size_global))
    np.add.at(values, (np.arange(len(values))[:, None], basis.nodes), basis.values)
    return values


@pytest.mark.parametrize("kind", MESHES)
def test_basis_at_points_of_all_ranks(kind):
    V = scenes.vectors(MESHES[kind]())
    points, expected = points_of_cells(V)
    # Each rank asks for another part, most of which other ranks own.
    mine = slice((WORLD.rank + 1) % WORLD.size, None, WORLD.size)
    basis = BackgroundBasis(V).at(points[mine])
    assert basis.found.all()
    assert basis.nodes.dtype == np.int64
    values = to_dense(basis, V)
    np.testing.assert_allclose(values, expected[mine], atol=1e-12)
    np.testing.assert_allclose(values.sum(axis=1), 1.0, atol=1e-12)
    np.testing.assert_allclose(values @ scenes.coordinates(V), points[mine], atol=1e-13)
    kept = basis.values[basis.values != 0.0]
    assert np.all(kept >= 1e-13)


@pytest.mark.parametrize("dim", [2, 3])
def test_structured_grid_has_hat_functions(dim):
    n, cell = 4, QUADRILATERAL if dim == 2 else HEXAHEDRON
    V = scenes.vectors(scenes.unit(n, cell))
    points = np.random.default_rng(WORLD.rank).random((50, dim))
    gap = np.abs(points[:, None] - scenes.coordinates(V)[None]) * n
    hats = np.prod(np.maximum(0.0, 1.0 - gap), axis=2)
    np.testing.assert_allclose(to_dense(BackgroundBasis(V).at(points), V), hats, atol=1e-12)


@pytest.mark.parametrize("cell", PLANE, ids=scenes.name)
@pytest.mark.parametrize("bent", [False, True])
def test_points_that_wander_through_a_large_background(cell, bent):
    # Ranks learn of the cells around their points step by step; who owns them plays no part.
    domain = scenes.unit(40, cell)
    V = scenes.vectors(scenes.bend(domain, 0.005) if bent else domain)
    background = BackgroundBasis(V)
    corners = scenes.coordinates(V)
    for x in (0.0, 0.3, 0.9, 0.4):
        points = np.random.default_rng(WORLD.rank).random((60, 2)) * [0.1, 1.0] + [x, 0.0]
        basis = background.at(points)
        assert basis.found.all()
        near = np.abs(corners[basis.nodes] - points[:, None]).max(axis=2)
        assert near.max() < 0.04
        np.testing.assert_allclose(basis.values.sum(axis=1), 1.0, atol=1e-12)
        moved = np.einsum("nk,nki->ni", basis.values, corners[basis.nodes])
        np.testing.assert_allclose(moved, points, atol=1e-13)


@pytest.mark.parametrize("kind", MESHES)
def test_points_just_outside(kind):
    V = scenes.vectors(MESHES[kind]())
    dim = V.mesh.geometry.dim
    square = np.random.default_rng(2).random((40, dim))
    side, face = np.arange(40) % dim, np.arange(40) // dim % 2
    normal = np.where(np.arange(dim) == side[:, None], 2.0 * face[:, None] - 1.0, 0.0)
    square[np.arange(40), side] = face
    linear = np.eye(dim)
    if kind.startswith("sheared"):
        corner = scenes.coordinates(V)
        span = [corner[np.argmin(np.abs(corner - e).sum(axis=1))] for e in shear_columns(dim)]
        linear = np.array(span).T
    basis = BackgroundBasis(V)
    on = (square + 1e-12 * normal) @ linear.T
    near = basis.at(on)
    assert near.found.all()
    values = to_dense(near, V)
    np.testing.assert_allclose(values @ scenes.coordinates(V), on, atol=3e-12)
    np.testing.assert_allclose(values.sum(axis=1), 1.0, atol=1e-12)
    for distance in (1e-6, 1e-2, 1e3):
        away = basis.at((square + distance * normal) @ linear.T)
        assert not away.found.any()
        assert np.all(away.values == 0.0)


def shear_columns(dim):
    """Return the images of the unit vectors under ``scenes.shear``."""
    unit = scenes.shear.__defaults__[0]
    return np.array(unit)[:dim, :dim].T


@pytest.mark.parametrize("kind", MESHES)
def test_cells_far_from_the_origin(kind):
    # Round-off of coordinates, 2e-12, is 1e-11 of a cell.
    domain = MESHES[kind]()
    dim = domain.topology.dim
    domain.geometry.x[:, :dim] += 1e4
    V = scenes.vectors(domain)
    points, expected = points_of_cells(V)
    basis = BackgroundBasis(V).at(points)
    assert basis.found.all()
    np.testing.assert_allclose(to_dense(basis, V), expected, atol=1e-10)


@pytest.mark.parametrize("cell", PLANE, ids=scenes.name)
def test_hole_is_outside(cell):
    # A point in a re-entrant corner is in the bounding box of the mesh, not in the mesh.
    domain = scenes.unit(4, cell)
    dim = domain.topology.dim
    cells = domain.topology.index_map(dim).size_local
    middle = scenes.mesh.compute_midpoints(domain, dim, np.arange(cells, dtype=np.int32))
    keep = np.flatnonzero((middle[:, :2] < 0.5).any(axis=1)).astype(np.int32)
    corner = scenes.mesh.create_submesh(domain, dim, keep)[0]
    found = BackgroundBasis(scenes.vectors(corner)).at(
        np.array([[0.75, 0.75], [0.5 + 1e-6, 0.5 + 1e-6], [0.5, 0.75], [0.25, 0.75], [0.9, 0.1]])
    )
    assert found.found.tolist() == [False, False, True, True, True]


def test_points_that_are_not_numbers_are_outside():
    basis = BackgroundBasis(scenes.vectors(scenes.unit(3, QUADRILATERAL)))
    points = np.array([[np.nan, 0.5], [np.inf, 0.5], [0.5, 0.5], [0.5, -np.inf]])
    assert basis.at(points).found.tolist() == [False, False, True, False]


@pytest.mark.parametrize("cell", ALL, ids=scenes.name)
def test_points_at_vertices_divide_by_nothing(cell):
    domain = scenes.unit(2, cell)
    V = scenes.vectors(domain)
    with np.errstate(all="raise"):
        rows = BackgroundBasis(V).at(domain.geometry.x[:, : domain.geometry.dim])
    assert rows.found.all()
    np.testing.assert_allclose(rows.values.max(axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(np.abs(rows.values).sum(axis=1), 1.0, atol=1e-14)


@pytest.mark.parametrize("cell", ALL, ids=scenes.name)
def test_ranks_without_points_or_cells(cell):
    V = scenes.vectors(scenes.unit(1, cell))
    dim = V.mesh.geometry.dim
    asks = WORLD.rank == WORLD.size - 1
    points = np.random.default_rng(3).random((7 if asks else 0, dim))
    basis = BackgroundBasis(V).at(points)
    assert (
        basis.nodes.shape
        == basis.values.shape
        == (len(points), 2**dim if cell in (QUADRILATERAL, HEXAHEDRON) else dim + 1)
    )
    assert basis.found.shape == (len(points),) and basis.found.all()
    x = scenes.coordinates(V)
    np.testing.assert_allclose(to_dense(basis, V) @ x, points, atol=1e-14)


def hollow(domain):
    """Return the cells of a domain that are not in its last corner."""
    dim = domain.topology.dim
    count = domain.topology.index_map(dim).size_local
    middle = scenes.mesh.compute_midpoints(domain, dim, np.arange(count, dtype=np.int32))
    keep = np.flatnonzero((middle[:, :dim] < 0.5).any(axis=1)).astype(np.int32)
    return scenes.mesh.create_submesh(domain, dim, keep)[0]


def graded(domain):
    """Make cells near the origin smaller."""
    domain.geometry.x[:] = domain.geometry.x**1.5
    return domain


@pytest.mark.parametrize("cell", [QUADRILATERAL, HEXAHEDRON], ids=scenes.name)
@pytest.mark.parametrize("change", [lambda m: m, graded, hollow], ids=["even", "graded", "hollow"])
@pytest.mark.parametrize("away", [0.0, 1e4])
def test_search_in_a_grid_finds_what_that_by_boxes_does(cell, change, away, monkeypatch):
    domain = change(scenes.unit(4, cell))
    dim = domain.geometry.dim
    domain.geometry.x[:, :dim] += away
    V = scenes.vectors(domain)
    corners = scenes.coordinates(V)
    random = np.random.default_rng(5)
    pairs = random.integers(len(corners), size=(2, 300))
    points = np.concatenate(
        [
            corners,
            0.5 * (corners[pairs[0]] + corners[pairs[1]]),  # on facets, edges and vertices too
            corners + random.choice([-1e-13, 1e-13, 1e-11, 1e-6], corners.shape),
            away + random.uniform(-0.2, 1.2, (200, dim)),
            [[np.nan] * dim, [np.inf, *[0.5] * (dim - 1)]],
        ]
    )
    known = BackgroundBasis(V)
    for _ in range(2):  # on several ranks the first learns of cells
        basis = known.at(points)
    assert 0 < np.count_nonzero(basis.found) < len(points)
    with monkeypatch.context() as patch:
        patch.setattr(cells.RegularGrid, "of", lambda vertices: None)
        other = BackgroundBasis(V)
        for _ in range(2):
            by_boxes = other.at(points)
    np.testing.assert_array_equal(basis.found, by_boxes.found)
    there = basis.found
    one, two = (to_dense(each, V)[there] for each in (basis, by_boxes))
    np.testing.assert_allclose(one, two, rtol=0.0, atol=1e-9)
    # on a facet the cell takes a point that is first in the input
    vertices, nodes, number, *_ = (
        np.concatenate(p) for p in gathered(cells.CellTable.owned(V).part(slice(None)))
    )
    low, high = vertices.min(axis=1), vertices.max(axis=1)
    size = np.maximum(np.abs(low), np.abs(high))
    reach = np.maximum(EQUAL * (high - low), LAST_PLACES * size)
    for point, found in zip(points[there], basis.nodes[there], strict=True):
        beyond = np.maximum(low - point, point - high)
        inside = np.flatnonzero((beyond <= reach).all(axis=1))
        if len(inside):
            np.testing.assert_array_equal(found, nodes[inside[number[inside].argmin()]])


def gathered(table):
    """Return the columns of tables of cells on all ranks, each as a list (collective)."""
    return zip(*scenes.WORLD.allgather(tuple(table)), strict=True)


@pytest.mark.parametrize("name", [name for name in MESHES if "sheared" not in name])
def test_a_boundary_that_is_held_goes_on_beyond_it(name):
    # At a point below a face that is held stands the basis of the nearest place of the face, whose
    # gradient has no part across it; elsewhere there is nothing.
    domain = MESHES[name]()
    V = scenes.vectors(domain)
    dim = domain.geometry.dim
    evaluator = BackgroundBasis(V)
    x = V.tabulate_dof_coordinates()[: V.dofmap.index_map.size_local, :dim]
    at_rest = np.zeros((len(x), dim), dtype=bool)
    at_rest[:, dim - 1] = np.abs(x[:, dim - 1]) < 1e-9
    assert not evaluator.hold(at_rest)  # nothing was
    random = np.random.default_rng(7)
    on = np.full((30, dim), 0.0)
    on[:, : dim - 1] = 0.3 + 0.4 * random.random((30, dim - 1))
    below, far, above = on.copy(), on.copy(), on.copy()
    below[:, -1], far[:, -1], above[:, -1] = -0.01, -1.5, 1.2
    there, found = (evaluator.at(points, gradients=True) for points in (on, below))
    assert there.found.all() and found.found.all()
    np.testing.assert_allclose(to_dense(found, V), to_dense(there, V), atol=1e-12)
    assert np.abs(found.gradients[..., -1]).max() < 1e-12
    step = np.zeros(dim)
    step[0] = 1e-6
    change = to_dense(evaluator.at(below + step), V) - to_dense(evaluator.at(below - step), V)
    slopes = to_dense(found._replace(values=found.gradients[..., 0]), V)
    smooth = np.abs(slopes) > 0  # (facets meet at kinks)
    np.testing.assert_allclose((change / 2e-6)[smooth], slopes[smooth], atol=1e-5)
    assert not evaluator.at(far).found.any() and not evaluator.at(above).found.any()
    assert evaluator.hold(np.zeros_like(at_rest)) and not evaluator.at(below).found.any()


@pytest.mark.parametrize(("size", "low"), [(1.0, 0.0), (1e-9, 0.0), (1e9, 0.0), (1.0, 5e6)])
def test_a_boundary_holds_what_is_less_than_a_cell_beyond_it(size, low):
    lower, upper = size * np.array([[low, low], [low + 2.0, low + 1.0]])
    V = scenes.vectors(scenes.box(lower, upper, [8, 2], scenes.QUADRILATERAL))
    evaluator = BackgroundBasis(V)
    x = V.tabulate_dof_coordinates()[: V.dofmap.index_map.size_local] / size - low
    evaluator.hold(np.column_stack([np.zeros(len(x), dtype=bool), x[:, 1] < 1e-3]))
    depths = np.array([0.01, 0.25, 0.49, 0.51, 0.75])
    points = np.column_stack([np.full(5, low + 0.9), low - depths])
    found = evaluator.at(size * points).found
    np.testing.assert_array_equal(found, depths < 0.5)
