# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Where a step failed, and what is said of it."""

import numpy as np
import pytest
import scenes
from scenes import QUADRILATERAL

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.stepping.diagnosis import improper


@pytest.mark.parametrize(("degree", "told"), [(1, True), (2, False)])
def test_quadrilaterals_that_cross_themselves_are_told_of_more_points(degree, told):
    V = scenes.vectors(scenes.box([-1.0, -1.0], [2.0, 2.0], [3, 3], QUADRILATERAL))
    particles = mpm.Particles(scenes.unit(2, QUADRILATERAL), V, quadrature_degree=degree)
    assert improper([particles], []) is None
    # The middle goes beyond a corner of the square.
    x = particles.W.tabulate_dof_coordinates()
    d = particles.displacement.x.array.reshape(-1, 2)
    d[(abs(x[:, :2] - 0.5) < 1e-9).all(axis=1)] = [0.7, 0.9]
    error = improper([particles], [])
    assert isinstance(error, mpm.DomainDistortionError) and error.particles
    assert ("quadrature_degree=2" in error.advice) is told


@pytest.mark.parametrize("later", [False, True])
def test_loads_that_are_not_finite_are_no_limit_of_the_ground(later):
    """They are told at once, without cutbacks, and the step before is whole."""
    V = scenes.vectors(scenes.box([-1.0, 0.0], [2.0, 2.0], [6, 4], QUADRILATERAL))
    body = scenes.unit(2, QUADRILATERAL)
    force = fem.Constant(body, (0.0, -1.0 if later else np.nan))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(mpm.Particles(body, V), mpm.materials.Hencky(100.0, 0.3), body_force=force),
        bcs=[mpm.held(V, y=0.0)],
    )
    if later:
        problem.solve(steps=1)
        force.value[0] = np.inf
    before = problem.bodies[0].displacement.x.array.copy()
    with pytest.raises(mpm.MPMError, match="not finite before anything moves") as error:
        problem.step() if later else problem.solve(steps=1)
    assert "limit" not in str(error.value) and problem.history.cutbacks == 0
    assert np.array_equal(problem.bodies[0].displacement.x.array, before)
