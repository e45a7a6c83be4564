# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Load steps chosen by a tolerance: their sizes, their errors, and what is taken back."""

from contextlib import nullcontext

import numpy as np
import pytest
import scenes
from compare import EXACT, outcome, raises, same_run
from scenes import QUADRILATERAL, TRIANGLE, WORLD, pulled

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky
from mpm_dolfinx.stepping.automatic import ErrorControl, StepError

LEVELS = (0.3, 0.55)


def column(weight=20e3, cell=QUADRILATERAL, **options):
    """Return a column of 4 x 8 m that flows under its weight, on cells of 1 m."""
    return scenes.slump(cell, weight, h=1.0, **options)


def distance(a, b):
    """Return the root mean square of a difference at the nodes, over that of b."""
    return np.sqrt(np.sum((a - b) ** 2) / np.sum(b**2))


def walk(control, ratio):
    """Accept steps whose error over the allowed one a function of (start, end) gives."""
    ends = []
    while not control.finished:
        start, end = control.share, control.target
        control.judge(StepError(ratio(start, end), (8.0 * control.asked[1]) ** -2, False))
        if not control.reject():
            control.accept(5)
            ends.append(end)
    return ends


def test_steps_land_on_levels():
    ends = walk(ErrorControl(0.01, [0.7, 0.1, 1.0, 1 / 3]), lambda start, end: 0.0)
    # Twice as large each time; no further than half of what is left to a level.
    assert ends[:2] == [0.05, 0.1] and ends[-1] == 1.0
    assert 1 / 3 in ends and 0.7 in ends
    halves = [b - a for a, b in zip([0.1, *ends[2:]], ends[2:], strict=False)]
    assert halves[:2] == pytest.approx([0.1, 1 / 3 - 0.2])


def test_steps_go_on_after_a_level_as_before():
    ends = walk(ErrorControl(0.01, [0.3001]), lambda start, end: ((end - start) / 0.1) ** 2)
    sizes = np.diff([0.0, *ends])
    after = ends.index(0.3001) + 1
    # (ratio = 0.5 is where 0.9 ratio^-0.35 ratio^0.2 is 1: steps of 0.07)
    assert sizes[after - 2 : after] == pytest.approx(0.047, abs=1e-4)
    assert sizes[after] > 0.065
    assert sizes[after:-2] == pytest.approx(0.07, rel=0.13)


def test_a_step_with_too_large_an_error_is_taken_back():
    control = ErrorControl(0.01)
    tried = []

    def ratio(start, end):
        tried.append((start, end))
        return 1.0 if start < 0.05 else 9.0 if end - start > 0.03 else 1.0

    ends = walk(control, ratio)
    assert tried[1] == (0.05, pytest.approx(0.095))
    assert tried[2] == (0.05, pytest.approx(0.05 + 0.9 / 3.0 * 0.045))
    assert all(start != tried[i + 1][0] or i == 1 for i, (start, _) in enumerate(tried[:2], 0))
    assert ends[0] == 0.05


def test_a_first_step_is_taken_back_where_something_touches():
    # Half of its motion counts as its error, whatever its size: that alone must not reject it.
    control = ErrorControl(0.01)
    control.judge(StepError(0.5, 1.0, False))
    assert not control.reject()
    control.judge(StepError(0.5, 1.0, False, True))
    assert control.reject() and control.target == pytest.approx(0.01)
    control.judge(StepError(0.5, 1.0, False, True))
    assert not control.reject()
    control.accept(5)
    assert control.share == pytest.approx(0.01)


@pytest.mark.parametrize(("length", "motion"), [(None, 1.0 / 0.05), (2.0, 2.0)])
def test_what_an_obstacle_drives_is_compared_with_the_motion_to_come(length, motion):
    control = ErrorControl(0.01, length=length)
    found = StepError(1e-3, 1.0, False, True, driven=True)
    assert control.judge(found) == pytest.approx(1e-3 / (0.015**2 * motion))


def test_a_step_that_failed_is_halved_and_does_not_grow_at_once():
    control = ErrorControl(0.01)
    assert control.cut_back() and control.target == 0.025
    control.judge(StepError(0.0, 1.0, True))
    control.accept(3)
    assert control.target == 0.05
    control.accept(3)
    assert control.target == pytest.approx(0.1)
    while control.cut_back():
        pass
    assert control.target - 0.05 == pytest.approx(0.05 / 1024)
    control.begin_anew()
    assert control.target == pytest.approx(0.1)


