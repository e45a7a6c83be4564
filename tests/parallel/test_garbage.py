# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a problem leaves is freed with its last reference."""

import gc
import weakref
from functools import partial

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from posed import staged as staged_with
from routes import on_route

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import contact


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
    mpm.DynamicProblem(mpm.Body(body, law, density=2.0, body_force=(0.0, -1.0))).solve(
        time=1e-3, dt=1e-3
    )


def with_a_pressure():
    V = scenes.vectors(scenes.box([-0.5] * 2, [1.5] * 2, [4, 4], scenes.QUADRILATERAL), 2)
    body = mpm.Particles(scenes.unit(4, scenes.QUADRILATERAL), V, degree=2)
    law = mpm.materials.Hencky(1e3, 0.4999)
    bcs = [fem.dirichletbc(np.zeros(2), fem.locate_dofs_geometrical(V, lambda x: x[1] < 0.1), V)]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(body, law, density=2.0, body_force=(0.0, -1.0)), bcs=bcs, mixed="pressure"
    )
    problem.repartition(0.0)
    problem.solve(1)


def with_water():
    V = scenes.vectors(scenes.box([-0.5] * 2, [1.5] * 2, [4, 4], scenes.QUADRILATERAL), 2)
    body = mpm.Particles(scenes.unit(2, scenes.QUADRILATERAL), V, degree=2)
    law = mpm.materials.Hencky(1e3, 0.3)
    mpm.PorousProblem(
        mpm.Body(body, law, body_force=(0.0, -1.0), pore_fluid=mpm.PoreFluid(0.02)),
        bcs=on_the_ground(V),
    ).step(0.05)


def on_the_ground(V):
    return [fem.dirichletbc(np.zeros(2), fem.locate_dofs_geometrical(V, lambda x: x[1] < 0.1), V)]


def ground():
    V = scenes.vectors(scenes.box([-0.5] * 2, [1.5] * 2, [4, 4], scenes.QUADRILATERAL))
    return mpm.Particles(scenes.unit(2, scenes.QUADRILATERAL), V, quadrature_degree=2)


def pressed(law):
    body = ground()
    die = contact.Rigid(body, contact.disc((0.5, 1.51), 0.5), 0.4, law=law)
    law = mpm.materials.Hencky(1e3, 0.3)
    problem = mpm.QuasiStaticProblem(mpm.Body(body, law), bcs=on_the_ground(body.V), terms=[die])
    die.move((0.0, -0.03))
    problem.step()


def under_a_footing():
    body = ground()
    shape = contact.box((0.2, 1.0), (0.8, 1.5), radius=0.1)
    footing = contact.RigidBody(body, shape, centre=(0.5, 1.0), friction=0.5)
    law = mpm.materials.Hencky(1e3, 0.3)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(body, law), bcs=on_the_ground(body.V), terms=[footing]
    )
    footing.push((0.0, -10.0))
    problem.step()


def two_bodies(term):
    background = scenes.box([-0.5] * 2, [1.5] * 2, [4, 4], scenes.QUADRILATERAL)
    upper, lower = (
        mpm.Particles(
            scenes.box(*corners, [3, 2], scenes.QUADRILATERAL),
            scenes.vectors(background),
            quadrature_degree=2,
        )
        for corners in (([0.1, 0.5], [0.9, 1.0]), ([0.0, 0.0], [1.0, 0.5]))
    )
    law = mpm.materials.Hencky(1e3, 0.3)
    bcs = [
        fem.dirichletbc(fem.Constant(background, (0.0, value)), dofs, V)
        for V, value, inside in (
            (upper.V, -0.02, lambda x: x[1] > 0.9),
            (lower.V, 0.0, lambda x: x[1] < 0.1),
        )
        for dofs in [fem.locate_dofs_geometrical(V, inside)]
    ]
    mpm.QuasiStaticProblem(
        [mpm.Body(p, law) for p in (upper, lower)], bcs=bcs, terms=[term(upper, lower)]
    ).step()


def tied(a, b):
    return mpm.Tie(a, b, scenes.facet_tags(a.mesh, scenes.at(1, 0.5)), 1, 1e4)


def staged():
    problem = scenes.block()
    problem.solve(1)
    staged_with(problem, density=2.0)
    problem.solve(1)


KINDS = {
    **{f.__name__: f for f in (loaded, repartitioned, split, on_reference_route, moving, staged)},
    **{f.__name__: f for f in (with_a_pressure, with_water, under_a_footing)},
    **{f"pressed, {law}": partial(pressed, law) for law in ("penalty", "nitsche")},
    "a pair": partial(two_bodies, contact.Pair),
    "tied": partial(two_bodies, tied),
}


def run(kind, times):
    for _ in range(times):
        KINDS[kind]()
        gc.collect()


@pytest.mark.filterwarnings("ignore:The domains have")
def test_problems_leave_no_communicator():
    # (To count them takes longer than to run: one by one where there is something to find.)
    for kind in KINDS:
        run(kind, 1)
    free = free_communicators()
    for kind in KINDS:
        run(kind, 3)
    if (left := free_communicators()) >= free:
        return
    leaks = {}
    for kind in KINDS:
        run(kind, 3)
        free, left = left, free_communicators()
        leaks[kind] = (free - left) / 3
    # (what one of the run before had left to the garbage collector is not of a kind)
    assert not any(leaks.values()), f"Communicators that a problem leaves: {leaks}"
