# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Where the unknowns of a step live."""

import numpy as np
import scenes
from scenes import QUADRILATERAL, TRIANGLE, WORLD

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky
from mpm_dolfinx.parallel.balance import imbalance
from mpm_dolfinx.system.numbering import FreeDofs, Numbering
from mpm_dolfinx.transfer.touched import TouchedNodes


def corner():
    """A body in a corner of a large background: the unknowns are one rank's there."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [20.0, 20.0], [20, 20], QUADRILATERAL))
    body = scenes.box([0.1, 0.0], [4.1, 4.0], [12, 12], TRIANGLE)
    return mpm.QuasiStaticProblem(
        mpm.Body(mpm.Particles(body, V), Hencky(1e4, 0.3), density=1.0, body_force=(0.0, -25.0)),
        bcs=[scenes.fix(V, scenes.at(1, 0.0))],
    )


def test_numbers_and_values():
    particles = corner().particles
    V = particles.V
    bs = V.dofmap.index_map_bs
    free = np.flatnonzero(np.isin(np.arange(bs * V.dofmap.index_map.size_local) % 7, [0, 2, 3]))
    owned = particles.W.dofmap.index_map.size_local
    touched = TouchedNodes(V, [particles.node_basis], [owned])
    layout = FreeDofs(V, free.astype(np.int32), touched)
    start = V.dofmap.index_map.local_range[0] * bs
    numbering = Numbering(WORLD, [layout])
    local, size = numbering.sizes
    assert numbering.parts == [slice(0, local)] and layout.count == local
    assert size == WORLD.allreduce(len(free)) and WORLD.allreduce(local) == size
    nodes = WORLD.allreduce(len(np.unique(free // bs)))
    assert len(np.unique(layout.collect(free + start) // bs)) <= np.ceil(1.05 * nodes / WORLD.size)
    for node in np.unique(free // bs):  # dofs of a node are together
        own = numbering.numbers[0][free // bs == node]
        assert np.array_equal(own, own[0] + np.arange(len(own)))
    numbers = np.concatenate(WORLD.allgather(numbering.numbers[0]))
    assert np.array_equal(np.sort(numbers), np.arange(size))
    columns = np.concatenate(WORLD.allgather(layout.collect(free + start)))
    assert np.array_equal(columns[numbering.numbers[0]], free + start)
    values = np.sin(free + start)
    assert np.array_equal(layout.spread(2.0 * layout.collect(values)), 2.0 * values)


def test_unknowns_follow_the_body():
    problem = corner()
    particles = problem.particles
    problem.solve(steps=2)
    statistics = problem.history.statistics
    # (dofs of a node stay together)
    assert statistics["dof_imbalance"] <= 1.06 + 2 * WORLD.size / statistics["free_dofs"]
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


def test_unknowns_of_finite_elements_last_until_others_are_held():
    """Nothing moves relative to what carries it: numbers, T and matrices stay as they are."""
    body = mpm.Particles(scenes.box([0.0, 0.0], [2.0, 1.0], [8, 4], QUADRILATERAL), degree=2)
    end, side = mpm.held(body.W, x=0.0), mpm.held(body.W, 1, x=2.0)
    given = mpm.Body(body, Hencky(1e3, 0.3), density=1.0, body_force=(0.0, -2.0))
    problem = mpm.QuasiStaticProblem(given, bcs=[end, side])
    seen = []
    for bcs in ([end, side], [end], [end, side]):
        problem.stage(f"stage {len(seen)}", bcs=bcs)
        for _ in problem.steps(3):
            seen.append((problem.reduced.unknowns.find(), body.T, problem.A.getSize()[0]))
    numbers, transfers, sizes = zip(*seen, strict=True)
    for kept in (numbers, transfers):
        for first in (0, 3, 6):
            assert all(one is kept[first] for one in kept[first : first + 3])
        assert kept[3] is not kept[2] and kept[6] is not kept[5]
    assert sizes[2] == sizes[8] < sizes[5]
    again = mpm.Particles(scenes.box([0.0, 0.0], [2.0, 1.0], [8, 4], QUADRILATERAL), degree=2)
    ends = [mpm.held(again.W, x=0.0), mpm.held(again.W, 1, x=2.0)]
    given = mpm.Body(again, Hencky(1e3, 0.3), density=1.0, body_force=(0.0, -2.0))
    whole = mpm.QuasiStaticProblem(given, bcs=ends)
    whole.solve(1)
    left = problem.reaction(end)[1] + problem.reaction(side)[1]
    assert np.isclose(left, whole.reaction(ends[0])[1] + whole.reaction(ends[1])[1], rtol=1e-6)
