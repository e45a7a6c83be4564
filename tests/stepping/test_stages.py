# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Runs one after the other: what was applied stays, and what a path says is what happens."""

import warnings

import numpy as np
import pytest
import scenes
from scenes import QUADRILATERAL, TRIANGLE, WORLD

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.boundary.supports import fixed, roller
from mpm_dolfinx.materials import Hencky, VonMises


def slope():
    """Return a bank on a rough base with a strip on its crest, the strip's load, the weight."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [12.0, 5.0], [24, 10], QUADRILATERAL))
    body = scenes.box([0.0, 0.0], [10.0, 4.0], [20, 8], QUADRILATERAL)
    x = body.geometry.x
    x[:, 0] -= 0.15 * x[:, 0] * x[:, 1]
    strip = fem.Constant(body, np.zeros(2))
    crest = scenes.facet_tags(body, lambda x: np.isclose(x[1], 4.0) & (x[0] < 2.0 + 1e-9))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            mpm.Particles(body, V),
            VonMises(2e7, 0.3, rho_y=3e4),
            density=2000.0,
            body_force=(0.0, -10.0),
            tractions=[(strip, 1)],
            facet_tags=crest,
        ),
        bcs=[scenes.fix(V, scenes.at(1, 0.0)), scenes.fix(V, scenes.at(0, 0.0), component=0)],
    )
    volume = WORLD.allreduce(problem.particles.initial_volume.sum())
    return problem, strip, 2000.0 * 10.0 * volume


def test_a_strip_load_after_the_weight():
    problem, strip, weight = slope()
    problem.solve(steps=2)
    for path in (lambda t: 8e4 * t, lambda t: 8e4 * (1.0 - 0.5 * t), lambda t: 4e4):

        def update(t, path=path):
            strip.value[1] = -path(t)

        for step in problem.steps(4, update=update):
            assert float(problem.particles.load.value) == 1.0
            force = problem.reaction(problem.bcs[0])[1]
            assert abs(force / (weight + 2.0 * path(step.load)) - 1.0) < 1e-9
    assert WORLD.allreduce(problem.particles.plastic_strain.sum()) > 0.0
    # Single steps go on from there too.
    strip.value[1] = 0.0
    problem.step()
    assert abs(problem.reaction(problem.bcs[0])[1] / weight - 1.0) < 1e-9


def sets_loads(problem, update):
    """Return whether a path in two steps is warned of, on rank 0."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        problem.solve(2, update=update)
    return sum("update= sets loads" in str(one.message) for one in told)


def test_a_path_that_sets_loads_which_grow_besides():
    """It is warned of once; not where the path sets the factor, or loads were applied before."""

    def load(strip):
        return lambda t: np.put(strip.value, 1, -8e4 * t)

    problem, strip, _ = slope()
    assert sets_loads(problem, load(strip)) == (WORLD.rank == 0)
    assert sets_loads(problem, lambda t: np.put(strip.value, 1, -8e4 * (1.0 - 0.5 * t))) == 0

    problem, strip, weight = slope()

    def all_of_it(t):
        problem.particles.load.value = 1.0
        load(strip)(t)

    assert sets_loads(problem, all_of_it) == 0
    assert abs(problem.reaction(problem.bcs[0])[1] / (weight + 2.0 * 8e4) - 1.0) < 1e-9

    problem, strip, _ = slope()
    assert sets_loads(problem, lambda t: None) == 0


def test_the_load_factor_goes_on_from_where_it_is(mpi_tmp_path):
    def pulled():
        problem = scenes.block(force=(0.0, -1.0))
        steps = problem.steps(4)
        next(steps), next(steps)
        return problem

    problem, asked = pulled(), []
    for step in problem.steps(5, update=asked.append):
        assert float(problem.particles.load.value) == 0.5 + 0.5 * step.load
        weight = 2.0 * (0.5 + 0.5 * step.load)
        np.testing.assert_allclose(
            problem.reaction(problem.bcs[0]), [0.0, weight], rtol=0.0, atol=1e-8
        )
        if step.load == 0.4:
            problem.save(mpi_tmp_path / "path.ckpt")
    assert asked == [k / 5 for k in range(1, 6)]
    again = scenes.block(force=(0.0, -1.0))
    again.restore(mpi_tmp_path / "path.ckpt")
    assert float(again.particles.load.value) == 0.7
    again.solve(5, update=asked.append)
    assert asked[5:] == [0.6, 0.8, 1.0]
    gap = again.particles.displacement.x.array - problem.particles.displacement.x.array
    assert scenes.largest(gap) < 1e-12

    # A path that sets the factor has its way, and the next one begins where that ended.
    def less(t):
        problem.particles.load.value = 1.0 - 0.6 * t

    problem.solve(2, update=less)
    assert float(problem.particles.load.value) == 0.4
    loads = []
    for _ in problem.steps(3, update=lambda t: None):
        loads.append(float(problem.particles.load.value))
    np.testing.assert_allclose(loads, [0.6, 0.8, 1.0], rtol=1e-15)


