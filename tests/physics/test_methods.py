# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Published errors of columns, method by method."""

import numpy as np
import pytest
import scenes
from scenes import QUADRILATERAL, A, B

from mpm_dolfinx.materials import Hencky, VonMises


def law(case):
    if np.isfinite(case.rho_y):
        return VonMises(case.young, case.poisson, rho_y=case.rho_y)
    return Hencky(case.young, case.poisson)


@pytest.mark.parametrize(
    ("case", "ne", "method", "error"),
    [
        (A, 16, "gimp", 3.659e-3),
        (A, 64, "gimp", 4.357e-4),
        (B, 16, "gimp", 3.844e-3),
        (A, 16, "mpm", 8.7e-2),
        pytest.param(A, 64, "mpm", 8.3e-2, marks=pytest.mark.slow),
        (A, 16, "cpdi", 2.57e-3),
    ],
)
def test_errors_of_the_columns(case, ne, method, error):
    problem = scenes.column(case, ne, QUADRILATERAL, law(case), method=method)
    problem.solve(steps=40)
    along = case.stress(problem.particles.initial_centroid[:, 1])[1]
    assert scenes.stress_error(problem, case, 1, along) == pytest.approx(error, rel=0.01)
    assert sum(problem.history.iterations) <= (170 if method == "mpm" else 130)
