# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Particles that live where the background is in which they lie."""

import gc
import weakref

import numpy as np
import pytest
import scenes
from compare import outcome, same_run
from posed import posed
from scenes import QUADRILATERAL, TRIANGLE, WORLD, anywhere

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, VonMises
from mpm_dolfinx.meshes.redistribution import Redistribution


@pytest.mark.mpi
def test_meshes_between_are_forgotten():
    # Each holds some communicators of MPI, of which there are about 2000. Eight are remembered.
    problem = flowing("given")
    particles = problem.particles
    last = early = problem.setup.bodies[0].cell_tags
    young = fem.Function(fem.functionspace(particles.mesh, ("DG", 0)))
    young.interpolate(lambda x: 1.0 + x[1])
    meshes = []
    for seed in range(11):
        ranks = anywhere(particles.mesh, seed)
        problem.state.renew(
            lambda ranks=ranks: particles.live_on(Redistribution(particles.mesh, ranks)),
            lambda state: state,
        )
        meshes.append(weakref.ref(particles.mesh))
        last = particles.carry(last)
        if seed == 4:
            early = last
    other = flowing("given")
    for one in (problem, other):
        one.solve(2)
    gc.collect()
    assert [known() is not None for known in meshes] == [False] * 2 + [True] * 9
    same_run(outcome(problem), outcome(other), 1e-9)
    own = slice(particles.num_local)
    middle = mesh.compute_midpoints(
        particles.mesh, 2, np.arange(particles.num_local, dtype=np.int32)
    )
    for tags in (last, particles.carry(early)):
        np.testing.assert_array_equal(tags.values[own], 1 + (middle[:, 1] > 4.0))
    carried = particles.carry(young)
    assert carried.function_space.mesh is particles.mesh
    np.testing.assert_allclose(carried.x.array[own], 1.0 + middle[:, 1], rtol=1e-12)


def weight(domain):
    """Return a weight that varies over the body, on its mesh of the moment."""
    return ufl.as_vector((0.0, -12.0 + 0.1 * ufl.SpatialCoordinate(domain)[0]))


def flowing(partition, comm=WORLD, **options):
    """A column of two materials that slumps, under a pressure on its top."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [12.0, 9.0], [12, 9], QUADRILATERAL, comm))
    body = scenes.box([0.0, 0.0], [4.0, 8.0], [8, 16], TRIANGLE, comm)
    tags = scenes.cell_tags(body, lambda x: 1 + (x[:, 1] > 4.0))
    young = fem.Function(fem.functionspace(body, ("DG", 0)))
    young.interpolate(lambda x: 1e6 * (1.0 + 0.05 * x[1]))
    law = VonMises(young, 0.3, rho_y=20e3, hardening=2e4)
    particles = mpm.Particles(body, V)
    if partition == "background":
        particles.repartition()
    return posed(
        mpm.QuasiStaticProblem,
        particles,
        {1: law, 2: Hencky(1e6, 0.3)},
        density=1000.0,
        body_force=lambda x: (0.0, -12.0 + 0.1 * x[0]),
        bcs=[scenes.fix(V, scenes.at(i, 0.0), component=i) for i in (0, 1)],
        cell_tags=tags,
        facet_tags=scenes.facet_tags(body, scenes.at(1, 8.0)),
        pressures=[(5e3, 1)],
        **options,
    )


def test_answer_does_not_depend_on_the_partition():
    results = []
    for partition, repartition in (("given", None), ("background", None), ("given", 0.0)):
        problem = flowing(partition)
        problem.solve(4, repartition=repartition)
        results.append((problem.history.iterations, outcome(problem)))
    assert problem.history.statistics["repartitions"] >= (WORLD.size > 1)
    for iterations, values in results[1:]:
        assert iterations == results[0][0]
        same_run(values, results[0][1], 1e-9)


def test_clouds_of_boxes(mpi_tmp_path):
    V = scenes.vectors(scenes.box([0.0, 0.0], [4.0, 4.0], [8, 8], QUADRILATERAL))
    x = np.stack(np.meshgrid(*[0.125 + 0.25 * np.arange(8)] * 2), axis=-1).reshape(-1, 2)
    own = x[WORLD.rank :: WORLD.size]
    values = []
    for partition in ("given", "background"):
        particles = mpm.Particles.from_points(own, 0.25, V, method="gimp")
        if partition == "background":
            particles.repartition()
        bcs = [scenes.fix(V, scenes.at(i, 0.0), component=i) for i in (0, 1)]
        problem = mpm.QuasiStaticProblem(
            mpm.Body(particles, Hencky(1e3, 0.3), body_force=(0.0, -10.0)), bcs=bcs
        )
        for _ in problem.steps(3, repartition=0.0):
            problem.write(mpi_tmp_path / f"{partition}.pvd")
        values.append(outcome(problem))
    same_run(*values, 1e-9)


def test_checkpoints_do_not_mind_where_ranks_are(mpi_tmp_path):
    path = mpi_tmp_path / "column.ckpt"
    problem = flowing("background")
    for step in problem.steps(4, repartition=0.0):
        if step.load == 0.5:
            problem.save(path)
    other = flowing("given")
    other.restore(path)
    other.solve(4, repartition=0.05)
    assert other.history.iterations == problem.history.iterations
    same_run(outcome(other), outcome(problem), 1e-9)


def test_objects_stay_the_same():
    problem = flowing("given")
    particles, history = problem.particles, problem.history
    moved = False
    for _ in problem.steps(4):
        before = outcome(problem)
        seconds = history.statistics["assemble"]
        moved |= problem.repartition(0.0)
        assert problem.particles is particles and problem.history is history
        assert history.statistics["assemble"] == seconds
        after = outcome(problem)
        for name, values in before.items():
            size = np.abs(values).max()
            np.testing.assert_allclose(after[name], values, rtol=0.0, atol=1e-13 * size)
    assert moved == (WORLD.size > 1)
    assert problem.history.load == [0.25, 0.5, 0.75, 1.0]


def test_what_cannot_move():
    problem = scenes.block()
    with pytest.raises(mpm.MPMError, match="threshold must be a share"):
        problem.repartition(2.0)
    body, V = problem.particles.mesh, problem.particles.V
    x = ufl.SpatialCoordinate(body)
    law = Hencky(1e3, 0.3)
    for options, match in (
        ({"body_force": ufl.as_vector((x[0], 0.0))}, "body_force is written on the present"),
        ({"density": fem.Constant(body, 2.0)}, "density is written on the present"),
        ({"material": Hencky(np.full(problem.particles.num_local, 1e3), 0.3)}, "use DG0"),
    ):
        arguments = {"material": law, "bcs": problem.bcs, **options}
        other = posed(mpm.QuasiStaticProblem, mpm.Particles(body, V), **arguments)
        with pytest.raises(mpm.MPMError, match=match):
            other.repartition()
    particles = mpm.Particles(body, V)
    d, v = particles.displacement, ufl.TestFunction(particles.W)
    R = ufl.derivative(scenes.neo_hookean(d) * particles.dx, d, v)
    with pytest.raises(mpm.MPMError, match="residual is written on the present body mesh"):
        mpm.ParticleProblem(R, particles, bcs=problem.bcs).repartition()
    with pytest.raises(mpm.MPMError, match=r"moved by problem\.repartition"):
        problem.particles.repartition()
    with pytest.raises(mpm.MPMError, match="have no background"):
        mpm.Particles(body).repartition()
