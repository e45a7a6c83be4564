# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a problem leaves is freed with its last reference."""

import gc
import weakref

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from routes import on_route

from dolfinx import fem

import mpm_dolfinx as mpm


def test_a_problem_ends_with_its_last_reference():
    # PETSc's callbacks must not keep it: a study of a hundred runs would use up the
    # communicators of MPI.
    problem = scenes.block()
    problem.solve(steps=2)
    alive = [weakref.ref(problem), weakref.ref(problem.particles)]
    del problem
    gc.collect()
    assert [reference() for reference in alive] == [None, None]


@pytest.mark.skip_in_parallel  # where the next problem frees them
@pytest.mark.parametrize("f_bar", ["none", "patch"])
def test_meshes_end_with_their_problem(f_bar):
    """Each holds communicators of MPI, of which there are about 2000."""
    problem = scenes.block(f_bar=f_bar, tractions=[])
    problem.solve(1)
    particles = problem.particles
    meshes = [weakref.ref(particles.mesh), weakref.ref(particles.V.mesh)]
    del problem, particles
    gc.collect()
    assert [mesh() for mesh in meshes] == [None, None]


@pytest.mark.skip_in_parallel
def test_problems_leave_nothing_that_grows():
    def count(problems):
        for _ in range(problems):
            scenes.block().solve(1)
        gc.collect()
        return len(gc.get_objects())

    count(2)
    assert abs(count(4) - count(4)) < 50


def free_communicators(enough=4000):
    """Return how many communicators MPI would still make (collective)."""
    made = []
    try:
        while len(made) < enough:
            made.append(scenes.WORLD.Dup())
    except MPI.Exception:
        pass
    for comm in made:
        comm.Free()
    return len(made)


def loaded():
    scenes.block().solve(1)


def repartitioned():
    problem = scenes.block()
    problem.repartition(0.0)
    problem.solve(1)


def split():
    problem = scenes.block(cell=scenes.QUADRILATERAL, force=(0.0, -1.0))
    problem.split([0])
    problem.solve(1)


def on_reference_route():
    with on_route("reference"):
        scenes.block(f_bar="patch", tractions=[]).solve(1)


def moving():
    V = scenes.vectors(scenes.box([-0.5] * 2, [1.5] * 2, [4, 4], scenes.QUADRILATERAL))
    body = mpm.Particles(scenes.unit(4, scenes.TRIANGLE), V)
    law = mpm.materials.Hencky(1e3, 0.3)
    mpm.DynamicProblem(body, law, density=2.0, body_force=(0.0, -1.0)).solve(1e-3, 1e-3)


def with_a_pressure():
    V = scenes.vectors(scenes.box([-0.5] * 2, [1.5] * 2, [4, 4], scenes.QUADRILATERAL), 2)
    body = mpm.Particles(scenes.unit(4, scenes.QUADRILATERAL), V, degree=2)
    law = mpm.materials.Hencky(1e3, 0.4999)
    bcs = [fem.dirichletbc(np.zeros(2), fem.locate_dofs_geometrical(V, lambda x: x[1] < 0.1), V)]
    problem = mpm.QuasiStaticProblem(body, law, 2.0, (0.0, -1.0), bcs=bcs, mixed="pressure")
    problem.repartition(0.0)
    problem.solve(1)


@pytest.mark.mpi
@pytest.mark.filterwarnings("ignore:The domains have")
def test_problems_leave_no_communicator():
    kinds = [loaded, repartitioned, split, on_reference_route, moving, with_a_pressure]

    def run(times):
        for _ in range(times):
            for kind in kinds:
                kind()
                gc.collect()

    run(1)
    before = free_communicators()
    run(3)
    assert free_communicators() == before