def test_cutbacks_come_to_an_end_wherever_a_run_is():
    # The size of a step, an end less a beginning, is the smallest one but for round-off.
    control = ErrorControl(0.01)
    for _ in range(50):
        assert sum(1 for _ in zip(range(100), iter(control.cut_back, False), strict=False)) <= 10
        control.judge(StepError(0.0, 1.0, True))
        control.accept(3)


def test_a_tolerance_that_cannot_be_kept_is_told_once():
    # Every other step is good: a run that is only missed now and then goes on.
    control = ErrorControl(1e-3)
    told, number = [], 0
    while control.share < 0.06:
        good = number % 2 and control.target - control.share < 1e-4
        control.judge(StepError(0.0 if good else 1e3 * control.target, 1.0, False))
        if not control.reject():
            told += [] if control.complaint is None else [(control.share, control.complaint)]
            assert control.failure is None
            control.accept(5)
            number += 1
    assert len(told) == 1 and told[0][0] < 0.1
    assert "tolerance=0.001 cannot be kept: a step of the smallest" in told[0][1]


@pytest.mark.parametrize("options", [{"tolerance": 1e-8}, {"length": 1e-9}], ids=str)
def test_a_run_that_cannot_keep_its_tolerance_ends_early(options):
    # It had gone on with up to twenty thousand steps of the smallest size.
    problem = column(60e3)
    with pytest.warns(UserWarning, match="cannot be kept") if WORLD.rank == 0 else nullcontext():
        with pytest.raises(mpm.MPMError, match="10 steps in a row of the smallest") as caught:
            problem.solve("auto", **options)
    history = problem.history
    assert all(text == str(caught.value) for text in WORLD.allgather(str(caught.value)))
    assert caught.value.load == history.load[-1]
    assert 0.05 < history.load[-1] < 0.06 and len(history.steps) <= 12
    assert problem.particles.load.value == history.load[-1]
    next(problem.steps(20))
    assert history.load[-1] > 0.09


def test_sizes_follow_the_second_difference():
    # The same, from displacements alone: e = D^2 / (D + D') |u / D - u' / D'|.
    tolerance = 0.06
    problem = column()
    d, ends, yielded = [np.zeros_like(nodal(problem))], [0.0], []
    before = 0.0
    for step in problem.steps("auto", tolerance=tolerance):
        d.append(nodal(problem))
        ends.append(step.load)
        now = float(np.sum(problem.particles.plastic_strain))
        yielded.append(WORLD.allreduce(now) > before)
        before = WORLD.allreduce(now)
    u, D = np.diff(d, axis=0), np.diff(ends)
    ratio = [1.0 if yielded[0] else 0.02]
    ratio[0] *= 0.5 / (8 * tolerance) ** 2
    for k in range(1, len(D)):
        e = D[k] ** 2 / (D[k] + D[k - 1]) * (u[k] / D[k] - u[k - 1] / D[k - 1])
        weight = 1.0 if yielded[k] else 0.02
        motion = (8 * tolerance) ** 2 * np.linalg.norm(d[k + 1])
        ratio.append(weight * np.linalg.norm(e) / motion)
    assert max(ratio[1:]) <= 4.0
    checked = 0
    starts = [attempt.load - attempt.size for attempt in problem.history.taken_back]
    for k in range(1, len(D) - 1):
        expected = D[k] * np.clip(0.9 * ratio[k] ** -0.35 * ratio[k - 1] ** 0.2, 0.2, 2.0)
        if np.isclose(starts, ends[k + 1]).any() or expected > 0.5 * (1.0 - ends[k + 1]):
            continue  # what was tried first was larger
        assert D[k + 1] == pytest.approx(expected, rel=1e-6)
        checked += 1
    assert checked >= 5


def nodal(problem):
    """Return the displacements of all nodes, of all ranks, in the order of their numbers."""
    W = problem.particles.W
    own = problem.particles.converged_displacement[: W.dofmap.index_map.size_local * 2]
    return np.concatenate(WORLD.allgather(own))


@pytest.mark.slow
@pytest.mark.parametrize(("weight", "cell"), [(20e3, QUADRILATERAL), (80e3, TRIANGLE)])
def test_the_error_is_within_the_tolerance(weight, cell):
    width = weight / 1e3
    reference = column(weight, cell, width=width)
    reference.solve(steps=320)
    exact = nodal(reference)
    for tolerance in (0.04, 0.02):
        problem = column(weight, cell, width=width)
        history = problem.solve("auto", tolerance=tolerance)
        assert distance(nodal(problem), exact) <= tolerance
        assert history.load[-1] == 1.0 and len(history.steps) < 80


