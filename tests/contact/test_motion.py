# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Contact in motion: what bounces and collides keeps energy and momentum; friction takes some."""

import numpy as np
import pytest
import scenes
from compare import EXACT, breaks, error_of_a_term, outcome, same_run
from marks import slow, thinned
from posed import posed
from scenes import HEXAHEDRON, QUADRILATERAL, TETRAHEDRON, TRIANGLE, WORLD, box

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import contact
from mpm_dolfinx.materials import Hencky

TIGHT = {"petsc_options": {"snes_rtol": 1e-12}}


def energies(history):
    """Return kinetic plus elastic energy at the end of each step, over that at the beginning."""
    whole = np.array([energy.kinetic + energy.strain for energy in history.energies])
    return whole / whole[0]


def account(history):
    """Return the largest change of what is kept, work against contact and friction included."""
    kept = np.array([e.kinetic + e.internal + e.damping + e.lost for e in history.energies])
    balance = np.array([e.balance for e in history.energies])
    return max(np.ptp(kept), np.ptp(balance)) / kept[0]


def falling(shape, friction=0.0, comm=WORLD, turn=0.0, **options):
    """Return a block that is about to hit an obstacle."""
    V = scenes.vectors(box([-0.6, -0.3], [1.6, 2.0], [8, 8], QUADRILATERAL, comm))
    body = box([0.1, 0.55], [0.9, 1.2], [5, 4], TRIANGLE, comm)
    particles = mpm.Particles(body, V)
    ground = contact.Rigid(particles, shape, friction)
    problem = posed(
        mpm.DynamicProblem,
        particles,
        Hencky(100.0, 0.3),
        1.0,
        velocity=lambda x: np.stack([0.1 - turn * (x[1] - 0.8), -1.0 + turn * (x[0] - 0.5)]),
        terms=[ground],
        **{**TIGHT, **options},
    )
    return problem, ground


@pytest.mark.parametrize(
    ("shape", "turn"),
    [
        (contact.plane((0.0, 0.5), (0.1, 1.0)), 0.5),
        pytest.param(contact.disc((0.4, 0.2), 0.3), 0.0, marks=pytest.mark.slow),
        pytest.param(contact.box((0.2, 0.0), (0.6, 0.5), 0.1), 0.0, marks=pytest.mark.slow),
    ],
    ids=["plane", "disc", "box"],
)
def test_a_block_bounces_off_an_obstacle_with_all_its_energy(shape, turn):
    problem, ground = falling(shape, turn=turn, scheme="conserving", out_of_range="reflect")
    before, pushed = problem.momentum, 0
    for _ in problem.steps(time=0.6, dt=0.02):
        force = problem.reaction(ground)
        assert np.abs(problem.momentum - before - 0.02 * force).max() < 1e-11
        before, pushed = problem.momentum, pushed + bool(np.abs(force).max() > 0.0)
    assert pushed > 3 and problem.momentum[1] > 0.0
    history = problem.history
    assert not ground.touches.any()
    assert abs(energies(history)[-1] - 1.0) < 1e-10 and energies(history).max() < 1.0 + 1e-10
    assert account(history) < 1e-10
    assert np.mean(history.iterations) < 5.0


def test_an_obstacle_that_moves_throws_a_block():
    # A wall of speed 1 hits a block at rest; all that its energy has come from is the wall's work.
    problem, wall = falling(contact.plane((0.0, 0.5), (0.0, 1.0)), scheme="midpoint")
    problem.inertia.velocities[0].x.array[:] = 0.0
    work, at = 0.0, 0.0
    for _ in problem.steps(time=0.44, dt=0.02, update=lambda t: wall.move((0.0, t))):
        work += problem.reaction(wall)[1] * (wall.offset[1] - at)
        at = wall.offset[1]
    last = problem.history.energies[-1]
    assert problem.momentum[1] > 0.6 * 2.0 * 0.52  # (some of it vibrates)
    # (midpoint: energy of large strains to second order)
    assert last.kinetic + last.strain + last.lost == pytest.approx(work, rel=0.02)
    assert last.strain - last.internal == pytest.approx(work, rel=0.02)


