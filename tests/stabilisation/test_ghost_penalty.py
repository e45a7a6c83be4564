# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Ghost penalty: exact on polynomials."""

import numpy as np
import pytest
import scenes
from scenes import ALL, PLANE, QUADRILATERAL, TRIANGLE, WORLD
from stabilisation.slivers import look, polynomial, sliver, vector

from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.stabilisation.ghost_penalty import PENALTY, GhostPenalty
from mpm_dolfinx.transfer.touched import TouchedNodes


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("cell", ALL, ids=scenes.name)
def test_penalty_vanishes_on_polynomials_alone(cell, degree):
    n = 4 if cell in PLANE else 2
    particles = sliver(cell, degree, 1e-3, n=n)
    ghost = GhostPenalty([particles])
    look(ghost, particles)
    assert ghost.counts["ghost_facets"] > 0
    G = ghost.penalty([1.0])
    kernel = vector(G, polynomial(particles.V, degree))
    residual = G.createVecLeft()
    G.mult(kernel, residual)
    assert residual.norm() < 1e-12 * G.norm() * kernel.norm()
    rough = vector(G, polynomial(particles.V, degree))
    rough.setRandom()
    G.mult(rough, residual)
    assert rough.dot(residual) > 0.0
    assert G.isSymmetric(1e-12 * PENALTY)


def test_penalty_vanishes_on_bent_cells():
    grid = scenes.bend(scenes.unit(4, QUADRILATERAL), 0.03)
    body = scenes.box([0.1, 0.1], [0.9, 0.6], [4, 3], TRIANGLE)
    particles = mpm.Particles(body, scenes.vectors(grid, 2), degree=2)
    ghost = GhostPenalty([particles])
    look(ghost, particles)
    G = ghost.penalty([1.0])
    x = vector(G, polynomial(ghost._V, 2))
    y = G.createVecLeft()
    G.mult(x, y)
    assert y.norm() < 1e-12 * G.norm() * x.norm()


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_penalty_is_the_jump_of_normal_derivatives(degree):
    # On two unit squares: sum_j 2/((2j+1) (j!)^2) h^(2j-1) int [d_n^j u][d_n^j v] bounds the
    # direct form from both sides; for a jump in one derivative alone they are compared exactly.
    grid = mesh.create_rectangle(
        WORLD, [[0.0, 0.0], [2.0, 1.0]], [2, 1], QUADRILATERAL, ghost_mode=mesh.GhostMode.none
    )
    body = scenes.box([0.0, 0.0], [1.0 + 1e-6, 1.0], [2, 2], QUADRILATERAL)
    V = scenes.vectors(grid, degree)
    particles = mpm.Particles(body, V, degree=degree)
    ghost = GhostPenalty([particles])
    look(ghost, particles)
    G = ghost.penalty([3.0])
    u = fem.Function(V)
    u.interpolate(lambda x: np.array([np.where(x[0] > 1.0, (x[0] - 1.0) ** degree, 0.0), 0 * x[1]]))
    x, y = vector(G, u), G.createVecLeft()
    G.mult(x, y)
    # (u_1 - u_2)^2 = (x - 1)^(2 k) over both cells, G / h^2 = 3
    assert np.isclose(x.dot(y), PENALTY * 3.0 * 2.0 / (2 * degree + 1), rtol=1e-10)


def test_carried_nodes_are_counted_once_on_any_number_of_ranks():
    """Whether there is a penalty hangs on nodes of V with weight over 36 nodes that are carried."""
    V = scenes.vectors(scenes.box([-0.1, -0.1], [1.9, 1.9], [8, 8], QUADRILATERAL))
    body = scenes.unit(8, QUADRILATERAL)
    cells = mesh.locate_entities(body, 2, lambda x: x[0] < 0.51)
    tags = mesh.meshtags(body, 2, cells, np.ones(len(cells), dtype=np.int32))
    particles = mpm.Particles(body, V, free=(tags, 1))
    touched = TouchedNodes(V, [particles.node_basis], [particles.W.dofmap.index_map.size_local])
    most = WORLD.allreduce(len(touched.active)) / 36.0
    for least, acts in ((most, True), (most * (1.0 + 1e-12), False)):
        ghost = GhostPenalty([particles], least)
        look(ghost, particles)
        assert ghost.acts is acts


def test_a_penalty_that_comes_later_does_not_depend_on_where_a_step_starts():
    """With degree 1 it comes where nodes enter cells; points may yield at the first guess then."""
    found = []
    for predictor in (True, False):
        V = scenes.vectors(scenes.box([0.0, -1.0], [2.0, 2.0], [6, 9], QUADRILATERAL))
        particles = mpm.Particles(scenes.unit(4, QUADRILATERAL), V)
        law = mpm.materials.VonMises(1e3, 0.3, rho_y=8.0, hardening=50.0)
        problem = mpm.QuasiStaticProblem(
            mpm.Body(particles, law, body_force=(0.0, -10.0)),
            bcs=[mpm.held(V, x=0.0)],
            solver=mpm.Solver(predictor=predictor),
        )
        problem.solve(2)
        assert problem.reduced.unknowns.moduli is None
        particles.load.value = 1.05
        problem.step()
        assert problem.history.statistics["ghost_facets"] > 0
        assert problem.reduced.unknowns.moduli == pytest.approx([1e3 / 2.6])
        found.append(scenes.in_order(particles, particles.centroid))
    np.testing.assert_allclose(*found, rtol=0.0, atol=1e-9)


def test_a_penalty_beside_forces_that_count_for_the_whole_step_counts_as_often():
    """Of the midpoint rule a body without inertia counts twice, as its forces are of the end."""
    V, other = (
        scenes.vectors(scenes.box([0.0, -1.0], [2.0, 2.0], [6, 9], QUADRILATERAL)) for _ in range(2)
    )
    mine, its = (mpm.Particles(scenes.unit(4, QUADRILATERAL), one) for one in (V, other))
    law = mpm.materials.Hencky(1e3, 0.3)
    problem = mpm.DynamicProblem(
        [mpm.Body(one, law, 1.0, (0.0, -1.0)) for one in (mine, its)],
        bcs=[mpm.held(V, x=0.0), mpm.held(other, x=0.0)],
        solver=mpm.Solver(stabilisation="ghost"),
        scheme="midpoint",
        quasi_static=[mine],
    )
    problem.step(0.1)
    assert problem.reduced.unknowns.moduli == pytest.approx([2e3 / 2.6, 1e3 / 2.6])


def test_whether_it_acts_is_asked_of_carried_nodes_each_counted_once_on_any_ranks():
    body, V = scenes.unit(6, TRIANGLE), scenes.vectors(scenes.unit(4, TRIANGLE))
    particles = mpm.Particles(body, V, free=lambda x: x[0] + x[1] < 0.9)
    x = np.unique(np.round(scenes.gather(particles.node_positions), 9), axis=0)
    carried = np.count_nonzero(~(x[:, 0] + x[:, 1] < 0.9))
    look(loose := GhostPenalty([particles]), particles)
    owned = particles.W.dofmap.index_map.size_local
    touched = TouchedNodes(V, [particles.node_basis], [owned])
    active = WORLD.allreduce(len(touched.active))
    assert loose.acts and 0 < carried < len(x)
    for more in (-0.01, 0.01):
        ghost = GhostPenalty([particles], least=(active + more) / carried)
        look(ghost, particles)
        assert ghost.acts == (more < 0.0)
