# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Where the unknowns of a step live."""

from petsc4py import PETSc

import numpy as np
import pytest
import scenes
from scenes import QUADRILATERAL, TRIANGLE, WORLD

import mpm_dolfinx as mpm
from mpm_dolfinx.layout import FreeDofs, TouchedNodes, even, imbalance
from mpm_dolfinx.materials import Hencky


def corner():
    """A body in a corner of a large background: the unknowns are one rank's there."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [20.0, 20.0], [20, 20], QUADRILATERAL))
    body = scenes.box([0.1, 0.0], [4.1, 4.0], [12, 12], TRIANGLE)
    return mpm.QuasiStaticProblem(
        mpm.Particles(body, V),
        Hencky(1e4, 0.3),
        density=1.0,
        body_force=(0.0, -25.0),
        bcs=[scenes.fix(V, scenes.at(1, 0.0))],
    )


@pytest.mark.parametrize("slack", [0.0, 0.1])
def test_no_rank_has_more_than_its_share(slack):
    dice = np.random.default_rng(WORLD.rank)
    homes = np.minimum(dice.integers(0, 2 * WORLD.size, 200 + WORLD.rank), WORLD.size - 1)
    ranks = even(WORLD, homes, slack)
    counts = WORLD.allreduce(np.bincount(ranks, minlength=WORLD.size))
    total = WORLD.allreduce(len(homes))
    most = np.ceil((1.0 + slack) * total / WORLD.size)
    assert counts.sum() == total and counts.max() <= most
    # Who has room keeps its own; who has not keeps as many as it may.
    wanted = WORLD.allreduce(np.bincount(homes, minlength=WORLD.size))
    kept = WORLD.allreduce(np.bincount(homes[ranks == homes], minlength=WORLD.size))
    assert np.array_equal(kept, np.minimum(wanted, most))


def test_numbers_and_values():
    particles = corner().particles
    V = particles.V
    bs = V.dofmap.index_map_bs
    free = np.flatnonzero(np.isin(np.arange(bs * V.dofmap.index_map.size_local) % 7, [0, 2, 3]))
    owned = particles.W.dofmap.index_map.size_local
    touched = TouchedNodes(V, [particles.node_basis], [owned])
    layout = FreeDofs(V, free.astype(np.int32), touched)
    start = V.dofmap.index_map.local_range[0] * bs
    local, size = layout.sizes
    assert size == WORLD.allreduce(len(free)) and WORLD.allreduce(local) == size
    assert local <= np.ceil(1.05 * size / WORLD.size)
    numbers = np.concatenate(WORLD.allgather(layout.numbers))
    assert np.array_equal(np.sort(numbers), np.arange(size))
    columns = np.concatenate(WORLD.allgather(layout.columns.getIndices()))
    assert np.array_equal(columns[layout.numbers], free + start)
    x = PETSc.Vec().createMPI(layout.sizes, comm=WORLD)
    values = np.sin(free + start)
    layout.collect(values, x)
    assert np.array_equal(x.array_r, np.sin(layout.columns.getIndices()))
    x.scale(2.0)
    assert np.array_equal(layout.spread(x), 2.0 * values)


def test_unknowns_follow_the_body():
    problem = corner()
    particles = problem.particles
    problem.solve(steps=2)
    statistics = problem.history.statistics
    assert statistics["dof_imbalance"] <= 1.06 + WORLD.size / statistics["free_dofs"]
    assert statistics["particle_imbalance"] == imbalance(WORLD, particles.num_local)
    assert problem.A.getLocalSize() == (problem.x.getLocalSize(),) * 2
    # In the background's own layout most rows have their columns on other ranks.
    starts, columns, _ = particles.T.getValuesCSR()
    first, last = particles.T.getOwnershipRangeColumn()
    off = (columns < first) | (columns >= last)
    rows = np.count_nonzero(np.diff(np.concatenate([[0], np.cumsum(off)])[starts]))
    before = WORLD.allreduce(rows) / WORLD.allreduce(len(starts) - 1)
    if WORLD.size == 1:
        assert statistics["off_rank_rows"] == statistics["off_rank_columns"] == before == 0.0
    else:
        assert before > 0.4
        assert 0.0 < statistics["off_rank_rows"] < before


def test_imbalance():
    assert imbalance(WORLD, 3) == 1.0
    assert imbalance(WORLD, 4 if WORLD.rank == 0 else 0) == WORLD.size
    assert imbalance(WORLD, 0) == 0.0


def test_multigrid_knows_the_rigid_motions():
    # Without conditions these are what the tangent of a body at rest gives no force to.
    V = scenes.vectors(scenes.box([0.0, 0.0], [4.0, 3.0], [20, 15], QUADRILATERAL))
    body = scenes.box([0.5, 0.3], [3.5, 2.7], [30, 24], TRIANGLE)
    options = {"ksp_type": "cg", "pc_type": "gamg", "ksp_rtol": 1e-10}
    problem = mpm.QuasiStaticProblem(
        mpm.Particles(body, V),
        Hencky(1e4, 0.3),
        density=1.0,
        body_force=(0.0, -1.0),
        bcs=[scenes.fix(V, scenes.at(1, 0.6))],
        petsc_options=options,
    )
    problem.reduced._bcs = []
    problem.reduced.begin(np.zeros_like(problem.particles.increment.x.array), 1.0)
    x = PETSc.Vec().createMPI(problem.reduced.sizes, comm=WORLD)
    problem.reduced.residual(x, x.duplicate())
    K = problem.reduced.tangent()
    motions = problem.reduced.rigid_motions().getVecs()
    assert len(motions) == 3
    for number, motion in enumerate(motions):
        assert abs(motion.norm() - 1.0) < 1e-14
        assert all(abs(motion.dot(other)) < 1e-14 for other in motions[:number])
        assert (K * motion).norm() < 1e-12 * K.norm()


def test_iterative_solver():
    options = {"ksp_type": "cg", "pc_type": "gamg", "ksp_rtol": 1e-10, "ksp_max_it": 200}
    moved = []
    for given in ({}, options):
        problem = scenes.slump(TRIANGLE, 5e3, h=0.25, petsc_options=given)
        problem.solve(steps=2)
        body = problem.particles
        moved.append(scenes.in_order(body, body.centroid - body.initial_centroid))
    assert problem.solver.getKSP().getPC().getType() == "gamg"
    assert np.abs(moved[0]).max() > 1e-3
    assert np.abs(moved[0] - moved[1]).max() < 1e-8
