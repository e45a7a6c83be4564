# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Rigid bodies that forces drive: they fall, spin, bounce, roll, and stand on what deforms."""

import numpy as np
import pytest
import scenes
from compare import EXACT, breaks, error_of_a_term, outcome, raises, same_run
from marks import slow, thinned
from posed import posed
from scenes import HEXAHEDRON, QUADRILATERAL, TETRAHEDRON, TRIANGLE, WORLD, box

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import contact
from mpm_dolfinx.materials import Hencky, LinearElastic, VonMises

TIGHT = {"petsc_options": {"snes_rtol": 1e-12}}
MASS, RADIUS = 0.3, 0.3
TURNING = 0.5 * MASS * RADIUS**2
YOUNG, POISSON = 100.0, 0.3
CONFINED = YOUNG * (1 - POISSON) / (1 + POISSON) / (1 - 2 * POISSON)


def thrown(shape="disc", friction=0.0, comm=WORLD, origin=0.0, law=None, **options):
    """Return a block that floats, and a body of mass, which spins, thrown at it."""

    def at(*x):
        return np.array(x) + origin

    V = scenes.vectors(box(at(-1.6, -1.3), at(2.6, 1.3), [14, 9], QUADRILATERAL, comm))
    particles = mpm.Particles(box(at(-0.3, -0.5), at(1.3, 0.5), [8, 5], TRIANGLE, comm), V)
    shapes = {
        "disc": contact.disc(at(0.4, 0.81), RADIUS),
        "box": contact.box(at(0.2, 0.51), at(0.6, 0.9), 0.1),
    }
    ball = contact.RigidBody(
        particles,
        shapes[shape],
        MASS,
        inertia=TURNING,
        centre=at(0.37, 0.78),
        friction=friction,
        velocity=(0.3, -1.0),
        spin=2.0,
    )
    problem = posed(
        mpm.DynamicProblem,
        particles,
        Hencky(YOUNG, POISSON) if law is None else law,
        1.0,
        terms=[ball],
        **{"scheme": "conserving", "out_of_range": "reflect", **TIGHT, **options},
    )
    return problem, ball


def energy(problem, ball):
    """Return all energy that there is now, and what friction has taken."""
    e = problem.history.energies[-1]
    ours = ball.kinetic_energy + ball.potential_energy + ball.contact_energy
    return e.kinetic + e.strain + ours + e.damping


@pytest.mark.parametrize(
    ("shape", "friction"), thinned(2, [("disc", 0.0), ("box", 0.0), ("box", 0.4)])
)
def test_an_impact_keeps_energy_momentum_and_angular_momentum(shape, friction):
    problem, ball = thrown(shape, friction)
    momentum = problem.momentum + ball.momentum
    turning = problem.angular_momentum + ball.angular_momentum
    whole, pushed, before = ball.kinetic_energy, 0, ball.momentum
    for _ in problem.steps(time=0.28, dt=0.02):
        assert energy(problem, ball) == pytest.approx(whole, rel=1e-10)
        assert np.abs(problem.momentum + ball.momentum - momentum).max() < 1e-12
        assert np.abs(problem.angular_momentum + ball.angular_momentum - turning).max() < 1e-12
        force = problem.reaction(ball)
        assert np.abs(ball.momentum - before + 0.02 * force).max() < 1e-12
        before, pushed = ball.momentum, pushed + bool(force[1] < 0.0)
    assert pushed > 6 and not force.any()
    assert ball.velocity[1] > 0.2 and problem.momentum[1] < -0.3 * MASS
    assert abs(ball.spin[0] - 2.0) > (0.1 if shape == "box" else 1e-6)
    account = problem.history.energies
    assert np.ptp([e.balance for e in account]) < 1e-12
    assert account[-1].damping > 1e-2 * whole if friction else account[-1].damping == 0.0
    assert np.mean(problem.history.iterations) < 5.0 and problem.history.cutbacks == 0


