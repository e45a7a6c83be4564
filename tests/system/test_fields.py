# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bodies on backgrounds of their own: fields of one problem."""

from petsc4py import PETSc

import numpy as np
import pytest
import scenes
from posed import posed
from scenes import QUADRILATERAL, TRIANGLE

import ufl

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, VonMises

#: Small residuals, so that the number of Newton steps is no difference.
OPTIONS = {"petsc_options": {"snes_rtol": 1e-14}}


def pillar(at, h, degree, cell, **options):
    """Return a pillar that stands on the ground, on a background of its own, and its condition."""
    n = round(2.0 / h)
    V = scenes.vectors(scenes.box([at - 0.5, 0.0], [at + 1.5, 2.0], [n, n], QUADRILATERAL), degree)
    body = scenes.box([at, 0.0], [at + 1.0, 1.5], [n, round(1.5 * n)], cell)
    particles = mpm.Particles(body, V, degree=degree, **options)
    return particles, scenes.fix(V, scenes.at(1, 0.0))


def left():
    return pillar(0.0, 0.25, 1, TRIANGLE)


def right():
    return pillar(10.0, 0.5, 2, QUADRILATERAL)


def state(problem, particles, bc):
    """Return what a run gives a body, in an order that ranks do not change."""
    n = particles.num_local
    return {
        "positions": scenes.in_order(particles, particles.domains.reshape(n, -1)),
        "stress": scenes.in_order(particles, particles.stress.reshape(n, -1)),
        "plastic strain": scenes.in_order(particles, particles.plastic_strain),
        "reaction": problem.reaction(bc),
    }


def require_same(one, other, tolerance=1e-12):
    for name, values in one.items():
        assert np.abs(other[name] - values).max() <= tolerance * np.abs(values).max(), name


def alone(make, law, density, **options):
    particles, bc = make()
    problem = posed(
        mpm.QuasiStaticProblem,
        particles,
        law,
        density=density,
        body_force=(2.0, -10.0),
        bcs=[bc],
        **OPTIONS,
        **options,
    )
    return problem, [(particles, bc)]


def together(laws, densities, makes=(left, right), **options):
    pairs = [make() for make in makes]
    problem = posed(
        mpm.QuasiStaticProblem,
        [particles for particles, _ in pairs],
        laws,
        density=densities,
        body_force=(2.0, -10.0),
        bcs=[bc for _, bc in pairs],
        **OPTIONS,
        **options,
    )
    return problem, pairs


#: Clay that flows, and a body that is lighter and stiffer.
LAWS = [VonMises(1e4, 0.3, 16.0), Hencky(2e5, 0.2)]
DENSITIES = [2.0, 0.05]


def require_each_as_alone(problem, pairs, run, densities=DENSITIES, **options):
    """Compare each body with a problem of its own."""
    for make, law, density, pair in zip((left, right), LAWS, densities, pairs, strict=True):
        single, ((particles, bc),) = alone(make, law, density, **options)
        run(single, [bc])
        require_same(state(single, particles, bc), state(problem, *pair))


def load(problem, bcs):
    problem.solve(steps=3)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"route": "reference"},
        {"stabilisation": "ghost"},
        {"predictor": False, "line_search": False},
    ],
    ids=["loops", "reference", "ghost", "plain"],
)
def test_bodies_on_backgrounds_of_their_own_do_not_know_of_each_other(options, take):
    options = dict(options)
    take(options.pop("route", "loops"))
    problem, pairs = together(LAWS, DENSITIES, **options)
    load(problem, problem.bcs)
    assert [field.bodies for field in problem.reduced.fields] == [[body] for body, _ in pairs]
    assert scenes.largest(pairs[0][0].plastic_strain) > 1e-3
    require_each_as_alone(problem, pairs, load, **options)


def test_the_same_space_is_one_field():
    V = scenes.vectors(scenes.box([0.0, 0.0], [4.0, 2.0], [8, 4], QUADRILATERAL))
    bodies = [
        mpm.Particles(scenes.box([x, 0.0], [x + 1.0, 1.0], [4, 4], TRIANGLE), V) for x in (0.0, 2.0)
    ]
    problem = posed(
        mpm.QuasiStaticProblem, bodies, Hencky(1e3, 0.3), bcs=[scenes.fix(V, scenes.at(1, 0))]
    )
    (field,) = problem.reduced.fields
    assert field.bodies == bodies and field.V is V


def test_conditions_move_each_field_by_itself():
    def lift(problem, bcs):
        for height in (0.01, 0.02):
            for bc in bcs:
                bc.g.value[:] = (0.0, height)
            for body in problem.bodies:
                body.load.value = 1.0
            problem.step()

    problem, pairs = together(LAWS, [2.0, 5.0])
    lift(problem, problem.bcs)
    require_each_as_alone(problem, pairs, lift, densities=[2.0, 5.0])


def test_each_field_converges_by_itself():
    # A body whose forces are small beside those of another is solved as exactly as that.
    problem, pairs = together(LAWS, [1e-9, 0.05])
    problem.solve(steps=1)
    single, ((particles, bc),) = alone(left, LAWS[0], 1e-9)
    single.solve(steps=1)
    require_same(state(single, particles, bc), state(problem, *pairs[0]), 1e-9)


