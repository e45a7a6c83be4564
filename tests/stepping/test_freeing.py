# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Nodes that are free until the domains around them are distorted or leave the background."""

from contextlib import suppress

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from compare import raises
from marks import slow
from scenes import HEXAHEDRON, QUADRILATERAL, TRIANGLE, WORLD, at

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import NeoHooke, VonMises
from mpm_dolfinx.stepping.freeing import LEAST_QUALITY, carried_after

STEPS = 20


RUBBER = NeoHooke(1.5e4, 0.3)
CLAY = VonMises(1e5, 0.3, yield_stress=9e3, hardening=2e4)


def column(free="auto", cell=QUADRILATERAL, n=1, comm=WORLD, weight=1e4, law=RUBBER):
    """A column of rubber that sags under its weight, and rolls onto its base (half of it)."""
    dim = 3 if cell == HEXAHEDRON else 2
    thin = [0.25, n][: dim - 2]
    body = scenes.box(
        [0.0] * dim, [2.0, 4.0, *thin[:1]], [8 * n, 16 * n, *([1] * (dim - 2))], cell, comm
    )
    grid = scenes.box(
        [0.0] * dim, [6.0, 5.0, *thin[:1]], [12 * n, 10 * n, *([1] * (dim - 2))],
        HEXAHEDRON if dim == 3 else QUADRILATERAL, comm,
    )  # fmt: skip
    V = scenes.vectors(grid)
    if free == "elements":
        own = mpm.Particles(body)
    else:
        own = mpm.Particles(body, V, free=free, quadrature_degree=1 if cell == TRIANGLE else 2)
    bcs = [mpm.held(own.V, 0, x=0.0), mpm.held(own.V, y=0.0)]
    if dim == 3:
        bcs += [mpm.held(own.V, 2, z=0.0), mpm.held(own.V, 2, z=0.25)]
    force = (0.0, -weight, 0.0)[:dim]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(own, law, density=1.0, body_force=force),
        bcs=bcs,
        solver=mpm.Solver(petsc_options={"snes_rtol": 1e-10}),
    )
    return problem, own


def top(own):
    """Height of the column."""
    return own.mesh.comm.allreduce(own.domains[:, :, 1].max(initial=-np.inf), MPI.MAX)


def lowest(own):
    """Height of its lowest node."""
    return own.mesh.comm.allreduce(own.domains[:, :, 1].min(initial=np.inf), MPI.MIN)


def share_free(own):
    """Share of the nodes that are free."""
    chosen = scenes.gather(own.free[: own.W.dofmap.index_map.size_local].astype(float))
    return float(chosen.mean())


@pytest.mark.parametrize("cell", [QUADRILATERAL, *slow(TRIANGLE, HEXAHEDRON)], ids=str)
def test_a_run_goes_on_where_finite_elements_end(cell):
    problem, own = column("elements", cell)
    with suppress(mpm.MPMError):
        problem.solve(STEPS)
    assert lowest(own) < -0.01  # through the base
    assert (problem.history.load[-1] < 1.0) == (cell != TRIANGLE)

    problem, own = column("auto", cell)
    assert share_free(own) == 1.0
    problem.solve(STEPS)
    assert problem.history.cutbacks == 0
    assert 0.5 < share_free(own) < 1.0
    assert lowest(own) > -1e-9
    reaction = problem.reaction(problem.bcs[1])[1]
    weight = 1e4 * scenes.total(own, own.initial_volume)
    assert reaction == pytest.approx(weight, rel=1e-8)


@pytest.mark.parametrize("law", [*slow(RUBBER), CLAY], ids=["rubber", "clay"])
def test_nothing_jumps_where_nodes_are_carried(law):
    problem, own = column(law=law)
    counts, heights, shares = [], [4.0], []
    for step in problem.steps(STEPS):
        counts.append(step.iterations)
        heights.append(top(own))
        shares.append(share_free(own))
    assert 1.0 == shares[0] > shares[-1]
    assert np.abs(np.diff(counts)).max() <= 3
    sinks = -np.diff(heights)
    assert np.abs(np.diff(sinks)).max() < 0.3 * sinks.max()


