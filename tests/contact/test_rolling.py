# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Cylinders and balls that roll or slide down an incline, and a block on one in space."""

import numpy as np
import pytest
import scenes
from scenes import HEXAHEDRON, QUADRILATERAL, TETRAHEDRON, WORLD

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import contact
from mpm_dolfinx.materials import Hencky, LinearElastic

RADIUS, GRAVITY, ANGLE = 0.5, 10.0, np.radians(30.0)


def round_body(dim, n, centre):
    """Return a disc or a ball of n cells each way: a square or cube that is mapped."""
    kind = QUADRILATERAL if dim == 2 else HEXAHEDRON
    body = scenes.box([-1.0] * dim, [1.0] * dim, [n] * dim, kind)
    x = body.geometry.x[:, :dim].copy()
    for i in range(dim):
        others = [x[:, j] ** 2 for j in range(dim) if j != i]
        inner = 1.0 - sum(others) / 2.0 + (np.prod(others, axis=0) / 3.0 if dim == 3 else 0.0)
        body.geometry.x[:, i] = RADIUS * x[:, i] * np.sqrt(inner) + centre[i]
    return body


def rolled(dim, friction, n, cell, dt, steps, scheme="euler", rests=False):
    """Let a round body go down an incline; return its acceleration and T / N in the last half.

    It is let go where it touches, or where it rests with its weight on the incline.
    """
    c, s = np.cos(ANGLE), np.sin(ANGLE)
    along, normal = np.zeros(dim), np.zeros(dim)
    along[[0, -1]], normal[[0, -1]] = (c, -s), (s, c)
    way = 0.25 * GRAVITY * (steps * dt) ** 2
    low = np.array([-0.8] * (dim - 1) + [-0.7 - way * s])
    high = np.array([way * c + 1.2] + [0.8] * (dim - 2) + [1.3])
    cells = np.ceil((high - low) / cell).astype(int)
    kind = QUADRILATERAL if dim == 2 else HEXAHEDRON
    V = scenes.vectors(scenes.box(low, low + cell * cells, cells, kind))
    body = round_body(dim, n, normal * RADIUS * (1.0 + (-6e-3 if rests else 1e-9)))
    particles = mpm.Particles(body, V, quadrature_degree=2)
    ground = contact.Rigid(particles, contact.plane(np.zeros(dim), normal), friction)
    law, force = Hencky(1e6, 0.3), fem.Constant(body, -GRAVITY * c * normal)
    before = None
    if rests:
        before = mpm.QuasiStaticProblem(
            mpm.Body(particles, law, density=1000.0, body_force=force), terms=[ground]
        )
        before.solve(4)
    weight = np.append(np.zeros(dim - 1), -GRAVITY)
    problem = mpm.DynamicProblem(
        mpm.Body(particles, law, density=1000.0, body_force=fem.Constant(body, weight)),
        scheme=scheme,
        terms=[ground],
        after=before,
    )
    mass = 1000.0 * WORLD.allreduce(particles.initial_volume.sum())
    speeds, ratios = [], []
    for _ in problem.steps(time=steps * dt, dt=dt):
        speeds.append(problem.momentum @ along / mass)
        force = problem.reaction(ground)
        ratios.append(-(force @ along) / (force @ normal))
    assert problem.history.cutbacks == 0
    first = steps // 4
    slope = np.polyfit(dt * np.arange(first, steps), speeds[first:], 1)[0]
    return slope, np.mean(ratios[steps // 2 :])


def test_a_cylinder_rolls_with_two_thirds_of_the_acceleration():
    found, _ = rolled(2, 0.5, 10, 0.16, 0.015, 30)
    assert found == pytest.approx(2 / 3 * GRAVITY * np.sin(ANGLE), rel=0.03)


@pytest.mark.slow
def test_a_cylinder_that_rests_on_its_ground_rolls_without_bouncing():
    # (let go where it touches it bounces for ever in this scheme, slips as it lands, and has 0.96)
    found, _ = rolled(2, 0.5, 12, 0.125, 0.01, 60, "conserving", rests=True)
    assert found == pytest.approx(2 / 3 * GRAVITY * np.sin(ANGLE), rel=0.015)


@pytest.mark.slow
@pytest.mark.parametrize("dim", [2, 3])
def test_a_round_body_slides_with_the_friction_that_it_has(dim):
    n, cell, dt = (12, 0.125, 0.01) if dim == 2 else (8, 0.2, 0.02)
    found, ratio = rolled(dim, 0.1, n, cell, dt, 40 if dim == 2 else 20)
    exact = GRAVITY * (np.sin(ANGLE) - 0.1 * np.cos(ANGLE))
    assert found == pytest.approx(exact, rel=0.01 if dim == 2 else 0.02)
    # (points of a ball slip in ways that are not quite parallel)
    assert ratio == pytest.approx(0.1, rel=1e-6 if dim == 2 else 1e-3)


@pytest.mark.slow
def test_a_rough_ball_rolls_with_five_sevenths_of_the_acceleration():
    found, _ = rolled(3, 0.5, 8, 0.2, 0.02, 25)
    assert found == pytest.approx(5 / 7 * GRAVITY * np.sin(ANGLE), rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("friction", "kind", "tilt"), [(0.5, HEXAHEDRON, 20.0), (0.3, TETRAHEDRON, 0.0)]
)
def test_a_block_in_space_sticks_up_to_the_angle_of_friction(friction, kind, tilt):
    c, s = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
    x, y = np.cos(0.5), np.sin(0.5)
    along, normal = np.array([c * x, c * y, s]), np.array([-s * x, -s * y, c])
    body = scenes.box([0.0, -0.3, 0.0], [1.0, 0.3, 0.4], [5, 3, 2], kind)
    body.geometry.x[:] = body.geometry.x @ np.array([along, np.cross(normal, along), normal])
    V = scenes.vectors(scenes.box([-3, -3, -2.5], [3.1, 3.1, 2.5], [23, 23, 19], HEXAHEDRON))
    particles = mpm.Particles(body, V, quadrature_degree=2 if kind == HEXAHEDRON else None)
    ground = contact.Rigid(particles, contact.plane(np.zeros(3), normal), friction)
    force = fem.Constant(body, np.zeros(3))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, LinearElastic(1e4, 0.3), body_force=force), terms=[ground]
    )
    last = 0.0

    def path(t):
        # (no step ends at the angle itself, where any slip is an equilibrium)
        weight, turn = min(4.0 * t, 1.0) / t, 1.23 * np.arctan(friction) * max(t - 0.25, 0.0) / 0.75
        path.angle = np.degrees(turn)
        force.value[:] = -100.0 * weight * (np.cos(turn) * normal + np.sin(turn) * along)

    with pytest.raises(mpm.MPMError, match=r"load|limit"):
        for _ in problem.steps(12, update=path):
            last, reaction = path.angle, problem.reaction(ground)
    exact = np.degrees(np.arctan(friction))
    assert exact - 0.05 < last <= exact + 1e-9
    pressed = reaction @ normal
    assert np.linalg.norm(reaction - pressed * normal) == pytest.approx(
        friction * pressed, rel=1e-3
    )
