# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Regions, tags and conditions by regions, against DOLFINx's own calls."""

import numpy as np
import pytest
import scenes
from compare import raises
from scenes import HEXAHEDRON, QUADRILATERAL, TRIANGLE, WORLD

from dolfinx import fem, mesh

import mpm_dolfinx as mpm


@pytest.fixture
def domain():
    return scenes.box([0.0, 0.0], [4.0, 3.0], [8, 6], QUADRILATERAL)


def test_a_bound_far_away_does_not_move_the_other_one():
    x = np.zeros((3, 5))
    x[0] = [-1.0, 0.0, 1e-12, 1e-6, 0.5]
    for far in (1e3, 1e9, np.inf):
        assert mpm.region(x=(-far, 0.0))(x).tolist() == [True, True, True, False, False]
        assert mpm.region(x=(0.0, far))(x).tolist() == [False, True, True, True, True]
        assert mpm.region(x=(-1.0, 0.0), y=(-far, far))(x).tolist() == [True] * 3 + [False] * 2


def test_points_of_regions():
    x = np.array([[0.0, 1.0, 2.0, 1.0, 5.0], [0.0, 0.5, 1.0, 2.0, 5.0], [0.0] * 5])
    assert mpm.region(x=1.0)(x).tolist() == [False, True, False, True, False]
    assert mpm.region(x=1.0, y=(0.0, 1.0))(x).tolist() == [False, True, False, False, False]
    assert mpm.region(y=(1.0, np.inf))(x).tolist() == [False, False, True, True, True]
    for corners in ([(0, 0), (3, 0), (1, 3)], [(0, 0), (1, 3), (3, 0)]):
        assert mpm.region(polygon=corners)(x).tolist() == [True, True, True, True, False]


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_the_boundary_of_a_polygon_is_in_it_in_any_unit(scale):
    corners = scale * np.array([(0.1, 0.0), (3.0, 0.7), (2.0, 2.3), (0.4, 1.9)])
    t = np.linspace(0.0, 1.0, 7)[:, None]
    sides = [a + t * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    on, middle = np.concatenate(sides), corners.mean(axis=0)
    for points, found in ((on, True), (1.0001 * (on - middle) + middle, False)):
        x = np.column_stack([points, np.zeros(len(points))]).T
        assert (mpm.region(polygon=corners.tolist())(x) == found).all()


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_a_plane_is_found_in_any_unit(scale):
    domain = scenes.box([0.0, 0.0], [3.0 * scale, scale], [9, 3], TRIANGLE)
    domain.geometry.x[:] *= 1.0 + 1e-15
    V = scenes.vectors(domain)
    bc = mpm.held(V, 0, x=scale * (0.1 + 0.2) / 0.3)  # one, but for round-off
    dofs, own = bc.dof_indices()
    assert WORLD.allreduce(own) == 4
    x = V.tabulate_dof_coordinates()[dofs // 2, 0] / scale
    assert scenes.largest(np.abs(x - 1.0)) < 1e-9


@pytest.mark.parametrize("degree", [1, 2])
def test_conditions_as_by_dolfinx(domain, degree):
    V = scenes.vectors(domain, degree)
    for component in (0, 1):
        facets = mesh.locate_entities_boundary(domain, 1, lambda x: np.isclose(x[0], 4.0))
        dofs = fem.locate_dofs_topological(V.sub(component), 1, facets)
        bc = mpm.held(V, component, x=4.0, value=0.3)
        np.testing.assert_array_equal(bc.dof_indices()[0], dofs)
        assert float(bc.g.value) == 0.3
    inner = mesh.locate_entities(domain, 1, lambda x: np.isclose(x[1], 1.5))
    bc = mpm.held(V, y=1.5)
    every = fem.locate_dofs_topological(V, 1, inner)
    np.testing.assert_array_equal(np.unique(bc.dof_indices()[0] // 2), np.unique(every))
    value = fem.Constant(domain, np.array([1.0, 2.0]))
    assert mpm.held(V, x=0.0, value=value).g is value._cpp_object
    collapsed, _ = V.sub(1).collapse()
    along = fem.Function(collapsed)
    along.interpolate(lambda x: x[0])
    moved = fem.Function(V)
    moved.x.array[:] = 0.0
    bc = mpm.held(V, 1, where=mpm.region(y=3.0), value=along)
    bc.set(moved.x.array)
    x = V.tabulate_dof_coordinates()
    top = np.isclose(x[:, 1], 3.0)
    np.testing.assert_allclose(moved.x.array[1::2][top], x[top, 0])
    assert not moved.x.array[::2].any()


def test_scalar_spaces_and_space():
    box = scenes.box([0.0] * 3, [1.0] * 3, [2] * 3, HEXAHEDRON)
    scalar = fem.functionspace(box, ("Lagrange", 1))
    bc = mpm.held(scalar, z=1.0, value=2.0)
    own = bc.dof_indices()[0][: bc.dof_indices()[1]]
    assert WORLD.allreduce(len(own)) == 9
    V = scenes.vectors(box)
    own, count = mpm.held(V, x=0.0, value=(1.0, 0.0, 0.0)).dof_indices()
    assert WORLD.allreduce(count) == 27


def test_tags_of_facets_and_cells(domain):
    tags = mpm.facet_tags(domain, {3: mpm.region(y=3.0), 7: mpm.region(x=0.0)})
    top = mesh.locate_entities_boundary(domain, 1, lambda x: np.isclose(x[1], 3.0))
    np.testing.assert_array_equal(np.sort(tags.find(3)), np.sort(top))
    assert WORLD.allreduce(len(tags.find(7))) >= 6
    inner = mpm.facet_tags(domain, {1: mpm.region(y=1.5)}, interior=True)
    assert WORLD.allreduce(len(inner.indices)) >= 8
    layers = mpm.cell_tags(domain, {1: lambda x: x[1] < 9.0, 2: mpm.region(y=(1.0, 2.0))})
    own = domain.topology.index_map(2).size_local
    counts = [WORLD.allreduce(int((layers.find(tag) < own).sum())) for tag in (1, 2)]
    assert counts == [32, 16]  # (of two tags the latter)


def test_what_is_not_there_is_refused(domain):
    V = scenes.vectors(domain)
    nowhere = mpm.region(x=0.3)
    raises(lambda: mpm.held(V, 0, x=0.3), mpm.MPMError, r"x = 0\.3, the nearest vertex at 0\.5")
    raises(lambda: mpm.held(V, 0, x=0.0, y=0.0), mpm.MPMError, r"hold a point by a range")
    raises(lambda: mpm.held(V, 2, x=0.0), mpm.MPMError, "no component 2")
    raises(lambda: mpm.held(V), mpm.MPMError, "needs x=, y=, z=")
    raises(lambda: mpm.held(V, r=0.0), mpm.MPMError, "no r=")
    raises(lambda: mpm.held(V, x=0.0, where=nowhere), mpm.MPMError, "needs x=, y=, z=")
    raises(lambda: mpm.held(V, x=0.0, value=np.nan), mpm.MPMError, "finite")
    raises(lambda: mpm.held(V, x=0.0, value=(1.0, 2.0, 3.0)), mpm.MPMError, "must have .2,")
    raises(lambda: mpm.held(V, where=lambda x: 1 / 0), mpm.MPMError, "ZeroDivisionError")
    raises(lambda: mpm.facet_tags(domain, {1: nowhere}), mpm.MPMError, "where tag 1")
    hidden = {1: mpm.region(y=3.0, x=(0.0, 1.0)), 2: mpm.region(y=3.0)}
    raises(lambda: mpm.facet_tags(domain, hidden), mpm.MPMError, "Nothing is left of tag 1")
    raises(lambda: mpm.facet_tags(domain, {}), mpm.MPMError, "needs {tag: where")
    raises(lambda: mpm.facet_tags(domain, {1.5: nowhere}), mpm.MPMError, "whole number")
    raises(lambda: mpm.cell_tags(domain, {1: 2.0}), mpm.MPMError, "function of coordinates")
    for wrong in ({}, {"x": "a"}, {"x": (1.0, 0.0)}, {"x": np.nan}, {"polygon": [(0, 0)]}):
        with pytest.raises(mpm.MPMError):
            mpm.region(**wrong)


MARKERS = {
    "a level": lambda x: x[0] - 0.5,
    "numbers": lambda x: (x[0] > 0.5).astype(int),
    "all coordinates": lambda x: x > 0.5,
    "one for all": lambda x: True,
    "nothing": lambda x: None,
}


@pytest.mark.parametrize("marker", MARKERS.values(), ids=MARKERS)
def test_markers_that_return_no_bool_for_each_point_are_refused(marker):
    """A level that is zero almost nowhere held all of a mesh, and all coordinates any cells."""
    body, V = scenes.unit(4, QUADRILATERAL), scenes.vectors(scenes.unit(4, QUADRILATERAL))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(mpm.Particles(body, V), mpm.materials.Hencky(1.0, 0.3)), bcs=[mpm.held(V, y=0.0)]
    )
    for call in (
        lambda: mpm.held(V, where=marker),
        lambda: mpm.facet_tags(body, {1: marker}),
        lambda: mpm.facet_tags(body, {1: marker}, interior=True),
        lambda: mpm.cell_tags(body, {1: marker}),
        lambda: mpm.Particles(body, V, quadrature_degree=2, free=marker),
        lambda: problem.remove(marker),
    ):
        raises(call, mpm.MPMError, r"must return one bool for each of the coordinates \(3, n\)")