def test_without_distortion_it_is_a_body_of_finite_elements():
    ends = []
    for free in ("elements", "auto"):
        problem, own = column(free, weight=1e3)
        problem.solve(2)
        ends.append(scenes.in_order(own, own.centroid))
    assert share_free(own) == 1.0
    np.testing.assert_allclose(*ends, rtol=0.0, atol=1e-10)


def test_any_number_of_ranks_carries_the_same_nodes():
    found = []
    for comm in (WORLD, MPI.COMM_SELF):
        problem, own = column(comm=comm)
        problem.solve(STEPS)
        found.append((top(own), problem.history.total_iterations))
    assert abs(found[0][0] - found[-1][0]) < 1e-8 and found[0][1] == found[-1][1]


@pytest.mark.skip_in_parallel
def test_single_steps_and_one_that_is_made_again():
    problem, own = column(n=2)
    for load in np.linspace(0.05, 1.0, 20):
        own.load.value = load
        problem.step()
        assert lowest(own) > -1e-9 and float(own.load.value) == load
    reasons = [attempt.reason for attempt in problem.history.taken_back]
    assert reasons == ["free nodes left the background"]


def test_a_step_is_too_late_for_whichever_body_leaves():
    V = scenes.vectors(scenes.box([0.0, 0.0], [3.0, 2.0], [6, 4], QUADRILATERAL))
    leaves, stays = (
        mpm.Particles(
            scenes.box([x, 0.5], [x + 1.0, 1.5], [2, 2], QUADRILATERAL),
            V,
            free="auto",
            quadrature_degree=2,
        )
        for x in (0.25, 1.5)
    )
    assert not carried_after([leaves, stays]).too_late
    scenes.move(leaves, lambda X: np.broadcast_to([0.0, -0.6], X.shape), commit=False)
    assert carried_after([leaves, stays]).too_late
    assert carried_after([stays, leaves]).too_late


def test_a_run_goes_on_from_a_checkpoint_as_it_was(mpi_tmp_path):
    whole, own = column()
    steps = whole.steps(STEPS)
    while share_free(own) == 1.0:
        next(steps)
    whole.save(mpi_tmp_path / "state")
    for _ in steps:
        pass
    again, other = column()
    again.restore(mpi_tmp_path / "state")
    again.solve(STEPS)
    assert np.array_equal(own.free, other.free)
    if WORLD.size == 1:
        scenes.assert_same_state(scenes.state(whole), scenes.state(again))
    # (on several ranks a factorisation adds in the order in which messages arrive)
    ends = [scenes.in_order(body, body.centroid) for body in (own, other)]
    np.testing.assert_allclose(*ends, rtol=0.0, atol=1e-12)


def test_nodes_that_a_failed_step_left_may_be_freed():
    """What is unknown follows the nodes that are free, after a step that was taken back too."""
    ends = []
    for fails in (False, True):
        problem, own = column([], weight=2e3)
        problem.solve(2)
        if fails:
            own.load.value = 1e3
            with pytest.raises(mpm.MPMError):
                problem.step()
            own.load.value = 1.0
        own.free = mpm.region(y=(-1.0, 2.0))
        problem.step()
        ends.append(scenes.in_order(own, own.centroid))
    np.testing.assert_allclose(*ends, rtol=0.0, atol=1e-8)


def test_what_was_bad_is_not_freed_again_by_its_error():
    """A run that frees nodes by their error (``adapt=``) carries them where domains are bad."""
    problem, own = column([])
    seen = [own.free_nodes.spent]
    for step in problem.steps(STEPS, adapt=0.05):
        quality = own.geometry.quality(own.node_positions[own.domain_nodes])
        assert not own.free[own.domain_nodes[quality < LEAST_QUALITY]].any()
        assert not (own.free & own.free_nodes.spent).any()
        assert (own.free_nodes.spent >= seen[-1]).all()
        seen.append(own.free_nodes.spent)
    assert scenes.gather(seen[-1]).any() and share_free(own) > 0.0
    assert step.error is not None and problem.history.cutbacks == 0
    own.free = np.flatnonzero(seen[-1])
    assert not own.free_nodes.spent.any()


