# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The estimated error of steps in time, beside exact motions and much shorter steps."""

import numpy as np
import pytest
from marks import slow, thinned
from obstacles import wall
from own_schemes import BDF2, Theta
from scenes import QUADRILATERAL, WORLD, anywhere, box, gather, vectors

import mpm_dolfinx as mpm
from mpm_dolfinx import contact
from mpm_dolfinx.materials import LinearElastic, VonMises
from mpm_dolfinx.meshes.redistribution import Redistribution
from mpm_dolfinx.system.schemes import Conserving, Euler, Midpoint, order_of


@pytest.mark.parametrize(
    ("scheme", "order", "constant"),
    [
        (Midpoint(), 2, 1 / 12),
        (Midpoint(reflects=True), 2, 1 / 12),
        (Conserving(), 2, 1 / 12),
        (Euler(), 1, 1 / 2),
        (Theta(0.7), 1, 0.7 - 0.5),
        (BDF2(), 2, 1 / 3),
    ],
)
def test_order_and_constant_of_a_scheme_are_those_of_its_expansion(scheme, order, constant):
    found = order_of(WORLD, scheme)
    assert found[0] == order and found[1] == pytest.approx(constant, rel=5e-3)


def background(comm=WORLD):
    """Return the space on a background of 2 x 2."""
    return vectors(box([0.0, 0.0], [2.0, 2.0], [8, 8], QUADRILATERAL, comm))


TIGHT = mpm.Solver(petsc_options={"snes_rtol": 1e-12})


def block(low, V, comm=WORLD):
    """Return a square of the side 0.5."""
    return mpm.Particles(box(list(low), [x + 0.5 for x in low], [4, 4], QUADRILATERAL, comm), V)


def falling(**options):
    """Return a block that falls with the acceleration 2."""
    body = mpm.Body(
        block((0.43, 1.2), background()),
        LinearElastic(1e3, 0.3),
        density=1.0,
        body_force=(0.0, -2.0),
    )
    return mpm.DynamicProblem(body, **options)


def test_backward_euler_falls_too_far_by_what_is_estimated():
    problem = falling(scheme="euler")
    steps, time = 8, 0.6
    history = problem.solve(time=time, dt=time / steps)
    fallen = time**2 + time**2 / steps  # exactly
    assert history.steps[0].time_error is None
    assert history.steps[-1].motion == pytest.approx(fallen, rel=1e-9)
    assert history.time_error * fallen == pytest.approx(fallen - time**2, rel=1e-3)


def test_the_midpoint_rule_falls_without_error():
    problem = falling()
    history = problem.solve(time=0.6, dt=0.1)
    assert [step.time_error is None for step in history.steps] == [True, True] + 4 * [False]
    assert history.time_error < 1e-8
    assert "of the motion uncertain" in " ".join(problem.summary().split())


def bar(scheme):
    """Return a bar whose first mode swings with the period 2 while it flies slowly."""
    V = vectors(box([0.0, 0.0], [1.75, 1 / 8], [28, 2], QUADRILATERAL))
    body = mpm.Particles(box([0.3, 0.0], [1.3, 1 / 8], [32, 4], QUADRILATERAL), V)

    def velocity(x):
        return np.stack([0.02 + 0.05 * np.pi * np.cos(np.pi * (x[0] - 0.3)), 0.0 * x[0]])

    return mpm.DynamicProblem(
        mpm.Body(body, LinearElastic(1.0, 0.0), density=1.0, velocity=velocity),
        scheme=scheme,
        solver=TIGHT,
    )


@pytest.mark.parametrize(
    ("scheme", "uneven"),
    thinned(
        2,
        [
            *(("midpoint", False), ("midpoint", True)),
            *(("conserving", True), ("conserving", False)),
            *((BDF2(), True), (BDF2(), False)),
            *(("euler", True), ("euler", False)),
        ],
    ),
)
def test_what_a_vibration_has_lost_is_what_is_estimated(scheme, uneven):
    steps = 120 if scheme == "euler" else 30
    problem, time, errors = bar(scheme), 3.0, []
    particles = problem.particles
    x = particles.W.tabulate_dof_coordinates()[:, 0] - 0.3
    shape = 0.05 * np.cos(np.pi * x)
    places = [time * (k + 0.6) / steps for k in range(0, steps, 2)] if uneven else ()
    for step in problem.steps(
        time=time, dt=time / steps * (2.0 if uneven else 1.0), output_at=places
    ):
        exact = 0.02 * step.time + shape * np.sin(np.pi * step.time)
        wrong = particles.displacement.x.array.reshape(-1, 2)[:, 0] - exact
        count = WORLD.allreduce(len(wrong))
        errors.append(np.sqrt(WORLD.allreduce(float(wrong @ wrong)) / count))
    most = max(step.motion for step in problem.history.steps)
    effectivity = problem.history.time_error * most / max(errors)
    assert 0.4 < effectivity < 2.0


