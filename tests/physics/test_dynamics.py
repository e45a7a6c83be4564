# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Motion: momentum, energy and order, against exact solutions; splits, ranks and restarts."""

import warnings
from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
from compare import EXACT, raises
from marks import all_but, slow, thinned
from obstacles import wall
from posed import posed
from routes import ROUTES, on_route
from scenes import (
    HEXAHEDRON,
    QUADRILATERAL,
    TRIANGLE,
    WORLD,
    anywhere,
    at,
    box,
    facet_tags,
    fix,
    in_order,
    largest,
    vectors,
)

import basix.ufl
import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.boundary import dashpot, fixed
from mpm_dolfinx.errors import ConvergenceError
from mpm_dolfinx.materials import Hencky, LinearElastic, VonMises
from mpm_dolfinx.meshes.redistribution import Redistribution
from mpm_dolfinx.system.inertia import Inertia
from mpm_dolfinx.system.term import Term

SCHEMES = [
    ("midpoint", "project"),
    ("midpoint", "reflect"),
    ("conserving", "project"),
    ("conserving", "reflect"),
    ("euler", "project"),
]
ON_DEGREES = [(degree, *scheme) for degree in (1, 2) for scheme in SCHEMES]


def plate(comm=WORLD, degree=1):
    """Return the space on a background of 4 x 4."""
    return vectors(box([0.0, 0.0], [4.0, 4.0], [16, 16], QUADRILATERAL, comm), degree)


def square(cell=QUADRILATERAL, corner=(1.23, 1.51), V=None, degree=1, comm=WORLD, **options):
    """Return a unit square on a background of 4 x 4."""
    body = box(list(corner), [c + 1.0 for c in corner], [8, 8], cell, comm)
    V = plate(comm, degree) if V is None else V
    return mpm.Particles(body, V, degree=degree, **options)


def spin(x):
    """Return a rotation about (1.73, 2.01) at one radian in a unit of time."""
    return np.stack([-(x[1] - 2.01), x[0] - 1.73])


def spinning(particles=None, material=None, velocity=spin, **options):
    """Return a problem of a square that spins."""
    particles = square() if particles is None else particles
    law = Hencky(100.0, 0.3) if material is None else material
    options = {"petsc_options": {"snes_rtol": 1e-12}, **options}
    return posed(mpm.DynamicProblem, particles, law, 2.0, velocity=velocity, **options)


def change_of_balance(history):
    """Return the largest change of what the account must keep, relative to the kinetic energy."""
    balances = np.array([energy.balance for energy in history.energies])
    return np.abs(balances - balances[0]).max() / history.energies[0].kinetic


def change_of_balance_of(history, size):
    """Return the largest change of what the account must keep, relative to an energy."""
    balances = np.array([energy.balance for energy in history.energies])
    return np.abs(balances - balances[0]).max() / size


def nodal(function):
    return function.x.array.reshape(-1, function.function_space.dofmap.bs)


# -- Free bodies, exactly -----------------------------------------------------------------------


@pytest.mark.parametrize(("degree", "scheme", "out"), thinned(3, ON_DEGREES))
def test_a_free_body_flies_on(scheme, out, degree):
    problem = spinning(
        square(degree=degree),
        velocity=(0.3, -0.2),
        scheme=scheme,
        out_of_range=out,
        petsc_options={},
    )
    momentum, turning, energy = problem.momentum, problem.angular_momentum, problem.kinetic_energy
    np.testing.assert_allclose(momentum, [0.6, -0.4], rtol=1e-13)
    np.testing.assert_allclose(turning, 1.73 * -0.4 - 2.01 * 0.6, rtol=1e-13)
    history = problem.solve(time=1.0, dt=0.1)
    most = 0 if out == "project" and scheme != "euler" and degree == 1 else 1
    assert all(step.iterations <= most for step in history.steps)
    moved = nodal(problem.particles.displacement) - [0.3, -0.2]
    assert largest(moved) < 1e-10
    np.testing.assert_allclose(problem.momentum, momentum, atol=1e-11)
    np.testing.assert_allclose(problem.angular_momentum, turning, atol=1e-10)
    assert problem.kinetic_energy == pytest.approx(energy, rel=1e-9)


@pytest.mark.parametrize(("degree", "scheme", "out"), thinned(3, ON_DEGREES))
def test_dust_that_spins_flies_apart_in_straight_lines(scheme, out, degree):
    # Without stress each node keeps its velocity: x + t v(x), a motion in the range of T.
    dust = LinearElastic(1e-14, 0.3)
    problem = spinning(
        square(degree=degree), dust, scheme=scheme, out_of_range=out, stabilisation=None
    )
    velocity = nodal(problem.velocity).copy()
    momentum, turning, energy = problem.momentum, problem.angular_momentum, problem.kinetic_energy
    problem.solve(time=0.7, dt=0.1)
    assert largest(nodal(problem.particles.displacement) - 0.7 * velocity) < 1e-10
    np.testing.assert_allclose(problem.momentum, momentum, atol=1e-11)
    np.testing.assert_allclose(problem.angular_momentum, turning, atol=1e-11)
    assert problem.kinetic_energy == pytest.approx(energy, rel=1e-11)


@pytest.mark.parametrize("cell", [TRIANGLE, QUADRILATERAL])
def test_a_body_falls_on_a_parabola(cell):
    problem = spinning(square(cell), velocity=(0.1, 0.4), body_force=(0.0, -1.0))
    history = problem.solve(time=1.0, dt=0.13)  # the steps are 1/8
    assert [step.time for step in history.steps] == [k / 8 for k in range(1, 9)]
    for energy in history.energies:
        t = energy.time
        assert energy.kinetic == pytest.approx(0.1**2 + (0.4 - t) ** 2, abs=1e-11)
        assert energy.external == pytest.approx(-2.0 * (0.4 * t - 0.5 * t**2), abs=1e-11)
    assert largest(nodal(problem.particles.displacement) - [0.1, -0.1]) < 1e-11
    np.testing.assert_allclose(problem.momentum, [0.2, -1.2], atol=1e-11)


def test_a_load_in_time_gives_the_momentum_of_its_trapezium():
    particles = square()
    force = fem.Constant(particles.mesh, (0.0, 0.0))
    problem = spinning(particles, velocity=None, body_force=force)

    def update(t):
        force.value = (3.0 * t**2, 1.0)

    problem.solve(time=1.0, dt=0.25, update=update)
    mean = np.mean([3.0 * (a**2 + (a + 0.25) ** 2) / 2 for a in (0.0, 0.25, 0.5, 0.75)])
    np.testing.assert_allclose(problem.momentum, [2.0 * mean, 2.0], rtol=1e-11)
    force.value = (0.0, -1.0)
    problem.step(0.5)  # what is set acts all through it
    np.testing.assert_allclose(problem.momentum, [2.0 * mean, 1.0], rtol=1e-11)


# -- Energy, order --------------------------------------------------------------------------------


@pytest.mark.parametrize(("scheme", "out"), thinned(5, SCHEMES))
def test_a_spinning_body_keeps_momentum_and_its_account(scheme, out):
    problem = spinning(scheme=scheme, out_of_range=out)
    momentum, turning = problem.momentum, problem.angular_momentum
    history = problem.solve(time=2.0, dt=0.05)
    np.testing.assert_allclose(problem.momentum, momentum, atol=1e-11)
    if scheme != "euler":  # midpoint: to second order; the spin of the whole run is two radians
        rtol = 1e-3 if scheme == "midpoint" else 1e-10
        np.testing.assert_allclose(problem.angular_momentum, turning, rtol=rtol)
    assert change_of_balance(history) < 1e-12
    lost = np.array([energy.lost for energy in history.energies])
    assert np.diff(lost).min() >= -1e-12 * history.energies[0].kinetic
    assert (lost[-1] == 0.0) == (out == "reflect")
    end = history.energies[-1]
    assert end.strain > 1e-6  # the body is pulled by its spin
    assert end.internal == pytest.approx(end.strain + end.dissipated, rel=1e-9)
    if scheme == "conserving":
        assert abs(end.dissipated) < 1e-12 * end.kinetic


@pytest.mark.parametrize(
    ("law", "route", "cell", "f_bar"),
    [
        (Hencky(100.0, 0.49), "loops", QUADRILATERAL, "domain"),
        *thinned(
            3,
            [
                (Hencky(100.0, 0.49), "reference", QUADRILATERAL, "domain"),
                (Hencky(100.0, 0.49), "reference", TRIANGLE, "patch"),
                (Hencky(100.0, 0.49), "loops", TRIANGLE, "patch"),
            ],
        ),
        (VonMises(100.0, 0.49, rho_y=99.0), "loops", TRIANGLE, "patch"),
    ],
    indirect=["route"],
)
@pytest.mark.usefixtures("route")
def test_with_f_bar_an_elastic_body_keeps_its_energy(law, cell, f_bar):
    particles = square(cell, quadrature_degree=2 if f_bar == "domain" else None)
    problem = spinning(
        particles,
        law,
        lambda x: spin(x) + 0.3 * np.sin(4.0 * x[:2]),
        scheme="conserving",
        out_of_range="reflect",
        f_bar=f_bar,
    )
    turning = problem.angular_momentum
    history = problem.solve(time=0.4, dt=0.04)
    np.testing.assert_allclose(problem.angular_momentum, turning, rtol=1e-11)
    whole = np.array([e.kinetic + e.strain for e in history.energies])
    assert np.abs(whole / whole[0] - 1.0).max() < 1e-10
    assert history.energies[-1].strain > 0.01 * whole[0]
    assert change_of_balance(history) < 1e-12
    assert np.mean(history.iterations) <= 5.0 and history.cutbacks == 0


