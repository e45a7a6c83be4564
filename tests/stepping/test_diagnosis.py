# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Where a step failed, and what is said of it."""

import pytest
import scenes
from scenes import QUADRILATERAL

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
    assert ("quadrature_degree=2" in str(error)) is told
