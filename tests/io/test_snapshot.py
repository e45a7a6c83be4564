# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What goes with a problem: split, rebased, moved to other ranks, saved and restored."""

from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from compare import outcome, same_run
from scenes import QUADRILATERAL, WORLD

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.io.snapshot import Kept, fill, of_cells
from mpm_dolfinx.materials import VonMises
from mpm_dolfinx.meshes.redistribution import Redistribution
from mpm_dolfinx.meshes.remesh import Column

DATA = Path(__file__).parents[1] / "data"
#: Corners of a quadrilateral's facets, and the shares of Gauss' points along them.
FACETS = np.array([[0, 1], [0, 2], [1, 3], [2, 3]])
GAUSS = 0.5 + 0.5 * np.array([-1.0, 0.0, 1.0]) * np.sqrt(0.6)


def made(comm=WORLD):
    """A block that yields, of nine quadrilaterals."""
    V = scenes.vectors(scenes.box([0.0, -0.5], [2.0, 1.5], [8, 8], QUADRILATERAL, comm))
    body = scenes.box([0.0, 0.0], [0.75, 0.75], [3, 3], QUADRILATERAL, comm)
    return mpm.QuasiStaticProblem(
        mpm.Body(
            mpm.Particles(body, V),
            VonMises(1e3, 0.3, rho_y=20.0, hardening=100.0),
            density=1.0,
            body_force=(0.0, -30.0),
        ),
        bcs=[scenes.fix(V, scenes.at(0, 0.0))],
    )


def run(problem, after=None):
    """Go through six steps with a split and a rebase on the way; yield each."""
    for number, _ in enumerate(problem.steps(6)):
        if number == 1:
            problem.split([4, 7])
        if number == 2:
            problem.rebase()
        yield number


@pytest.mark.filterwarnings("ignore:The domains have one")
def test_a_checkpoint_after_cuts_and_a_rebase_goes_on(mpi_tmp_path):
    problem, resumed = made(), made()
    path, history = mpi_tmp_path / "run.ckpt", resumed.history
    with pytest.raises(mpm.MPMError, match="by an older mpm_dolfinx"):
        resumed.restore(DATA / "split_and_rebased.ckpt")
    for number in run(problem):
        if number == 3:
            problem.save(path)
            resumed.restore(path)
            same_run(outcome(resumed), outcome(problem), 1e-9)
    for _ in resumed.steps(6):
        pass
    same_run(outcome(resumed), outcome(problem), 1e-9)
    assert history.iterations == problem.history.iterations
    assert [s.time for s in history.steps] == [s.time for s in problem.history.steps]
    assert scenes.largest(problem.particles.plastic_strain) > 0.1


# -- Something of the user's own ----------------------------------------------------------


class Own(Kept):
    """Velocity and force at nodes, a number of each cell, a vector at points, and a slip."""

    key = "own"

    def __init__(self, problem):
        self.problem = problem
        p = problem.particles
        x = p.domains
        self.velocity = fem.Function(p.W)
        fill(self.velocity, velocity(x))
        self.force = self.velocity.copy()
        self.total = resultant(self.force)
        middle = x.mean(axis=1)
        self.number = middle[:, 0].copy()
        self.strength = np.tile(middle[:, None, :], (1, p.num_points, 1))
        self.slip = slip(x)
        self.count = 7

    def numbers(self):
        return {"count": self.count}

    def columns(self, body):
        if body is None:
            return {}
        return {
            "velocity": Column(of_cells(self.velocity), "nodes"),
            "force": Column(of_cells(self.force), "forces"),
            "number": Column(self.number, "cells"),
            "strength": Column(self.strength, "points"),
            "slip": Column(self.slip, "facets"),
        }

    def restore(self, taken):
        self.count = taken.numbers["count"]
        (columns, _) = taken.columns
        self.velocity = fem.Function(self.problem.particles.W)
        fill(self.velocity, columns["velocity"])
        self.force = fem.Function(self.problem.particles.W)
        fill(self.force, columns["force"])
        self.number, self.strength = columns["number"], columns["strength"]
        self.slip = columns["slip"]


def velocity(x):
    return np.stack([1.0 + 2.0 * x[..., 0] - x[..., 1] ** 2, x[..., 0] * x[..., 1]], axis=-1)


def slip(x):
    """Return a function of places at the facet points, for corners ``(n, 4, 2)``."""
    ends = x[:, FACETS]
    points = ends[:, :, :1] * (1 - GAUSS[:, None]) + ends[:, :, 1:] * GAUSS[:, None]
    return 1.0 + velocity(points)


