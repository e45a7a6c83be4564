# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Point MPM, GIMP and CPDI beside CPDI2: weights, updates, published errors."""

import numpy as np
import pytest
import scenes
from scenes import QUADRILATERAL, box, vectors
from transfer.moved import GRADIENT, dense_weights, moved_particles

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky

METHODS = ["cpdi2", "cpdi", "gimp", "mpm"]


@pytest.mark.parametrize("method", METHODS)
def test_linear_completeness(method):
    S, G, x = dense_weights(particles := moved_particles(method, GRADIENT))
    np.testing.assert_allclose(S.sum(axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(S @ x, particles.centroid, atol=1e-12)
    np.testing.assert_allclose(G.sum(axis=1), 0.0, atol=1e-10)
    np.testing.assert_allclose(
        np.einsum("pid,ic->pdc", G, x), np.tile(np.eye(2), (len(G), 1, 1)), atol=1e-10
    )


@pytest.mark.parametrize("method", METHODS)
def test_a_linear_motion_of_the_background_is_followed_exactly(method):
    V = vectors(box([-1.0, -1.0], [2.0, 2.0], [12, 12], QUADRILATERAL))
    body = box([0.1, 0.2], [0.6, 0.5], [5, 3], QUADRILATERAL)
    condition, values = scenes.everywhere(V)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(mpm.Particles(body, V, method=method), Hencky(1e3, 0.3)), bcs=[condition]
    )
    centre = problem.particles.centroid.copy()
    turn, F = 0.0, np.eye(2)
    for _ in range(8):
        # Each step shears and turns the background as it is now; totals are sums of changes.
        turn += 0.1
        step = np.array([[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]])
        step = step @ [[1.0, 0.05], [0.0, 1.0]]
        x = V.tabulate_dof_coordinates()[:, :2]
        values.x.array[:] += (x @ (step - np.eye(2)).T).ravel()
        problem.step()
        F, centre = step @ F, centre @ step.T
    particles = problem.particles
    np.testing.assert_allclose(particles.centroid, centre, atol=1e-12)
    np.testing.assert_allclose(
        particles.deformation_gradient[:, :2, :2], np.tile(F, (len(centre), 1, 1)), atol=1e-11
    )
    np.testing.assert_allclose(particles.volume, particles.initial_volume, rtol=1e-11)
