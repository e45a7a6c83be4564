# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Runs on all ranks against the same runs on one."""

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from compare import outcome, same_run
from scenes import HEXAHEDRON, PLANE, QUADRILATERAL, TRIANGLE, WORLD, A, B

from dolfinx import mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, VonMises

pytestmark = pytest.mark.mpi
SELF = MPI.COMM_SELF


def compare(make, steps, tolerance=1e-9):
    """Run a scene on all ranks and on each rank alone, and compare."""
    runs = []
    for comm in (WORLD, SELF):
        problem = make(comm)
        problem.solve(steps=steps)
        nodes = scenes.node_positions(problem.particles)
        runs.append((problem.history, {"nodes": nodes.max(axis=0), **outcome(problem)}))
    (one, values), (two, others) = runs
    assert one.iterations == two.iterations
    assert one.load == two.load and one.cutbacks == two.cutbacks
    same_run(values, others, tolerance)
    return values


@pytest.mark.parametrize("cell", PLANE, ids=scenes.name)
def test_elastic_column(cell):
    compare(lambda comm: scenes.column(A, 8, cell, Hencky(A.young, A.poisson), comm), 10)


def test_plastic_column():
    law = VonMises(B.young, B.poisson, rho_y=B.rho_y, hardening=1e4)
    arrays = compare(lambda comm: scenes.column(B, 8, QUADRILATERAL, law, comm), 10)
    assert arrays["plastic_strain 0"].max() > 0.05


def test_slumping_column():
    # Flowing, so that round-off grows a little in each step.
    arrays = compare(lambda comm: scenes.slump(TRIANGLE, 20e3, h=1.0, comm=comm), 20)
    assert arrays["plastic_strain 0"].max() > 0.5


@pytest.mark.parametrize("ghosts", ["none", "shared_facet"])
def test_ghosts_make_no_difference(ghosts):
    mode = getattr(mesh.GhostMode, ghosts)

    def make(comm):
        V = scenes.vectors(
            scenes.box([0.0, -0.5], [2.0, 1.5], [8, 8], TRIANGLE, comm, ghost_mode=mode)
        )
        body = scenes.box([0.0, 0.0], [1.0, 1.0], [6, 6], QUADRILATERAL, comm, ghost_mode=mode)
        tags = scenes.facet_tags(body, scenes.at(0, 1.0))
        return mpm.QuasiStaticProblem(
            mpm.Body(
                mpm.Particles(body, V),
                Hencky(1e3, 0.3),
                density=1.0,
                body_force=(0.0, -20.0),
                tractions=[((20.0, 10.0), 1)],
                facet_tags=tags,
            ),
            bcs=[scenes.fix(V, scenes.at(0, 0.0))],
        )

    compare(make, 4)


@pytest.mark.parametrize("cell", PLANE, ids=scenes.name)
def test_ranks_without_particles(cell):
    # One quadrilateral, or two triangles, that cross a few background cells.
    def make(comm):
        return scenes.block(Hencky(1e3, 0.3), cell, n=1, comm=comm, force=(3.0, -5.0))

    problem = make(WORLD)
    counts = WORLD.allgather(problem.particles.num_local)
    assert min(counts) == 0 or (cell is TRIANGLE and WORLD.size == 2)
    if cell is TRIANGLE:
        compare(make, 3)
        return
    # One particle has an hourglass: all of the background is prescribed.
    moved = []
    for comm in (WORLD, SELF):
        V = make(comm).particles.V
        bc, u = scenes.everywhere(V)
        u.interpolate(lambda x: np.array([[0.2, 0.1], [0.0, -0.1]]) @ x[:2])
        body = scenes.unit(1, cell, comm)
        problem = mpm.QuasiStaticProblem(
            mpm.Body(mpm.Particles(body, V), Hencky(1e3, 0.3)), bcs=[bc]
        )
        problem.solve(steps=4)
        moved.append(outcome(problem))
    for key, values in moved[0].items():
        gap = 1e-8 if key.startswith("reaction") else 1e-10
        np.testing.assert_allclose(values, moved[1][key], atol=gap, err_msg=key)


