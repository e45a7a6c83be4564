# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Values that users give, of each kind, at points of cells and as Functions."""

import numpy as np
import pytest
import scenes
from compare import raises
from scenes import QUADRILATERAL, TRIANGLE

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.meshes.quadrature import quadrature_rule
from mpm_dolfinx.meshes.values import AtPoints, as_ufl, at_points, interpolated

KINDS = ("Function", "UFL", "list of UFL", "function", "function of arrays")


def plane(x):
    return (1.0 + 0.5 * x[0], 2.0 * x[1])


def of_kind(kind, domain):
    """Return the same vector, linear in coordinates, as each kind of value."""
    space = fem.functionspace(domain, ("Lagrange", 1, (2,)))
    function = fem.Function(space)
    function.interpolate(lambda x: np.array(plane(x)))
    x = ufl.SpatialCoordinate(domain)
    half = fem.Constant(domain, 0.5)
    return {
        "Function": function,
        "UFL": ufl.as_vector(plane(x)),
        "list of UFL": [1.0 + half * x[0], 2.0 * x[1]],
        "function": plane,
        "function of arrays": lambda x: np.array([1.0 + 0.5 * x[0], 2.0 * x[1]]),
    }[kind]


@pytest.mark.parametrize("cell", [QUADRILATERAL, TRIANGLE])
@pytest.mark.parametrize(
    "kind", ["Function", "UFL", "list of UFL", "function", "function of arrays"]
)
def test_each_kind_at_points_and_in_a_space(kind, cell):
    domain = scenes.unit(3, cell)
    value = of_kind(kind, domain)
    points, _ = quadrature_rule(domain.basix_cell(), 2)
    n = domain.topology.index_map(2).size_local
    x = AtPoints(ufl.SpatialCoordinate(domain), domain, points).values()
    places = np.zeros((3, n * len(points)))
    places[:2] = x.reshape(-1, 2).T
    expected = np.stack(plane(np.moveaxis(x, -1, 0)), axis=-1)
    found = at_points(value, domain, "wind", (2,), points, places)
    np.testing.assert_allclose(found, expected, rtol=1e-14)
    if kind != "function of arrays":
        made = as_ufl(value, domain, "wind", (2,))
        np.testing.assert_allclose(AtPoints(made, domain, points).values(), expected, rtol=1e-14)
    for degree in (1, 2):
        space = fem.functionspace(domain, ("Lagrange", degree, (2,)))
        at_nodes = space.tabulate_dof_coordinates()
        own = interpolated(value, space, "wind").x.array.reshape(-1, 2)
        np.testing.assert_allclose(own, np.transpose(plane(at_nodes.T)), rtol=0.0, atol=1e-14)


def test_numbers_are_the_same_everywhere_and_constants_are_followed():
    domain = scenes.unit(2, TRIANGLE)
    points, _ = quadrature_rule(domain.basix_cell(), 2)
    constant = fem.Constant(domain, [1.0, -2.0])
    followed = AtPoints(as_ufl([constant[0], 3.0], domain, "wind", (2,)), domain, points)
    assert (followed.values() == [1.0, 3.0]).all()
    constant.value[0] = 4.0
    assert (followed.values() == [4.0, 3.0]).all()
    for value in (2.0, np.float32(2.0), ufl.as_ufl(2.0), lambda x: 2.0, lambda x: 2.0 + 0.0 * x[0]):
        space = fem.functionspace(domain, ("Lagrange", 2))
        assert (interpolated(value, space, "heat").x.array == 2.0).all()


def test_a_dirichlet_value_is_a_function_of_coordinates():
    V = scenes.vectors(scenes.unit(4, QUADRILATERAL))
    x = V.tabulate_dof_coordinates()
    at = np.flatnonzero(x[:, 0] == 1.0)
    for bc, component, expected in (
        (mpm.held(V, x=1.0, value=plane), slice(None), np.transpose(plane(x.T))),
        (mpm.held(V, 1, x=1.0, value=lambda x: np.sin(x[1])), 1, np.sin(x[:, 1])),
    ):
        values = np.full(len(x) * 2, 7.0)
        bc.set(values)
        found = values.reshape(-1, 2)[:, component]
        np.testing.assert_allclose(found[at], expected[at], rtol=1e-14)
        assert (np.delete(found, at, axis=0) == 7.0).all()
    assert (values.reshape(-1, 2)[:, 0] == 7.0).all()


def test_what_is_told_of_a_function_that_makes_no_sense():
    domain = scenes.unit(2, TRIANGLE)
    space = fem.functionspace(domain, ("Lagrange", 1, (2,)))

    def fails(value, sentence):
        raises(lambda: interpolated(value, space, "wind"), mpm.MPMError, sentence)

    fails(lambda x: x[5], "The function that gives wind failed with IndexError")
    for wrong in (lambda x: x, lambda x: 1.0, lambda x: "up", lambda x: (1.0, np.nan * x[0])):
        fails(wrong, r"wind must return finite numbers of the shape \(2, \d+\) for coordinates")
    fails(ufl.sqrt(-1.0 - ufl.SpatialCoordinate(domain)[0]) * ufl.as_vector([1, 1]), "be finite")
    raises(lambda: as_ufl(lambda x: "up", domain, "heat"), mpm.MPMError, "heat must be .* not 'up'")
