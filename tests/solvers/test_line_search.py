# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Hard steps: directions uphill, stalls, limit loads, and what a failure names."""

from types import SimpleNamespace

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest
import scenes
from posed import posed
from scenes import QUADRILATERAL
from solvers.double_well import DoubleWell, newton

import mpm_dolfinx as mpm
from mpm_dolfinx.history import Statistics
from mpm_dolfinx.solvers.line_search import LineSearch, Rules, stalled


def test_a_step_uphill_is_redirected():
    # Near an inflection the potential's curvature is small and negative: Newton's own step is long
    # and leads uphill, where the residual grows.
    problem = DoubleWell([1.0, 5.0, 0.3], 0.1)
    solver = newton()
    solver.solve(problem, (3, 3), shorten=False)
    assert solver.statistics["redirections"] >= 1
    x = solver.x.array_r + problem.start
    assert np.all(3.0 * x**2 > 1.0)  # a minimum of the potential, not its maximum
    assert np.all(x > 0.0)  # the one downhill from the start
    assert problem.potential(x) < problem.potential(np.full(3, problem.start))
    np.testing.assert_allclose(problem.c * (x**3 - x), 0.1, atol=1e-8)
    assert solver.statistics["factorisations"] == solver.iterations


@pytest.mark.parametrize("options", [{"symmetric": False}, {"shift": 0.0}, {"line_search": False}])
def test_no_redirection_without_its_conditions(options):
    solver = newton(**options)
    try:
        solver.solve(DoubleWell([1.0, 5.0, 0.3], 0.1), (3, 3), shorten=False)
    except mpm.ConvergenceError:
        assert solver.gave_up
    assert solver.statistics["redirections"] == 0


class Softening(DoubleWell):
    """The same with a history."""

    def smooth(self):
        return False


def test_a_fold_is_passed_forward():
    # Without symmetry nothing but the sign of the second-order work tells the side that gives way,
    # from which Newton's own step leads back to a maximum, or to the fold.
    problem = Softening([1.0, 5.0, 0.3], 0.1)
    solver = newton(symmetric=False)
    solver.solve(problem, (3, 3), shorten=False)
    assert solver.statistics["redirections"] >= 1 and solver.iterations < 15
    x = solver.x.array_r + problem.start
    assert np.all(3.0 * x**2 > 1.0) and np.all(x > 0.0)  # stable, and on the way
    np.testing.assert_allclose(problem.c * (x**3 - x), 0.1, atol=1e-8)


@pytest.mark.parametrize("tells", [True, False])
def test_steps_are_reversed_only_where_work_tells_stability(tells):
    problem, solver = Softening([1.0, 5.0, 0.3], 0.1), newton(symmetric=False)
    problem.work_tells = lambda: tells
    try:
        solver.solve(problem, (3, 3), shorten=False)
    except mpm.ConvergenceError:
        assert not tells
    assert (solver.statistics["redirections"] > 0) == tells


@pytest.mark.skip_in_parallel
@pytest.mark.parametrize("works", [True, False])
def test_work_that_tells_nothing_judges_a_step_by_its_size(works):
    # With water or Nitsche's method the work on a step may begin below zero; where it falls in
    # size the step is taken, though the residual grows across it. Where it tells stability it is
    # a fold, and the step is shortened.
    def vector(*values):
        return PETSc.Vec().createWithArray(np.array(values, dtype=float), comm=MPI.COMM_SELF)

    def evaluate(trial):
        F.array_w[:] = np.array([1.0, 0.0]) + trial.array_r[0] ** 2 * np.array([-0.9, 5.0])

    statistics = Statistics()
    search = LineSearch(
        Rules(False, works, False),
        evaluate,
        SimpleNamespace(uphill=lambda *_: False),
        lambda: False,
        statistics,
    )
    x, y, F, trial = vector(0, 0), vector(-1, 0), vector(1, 0), vector(0, 0)
    assert search(x, y, F, trial) == works
    assert (statistics["halvings"] > 0) == works
    assert (trial.array_r[0] == 1.0) != works


