# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Sizes of load steps, and limits of the load."""

import numpy as np
import pytest
import scenes
from laws import Sulky
from scenes import QUADRILATERAL, WORLD, pulled

import mpm_dolfinx as mpm
from mpm_dolfinx.stepping.control import StepControl


def test_a_bracket_ends_at_a_limit():
    control = StepControl(10)
    for _ in range(5):
        control.accept(20)
    cuts = 0
    while control.cut_back(gave_up=True):
        cuts += 1
    assert cuts == 8  # 1/10 halved to below a thousandth of 1/2
    other = StepControl(10)
    while other.cut_back(gave_up=True):
        pass
    assert other.target == pytest.approx(0.1 / 1024)  # nothing is reached yet


def test_a_step_that_failed_after_growing_does_not_grow_at_once():
    control = StepControl(1)
    limit, ends, failures = 0.3, [], 0
    while True:
        if control.target > limit:
            failures += 1
            if not control.cut_back(gave_up=True):
                break
        else:
            ends.append(control.target)
            control.accept(3)
    assert limit - ends[-1] < 2e-3 * limit
    assert failures <= 12


@pytest.mark.skip_in_parallel
def test_onset_of_a_collapse_is_passed():
    # One-point quadrilaterals on cells that do not fit: the tangent has negative pivots on the way.
    problem = scenes.slump(QUADRILATERAL, 160e3, h=1.06, width=106.0, height=8.0)
    history = problem.solve(steps=20)
    assert history.load[-1] == 1.0 and history.cutbacks <= 3


def test_limit_load_is_told():
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 1.5], [4, 3], QUADRILATERAL))
    body = scenes.box([0.0, 0.0], [1.1, 0.9], [4, 4], QUADRILATERAL)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            mpm.Particles(body, V),
            mpm.materials.SmallStrainVonMises(1e4, 0.3, rho_y=10.0),
            tractions=[((2 * np.sqrt(2) * 10.0, 0.0), 1)],
            facet_tags=scenes.facet_tags(body, scenes.at(0, 1.1)),
        ),
        bcs=[scenes.fix(V, scenes.at(i, 0.0), component=i) for i in (0, 1)],
    )
    with pytest.raises(mpm.MPMError) as caught:
        problem.solve(steps=10)
    error = caught.value
    assert all(text == str(error) for text in WORLD.allgather(str(error)))
    assert 0.499 <= error.load <= 0.5001
    assert problem.history.cutbacks <= 12
    assert problem.history.total_iterations < 350
    if isinstance(error, mpm.ConvergenceError):
        assert "no step, however small, gets to 0.50" in str(error)
        assert "unstable" not in str(error)
        assert len(error.dofs) == 1 and f"dof {error.dofs[0]} of V near (" in str(error)
        assert 0 <= error.dofs[0] < problem.particles.T.getSize()[1]
        assert error.particles


def test_necking_is_told_from_flow():
    # Hencky's bar in plane strain bears E / (1 - nu^2) / e at most, at the stretch e.
    largest = 1e3 / 0.91 / np.e
    body = scenes.box([0.0, 0.0], [1.0, 0.25], [2, 1], QUADRILATERAL)
    particles = mpm.Particles(body)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            particles,
            mpm.materials.Hencky(1e3, 0.3),
            tractions=[((1.1 * largest, 0.0), 1)],
            facet_tags=scenes.facet_tags(body, scenes.at(0, 1.0)),
        ),
        bcs=[scenes.fix(particles.W, scenes.at(i, 0.0), component=i) for i in (0, 1)],
    )
    with pytest.raises(mpm.ConvergenceError, match="may turn unstable there"):
        problem.solve(steps=5)
    assert 0.99 / 1.1 < problem.history.load[-1] < 1.0 / 1.1


@pytest.mark.parametrize("n", [1, 3, 7, 40])
def test_equal_steps_end_at_exact_loads(n):
    problem = scenes.block(force=(0.0, -1e-3))
    loads = [step.load for step in problem.steps(n)]
    assert loads == [k / n for k in range(1, n + 1)]
    assert problem.history.load == loads
    assert float(problem.particles.load.value) == 1.0
    assert problem.history.cutbacks == problem.history.failed_iterations == 0


def test_step_grows_after_easy_steps():
    # Only the first steps fail: later ones are as large as asked for again.
    problem, _ = pulled(Sulky(range(1, 4)), end=0.1, line_search=False)
    problem.solve(steps=4)
    assert problem.history.cutbacks == 3
    assert problem.history.load == [1 / 32, 3 / 32, 7 / 32, 15 / 32, 23 / 32, 31 / 32, 1.0]


def test_control_of_steps():
    control = StepControl(4)
    assert control.target == 0.25
    for _ in range(10):
        assert control.cut_back()
    assert control.target == 0.25 / 1024
    assert not control.cut_back()
    control.accept(3)
    assert control.target == 3 * 0.25 / 1024
    control.accept(20)
    assert control.target == 5 * 0.25 / 1024
    while not control.finished:
        control.accept(1)
    assert control.target == 1.0
