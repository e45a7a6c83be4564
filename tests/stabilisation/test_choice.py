# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Ghost penalty: bounded condition, right in parallel."""

import numpy as np
import pytest
import scenes
from posed import posed
from scenes import QUADRILATERAL

import ufl

import mpm_dolfinx as mpm


def cantilever(offset, stabilisation, degree=2, h=0.5, **options):
    """Return a short elastic beam, clamped, that bends under a load on its end."""
    V = scenes.vectors(
        scenes.box([0.0, 0.0], [4.0, 4.0], [round(4 / h)] * 2, QUADRILATERAL), degree
    )
    n = round(2 / h)
    body = scenes.box([0.0, 2.5 - offset], [3.0, 3.5 - offset], [3 * n, n], QUADRILATERAL)
    tags = scenes.facet_tags(body, scenes.at(0, 3.0))
    return posed(
        mpm.QuasiStaticProblem,
        mpm.Particles(body, V, degree=degree),
        mpm.materials.Hencky(1e4, 0.2),
        bcs=[scenes.fix(V, scenes.at(0, 0.0))],
        tractions=[((0.0, -400.0), 1)],
        facet_tags=tags,
        stabilisation=stabilisation,
        **options,
    )


def test_slivers_do_not_matter():
    tips = []
    for offset in (0.0, 1e-9, 0.05, 0.185):
        problem = cantilever(offset, "ghost")
        problem.solve(steps=4)
        assert problem.history.cutbacks == 0
        volume = problem.particles.initial_volume
        drop = problem.particles.centroid - problem.particles.initial_centroid
        tips.append(scenes.total(problem.particles, drop * volume[:, None]))
    tips = np.array(tips)
    assert np.abs(tips - tips[0]).max() < 3e-3 * np.abs(tips[0]).max()


def condition(problem):
    """Return the condition number of the reduced tangent scaled to unit diagonal."""
    problem.solve(steps=1)
    K = scenes.dense(problem.A)
    scale = 1.0 / np.sqrt(np.diag(K))
    size = np.linalg.eigvalsh(K * np.outer(scale, scale))
    return size[-1] / max(size[0], 1e-300)


def test_condition_is_bounded():
    conditions = [condition(cantilever(s, "ghost")) for s in (0.25, 0.1, 1e-3, 1e-6)]
    assert max(conditions) < 1e3 * min(conditions)


def test_auto_acts_for_degree_2_and_where_a_cut_is_small():
    problem = cantilever(0.1, "auto", degree=1)
    problem.solve(steps=1)
    assert problem.history.statistics["ghost_facets"] == 0
    assert problem.reduced.unknowns.moduli is None
    problem = cantilever(0.05, "auto")
    problem.solve(steps=1)
    assert problem.history.statistics["ghost_facets"] > 0
    grid = scenes.vectors(scenes.unit(3, QUADRILATERAL), 2)
    particles = mpm.Particles(scenes.unit(6, QUADRILATERAL), grid, degree=2)
    sides = [(0, (0.0, 1.0)), (1, (0.0,))]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, mpm.materials.Hencky(1e3, 0.3), body_force=(0.0, -1.0)),
        bcs=[scenes.fix(grid, scenes.at(i, *ends), component=i) for i, ends in sides],
    )
    problem.solve(steps=1)
    assert problem.history.statistics["ghost_facets"] == 0
    assert np.isclose(problem.reduced.unknowns.moduli[0], 1e3 / 2.6, rtol=1e-6)


def test_modulus_and_answer_do_not_depend_on_units():
    tips = []
    for unit in (1.0, 1e9):
        problem = cantilever(0.05, "ghost")
        particles = problem.particles
        d, v = particles.displacement, ufl.TestFunction(particles.W)
        R = ufl.inner(scenes.linear_stress(d, 1e3 * unit, 0.3), ufl.grad(v)) * particles.dx
        b = ufl.as_vector([0.0, -unit])
        R -= particles.load * ufl.inner(b, v) * particles.dx_exact
        mine = mpm.ParticleProblem(
            R, particles, bcs=problem.bcs, solver=mpm.Solver(stabilisation="ghost")
        )
        mine.solve(steps=2)
        assert np.isclose(mine.reduced.unknowns.moduli[0], unit * 1e3 / 2.6)
        tips.append(scenes.in_order(particles, particles.centroid))
    assert np.abs(tips[1] - tips[0]).max() < 1e-9