def test_friction_takes_energy_and_says_how_much():
    problem, ground = falling(
        contact.disc((0.3, 0.2), 0.3), 0.4, scheme="conserving", out_of_range="reflect"
    )
    for _ in problem.steps(time=0.6, dt=0.02):
        normal = ground.points - [0.3, 0.2]
        normal /= np.linalg.norm(normal, axis=1)[:, None]
        shear = ground.traction - (ground.traction * normal).sum(axis=1)[:, None] * normal
        # (its direction is that of the normal in the middle of the step)
        assert np.all(np.linalg.norm(shear, axis=1) <= 0.45 * ground.pressure + 1e-9)
    history = problem.history
    taken = history.energies[-1].damping / history.energies[0].kinetic
    assert 1e-3 < taken < 0.2
    assert 1.0 - energies(history)[-1] == pytest.approx(taken, abs=1e-10)
    assert account(history) < 1e-10


def on_a_mat(speed, friction=0.0, cell=TRIANGLE, static=True, sideways=0.0, **options):
    """Return a block that falls on a softer mat, with or without inertia, and the contact."""
    spaces = [scenes.vectors(box([-0.6, 0.0], [1.6, 2.0], [8, 8], QUADRILATERAL)) for _ in range(2)]
    block = mpm.Particles(box([0.1, 0.55], [0.9, 1.2], [5, 4], cell), spaces[0])
    mat = mpm.Particles(box([-0.3, 0.0], [1.3, 0.5], [13, 4], QUADRILATERAL), spaces[1])
    touch = contact.Pair(block, mat, friction)
    problem = posed(
        mpm.DynamicProblem,
        [block, mat],
        [Hencky(100.0, 0.3), Hencky(30.0, 0.3)],
        1.0,
        velocity=[(sideways, -speed), None if static else (0.0, 0.0)],
        bcs=[scenes.fix(spaces[1], scenes.at(1, 0.0))],
        terms=[touch],
        quasi_static=[mat] if static else [],
        **{**TIGHT, **options},
    )
    return problem, touch


@pytest.mark.parametrize("scheme", [*slow("midpoint"), "conserving"])
def test_a_block_falls_on_a_mat_without_inertia(scheme):
    # What the block loses of its momentum, the mat's floor has; both halves of the contact count.
    problem, _ = on_a_mat(0.3, scheme=scheme)
    mat, floor = problem.bodies[1], problem.bcs[0]
    before, pushed, lowest = problem.momentum, 0, 0.0
    for step in problem.steps(time=0.8, dt=0.04):
        force = problem.reaction(floor)
        np.testing.assert_allclose((problem.momentum - before)[1], 0.04 * force[1], atol=1e-10)
        before, pushed = problem.momentum, pushed + bool(force[1] > 0.0)
        lowest = min(lowest, float(mat.displacement.x.array.min(initial=0.0)))
        assert step.iterations < 10
    history = problem.history
    assert pushed > 3 and problem.momentum[1] > 0.0 and history.cutbacks == 0
    assert WORLD.allreduce(lowest) < -0.01
    assert account(history) < 1e-10


@pytest.mark.parametrize(
    ("static", "friction", "split"),
    thinned(4, [(True, 0.5, True), (True, 0.0, False), (False, 0.5, True), (False, 0.5, False)]),
)
def test_corners_are_pressed_into_a_mat(static, friction, split):
    # Points come round corners, from one facet to another: the difference of their gaps from both
    # is no motion.
    problem, touch = on_a_mat(1.0, friction, QUADRILATERAL, static, scheme="conserving")
    before, pushed = problem.momentum, 0
    for number, _ in enumerate(problem.steps(time=0.5, dt=0.02)):
        force = problem.reaction(problem.bcs[0])
        if static:  # (else the floor's nodes have a mass of their own)
            np.testing.assert_allclose((problem.momentum - before)[1], 0.02 * force[1], atol=1e-10)
        before, pushed = problem.momentum, pushed + bool(force[1] > 0.0)
        if split and number == 10:
            sticks, force = touch.sticks, problem.reaction(touch)
            problem.split(np.arange(problem.bodies[0].num_global))
            assert touch.sticks.dtype == bool  # numbers would choose points one and none
            assert WORLD.allreduce(touch.sticks.sum()) == WORLD.allreduce(sticks.sum()) > 0
            assert np.abs(problem.reaction(touch) - force).max() < 1e-12 * np.abs(force).max()
    history = problem.history
    assert pushed > 10 and problem.momentum[1] > 0.0
    assert history.cutbacks <= (0 if static else 1) and max(history.iterations) <= 6
    assert energies(history).max() < 1.0 + 1e-9 and account(history) < 1e-10


