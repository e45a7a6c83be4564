# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The same answer in metres and pascals, in millimetres and megapascals, and 1e9 times larger."""

import numpy as np
import pytest
import scenes
from marks import slow
from posed import posed
from scenes import QUADRILATERAL

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, VonMises

#: Length and stress in the units at hand, in metres and pascals.
UNITS = {"millimetres": (1e-3, 1e6), "small": (1e-9, 1.0), "stiff": (1.0, 1e9)}


def case(name, length=1.0, stress=1.0, **options):
    """Return a problem in units of a length and a stress, and its number of steps."""
    size, width, h, steps = {
        "A": ((50.0 / 16, 50.0), 50.0 / 16, 50.0 / 16, 10),
        "B": ((0.625, 10.0), 0.625, 0.625, 10),
        "C": ((4.0, 8.0), 18.0, 1.0, 12),
    }[name]
    weight, law = {
        "A": (800.0, lambda: Hencky(1e4 / stress, 0.0)),
        "B": (8e3, lambda: VonMises(2e5 / stress, 0.3, rho_y=20e3 / stress)),
        "C": (20e3, lambda: VonMises(1e6 / stress, 0.3, rho_y=20e3 / stress)),
    }[name]
    high = max(size[1], 10.0)
    n = [round(width / h), round(high / h)]
    V = scenes.vectors(scenes.box([0.0, 0.0], [n[0] * h, n[1] * h], n, QUADRILATERAL))
    body = scenes.box([0.0, 0.0], size, [round(2 * x / h) for x in size], QUADRILATERAL)
    for domain in (V.mesh, body):
        domain.geometry.x[:] /= length
    sides = (0.0,) if name == "C" else (0.0, h)
    bcs = [fix(V, 0, [x / length for x in sides]), fix(V, 1, [0.0])]
    force = -weight * length / stress
    problem = posed(
        mpm.QuasiStaticProblem,
        mpm.Particles(body, V),
        law(),
        density=1.0,
        body_force=(0.0, force),
        bcs=bcs,
        **options,
    )
    return problem, steps


def fix(V, component, places):
    size = np.abs(V.mesh.geometry.x).max(initial=0.0)
    size = scenes.largest(size)
    return scenes.fix(
        V,
        lambda x: np.any(np.abs(x[component][:, None] - places) < 1e-9 * size, axis=1),
        component=component,
    )


def result(problem):
    p = problem.particles
    reactions = [problem.reaction(bc) for bc in problem.bcs]
    return p.centroid, p.stress, p.plastic_strain, np.array(reactions)


@pytest.mark.parametrize("name", ["A", *slow("B"), "C"])
def test_units(name):
    problem, steps = case(name)
    problem.solve(steps=steps)
    expected = result(problem)
    iterations = problem.history.iterations
    for unit, (length, stress) in UNITS.items():
        problem, _ = case(name, length, stress)
        problem.solve(steps=steps)
        assert problem.history.cutbacks == 0
        assert problem.history.iterations == iterations, unit
        answer = result(problem)
        factors = (length, stress, 1.0, stress * length)
        for one, two, factor in zip(expected, answer, factors, strict=True):
            size = max(scenes.largest(one), 1e-12)
            np.testing.assert_allclose(two * factor, one, rtol=0, atol=1e-8 * size, err_msg=unit)


#: Origins of coordinates, the last two those of a map.
ORIGINS = ((0.0, 0.0), (1.1e4, -2.3e4), (5.3e5, 4.1e6), (5.3e5 + 0.1, 4.1e6 + 0.3))


def near(V, component, places):
    """Return a condition on lines of a background of unit cells, or of a tenth of that."""
    return scenes.fix(
        V,
        lambda x: np.any(np.abs(x[component][:, None] - places) < 1e-3, axis=1),
        component=component,
    )


@pytest.mark.parametrize("cell", scenes.PLANE, ids=scenes.name)
@pytest.mark.parametrize("ground", scenes.PLANE, ids=scenes.name)
def test_a_body_on_lines_of_its_background_wherever_the_origin_is(cell, ground):
    # Nodes on facets and on the border have coordinates of a round-off that is not that of cells.
    found = []
    h = 0.1
    for origin in ORIGINS:
        low = np.array(origin)
        V = scenes.vectors(scenes.box(low, low + 7 * h, [7, 7], ground))
        body = scenes.box(low, low + np.array([7 * h, 3 * h]), [14, 6], cell)
        bcs = [near(V, 0, [low[0], low[0] + 7 * h]), near(V, 1, low[1:])]
        particles = mpm.Particles(body, V)
        problem = mpm.QuasiStaticProblem(
            mpm.Body(particles, Hencky(1e4, 0.3), body_force=(0.0, -100.0)), bcs=bcs
        )
        problem.solve(steps=2)
        force = problem.reaction(bcs[1])
        found.append((scenes.in_order(particles, particles.volume), force))
        assert abs(force[1] - 100.0 * 21 * h**2) < 1e-6
    for volume, force in found[1:]:
        assert np.abs(volume / found[0][0] - 1.0).max() < 1e-7
        assert np.abs(force - found[0][1]).max() < 1e-6


def test_a_controlled_point_in_coordinates_of_a_map():
    low = np.array(ORIGINS[-1])
    V = scenes.vectors(scenes.box(low, low + 7.0, [7, 7], QUADRILATERAL))
    particles = mpm.Particles(
        scenes.box(low, low + np.array([7.0, 3.0]), [14, 6], scenes.TRIANGLE), V
    )
    bcs = [near(V, 1, low[1:]), near(V, 0, [low[0], low[0] + 7.0])]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, Hencky(1e4, 0.3), body_force=(0.0, -10.0)), bcs=bcs
    )
    top = low + np.array([7.0, 3.0])
    control = mpm.DisplacementControl(particles, 0.01, point=top, direction=(0.0, -1.0))
    problem.solve(2, control=control)
    assert np.isclose(control.present(), 0.01)