def test_sand_without_cohesion_is_placed_by_its_weight():
    # Sand that leans on a rough wall parts at its upper corner in the first iteration, and points
    # at the apex resist nothing: the Newton step was 1e8 m long, whatever the load. The answer is
    # that of sand with next to no cohesion.
    def force(cohesion):
        V = scenes.vectors(scenes.box((-1, -1), (8, 4), (18, 10), QUADRILATERAL))
        sand = mpm.Particles(scenes.box((0, 0), (6, 3), (24, 12), QUADRILATERAL), V)
        wall = mpm.contact.Rigid(sand, mpm.contact.plane((0, 0), (1, 0)), friction=0.3)
        law = mpm.materials.MohrCoulomb(2e7, 0.3, cohesion=cohesion, friction_angle=33.0)
        ground = mpm.Body(sand, law, density=1800.0, body_force=(0.0, -9.81))
        base, side = mpm.held(V, y=(-np.inf, 0.0)), mpm.held(V, 0, x=6.0)
        problem = mpm.QuasiStaticProblem(ground, bcs=[base, side], terms=[wall])
        problem.solve(2)
        assert cohesion > 0.0 or problem.history.cutbacks == 0
        held = problem.reaction(wall) + problem.reaction(base)
        np.testing.assert_allclose(held[1], 18.0 * 1800.0 * 9.81, rtol=1e-8)
        return problem.reaction(wall)

    np.testing.assert_allclose(force(0.0), force(100.0), rtol=1e-3)


class Rod(DoubleWell):
    """A stiff rod from the origin to (1, 0), its end held by a soft spring and pulled sideways.

    Gradient of ``stiffness (|X|^2 - 1)^2 / 8 + |X - start|^2 / 2 - X_1``.
    """

    def __init__(self, stiffness, has_history):
        super().__init__([stiffness, stiffness], 1.0, np.array([1.0, 0.0]))
        self.stiffness, self.has_history = stiffness, has_history
        self.K = PETSc.Mat().createAIJ((2, 2), nnz=2, comm=MPI.COMM_SELF)

    def residual(self, x, F):
        self.x = x.array_r + self.start
        self.force = 0.5 * self.stiffness * (self.x @ self.x - 1.0)
        F.array_w[:] = self.force * self.x + x.array_r - [0.0, 1.0]
        return None

    def tangent(self):
        dense = self.stiffness * np.outer(self.x, self.x) + (self.force + 1.0) * np.eye(2)
        self.K.setValues([0, 1], [0, 1], dense)
        self.K.assemble()
        return self.K

    def smooth(self):
        return not self.has_history


def test_a_step_that_turns_a_stiff_rod_is_trusted():
    # The first Newton step stretches the rod by 1.4: its force is 10^6 times the load then.
    solver, problem = newton(), Rod(1e6, has_history=False)
    solver.solve(problem, (2, 2), shorten=False)
    assert solver.statistics["trusted_steps"] == 1 and solver.statistics["halvings"] == 0
    assert solver.iterations < 10 and max(solver.residuals) > 1e5
    # A rod that hardly stretches stands at 45 degrees: spring and load pull along it.
    np.testing.assert_allclose(solver.x.array_r + problem.start, 0.5**0.5, rtol=0.0, atol=1e-6)


def test_a_response_with_a_history_is_not_trusted():
    ends, solves = [], []
    for has_history in (False, True):
        solver, problem = newton(), Rod(1e3, has_history)
        solver.solve(problem, (2, 2), shorten=False)
        assert (solver.statistics["trusted_steps"] > 0) != has_history
        assert (solver.statistics["halvings"] > 0) == has_history
        ends.append(solver.x.array_r + problem.start)
        solves.append(solver.iterations)
    np.testing.assert_allclose(ends[0], ends[1], rtol=0.0, atol=1e-9)
    assert 2 * solves[0] < solves[1]


class Flat(DoubleWell):
    """Gradient of a convex potential, ``arctan(X)``: Newton's own steps from afar run away."""

    def residual(self, x, F):
        self.x = x.array_r + self.start
        F.array_w[:] = np.arctan(self.x)
        return None

    def tangent(self):
        for i, value in enumerate(1.0 / (1.0 + self.x**2)):
            self.K.setValue(i, i, value)
        self.K.assemble()
        return self.K