@pytest.mark.parametrize(
    ("scheme", "time"),
    [
        ("conserving", 0.6),
        pytest.param("conserving", 4.0, marks=pytest.mark.slow),
        pytest.param("midpoint", 4.0, marks=pytest.mark.slow),
    ],
)
def test_with_a_stabilised_pressure_no_energy_is_won(scheme, time):
    # What keeps the pressure from oscillating is of the cells, and stores other energies in others.
    def problem(out):
        return spinning(
            material=Hencky(100.0, 0.4999),
            velocity=lambda x: spin(x) + 0.3 * np.sin(4.0 * x[:2]),
            scheme=scheme,
            out_of_range=out,
            mixed="stabilised pressure",
        )

    with warnings.catch_warnings(record=True) as told:  # on the first rank
        warnings.simplefilter("always")
        problem("reflect")
    sentences = [str(each.message) for each in told if "may gain energy" in str(each.message)]
    assert len(sentences) == (WORLD.rank == 0)
    assert all("use out_of_range='project'" in one for one in sentences)
    moving = problem("project")
    momentum, turning = moving.momentum, moving.angular_momentum
    history = moving.solve(time=time, dt=0.05)
    np.testing.assert_allclose(moving.momentum, momentum, atol=1e-11)
    if scheme == "conserving":
        np.testing.assert_allclose(moving.angular_momentum, turning, rtol=1e-11)
    whole = np.array([energy.kinetic + energy.strain for energy in history.energies])
    assert whole.max() == whole[0] and whole[-1] > 0.8 * whole[0]
    assert change_of_balance(history) < 1e-12


@pytest.mark.parametrize("cell", [*slow(TRIANGLE), QUADRILATERAL])
def test_a_body_that_yields_keeps_its_angular_momentum(cell):
    # Bounds of the prototype: 1e-10, at most 5 solves in a step and no cutback.
    law = VonMises(100.0, 0.3, rho_y=0.2)
    problem = spinning(square(cell), law, scheme="conserving", petsc_options={})
    turning = problem.angular_momentum
    history = problem.solve(time=1.0, dt=0.04)
    assert problem.particles.plastic_strain.max() > 1e-4
    np.testing.assert_allclose(problem.angular_momentum, turning, rtol=1e-9)
    assert change_of_balance(history) < 1e-12
    assert history.cutbacks == 0 and np.mean(history.iterations) <= 5.0
    assert 1e-7 < history.energies[-1].dissipated < history.energies[-1].internal
    dissipated = np.array([energy.dissipated for energy in history.energies])
    assert np.diff(dissipated).min() > -1e-12 * history.energies[0].kinetic


def test_both_routes_conserve_alike():
    runs = []
    for route in ROUTES:
        with on_route(route):
            problem = thrown(scheme="conserving", rayleigh=(0.1, 0.01))
            problem.solve(time=0.2, dt=0.05)
        runs.append(run_of(problem))
    require_same(*runs, 1e-9)


@pytest.mark.parametrize(
    ("cell", "degree", "method"),
    [
        (QUADRILATERAL, 1, "cpdi2"),
        (TRIANGLE, 1, "cpdi2"),
        (QUADRILATERAL, 1, "gimp"),
        (QUADRILATERAL, 2, "cpdi2"),
        (TRIANGLE, 3, "cpdi2"),
        pytest.param(HEXAHEDRON, 1, "cpdi2", marks=pytest.mark.slow),
    ],
)
def test_masses_reduced_domain_by_domain_are_those_of_stock_forms(cell, degree, method, take):
    # A linear body takes one solve if its tangent is exact; that of the reference route is made of
    # sparse products.
    gdim = 3 if cell == HEXAHEDRON else 2
    lows, size = ((0.31, 1.17), 0.5) if degree == 1 else ((0.02, 1.22), 0.76)  # (no slivers)
    runs = []
    for route in ROUTES:
        take(route)
        V = vectors(box([0.0] * gdim, [2.0] * gdim, [5] * gdim, HEXAHEDRON if gdim == 3 else cell))
        if degree > 1:
            V = vectors(V.mesh, degree)
        bodies = [
            mpm.Particles(
                box([low] * gdim, [low + size] * gdim, [3] * gdim, cell),
                V,
                degree=degree,
                method=method,
            )
            for low in lows
        ]
        problem = posed(
            mpm.DynamicProblem,
            bodies,
            LinearElastic(10.0, 0.3),
            [1.0 + ufl.SpatialCoordinate(body.mesh)[0] for body in bodies],
            velocity=lambda x: np.stack([np.sin(7 * x[i] + i) for i in range(gdim)]),
            stabilisation=None,
        )
        problem.solve(time=0.02, dt=0.01)
        assert [step.iterations for step in problem.history.steps] == [1, 1]
        found = zip(bodies, problem.velocity, strict=True)
        runs.append([in_order(body, nodal(v)[body.domain_nodes]) for body, v in found])
    np.testing.assert_allclose(*runs, atol=1e-9)


@pytest.mark.slow
def test_sand_that_falls_apart_gives_back_no_more_than_it_has():
    # With the mean of the end stresses what is dissipated falls, by tens of joules.
    energies = sand_column("conserving").solve(time=0.6, dt=0.01).energies
    dissipated = np.array([energy.dissipated for energy in energies])
    assert np.diff(dissipated).min() > -1e-6 and 700.0 < dissipated[-1] < 1100.0
    assert np.ptp([energy.balance for energy in energies]) < 1e-10 * dissipated[-1]


@pytest.mark.skip_in_parallel
def test_stress_that_drives_a_motion_is_told():
    # The mean of the end stresses makes energy where sand opens and closes. The column had
    # 10 kJ to lose, of which it took 0.9 to fall; then it speeds up at rest.
    problem = sand_column("midpoint")
    with pytest.warns(UserWarning, match="more work on the bodies than they had stored") as told:
        energies = problem.solve(time=1.0, dt=0.02).energies
    dissipated = np.array([energy.dissipated for energy in energies])
    assert dissipated.max() < 1e3 and dissipated[-1] < -1e3
    assert energies[-1].kinetic > 5.0 * max(e.kinetic for e in energies[:26])
    assert len([w for w in told if "stored" in str(w.message)]) == 1


def sand_column(scheme):
    """Return a square column of sand on a floor of cells that are held."""
    V = vectors(box([0.0, -0.25], [4.0, 1.25], [16, 6], QUADRILATERAL))
    body = box([0.0, 0.0], [1.0, 1.0], [8, 8], TRIANGLE)
    sand = mpm.materials.MohrCoulomb(1e6, 0.3, 0.0, 30.0, 0.0, volume_correction=True)
    return mpm.DynamicProblem(
        mpm.Body(
            mpm.Particles(body, V, outside="delete"),
            sand,
            density=2000.0,
            body_force=(0.0, -10.0),
        ),
        bcs=[mpm.held(V, 0, x=0.0), mpm.held(V, y=(-0.25, 0.0))],
        scheme=scheme,
    )


@pytest.mark.parametrize("beta", [*slow(0.0), 0.03])
def test_rayleigh_damping_lets_a_mode_decay_as_it_must(beta):
    # The amplitude of a mode w falls by exp(-(alpha + beta w^2) t / 2).
    w, t = np.pi, 1.0
    alpha = 0.2 if beta == 0.0 else 0.0
    V = vectors(box([0.0, 0.0], [1.6, 3 / 16], [26, 3], QUADRILATERAL))
    body = box([0.3, 1 / 16], [1.3, 2 / 16], [32, 2], QUADRILATERAL)
    problem = mpm.DynamicProblem(
        mpm.Body(
            mpm.Particles(body, V),
            LinearElastic(1.0, 0.0),
            density=1.0,
            velocity=lambda x: np.stack([0.01 * np.cos(w * (x[0] - 0.3)), 0.0 * x[0]]),
        ),
        out_of_range="reflect",
        rayleigh=(alpha, beta),
    )
    history = problem.solve(time=t, dt=0.02)
    first, last = history.energies[0], history.energies[-1]
    assert change_of_balance(history) < 1e-12
    whole = last.kinetic + last.strain
    assert whole == pytest.approx(first.kinetic * np.exp(-(alpha + beta * w**2) * t), rel=0.02)
    assert last.damping == pytest.approx(first.kinetic - whole, rel=1e-3)


def test_damping_by_stiffness_resists_no_rotation():
    # Rigid spins, exact: the damping of a soft dust is that of its strain rates alone.
    problem = spinning(rayleigh=(0.0, 0.02), scheme="conserving")
    turning = problem.angular_momentum
    history = problem.solve(time=1.0, dt=0.05)
    np.testing.assert_allclose(problem.angular_momentum, turning, rtol=1e-10)
    assert 0.0 < history.energies[-1].damping < 2e-3 * history.energies[0].kinetic


def bounced(n, dt):
    """Return how far up a ball of n^3 hexahedra comes after its fall, over the fall's height."""
    h, q = 1.1 / n, np.linspace(-1.0, 1.0, n + 1)
    x, y, z = (a.ravel() for a in np.meshgrid(q, q, q, indexing="ij"))
    squares = [(x, y, z), (y, z, x), (z, x, y)]
    points = [a * np.sqrt(1 - b**2 / 2 - c**2 / 2 + b**2 * c**2 / 3) for a, b, c in squares]
    points = 0.25 * np.stack(points, axis=1) + [0.0, 0.0, 0.35]
    i = np.arange((n + 1) ** 3).reshape(n + 1, n + 1, n + 1)
    ends = [(a, b, c) for c in (0, 1) for b in (0, 1) for a in (0, 1)]
    corners = [i[a : n + a, b : n + b, c : n + c] for a, b, c in ends]
    cells = np.stack(corners, axis=-1).reshape(-1, 8).astype(np.int64)
    if WORLD.rank > 0:
        cells, points = cells[:0], points[:0]
    element = basix.ufl.element("Lagrange", "hexahedron", 1, shape=(3,))
    ball = mesh.create_mesh(WORLD, cells, element, points)
    low, count = np.array([-0.41, -0.4, -0.1]), np.ceil(np.array([0.8, 0.8, 1.0]) / h).astype(int)
    V = vectors(box(list(low), list(low + h * count), count.tolist(), HEXAHEDRON))
    particles = mpm.Particles(ball, V, quadrature_degree=2)
    problem = mpm.DynamicProblem(
        mpm.Body(particles, Hencky(500.0, 0.3), density=1.0, body_force=(0.0, 0.0, -1.0)),
        scheme="conserving",
        terms=[wall(particles, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), penalty=1.0)],
        solver=mpm.Solver(petsc_options={"snes_rtol": 1e-11}),
    )
    masses, heights = problem.built.mass_matrices(0).sum(axis=2), []
    mass = WORLD.allreduce(float(masses.sum()))
    for _ in problem.steps(time=1.1, dt=dt):
        z = particles.node_positions[:, 2][particles.domain_nodes[: particles.num_local]]
        heights.append(WORLD.allreduce(float((masses * z).sum())) / mass)
    energies, scale = problem.history.energies, 0.1 * mass
    whole = np.array([e.kinetic + e.internal - e.external for e in energies])
    assert whole.max() <= whole[0] + 1e-10 * scale
    assert whole.min() >= whole[0] - 0.03 * scale  # what cells cannot follow
    assert np.ptp([e.balance for e in energies]) < 1e-11 * scale
    assert np.abs(problem.momentum[:2]).max() < 1e-4 * mass  # the grid is not symmetric
    assert problem.history.cutbacks == 0
    lowest = int(np.argmin(heights))
    assert 0.22 < heights[lowest] < 0.25
    return (max(heights[lowest:]) - 0.25) / 0.1