@pytest.mark.parametrize("how", ["step", "run"])
def test_a_step_that_fails_leaves_free_nodes_as_they_were(how):
    ends = []
    for fails in (False, True):
        problem, own = column(weight=2e3)
        problem.solve(2)
        assert own.free.all()
        if fails:

            def far(t):
                own.load.value = 1.0 + 1e6 * t

            with pytest.raises(mpm.MPMError):
                if how == "run":
                    problem.solve(1, update=far)
                far(1.0)
                problem.step()
            assert own.free.all()
            own.load.value = 1.0
        problem.step()
        ends.append(scenes.in_order(own, own.centroid))
    np.testing.assert_allclose(*ends, rtol=0.0, atol=1e-12)


def test_particles_go_to_other_ranks_within_a_run():
    ends = []
    for threshold in (None, 0.0):
        problem, own = column(n=2, weight=6e3)
        problem.solve(8, repartition=threshold)
        ends.append((scenes.in_order(own, own.centroid), share_free(own)))
    (one, share), (two, its) = ends
    assert share == its
    np.testing.assert_allclose(one, two, rtol=0.0, atol=1e-8)


def test_bodies_that_would_pass_through_each_other_are_refused():
    """Those on one background, of which the nodes of one are free and nothing couples them."""

    def made():
        V = scenes.vectors(scenes.box([0.0, 0.0], [3.0, 3.0], [6, 6], QUADRILATERAL))
        bodies = [
            mpm.Body(
                mpm.Particles(
                    scenes.box([0.5, y], [2.5, y + 1.0], [4, 2], QUADRILATERAL),
                    V,
                    free=free,
                    quadrature_degree=2,
                ),
                RUBBER,
                density=1.0,
                body_force=(0.0, -10.0),
            )
            for y, free in ((0.0, "auto"), (1.0, []))
        ]
        lower, upper = (body.particles for body in bodies)
        tags = scenes.facet_tags(upper.mesh, at(1, 1.0))
        tie = mpm.Tie(upper, lower, tags, 1, 1e6)
        return bodies, [mpm.held(V, y=0.0), mpm.held(V, 0, x=0.0)], tie

    says = "leaves none: they would pass through each other"
    bodies, sides, _ = made()
    raises(lambda: mpm.QuasiStaticProblem(bodies, bcs=sides), mpm.MPMError, says)
    problem = mpm.QuasiStaticProblem(bodies[0], bcs=sides)
    problem.solve(1)
    before = scenes.in_order(problem.particles, problem.particles.centroid)
    raises(lambda: problem.add(bodies[1]), mpm.MPMError, says)
    problem.step()
    after = scenes.in_order(problem.particles, problem.particles.centroid)
    np.testing.assert_allclose(after, before, atol=1e-12)
    bodies, sides, tie = made()
    tied = mpm.QuasiStaticProblem(bodies, bcs=sides, terms=[tie])
    tied.solve(2)
    assert tied.reaction(tie)[1] == pytest.approx(20.0, rel=1e-6)
    raises(lambda: tied.stage("apart", terms=[]), mpm.MPMError, says)
    tied.step()
    assert tied.reaction(tie)[1] == pytest.approx(20.0, rel=1e-6)


def test_conditions_on_its_own_nodes_are_refused():
    _, own = column()
    body = mpm.Body(own, NeoHooke(1.0, 0.3))
    with pytest.raises(mpm.MPMError, match="free='auto' may let the background carry"):
        mpm.QuasiStaticProblem(body, bcs=[scenes.fix(own.W, at(1, 0.0))])
