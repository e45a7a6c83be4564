# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Ctrl-C, and errors of a user's code: the state is that of the last converged step."""

import itertools
import os
import signal
import threading

import numpy as np
import pytest
import scenes
from marks import slow
from scenes import TRIANGLE, WORLD
from stress import interrupts

import mpm_dolfinx as mpm


@pytest.fixture(autouse=True)
def handler():
    """Look whether SIGINT does afterwards what it did before.

    In the background of a shell without job control it is ignored, by what runs there too.
    """
    given = signal.signal(signal.SIGINT, signal.default_int_handler)
    before = signal.getsignal(signal.SIGINT)
    yield
    assert signal.getsignal(signal.SIGINT) is before
    signal.signal(signal.SIGINT, given)


def slump():
    return scenes.slump(TRIANGLE, 20e3, h=1.0)


def at_evaluation(problem, number, action, rank=None):
    """Do something in the residual's evaluation of a number, on one rank or on all."""
    evaluate, count = problem.evaluate, [0]

    def counted():
        count[0] += 1
        if count[0] == number and rank in (None, WORLD.rank):
            action()
        return evaluate()

    problem.evaluate = counted
    return count


def ctrl_c():
    os.kill(os.getpid(), signal.SIGINT)


def interrupt(problem, error=KeyboardInterrupt, steps=3, **options):
    """Run until an error; compare the state with that after the last step; return the error."""
    kept = interrupts.whole_state(problem)
    with pytest.raises(error) as caught:
        for _ in problem.steps(steps, **options):
            kept = interrupts.whole_state(problem)
    scenes.assert_same_state(kept, interrupts.whole_state(problem))
    assert set(WORLD.allgather(len(problem.history.steps))) == {len(problem.history.steps)}
    return caught.value


@pytest.mark.parametrize("number", [1, 5, 14, *slow(2, 9, 19)])
def test_a_signal_takes_the_step_back(number):
    # On one of the ranks, in a prediction, an iteration or a line search.
    problem = slump()
    count = at_evaluation(problem, number, ctrl_c, number % WORLD.size)
    interrupt(problem)
    assert count[0] <= number + 1
    # The run goes on as if nothing had been.
    other = slump()
    done = len(problem.history.steps)
    for _ in itertools.islice(other.steps(3), done):
        pass
    for each in (problem, other):
        each.particles.load.value = min(1.0, (done + 0.5) / 3)
        each.step()
    one, two = (each.particles.displacement.x.array for each in (problem, other))
    if WORLD.size == 1:
        assert np.array_equal(one, two)
    np.testing.assert_allclose(one, two, rtol=0.0, atol=1e-9)


def test_signals_of_a_timer():
    problem, interruptions = slump(), 0
    for delay in (0.0, 0.01, 0.02, 0.04, 0.06, 0.1):
        problem = slump()
        kept = interrupts.whole_state(problem)
        timer = threading.Timer(delay, ctrl_c)
        try:
            if WORLD.rank == 0:
                at_evaluation(problem, 1, timer.start)
            problem.solve(8)
            if WORLD.rank == 0:
                timer.join()  # the signal may come after the run
        except KeyboardInterrupt:
            interruptions += 1
        done = len(problem.history.steps)
        assert float(problem.particles.load.value) == done / 8
        if WORLD.size == 1:
            other = slump()
            kept = interrupts.whole_state(other)
            for _ in itertools.islice(other.steps(8), done):
                kept = interrupts.whole_state(other)
            scenes.assert_same_state(kept, interrupts.whole_state(problem))
    assert WORLD.bcast(interruptions) >= 3


def test_a_signal_in_the_last_moment_of_a_step_ends_the_run_after_it():
    problem = slump()
    commit = problem.commit

    def late():
        commit()
        ctrl_c()

    problem.commit = late
    kept = None
    with pytest.raises(KeyboardInterrupt):
        for _ in problem.steps(3):
            kept = interrupts.whole_state(problem)
    assert len(problem.history.steps) == 1
    scenes.assert_same_state(kept, interrupts.whole_state(problem))
    with pytest.raises(KeyboardInterrupt):
        problem.step()
    assert len(problem.history.steps) == 2


def test_a_signal_on_a_path_and_under_control():
    problem = slump()
    asked = []
    at_evaluation(problem, 9, ctrl_c)
    interrupt(problem, update=asked.append)
    assert len(problem.history.steps) >= 1 and asked[-1] == problem.history.load[-1]
    problem = slump()
    control = mpm.DisplacementControl(problem.particles, -0.5, (0.0, 8.0), (0.0, 1.0))
    at_evaluation(problem, 7, ctrl_c)
    interrupt(problem, control=control)


def test_a_single_step_is_taken_back():
    problem = slump()
    at_evaluation(problem, 2, ctrl_c, WORLD.size - 1)
    kept = interrupts.whole_state(problem)
    problem.particles.load.value = 0.3
    with pytest.raises(KeyboardInterrupt):
        problem.step()
    scenes.assert_same_state(kept, interrupts.whole_state(problem))