def test_points_that_rub_across_a_kink_end_their_steps_on_the_facet_that_is_there():
    # Where they stayed beyond the end of one of before, the next step had another gap to begin
    # with: a force that grew as steps were halved, at bends of four degrees too.
    problem, touch = on_a_mat(1.5, 0.8, QUADRILATERAL, sideways=-0.8, scheme="conserving")
    block, pushed = problem.bodies[0], 0
    for number, _ in enumerate(problem.steps(time=0.5, dt=0.02)):
        pushed += bool(problem.reaction(touch)[1] > 0.0)
        if number == 10:
            x = block.initial_domains.mean(axis=1)
            lower = (np.abs(x[:, 0] - 0.5) > 0.3) & (x[:, 1] < 0.7)
            both = WORLD.allgather(block.global_index[lower])
            problem.split(np.sort(np.concatenate(both)))
    history = problem.history
    assert pushed > 10 and problem.momentum[1] > 0.0 and block.num_global == 22
    assert history.cutbacks <= 3 and max(history.iterations) <= 10
    assert energies(history).max() < 1.0 + 1e-9 and account(history) < 1e-10


class Worn(contact.Friction):
    """Friction that falls with the way that points have slipped."""

    memory = (0.0,)

    def bound(self, at):
        return (0.3 + 0.2 * np.exp(-(at.memory[:, 0] + at.slip) / 0.01)) * at.pressure

    def remember(self, at):
        return at.memory + at.slip[:, None]


@pytest.mark.parametrize("friction", [0.0, 0.5, Worn()])
@pytest.mark.parametrize("what", ["rigid", "pair"])
def test_tangent_is_the_derivative_of_the_forces(what, friction):
    if what == "rigid":
        problem, term = falling(contact.disc((0.4, 0.2), 0.3), friction, scheme="midpoint")
        steps = problem.steps(time=0.14, dt=0.02)
    else:
        problem, term = colliding(friction, scheme="midpoint")
        steps = problem.steps(time=0.6, dt=0.04)
    for _ in steps:
        if np.abs(problem.reaction(term)).max() > 0.0:
            break
    bodies = problem.bodies
    start = [body.displacement.x.array.copy() for body in bodies]
    start[0].reshape(-1, 2)[:] += (0.013, -0.011)
    term.pace(0.02, 0.5)
    term.begin()
    assert error_of_a_term(term, bodies, start) < 1e-6


def colliding(
    friction=0.0,
    comm=WORLD,
    cells=(QUADRILATERAL, TRIANGLE),
    passes=2,
    law="penalty",
    **options,
):
    """Return two blocks on fields of their own that fly towards each other, one of them tilted."""
    mesh = box([-0.8, -0.7], [1.9, 1.3], [9, 7], QUADRILATERAL, comm)
    Va, Vb = (scenes.vectors(mesh) for _ in range(2))
    upper = box([0.0, 0.0], [0.5, 0.4], [4, 3], cells[0], comm)
    c, s = np.cos(0.4), np.sin(0.4)
    x = upper.geometry.x[:, :2]
    upper.geometry.x[:, :2] = x @ np.array([[c, s], [-s, c]]) + (0.35, 0.31)
    lower = box([0.0, -0.3], [1.0, 0.2], [7, 4], cells[1], comm)
    a, b = mpm.Particles(upper, Va), mpm.Particles(lower, Vb)
    touch = contact.Pair(a, b, friction, passes=passes, law=law)
    problem = posed(
        mpm.DynamicProblem,
        [a, b],
        Hencky(100.0, 0.3),
        1.0,
        velocity=[(0.3, -0.5), (0.0, 0.2)],
        terms=[touch],
        **{"scheme": "conserving", "out_of_range": "reflect", **TIGHT, **options},
    )
    return problem, touch