def start(comm=WORLD):
    """Return a problem, not yet loaded, that keeps something, and that."""
    problem = made(comm)
    thing = Own(problem)
    problem.keep(thing)
    return problem, thing


def resultant(force):
    """Return the sum over all nodes of a Function on W."""
    index_map = force.function_space.dofmap.index_map
    mine = force.x.array[: 2 * index_map.size_local].reshape(-1, 2).sum(axis=0)
    return index_map.comm.allreduce(mine)


def check(problem, thing, x, cut=()):
    """Compare with functions of the corners ``(n, 4, 2)`` where all was defined, by particle."""
    p = problem.particles
    np.testing.assert_allclose(of_cells(thing.velocity), velocity(x), atol=1e-13)
    np.testing.assert_allclose(resultant(thing.force), thing.total, rtol=1e-13)
    origin = p.origin_index
    whole = ~np.isin(origin, cut)
    middle = x.mean(axis=1)
    assert thing.number.shape == (p.num_local,)
    np.testing.assert_allclose(thing.number[whole], middle[whole, 0], atol=1e-13)
    np.testing.assert_allclose(thing.strength[whole, 0], middle[whole], atol=1e-13)
    expected = slip(x)
    np.testing.assert_allclose(thing.slip[whole], expected[whole], atol=1e-13)
    # A half has the values of its cell, and of two facets that were the cell's.
    centres = {}
    for index, value in zip(origin[~whole], thing.number[~whole], strict=True):
        centres.setdefault(index, value)
        assert centres[index] == value
    for mine, places, corners in zip(thing.slip[~whole], expected[~whole], x[~whole], strict=True):
        edges = corners[FACETS[:, 1]] - corners[FACETS[:, 0]]
        outer = (np.abs(edges) < 1e-12).sum(axis=1) == 1  # along the axes; not the diagonal
        assert outer.sum() == 2
        np.testing.assert_allclose(mine[outer], places[outer], atol=1e-13)
        assert not mine[~outer].any()
    assert thing.count == 7


@pytest.mark.filterwarnings("ignore:The domains have one")
def test_what_says_where_it_lives_goes_with_the_problem(mpi_tmp_path):
    problem, thing = start()
    p = problem.particles
    x = p.domains
    check(problem, thing, x)
    problem.save(mpi_tmp_path / "whole.ckpt")

    problem.split([4, 0])  # before any load: domains are squares where all was defined
    assert problem.particles.num_global == 11
    check(problem, thing, problem.particles.domains, cut=[4, 0])
    problem.save(mpi_tmp_path / "split.ckpt")

    problem.particles.load.value = 0.1
    problem.step()
    problem.rebase()
    assert scenes.largest(problem.particles.domains - problem.particles.initial_domains) > 1e-4
    check(problem, thing, problem.particles.initial_domains, cut=[4, 0])
    problem.save(mpi_tmp_path / "rebased.ckpt")

    if WORLD.size > 1:
        before = WORLD.allgather(problem.particles.num_local)
        ranks = (problem.particles.global_index % WORLD.size).astype(np.int64)
        problem.state.renew(
            lambda: problem.particles.live_on(Redistribution(problem.particles.mesh, ranks)),
            lambda snapshot: snapshot,
        )
        after = WORLD.allgather(problem.particles.num_local)
        assert before != after or WORLD.allreduce(int((ranks != WORLD.rank).sum())) > 0
        check(problem, thing, problem.particles.initial_domains, cut=[4, 0])

    # Restored on as many ranks, and on one.
    for name, cut in (("whole", []), ("split", [4, 0]), ("rebased", [4, 0])):
        for comm in (WORLD, MPI.COMM_SELF):
            other, its = start(comm)
            its.velocity.x.array[:] = 0.0
            its.number[:], its.strength[:], its.slip[:], its.count = 0.0, 0.0, 0.0, 0
            other.restore(mpi_tmp_path / f"{name}.ckpt")
            check(other, its, other.particles.initial_domains, cut)
    with pytest.raises(mpm.MPMError, match=r"holds \['own force'.*does not keep"):
        made().restore(mpi_tmp_path / "whole.ckpt")
    without = made()
    without.save(mpi_tmp_path / "without.ckpt")
    with pytest.raises(mpm.MPMError, match=r"holds \[\] under the key 'own', where this problem"):
        start()[0].restore(mpi_tmp_path / "without.ckpt")