@pytest.mark.slow
def test_a_ball_bounces_off_a_plane():
    assert 0.97 < bounced(4, 0.02) < 1.0


@pytest.mark.slow
def test_a_ball_bounces_as_high_as_a_finer_one():
    # What is missing is in its vibrations, which a few facets of contact know roughly.
    assert bounced(6, 0.005) == pytest.approx(bounced(10, 0.005), rel=0.02)


@pytest.mark.parametrize(
    ("scheme", "out"), thinned(2, [("conserving", "project"), ("midpoint", "reflect")])
)
def test_a_bar_bounces_off_a_plane(scheme, out):
    # A mean of the end forces would multiply the energy by 4.7 (with reflect) in such a run.
    V = vectors(box([0.0, 0.0], [2.0, 3 / 8], [16, 3], QUADRILATERAL))
    body = box([0.31, 1 / 8], [1.31, 2 / 8], [16, 2], QUADRILATERAL)
    particles = mpm.Particles(body, V)
    problem = mpm.DynamicProblem(
        mpm.Body(particles, LinearElastic(1.0, 0.0), density=1.0, velocity=(-0.1, 0.0)),
        scheme=scheme,
        out_of_range=out,
        terms=[wall(particles, (0.29, 0.0), (1.0, 0.0))],
    )
    momentum = problem.momentum
    history = problem.solve(time=2.8, dt=0.04)
    np.testing.assert_allclose(problem.momentum / momentum[0], [-1.0, 0.0], atol=0.06)
    whole = np.array([energy.kinetic + energy.internal for energy in history.energies])
    assert whole.max() <= whole[0] * (1.0 + 1e-9)
    assert whole[-1] >= whole[0] * (1.0 - (1e-3 if out == "reflect" else 0.05))
    assert change_of_balance(history) < 1e-11


@pytest.mark.parametrize("scheme", ["midpoint", *slow("euler")])
def test_a_quiet_boundary_lets_a_pulse_go(scheme):
    # A pulse that runs to the left (v = c d') leaves the bar of wave speed 1 through its end.
    V = vectors(box([0.0, 0.0], [1.6, 3 / 32], [51, 3], QUADRILATERAL))
    body = box([0.3, 1 / 32], [1.3, 2 / 32], [64, 2], QUADRILATERAL)
    particles = mpm.Particles(body, V)
    end = mesh.locate_entities_boundary(body, 1, at(0, 0.3))
    tags = mesh.meshtags(body, 1, np.sort(end), np.full(len(end), 1, dtype=np.int32))
    quiet = dashpot(particles, tags, 1, 1.0, 0.0)
    problem = mpm.DynamicProblem(
        mpm.Body(
            particles,
            LinearElastic(1.0, 0.0),
            density=1.0,
            velocity=lambda x: np.stack(
                [-0.01 * np.exp(-(((x[0] - 0.6) / 0.06) ** 2)), 0.0 * x[0]]
            ),
        ),
        supports=[quiet],
        scheme=scheme,
    )
    momentum = problem.momentum[0]
    impulse = 0.0
    for _ in problem.steps(time=0.6, dt=0.01):
        impulse += 0.01 * problem.reaction(quiet)[0]
    history = problem.history
    # Half of it runs to the right, with half of the energy.
    np.testing.assert_allclose(problem.momentum[0], 0.5 * momentum, rtol=0.02)
    np.testing.assert_allclose(impulse, -0.5 * momentum, rtol=0.02)
    assert change_of_balance(history) < 1e-11
    if scheme == "midpoint":
        half = 0.5 * history.energies[0].kinetic
        assert history.energies[-1].damping == pytest.approx(half, rel=0.04)
    law = LinearElastic(1.0, 0.0)
    raises(
        lambda: mpm.QuasiStaticProblem(mpm.Body(particles, law), supports=[quiet]),
        mpm.MPMError,
        "give it to a DynamicProblem",
    )
    raises(lambda: dashpot(particles, tags, 1, -1.0, 0.0), mpm.MPMError, "must not be negative")


@pytest.mark.parametrize("scheme", ["midpoint", "euler"])
def test_a_quiet_boundary_resists_motions_across_and_along_it(scheme):
    V = vectors(box([0.0, 0.0], [2.0, 2.0], [8, 8], QUADRILATERAL))
    body = box([0.3, 0.3], [1.2, 1.3], [5, 6], QUADRILATERAL)
    particles = mpm.Particles(body, V)
    tags = mpm.facet_tags(body, {1: mpm.region(x=1.2)})
    quiet = dashpot(particles, tags, 1, 3.0, 0.7)
    law = LinearElastic(50.0, 0.2)
    problem = mpm.DynamicProblem(
        mpm.Body(particles, law, density=1.0, velocity=(0.2, -0.3)), supports=[quiet], scheme=scheme
    )
    change, ds = fem.Function(particles.W), ufl.Measure("ds", domain=body, subdomain_data=tags)(1)
    sides = [fem.form(change[i] * ds) for i in (0, 1)]
    change.x.array[:] = 0.0
    momentum = problem.momentum
    for _ in problem.steps(time=0.1, dt=0.02):
        change.x.array[:] = (particles.displacement.x.array - change.x.array) / 0.02
        across, along = (WORLD.allreduce(fem.assemble_scalar(side)) for side in sides)
        force = [-3.0 * across, -0.7 * along]
        np.testing.assert_allclose(problem.reaction(quiet), force, rtol=1e-9)
        np.testing.assert_allclose(problem.momentum - momentum, np.multiply(0.02, force), rtol=1e-6)
        momentum = problem.momentum
        change.x.array[:] = particles.displacement.x.array
    assert min(abs(across), abs(along)) > 0.05


@pytest.mark.slow
def test_a_plane_that_moves_throws_a_body():
    # A wall at speed 0.1 meets a bar at rest, which leaves it at twice that; work is done on it.
    V = vectors(box([0.0, 0.0], [2.0, 3 / 8], [16, 3], QUADRILATERAL))
    body = box([0.31, 1 / 8], [1.31, 2 / 8], [16, 2], QUADRILATERAL)
    particles = mpm.Particles(body, V)
    plate = wall(particles, (0.29, 0.0), (1.0, 0.0))
    problem = mpm.DynamicProblem(
        mpm.Body(particles, LinearElastic(1.0, 0.0), density=1.0), terms=[plate]
    )
    history = problem.solve(time=2.6, dt=0.04, update=lambda t: plate.move((0.1 * t, 0.0)))
    np.testing.assert_allclose(problem.momentum, [0.2 / 8, 0.0], rtol=0.03, atol=1e-6)
    work = -history.energies[-1].internal + history.energies[-1].strain
    assert work == pytest.approx(0.5 * 0.2**2 / 8, rel=0.05)


@pytest.mark.parametrize(
    ("speed", "dt", "out"),
    thinned(11, product([0.1, 0.37, 0.8, 1.25], [0.02, 0.05, 0.31], ["project", "reflect"])),
)
def test_an_elastic_bar_wins_no_energy_at_any_speed(speed, dt, out):
    # The bar vibrates, and flies through the cells; small strains have an energy that the mean of
    # the end forces keeps.
    V = vectors(box([0.0, 0.0], [9.0, 0.375], [72, 3], QUADRILATERAL))
    body = box([0.3, 0.141], [1.3, 0.266], [16, 2], QUADRILATERAL)
    problem = mpm.DynamicProblem(
        mpm.Body(
            mpm.Particles(body, V),
            LinearElastic(1.0, 0.3),
            density=1.0,
            velocity=lambda x: np.stack([speed + 0.3 * np.cos(np.pi * (x[0] - 0.3)), 0.0 * x[0]]),
        ),
        out_of_range=out,
    )
    history = problem.solve(time=50 * dt if speed * 50 * dt < 7.0 else 5.0, dt=dt)
    whole = np.array([energy.kinetic + energy.internal for energy in history.energies])
    assert whole.max() <= whole[0] * (1.0 + 1e-10)
    assert whole.min() >= whole[0] * (1.0 - (1e-3 if out == "reflect" else 0.05))
    assert np.diff([energy.balance for energy in history.energies]).max() < 1e-10 * whole[0]


@pytest.mark.slow
def test_momentum_does_not_wander_from_step_to_step():
    # What the shift of a projection holds back, 1e-13 of the momentum, adds up to 1e-12 here.
    h = 1 / 16
    V = vectors(box([0.0, 0.0], [2.0, h], [32, 1], QUADRILATERAL))
    across = V.sub(1).collapse()[0]
    held = fem.locate_dofs_geometrical((V.sub(1), across), lambda x: x[0] > -1.0)
    problem = mpm.DynamicProblem(
        mpm.Body(
            mpm.Particles(box([0.25, 0.0], [1.25, h], [32, 2], QUADRILATERAL), V),
            LinearElastic(1.0, 0.0),
            density=1.0,
            velocity=lambda x: np.stack([0.37 + 0.3 * np.cos(np.pi * (x[0] - 0.25)), 0.0 * x[0]]),
        ),
        bcs=[fem.dirichletbc(fem.Function(across), held, V.sub(1))],
        solver=mpm.Solver(petsc_options={"snes_rtol": 1e-13}),
    )
    first = problem.momentum
    problem.solve(time=1.4, dt=0.02)
    assert abs(problem.momentum - first)[0] < 1e-13 * h


