# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What deletion does to a body."""

import numpy as np
import pytest
import scenes
from scenes import QUADRILATERAL, TRIANGLE, WORLD, falling

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, LinearElastic


@pytest.mark.parametrize("method", ["cpdi2", "cpdi", "gimp", "mpm"])
def test_deleted_row_by_row(method):
    problem = falling(method=method)
    p = problem.particles
    for step in problem.steps(8):
        # GIMP and the point MPM keep a domain as long as the particle itself is inside.
        bottom = p.initial_centroid[:, 1] - (0.125 if method in ("cpdi2", "cpdi") else 0.0)
        expected = bottom - step.load < -0.5 - 1e-9
        assert np.array_equal(p.deleted, expected)
        # Those that are present move on, the others stay where they left.
        depth = step.load - np.zeros(p.num_local)
        depth[expected] = np.ceil(8 * (bottom[expected] + 0.5 + 1e-9)) / 8
        travelled = p.centroid - p.initial_centroid
        np.testing.assert_allclose(travelled[:, 1], -depth, atol=1e-12)
        np.testing.assert_allclose(travelled[:, 0], 0.0, atol=1e-12)
    statistics, losses = problem.history.statistics, problem.history.losses
    gone = scenes.total(p, p.deleted)
    assert gone == statistics["lost_particles"] > 0
    assert sum(len(loss.particles) for loss in losses) == gone
    here = scenes.gather(p.global_index[p.deleted])
    assert sorted(here) == sorted(i for loss in losses for i in loss.particles)
    mass = scenes.total(p, 3.0 * p.initial_volume[~p.deleted])
    assert abs(mass + statistics["lost_mass"] - 3.0) < 1e-12
    assert abs(statistics["lost_mass"] - 3.0 * statistics["lost_volume"]) < 1e-12
    assert scenes.largest(p.stress) < 1e-9
    # Nothing of the transfer or of the weights is left of them.
    weights = p.weights()
    assert np.all(np.diff(weights.offsets)[p.deleted] == 0)
    assert np.all(np.diff(weights.offsets)[~p.deleted] > 0)
    rows = np.diff(p.T.getValuesCSR()[0]).reshape(-1, 2)
    present = np.zeros(len(p.node_positions), dtype=int)
    present[p.domain_nodes[~p.deleted]] = 1
    if WORLD.size == 1:
        assert np.array_equal(rows[:, 0] > 0, present == 1)


def test_mass_by_a_density_that_varies():
    V = falling().particles.V
    body = scenes.unit(4, TRIANGLE)
    bc, u = scenes.everywhere(V)
    u.x.array.reshape(-1, 2)[:] = [0.0, -1.0]
    x = ufl.SpatialCoordinate(body)
    p = mpm.Particles(body, V, outside="delete")
    problem = mpm.QuasiStaticProblem(
        mpm.Body(p, LinearElastic(1e4, 0.3), density=1 + x[0] * x[1]), bcs=[bc]
    )
    problem.solve(steps=4)
    # Rows below y = 0.5 are out: the integral of 1 + x y over [0, 1] x [0, 0.5].
    assert len(problem.history.losses) == 2
    assert abs(problem.history.statistics["lost_mass"] - (0.5 + 0.5 * 0.125)) < 1e-12


def stretched(body, V, outside, material):
    """Return a bar held at its left side and pulled by its weight to the right."""
    p = mpm.Particles(body, V, outside=outside)
    bcs = [scenes.fix(V, scenes.at(0, 0.0))]
    return mpm.QuasiStaticProblem(
        mpm.Body(p, material, density=1.0, body_force=(1.0, 0.0)), bcs=bcs
    )


@pytest.mark.parametrize("cell", [TRIANGLE, QUADRILATERAL], ids=scenes.name)
def test_what_is_left_is_a_body_of_its_own(cell):
    # A bar grows out of the background. After each deletion its further way is that of a body
    # which never had these cells, put where the bar is.
    V = scenes.vectors(scenes.box([0.0, -0.5], [2.5, 1.0], [10, 6], QUADRILATERAL))
    material = Hencky(2.0, 0.3)
    bar = stretched(scenes.box([0.0, 0.0], [2.0, 0.5], [12, 3], cell), V, "delete", material)
    p = bar.particles
    for _ in bar.steps(8):
        if bar.history.losses:
            break
    kept = np.flatnonzero(~p.deleted).astype(np.int32)
    rest = mesh.create_submesh(p.mesh, p.mesh.topology.dim, kept)[0]
    other = stretched(rest, V, "error", material)
    q = other.particles
    d = p.displacement.x.array.reshape(-1, 2)
    nodes = p.W.tabulate_dof_coordinates()
    start = {tuple(np.round(X, 9)): row for X, row in zip(nodes, d, strict=True)}
    scenes.move(q, lambda X: np.array([start[tuple(np.round([*x, 0.0], 9))] for x in X]))
    q.load.value = p.load.value
    for _ in range(2):
        other.step()  # the equilibrium of what is left, at the same load
        bar.step()
    rows = [np.hstack([b.initial_centroid, b.centroid])[~b.deleted] for b in (p, q)]
    rows = [scenes.gather(r) for r in rows]
    one, two = (r[np.lexsort(np.round(r[:, :2], 9).T)] for r in rows)
    np.testing.assert_allclose(one, two, rtol=0, atol=1e-9)
    reactions = [b.reaction(b.bcs[0]) for b in (bar, other)]
    np.testing.assert_allclose(*reactions, rtol=0, atol=1e-8)
    here = scenes.total(p, p.initial_volume[~p.deleted])
    assert abs(here + bar.history.statistics["lost_mass"] - 1.0) < 1e-12
    # The support carries the weight of what is left.
    weight = here * bar.history.load[-1]
    np.testing.assert_allclose(bar.reaction(bar.bcs[0])[0], -weight, rtol=1e-8)


def test_a_deleted_domain_may_turn_inside_out():
    # The neighbours of a deleted domain drag its nodes through each other; a stored energy with
    # a logarithm of det F is no number there, and must not matter.
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 1.0], [8, 4], QUADRILATERAL))
    body = scenes.box([0.0, 0.0], [1.5, 1.0], [6, 4], TRIANGLE)
    p = mpm.Particles(body, V, outside="delete")
    d, v = p.displacement, ufl.TestFunction(p.W)
    R = ufl.derivative(scenes.neo_hookean(d) * p.dx, d, v)
    values = fem.Function(V)
    nodes = np.arange(len(values.x.array) // 2, dtype=np.int32)
    problem = mpm.ParticleProblem(R, p, bcs=[fem.dirichletbc(values, nodes)])
    X = p.initial_centroid
    gone = np.flatnonzero((np.abs(X[:, 0] - 0.6) < 0.13) & (np.abs(X[:, 1] - 0.4) < 0.13))
    p.placement.delete(gone)
    values.x.array[:] = V.tabulate_dof_coordinates()[:, :2].ravel() * [-0.2]
    problem.step()
    # Fold the deleted domains' nodes.
    inside = p.deleted.copy()
    moved = p.displacement.x.array.copy()
    nodes = np.unique(p.domain_nodes[inside])
    alone = np.setdiff1d(nodes, np.unique(p.domain_nodes[~inside]))
    moved.reshape(-1, 2)[alone] += 10.0
    assert np.isfinite(problem.b.array_r).all()
    before = p.deformation_gradient[inside]
    p.displacement.x.array[:] = moved
    p.commit()
    problem.step()
    assert np.isfinite(problem.history.steps[-1].residuals).all()
    assert np.array_equal(p.deformation_gradient[inside], before)
