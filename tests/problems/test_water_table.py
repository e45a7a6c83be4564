# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Water at rest in the ground: buoyancy and seepage, against exact stresses and known slopes."""

import numpy as np
import pytest
from compare import raises
from scenes import QUADRILATERAL, at, box, fix, in_order, largest, vectors

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import materials

WEIGHT, G = 9.81, (0.0, -10.0)


def ground(level, initial=True, **options):
    """Return ground, 4 m deep with rollers on its sides, with water up to a level."""
    V = vectors(box([0, 0], [2, 5], [4, 10], QUADRILATERAL), 2)
    body = box([0, 0], [2, 4], [8, 16], QUADRILATERAL)
    water = mpm.WaterTable(level, WEIGHT)
    given = {"pore_pressure": water} | options
    if given["pore_pressure"] is by_cells:
        given["pore_pressure"] = by_cells(body)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            mpm.Particles(body, V, degree=2),
            materials.LinearElastic(1e7, 0.25),
            density=2.0,
            body_force=G,
            initial_stress=mpm.geostatic(4.0, 2.0, 0.5, G, water=water) if initial else None,
            **given,
        ),
        bcs=[mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=2.0), mpm.held(V, 1, y=0.0)],
    )
    problem.solve()
    return problem


def effective(level, y):
    """Return the vertical effective stress of that ground."""
    total = 20.0 * (4.0 - y) + WEIGHT * max(level - 4.0, 0.0)
    return -(total - WEIGHT * np.maximum(level - y, 0.0))


@pytest.mark.parametrize("level", [0.0, 2.0, 4.0, 4.9])
def test_ground_with_water_is_in_equilibrium_as_it_is(level):
    problem = ground(level)
    body = problem.bodies[0]
    assert largest(np.abs(body.displacement.x.array)) < 1e-9
    y = body.initial_points[:, :, 1].mean(axis=1)
    assert in_order(body, body.stress[:, 1, 1]) == pytest.approx(
        in_order(body, effective(level, y)), rel=1e-6, abs=1e-6
    )


@pytest.mark.parametrize("level", [2.0, 4.0, 4.9])
def test_weight_and_buoyancy_make_the_effective_stress(level):
    body = ground(level, initial=False).bodies[0]
    y = body.initial_points[:, :, 1].mean(axis=1)
    found, expected = body.stress[:, 1, 1], effective(level, y)
    assert in_order(body, found) == pytest.approx(in_order(body, expected), abs=2e-3)


def test_a_pressure_in_ufl_is_the_same_and_seepage_acts_along_its_slope():
    by_level = ground(4.0).bodies[0].displacement.x.array
    in_ufl = ground(4.0, pore_pressure=lambda x: WEIGHT * (4.0 - x[1]))
    assert largest(np.abs(in_ufl.bodies[0].displacement.x.array - by_level)) < 1e-12
    # water that flows upwards with a gradient i takes i times its weight from the ground besides
    flow = ground(4.0, False, pore_pressure=lambda x: 1.5 * WEIGHT * (4.0 - x[1])).bodies[0]
    y = flow.initial_points[:, :, 1].mean(axis=1)
    expected = -(20.0 - 1.5 * WEIGHT) * (4.0 - y)
    assert in_order(flow, flow.stress[:, 1, 1]) == pytest.approx(in_order(flow, expected), abs=2e-3)


def test_a_level_by_points_is_straight_in_between_and_level_beyond():
    bends = [(0.5, 3.0), (1.0, 4.0), (1.6, 1.5)]
    water = mpm.WaterTable(bends, WEIGHT)
    assert water == mpm.WaterTable(np.array(bends), WEIGHT)
    x = np.zeros((3, 50))
    x[0] = np.linspace(-1.0, 3.0, 50)
    known = np.interp(x[0], *np.transpose(bends))
    assert water.level_at(x) == pytest.approx(known, abs=1e-12)
    body = box([0, 0], [2, 4], [8, 16], QUADRILATERAL)
    Q = fem.functionspace(body, ("Lagrange", 1))
    pressure = fem.Function(Q)
    pressure.interpolate(
        fem.Expression(water(ufl.SpatialCoordinate(body)), Q.element.interpolation_points)
    )
    at_nodes = Q.tabulate_dof_coordinates()
    below = np.interp(at_nodes[:, 0], *np.transpose(bends)) - at_nodes[:, 1]
    assert pressure.x.array == pytest.approx(WEIGHT * np.maximum(below, 0.0), abs=1e-12)
    # a level by points that is level is the level
    by_points, by_level = (ground(level).bodies[0] for level in ([(0.3, 2.0), (1.1, 2.0)], 2.0))
    assert largest(np.abs(by_points.stress - by_level.stress)) < 1e-9


