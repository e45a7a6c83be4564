# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The start of Newton's method from the last increments."""

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from laws import Sulky
from marks import slow, thinned
from scenes import HEXAHEDRON, PLANE, QUADRILATERAL, TRIANGLE, WORLD, A, B

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, VonMises
from mpm_dolfinx.system.predictor import Predictor, map_to_background


def plastic(predictor=True, ne=16, cell=QUADRILATERAL, **options):
    """Return the column between rollers."""
    law = VonMises(B.young, B.poisson, rho_y=B.rho_y)
    return scenes.column(B, ne, cell, law, predictor=predictor, **options)


def gripped(predictor, end=0.4, law=None):
    """Return a block that is pulled down by background nodes which it hangs on."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 2.0], [8, 8], QUADRILATERAL))
    body = scenes.box([0.5, 0.5], [1.5, 2.0], [8, 12], QUADRILATERAL)
    value = fem.Constant(V.mesh, np.array([0.1 * end, -end]))
    low = np.flatnonzero(V.tabulate_dof_coordinates()[:, 1] < 0.6).astype(np.int32)
    bcs = [scenes.fix(V, scenes.at(1, 2.0)), fem.dirichletbc(value, low, V)]
    law = law or Hencky(1e3, 0.3)
    return mpm.QuasiStaticProblem(
        mpm.Body(mpm.Particles(body, V), law), bcs=bcs, solver=mpm.Solver(predictor=predictor)
    )


# -- Extrapolation -----------------------------------------------------------------------


def test_extrapolation_is_exact_for_constant_acceleration_in_unequal_steps():
    def position(t):
        return np.array([[3.0 * t - 2.0 * t**2], [t**2]])

    predictor = Predictor()
    assert predictor.increments(0.1) is None
    times = [0.0, 0.1, 0.15, 0.4, 0.41, 1.0]
    for k in range(1, len(times)):
        size = times[k] - times[k - 1]
        increment = position(times[k]) - position(times[k - 1])
        if k >= 3:
            (guess,) = predictor.increments(size)
            np.testing.assert_allclose(guess, increment, rtol=1e-11, atol=1e-14)
        predictor.record(size, [increment])
    predictor.clear()
    assert predictor.increments(0.1) is None


def test_one_past_step_gives_its_velocity_and_no_progress_gives_nothing():
    predictor = Predictor()
    predictor.record(0.5, [np.array([1.0, 2.0]), np.array([4.0])])
    first, second = predictor.increments(0.25)
    assert np.array_equal(first, [0.5, 1.0]) and np.array_equal(second, [2.0])
    assert predictor.increments(0.0) is None
    predictor.record(0.0, [np.zeros(2), np.zeros(1)])
    assert predictor.increments(0.25) is None


@pytest.mark.parametrize("cell", [*PLANE, HEXAHEDRON], ids=scenes.name)
def test_map_to_background_gives_increments_back(cell):
    dim = 3 if cell == HEXAHEDRON else 2
    V = scenes.vectors(
        scenes.box([0.0] * dim, [1.0] * dim, [4] * dim, HEXAHEDRON if dim == 3 else cell)
    )
    bodies = [
        mpm.Particles(scenes.box([a] * dim, [b] * dim, [3] * dim, cell), V)
        for a, b in ((0.05, 0.45), (0.4, 0.7))
    ]
    increments = []
    for body in bodies:
        owned = body.W.dofmap.index_map.size_local
        x = body.W.tabulate_dof_coordinates()[:owned, :dim]
        increments.append(
            np.sin(x @ np.arange(1.0, dim + 1.0))[:, None] * np.arange(1.0, dim + 1.0)
        )
    transfers = [body.T for body in bodies]
    u = map_to_background(transfers, [w.ravel() for w in increments])
    T = np.concatenate([scenes.dense(t) for t in transfers])
    w = np.concatenate([scenes.gather(w.ravel()) for w in increments])
    weight = T.sum(axis=0)
    seen = weight > 0.0
    assert 0 < seen.sum() < len(seen)
    mean = np.zeros(len(weight))
    mean[seen] = (T.T @ w)[seen] / weight[seen]
    # Nearly as near as least squares come, and much nearer than weighted means.
    best = np.linalg.norm(T @ np.linalg.lstsq(T, w, rcond=None)[0] - w)
    left, before = (np.linalg.norm(T @ x - w) for x in (scenes.gather(u), mean))
    assert left <= best + 1e-3 * before
    assert not np.any(scenes.gather(u)[~seen])
    # What the background has moved is given back.
    moved = np.sin(np.arange(len(weight)))
    parts = np.split(T @ moved, [len(scenes.gather(increments[0].ravel()))])
    again = map_to_background(
        transfers, [own(t, part) for t, part in zip(transfers, parts, strict=True)]
    )
    whole = np.linalg.norm(T @ moved)
    assert np.linalg.norm(T @ (scenes.gather(again) - moved)) <= 1e-2 * whole


# -- Runs --------------------------------------------------------------------------------


@pytest.mark.parametrize(("case", "ne"), thinned(3, [(A, 16), (A, 64), (B, 64), (B, 16)]))
def test_fewer_solves_for_the_same_answer(case, ne):
    results = []
    for predictor in (False, True):
        law = Hencky(A.young, 0.0) if case is A else VonMises(B.young, B.poisson, rho_y=B.rho_y)
        problem = scenes.column(case, ne, QUADRILATERAL, law, predictor=predictor)
        history = problem.solve(steps=40)
        results.append(scenes.in_order(problem.particles, problem.particles.stress))
        counts = history.statistics
        tried = counts["predictions"] + counts["rejected_predictions"]
        assert tried == (39 if predictor else 0)
    without, with_it = results
    assert history.total_iterations <= 95
    np.testing.assert_allclose(with_it, without, rtol=0.0, atol=1e-8 * np.abs(without).max())


@pytest.mark.parametrize("g0", [20e3, *slow(80e3)])
def test_flow_takes_no_more_solves(g0):
    positions, histories = [], []
    for predictor in (False, True):
        problem = scenes.slump(TRIANGLE, g0, h=1.0, width=g0 / 1e3, predictor=predictor)
        histories.append(problem.solve(steps=40))
        positions.append(scenes.in_order(problem.particles, problem.particles.centroid))
    without, with_it = histories
    assert with_it.statistics["rejected_predictions"] > 0
    assert with_it.total_iterations <= without.total_iterations
    assert with_it.cutbacks <= without.cutbacks
    np.testing.assert_allclose(*positions, atol=1e-6)


def test_imposed_displacements():
    results = []
    for predictor in (False, True):
        problem = gripped(predictor)
        history = problem.solve(steps=10)
        results.append(scenes.in_order(problem.particles, problem.particles.stress))
        force = sum(problem.reaction(bc) for bc in problem.bcs)
        assert np.abs(force).max() < 1e-6
    np.testing.assert_allclose(*results, atol=1e-7 * np.abs(results[0]).max())
    assert history.statistics["predictions"] >= 8
    without = gripped(False)
    assert history.total_iterations <= without.solve(steps=10).total_iterations


def test_cutback_and_growth():
    problem = gripped(True, law=Sulky(range(8, 22)))
    history = problem.solve(steps=5)
    assert history.cutbacks > 0
    assert len(set(np.diff([0.0, *history.load]).round(12))) > 1
    assert history.statistics["predictions"] > 0
    other = gripped(False)
    other.solve(steps=5)
    once, again = (scenes.in_order(p.particles, p.particles.centroid) for p in (problem, other))
    np.testing.assert_allclose(once, again, atol=5e-3)


def test_failed_prediction_is_a_rejected_one():
    reference = gripped(True)
    reference.solve(steps=3)
    # The first update of the second step is that of the start from zero, the next that of the
    # prediction.
    first = gripped(True, law=(law := Sulky(())))
    steps = first.steps(3)
    next(steps)
    law.calls = (law.count + 2,)
    for _ in steps:
        pass
    counts = first.history.statistics
    assert (counts["predictions"], counts["rejected_predictions"]) == (1, 1)
    assert first.history.cutbacks == 0
    assert reference.history.statistics["predictions"] == 2
    gap = first.particles.displacement.x.array - reference.particles.displacement.x.array
    assert scenes.largest(gap) < 1e-9


@pytest.mark.mpi
def test_same_on_one_rank_and_on_all():
    runs = [plastic(comm=comm) for comm in (WORLD, MPI.COMM_SELF)]
    histories = [problem.solve(steps=10) for problem in runs]
    assert histories[0].iterations == histories[1].iterations
    for name in ("predictions", "rejected_predictions", "residuals"):
        assert histories[0].statistics[name] == histories[1].statistics[name]
    stress = [scenes.in_order(problem.particles, problem.particles.stress) for problem in runs]
    np.testing.assert_allclose(*stress, atol=1e-9 * np.abs(stress[1]).max())


def own(transfer, values):
    """Return this rank's part of values at the rows of a transfer."""
    first, last = transfer.getOwnershipRange()
    return values[first:last]
