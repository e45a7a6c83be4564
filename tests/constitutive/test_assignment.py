# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Which material governs which points: by tags, by parameters, and parameters out of range."""

import numpy as np
import pytest
import scenes
from bad_input import particles, with_one_value
from compare import raises
from scenes import QUADRILATERAL, WORLD, A, top
from scipy.integrate import quad

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, VonMises

LAYERS = {1: 1e4, 2: 3e4}


def layered(kind):
    """Return a function that makes the materials of a column with a stiff lower half."""

    def make(body):
        tags = scenes.cell_tags(body, lambda x: np.where(x[:, 1] > A.length / 2, 1, 2))
        if kind == "materials":
            return {tag: Hencky(young, 0.0) for tag, young in LAYERS.items()}, {"cell_tags": tags}
        space = fem.functionspace(body, ("Discontinuous Lagrange", 0))
        young = fem.Function(space)
        young.x.array[space.dofmap.list[tags.indices, 0]] = [LAYERS[t] for t in tags.values]
        return Hencky(young, 0.0), {}

    return make


def test_materials_by_tag_and_parameters_by_cell():
    problems = []
    for kind in ("materials", "parameters"):
        problem = scenes.column(A, 16, QUADRILATERAL, None, material_of=layered(kind))
        problem.solve(steps=20)
        problems.append(problem)
    one, two = (problem.particles for problem in problems)
    np.testing.assert_allclose(one.stress, two.stress, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(one.displacement.x.array, two.displacement.x.array, atol=1e-12)
    Y = one.initial_centroid[:, 1]
    assert scenes.stress_error(problems[0], A, 1, -A.g0 * (A.length - Y)) < 1.5e-2
    stiff = A._replace(young=LAYERS[2])
    layers = (stiff, 0.0, A.length / 2), (A, A.length / 2, A.length)
    height = sum(quad(lambda y, c=c: np.exp(-c.strain(y)), a, b)[0] for c, a, b in layers)
    assert abs(top(problems[0]) - height) < 0.05
    assert abs(height - 24.06) > 5.0


def test_one_parameter_out_of_range():
    # Only the rank that owns the particle sees that its modulus is negative.
    young = with_one_value(particles(), 1e3, -1.0)
    raises(lambda: Hencky(young, 0.3), mpm.MPMError, r"young is -1")


@pytest.mark.parametrize(
    ("name", "value", "match"),
    [
        ("young", -1.0, "young is -1 but"),
        ("yield_stress", np.nan, "yield_stress is nan but"),
        ("hardening", -2.0, "hardening is -2 but"),
    ],
)
def test_one_value_out_of_range_in_arrays_of_the_ranks(name, value, match):
    p = particles()
    values = np.full(p.num_local, 1e3)
    values[p.global_index == 0] = value
    parameters = {"young": 1e3, "yield_stress": 1.0, name: values}
    raises(
        lambda: mpm.QuasiStaticProblem(mpm.Body(p, VonMises(poisson=0.3, **parameters))),
        mpm.MPMError,
        match,
    )


def test_one_array_of_another_length():
    p = particles()
    young = np.full(p.num_local + (WORLD.rank == WORLD.size - 1), 1e3)
    raises(
        lambda: mpm.QuasiStaticProblem(mpm.Body(p, Hencky(young, 0.3))), mpm.MPMError, "young has"
    )