@pytest.mark.parametrize("strength", [4.0, *slow(50.0)])
def test_an_impact_on_metal_takes_what_yielding_takes(strength):
    # The work of a radial return, found from the plastic strains: nothing is won or lost besides,
    # neither where metal yields nor where it is struck too softly for that.
    law = VonMises(YOUNG, POISSON, yield_stress=strength, hardening=10.0)
    problem, ball = thrown("box", law=law)
    volumes, whole, taken = problem.points[0].strain.weights.ravel(), ball.kinetic_energy, 0.0
    for _ in problem.steps(time=0.28, dt=0.02):
        kappa = problem.points[0].last.plastic_strain().ravel()
        taken = WORLD.allreduce(float(volumes @ ((strength + 5.0 * kappa) * kappa)))
        assert energy(problem, ball) + taken == pytest.approx(whole, rel=1e-10)
    assert taken > 0.05 * whole if strength < 10.0 else taken == 0.0
    assert problem.history.energies[-1].dissipated == pytest.approx(taken, abs=1e-10 * whole)
    assert np.mean(problem.history.iterations) < 5.0 and problem.history.cutbacks == 0


@pytest.mark.parametrize("shape", [*slow("disc"), "box"])
def test_an_impact_at_the_coordinates_of_a_map_takes_the_same_steps(shape):
    found = []
    for origin in (0.0, 4e6):
        problem, ball = thrown(shape, 0.4, origin=origin, petsc_options={"snes_rtol": 1e-8})
        problem.solve(time=0.16, dt=0.02)
        assert problem.history.cutbacks == 0
        found.append(np.concatenate([ball.offset, ball.velocity]))
    # (points touch at a gap of 1e-12 of the coordinates)
    assert np.abs(found[1] - found[0]).max() < 0.01 * np.abs(found[0]).max()


def test_a_body_falls_and_spins_as_nothing_touches_it():
    particles = mpm.Particles(
        box([0.0] * 3, [1.0] * 3, [1] * 3, TETRAHEDRON),
        scenes.vectors(box([-0.1] * 3, [1.1] * 3, [1] * 3, HEXAHEDRON)),
    )
    J = np.diag([1.0, 2.0, 3.0])
    start = np.array([0.3, 2.0, 0.2])  # near to the axis about which it cannot spin for long
    found, end = [], 1.6
    for dt in (0.16, 0.08):
        stone = contact.RigidBody(
            particles,
            contact.box((3.0, 3.0, 3.0), (4.0, 4.5, 5.0), 0.1),
            2.0,
            inertia=J,
            gravity=(0.0, 1.0, -10.0),
            velocity=(1.0, 0.0, 2.0),
            spin=start,
        )
        problem = mpm.DynamicProblem(
            mpm.Body(particles, Hencky(1e3, 0.3), density=1.0), terms=[stone]
        )
        momentum, kinetic = J @ start, 0.5 * start @ J @ start
        for _ in problem.steps(time=end, dt=dt):
            t = problem.history.time
            place = t * np.array([1.0, 0.0, 2.0]) + 0.5 * t**2 * np.array([0.0, 1.0, -10.0])
            assert np.abs(stone.offset - place).max() < 1e-12 * (1.0 + 5.0 * t**2)
            v = stone.velocity
            assert stone.kinetic_energy - v @ v == pytest.approx(kinetic, rel=1e-12)
            turning = stone.angular_momentum - np.cross(stone.centre, stone.momentum)
            assert np.abs(turning - momentum).max() < 1e-11
        found.append(stone.placed().distance)
        angle = stone.angle
    # Euler's equations by Runge and Kutta.
    w, Q, n = start.copy(), np.eye(3), 160
    h = end / n

    def rates(w, Q):
        W = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
        return np.linalg.solve(J, np.cross(J @ w, w)), Q @ W

    for _ in range(n):
        k = [rates(w, Q)]
        for c in (0.5, 0.5, 1.0):
            k.append(rates(w + c * h * k[-1][0], Q + c * h * k[-1][1]))
        w, Q = (
            y + h / 6.0 * (k[0][i] + 2 * k[1][i] + 2 * k[2][i] + k[3][i])
            for i, y in enumerate((w, Q))
        )
    centre = np.array([3.5, 3.75, 4.0])
    marks = np.array([[0.5, 0.0, 0.0], [0.0, 0.75, 0.0], [0.0, 0.0, 1.0]])
    at = centre + stone.offset + marks @ Q.T
    errors = [np.abs(distance(at)).max() for distance in found]
    assert np.linalg.norm(angle) > 0.5
    assert errors[1] < 0.3 * errors[0] and errors[1] < 0.02


