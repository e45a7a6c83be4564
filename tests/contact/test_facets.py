# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The facets of a body that are closest to points: against a search among all, and basix."""

import numpy as np
import pytest
import scenes
from scenes import HEXAHEDRON, QUADRILATERAL, TETRAHEDRON, TRIANGLE, WORLD, box

import basix

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
    surface = Surface(body, None, 3, False, "A test")
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


def among_all(known, nodes, x, inner):
    """Return the closest facets, and what is told of them, by a projection on every facet."""
    count, size = len(x), len(nodes)
    which, facet = np.repeat(np.arange(count), size), np.tile(np.arange(size), count)
    middle = np.full((len(which), x.shape[1] - 1), 1 / 3 if nodes.shape[1] in (3, 6) else 0.5)
    if x.shape[1] == 2:
        middle[:] = 0.5
    s = known.project(x[which], nodes[facet], middle)
    border = known.clamped(s)
    r, n = facets.separated(known.tabulate(border), x[which], nodes[facet], known.outward[facet])
    far = np.linalg.norm(r, axis=1)
    ok = far <= REACH
    if inner is not None:
        ok &= (inner[which] * n).sum(axis=1) < facets.FACING
    far = np.where(ok, np.round(far / REACH, 12), np.inf).reshape(count, size)
    best = far.argmin(axis=1)
    who = np.arange(count) * size + best
    table, X = known.tabulate(s[who]), nodes[best]
    r, n = facets.separated(table, x, X, known.outward[best])
    gap, length = (r * n).sum(axis=1), np.linalg.norm(table[1] @ X, axis=2).max(axis=1)
    over = np.abs(s - border)[who].max(axis=1) * length
    depth = np.abs(gap)
    off = over > np.maximum(1e-9 * length, 0.2 * np.minimum(depth, 0.1 * length))
    off &= (REACH * far.min(axis=1) > 2.0 * depth + 1e-12 * length) | (gap < -0.5 * length)
    return np.isfinite(far.min(axis=1)), best, s[who], gap, ~off, over / length


@pytest.mark.skip_in_parallel
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("faced", [False, True])
@pytest.mark.parametrize("kind", [TRIANGLE, QUADRILATERAL, TETRAHEDRON, HEXAHEDRON])
def test_the_closest_facet_is_that_of_a_search_among_all(kind, faced, degree):
    known, nodes, x, inner = near_a_body(kind, degree)
    found = known.closest(x, inner if faced else None, nodes, REACH)
    there, best, *told = among_all(known, nodes, x, inner if faced else None)
    assert np.array_equal(found.facet, np.where(there, best, -1)) and there.sum() > 50
    for name, value in zip(("place", "gap", "near", "beside"), told, strict=True):
        np.testing.assert_allclose(getattr(found, name)[there], value[there], atol=1e-11)


@pytest.mark.skip_in_parallel
@pytest.mark.parametrize("kind", [TRIANGLE, HEXAHEDRON])
def test_a_facet_without_an_area_asks_for_smaller_steps(kind):
    # As an MPMError, so that ranks agree on it also where a step is committed.
    known, nodes, x, _ = near_a_body(kind)
    gone = np.tile(nodes[:1, :1], (1, nodes.shape[1], 1))
    where = np.full((1, x.shape[1] - 1), 0.3)
    for call in (
        lambda: known.project(x[:1], gone, where),
        lambda: known.closest(gone[:, 0], None, np.concatenate([gone, nodes[1:]]), REACH),
    ):
        with pytest.raises(mpm.ConvergenceError, match="Facets of a Pair collapse"):
            call()


@pytest.mark.skip_in_parallel
@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("kind", [TRIANGLE, QUADRILATERAL, TETRAHEDRON, HEXAHEDRON])
def test_shape_functions_are_those_of_basix_and_projections_are_upright(kind, degree):
    known, nodes, x, _ = near_a_body(kind, degree)
    e, some = x.shape[1] - 1, np.random.default_rng(2)
    place = some.uniform(-0.2, 1.2, (50, e))
    table = known.element.tabulate(2, place)[:, :, :, 0]
    N, dN, ddN = known.tabulate(place)
    np.testing.assert_allclose(N, table[0], atol=1e-13)
    for i in range(e):
        powers = np.eye(e, dtype=int)[i]
        np.testing.assert_allclose(dN[:, i], table[basix.index(*powers)], atol=1e-12)
        for j in range(e):
            powers = np.eye(e, dtype=int)[i] + np.eye(e, dtype=int)[j]
            np.testing.assert_allclose(ddN[:, i, j], table[basix.index(*powers)], atol=1e-11)
    facet = some.integers(0, len(nodes), len(x))
    on = known.tabulate(some.uniform(0.1, 0.4, (len(x), e)))[0]
    x = np.einsum("nk,nki->ni", on, nodes[facet]) + 0.02 * some.normal(size=x.shape)
    s = known.project(x, nodes[facet], np.full((len(x), e), 0.3))
    N, dN, _ = known.tabulate(s)
    r = x - np.einsum("nk,nki->ni", N, nodes[facet])
    assert np.abs(np.einsum("nek,nki,ni->ne", dN, nodes[facet], r)).max() < 1e-10


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
    surface = Surface(mpm.Particles(mesh, V), (tags, 1), 3, False, "A test")
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
    surface = Surface(mpm.Particles(mesh, V), (tags, 1), 3, False, "A test")
    surface.settle()
    nodes = surface.own_nodes()
    angle = np.linspace(-0.66, 0.66, 400)
    radius = 1.0 + np.array([0.05, 1e-3, 1e-6])[np.arange(len(angle)) % 3]
    x = radius[:, None] * np.column_stack([np.sin(angle), np.cos(angle)])
    known = facets.NearFacets(surface, np.arange(len(surface.layout.cells)), x, 3.0 * REACH, nodes)
    found = known.closest(x, None, known.positions(nodes), REACH)
    assert found.near.all() and (found.beside > 0.0).any()
