# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bodies that stick to each other stay so where next to nothing holds the background between."""

import numpy as np
import pytest
import scenes
from posed import posed
from scenes import ALL, HEXAHEDRON, QUADRILATERAL, TETRAHEDRON
from stabilisation.slivers import polynomial, vector

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky
from mpm_dolfinx.stabilisation import joints_of
from mpm_dolfinx.transfer.touched import TouchedNodes

DENSITY, GRAVITY = 2.0, 10.0


def stacked(cell=QUADRILATERAL, above=1e-7, below=2e-3, bend=0.0):
    """Return a block, and on it one whose toe has just crossed a line of the grid, at 1."""
    dim = 3 if cell in (TETRAHEDRON, HEXAHEDRON) else 2
    grid = scenes.box([0.0] * dim, [2.0] * dim, [4] * dim, cell)
    if bend:
        scenes.bend(grid, bend)
    V = scenes.vectors(grid)
    side, n = ([0.3] * (dim - 1), [1.3] * (dim - 1)), [4] * (dim - 1)
    lower = scenes.box([*side[0], 0.0], [*side[1], 1.0 - below], [*n, 4], cell)
    upper = scenes.box([*side[0], 0.0], [*side[1], 0.4], [*n, 2], cell)
    x = upper.geometry.x
    x[:, 0] = 0.3 + (x[:, 0] - 0.3) * (1.0 - 0.7 * x[:, dim - 1] / 0.4)
    x[:, dim - 1] += 1.0 + above
    return [mpm.Particles(body, V) for body in (lower, upper)]


def loose(touched):
    """Return which own nodes of V next to nothing holds."""
    hold = touched.hold()
    return (hold > 0.0) & (hold < 1e-2)


@pytest.mark.parametrize("cell", ALL, ids=scenes.name)
def test_a_toe_follows_the_cell_below_exactly(cell):
    bodies = stacked(cell)
    V = bodies[0].V
    owned = [body.W.dofmap.index_map.size_local for body in bodies]
    before = loose(TouchedNodes(V, [body.node_basis for body in bodies], owned))
    joints = joints_of("auto", bodies)
    touched = joints.touched()
    assert joints.count > 0
    assert scenes.largest(before.astype(float)) == 1.0
    assert scenes.largest(loose(touched).astype(float)) == 0.0
    u = polynomial(V, 1)
    x = vector(bodies[0].T, u)
    x.array_w[:] += np.where(touched.on_dofs(before), 1e9, 0.0)  # what is loose moves nobody
    for body in bodies:
        exact = scenes.fem.Function(body.W)
        dim = body.mesh.geometry.dim
        exact.interpolate(
            lambda x, dim=dim: np.array([1 + i - x[0] + (2 + i) * x[dim - 1] for i in range(dim)])
        )
        moved = body.T.createVecLeft()
        body.T.mult(x, moved)
        assert scenes.largest(moved.array_r - scenes.own(exact)) < 1e-12


def test_nothing_else_is_touched():
    lower, upper = stacked()
    assert joints_of("auto", [upper]) is None and joints_of(None, [lower, upper]) is None
    # It is held by itself where it bears on nobody, and where nothing is loose all stays.
    apart, held = stacked(below=0.6), stacked(above=0.03)
    for bodies in (apart, held):
        rows = [body.node_basis.values.copy() for body in bodies]
        joints = joints_of("auto", bodies)
        joints.touched()
        assert joints.count == 0
        for body, values in zip(bodies, rows, strict=True):
            assert np.array_equal(body.node_basis.values, values)


def stack(above, **options):
    """Return the stack under gravity."""
    bodies = stacked(above=above)
    V = bodies[0].V
    bcs = [scenes.fix(V, scenes.at(1, 0.0))]
    return posed(
        mpm.QuasiStaticProblem,
        bodies,
        Hencky(1e3, 0.3),
        density=DENSITY,
        body_force=(0.0, -GRAVITY),
        bcs=bcs,
        **options,
    )


@pytest.mark.parametrize("linear_solver", ["direct", "multigrid"])
def test_a_toe_settles_as_it_does_where_no_line_is_near(linear_solver):
    """Its corner sinks by 73 % more where the background lets it loose."""
    sunk = []
    for above, options in ((-1e-3, {}), (1e-7, {}), (1e-7, {"stabilisation": None})):
        problem = stack(above, linear_solver=linear_solver, **options)
        problem.solve(2)
        x = scenes.node_positions(problem.particles[1])
        sunk.append(1.0 + above - x[:, 1][x[:, 0].argmax()])
    assert abs(sunk[1] / sunk[0] - 1.0) < 2e-3
    assert sunk[2] > 1.5 * sunk[0]


def test_bodies_in_motion_have_no_joints():
    """Bodies that have met part again: see ``test_two_bodies_collide_on_one_background``."""
    bodies = stacked()
    problem = posed(
        mpm.DynamicProblem,
        bodies,
        Hencky(1e3, 0.3),
        density=DENSITY,
        body_force=(0.0, -GRAVITY),
        bcs=[scenes.fix(bodies[0].V, scenes.at(1, 0.0))],
    )
    problem.solve(time=0.05, dt=0.005)
    assert problem.history.statistics["joint_nodes"] == 0
