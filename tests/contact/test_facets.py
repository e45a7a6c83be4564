# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The facets of a body that are closest to points: compiled, by NumPy, and by brute force."""

import numpy as np
import pytest
import scenes
from scenes import HEXAHEDRON, QUADRILATERAL, TETRAHEDRON, TRIANGLE, WORLD, box

import mpm_dolfinx as mpm
from mpm_dolfinx._core import loops
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
    x = nodes[surface.own].mean(axis=1)[rng.integers(0, len(surface.cells), 300)]
    x = x + rng.uniform(-0.15, 0.15, x.shape)
    inner = -rng.normal(size=x.shape)
    inner /= np.linalg.norm(inner, axis=1)[:, None]
    number = np.arange(len(surface.cells))
    known = facets.NearFacets(surface, number, x, 3.0 * REACH, nodes)
    return known, known.positions(nodes), x, inner


@pytest.mark.skip_in_parallel
@pytest.mark.skipif(loops is None, reason="needs the compiled loops")
@pytest.mark.parametrize("faced", [False, True])
@pytest.mark.parametrize("kind", [TRIANGLE, QUADRILATERAL, TETRAHEDRON, HEXAHEDRON])
def test_compiled_search_finds_what_that_by_numpy_finds(kind, faced):
    known, nodes, x, inner = near_a_body(kind)
    found, other = (
        known.closest(x, inner if faced else None, nodes, REACH, compiled=compiled)
        for compiled in (True, False)
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