@pytest.mark.slow
@pytest.mark.parametrize("out", ["project", "reflect"])
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("speed", [0.0, 0.1, 0.25, 0.37, 0.5, 0.8, 1.0, 1.25])
def test_a_bar_wins_no_energy_in_a_long_flight(speed, degree, out):
    # In steps of 0.2 to 16 times what a wave needs for a cell; the bar is of one dimension.
    h, steps = 0.125, 400
    for dt in (0.2 * h, 0.8 * h, 2.0 * h, 5.0 * h, 16.0 * h):
        cells = int(np.ceil((2.3 + speed * dt * steps) / h))
        V = vectors(box([0.0, 0.0], [cells * h, h], [cells, 1], QUADRILATERAL), degree)
        body = box([0.3, 0.0], [1.3, h], [16, 2], QUADRILATERAL)
        across = V.sub(1).collapse()[0]
        held = fem.locate_dofs_geometrical((V.sub(1), across), lambda x: x[0] > -1.0)
        problem = mpm.DynamicProblem(
            mpm.Body(
                mpm.Particles(body, V, degree=degree),
                LinearElastic(1.0, 0.0),
                density=1.0,
                velocity=lambda x: np.stack(
                    [speed + 0.1 * np.cos(np.pi * (x[0] - 0.3)), 0.0 * x[0]]
                ),
            ),
            bcs=[fem.dirichletbc(fem.Function(across), held, V.sub(1))],
            out_of_range=out,
            solver=mpm.Solver(stabilisation=None),
        )
        history = problem.solve(time=steps * dt, dt=dt)
        whole = np.array([energy.kinetic + energy.strain for energy in history.energies])
        assert whole.max() <= whole[0] * (1.0 + 1e-10)
        if out == "reflect":
            assert whole.min() >= whole[0] * (1.0 - 1e-8)
        balances = np.array([energy.balance for energy in history.energies])
        assert np.ptp(balances) < 1e-10 * whole[0]


def vibrating(steps, scheme):
    """Return the error of displacement of a bar's first mode, relative to its amplitude."""
    V = vectors(box([0.0, 0.0], [2.5, 3 / 32], [80, 3], QUADRILATERAL))
    body = box([0.3, 1 / 32], [1.3, 2 / 32], [64, 2], QUADRILATERAL)
    particles, w, speed, end = mpm.Particles(body, V), np.pi, 0.37, 2.25

    def velocity(x):
        return np.stack([speed + 0.1 * w * np.cos(np.pi * (x[0] - 0.3)), 0.0 * x[0]])

    problem = mpm.DynamicProblem(
        mpm.Body(particles, LinearElastic(1.0, 0.0), density=1.0, velocity=velocity), scheme=scheme
    )
    problem.solve(time=end, dt=end / steps)
    x = particles.W.tabulate_dof_coordinates()[:, 0] - 0.3
    exact = 0.1 * np.sin(w * end) * np.cos(np.pi * x)
    return largest(nodal(particles.displacement)[:, 0] - speed * end - exact) / 0.1


@pytest.mark.parametrize(
    ("scheme", "rates"), thinned(2, [("midpoint", (1.9, 2.2)), ("euler", (0.7, 1.0))])
)
def test_order_in_time_of_a_bar_that_vibrates_and_flies(scheme, rates):
    errors = [
        vibrating(steps, scheme) for steps in ((18, 36) if scheme == "midpoint" else (72, 144))
    ]
    assert rates[0] < np.log2(errors[0] / errors[1]) < rates[1]
    assert errors[1] < (0.02 if scheme == "midpoint" else 0.15)


@pytest.mark.slow
def test_a_bar_that_is_shaken_at_its_end_carries_the_wave():
    # d'Alembert: d(x, t) = g(t - x) until the wave comes back.
    V = vectors(box([0.0, 0.0], [1.5, 3 / 32], [48, 3], QUADRILATERAL))
    body = box([0.2, 1 / 32], [1.2, 2 / 32], [64, 2], QUADRILATERAL)
    particles = mpm.Particles(body, V)
    base = mesh.locate_entities_boundary(body, 1, lambda x: np.isclose(x[0], 0.2))
    tags = mesh.meshtags(body, 1, np.sort(base), np.full(len(base), 1, dtype=np.int32))
    shaken = fem.Constant(body, (0.0, 0.0))
    support = fixed(particles, tags, 1, value=shaken)
    problem = mpm.DynamicProblem(
        mpm.Body(particles, LinearElastic(1.0, 0.0), density=1.0), supports=[support]
    )

    def path(t):
        return 0.02 * np.sin(np.pi * np.clip(t, 0.0, 1.0)) ** 2

    def update(t):
        shaken.value[0] = path(t)

    problem.solve(time=0.9, dt=0.9 / 60, update=update)
    x = particles.W.tabulate_dof_coordinates()[:, 0] - 0.2
    assert largest(nodal(particles.displacement)[:, 0] - path(0.9 - x)) < 0.03 * 0.02


@pytest.mark.parametrize("scheme", ["midpoint", "euler"])
def test_the_reaction_is_the_force_that_moves_a_body(scheme):
    # All of the background is held, and follows g: the body has the acceleration of g.
    V = plate()
    value = fem.Function(V)
    dofs = np.arange(V.dofmap.index_map.size_local + V.dofmap.index_map.num_ghosts, dtype=np.int32)
    bc = fem.dirichletbc(value, dofs)
    problem = spinning(square(V=V), velocity=None, bcs=[bc], scheme=scheme, out_of_range="reflect")

    def update(t):
        nodal(value)[:] = (0.1 * t**2, -0.05 * t**2)

    forces = []
    for step in problem.steps(time=0.5, dt=0.1, update=update):
        if scheme == "midpoint":
            np.testing.assert_allclose(
                problem.momentum, 2.0 * step.time * np.array([0.2, -0.1]), atol=1e-11
            )
        forces.append(problem.reaction(bc))
    np.testing.assert_allclose(forces[1:], np.tile([0.4, -0.2], (4, 1)), rtol=1e-9)


def test_dirichlet_values_that_move_are_followed_by_what_projects():
    # The rates of a parabola are known from its last three values, so from the second step on.
    V = plate()
    value = fem.Function(V)
    dofs = np.arange(V.dofmap.index_map.size_local + V.dofmap.index_map.num_ghosts, dtype=np.int32)
    bc = fem.dirichletbc(value, dofs)
    problem = spinning(square(V=V), velocity=None, bcs=[bc])

    def update(t):
        nodal(value)[:] = (0.1 * t**2, -0.05 * t**2)

    for number, step in enumerate(problem.steps(time=0.5, dt=0.1, update=update)):
        if number > 0:
            expected = 2.0 * step.time * np.array([0.2, -0.1])
            np.testing.assert_allclose(problem.momentum, expected, atol=1e-11)
        if number > 1:
            np.testing.assert_allclose(problem.reaction(bc), [0.4, -0.2], rtol=1e-9)
    history = problem.history
    assert history.energies[-1].prescribed > 0.0
    assert change_of_balance_of(history, history.energies[-1].kinetic) < 1e-12


@pytest.mark.parametrize("out", ["project", *slow("reflect")])
def test_a_pushed_bar_carries_the_wave(tmp_path, out):
    # The background's left end pushes; the account has its work; a restart goes on bit for bit.
    def pushed():
        V = vectors(box([0.0, 0.0], [1.5, 3 / 16], [24, 3], QUADRILATERAL))
        # (off the grid's lines: on one, round-off says which nodes beyond it are touched)
        body = box([0.0, 1 / 16 + 0.004], [1.0, 2 / 16 + 0.004], [32, 2], QUADRILATERAL)
        end = fem.Function(V)
        left = mesh.locate_entities_boundary(V.mesh, 1, at(0, 0.0))
        bc = fem.dirichletbc(end, fem.locate_dofs_topological(V, 1, left))
        law = LinearElastic(1.0, 0.0)
        problem = mpm.DynamicProblem(
            mpm.Body(mpm.Particles(body, V), law, density=1.0),
            bcs=[bc],
            out_of_range=out,
            supports=[],
        )

        def update(t):
            nodal(end)[:] = (0.002 * np.sin(np.pi * np.clip(t, 0.0, 1.0)) ** 2, 0.0)

        return problem, update

    problem, update = pushed()
    path = WORLD.bcast(tmp_path) / "run.ckpt"
    for step in problem.steps(time=0.9, dt=0.015, update=update):
        if len(problem.history.steps) == 30:
            problem.save(path)
    x = problem.particles.W.tabulate_dof_coordinates()[:, 0]
    exact = 0.002 * np.sin(np.pi * np.clip(0.9 - x, 0.0, 1.0)) ** 2
    error = nodal(problem.particles.displacement)[:, 0] - exact
    assert largest(error) < 0.03 * 0.002
    work = problem.history.energies[-1].prescribed
    assert work > 0.0
    assert change_of_balance_of(problem.history, work) < 1e-11
    again, update = pushed()
    again.restore(path)
    again.solve(time=0.9, dt=0.015, update=update)
    require_same(run_of(again), run_of(problem), EXACT)


def test_a_body_of_revolution_falls_and_keeps_its_account():
    V = plate()
    particles = square(V=V, corner=(0.0, 1.51))
    problem = spinning(
        particles,
        velocity=lambda x: np.stack([0.1 * x[0], 0.0 * x[0]]),
        axisymmetric=True,
        bcs=[fix(V, at(0, 0.0), 0.0, component=0)],
        body_force=(0.0, -1.0),
    )
    mass = 2.0 * np.pi
    history = problem.solve(time=0.5, dt=0.05)
    np.testing.assert_allclose(problem.momentum[1], -0.5 * mass, rtol=1e-10)
    assert change_of_balance(history) < 1e-9
    assert history.energies[-1].external == pytest.approx(mass * 0.125, rel=1e-10)


