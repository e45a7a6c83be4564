# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""History of points: of several materials, and of an update that fails."""

import numpy as np
import pytest
import scenes
from scenes import QUADRILATERAL, B

import mpm_dolfinx as mpm
from mpm_dolfinx.constitutive.beginning import begin_unstrained
from mpm_dolfinx.constitutive.energies import elastic_energy
from mpm_dolfinx.materials import Hencky, VonMises


def test_materials_with_different_histories():
    # An elastic layer on a plastic one: each particle has its own law's variables.
    def make(body):
        tags = scenes.cell_tags(body, lambda x: np.where(x[:, 1] > 2.0, 7, 3))
        materials = {7: Hencky(B.young, B.poisson), 3: VonMises(B.young, B.poisson, rho_y=B.rho_y)}
        return materials, {"cell_tags": tags}

    problem = scenes.column(B, 10, QUADRILATERAL, None, material_of=make)
    problem.solve(steps=10)
    particles = problem.particles
    Y = particles.initial_centroid[:, 1]
    elastic = Y > 2.0
    assert np.all(particles.plastic_strain[elastic] == 0.0)
    assert np.all(particles.plastic_strain[~elastic] > 0.0)
    np.testing.assert_allclose(problem.yield_function[elastic], -1.0)
    np.testing.assert_allclose(problem.yield_function[~elastic], 0.0, atol=1e-12)
    across = np.where(elastic, B._replace(rho_y=np.inf).stress(Y)[0], B.stress(Y)[0])
    assert scenes.stress_error(problem, B, 0, across) < 6e-3


def test_an_update_that_fails_leaves_the_last_converged_step():
    problem = scenes.block(VonMises(1e3, 0.3, rho_y=60.0))
    problem.solve(steps=1)
    (body,), (stress,) = problem.bodies, problem.points
    at_rest = elastic_energy(stress)
    good = body.displacement.x.array.copy()
    x = body.W.tabulate_dof_coordinates()[:, :2]
    body.displacement.x.array[:] += 0.3 * x.ravel()
    stress.update()
    assert (
        not stress.trial.is_elastic_since(stress.last)
        and (elastic_energy(stress, trial=True) != at_rest).any()
    )
    body.displacement.x.array[:] = (x * (-2.0, 0.0)).ravel()  # turned inside out
    with pytest.raises(mpm.MPMError):
        stress.update()
    assert stress.trial.is_elastic_since(stress.last)
    np.testing.assert_array_equal(elastic_energy(stress, trial=True), at_rest)
    body.displacement.x.array[:] = good
    stress.roll_back()
    np.testing.assert_array_equal(elastic_energy(stress), at_rest)


@pytest.mark.parametrize("f_bar", ["none", "patch"])
def test_memories_and_displacements_bring_a_converged_step_back(f_bar):
    law = VonMises(1e3, 0.3, yield_stress=20.0, hardening=300.0)
    problem = scenes.block(law, f_bar=f_bar)
    problem.solve(steps=2)
    (points,) = problem.points
    (kept,) = points.last.states
    assert problem.particles.mesh.comm.allreduce(kept["plastic_strain"].sum()) > 0.0
    memories = [{name: v.copy() for name, v in own.items()} for own in points.last.memories()]
    count = len(kept["stress"])
    assert sum(values.nbytes for values in memories[0].values()) == 40 * count
    begin_unstrained(points)
    assert not points.last.states[0]["displacement_gradient"].any()
    points.recall(memories)
    for name in kept.keys() - {"stress"}:
        np.testing.assert_array_equal(points.last.states[0][name], kept[name])
