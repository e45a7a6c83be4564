# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Dirichlet values and reactions."""

import numpy as np
import pytest
import scenes
from compare import raises
from scenes import QUADRILATERAL, TRIANGLE

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky


@pytest.mark.parametrize("component", [None, 1])
def test_reaction_counts_a_dof_once(component):
    # Two sides' dofs put together name the corner twice, and here all of them three times.
    V = scenes.vectors(scenes.box([0.0, -0.25], [1.5, 1.25], [6, 6], QUADRILATERAL))
    particles = mpm.Particles(scenes.unit(4, TRIANGLE), V)
    V.mesh.topology.create_connectivity(1, 2)
    space = V if component is None else V.sub(component)
    sides = [
        fem.locate_dofs_topological(
            space,
            1,
            scenes.mesh.locate_entities(V.mesh, 1, scenes.at(*side)),
        )
        for side in ((1, 0.0), (0, 0.0))
    ]
    value = np.zeros(2) if component is None else 0.0
    both = fem.dirichletbc(value, np.concatenate([*sides, *sides, sides[0]]), space)
    others = [] if component is None else [scenes.fix(V, scenes.at(0, 0.0), component=0)]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, Hencky(1e3, 0.2), body_force=(0.0, -10.0)), bcs=[both, *others]
    )
    problem.solve(steps=1)
    force = sum(problem.reaction(bc) for bc in problem.bcs)
    np.testing.assert_allclose(force, [0.0, 10.0], rtol=1e-8, atol=1e-8)


def test_condition_that_is_not_a_number():
    V = scenes.block().particles.V
    bc = scenes.fix(V, scenes.at(0, 0.0), np.array([np.nan, 0.0]))
    failed = scenes.block(bcs=[])
    failed = mpm.QuasiStaticProblem(
        mpm.Body(mpm.Particles(scenes.unit(2, TRIANGLE), V), Hencky(1e3, 0.3)), bcs=[bc]
    )
    kept = scenes.state(failed)
    error = raises(lambda: failed.solve(steps=2), mpm.MPMError, r"Dirichlet.*finite")
    assert error.load == 0.0
    scenes.assert_same_state(kept, scenes.state(failed))
