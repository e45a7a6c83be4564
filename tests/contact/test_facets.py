# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The facets of a body that are closest to points: compiled, by NumPy, and by brute force."""

import numpy as np
import pytest
import scenes
from scenes import HEXAHEDRON, QUADRILATERAL, TETRAHEDRON, TRIANGLE, WORLD, box

import mpm_dolfinx as mpm
from mpm_dolfinx.contact import facets
from mpm_dolfinx.contact.surface import Surface

REACH = 0.2
GRID = {2: QUADRILATERAL, 3: HEXAHEDRON}


def near_a_body(kind, degree=1):
    """Return facets of a bent body, their nodes, and points around it with directions."""
    dim = 2 if kind in (TRIANGLE, QUADRILATERAL) else 3
    V = scenes.vectors(box([-1.0] * dim, [2.0] * dim, [3] * dim, GRID[dim], WORLD))
    mesh = box([0.0] * dim, [1.0] * dim, [5, 4, 3][:dim], kind, WORLD)
    body = mpm.Particles(mesh, V, degree=degree)
    surface = Surface(body, None, None, 3, False, "A test")
    surface.settle()
    nodes = surface.own_nodes()
    nodes = nodes + 0.03 * np.sin(5.0 * nodes[:, ::-1])
    rng = np.random.default_rng(1)
    x = nodes[surface.layout.own].mean(axis=1)[rng.integers(0, len(surface.layout.cells), 300)]
    x = x + rng.uniform(-0.15, 0.15, x.shape)
    inner = -rng.normal(size=x.shape)
    inner /= np.linalg.norm(inner, axis=1)[:, None]
    number = np.arange(len(surface.layout.cells))
    known = facets.NearFacets(surface, number, x, 3.0 * REACH, nodes)
    return known, known.positions(nodes), x, inner


@pytest.mark.skip_in_parallel
@pytest.mark.parametrize("faced", [False, True])
@pytest.mark.parametrize("kind", [TRIANGLE, QUADRILATERAL, TETRAHEDRON, HEXAHEDRON])
def test_compiled_search_finds_what_that_by_numpy_finds(kind, faced):
    known, nodes, x, inner = near_a_body(kind)
    found, other = (
        search(x, inner if faced else None, nodes, REACH)
        for search in (known.closest, known.closest_curved)
    )
    assert np.array_equal(found.facet, other.facet) and (found.facet >= 0).sum() > 50
    assert np.array_equal(found.near, other.near)
    for name in ("place", "gap", "beside"):
        np.testing.assert_allclose(getattr(found, name), getattr(other, name), atol=1e-11)


@pytest.mark.skip_in_parallel
@pytest.mark.parametrize("kind", [TRIANGLE, QUADRILATERAL, HEXAHEDRON])
def test_no_place_on_any_facet_is_nearer(kind):
    """Among places on all facets, so many that some are within a fiftieth of a facet.

    (On triangles a foot beyond two edges is taken back along these, and not the shortest way.)
    """
    known, nodes, x, _ = near_a_body(kind)
    x = x[:60]
    found = known.closest(x, None, nodes, REACH)
    e = x.shape[1] - 1
    line = np.linspace(0.0, 1.0, 101 if e == 1 else 25)
    places = np.stack(np.meshgrid(*[line] * e, indexing="ij"), axis=-1).reshape(-1, e)
    N, _, _ = known.tabulate(places)
    on = (N[None] @ nodes).reshape(-1, x.shape[1])
    least = np.array([np.linalg.norm(on - point, axis=1).min() for point in x])
    has = found.facet >= 0
    assert has[least <= REACH].all() and has.sum() > 20
    at, _, _ = known.tabulate(known.clamped(found.place[has]))
    far = np.linalg.norm(x[has] - np.einsum("nk,nki->ni", at, nodes[found.facet[has]]), axis=1)
    assert (far <= least[has] * (1.0 + 1e-9)).all()


@pytest.mark.skip_in_parallel
@pytest.mark.parametrize("kind", [TRIANGLE, TETRAHEDRON, HEXAHEDRON])
def test_points_beside_the_end_of_a_surface_touch_nothing(kind):
    # above its plane as below it, where a pressure by stress may act at a gap
    dim = 2 if kind == TRIANGLE else 3
    V = scenes.vectors(box([-1.0] * dim, [2.0] * dim, [3] * dim, GRID[dim], WORLD))
    mesh = box([0.0] * dim, [1.0] * dim, [5, 4, 3][:dim], kind, WORLD)
    tags = scenes.facet_tags(mesh, scenes.at(dim - 1, 1.0))
    surface = Surface(mpm.Particles(mesh, V), tags, 1, 3, False, "A test")
    surface.settle()
    nodes = surface.own_nodes()
    x = np.full((400, dim), 0.4)
    x[:, 0] = np.linspace(-0.1, 1.1, len(x))
    x[:, -1] = 1.0 + 2e-4 * np.array([1.0, -1.0, 1e-12, -1e-12])[np.arange(len(x)) % 4]
    known = facets.NearFacets(surface, np.arange(len(surface.layout.cells)), x, 3.0 * REACH, nodes)
    found = known.closest(x, None, known.positions(nodes), REACH)
    assert (found.facet >= 0).all()
    assert np.array_equal(found.near, (x[:, 0] >= 0.0) & (x[:, 0] <= 1.0))


@pytest.mark.skip_in_parallel
def test_points_over_the_edges_of_a_bent_surface_face_it():
    V = scenes.vectors(box([-2.0, -2.0], [2.0, 2.0], [3, 3], QUADRILATERAL, WORLD))
    mesh = box([-1.0, 0.0], [1.0, 1.0], [8, 4], QUADRILATERAL, WORLD)
    # the arc of a circle: corners of 9.6 degrees
    X = mesh.geometry.x
    X[:, :2] = np.column_stack([np.sin(0.67 * X[:, 0]), np.cos(0.67 * X[:, 0])]) * (
        0.5 + 0.5 * X[:, 1:2]
    )

    def outer(x):
        return np.abs(np.hypot(x[0], x[1]) - 1.0) < 1e-9

    tags = scenes.facet_tags(mesh, outer)
    surface = Surface(mpm.Particles(mesh, V), tags, 1, 3, False, "A test")
    surface.settle()
    nodes = surface.own_nodes()
    angle = np.linspace(-0.66, 0.66, 400)
    radius = 1.0 + np.array([0.05, 1e-3, 1e-6])[np.arange(len(angle)) % 3]
    x = radius[:, None] * np.column_stack([np.sin(angle), np.cos(angle)])
    known = facets.NearFacets(surface, np.arange(len(surface.layout.cells)), x, 3.0 * REACH, nodes)
    found = known.closest(x, None, known.positions(nodes), REACH)
    assert found.near.all() and (found.beside > 0.0).any()