def test_trust_that_is_abused_ends():
    solver = newton()
    problem = Flat([1.0, 1.0], 0.0, start=np.array([1.5, -3.0]))
    solver.solve(problem, (2, 2), shorten=False)
    assert solver.statistics["trusted_steps"] == solver.statistics["withdrawn_steps"] == 1
    assert solver.statistics["halvings"] > 0 and solver.iterations < 20
    np.testing.assert_allclose(solver.x.array_r + problem.start, 0.0, atol=1e-9)


def test_trust_ends_where_a_linear_solve_breaks_down():
    solver = newton()
    problem = Flat([1.0, 1.0], 0.0, start=np.array([1.5, -10.0]))  # a tangent of 1e-300 soon
    solver.solve(problem, (2, 2), shorten=False)
    assert solver.statistics["withdrawn_steps"] == 1
    np.testing.assert_allclose(solver.x.array_r + problem.start, 0.0, atol=1e-9)


@pytest.mark.parametrize("strain", [1e-4, 1e-1])
def test_response_is_smooth_where_nothing_yields(strain):
    problem = scenes.slump(QUADRILATERAL, 1e3, h=1.0)
    problem.solve(steps=1)
    problem.particles.displacement.interpolate(lambda x: (strain * x[1], 0.0 * x[0]))
    (term,) = problem.built.body_terms
    assert term.update() is None
    assert problem.reduced.terms.smooth() == (strain < 1e-2)
    problem.reduced.terms.roll_back()
    assert problem.reduced.terms.smooth()


def test_histories_and_contact_are_not_smooth():
    problem = scenes.block()
    particles = problem.particles
    d, v = particles.displacement, scenes.ufl.TestFunction(particles.W)
    R = scenes.ufl.inner(scenes.linear_stress(d, 1e3, 0.3), scenes.ufl.grad(v)) * particles.dx

    class WithHistory(mpm.ParticleProblem):
        def commit(self):
            pass

    assert problem.reduced.terms.smooth()
    assert mpm.ParticleProblem(R, particles, bcs=problem.bcs).reduced.terms.smooth()
    assert not WithHistory(R, particles, bcs=problem.bcs).reduced.terms.smooth()
    end = scenes.WORLD.allreduce(particles.node_positions[:, 0].max(initial=0.0), scenes.MPI.MAX)
    wall = mpm.contact.Rigid(particles, mpm.contact.plane((end, 0.0), (-1.0, 0.0)))
    touching = mpm.QuasiStaticProblem(
        mpm.Body(particles, mpm.materials.Hencky(1e3, 0.3)), bcs=problem.bcs, terms=[wall]
    )
    assert touching.reduced.terms.update() is None
    assert not touching.reduced.terms.smooth()


def nearly_incompressible(**options):
    """A cantilever that bends by 0.6 of its length in 10 steps, volume averaged over patches."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [11.0, 10.0], [22, 20], QUADRILATERAL))
    body = scenes.box([0.0, 8.5], [10.0, 9.5], [40, 4], QUADRILATERAL)
    problem = posed(
        mpm.QuasiStaticProblem,
        mpm.Particles(body, V),
        mpm.materials.Hencky(12e6, 0.4999),
        bcs=[scenes.fix(V, scenes.at(0, 0.0))],
        tractions=[((0.0, -30e3), 1)],
        facet_tags=scenes.facet_tags(body, scenes.at(0, 10.0)),
        f_bar="patch",
        **options,
    )
    problem.solve(steps=10)
    return problem


def test_line_search_lets_a_nearly_incompressible_body_bend():
    search, plain = nearly_incompressible(), nearly_incompressible(line_search=False)
    assert search.history.statistics["trusted_steps"] > 0
    solves = [sum(p.history.iterations) + p.history.failed_iterations for p in (search, plain)]
    assert solves[0] <= 1.5 * solves[1]
    ends = [scenes.in_order(p.particles, p.particles.centroid) for p in (search, plain)]
    np.testing.assert_allclose(ends[0], ends[1], rtol=0.0, atol=1e-6)


def test_stalls():
    falling = [2.0**-i for i in range(40)]
    assert not any(stalled(falling[:n]) for n in range(1, 41))
    assert not stalled([1.0] * 15)
    assert stalled([1.0] * 16)
    cycle = [1.0, 0.3, 2.0] * 10
    assert stalled(cycle)
    assert not stalled([1.0] * 14 + [0.6, 0.5])
