# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""CPDI against parallelograms and against CPDI2."""

import numpy as np
import scenes
from scenes import HEXAHEDRON, TETRAHEDRON, TRIANGLE, box, vectors
from transfer.moved import GRADIENT, dense_weights, hat, moved_particles

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky


def test_cpdi_weights_are_those_of_the_parallelogram():
    # Sadeghirad, Brannon & Burghardt (2011), eqs 17 and 18: corners x_p -+ r1 -+ r2 with the
    # current half-edges r1, r2.
    particles = moved_particles("cpdi", GRADIENT)
    S, G, x = dense_weights(particles)
    r1, r2 = (np.eye(2) + GRADIENT) @ (0.05 * np.eye(2))
    r1, r2 = np.array([r1[0], r2[0]]), np.array([r1[1], r2[1]])
    volume = 4 * abs(r1[0] * r2[1] - r1[1] * r2[0])
    for p, centre in enumerate(particles.centroid):
        N = []
        for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
            (sx, _), (sy, _) = (hat((centre + s * r1 + t * r2)[k], x[:, k], 0.25) for k in (0, 1))
            N.append(sx * sy)
        slope = np.outer(N[0] - N[2], [r1[1] - r2[1], r2[0] - r1[0]])
        slope += np.outer(N[1] - N[3], [r1[1] + r2[1], -r1[0] - r2[0]])
        np.testing.assert_allclose(S[p], sum(N) / 4, atol=1e-12)
        np.testing.assert_allclose(G[p], slope / volume, atol=1e-10)


def test_cpdi_is_cpdi2_on_triangles():
    runs = []
    for method in ("cpdi", "cpdi2"):
        problem = scenes.slump(TRIANGLE, 20e3, h=1.0, method=method)
        problem.solve(steps=20)
        runs.append(scenes.in_order(problem.particles, problem.particles.domains))
    assert np.abs(runs[0]).max() > 8.0
    np.testing.assert_allclose(runs[0], runs[1], atol=1e-9)


def test_cpdi_is_cpdi2_on_tetrahedra():
    runs = []
    for method in ("cpdi", "cpdi2"):
        V = vectors(box([0.0] * 3, [2.0, 2.0, 1.2], [4, 4, 3], HEXAHEDRON))
        body = box([0.0] * 3, [1.0, 1.0, 1.0], [3, 3, 3], TETRAHEDRON)
        bcs = [scenes.fix(V, scenes.at(i, 0.0), component=i) for i in range(3)]
        problem = mpm.QuasiStaticProblem(
            mpm.Body(
                mpm.Particles(body, V, method=method),
                Hencky(1e3, 0.3),
                body_force=(0.0, 0.0, -300.0),
            ),
            bcs=bcs,
            solver=mpm.Solver(stabilisation=None),
        )
        problem.solve(steps=4)
        runs.append(scenes.in_order(problem.particles, problem.particles.domains))
    assert np.abs(runs[0] - runs[1]).max() < 1e-10
