# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a problem leaves is freed with its last reference."""

import gc
import weakref

import pytest
import scenes


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