def test_a_cube_spins_in_space():
    V = vectors(box([0.0] * 3, [2.0] * 3, [6] * 3, HEXAHEDRON))
    body = box([0.53] * 3, [1.53] * 3, [4] * 3, HEXAHEDRON)
    problem = mpm.DynamicProblem(
        mpm.Body(
            mpm.Particles(body, V),
            VonMises(100.0, 0.3, rho_y=5.0),
            density=1.0,
            velocity=lambda x: np.stack([0.1 - x[1] + 1.03, x[0] - 1.03, 0.0 * x[2]]),
        ),
        solver=mpm.Solver(petsc_options={"snes_rtol": 1e-12}, stabilisation=None),
    )
    momentum, turning = problem.momentum, problem.angular_momentum
    assert turning.shape == (3,)
    history = problem.solve(time=0.2, dt=0.05)
    np.testing.assert_allclose(problem.momentum, momentum, atol=1e-11)
    np.testing.assert_allclose(problem.angular_momentum, turning, atol=2e-4)
    assert change_of_balance(history) < 1e-10


@pytest.mark.slow
def test_backward_euler_brings_a_body_to_rest_on_a_plane():
    particles = square(corner=(1.23, 1.0))
    floor = wall(particles, (0.0, 1.0), (0.0, 1.0))
    options = {"body_force": (0.0, -1.0), "terms": [floor], "velocity": None}
    problem = spinning(particles, scheme="euler", **options)
    problem.solve(time=4.0, dt=0.1)
    assert problem.kinetic_energy < 1e-6
    np.testing.assert_allclose(problem.reaction(floor), [0.0, 2.0], atol=1e-3)


# -- What goes with the rest of the package -------------------------------------------------------


def run_of(problem):
    """Return what a run gives, in an order that ranks do not change."""
    found = {}
    for number, body in enumerate(problem.bodies):
        nodes = body.domain_nodes
        velocity = nodal(problem.inertia.velocities[number])[nodes]
        n = body.num_local
        found[f"positions {number}"] = in_order(body, body.domains.reshape(n, -1))
        found[f"stress {number}"] = in_order(body, body.stress.reshape(n, -1))
        found[f"velocity {number}"] = in_order(body, velocity.reshape(n, -1))
    energies = problem.history.energies
    found["energies"] = np.array([list(vars(energy).values()) for energy in energies])
    return found


def require_same(one, other, tolerance):
    assert one.keys() == other.keys()
    for name, values in one.items():
        atol = tolerance * np.abs(other[name]).max(initial=0.0)
        np.testing.assert_allclose(values, other[name], rtol=0.0, atol=atol, err_msg=name)


def thrown(comm=WORLD, out="project", scheme="midpoint", **options):
    """Return a body that yields, spins and falls."""
    particles = square(V=plate(comm), comm=comm)
    law = VonMises(100.0, 0.3, rho_y=3.0 if scheme == "midpoint" else 0.3)
    loads = {"body_force": (0.0, -1.0), "out_of_range": out, "scheme": scheme}
    return spinning(particles, law, **loads, **options)


@pytest.mark.parametrize(
    ("scheme", "out"), thinned(3, product(["midpoint", "conserving"], ["project", "reflect"]))
)
def test_a_run_that_is_restored_goes_on_bit_for_bit(tmp_path, out, scheme):
    path = WORLD.bcast(tmp_path) / "run.ckpt"
    whole = thrown(out=out, scheme=scheme)
    for step in whole.steps(time=0.5, dt=0.05, output_at=[0.33]):
        if step.time == 0.25 or len(whole.history.steps) == 5:
            whole.save(path)
    restored = thrown(out=out, scheme=scheme)
    restored.restore(path)
    assert len(restored.history.steps) == 5
    restored.solve(time=0.5, dt=0.05, output_at=[0.33])
    assert [s.time for s in restored.history.steps] == [s.time for s in whole.history.steps]
    require_same(run_of(restored), run_of(whole), EXACT)
    raises(
        lambda: thrown(out="reflect" if out == "project" else "project", scheme=scheme).restore(
            path
        ),
        mpm.MPMError,
        f"was made with scheme={scheme!r}",
    )
    raises(
        lambda: thrown(out=out, scheme=scheme, rayleigh=(0.0, 1e-3)).restore(path),
        mpm.MPMError,
        r"was made with rayleigh=\(0.0, 0.0\), and this problem with \(0.0, 0.001\)",
    )
    static = mpm.QuasiStaticProblem(mpm.Body(square(), VonMises(100.0, 0.3, rho_y=3.0)))
    static.save(path)
    sentence = "terms keep 'release', and here they keep 'inertia', 'release'"
    raises(lambda: thrown(out=out).restore(path), mpm.MPMError, sentence)


@pytest.mark.parametrize("scheme", ["midpoint", "conserving"])
def test_ranks_and_moves_between_them_change_nothing(scheme):
    options = {"scheme": scheme, "rayleigh": (0.1, 0.002)}
    alone = thrown(mesh_comm(), **options) if WORLD.size > 1 else thrown(**options)
    alone.solve(time=0.5, dt=0.05)
    moving = thrown(**options)
    for number, _ in enumerate(moving.steps(time=0.5, dt=0.05)):
        if number % 3 == 0:
            mesh = moving.particles.mesh
            move = Redistribution(mesh, anywhere(mesh, number))
            moving.state.renew(
                lambda move=move: moving.particles.live_on(move), lambda state: state
            )
    require_same(run_of(moving), run_of(alone), 1e-9)


def mesh_comm():
    from mpi4py import MPI

    return MPI.COMM_SELF


@pytest.mark.parametrize(
    ("out", "scheme"),
    [("project", "midpoint"), ("reflect", "midpoint"), ("project", "conserving")],
)
def test_split_and_rebase_keep_momentum(out, scheme):
    problem = thrown(out=out, scheme=scheme)
    problem.solve(time=0.2, dt=0.05)
    expected = problem.momentum
    problem.split([3, 17, 40])
    np.testing.assert_allclose(problem.momentum, expected, atol=1e-12)
    problem.rebase()
    np.testing.assert_allclose(problem.momentum, expected, atol=1e-12)
    turning = problem.angular_momentum
    history = problem.solve(time=0.4, dt=0.05)
    np.testing.assert_allclose(problem.momentum, expected - [0.0, 0.2 * 2.0], atol=1e-11)
    if scheme == "conserving":  # the weight turns it about the origin
        turned = problem.angular_momentum - turning
        centre = np.trapezoid([1.73, 1.73], dx=0.2)
        np.testing.assert_allclose(turned, -2.0 * centre, atol=1e-10)
    assert change_of_balance(history) < 1e-9


@pytest.mark.parametrize(("cell", "degree"), [(TRIANGLE, 3), (QUADRILATERAL, 2)])
def test_a_rebase_keeps_kinetic_energy(cell, degree):
    # A body that shears by as much as its size: cells with curved sides, far from what they were.
    def torn(x):
        return np.stack([2.0 * np.sin(3.0 * x[1]), 1.5 * np.cos(4.0 * x[0])])

    body = box([1.23, 1.51], [2.23, 2.51], [2, 2], cell)
    particles = mpm.Particles(body, plate(degree=degree), degree=degree)
    problem = spinning(particles, velocity=torn)
    problem.solve(time=0.2, dt=0.05)
    strain = np.abs(particles.deformation_gradient - np.eye(3)).max(initial=0.0)
    assert WORLD.allreduce(strain, MPI.MAX) > 0.3
    before = problem.kinetic_energy, *problem.momentum
    problem.rebase()
    after = problem.kinetic_energy, *problem.momentum
    np.testing.assert_allclose(after, before, rtol=0, atol=1e-13 * before[0])
    problem.solve(time=0.3, dt=0.05)
    assert change_of_balance(problem.history) < 1e-9


@pytest.mark.parametrize("options", [{"f_bar": "patch"}, {"axisymmetric": True}], ids=str)
def test_a_motion_goes_on_as_it_was_after_a_rebase(options):
    # A tube or a block that widens, pulled back by its stiffness.
    runs = []
    for rebased in (False, True):
        problem = spinning(velocity=lambda x: 0.3 * x[:2], scheme="conserving", **options)
        problem.solve(time=0.2, dt=0.05)
        if rebased:
            problem.rebase()
        problem.solve(time=0.4, dt=0.05)
        assert change_of_balance(problem.history) < 1e-9
        runs.append(problem)
    one, two = runs
    assert one.history.iterations == two.history.iterations
    places = [in_order(run.particles, run.particles.domains) for run in runs]
    np.testing.assert_allclose(places[1], places[0], rtol=0, atol=1e-9)
    assert np.abs(one.particles.deformation_gradient - np.eye(3)).max(initial=0.0) > 0.01


@pytest.mark.parametrize("scheme", ["midpoint", "conserving", "euler"])
def test_a_split_between_two_steps_keeps_momentum(scheme):
    # The forces at the beginning of the next step are those of before.
    problem = thrown(scheme=scheme, petsc_options={"snes_rtol": 1e-12})
    expected = problem.momentum
    for step in problem.steps(time=0.3, dt=0.05):
        if step.time == pytest.approx(0.15):
            problem.split(np.arange(0, problem.particles.num_global, 2))
        fallen = [0.0, step.time * 2.0]
        np.testing.assert_allclose(problem.momentum, expected - fallen, atol=1e-11)


@pytest.mark.parametrize(("what", "damping"), thinned(3, product(["split", "rebase"], [0.0, 1e-3])))
def test_other_meshes_between_two_steps_are_no_other_run(what, damping):
    # Stresses of whole steps know what the new mesh is strained by, also within one run.
    def change(problem):
        if what == "rebase":
            problem.rebase()
        else:
            problem.split(np.arange(0, problem.particles.num_global, 2))

    runs = []
    for once in (True, False):
        problem = thrown(scheme="conserving", rayleigh=(0.0, damping))
        if once:
            for step in problem.steps(time=0.3, dt=0.05):
                if step.time == pytest.approx(0.15):
                    change(problem)
        else:
            problem.solve(time=0.15, dt=0.05)
            change(problem)
            problem.solve(time=0.3, dt=0.05)
        assert change_of_balance(problem.history) < 1e-9
        runs.append(problem.particles)
    assert np.abs(runs[0].domains - runs[1].domains).max(initial=0.0) < 1e-9