@pytest.mark.parametrize(
    ("friction", "passes"), thinned(3, [(0.0, 1), (0.0, 2), (0.3, 2), (Worn(), 2)])
)
def test_bodies_that_collide_keep_momentum_and_energy(friction, passes):
    problem, touch = colliding(friction, passes=passes)
    momentum, turning = problem.momentum, problem.angular_momentum
    reach, near, pushed = 0.02 * 0.3, np.inf, 0
    for _ in problem.steps(time=0.44, dt=0.04):
        assert np.abs(problem.momentum - momentum).max() < 1e-11
        assert np.abs(problem.angular_momentum - turning).max() < 1e-11
        gap = WORLD.allreduce(touch.gap.min(initial=np.inf), scenes.MPI.MIN)
        force = np.abs(problem.reaction(touch)).max()
        if passes == 1:  # (otherwise points of b may touch alone)
            assert force == 0.0 or min(gap, near) < reach
        near, pushed = gap, pushed + bool(force > 0.0)
    history = problem.history
    assert pushed > 4 and force == 0.0
    end = energies(history)
    taken = history.energies[-1].damping / history.energies[0].kinetic
    assert end.max() < 1.0 + 1e-9 and end[-1] == pytest.approx(1.0 - taken, abs=1e-6)
    assert (taken > 1e-4) if friction else taken == 0.0
    assert account(history) < 1e-9


@pytest.mark.parametrize("passes", [1, *slow(2)])
def test_a_corner_that_passes_the_other_gives_no_energy(passes):
    # Facets end there, and points come from the side; without an offset of their gaps they would
    # multiply the energy by 1.45.
    problem, touch = colliding(passes=passes)
    momentum = problem.momentum
    problem.solve(time=1.0, dt=0.04)
    assert np.abs(problem.momentum - momentum).max() < 1e-11
    assert energies(problem.history).max() < 1.0 + 1e-9
    assert energies(problem.history)[-1] > 0.98
    assert account(problem.history) < 1e-9
    assert not touch.touches.any()


@pytest.mark.mpi
def test_a_collision_is_the_same_on_any_number_of_ranks():
    problem, touch = colliding(0.3)
    other, alone = colliding(0.3, comm=scenes.MPI.COMM_SELF)
    problem.solve(time=0.28, dt=0.04)
    other.solve(time=0.28, dt=0.04)
    force = other.reaction(alone)
    assert np.abs(force).max() > 0.0
    assert np.abs(problem.reaction(touch) - force).max() < 1e-9 * np.abs(force).max()
    same_run(outcome(problem), outcome(other), 1e-9)


def test_the_account_closes_where_points_have_stayed_with_their_facets(monkeypatch):
    # the forces of a step are those that were in balance, not those of facets looked for again
    monkeypatch.setattr("mpm_dolfinx.contact.facet_pass.FREEZE", 1)
    problem, touch = colliding(0.3, scheme="euler", out_of_range="project")
    pushed = 0
    for _ in problem.steps(time=0.4, dt=0.04):
        pushed += bool(np.abs(problem.reaction(touch)).max() > 0.0)
    balance = np.array([energy.balance for energy in problem.history.energies])
    assert pushed > 3 and np.ptp(balance) < 1e-12 * balance[0]


@pytest.mark.parametrize("what", ["rigid", "pair"])
def test_a_checkpoint_in_the_middle_of_an_impact_goes_on_as_the_run_does(what, mpi_tmp_path):
    def made():
        if what == "pair":
            return colliding(0.3)
        return falling(contact.disc((0.4, 0.2), 0.3), 0.3, scheme="conserving")

    problem, touch = made()
    half, dt = (0.24, 0.04) if what == "pair" else (0.16, 0.02)
    whole = half + 2 * dt
    for _ in problem.steps(time=whole, dt=dt, output_at=[half]):
        if problem.history.time == half:
            problem.save(mpi_tmp_path / "half.ckpt")
            force = problem.reaction(touch)
    assert np.abs(force).max() > 0.0
    other, again = made()
    other.restore(mpi_tmp_path / "half.ckpt")
    assert np.abs(other.reaction(again) - force).max() <= 1e-14 * np.abs(force).max()
    other.solve(time=whole, dt=dt, output_at=[half])
    end = problem.momentum
    assert np.abs(other.momentum - end).max() < 1e-9
    same_run(outcome(other), outcome(problem), EXACT)
    assert abs(energies(other.history)[-1] - energies(problem.history)[-1]) < 1e-8