@pytest.mark.parametrize("kind", ["condition", "roller", "fixed"])
def test_displacements_are_totals_on_a_path(kind):
    # A block whose top is moved by a condition or a support; elsewhere it is held or free.
    V = scenes.vectors(scenes.box([-0.5, 0.0], [1.5, 1.5], [8, 6], QUADRILATERAL))
    body = scenes.box([0.0, 0.0], [1.0, 1.0], [4, 4], TRIANGLE)
    particles = mpm.Particles(body, V)
    wall = fem.Constant(V.mesh if kind == "condition" else body, np.zeros(2))
    top = scenes.facet_tags(body, scenes.at(1, 1.0))
    bcs = [scenes.fix(V, scenes.at(1, 0.0))]
    supports = []
    if kind == "condition":
        nodes = np.flatnonzero(V.tabulate_dof_coordinates()[:, 1] > 0.7).astype(np.int32)
        bcs.append(fem.dirichletbc(wall, nodes, V))
    elif kind == "roller":
        supports = [roller(particles, top, 1, (0.0, 1.0), wall[1])]
    else:
        supports = [fixed(particles, top, 1, wall)]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, Hencky(1e3, 0.3)), bcs=bcs, supports=supports
    )
    upper = np.isclose(particles.W.tabulate_dof_coordinates()[:, 1], 1.0)

    def moved_to(total):
        d = particles.displacement.x.array.reshape(-1, 2)[upper, 1]
        np.testing.assert_allclose(d, total, rtol=0.0, atol=2e-4 * abs(total) + 1e-9)
        assert float(wall.value[1]) == total

    def at(total):
        wall.value[1] = total

    # In proportion, then on a path that does not touch it, then on paths that do.
    at(-0.01)
    for step in problem.steps(2):
        d = particles.displacement.x.array.reshape(-1, 2)[upper, 1]
        np.testing.assert_allclose(d, -0.01 * step.load, rtol=2e-4, atol=0.0)
    for _ in problem.steps(2, update=lambda t: None):
        moved_to(-0.01)
    for step in problem.steps(2, update=lambda t: at(-0.01 - 0.02 * t)):
        moved_to(-0.01 - 0.02 * step.load)

    # With the load factor anywhere.
    def unloading(t):
        particles.load.value = 1.0 - t
        at(-0.03)

    for _ in problem.steps(2, update=unloading):
        moved_to(-0.03)
    particles.load.value = 0.3
    at(-0.04)
    problem.step()
    moved_to(-0.04)
    problem.solve(2)
    np.testing.assert_allclose(problem.history.load[-2:], [0.65, 1.0], rtol=1e-14)
    moved_to(-0.04)


def test_a_first_path_moves_supports_to_totals():
    # A failing step leaves the rule that was in force before.
    V = scenes.vectors(scenes.box([-0.5, 0.0], [1.5, 1.5], [8, 6], QUADRILATERAL))
    body = scenes.box([0.0, 0.0], [1.0, 1.0], [4, 4], TRIANGLE)
    particles = mpm.Particles(body, V)
    wall = fem.Constant(body, 0.0)
    top = roller(particles, scenes.facet_tags(body, scenes.at(1, 1.0)), 1, (0.0, 1.0), wall)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, Hencky(1e3, 0.3)),
        bcs=[scenes.fix(V, scenes.at(1, 0.0))],
        supports=[top],
    )

    def too_far(t):
        raise mpm.MPMError("The wall is too far")

    with pytest.raises(mpm.MPMError, match="too far"):
        problem.solve(2, update=too_far)
    assert (float(particles.load.value), float(particles.proportional.value)) == (0.0, 1.0)
    upper = np.isclose(particles.W.tabulate_dof_coordinates()[:, 1], 1.0)

    def path(t):
        wall.value = -0.01 * t

    for step in problem.steps(4, update=path):
        d = particles.displacement.x.array.reshape(-1, 2)[upper, 1]
        np.testing.assert_allclose(d, -0.01 * step.load, rtol=2e-4, atol=0.0)