@pytest.mark.parametrize("share", [None, 0.5, 1.0], ids=["still", "midpoint", "euler"])
@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.parametrize("dim", [2, 3])
def test_tangent_is_the_derivative_of_the_forces(dim, friction, share):
    if dim == 2:
        bodies = [box([-0.3, -0.5], [0.3, 0.5], [4, 5], TRIANGLE)]
        bodies += [box([0.35, -0.5], [1.0, 0.48], [5, 5], QUADRILATERAL)]
        grid = box([-1.6, -1.3], [2.6, 1.3], [14, 9], QUADRILATERAL)
        shape = contact.box((0.0, 0.505), (0.8, 0.9), 0.1)
        motion = {"velocity": (0.3, -1.0), "spin": 0.7, "inertia": 0.02}
        wide, depth = 1.0, (0.0, 0.03)
    else:
        bodies = [box([0.0] * 3, [1.0, 1.0, 0.5], [3, 3, 2], TETRAHEDRON)]
        grid = box([-0.2] * 3, [1.3] * 3, [5] * 3, HEXAHEDRON)
        shape = contact.box((0.2, 0.1, 0.505), (0.9, 0.7, 1.0), 0.1)
        motion = {"velocity": (0.3, 0.1, -1.0), "spin": (0.7, 0.2, -0.4)}
        motion["inertia"] = [[0.02, 0.001, 0.0], [0.001, 0.03, 0.002], [0.0, 0.002, 0.04]]
        wide, depth = 0.7, (0.0, 0.0, 0.03)
    particles = [mpm.Particles(body, scenes.vectors(grid)) for body in bodies]
    stone = contact.RigidBody(
        particles,
        shape,
        MASS,
        friction=friction,
        centre=[*[0.5, 0.4][: dim - 1], 0.7],
        **motion,
    )
    material = Hencky(YOUNG, POISSON)
    kind = mpm.QuasiStaticProblem if share is None else mpm.DynamicProblem
    kind([mpm.Body(p, material, density=1.0) for p in particles], terms=[stone])
    start = [body.displacement.x.array.copy() for body in particles]
    for d in start:
        d.reshape(-1, dim)[:] += depth
    if share is not None:
        stone.pace(0.02, share)
    held = 1.0 if friction or share is not None else 0.0  # (friction alone bears what is along)
    turn = [0.1] if dim == 2 else [0.05, 0.1, 0.02 * held]
    stone.push([0.05 * held] * (dim - 1) + [-40.0 * 0.03 * wide], turn)
    stone.begin()
    assert error_of_a_term(stone, particles, start) < 1e-6
    moved = stone.residuals()
    assert scenes.largest(np.concatenate([f.array_r for f in moved])) > 0.0


