# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Loads as functions."""

import numpy as np
import scenes
from scenes import QUADRILATERAL, TRIANGLE

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky


def test_density_and_force_as_functions():
    # The same load as numbers, as Constants, as a Function and as an expression.
    runs = []
    for kind in ("number", "constant", "function", "expression"):
        V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 1.0], [8, 4], QUADRILATERAL))
        body = scenes.unit(6, TRIANGLE)
        body.geometry.x[:, 1] *= 0.9
        density, force = 2.0, (1.0, -4.0)
        if kind == "constant":
            density, force = fem.Constant(body, 2.0), fem.Constant(body, np.array(force))
        elif kind == "function":
            density = fem.Function(fem.functionspace(body, ("Discontinuous Lagrange", 0)))
            density.x.array[:] = 2.0
            given = fem.Function(scenes.vectors(body))
            given.x.array.reshape(-1, 2)[:] = force
            force = given
        elif kind == "expression":
            X = ufl.SpatialCoordinate(body)
            force = ufl.as_vector([1.0 + 0 * X[0], -4.0 + 0 * X[1]])
        problem = mpm.QuasiStaticProblem(
            mpm.Body(mpm.Particles(body, V), Hencky(1e3, 0.3), density=density, body_force=force),
            bcs=[scenes.fix(V, scenes.at(1, 0.0))],
        )
        problem.solve(steps=2)
        np.testing.assert_allclose(
            problem.reaction(problem.bcs[0]), [-2.0 * 0.9, 8.0 * 0.9], rtol=1e-8
        )
        runs.append(problem.particles.displacement.x.array)
    for run in runs[1:]:
        np.testing.assert_allclose(run, runs[0], atol=1e-13)
