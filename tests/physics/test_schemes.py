# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Time schemes of users: each is one class."""

import numpy as np
import pytest
from compare import EXACT, raises
from marks import slow, thinned
from obstacles import wall
from own_schemes import BDF2, Theta
from posed import posed
from scenes import QUADRILATERAL, WORLD, anywhere, box, in_order, largest, vectors

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import LinearElastic, VonMises
from mpm_dolfinx.meshes.redistribution import Redistribution


def bar(scheme):
    """Return a bar whose first mode swings with the amplitude 0.1 while it flies with 0.37."""
    V = vectors(box([0.0, 0.0], [2.5, 3 / 32], [80, 3], QUADRILATERAL))
    particles = mpm.Particles(box([0.3, 1 / 32], [1.3, 2 / 32], [64, 2], QUADRILATERAL), V)

    def velocity(x):
        return np.stack([0.37 + 0.1 * np.pi * np.cos(np.pi * (x[0] - 0.3)), 0.0 * x[0]])

    law = LinearElastic(1.0, 0.0)
    return mpm.DynamicProblem(
        mpm.Body(particles, law, density=1.0, velocity=velocity),
        scheme=scheme,
        solver=mpm.Solver(petsc_options={"snes_rtol": 1e-12}),
    )


def error_of(problem):
    """Return the error of displacement, relative to the amplitude."""
    particles, t = problem.particles, problem.history.time
    x = particles.W.tabulate_dof_coordinates()[:, 0] - 0.3
    exact = 0.37 * t + 0.1 * np.sin(np.pi * t) * np.cos(np.pi * x)
    return largest(particles.displacement.x.array.reshape(-1, 2)[:, 0] - exact) / 0.1


def change_of_balance(problem):
    balances = np.array([energy.balance for energy in problem.history.energies])
    return np.ptp(balances) / problem.history.energies[0].kinetic


@pytest.mark.parametrize("uneven", [*slow(False), True])
def test_bdf2_is_of_second_order_and_its_account_closes(uneven):
    errors = []
    for steps in (36, 72):
        problem = bar(BDF2())
        ends = np.linspace(0.0, 2.25, steps + 1)[1:]
        if uneven:
            ends[:-1:2] -= 0.3 * 2.25 / steps
        for duration in np.diff(ends, prepend=0.0):
            problem.step(duration)
        assert len(problem.history.steps) == steps
        assert change_of_balance(problem) < 1e-13
        errors.append(error_of(problem))
    assert 1.95 < np.log2(errors[0] / errors[1]) < 2.1
    euler = bar("euler")
    euler.solve(time=2.25, dt=2.25 / 72)
    assert errors[1] < 0.1 * error_of(euler)


def bouncing(scheme, on_plane=True, terms=(), **options):
    """Return a square that spins, falls (on a plane) and yields."""
    V = vectors(box([0.0, 0.0], [3.0, 3.0], [12, 12], QUADRILATERAL))
    particles = mpm.Particles(box([1.03, 1.01], [2.03, 2.01], [8, 8], QUADRILATERAL), V)
    floor = [wall(particles, (0.0, 0.95), (0.0, 1.0))] if on_plane else []
    return posed(
        mpm.DynamicProblem,
        particles,
        VonMises(100.0, 0.3, rho_y=3.0),
        2.0,
        velocity=lambda x: np.stack([-(x[1] - 1.51), x[0] - 1.53 - 1.0]),
        body_force=(0.0, -1.0),
        terms=[*floor, *terms],
        scheme=scheme,
        petsc_options={"snes_rtol": 1e-12},
        **options,
    )


def run_of(problem):
    """Return what a run gives, in an order that ranks do not change."""
    (body,) = problem.bodies
    n = body.num_local
    velocity = problem.velocity.x.array.reshape(-1, 2)[body.domain_nodes]
    energies = [list(vars(energy).values()) for energy in problem.history.energies]
    return [
        in_order(body, body.domains.reshape(n, -1)),
        in_order(body, velocity.reshape(n, -1)),
        in_order(body, body.stress.reshape(n, -1)),
        np.array(energies),
    ]


def require_same(one, other, tolerance):
    for values, expected in zip(run_of(one), run_of(other), strict=True):
        size = np.abs(expected).max()
        np.testing.assert_allclose(values, expected, rtol=0.0, atol=tolerance * size)