def test_a_run_that_is_interrupted_leaves_everything_as_it_was():
    problem, touch = colliding(0.3)
    for _ in problem.steps(time=0.2, dt=0.04):
        pass
    force = problem.reaction(touch)
    d = [body.displacement.x.array.copy() for body in problem.bodies]
    before = {k: c.values.copy() for k, c in touch.columns(0).items()}
    assert np.abs(force).max() > 0.0
    breaks(touch, lambda: problem.step(0.04))
    assert np.array_equal(force, problem.reaction(touch))
    for body, array in zip(problem.bodies, d, strict=True):
        assert np.array_equal(array, body.displacement.x.array)
    for key, column in touch.columns(0).items():
        assert np.array_equal(before[key], column.values), key
    other, again = colliding(0.3)
    problem.solve(time=0.24, dt=0.04)
    other.solve(time=0.24, dt=0.04)
    end = other.reaction(again)
    assert np.abs(problem.reaction(touch) - end).max() < 1e-9 * np.abs(end).max()


@pytest.mark.parametrize(
    ("scheme", "law", "passes"),
    [
        pytest.param("conserving", "penalty", 2, marks=pytest.mark.slow),
        pytest.param("midpoint", "penalty", 1, marks=pytest.mark.slow),
        pytest.param("euler", "penalty", 2, marks=pytest.mark.slow),
        ("euler", "nitsche", 2),
    ],
)
def test_an_equal_pair_put_in_during_an_impact_changes_nothing(scheme, law, passes):
    """Beside all that acts already, of which the bodies' inertia is not to act twice."""
    found = []
    for replaced in (False, True):
        problem, touch = colliding(0.2, scheme=scheme, law=law, passes=passes)
        problem.solver.setTolerances(rtol=1e-13)
        problem.solve(time=0.28, dt=0.04)
        if replaced:
            assert WORLD.allreduce(int(touch.sticks.sum())) > 2
            new = contact.Pair(*touch.bodies, 0.2, law=law, passes=passes)
            problem.stage(terms=[new if term is touch else term for term in problem.terms])
            problem.solver.setTolerances(rtol=1e-13)
        problem.solve(time=0.36, dt=0.04)
        places = [scenes.in_order(body, body.centroid) for body in problem.bodies]
        found.append((np.concatenate(places), problem.momentum))
    for one, two in zip(*found, strict=True):
        assert np.abs(one - two).max() < 1e-12 * np.abs(one).max()


def test_a_contact_of_a_motion_serves_equilibrium_again():
    # The force of a whole step is for motions alone.
    problem, ground = falling(contact.plane((0.0, 0.55), (0.0, 1.0)), scheme="midpoint")
    assert not ground.symmetric
    V = problem.particles.V
    top = fem.locate_dofs_geometrical(V, lambda x: x[1] > 1.0)
    motion = fem.Constant(V.mesh, np.array([0.0, -0.02]))
    still = posed(
        mpm.QuasiStaticProblem,
        problem.particles,
        Hencky(100.0, 0.3),
        bcs=[fem.dirichletbc(motion, top, V)],
        terms=[ground],
    )
    assert ground.symmetric
    still.solve(1)
    held = still.reaction(still.bcs[0])
    assert held[1] < 0.0
    assert np.abs(still.reaction(ground) + held).max() < 1e-7 * abs(held[1])


@pytest.mark.slow
@pytest.mark.parametrize("cell", [TETRAHEDRON, HEXAHEDRON], ids=scenes.name)
def test_cubes_collide_in_space(cell):
    mesh = box([-0.9] * 3, [1.8] * 3, [6] * 3, HEXAHEDRON)
    Va, Vb = (scenes.vectors(mesh) for _ in range(2))
    a = mpm.Particles(box([0.2, 0.25, 0.53], [0.7, 0.75, 1.0], [3, 3, 3], cell), Va)
    b = mpm.Particles(box([0.0] * 3, [0.8, 0.8, 0.5], [4, 4, 2], cell), Vb)
    touch = contact.Pair(a, b)
    problem = posed(
        mpm.DynamicProblem,
        [a, b],
        Hencky(100.0, 0.3),
        1.0,
        velocity=[(0.2, 0.0, -0.5), (0.0, 0.0, 0.0)],
        scheme="conserving",
        out_of_range="reflect",
        terms=[touch],
        **TIGHT,
    )
    momentum, turning = problem.momentum, problem.angular_momentum
    problem.solve(time=0.4, dt=0.04)
    assert np.abs(problem.momentum - momentum).max() < 1e-11
    assert np.abs(problem.angular_momentum - turning).max() < 1e-11
    assert account(problem.history) < 1e-9
    assert energies(problem.history).max() < 1.0 + 1e-9
    assert energies(problem.history).min() < 0.95