def test_two_bodies_collide_on_one_background():
    # No momentum is lost, and they part by themselves.
    V = vectors(box([-1.0, 0.0], [4.0, 1.5], [20, 6], QUADRILATERAL))
    bodies = [square(corner=(x, 0.27), V=V) for x in (0.3, 1.6)]
    problem = posed(
        mpm.DynamicProblem,
        bodies,
        Hencky(100.0, 0.3),
        1.0,
        velocity=[(0.5, 0.0), (-0.5, 0.0)],
        petsc_options={"snes_rtol": 1e-12},
    )
    history = problem.solve(time=0.8, dt=0.01)  # (the gap to contact is known to a step)
    np.testing.assert_allclose(problem.momentum, 0.0, atol=1e-11)
    speeds = []
    for body, velocity in zip(bodies, problem.velocity, strict=True):
        n = body.num_local
        mean = nodal(velocity)[body.domain_nodes].mean(axis=1)[:n, 0].sum()
        speeds.append(WORLD.allreduce(mean) / 64)
    assert speeds[0] < -0.25 and speeds[1] > 0.25  # the rest vibrates
    least = min(energy.kinetic for energy in history.energies)
    assert least < 0.2 * history.energies[0].kinetic
    assert change_of_balance(history) < 1e-9


OTHERS = {
    "cpdi": ({"method": "cpdi"}, {}),
    "gimp": ({"method": "gimp"}, {}),
    "mpm": ({"method": "mpm"}, {}),
    "F-bar": ({"quadrature_degree": 2}, {"f_bar": "domain"}),
    "degree 3": ({"degree": 3}, {"stabilisation": None}),
    "reference": ({}, {"route": "reference"}),
    "conserving F-bar": ({"quadrature_degree": 2}, {"f_bar": "domain", "scheme": "conserving"}),
    "conserving degree 2": ({"degree": 2}, {"scheme": "conserving"}),
    "conserving gimp": ({"method": "gimp"}, {"scheme": "conserving"}),
}


@pytest.mark.parametrize("name", all_but(["cpdi", "conserving F-bar", "conserving gimp"], OTHERS))
def test_other_methods_and_options_keep_momentum_and_the_account(name, take):
    of_particles, options = OTHERS[name]
    options = dict(options)
    take(options.pop("route", "loops"))
    problem = spinning(square(**of_particles), velocity=lambda x: 0.3 + 0.5 * spin(x), **options)
    momentum, turning = problem.momentum, problem.angular_momentum
    history = problem.solve(time=0.4, dt=0.05)
    np.testing.assert_allclose(problem.momentum, momentum, atol=1e-10)
    atol = 1e-10 if options.get("scheme") == "conserving" else 2e-4
    np.testing.assert_allclose(problem.angular_momentum, turning, atol=atol)
    assert change_of_balance(history) < 1e-11
    energies = history.energies
    assert all(
        energy.kinetic + energy.internal <= 1.0001 * energies[0].kinetic for energy in energies
    )


def test_a_pressure_and_a_tie_give_the_account_their_work():
    V, other = plate(), plate()
    bodies = [square(V=V), square(V=other, corner=(2.23, 1.51))]
    tags = [
        mesh.meshtags(
            body.mesh,
            1,
            np.sort(found := mesh.locate_entities_boundary(body.mesh, 1, where)),
            np.full(len(found), 1, dtype=np.int32),
        )
        for body, where in zip(bodies, (at(0, 2.23), at(0, 3.23)), strict=True)
    ]
    problem = posed(
        mpm.DynamicProblem,
        bodies,
        Hencky(100.0, 0.3),
        2.0,
        terms=[mpm.Tie(*bodies, tags[0], 1, 1e3)],
        pressures=[[], [(1.0, 1)]],
        facet_tags=tags,
        petsc_options={"snes_rtol": 1e-12},
    )
    history = problem.solve(time=0.5, dt=0.025)
    # A pressure of 1 on a face that is about as long as at first drives both to the left.
    np.testing.assert_allclose(problem.momentum, [-0.5, 0.0], atol=0.01)
    means = [nodal(v)[:, 0].mean() for v in problem.velocity]
    if WORLD.size == 1:
        np.testing.assert_allclose(means, -0.125, atol=0.02)
    balances = [energy.balance for energy in history.energies]
    assert np.ptp(balances) < 1e-9 * history.energies[-1].kinetic


def test_two_fields_fly_apart_as_if_each_were_alone():
    alone = []
    for speed in (0.4, -0.3):
        problem = spinning(velocity=lambda x, s=speed: s * spin(x))
        problem.solve(time=0.25, dt=0.05)
        alone.append(run_of(problem))
    pair = [square(), square()]
    together = spinning(pair, velocity=[lambda x, s=s: s * spin(x) for s in (0.4, -0.3)])
    together.solve(time=0.25, dt=0.05)
    found = run_of(together)
    for number, own in enumerate(alone):
        for name in ("positions", "stress", "velocity"):
            size = np.abs(own[f"{name} 0"]).max()
            np.testing.assert_allclose(
                found[f"{name} {number}"], own[f"{name} 0"], atol=1e-8 * size, err_msg=name
            )


def standing(f_bar="none"):
    """Return a body that stands on a floor, on a V of its own, and what loads and holds it."""
    V = vectors(box([0.0, 0.0], [3.0, 2.0], [12, 8], QUADRILATERAL))
    body = box([0.6, 0.0], [1.6, 1.0], [8, 8], QUADRILATERAL)
    rule = 2 if f_bar == "domain" else None
    particles = mpm.Particles(body, V, quadrature_degree=rule)
    top = np.sort(mesh.locate_entities_boundary(body, 1, at(1, 1.0)))
    tags = mesh.meshtags(body, 1, top, np.full(len(top), 1, dtype=np.int32))
    push = fem.Constant(body, 0.0)
    tractions = [(ufl.as_vector([0.5 * push, -push]), 1)]
    return particles, push, tractions, tags, [fix(V, at(1, 0.0))]


@pytest.mark.parametrize(
    ("scheme", "out", "f_bar", "route"),
    [
        pytest.param("midpoint", "project", "none", "loops", marks=pytest.mark.slow),
        ("midpoint", "reflect", "domain", "loops"),
        pytest.param("conserving", "project", "none", "reference", marks=pytest.mark.slow),
        pytest.param("conserving", "reflect", "none", "loops", marks=pytest.mark.slow),
        pytest.param("euler", "project", "none", "loops", marks=pytest.mark.slow),
    ],
    indirect=["route"],
)
@pytest.mark.usefixtures("route")
def test_a_body_without_inertia_beside_one_that_moves(scheme, out, f_bar):
    # Apart, each goes its own way: in equilibrium under a load that comes and goes, and as alone.
    law, times = VonMises(40.0, 0.3, rho_y=2.0), np.arange(1, 6) * 0.05
    options = {"body_force": (0.0, -1.0), "f_bar": f_bar}
    options |= {"petsc_options": {"snes_rtol": 1e-12}}

    def load(t):
        return 0.8 * np.sin(10.0 * t)

    particles, push, tractions, tags, bcs = standing(f_bar)
    static = posed(
        mpm.QuasiStaticProblem,
        particles,
        law,
        2.0,
        tractions=tractions,
        facet_tags=tags,
        bcs=bcs,
        **options,
    )
    alone = []

    def path(s):
        particles.load.value = 1.0
        push.value = load(s * times[-1])

    for _ in static.steps(len(times), update=path):
        alone.append(nodal(particles.displacement).copy())
    rule = 2 if f_bar == "domain" else None
    given = {"scheme": scheme, "out_of_range": out, **options}
    free = spinning(square(quadrature_degree=rule), law, **given)
    free.solve(time=times[-1], dt=times[0])

    body, weight, tractions, tags, bcs = standing(f_bar)
    pair = [square(quadrature_degree=rule), body]
    problem = spinning(
        pair,
        law,
        velocity=[spin, None],
        tractions=[[], tractions],
        facet_tags=[None, tags],
        bcs=bcs,
        quasi_static=[body],
        **given,
    )

    def update(t):
        weight.value = load(t)

    found = []
    for _ in problem.steps(time=times[-1], dt=times[0], update=update):
        found.append(nodal(body.displacement).copy())
    np.testing.assert_allclose(found, alone, atol=1e-9)
    assert WORLD.allreduce(float(body.plastic_strain.max(initial=0.0)), MPI.MAX) > 1e-3
    np.testing.assert_allclose(
        nodal(pair[0].displacement), nodal(free.particles.displacement), atol=1e-9
    )
    mean = (found[-1] - found[-2]) / times[0]
    np.testing.assert_allclose(nodal(problem.velocity[1]), mean, atol=1e-9)
    assert problem.kinetic_energy == pytest.approx(free.kinetic_energy, rel=1e-9)
    energies = problem.history.energies
    assert np.ptp([energy.balance for energy in energies]) < 1e-10 * energies[0].kinetic
    assert energies[-1].dissipated > free.history.energies[-1].dissipated + 1e-4


@pytest.mark.slow
def test_a_mass_on_a_spring_without_inertia_swings_in_its_period(tmp_path):
    # A heavy stiff block on a light bar, both on one background: of first order, as forces of the
    # bar are those at the end of each step.
    V = vectors(box([0.0, 0.0], [2.0, 0.25], [16, 2], QUADRILATERAL))
    across = V.sub(1).collapse()[0]
    held = fem.locate_dofs_geometrical((V.sub(1), across), lambda x: x[0] > -1.0)
    bar = mpm.Particles(box([0.0, 0.0], [1.0, 0.25], [16, 4], QUADRILATERAL), V)
    block = mpm.Particles(box([1.0, 0.0], [1.5, 0.25], [8, 4], QUADRILATERAL), V)

    def made(static, first=None):
        return mpm.DynamicProblem(
            [
                mpm.Body(bar, LinearElastic(1.0, 0.0), density=2.0, velocity=first),
                mpm.Body(block, LinearElastic(1e4, 0.0), density=2.0, velocity=(0.02, 0.0)),
            ],
            bcs=[fix(V, at(0, 0.0)), fem.dirichletbc(fem.Function(across), held, V.sub(1))],
            quasi_static=static,
        )

    problem = made([bar])
    omega = 1.0  # of the mass 0.25 on the stiffness 0.25
    history = problem.solve(time=np.pi / omega / 2.0, dt=0.02)
    middle = nodal(block.displacement)[:, 0].mean()
    if WORLD.size == 1:
        assert middle == pytest.approx(0.02 / omega, rel=0.015)
    energies = history.energies
    assert np.ptp([energy.balance for energy in energies]) < 1e-10 * energies[0].kinetic
    first, last = energies[0], energies[-1]
    assert last.kinetic < 1e-3 * first.kinetic and last.strain < first.kinetic
    assert last.strain + last.dissipated == pytest.approx(first.kinetic, rel=1e-3)
    assert 0.01 < last.dissipated / first.kinetic < 0.02
    path = WORLD.bcast(tmp_path) / "one.ckpt"
    problem.save(path)
    other = made([], (0.0, 0.0))
    raises(lambda: other.restore(path), mpm.MPMError, "other bodies without inertia than quasi_st")