def test_water_that_sinks_in_a_stage_loads_the_ground():
    problem = ground(4.0)
    problem.stage("sunk", problem.body().replace(pore_pressure=mpm.WaterTable(2.0, WEIGHT)))
    problem.solve()
    body = problem.bodies[0]
    y = body.initial_points[:, :, 1].mean(axis=1)
    assert in_order(body, body.stress[:, 1, 1]) == pytest.approx(
        in_order(body, effective(2.0, y)), abs=2e-3
    )


def slope(level, cell=2.5):
    """Return the slope of Griffiths & Lane (1999), examples 1 and 5, H = 10, with water."""
    H, weight = 10.0, 20.0
    crest, width = 1.2 * H, 2 * H
    n, k = (round(length / cell) for length in (crest + width, H))
    body = box([0, 0], [crest + width, H], [n, k], QUADRILATERAL)
    x = body.geometry.x
    x[:, 0] *= (crest + width * (1 - x[:, 1] / H)) / (crest + width)
    cells = [n + 4, k + 1]
    V = vectors(box([0, 0], [cell * c for c in cells], cells, QUADRILATERAL), 2)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            mpm.Particles(body, V, degree=2),
            materials.MohrCoulomb(1e5, 0.3, cohesion=0.05 * weight * H, friction_angle=20.0),
            density=weight,
            body_force=(0.0, -1.0),
            pore_pressure=None if level is None else mpm.WaterTable(level, WEIGHT),
        ),
        bcs=[fix(V, at(0, 0), component=0), fix(V, at(1, 0))],
        mixed="pressure",
    )
    problem.solve(2)
    return mpm.strength_reduction(problem, tolerance=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("level", "known"), [(10.0, 1.85), (3.0, 1.30), (None, 1.40)])
def test_factors_of_safety_of_a_slope_with_water(level, known):
    assert abs(slope(level).factor - known) < 0.03


def by_cells(body):
    """Return a pressure with a value in each cell, whose gradient is nothing."""
    p = fem.Function(fem.functionspace(body, ("Discontinuous Lagrange", 0)))
    p.interpolate(lambda x: 10.0 * (4.0 - x[1]))
    return p


def test_what_makes_no_sense_is_said():
    for build, words in (
        (lambda: mpm.WaterTable("high", 10.0), "level"),
        (lambda: mpm.WaterTable(1.0, -10.0), "positive"),
        (lambda: mpm.WaterTable([(1.0, 2.0), (1.0, 3.0)], 10.0), "each x larger than"),
        (lambda: mpm.WaterTable([(1.0, 2.0, 3.0)], 10.0), "must be pairs"),
        (lambda: mpm.WaterTable([(0.0, np.inf), (1.0, 3.0)], 10.0), "finite"),
        (lambda: mpm.WaterTable([], 10.0), "must be pairs"),
        (lambda: mpm.WaterTable(ufl.as_ufl(4.0), 10.0), "finite level, points"),
        (lambda: ground(4.0, pore_pressure=mpm.WaterTable(lambda x: np.nan, 10.0)), "The level of"),
        (lambda: ground(4.0, pore_pressure=mpm.WaterTable(lambda x: "high", 10.0)), "The level of"),
        (lambda: mpm.geostatic(4.0, 2.0, 0.5, G, water=3.0), "WaterTable"),
        (lambda: ground(4.0, pore_pressure=(1.0, 2.0)), "pore_pressure"),
        (lambda: ground(4.0, pore_fluid=mpm.PoreFluid(1.0)), "pore_fluid"),
        (lambda: ground(4.0, pore_pressure=by_cells), "gradient, which a Function that jumps"),
    ):
        raises(build, mpm.MPMError, words)