def test_checkpoint_of_two_fields(tmp_path):
    path = scenes.WORLD.bcast(tmp_path) / "two.h5"
    problem, pairs = together(LAWS, DENSITIES)
    for number, _ in enumerate(problem.steps(3)):
        if number == 0:
            problem.save(path)
    again, others = together(LAWS, DENSITIES)
    again.restore(path)
    again.solve(steps=3)
    for pair, other in zip(pairs, others, strict=True):
        require_same(state(problem, *pair), state(again, *other), 1e-13)
    require_each_as_alone(again, others, load)
    swapped, _ = together(LAWS[::-1], DENSITIES[::-1], makes=(right, left))
    with pytest.raises(mpm.MPMError, match="of another problem"):
        swapped.restore(path)


def test_particles_of_two_fields_move_to_other_ranks():
    problem, pairs = together(LAWS, DENSITIES)
    for _ in problem.steps(3):
        problem.repartition(0.0)
    require_each_as_alone(problem, pairs, load)


def test_displacement_control_of_one_of_two_fields():
    problem, pairs = together([Hencky(1e4, 0.3), Hencky(2e5, 0.2)], DENSITIES)
    control = mpm.DisplacementControl(pairs[0][0], -1.5e-3, (0.5, 1.5), (0.0, 1.0))
    problem.solve(steps=2, control=control)
    single, ((particles, bc),) = alone(left, Hencky(1e4, 0.3), 2.0)
    control = mpm.DisplacementControl(particles, -1.5e-3, (0.5, 1.5), (0.0, 1.0))
    single.solve(steps=2, control=control)
    assert 0.0 < single.history.steps[-1].load < 1.0
    assert problem.history.steps[-1].load == pytest.approx(single.history.steps[-1].load, rel=1e-9)
    require_same(state(single, particles, bc), state(problem, *pairs[0]), 1e-9)


def test_what_fails_is_told_with_its_background():
    problem, (_, (soft, _)) = together([Hencky(1e4, 0.3), Hencky(1.0, 0.2)], DENSITIES[::-1])
    problem.solver.setTolerances(max_it=1)
    for body in problem.bodies:
        body.load.value = 1.0
    with pytest.raises(mpm.ConvergenceError, match="of the V of background 1 near") as caught:
        problem.step()
    soft_index = set(range(soft.num_global))
    assert caught.value.particles and soft_index.issuperset(caught.value.particles)


def test_bodies_of_one_problem_share_space_and_ranks():
    (plane, _) = left()
    V = scenes.vectors(scenes.unit(2, scenes.HEXAHEDRON))
    solid = mpm.Particles(scenes.unit(4, scenes.HEXAHEDRON), V)
    with pytest.raises(mpm.MPMError, match="same dimension"):
        mpm.QuasiStaticProblem([mpm.Body(p, Hencky(1e3, 0.3)) for p in (plane, solid)])


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"route": "reference"},
        {"background": True},
        {"f_bar": "patch"},
        {"f_bar": "patch", "route": "reference"},
    ],
    ids=["loops", "reference", "background", "patch", "patch by reference"],
)
def test_the_tangent_is_one_object_within_a_step(options, take):
    options = dict(options)
    take(options.pop("route", "loops"))
    # Its factor keeps the ordering then.
    pairs = [left(), right()]
    bodies = [particles for particles, _ in pairs]
    if "background" in options:
        drag = [
            10.0 * ufl.inner(p.increment, ufl.TestFunction(p.V)) * (1.0 + p.increment[0]) * ufl.dx
            + ufl.inner(p.increment, ufl.TestFunction(p.V))
            * ufl.dx(metadata={"quadrature_degree": 1})
            for p in bodies
        ]
        options = {"background": drag}
    bcs = [bc for _, bc in pairs]
    problem = posed(mpm.QuasiStaticProblem, bodies, LAWS[1], bcs=bcs, **options)
    system = problem.reduced
    system.begin([np.zeros(len(p.increment.x.array)) for p in bodies], 1.0)
    x = PETSc.Vec().createMPI(system.unknowns.sizes, comm=scenes.WORLD)
    found = []
    for size in (0.0, 1e-3):
        x.array_w[:] = size * np.sin(np.arange(system.unknowns.sizes[0]))
        assert system.residual(x, x.duplicate()) is None
        found.append((system.tangent(), system.tangent().copy()))
    assert found[0][0] is found[1][0]
    found[1][1].axpy(-1.0, found[0][1])
    assert found[1][1].norm() > 0.0


def test_terms_on_the_background_of_each_field():
    def draggy(pairs, law, densities):
        forms = [50.0 * ufl.inner(p.increment, ufl.TestFunction(p.V)) * ufl.dx for p, _ in pairs]
        return posed(
            mpm.QuasiStaticProblem,
            [p for p, _ in pairs],
            law,
            density=densities,
            body_force=(2.0, -10.0),
            bcs=[bc for _, bc in pairs],
            background=forms,
            **OPTIONS,
        )

    pairs = [left(), right()]
    problem = draggy(pairs, LAWS, DENSITIES)
    problem.solve(steps=2)
    for make, law, density, pair in zip((left, right), LAWS, DENSITIES, pairs, strict=True):
        single = draggy([other := make()], [law], [density])
        single.solve(steps=2)
        require_same(state(single, *other), state(problem, *pair))