def test_ranks_without_background_cells():
    def make(comm):
        V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 2.0], [1, 1], QUADRILATERAL, comm))
        body = scenes.box([0.0, 0.0], [1.5, 1.5], [4, 4], TRIANGLE, comm)
        bcs = [scenes.fix(V, scenes.at(i, 0.0), component=i) for i in (0, 1)]
        return mpm.QuasiStaticProblem(
            mpm.Body(
                mpm.Particles(body, V), Hencky(1e3, 0.3), density=1.0, body_force=(0.0, -30.0)
            ),
            bcs=bcs,
        )

    problem = make(WORLD)
    cells = WORLD.allgather(problem.particles.V.mesh.topology.index_map(2).size_local)
    assert min(cells) == 0
    compare(make, 4)


def test_particles_far_from_the_rank_of_their_background():
    # The body sits in a corner of a large background: most ranks own none of its columns.
    def make(comm):
        V = scenes.vectors(scenes.box([0.0, 0.0], [20.0, 20.0], [20, 20], QUADRILATERAL, comm))
        body = scenes.box([17.1, 0.0], [19.3, 2.2], [6, 6], TRIANGLE, comm)
        return mpm.QuasiStaticProblem(
            mpm.Body(
                mpm.Particles(body, V),
                VonMises(1e4, 0.3, rho_y=20.0),
                density=1.0,
                body_force=(0.0, -25.0),
            ),
            bcs=[scenes.fix(V, scenes.at(1, 0.0))],
        )

    arrays = compare(make, 5)
    assert arrays["plastic_strain 0"].max() > 0.0


def test_nodes_that_a_stiff_support_lets_go_1e_12_behind_a_facet():
    def make(comm):
        V = scenes.vectors(scenes.box([-0.5] * 3, [1.5] * 3, [4] * 3, HEXAHEDRON, comm))
        body = mpm.Particles(scenes.unit(4, HEXAHEDRON, comm), V)
        tags = scenes.facet_tags(body.mesh, scenes.at(2, 0.0))
        return mpm.QuasiStaticProblem(
            mpm.Body(body, Hencky(1e3, 0.3), density=1.0, body_force=(10.0, 0.0, 0.0)),
            supports=[mpm.boundary.fixed(body, tags, 1)],
        )

    compare(make, 2)


def test_statistics_count_the_same_on_all_ranks():
    problem = scenes.block()
    problem.solve(steps=2)
    names = ("factorisations", "residuals", "transfers", "free_dofs")
    counters = WORLD.allgather({name: problem.history.statistics[name] for name in names})
    assert all(c == counters[0] for c in counters)
    free = WORLD.allreduce(len(problem.particles.active_dofs))
    assert 0 < counters[0]["free_dofs"] <= free


def test_free_nodes():
    # Free where the body is held on the background, and beside carried nodes.
    def make(comm):
        V = scenes.vectors(scenes.box([0.0, -0.5], [2.0, 1.5], [8, 8], QUADRILATERAL, comm))
        body = scenes.box([0.0, 0.0], [1.0, 1.0], [6, 6], QUADRILATERAL, comm)
        tags = scenes.facet_tags(body, scenes.at(0, 1.0))
        particles = mpm.Particles(body, V, free=lambda x: (x[0] + x[1] < 0.7) | (x[0] > 0.9))
        return mpm.QuasiStaticProblem(
            mpm.Body(
                particles,
                VonMises(1e3, 0.3, rho_y=20.0, hardening=100.0),
                density=1.0,
                body_force=(0.0, -30.0),
                tractions=[((20.0, 10.0), 1)],
                facet_tags=tags,
                f_bar="domain",
            ),
            bcs=[
                scenes.fix(V, scenes.at(0, 0.0)),
                scenes.fix(particles.W, scenes.at(0, 1.0), 0.0, 1),
            ],
        )

    arrays = compare(make, 4)
    assert arrays["plastic_strain 0"].max() > 1e-3