def test_a_keyboard_interrupt_of_a_users_code():
    # Raised where Python likes to, by a handler of the user's own say.
    def stop():
        raise KeyboardInterrupt

    problem = slump()
    at_evaluation(problem, 6, stop, WORLD.size - 1)
    interrupt(problem)


def test_a_handler_of_the_users_own_stays():
    calls = []
    signal.signal(signal.SIGINT, lambda *_: calls.append(1))
    try:
        problem = slump()
        at_evaluation(problem, 3, ctrl_c)
        problem.solve(1)
        assert calls == [1]
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def test_runs_in_another_thread():
    if WORLD.size > 1:
        pytest.skip("threads do not call MPI")
    problem = slump()
    thread = threading.Thread(target=problem.solve, args=(1,))
    thread.start()
    thread.join()
    assert problem.history.load == [1.0]


# -- Errors of a user's code ----------------------------------------------------------------


class Failing(mpm.materials.Hencky):
    """Hencky's law, which fails from some update on."""

    when, calls = np.inf, 0

    def update(self, displacement_gradient, state, tangent=True):
        self.calls += 1
        if self.calls >= self.when:
            divide()
        return super().update(displacement_gradient, state, tangent)


@pytest.mark.parametrize("when", [1, 4, 8])
def test_an_error_in_a_material_is_told(when):
    law = Failing(1e6, 0.3)
    problem = scenes.slump(TRIANGLE, 10e3, law, h=1.0)
    law.when = law.calls + when
    error = interrupt(problem, mpm.MPMError)
    assert "ZeroDivisionError" in str(error)
    if WORLD.size == 1:
        assert isinstance(error.__cause__, ZeroDivisionError)
    law.when = np.inf
    problem.solve(3)
    assert problem.history.load[-1] == 1.0


def divide():
    return 1 / 0


@pytest.mark.parametrize("refused", [True, *slow(False)])
def test_an_error_in_any_one_evaluation_ends_the_step(refused):
    # Some are at trials that the line search gives up for shorter ones.
    whole = scenes.slump(TRIANGLE, 15e3, h=1.0)
    count = at_evaluation(whole, 0, divide)
    whole.solve(2)
    assert whole.history.statistics["halvings"] > 0
    for number in range(1, count[0] + 1, 1 if WORLD.size == 1 else 4):
        problem = scenes.slump(TRIANGLE, 15e3, h=1.0)
        done = at_evaluation(problem, number, divide, WORLD.size - 1)
        if refused:  # at the same evaluation, by a term before that and by the first rank
            refuse_after(problem.built.body_terms[0], done, number - 1)
        error = interrupt(problem, mpm.MPMError, steps=2)
        assert "ZeroDivisionError" in str(error)


def refuse_after(term, done, number):
    """Let a term refuse all displacements after a number of evaluations."""
    update = term.update

    def refusing():
        found = update()
        return mpm.ConvergenceError("Too far") if done[0] >= number else found

    term.update = refusing


def test_an_error_in_a_call_of_petsc_comes_out_as_itself():
    whole, problem = slump(), slump()
    smooth, problem.reduced.terms.smooth = problem.reduced.terms.smooth, divide
    kept = interrupts.whole_state(problem)
    with pytest.raises(ZeroDivisionError):
        for _ in problem.steps(1):
            kept = interrupts.whole_state(problem)
    scenes.assert_same_state(kept, interrupts.whole_state(problem))
    problem.reduced.terms.smooth = smooth
    problem.solve(3)
    whole.solve(3)
    gap = problem.particles.displacement.x.array - whole.particles.displacement.x.array
    assert scenes.largest(gap) < 1e-9


def test_an_error_on_a_path_comes_out_as_itself():
    problem = slump()

    def path(t):
        if t > 0.5:
            divide()

    error = interrupt(problem, ZeroDivisionError, update=path)
    assert error.__cause__ is None
    assert problem.history.load == [1 / 3]


def test_an_error_in_commit_leaves_the_step_before():
    problem = slump()
    commit, fails = problem.commit, [False, True]

    def failing():
        if fails.pop(0):
            divide()
        commit()

    problem.commit = failing
    error = interrupt(problem, mpm.MPMError)
    assert "ZeroDivisionError" in str(error)
    assert len(problem.history.steps) == 1


@pytest.mark.parametrize("where", [0, WORLD.size - 1])
def test_a_commit_that_fails_takes_back_those_before(where):
    problem = slump()
    seen = []

    def failing():
        seen.append(scenes.largest(problem.particles.stress))
        if len(seen) == 2 and WORLD.rank == where:
            divide()

    problem.commit = failing
    error = interrupt(problem, mpm.MPMError)
    assert "ZeroDivisionError" in str(error)
    assert len(problem.history.steps) == 1
    # A hook sees the step that has converged, and none of it is left.
    assert seen[1] > 1.5 * seen[0] > 0.0
    assert scenes.largest(problem.particles.stress) == seen[0]