@pytest.mark.parametrize("scheme", ["midpoint", "conserving", "euler"])
def test_what_a_dashpot_on_a_body_without_inertia_takes_counts_once(scheme):
    V = vectors(box([0.0, 0.0], [2.0, 3.0], [8, 12], QUADRILATERAL))
    low = mpm.Particles(box([0.3, 0.0], [1.3, 1.0], [8, 8], QUADRILATERAL), V)
    high = mpm.Particles(box([0.3, 1.0], [1.3, 1.5], [8, 4], QUADRILATERAL), V)
    tags = mpm.facet_tags(low.mesh, {1: mpm.region(x=0.3)})
    law = Hencky(100.0, 0.3)
    problem = mpm.DynamicProblem(
        [mpm.Body(low, law, 1.0), mpm.Body(high, law, 1.0, velocity=(0.5, -1.0))],
        bcs=[mpm.held(V, y=0.0)],
        supports=[mpm.boundary.dashpot(low, tags, 1, 20.0, 10.0)],
        quasi_static=[low],
        scheme=scheme,
        solver=mpm.Solver(petsc_options={"snes_rtol": 1e-12}),
    )
    energies = problem.solve(time=0.3, dt=0.03).energies
    assert energies[-1].dissipated > 0.2 * energies[0].kinetic
    assert np.ptp([energy.balance for energy in energies]) < 1e-10 * energies[0].kinetic


@pytest.mark.parametrize(
    ("message", "options"),
    [
        ("needs a list of some of the problem's own particles", {"quasi_static": "all"}),
        ("at least one body must move", {"quasi_static": ...}),
        ("has no velocity; omit it", {"velocity": (0.0, 1.0)}),
        ("mixed='pressure' does not go with quasi_static=", {"mixed": "pressure"}),
    ],
)
def test_what_bodies_without_inertia_do_not_go_with(message, options):
    pair = [square(), square()]
    given = {"quasi_static": pair[:1], **options}
    if given["quasi_static"] is ...:
        given["quasi_static"] = pair
    velocity = given.pop("velocity", None)
    raises(lambda: spinning(pair, velocity=[velocity, None], **given), mpm.MPMError, message)


def resting(law, **options):
    """Return a body that stands on a floor in equilibrium, its problem, and what it is made with.

    The weight makes a von Mises body yield at its foot.
    """
    V = vectors(box([0.0, 0.0], [3.0, 1.5], [12, 6], QUADRILATERAL))
    bcs = [fix(V, at(1, 0.0), component=1), fix(V, at(0, 0.0), component=0)]
    body = box([0.0, 0.0], [1.0, 1.0], [8, 8], options.pop("cell", TRIANGLE))
    particles = mpm.Particles(body, V, quadrature_degree=options.pop("quadrature_degree", None))
    given = {"body_force": (0.0, -1.0), "bcs": bcs, "petsc_options": {"snes_rtol": 1e-12}}
    more = options.pop("more", 0)
    static = posed(mpm.QuasiStaticProblem, particles, law, 2.0, **given, **options)
    static.solve(4)
    for _ in range(more):
        static.step()  # what is in equilibrium in one step's cells is so in the next one's
    return particles, static, {**given, **options}


@pytest.mark.parametrize(
    ("f_bar", "scheme", "out"),
    thinned(3, [(f_bar, *scheme) for f_bar in ("none", "domain") for scheme in SCHEMES]),
)
def test_a_body_in_equilibrium_stays_at_rest(scheme, out, f_bar):
    law = VonMises(40.0, 0.3, rho_y=1.0)
    options = {} if f_bar == "none" else {"f_bar": f_bar, "quadrature_degree": 2}
    particles, static, given = resting(law, **options, cell=QUADRILATERAL, more=8)
    settled = nodal(particles.displacement).copy()
    yielded = particles.plastic_strain.copy()
    weight = static.reaction(given["bcs"][0])
    problem = posed(
        mpm.DynamicProblem,
        particles,
        law,
        2.0,
        scheme=scheme,
        out_of_range=out,
        after=static,
        **given,
    )
    np.testing.assert_array_equal(particles.plastic_strain, yielded)
    history = problem.solve(time=0.5, dt=0.1)
    assert WORLD.allreduce(float(yielded.sum())) > 1e-3
    assert largest(nodal(particles.displacement) - settled) < 1e-9
    assert problem.kinetic_energy < 1e-16
    np.testing.assert_allclose(problem.reaction(given["bcs"][0]), weight, rtol=1e-8)
    assert history.energies[0].strain > 0.0
    assert history.energies[0].time == 0.0
    raises(static.step, mpm.MPMError, "Another problem was made of these particles")


def test_what_was_weakened_in_equilibrium_stays_weak_in_motion():
    law = VonMises(40.0, 0.3, rho_y=1.5)
    particles, static, given = resting(law, cell=QUADRILATERAL, quadrature_degree=2)
    static.points[0].laws.weaken(1.5)
    static.step()
    strength = 1.0

    def most():
        """Return the largest size of a deviatoric Kirchhoff stress on any rank."""
        J = np.linalg.det(particles.deformation_gradient)
        tau = J[:, None, None] * particles.stress.reshape(-1, 3, 3)
        tau = tau - np.trace(tau, axis1=1, axis2=2)[:, None, None] / 3.0 * np.eye(3)
        return largest(np.linalg.norm(tau, axis=(1, 2)))

    assert strength * 0.9 < most() < 1.05 * strength
    given["body_force"] = (0.0, -3.0)
    problem = posed(mpm.DynamicProblem, particles, law, 2.0, scheme="euler", after=static, **given)
    problem.solve(time=0.2, dt=0.05)
    assert problem.points[0].laws.weakening == 1.5
    assert strength * 0.95 < most() < 1.05 * strength  # (means over domains)


@pytest.mark.parametrize("scheme", ["midpoint", "conserving"])
def test_a_body_with_a_pressure_of_its_own_stays_at_rest_in_equilibrium(scheme, recwarn):
    law, weight = Hencky(100.0, 0.4999), {"body_force": (0.0, -1.0)}
    V = vectors(box([0.0, 0.0], [2.0, 1.5], [6, 5], QUADRILATERAL), 2)
    feet = fix(V, at(1, 0.0))
    body = box([0.47, 0.0], [1.47, 1.0], [6, 6], QUADRILATERAL)
    particles = mpm.Particles(body, V, degree=2)
    given = {**weight, "bcs": [feet], "mixed": "pressure", "stabilisation": None}
    static = posed(mpm.QuasiStaticProblem, particles, law, 2.0, **given)
    static.solve(2)
    for _ in range(4):
        static.step()
    settled = nodal(particles.displacement).copy()
    pressure = static.pressure[0].x.array.copy()
    problem = posed(mpm.DynamicProblem, particles, law, 2.0, scheme=scheme, after=static, **given)
    np.testing.assert_array_equal(problem.pressure[0].x.array, pressure)
    history = problem.solve(time=0.2, dt=0.05)
    assert largest(nodal(particles.displacement) - settled) < 1e-8
    np.testing.assert_allclose(problem.pressure[0].x.array, pressure, atol=1e-6)
    assert problem.kinetic_energy < 1e-14 and WORLD.allreduce(float(pressure.min())) < -1.0
    assert history.cutbacks == 0
    # What is left of its motion is round-off, of which no step has an error worth a warning.
    assert history.time_error > 0.1 and history.steps[-1].motion < 1e-12
    assert not [one for one in recwarn if "too coarse" in str(one.message)]


def test_a_body_let_go_from_equilibrium_moves_as_its_energy_says():
    # Without weight the body springs up: what it stored is in motion and strain.
    law = Hencky(40.0, 0.3)
    particles, static, given = resting(law)
    given["body_force"] = None
    problem = posed(
        mpm.DynamicProblem,
        particles,
        law,
        2.0,
        scheme="conserving",
        out_of_range="reflect",
        after=static,
        **given,
    )
    history = problem.solve(time=0.3, dt=0.02)
    first, last = history.energies[0], history.energies[-1]
    assert first.kinetic == 0.0 and first.strain > 1e-3
    assert last.kinetic > 0.3 * first.strain
    assert last.kinetic + last.strain == pytest.approx(first.strain, rel=1e-9)


def test_what_a_motion_cannot_begin_with_is_refused():
    law = Hencky(40.0, 0.3)
    particles, static, given = resting(law)
    other, _, _ = resting(law)
    for sentence, body, options in (
        ("needs a QuasiStaticProblem", particles, {"after": particles}),
        ("of the same particles", other, {}),
        ("with f_bar='none'", particles, {"f_bar": "patch"}),
        ("with axisymmetric=False", particles, {"axisymmetric": True}),
        ("omit another initial_stress=", particles, {"initial_stress": lambda x: x}),
        ("with mixed=None; give the same", particles, {"mixed": "pressure"}),
    ):
        every = {"after": static, **given, **options}
        raises(
            lambda body=body, every=every: posed(mpm.DynamicProblem, body, law, 2.0, **every),
            mpm.MPMError,
            sentence,
        )
    raises(
        lambda: posed(mpm.DynamicProblem, particles, law, 0.0, after=static, **given),
        mpm.MPMError,
        "positive",
    )
    static.step()  # nothing has changed
    moving = posed(mpm.DynamicProblem, particles, law, 2.0, after=static, **given)
    raises(
        lambda: posed(mpm.DynamicProblem, particles, law, 2.0, after=moving, **given),
        mpm.MPMError,
        "needs a QuasiStaticProblem",
    )
    moving.solve(time=0.1, dt=0.1)  # particles are elsewhere now than that history knows
    raises(
        lambda: posed(mpm.DynamicProblem, particles, law, 2.0, after=static, **given),
        mpm.MPMError,
        "no longer governs its particles",
    )