def held(origin, degree=2, axisymmetric=False, stabilisation="ghost"):
    """Return a loaded block on a support of its own base, pressed from the side."""
    V = scenes.vectors(scenes.box([0.0, -0.5], [2.0, 1.5], [8, 8], QUADRILATERAL), degree)
    body = scenes.box([0.1, 0.03], [1.1, 1.03], [8, 8], QUADRILATERAL)
    tags = scenes.facet_tags(body, scenes.at(1, 0.03), scenes.at(0, 1.1))
    for domain in (V.mesh, body):
        domain.geometry.x[:, :2] += origin
    particles = mpm.Particles(body, V, degree=degree)
    return mpm.QuasiStaticProblem(
        mpm.Body(
            particles,
            mpm.materials.Hencky(1e3, 0.3),
            body_force=(0.0, -10.0),
            pressures=[(3.0, 2)],
            facet_tags=tags,
        ),
        supports=[mpm.boundary.fixed(particles, tags, 1)],
        axisymmetric=axisymmetric,
        solver=mpm.Solver(stabilisation=stabilisation),
    )


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("axisymmetric", [False, True])
def test_penalty_knows_neither_supports_nor_the_origin(axisymmetric, degree):
    shapes = []
    for origin in ((0.0, 0.0), (0.0 if axisymmetric else 1e4, -3e4)):
        problem = held(origin, degree, axisymmetric)
        problem.solve(steps=2)
        assert problem.history.statistics["ghost_facets"] > 0
        shapes.append(scenes.in_order(problem.particles, problem.particles.volume))
        around = 2.0 * np.pi * 0.6 if axisymmetric else 1.0
        assert np.isclose(problem.reduced.unknowns.moduli[0], around * 1e3 / 2.6, rtol=2e-2)
    assert np.abs(shapes[1] / shapes[0] - 1.0).max() < 1e-8


def test_modulus_of_a_residual_knows_neither_supports_nor_the_origin():
    for origin in ((0.0, 0.0), (1e4, -3e4)):
        particles = (problem := held(origin)).particles
        d, v = particles.displacement, ufl.TestFunction(particles.W)
        R = ufl.inner(scenes.linear_stress(d, 1e3, 0.3), ufl.grad(v)) * particles.dx
        R -= particles.load * ufl.inner(ufl.as_vector([0.0, -1.0]), v) * particles.dx_exact
        R += problem.setup.supports[0].residual
        mine = mpm.ParticleProblem(R, particles, solver=mpm.Solver(stabilisation="ghost"))
        mine.solve(steps=1)
        assert np.isclose(mine.reduced.unknowns.moduli[0], 1e3 / 2.6, rtol=1e-8)


def test_half_filled_cells_are_no_matter_of_round_off():
    # Along its sides the body fills halves of cells: 0.125 of 0.25.
    counts = set()
    for origin in ((0.0, 0.0), (100.0, -200.0), (1e4, -3e4), (0.3, 0.7)):
        problem = held(origin, 1)
        next(problem.steps(1000))
        counts.add(problem.history.statistics["ghost_facets"])
    assert len(counts) == 1


def test_imposed_displacement():
    # A uniform strain is imposed on the background's boundary; slivers follow.
    V = scenes.vectors(scenes.box([0.0, 0.0], [1.0, 2.0], [2, 4], QUADRILATERAL), 2)
    body = scenes.box([0.0, 0.0], [1.0, 1.5 + 1e-7], [4, 6], QUADRILATERAL)
    bcs = [
        scenes.fix(V, scenes.at(0, 0.0), component=0),
        scenes.fix(V, scenes.at(0, 1.0), -0.1, component=0),
        scenes.fix(V, scenes.at(1, 0.0), component=1),
    ]
    particles = mpm.Particles(body, V, degree=2)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, mpm.materials.Hencky(1e3, 0.3)),
        bcs=bcs,
        solver=mpm.Solver(stabilisation="ghost"),
    )
    problem.solve(steps=1)
    stress = particles.stress
    assert scenes.largest(stress[:, 1, 1]) < 1e-6 * scenes.largest(stress[:, 0, 0])
    force = problem.reaction(bcs[1])
    assert np.isclose(force[0], -problem.reaction(bcs[0])[0], rtol=1e-9)


@pytest.mark.parametrize("motion", [False, True])
def test_a_filled_cell_beyond_the_reach_of_all_nodes(motion):
    """Domains wider than cells fill cells with nodes that have no weight."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 2.0], [8, 8], QUADRILATERAL))
    body = scenes.box([0.0, 0.0], [1.41, 1.41], [2, 2], QUADRILATERAL)
    given = {
        "density": 2.0,
        "body_force": (0.0, -10.0),
        "bcs": [scenes.fix(V, scenes.at(i, 0.0), component=i) for i in (0, 1)],
        "stabilisation": "ghost",
    }
    kind = mpm.DynamicProblem if motion else mpm.QuasiStaticProblem
    problem = posed(kind, mpm.Particles(body, V), mpm.materials.Hencky(1e3, 0.3), **given)
    problem.solve(**({"time": 0.02, "dt": 0.01} if motion else {"steps": 2}))
    assert problem.history.cutbacks == 0
