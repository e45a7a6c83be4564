# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Newton's method: convergence, the proximal term, what nothing holds."""

import re

import numpy as np
import pytest
import scenes
from compare import raises
from scenes import QUADRILATERAL, TRIANGLE
from solvers.double_well import DoubleWell, newton

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, LinearElastic


@pytest.mark.parametrize("held", [None, 0, 1])
def test_a_body_that_nothing_holds(held):
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 2.0], [4, 4], QUADRILATERAL))
    bcs = [] if held is None else [scenes.fix(V, scenes.at(held, 0.0), component=held)]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            mpm.Particles(scenes.unit(4, TRIANGLE), V), Hencky(1e3, 0.3), body_force=(1.0, 1.0)
        ),
        bcs=bcs,
    )
    raises(lambda: problem.solve(steps=1), mpm.MPMError, r"nothing holds the bodies; support each")
    assert not problem.history.steps and not np.any(problem.particles.displacement.x.array)


@pytest.mark.filterwarnings("ignore:The domains have one quadrature point")
def test_a_motion_without_strain_that_is_not_rigid():
    # Rolls hold the block, but nothing resists the hourglass motion that this background can take.
    lines = scenes.box([0.0, 0.0], [2.1, 2.1], [7, 7], TRIANGLE, diagonal="crossed")
    V = scenes.vectors(lines)
    bcs = [scenes.fix(V, scenes.at(axis, 0.0), component=axis) for axis in (0, 1)]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            mpm.Particles(scenes.unit(7, QUADRILATERAL), V),
            mpm.materials.VonMises(1.0, 0.4, rho_y=0.0125),
            body_force=(0.0, -0.0178),
            f_bar="patch",
        ),
        bcs=bcs,
    )
    raises(lambda: problem.solve(steps=10), mpm.ConvergenceError, r"not rigid and .* hourglass")
    assert problem.history.cutbacks == 10 and not problem.history.steps


def test_a_body_that_what_only_pushes_may_let_go():
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 2.0], [4, 4], QUADRILATERAL))
    particles = mpm.Particles(scenes.unit(4, TRIANGLE), V)
    bcs = [scenes.fix(V, scenes.at(1, 0.0), component=1)]
    wall = mpm.contact.Rigid(particles, mpm.contact.plane((1.2, 0.0), (-1.0, 0.0)))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, Hencky(1e3, 0.3), body_force=(1.0, 0.0)), bcs=bcs, terms=[wall]
    )
    raises(lambda: problem.solve(steps=1), mpm.ConvergenceError, r"what only pushes has let")
    assert problem.history.cutbacks == 10


def test_what_is_held_softly_is_held():
    # Slender, one cell thick: bending has an eigenvalue some 1e-11 times that of a single cell.
    V = scenes.vectors(scenes.box([0.0, 0.0], [600.0, 3.0], [600, 3], QUADRILATERAL))
    beam = scenes.box([0.0, 1.0], [600.0, 2.0], [600, 1], QUADRILATERAL)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            mpm.Particles(beam, V, quadrature_degree=2),
            LinearElastic(1e3, 0.0),
            body_force=(0.0, -1e-10),
        ),
        bcs=[scenes.fix(V, scenes.at(0, 0.0))],
    )
    problem.solve(steps=1)
    np.testing.assert_allclose(problem.reaction(problem.bcs[0]), [0.0, 6e-8], rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("option", [{"snes_type": "ksponly"}, {"snes_linesearch_type": "bt"}])
def test_a_newton_method_of_petsc_is_refused(option):
    words = r"snes_type and snes_linesearch_type .* have no meaning here"
    raises(lambda: scenes.block(petsc_options=option), mpm.MPMError, words)


def test_monitors_of_petsc_are_told_of_each_iteration():
    problem, seen = scenes.block(), []
    problem.solver.setMonitor(lambda snes, iteration, norm: seen.append((iteration, norm)))
    step = next(iter(problem.steps(1)))
    assert [iteration for iteration, _ in seen] == list(range(len(step.residuals)))
    assert seen[-1][1] < 1e-8 * seen[0][1]


class Springs(DoubleWell):
    """Springs of different stiffness under forces that lengthen each by one."""

    def residual(self, x, F):
        F.array_w[:] = self.c * (x.array_r - 1.0)
        return None

    def tangent(self):
        for i, value in enumerate(self.c):
            self.K.setValue(i, i, value)
        self.K.assemble()
        return self.K


@pytest.mark.parametrize("shift", [1e-13, 1e-3])
def test_proximal_term_holds_nothing_back_that_moves(shift):
    solver = newton(shift=shift)
    solver.solve(Springs([1.0, 1e-2], 0.0), (2, 2), shorten=False)
    np.testing.assert_allclose(solver.x.array_r, 1.0, rtol=1e-8)
    assert solver.statistics["frozen_residual"] <= 1e-9


def test_round_off_counts_as_converged():
    # A tolerance that no residual can meet.
    problem = scenes.block(petsc_options={"snes_rtol": 1e-20})
    history = problem.solve(steps=2)
    assert history.cutbacks == 0
    assert history.statistics["converged_at_round_off"] >= 1
    assert max(step.residuals[-1] for step in history.steps) < 1e-12


def test_a_residual_that_round_off_keeps_large_ends_a_solve():
    # Elements of degree 2 across cells: steps rest at 2e-13 of the motion, the residual at 2e-12.
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 2.5], [12, 15], QUADRILATERAL), 2)
    body = scenes.box([0.0, 0.0], [1.0, 2.0], [6, 12], QUADRILATERAL)
    particles = mpm.Particles(body, V, degree=2, quadrature_degree=4)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            particles,
            Hencky(2e4, 0.3),
            body_force=(0.0, -1e3),
            tractions=[((300.0, 0.0), 1)],
            facet_tags=mpm.facet_tags(body, {1: mpm.region(y=2.0)}),
        ),
        bcs=[
            *(mpm.held(V, 0, value=0.02, **{side: 0.0}) for side in "xy"),
            mpm.held(V, 1, y=0.0),
        ],
        solver=mpm.Solver(petsc_options={"snes_rtol": 1e-12}),
    )
    history = problem.solve(10)
    assert history.failed_iterations == 0
    assert max(step.residuals[-1] for step in history.steps) < 1e-11


@pytest.mark.skip_in_parallel
def test_a_solve_that_goes_on_and_makes_no_headway_tells_its_own_residuals():
    class NoRoot(DoubleWell):
        there = True

        def residual(self, x, F):
            super().residual(x, F)
            if not self.there:
                F.array_w[:] = self.x**2 + 1.0

        def tangent(self):
            super().tangent()
            if not self.there:
                self.K.setValue(0, 0, 2.0 * self.x[0])
                self.K.assemble()
            return self.K

    well, solver = NoRoot([1.0], 0.0, start=0.9), newton(symmetric=False)
    solver.snes.setTolerances(max_it=1000)
    solver.solve(well, (1, 1), shorten=False)
    assert min(solver.residuals) < 1e-9
    well.there = False
    solver.unbalanced()
    with pytest.raises(mpm.ConvergenceError, match="did not stay below") as error:
        solver.go_on(0.1)
    assert float(re.search(r"below ([0-9.e+-]+)$", str(error.value))[1]) >= 1.0