def thrown(kind, **options):
    """Return a block that hits something: a wall, yielding or not, another block, or a body."""
    V = background()
    one, terms = block((0.43, 0.55), V), []
    law = VonMises(20.0, 0.3, rho_y=1.2) if kind == "plastic" else LinearElastic(20.0, 0.3)
    speed = 0.5 if kind in ("pair", "background") else -1.0
    bodies = [mpm.Body(one, law, density=1.0, velocity=(speed, 0.0))]
    if kind in ("rigid", "plastic"):
        terms = [wall(one, (0.35, 0.0), (1.0, 0.0))]
    if kind in ("pair", "background"):
        other = block((1.13, 0.55), background() if kind == "pair" else V)
        bodies.append(mpm.Body(other, law, density=1.0, velocity=(-0.5, 0.0)))
        terms = [contact.Pair(one, other)] if kind == "pair" else []
    if kind == "body":
        disc = contact.disc((0.2, 0.8), 0.15)
        terms = [contact.RigidBody(one, disc, mass=0.2, inertia=0.002)]
    return mpm.DynamicProblem(bodies, terms=terms, **options)


@pytest.mark.parametrize(
    ("kind", "scheme"),
    [
        pytest.param("rigid", "midpoint", marks=pytest.mark.slow),
        pytest.param("plastic", "euler", marks=pytest.mark.slow),
        pytest.param("plastic", "conserving", marks=pytest.mark.slow),
        pytest.param("pair", "conserving", marks=pytest.mark.slow),
        ("background", "euler"),
        pytest.param("body", "midpoint", marks=pytest.mark.slow),
    ],
)
def test_an_impact_is_as_uncertain_as_is_estimated(kind, scheme):
    ends = []
    for steps in (20, 80 if scheme == "euler" else 160):
        problem = thrown(kind, scheme=scheme)
        history = problem.solve(time=0.4, dt=0.4 / steps)
        ends.append((displacements(problem), history.time_error))
    most = max(step.motion for step in history.steps)
    error = np.linalg.norm(ends[0][0] - ends[1][0]) / np.sqrt(len(ends[0][0]) / 2) / most
    assert 0.3 < ends[0][1] / error < 3.0
    assert ends[1][1] < 0.6 * ends[0][1]


def displacements(problem):
    """Return the displacements of all bodies' corners, of all ranks."""
    return np.concatenate(
        [gather(one.displacement.x.array.copy()).ravel() for one in problem.bodies]
    )


def numbers(problem):
    """Return what each step tells of its error and of the motion."""
    steps = problem.history.steps
    return np.array([[np.nan if s.time_error is None else s.time_error, s.motion] for s in steps])


@pytest.mark.parametrize("scheme", ["midpoint", *slow("euler")])
def test_a_run_that_is_restored_tells_the_same_errors(mpi_tmp_path, scheme):
    whole = thrown("plastic", scheme=scheme)
    for step in whole.steps(time=0.3, dt=0.03):
        if len(whole.history.steps) == 4:
            whole.save(mpi_tmp_path / "run.ckpt")
    restored = thrown("plastic", scheme=scheme)
    restored.restore(mpi_tmp_path / "run.ckpt")
    np.testing.assert_array_equal(numbers(restored), numbers(whole)[:4])
    restored.solve(time=0.3, dt=0.03)
    np.testing.assert_array_equal(numbers(restored), numbers(whole))
    # With other steps it is no worse known: no first steps come again.
    other = thrown("plastic", scheme=scheme)
    other.restore(mpi_tmp_path / "run.ckpt", resume=False)
    other.solve(time=0.3, dt=0.015)
    assert np.isfinite(numbers(other)[2:]).all() and len(other.history.steps) > 10
    assert other.history.time_error < whole.history.time_error


def test_moves_between_ranks_and_a_rebase_change_no_error():
    alone, moving = (thrown("background") for _ in range(2))
    alone.solve(time=0.3, dt=0.03)
    for number, _ in enumerate(moving.steps(time=0.3, dt=0.03)):
        if number % 3 == 0:
            mesh = moving.bodies[0].mesh
            move = Redistribution(mesh, anywhere(mesh, number))
            moving.state.renew(
                lambda move=move: moving.bodies[0].live_on(move), lambda state: state
            )
    np.testing.assert_allclose(numbers(moving), numbers(alone), rtol=1e-7, atol=1e-12)


def test_a_body_that_comes_in_a_stage_begins_anew():
    problem = thrown("rigid")
    problem.solve(time=0.12, dt=0.03)
    problem.add(mpm.Body(block((1.3, 0.55), problem.bodies[0].V), LinearElastic(20.0, 0.3), 1.0))
    problem.solve(time=0.3, dt=0.03)
    known = [step.time_error is not None for step in problem.history.steps]
    assert known == [False, False, True, True, False, False, True, True, True, True]
    assert problem.history.time_error > 0.0


def test_runs_of_one_step_each_are_one_motion():
    once, each = falling(scheme="euler"), falling(scheme="euler")
    once.solve(time=0.4, dt=0.05)
    for _ in range(8):
        each.step(0.05)
    np.testing.assert_allclose(numbers(each), numbers(once), rtol=1e-8)


@pytest.mark.skip_in_parallel
def test_steps_that_are_too_long_are_told_once():
    problem = falling(scheme="euler")
    with pytest.warns(UserWarning, match="Time steps of 0.15 are too coarse") as told:
        problem.solve(time=0.3, dt=0.15)
        problem.solve(time=0.6, dt=0.15)
    assert len([one for one in told if "too coarse" in str(one.message)]) == 1


def test_what_has_no_time_or_no_inertia_has_no_such_error():
    body = mpm.Body(block((0.43, 0.5), V := background()), LinearElastic(1e3, 0.3), 1.0)
    problem = mpm.QuasiStaticProblem(body.replace(body_force=(0.0, -1.0)), [mpm.held(V, y=0.5)])
    assert problem.solve(2).time_error is None