@pytest.mark.parametrize("name", ["number", "strength", "slip"])
def test_values_of_another_shape_are_refused(name, mpi_tmp_path):
    problem, _ = start()
    problem.save(mpi_tmp_path / "whole.ckpt")
    other, its = start()
    before = np.repeat(getattr(its, name)[..., None], 2, axis=-1)
    setattr(its, name, before)
    with pytest.raises(mpm.MPMError, match=r"under the key 'own'.*or values of other shapes"):
        other.restore(mpi_tmp_path / "whole.ckpt")
    assert getattr(its, name) is before


@pytest.mark.filterwarnings("ignore:The domains have one")
def test_both_diagonals():
    for turn in (1.0, -1.0):
        problem = made()
        # The shape chooses the diagonal; what lives on the facets follows.
        p = problem.particles
        scenes.move(p, lambda X, t=turn: 0.2 * X[:, :1] * X[:, 1:] * np.array([1.0, t]))
        thing = Own(problem)
        fill(thing.velocity, velocity(p.initial_domains))
        thing.slip, thing.number = slip(p.initial_domains), p.initial_domains.mean(axis=1)[:, 0]
        thing.strength = p.initial_domains.mean(axis=1)[:, None]
        problem.keep(thing)
        problem.split([3, 4, 5])
        assert set(problem.particles.trail.cuts[:, 1]) == {0 if turn > 0 else 1}
        check(problem, thing, problem.particles.initial_domains, cut=[3, 4, 5])


class Silent(mpm.QuasiStaticProblem):
    """An heir whose velocity says nothing, or something, about where it lives."""

    at = None

    def converged_state(self):
        states = super().converged_state()
        values = velocity(self.particles.domains)
        states[0]["velocity"] = values if self.at is None else Column(values, self.at)
        return states

    def set_converged_state(self, states):
        self.velocity = states[0].pop("velocity")
        super().set_converged_state(states)


@pytest.mark.filterwarnings("ignore:The domains have one")
def test_what_does_not_say_where_it_lives_is_refused(mpi_tmp_path):
    V = scenes.vectors(scenes.box([0.0, -0.5], [2.0, 1.5], [8, 8], QUADRILATERAL))
    body = scenes.box([0.0, 0.0], [0.75, 0.75], [3, 3], QUADRILATERAL)
    bcs = [scenes.fix(V, scenes.at(0, 0.0))]
    law = VonMises(1e3, 0.3, rho_y=20.0)
    problem = Silent(mpm.Body(mpm.Particles(body, V), law), bcs)
    for attempt in (
        lambda: problem.split([4]),
        problem.rebase,
        lambda: problem.save(mpi_tmp_path / "silent.ckpt"),
    ):
        with pytest.raises(mpm.MPMError, match=r"'history velocity' is kept but does not say"):
            attempt()
    assert problem.particles.num_global == 9
    problem.at = "nodes"
    # it is the problem that it was: functions on its first mesh go into a file yet
    colour = fem.Function(fem.functionspace(problem.particles.mesh, ("DG", 0)))
    colour.interpolate(lambda x: x[0])
    problem.save(mpi_tmp_path / "whole.ckpt", functions=[colour])
    values = colour.x.array.copy()
    colour.x.array[:] = 0.0
    problem.restore(mpi_tmp_path / "whole.ckpt", functions=[colour])
    np.testing.assert_array_equal(colour.x.array, values)
    problem.split([4])
    assert problem.particles.num_global == 10
    np.testing.assert_allclose(problem.velocity, velocity(problem.particles.domains), atol=1e-13)
    with pytest.raises(mpm.MPMError, match=r"Domains were split"):
        problem.save(mpi_tmp_path / "split.ckpt", functions=[colour])


def test_keys_of_what_is_kept():
    problem, thing = start()
    with pytest.raises(mpm.MPMError, match=r"'own' cannot be the key"):
        problem.keep(thing)
    for key in ("", "two words", "history", "past", "steps", "displacement", "series"):
        other = Own(problem)
        other.key = key
        with pytest.raises(mpm.MPMError, match=r"cannot be the key of something that is kept"):
            problem.keep(other)
    with pytest.raises(mpm.MPMError, match=r"needs an heir of mpm_dolfinx\.io\.Kept"):
        problem.keep({"velocity": 1})


def test_a_captured_state_is_come_back_to_and_gone_on_from_on_any_ranks():
    problem = made()
    problem.solve(2)
    captured, before = problem.state.capture(), scenes.state(problem)
    problem.particles.load.value = 1.2
    problem.step()
    after = scenes.state(problem)
    problem.state.adopt(captured)
    scenes.assert_same_state(before, scenes.state(problem))
    problem.particles.load.value = 1.2
    problem.step()
    again = scenes.state(problem)
    assert np.abs(again["stress"] - after["stress"]).max(initial=0.0) <= 1e-9 * 30.0