def test_output_and_what_was_taken_back():
    problem = column()
    for step in problem.steps("auto", tolerance=0.04, output_at=LEVELS):
        assert step.output == (step.load in (*LEVELS, 1.0))
    history = problem.history
    assert {*LEVELS, 1.0} <= set(history.load)
    rejected = [a for a in history.taken_back if "times the allowed" in a.reason]
    assert len(rejected) == history.statistics["rejected_steps"] >= 1
    assert history.failed_iterations == sum(a.iterations for a in history.taken_back)
    for attempt in rejected:
        start = attempt.load - attempt.size
        k = int(np.argmin(np.abs(np.array(history.load) - start)))
        assert history.load[k] == pytest.approx(start) and history.load[k + 1] < attempt.load


class Noting(mpm.contact.Rigid):
    """An obstacle that notes what it is asked."""

    def drives(self):
        self.told = [*getattr(self, "told", []), super().drives()]
        return self.told[-1]


def pressed(law=None):
    """Return a block and a rigid disc on it that moves down by 0.1, its path and the disc."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [4.0, 3.0], [8, 6], QUADRILATERAL))
    body = scenes.box([0.0, 0.0], [4.0, 2.0], [16, 8], QUADRILATERAL)
    particles = mpm.Particles(body, V)
    disc = Noting(
        particles,
        mpm.contact.disc((2.0, 3.0), 1.0),
        facets=(scenes.facet_tags(body, scenes.at(1, 2.0)), 1),
    )
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, law or mpm.materials.VonMises(500.0, 0.3, rho_y=1.0)),
        bcs=[
            scenes.fix(V, scenes.at(axis, place), component=axis)
            for axis, place in ((0, 0.0), (0, 4.0), (1, 0.0))
        ],
        terms=[disc],
    )
    return problem, lambda t: disc.move((0.0, -0.1 * t)), disc


@pytest.mark.slow
def test_errors_of_contact_from_the_first_step_on_fall_with_the_tolerance():
    ends = []
    for count in (25, 50):
        problem, path, _ = pressed()
        problem.solve(count, update=path)
        ends.append(nodal(problem))
    exact, errors = 2.0 * ends[1] - ends[0], []  # equal steps converge in first order
    for tolerance in (0.04, 0.02):
        problem, path, disc = pressed()
        history = problem.solve("auto", tolerance=tolerance, update=path)
        assert history.taken_back[0].size == 0.05
        assert "times the allowed" in history.taken_back[0].reason
        assert history.steps[0].load < 0.05
        assert any(WORLD.allgather(disc.told[-1]))
        errors.append(distance(nodal(problem), exact))
        assert errors[-1] <= tolerance
    assert errors[1] < 0.7 * errors[0]


def test_steps_are_driven_where_an_obstacle_moves_and_points_yield():
    def told_in_a_run(problem, path, disc):
        disc.told = []
        problem.solve("auto", tolerance=0.04, update=path)
        return any(WORLD.allgather(any(disc.told)))

    problem, path, disc = pressed()
    assert told_in_a_run(problem, path, disc)
    count = len(problem.history.steps)
    assert not told_in_a_run(problem, lambda t: disc.move((0.0, -0.1)), disc)  # it rests
    elastic, path, _ = pressed(Hencky(500.0, 0.3))
    judged = elastic.solve("auto", tolerance=0.04, update=path).steps
    assert len(judged) < 0.5 * count  # where nothing yields the motion so far counts


def test_a_rejected_step_leaves_no_trace():
    # A run from the state before it goes the same way.
    problem = column()
    states = []
    for _ in problem.steps("auto", tolerance=0.04):
        states.append(nodal(problem))
    other = column()
    loads = [0.0, *problem.history.load]
    assert problem.history.statistics["rejected_steps"] >= 1
    for load, expected in zip(loads[1:], states, strict=True):
        other.particles.load.value = load
        other.step()
        np.testing.assert_allclose(nodal(other), expected, rtol=0, atol=1e-7 * np.ptp(expected))


def test_failures_are_cut_back():
    failures = []

    class Sulky(Hencky):
        def update(self, displacement_gradient, state, tangent=True):
            if len(failures) < 3:
                failures.append(1)
                raise mpm.ConvergenceError("Not yet", [0] if len(displacement_gradient) else [])
            return super().update(displacement_gradient, state, tangent)

    problem, _ = pulled(Sulky(1e3, 0.3), end=0.1, line_search=False)
    history = problem.solve("auto")
    assert history.cutbacks == 3 and len(history.taken_back) == 3
    assert all("Not yet" in attempt.reason for attempt in history.taken_back)
    assert [a.size for a in history.taken_back] == [0.05, 0.025, 0.0125]
    # What follows a failure is no larger, and what follows that at most twice as large.
    assert history.load[0] == 0.00625 and history.load[-1] == 1.0
    assert history.load[1] <= 0.0125 and history.load[2] <= 0.025


@pytest.mark.parametrize("predictor", [True, False])
def test_a_run_goes_on_from_a_checkpoint(mpi_tmp_path, predictor):
    options = {"tolerance": 0.1, "output_at": LEVELS}
    problem = column(predictor=predictor)
    for number, _ in enumerate(problem.steps("auto", **options)):
        if number == 5:
            problem.save(mpi_tmp_path / "state")
    resumed = column(predictor=predictor)
    resumed.restore(mpi_tmp_path / "state")
    raises(
        lambda: resumed.solve("auto", tolerance=0.02, output_at=LEVELS),
        mpm.MPMError,
        r"steps chosen by tolerance=0.1, .*output_at=\[0.3, 0.55\]",
    )
    raises(lambda: resumed.solve(10), mpm.MPMError, r"steps chosen by tolerance=0.1")
    resumed.solve("auto", **options)
    one, two = resumed.history, problem.history
    assert one.iterations == two.iterations and one.total_iterations == two.total_iterations
    if WORLD.size == 1:  # else sums over ranks differ in their last digits
        assert one.steps == two.steps and one.taken_back == two.taken_back
    np.testing.assert_allclose(one.load, two.load, rtol=EXACT)
    assert [step.output for step in one.steps] == [step.output for step in two.steps]
    same_run(outcome(resumed), outcome(problem), EXACT)


def test_displacement_control_and_paths():
    problem, value = pulled(Hencky(1e3, 0.3), end=0.0)

    def path(t):
        value.value[0] = 0.2 * t

    loads = [step.load for step in problem.steps("auto", update=path, output_at=[0.5])]
    assert 0.5 in loads and loads[-1] == 1.0
    other = scenes.block(force=(0.0, -1.0))
    top = mpm.DisplacementControl(other.particles, -0.01, point=(1.0, 1.0), direction=(0.0, 1.0))
    shares = [s.displacement for s in other.steps("auto", control=top, output_at=[0.5])]
    assert -0.005 in shares and shares[-1] == -0.01 and top.present() == pytest.approx(-0.01)


def test_a_second_stage_is_measured_by_its_own_motion():
    # After a first stage that moves the block by 100 the errors of 1e-3 count all the same.
    def second(first):
        problem, value = pulled(mpm.materials.VonMises(1e3, 0.3, rho_y=2.0), end=0.0)
        if first:
            value.value[0] = 0.05
            problem.step()
        begin = value.value[0]

        def path(t):
            value.value[1] = 0.02 * t
            value.value[0] = begin

        return [step.load for step in problem.steps("auto", update=path)]

    assert 0.4 < len(second(True)) / len(second(False)) < 2.5


def test_a_length_instead_of_the_motion():
    runs = []
    for length in (None, 1.0, 1e-4):
        problem = scenes.block(force=(0.0, -1.0))
        runs.append(len(problem.solve("auto", length=length).steps))
    assert runs[1] < runs[0] < runs[2]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"steps": "automatic"}, r"steps must be a whole number from 1 on or 'auto'"),
        ({"steps": 3, "output_at": [0.5]}, r"are for steps='auto', not for steps=3"),
        ({"steps": 3, "tolerance": 0.1}, r"are for steps='auto', not for steps=3"),
        ({"tolerance": 0.0}, r"tolerance must be a positive number up to 1, not 0.0"),
        ({"tolerance": "small"}, r"tolerance must be a positive number"),
        ({"length": -1.0}, r"length must be a positive number, not -1.0"),
        ({"output_at": [0.0, 0.5]}, r"output_at must be a list of shares of the run"),
        ({"output_at": 0.5}, r"output_at must be a list of shares of the run"),
    ],
)
def test_what_makes_no_sense_is_refused(options, told):
    problem = scenes.block(force=(0.0, -1.0))
    raises(lambda: problem.solve(**{"steps": "auto", **options}), mpm.MPMError, told)
    assert not problem.history.steps