def test_times_asked_for_are_hit_and_written(tmp_path):
    path = WORLD.bcast(tmp_path) / "run.pvd"
    problem = thrown()
    wanted = [0.1, 1.0 / 3.0, 0.37]
    history = problem.solve(time=0.4, dt=0.06, output_at=wanted, output=path)
    times = [step.time for step in history.steps]
    assert set(wanted) <= set(times) and times[-1] == 0.4 == history.time
    assert np.diff([0.0, *times]).max() <= 0.06 * (1 + 1e-12)
    assert path.read_text().count("<DataSet") == 5
    assert [energy.time for energy in history.energies] == [0.0, *times]
    problem.step(0.1)
    assert problem.history.time == 0.5


def test_a_step_that_fails_is_halved_and_later_ones_recover():
    problem = thrown()
    refuses = [2]

    def evaluate():
        if problem.inertia.dt > 0.04 and refuses[0]:
            refuses[0] -= 1
            return ConvergenceError("not so fast")
        return None

    calls = []
    problem.evaluate = evaluate
    history = problem.solve(time=0.3, dt=0.05, update=calls.append)
    assert history.cutbacks >= 1
    assert history.time == 0.3
    lengths = np.diff([energy.time for energy in history.energies])
    assert lengths.min() == pytest.approx(0.025) and lengths[-1] == pytest.approx(0.05)
    assert calls[0] == 0.0 and calls[-1] == 0.3
    np.testing.assert_allclose(problem.momentum[1], momentum_of_spin()[1] - 0.6, atol=1e-10)


def momentum_of_spin():
    return spinning().momentum


def test_particles_that_leave_take_their_momentum_with_them():
    V = plate()
    problem = spinning(square(V=V, corner=(2.53, 1.51), outside="delete"), velocity=(1.0, 0.0))
    history = problem.solve(time=1.0, dt=0.05)
    left = history.statistics["lost_mass"]
    assert 0.5 < left < 2.0
    np.testing.assert_allclose(problem.momentum, [2.0 - left, 0.0], atol=1e-9)
    assert history.energies[-1].lost == pytest.approx(0.5 * left, rel=1e-8)


# -- A residual in UFL ----------------------------------------------------------------------------


def elastic(particles, young=100.0, poisson=0.3):
    """Return the residual of small strains, in UFL."""
    mu, lame = young / (2 * (1 + poisson)), young * poisson / (1 + poisson) / (1 - 2 * poisson)

    def strain(w):
        return ufl.sym(ufl.grad(w))

    e = strain(particles.displacement)
    stress = 2 * mu * e + lame * ufl.tr(e) * ufl.Identity(2)
    return ufl.inner(stress, strain(ufl.TestFunction(particles.W))) * particles.dx


@pytest.mark.parametrize(
    ("scheme", "out"), thinned(2, [("midpoint", "project"), ("euler", "project")])
)
def test_a_residual_in_ufl_moves_as_its_material(scheme, out, tmp_path):
    def both(kind):
        particles = square()
        floor = wall(particles, (0.0, 1.48), (0.0, 1.0), modulus=100.0)
        options = {
            "velocity": lambda x: 0.2 * spin(x),
            "scheme": scheme,
            "out_of_range": out,
            "terms": [floor],
            "petsc_options": {"snes_rtol": 1e-12},
        }
        if kind == "material":
            law = LinearElastic(100.0, 0.3)
            return posed(
                mpm.DynamicProblem,
                particles,
                law,
                2.0,
                body_force=(0.0, -1.0),
                rayleigh=(0.1, 0.0),
                **options,
            )
        weight = fem.Constant(particles.mesh, (0.0, -2.0))
        test = ufl.TestFunction(particles.W)
        R = elastic(particles) - ufl.inner(weight, test) * particles.dx_exact
        return posed(mpm.DynamicParticleProblem, R, particles, 2.0, damping=0.1, **options)

    runs = []
    for kind in ("material", "UFL"):
        problem = both(kind)
        momentum = problem.momentum
        for _ in problem.steps(time=0.36, dt=0.03):
            if kind == "UFL" and len(problem.history.steps) == 8:
                problem.save(WORLD.bcast(tmp_path) / "run.ckpt")
        assert change_of_balance(problem.history) < 1e-11
        runs.append((problem, momentum))
    (one, p), (two, q) = runs
    np.testing.assert_allclose(p, q, rtol=1e-12)
    d, e = (nodal(problem.particles.displacement) for problem in (one, two))
    assert largest(d - e) < 1e-9
    v, w = (nodal(problem.velocity) for problem in (one, two))
    assert largest(v - w) < 1e-7
    ends = [problem.history.energies[-1] for problem in (one, two)]
    for name in ("kinetic", "internal", "external", "lost", "damping"):
        assert getattr(ends[1], name) == pytest.approx(getattr(ends[0], name), rel=1e-6, abs=1e-9)
    assert np.isnan(ends[1].strain)
    assert ends[0].internal > ends[0].strain > 0.0  # the floor has a share
    again = both("UFL")
    again.restore(WORLD.bcast(tmp_path) / "run.ckpt")
    again.solve(time=0.36, dt=0.03)
    assert largest(nodal(again.particles.displacement) - e) == 0.0


def test_what_a_residual_in_ufl_cannot_do_in_motion_is_refused():
    particles = square()
    R, tags = elastic(particles), facet_tags(particles.mesh, lambda x: x[1] > 0.0)
    for sentence, form, options in (
        ("needs the stress at points", R, {"scheme": "conserving"}),
        ("needs modulus=", R, {"supports": [fixed(particles, tags, 1)]}),
        ("damping must be a number that", R, {"damping": -1.0}),
        ("damping must be a number that", R, {"damping": True}),
        ("a list of 2 densities", R, {"density": [1.0, 1.0]}),
        ("has displacements alone", R, {"fields": [None]}),
    ):
        density = options.pop("density", 1.0)
        raises(
            lambda form=form, density=density, options=options: posed(
                mpm.DynamicParticleProblem, form, particles, density, **options
            ),
            mpm.MPMError,
            sentence,
        )


def test_what_does_not_go_with_inertia_is_refused():
    def refused(sentence, density=1.0, law=None, **options):
        law = Hencky(100.0, 0.3) if law is None else law
        particles = options.pop("particles", None) or square()
        raises(
            lambda: posed(mpm.DynamicProblem, particles, law, density, **options),
            mpm.MPMError,
            sentence,
        )

    refused("Unknown scheme='newmark'", scheme="newmark")
    refused("Unknown out_of_range='keep'", out_of_range="keep")
    refused("positive density", density=0.0)
    refused("velocity has the shape", velocity=(1.0, 2.0, 3.0))
    refused(
        "velocity must return finite numbers", velocity=lambda x: np.full((2, x.shape[1]), np.inf)
    )
    refused("function that gives velocity failed", velocity=lambda x: x[5])
    refused("velocity must return finite numbers of the shape", velocity=lambda x: 0.0)
    refused("velocity must return finite numbers of the shape", velocity=lambda x: x)
    particles = square()
    other = fem.Function(square().W)
    refused("velocity lives on another mesh", particles=particles, velocity=other)
    refused("rayleigh must be .alpha, beta., two numbers", rayleigh=0.1)
    refused("not negative", rayleigh=(0.1, -0.1))
    form = ufl.inner(particles.increment, ufl.TestFunction(particles.V)) * ufl.dx
    refused("form on the background has no past", particles=particles, background=form)
    problem = spinning()
    for call, sentence in (
        (lambda: problem.solve(time=-1.0, dt=0.1), "give a later time"),
        (lambda: problem.solve(time=1.0, dt=0.0), "dt must be positive"),
        (lambda: problem.solve(time=np.nan, dt=0.1), "time must be a finite number"),
        (lambda: problem.solve(time=1.0, dt=0.1, output_at=[2.0]), "later than the end"),
        (lambda: problem.solve(time=1.0, dt=0.1, output_at=3), "must be a list of times"),
        (lambda: problem.step(-0.1), "dt must be a positive number"),
    ):
        raises(call, mpm.MPMError, sentence)
    # A number of steps, as in a problem at rest, is not taken for a time.
    for go in (problem.solve, problem.steps):
        raises(
            lambda go=go: go(60, dt=0.01),
            TypeError,
            r"DynamicProblem\.(solve|steps)\(\) got too many arguments",
        )
        raises(lambda go=go: go(steps=60, dt=0.01), TypeError, "steps")
    assert problem.history.time == 0.0


def let_go(start=True, monkeypatch=None):
    """Return the problem of a column of sand that falls apart by backward Euler."""
    if not start:
        monkeypatch.setattr(Inertia, "start", Term.start)
    V = vectors(box([0.0, 0.0], [3.0, 1.5], [12, 6], QUADRILATERAL))
    particles = mpm.Particles(box([0.0, 0.0], [1.0, 1.0], [8, 8], TRIANGLE), V)
    bcs = [fix(V, at(1, 0.0)), fix(V, at(0, 0.0), component=0)]
    sand = mpm.materials.MohrCoulomb(1e6, 0.3, 1e3, 30.0, 30.0, volume_correction=True)
    problem = mpm.DynamicProblem(
        mpm.Body(
            particles,
            sand,
            density=2000.0,
            body_force=(0.0, -10.0),
            initial_stress=mpm.geostatic(1.0, 2000.0, 0.5, (0.0, -10.0)),
        ),
        bcs=bcs,
        scheme="euler",
    )
    problem.solve(time=0.25, dt=0.01)
    return problem


def test_the_start_by_velocity_saves_solves_and_keeps_the_answer(monkeypatch):
    # Associated flow has one answer, whatever Newton's method starts from.
    here = let_go()
    zero = let_go(False, monkeypatch)
    assert here.history.statistics["predictions"] > 0
    assert zero.history.statistics["predictions"] == 0
    assert sum(here.history.iterations) < 0.9 * sum(zero.history.iterations)
    ends = [in_order(p.particles, p.particles.centroid) for p in (here, zero)]
    assert ends[0][:, 0].max() > 1.0  # it was 0.96
    np.testing.assert_allclose(ends[0], ends[1], rtol=0.0, atol=1e-7)