@pytest.mark.parametrize(
    ("n", "dt", "scheme"),
    [(26, 0.02, "euler"), pytest.param(52, 0.01, "midpoint", marks=pytest.mark.slow)],
)
def test_a_disc_rolls_down_an_incline_with_two_thirds_of_the_acceleration(n, dt, scheme):
    # A stiff slab, and gravity that is inclined.
    V = scenes.vectors(box([-0.7, -0.5], [2.3, 0.3], [15, 4], QUADRILATERAL))
    particles = mpm.Particles(box([-0.5, -0.3], [2.1, 0.0], [n, n // 9], QUADRILATERAL), V)
    radius, slope = 0.5, np.radians(20.0)
    gravity = 10.0 * np.array([np.sin(slope), -np.cos(slope)])
    wheel = contact.RigidBody(
        particles,
        contact.disc((0.0, radius), radius),
        100.0,
        inertia=0.5 * 100.0 * radius**2,
        friction=0.5,
        gravity=gravity,
    )
    problem = mpm.DynamicProblem(
        mpm.Body(particles, Hencky(1e6, 0.3), density=1000.0),
        scheme=scheme,
        bcs=[scenes.below(V, -0.29)],
        rayleigh=(0.0, 1e-3),
        terms=[wheel],
    )
    times, speeds, spins = [], [], []
    for _ in problem.steps(time=0.5, dt=dt):
        times.append(problem.history.time)
        speeds.append(wheel.velocity[0])
        spins.append(wheel.spin[0])
    first = len(times) // 4
    found = np.polyfit(times[first:], speeds[first:], 1)[0]
    assert found == pytest.approx(2 / 3 * gravity[0], rel=5e-3)
    assert -radius * spins[-1] == pytest.approx(speeds[-1], rel=5e-3)
    assert problem.history.cutbacks == 0


def footing(comm=WORLD, cell=QUADRILATERAL, fixed=(), **options):
    """Return an elastic block on a base, and a footing that covers its top."""
    V = scenes.vectors(box([-0.3, -0.2], [1.3, 1.2], [8, 7], QUADRILATERAL, comm))
    particles = mpm.Particles(box([0.0, 0.0], [1.0, 1.0], [9, 9], cell, comm), V)
    shape = contact.box((-0.4, 1.0), (1.4, 1.4), 0.05)
    plate = contact.RigidBody(particles, shape, centre=(0.5, 1.0), fixed=fixed, **options)
    problem = posed(
        mpm.QuasiStaticProblem,
        particles,
        Hencky(YOUNG, POISSON),
        bcs=[scenes.below(V, 0.01)],
        terms=[plate],
        **TIGHT,
    )
    return problem, plate


def test_a_footing_tilts_under_a_force_off_its_centre():
    problem, plate = footing(friction=0.5)
    problem.solve(3, update=lambda t: plate.push((0.3 * t, -8.0 * t), -0.6 * t))
    assert np.abs(problem.reaction(plate) - (0.3, -8.0)).max() < 1e-9
    assert plate.contacts[0].moment(plate.centre) == pytest.approx(-0.6, abs=1e-9)
    assert -0.2 < plate.angle[0] < -0.005 and plate.offset[1] < -0.05
    assert problem.history.cutbacks == 0 and np.mean(problem.history.iterations) < 7.0
    # An obstacle on the same way, and held but for its rotation: the same forces.
    same, other = footing(friction=0.5, fixed=("x", "y", "rotation"))
    way = [(0.0, np.zeros(2), np.zeros(1))]
    again, last = footing(friction=0.5)
    for _ in again.steps(3, update=lambda t: last.push((0.3 * t, -8.0 * t), -0.6 * t)):
        way.append((len(way) / 3.0, last.offset, last.angle))

    def path(t):
        place = next(p for p in way if abs(p[0] - t) < 1e-9)
        other.move(place[1], place[2])

    same.solve(3, update=path)
    assert np.abs(same.reaction(other) - (0.3, -8.0)).max() < 1e-7
    assert other.contacts[0].moment(other.centre) == pytest.approx(-0.6, abs=1e-7)
    same_run(outcome(same), outcome(problem), 1e-7)


def test_a_plate_settles_as_a_column_is_compressed():
    V = scenes.vectors(box([-0.2, -0.2], [1.2, 1.2], [7, 7], QUADRILATERAL))
    particles = mpm.Particles(box([0.0, 0.0], [1.0, 1.0], [6, 6], QUADRILATERAL), V)
    plate = contact.RigidBody(particles, contact.box((-0.2, 1.0), (1.2, 1.5)), 2.0, gravity=(0, -9))
    sides = [
        fem.dirichletbc(np.zeros(()), dofs[0], V.sub(0))
        for dofs in [
            fem.locate_dofs_geometrical((V.sub(0), V.sub(0).collapse()[0]), lambda x: x[1] < 9.0)
        ]
    ]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, LinearElastic(1e4, POISSON)),
        bcs=[*sides, scenes.below(V, 0.01)],
        terms=[plate],
    )
    problem.solve(1, update=lambda t: plate.push((0.0, -82.0)))
    # (the last row of domains is as soft once more: the penalty is 1)
    modulus = CONFINED / YOUNG * 1e4
    assert plate.offset[1] == pytest.approx(-100.0 / modulus * (1.0 + 1 / 6), rel=1e-3)
    assert abs(plate.angle[0]) < 1e-9 and abs(plate.offset[0]) < 1e-9
    assert plate.contacts[0].pressure[plate.contacts[0].touches] == pytest.approx(100.0, rel=1e-6)


def test_what_nothing_holds_is_told():
    problem, plate = footing()

    def lifted(t):
        plate.push((0.0, 1.0))

    with pytest.raises(mpm.MPMError, match="Nothing holds a RigidBody"):
        problem.solve(1, update=lifted)
    assert not plate.offset.any()


def test_it_touches_several_bodies_and_goes_with_splitting_and_plasticity():
    # Hit by a tool, two bodies on fields of their own; some domains are split on the way.
    grid = box([-0.8, -0.6], [1.8, 1.0], [10, 6], QUADRILATERAL)
    halves = [box([a, 0.0], [a + 0.5, 0.5], [4, 4], QUADRILATERAL) for a in (0.0, 0.5)]
    bodies = [mpm.Particles(half, scenes.vectors(grid)) for half in halves]
    tool = contact.RigidBody(
        bodies,
        contact.disc((0.45, 0.71), 0.2),
        0.2,
        inertia=0.004,
        friction=0.3,
        velocity=(0.1, -2.0),
        spin=1.0,
    )
    problem = posed(
        mpm.DynamicProblem,
        bodies,
        [VonMises(YOUNG, POISSON, 2.0), Hencky(YOUNG, POISSON)],
        [1.0, 1.5],
        scheme="conserving",
        terms=[tool],
        **TIGHT,
    )
    momentum = problem.momentum + tool.momentum
    for _ in problem.steps(time=0.2, dt=0.02):
        assert np.abs(problem.momentum + tool.momentum - momentum).max() < 1e-12
        if problem.history.time == pytest.approx(0.1):
            problem.split(np.arange(0, bodies[0].num_global, 2))
    assert [bool(np.abs(c.reaction).max() >= 0.0) for c in tool.contacts] == [True, True]
    assert tool.velocity[1] > -1.2


def test_a_checkpoint_in_an_impact_goes_on_as_the_run_does(mpi_tmp_path):
    problem, ball = thrown("box", 0.3)
    for _ in problem.steps(time=0.12, dt=0.02, output_at=[0.06]):
        if problem.history.time == 0.06:
            problem.save(mpi_tmp_path / "half.ckpt")
            force = problem.reaction(ball)
    assert np.abs(force).max() > 0.0
    other, again = thrown("box", 0.3)
    other.restore(mpi_tmp_path / "half.ckpt")
    assert np.abs(other.reaction(again) - force).max() <= 1e-14 * np.abs(force).max()
    other.solve(time=0.12, dt=0.02, output_at=[0.06])
    for name in ("offset", "angle", "velocity", "spin", "reaction"):
        assert np.abs(getattr(again, name) - getattr(ball, name)).max() < 1e-9, name
    same_run(outcome(other), outcome(problem), EXACT)


@pytest.mark.parametrize("scheme", ["midpoint", "euler"])
def test_what_follows_a_path_has_its_velocity_from_the_first_step_on(scheme):
    V = scenes.vectors(box([-1.0, -1.0], [2.0, 2.0], [4, 4], QUADRILATERAL))
    particles = mpm.Particles(box([0.0, 0.0], [1.0, 1.0], [3, 3], QUADRILATERAL), V)
    disc = contact.disc((0.5, 1.7), RADIUS)
    tool = contact.RigidBody(
        particles, disc, MASS, inertia=TURNING, fixed=("x", "rotation"), velocity=(0.0, 0.3)
    )
    problem = mpm.DynamicProblem(
        mpm.Body(particles, Hencky(YOUNG, POISSON), density=1.0), terms=[tool], scheme=scheme
    )
    for _ in problem.steps(time=0.1, dt=0.02, update=lambda t: tool.move((0.5 * t, 0.0), 0.1 * t)):
        assert np.abs(tool.velocity - (0.5, 0.3)).max() < 1e-12
        assert tool.spin[0] == pytest.approx(0.1, rel=1e-9)


def test_what_turns_on_a_path_turns_by_less_than_half_a_turn_in_a_step():
    particles = mpm.Particles(
        box([0.0, 0.0], [1.0, 1.0], [2, 2], QUADRILATERAL),
        scenes.vectors(box([-1.0, -1.0], [2.0, 2.0], [4, 4], QUADRILATERAL)),
    )
    tool = contact.RigidBody(particles, contact.disc((5.0, 0.5), 0.3), MASS, fixed="rotation")
    problem = mpm.DynamicProblem(
        mpm.Body(particles, Hencky(YOUNG, POISSON), density=1.0), terms=[tool]
    )
    tool.move((0.0, 0.0), 4.0)
    raises(lambda: problem.step(0.1), mpm.ConvergenceError, "half a turn or more in one step")
    assert tool.angle[0] == 0.0
    problem.solve(time=0.4, dt=0.1, update=lambda t: tool.move((0.0, 0.0), 20.0 * t))
    assert tool.angle[0] == pytest.approx(8.0, rel=1e-12)


def test_a_step_that_fails_leaves_it_where_it_was():
    problem, ball = thrown("box", 0.3)
    problem.solve(time=0.06, dt=0.02)
    names = ("offset", "angle", "velocity", "spin", "reaction", "kinetic_energy")
    before = {name: getattr(ball, name) for name in names}
    breaks(ball, lambda: problem.step(0.02))
    for name, value in before.items():
        assert np.array_equal(getattr(ball, name), value), name
    other, again = thrown("box", 0.3)
    problem.solve(time=0.1, dt=0.02)
    other.solve(time=0.1, dt=0.02)
    assert np.abs(ball.velocity - again.velocity).max() < 1e-10


@pytest.mark.mpi
def test_it_is_the_same_on_any_number_of_ranks():
    problem, ball = thrown("box", 0.3)
    other, alone = thrown("box", 0.3, comm=scenes.MPI.COMM_SELF)
    problem.solve(time=0.06, dt=0.02)
    problem.repartition()
    problem.solve(time=0.12, dt=0.02)
    other.solve(time=0.12, dt=0.02)
    for name in ("offset", "angle", "velocity", "spin", "reaction"):
        one, two = getattr(ball, name), getattr(alone, name)
        assert np.abs(one - two).max() < 1e-9 * max(1.0, np.abs(two).max()), name
    same_run(outcome(problem), outcome(other), 1e-9)


def test_a_drop_weight_on_a_column_of_revolution():
    V = scenes.vectors(box([0.0, -0.2], [0.8, 0.8], [4, 5], QUADRILATERAL))
    particles = mpm.Particles(box([0.0, 0.0], [0.4, 0.5], [5, 6], QUADRILATERAL), V)
    axis = fem.locate_dofs_geometrical(
        (V.sub(0), V.sub(0).collapse()[0]), lambda x: np.isclose(x[0], 0.0)
    )
    weight = contact.RigidBody(
        particles,
        contact.plane((0.0, 0.51), (0.0, -1.0)),
        0.5,
        velocity=(0.0, -1.0),
        axisymmetric=True,
    )
    problem = posed(
        mpm.DynamicProblem,
        particles,
        Hencky(YOUNG, POISSON),
        1.0,
        scheme="conserving",
        axisymmetric=True,
        bcs=[fem.dirichletbc(np.zeros(()), axis[0], V.sub(0))],
        terms=[weight],
        out_of_range="reflect",
        **TIGHT,
    )
    whole, before = weight.kinetic_energy, weight.momentum
    for _ in problem.steps(time=0.2, dt=0.02):
        assert energy(problem, weight) == pytest.approx(whole, rel=1e-10)
        force = problem.reaction(weight)[1]
        assert weight.momentum[1] - before[1] == pytest.approx(-0.02 * force, abs=1e-13)
        assert weight.angle[0] == weight.offset[0] == 0.0
        before = weight.momentum
    assert weight.velocity[1] > -0.7


@pytest.mark.slow
def test_a_ball_rolls_down_an_incline_with_five_sevenths_of_the_acceleration():
    V = scenes.vectors(box([-0.6, -0.6, -0.4], [1.2, 0.6, 0.2], [9, 6, 3], HEXAHEDRON))
    particles = mpm.Particles(
        box([-0.4, -0.3, -0.2], [1.0, 0.3, 0.0], [28, 12, 2], HEXAHEDRON), V, quadrature_degree=2
    )
    radius, slope = 0.5, np.radians(20.0)
    gravity = 10.0 * np.array([np.sin(slope), 0.0, -np.cos(slope)])
    ball = contact.RigidBody(
        particles,
        contact.sphere((0.0, 0.0, radius), radius),
        100.0,
        inertia=0.4 * 100.0 * radius**2,
        friction=0.5,
        gravity=gravity,
    )
    problem = mpm.DynamicProblem(
        mpm.Body(particles, Hencky(1e6, 0.3), density=1000.0),
        scheme="euler",
        bcs=[scenes.below(V, -0.19)],
        terms=[ball],
    )
    times, speeds = [], []
    for _ in problem.steps(time=0.5, dt=0.01):
        times.append(problem.history.time)
        speeds.append(ball.velocity[0])
    found = np.polyfit(times[15:], speeds[15:], 1)[0]
    assert found == pytest.approx(5 / 7 * gravity[0], rel=0.01)
    assert radius * ball.spin[1] == pytest.approx(speeds[-1], rel=0.02)
    assert np.abs(ball.spin[[0, 2]]).max() < 0.02 * ball.spin[1]


def test_what_makes_no_sense_is_refused():
    particles = thrown()[0].particles
    disc = contact.disc((0.4, 0.81), RADIUS)

    def made(*args, **options):
        return lambda: contact.RigidBody(particles, disc, *args, **options)

    for build, sentence in (
        (made(-1.0), "mass must be a positive number"),
        (made(1.0, inertia=-1.0), "must be positive"),
        (made(1.0, inertia=np.eye(3)), "inertia of a RigidBody must be a number"),
        (made(gravity=(0.0, -9.81)), "needs its mass="),
        (made(1.0, inertia=True), "inertia of a RigidBody must be a number"),
        (made(1.0, fixed=("z",)), "names among 'x', 'y', 'rotation'"),
        (made(1.0, fixed=2), "names among 'x', 'y', 'rotation', not 2"),
        (lambda: made(1.0)().contact_energy, "belongs to no problem yet"),
        (made(1.0, spin=(1.0, 2.0, 3.0)), "spin of a RigidBody must be a finite number"),
        (made(1.0, centre=(0.0, np.inf)), "centre must be 2 finite numbers"),
        (made(1.0, law="nitsche"), "law='nitsche' is for a Rigid that moves on a path"),
        (lambda: contact.RigidBody([], disc), "needs one body"),
        (lambda: contact.RigidBody([particles, particles], disc), "not the same one twice"),
        (lambda: contact.RigidBody("it", disc), "needs mpm.Particles"),
        (lambda: made(1.0)().push((1.0,)), "force must be 2 finite numbers"),
        (lambda: made(1.0)().contacts[0].move((1.0, 0.0)), r"use move\(\) of the RigidBody"),
    ):
        raises(build, mpm.MPMError, sentence)
    for options, sentence in (
        ({}, "needs its mass="),
        ({"mass": 1.0}, "needs its inertia="),
    ):
        term = contact.RigidBody(particles, disc, **options)
        raises(
            lambda term=term: mpm.DynamicProblem(
                mpm.Body(particles, Hencky(1e3, 0.3), density=1.0), terms=[term]
            ),
            mpm.MPMError,
            sentence,
        )


def test_an_error_in_any_one_call_of_a_shape_ends_the_step():
    # A RigidBody looks for its balance from several starts, and no error is one of a start.
    last = WORLD.size - 1
    plate_shape = contact.box((-0.4, 1.0), (1.4, 1.4), 0.05)

    def settle(number=0):
        def distance(y):
            calls.append(len(y))
            if len(calls) == number and WORLD.rank == last:
                raise ZeroDivisionError("no distance")
            return plate_shape.distance(y)[0]

        calls = []
        V = scenes.vectors(box([-0.3, -0.2], [1.3, 1.2], [8, 7], QUADRILATERAL))
        particles = mpm.Particles(box([0.0, 0.0], [1.0, 1.0], [4, 4], QUADRILATERAL), V)
        shape = contact.signed_distance(distance, (0.5, 1.2))
        plate = contact.RigidBody(particles, shape, centre=(0.5, 1.0), fixed=("rotation",))
        law = Hencky(YOUNG, POISSON)
        problem = mpm.QuasiStaticProblem(
            mpm.Body(particles, law), bcs=[scenes.below(V, 0.01)], terms=[plate]
        )
        begun = len(calls)
        problem.solve(1, update=lambda t: plate.push((0.0, -8.0 * t), 0.0))
        return begun, len(calls)

    begun, done = WORLD.bcast(settle(), last)
    for number in range(begun + 1, done + 1, (done - begun) // 12):
        raises(lambda: settle(number), mpm.MPMError, "ZeroDivisionError: no distance")