@pytest.mark.parametrize(
    ("options", "share", "known"),
    thinned(
        4,
        [
            (options, *scheme)
            for options in ({"f_bar": "patch"}, {}, {"mixed": "stabilised pressure"})
            for scheme in ((0.5, "midpoint"), (1.0, "euler"), (0.6, None))
        ],
    ),
)
def test_a_family_of_schemes_has_midpoint_and_euler_at_its_ends(options, share, known):
    found = bouncing(Theta(share), rayleigh=(0.1, 1e-3), **options)
    found.solve(time=0.21, dt=0.03)
    contact = [energy.internal for energy in found.history.energies]
    assert change_of_balance(found) < 1e-9
    assert max(contact) > 0.01 * found.history.energies[0].kinetic
    if known is not None:
        same = bouncing(known, rayleigh=(0.1, 1e-3), **options)
        same.solve(time=0.21, dt=0.03)
        require_same(found, same, 1e-8)


def test_what_a_scheme_keeps_is_restored_bit_for_bit(tmp_path):
    path = WORLD.bcast(tmp_path) / "run.ckpt"
    whole = bouncing(BDF2())
    for _ in whole.steps(time=0.3, dt=0.03):
        if len(whole.history.steps) == 5:
            whole.save(path)
    restored = bouncing(BDF2())
    restored.restore(path)
    restored.solve(time=0.3, dt=0.03)
    require_same(restored, whole, EXACT)
    sentence = "was made with scheme='bdf2', out_of_range='project', and this problem with 'euler'"
    raises(lambda: bouncing("euler").restore(path), mpm.MPMError, sentence)


def test_what_a_scheme_keeps_goes_with_bodies_to_other_ranks_and_meshes():
    there, moving = bouncing(BDF2(), False), bouncing(BDF2(), False)
    there.solve(time=0.2, dt=0.02)
    for number, _ in enumerate(moving.steps(time=0.2, dt=0.02)):
        mesh = moving.particles.mesh
        move = Redistribution(mesh, anywhere(mesh, number))
        moving.state.renew(lambda move=move: moving.particles.live_on(move), lambda state: state)
    require_same(moving, there, 1e-9)

    flying = bar(BDF2())
    flying.inertia.velocities[0].x.array[:] = np.tile(
        [0.37, 0.0], len(flying.velocity.x.array) // 2
    )
    for number in range(6):
        if number == 3:
            flying.split([0, 1, 40])
        flying.step(0.05)
    moved = flying.particles.displacement.x.array.reshape(-1, 2) - [0.37 * 0.3, 0.0]
    assert largest(moved) < 1e-12


def test_a_step_that_fails_leaves_nothing_in_what_a_scheme_keeps():
    class Fails(mpm.Term):
        refuses = False

        def commit(self):
            if self.refuses:
                raise mpm.MPMError("It cannot be")

    term, plain = Fails(), bouncing(BDF2())
    problem = bouncing(BDF2(), terms=[term])
    for number in range(6):
        plain.step(0.03)
        if number == 3:
            term.refuses = True
            raises(lambda: problem.step(0.03), mpm.MPMError, "It cannot be")
            term.refuses = False
        problem.step(0.03)
    require_same(problem, plain, 1e-12)


def test_schemes_that_cannot_be_are_refused():
    class Whole(Theta):
        stress_of_step = True

    choices = "choose one of midpoint, conserving, euler, or give an mpm.Scheme"
    for scheme, sentence in (
        ("newmark", f"Unknown scheme='newmark'; {choices}"),
        (BDF2, choices),
        (Theta(0.3), "Theta.share must be from 0.5 to 1"),
        (Whole(1.0), "Whole.share must be from 0.5 to 1, and 0.5 with a stress of the whole step"),
    ):
        raises(lambda scheme=scheme: bar(scheme), mpm.MPMError, sentence)
    raises(lambda: bouncing(BDF2(), out_of_range="reflect"), mpm.MPMError, "make this one reflect")

    def own(**members):
        return type("Own", (BDF2,), members)()

    for scheme, sentence in (
        (own(name=None), "Own.name must be a word of its own"),
        (own(name="euler"), "Own.name must be a word of its own"),
        (own(share="half"), "Own.share must be from 0.5 to 1"),
        (own(keeps="increment"), "Own.keeps must be a tuple of names"),
        (own(keeps=("a", "a")), "Own.keeps must be a tuple of names"),
        (own(stress_of_step=0.5), "Own.stress_of_step must be True or False"),
        (own(__init__=lambda self: None), r"Own.__init__ must call super\(\)"),
    ):
        raises(lambda scheme=scheme: bar(scheme), mpm.MPMError, sentence)
    for rates, sentence in (
        (lambda self, dt, last: None, "Own.rates must return mpm.Rates"),
        (lambda self, dt, last: 1 / 0, "Own.rates.* failed with ZeroDivisionError"),
    ):
        scheme = own(rates=rates)
        raises(lambda scheme=scheme: bar(scheme).step(0.1), mpm.MPMError, sentence)

    class Short(Theta):
        keeps = ("increment",)

    raises(
        lambda: bar(Short(1.0)).step(0.1),
        mpm.MPMError,
        "Short.rates must return 4 rows of 3 finite numbers",
    )
