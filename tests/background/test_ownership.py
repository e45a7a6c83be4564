# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The ranks that particles live on."""

import numpy as np
import pytest
import scenes
from scenes import QUADRILATERAL, TRIANGLE, WORLD

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky
from mpm_dolfinx.meshes.redistribution import Redistribution


def test_particles_are_where_their_background_is():
    # The body fills the background.
    V = scenes.vectors(scenes.box([0.0, 0.0], [4.0, 4.0], [32, 32], QUADRILATERAL))
    body = scenes.box([0.0, 0.0], [4.0, 4.0], [64, 64], TRIANGLE)
    particles = mpm.Particles(body, V)
    particles.repartition()
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, Hencky(1e3, 0.3), body_force=(0.0, -1.0)),
        bcs=[scenes.fix(V, scenes.at(i, 0.0, 4.0), component=i) for i in (0, 1)],
    )
    assert np.all(particles.best_ranks() == WORLD.rank)
    problem.solve(1)
    statistics = problem.history.statistics
    assert statistics["off_rank_rows"] <= 0.03 * 2 * (WORLD.size - 1)
    assert statistics["particle_imbalance"] <= 1.06
    assert statistics["dof_imbalance"] <= 1.06
    assert not problem.repartition(0.0)


@pytest.mark.mpi
def test_particles_of_a_rank_are_together():
    # A column in a corner of the background, which flows until it is a flat heap.
    problem = scenes.slump(TRIANGLE, 40e3, h=0.5, width=30.0)
    problem.solve(steps=10)
    before = problem.history.statistics["off_rank_rows"]
    assert problem.repartition(0.1)
    for _ in range(2):  # each part stays with the rank that has it
        assert not problem.repartition(0.01)
    problem.particles.load.value = 0.99
    problem.step()
    assert problem.history.statistics["off_rank_rows"] < 0.7 * before
    assert problem.history.statistics["particle_imbalance"] <= 1.05


@pytest.mark.mpi
def test_idle_ranks_get_particles():
    # All in one corner, and all on one rank: nobody has more than its share afterwards.
    problem = scenes.block()
    particles = problem.particles
    ranks = np.zeros(particles.num_local, dtype=np.int64)
    particles.live_on(Redistribution(particles.mesh, ranks))
    problem = mpm.QuasiStaticProblem(mpm.Body(particles, Hencky(1e3, 0.3)), bcs=problem.bcs)
    assert (particles.num_local == 0) == (WORLD.rank > 0)
    assert problem.repartition(0.1)
    assert particles.num_local <= np.ceil(1.05 * particles.num_global / WORLD.size)
    assert problem.particles is particles and not problem.repartition(0.1)
