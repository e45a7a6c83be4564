# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Steps of problems of any kind that a user's code ends on one rank: all is as it was before."""

import json

import numpy as np
import pytest
import scenes
from compare import same_run
from marks import slow
from posed import posed
from scenes import QUADRILATERAL, WORLD

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import contact
from mpm_dolfinx.materials import Fracture, Hencky, NeoHooke, VonMises

TIGHT = {"snes_rtol": 1e-12}
#: What tells of attempts, also of those that fail.
COUNTS = ("statistics", "failed_iterations", "cutbacks", "taken_back", "run")
LAST = WORLD.rank == WORLD.size - 1


class Interrupts(mpm.Term):
    """A user's term that ends a step from one of its evaluations on, on one rank."""

    def __init__(self, bodies):
        super().__init__(bodies)
        self.kind, self.left = None, 0

    def update(self):
        self.left -= 1
        if self.kind is not None and self.left <= 0 and LAST:
            raise self.kind("enough")


def body(degree=1, low=0.0, V=None, **options):
    """Return a unit square that is cut by the cells of its background."""
    if V is None:
        V = scenes.vectors(
            scenes.box([-0.6, low - 0.4], [1.8, low + 1.6], [6, 5], QUADRILATERAL), degree
        )
    mesh = scenes.box([0.0, low], [1.0, low + 1.0], [4, 4], QUADRILATERAL)
    return mpm.Particles(mesh, V, degree=degree, **options)


def held(particles, where=lambda x: x[1] < 0.01, value=None):
    """Return a condition on the nodes of the background in some place, those at the base."""
    V = particles.V
    dofs = fem.locate_dofs_geometrical(V, where)
    return fem.dirichletbc(np.zeros(2) if value is None else value, dofs, V)


def loaded(problem, load):
    """Take a step to a load."""
    for particles in problem.bodies:
        particles.load.value = load
    problem.step()


def in_ufl(terms):
    p = body()
    R = ufl.derivative(scenes.neo_hookean(p.displacement, 1e3) * p.dx, p.displacement)
    R -= p.load * ufl.inner(ufl.as_vector((20.0, -60.0)), ufl.TestFunction(p.W)) * p.dx_exact
    problem = mpm.ParticleProblem(
        R, p, bcs=[held(p)], terms=terms([p]), solver=mpm.Solver(petsc_options=TIGHT)
    )
    return problem, loaded


def with_temperature(terms):
    p = body()
    T = mpm.ParticleField(
        p, fem.functionspace(p.V.mesh, ("Lagrange", 1)), at="nodes", name="temperature"
    )
    T.interpolate(lambda x: 1.0 + x[0])
    T.previous.x.array[:] = T.x.array
    S, dx = ufl.TestFunction(T.W), p.dx
    grown = 1e3 * 0.01 * T * ufl.div(ufl.TestFunction(p.W)) * dx
    R = ufl.derivative(scenes.neo_hookean(p.displacement, 1e3) * dx, p.displacement) - grown
    R -= p.load * ufl.inner(ufl.as_vector((20.0, -60.0)), ufl.TestFunction(p.W)) * p.dx_exact
    heat = ((T - T.previous) * S + 0.05 * ufl.inner(ufl.grad(T), ufl.grad(S))) * dx
    problem = mpm.ParticleProblem(
        [R, heat],
        p,
        bcs=[held(p)],
        fields=[T],
        terms=terms([p]),
        solver=mpm.Solver(petsc_options=TIGHT),
    )
    return problem, loaded


def of_materials(terms, **options):
    p = body(2 if "mixed" in options else 1)
    law = VonMises(1e3, 0.3, rho_y=8.0, hardening=200.0)
    problem = posed(
        mpm.QuasiStaticProblem,
        p,
        law,
        body_force=(4.0, -16.0),
        bcs=[held(p)],
        terms=terms([p]),
        petsc_options=TIGHT,
        **options,
    )
    return problem, loaded


def of_law(terms, law, particles=None, load=(4.0, -16.0), **options):
    p = body(quadrature_degree=2, **(particles or {}))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(p, law, body_force=load, **options),
        bcs=[held(p)],
        terms=terms([p]),
        solver=mpm.Solver(petsc_options=TIGHT),
    )
    return problem, loaded


def with_free_nodes(terms):
    return of_law(terms, NeoHooke(1e2, 0.3), {"free": "auto"}, (12.0, -50.0))


def cracking(terms):
    return of_law(terms, Fracture(Hencky(1e3, 0.3), 0.05, 0.4, model="AT2"), load=(2.0, -6.0))


def softening(terms):
    law = VonMises(1e3, 0.3, rho_y=5.5, hardening=100.0).with_softening(20.0, residual=0.9)
    return of_law(terms, law, length=0.3)


def with_water(terms):
    p = body(2)
    problem = mpm.PorousProblem(
        mpm.Body(
            p,
            Hencky(1e3, 0.3),
            body_force=(1.0, -10.0),
            facet_tags=scenes.facet_tags(p.mesh, scenes.at(1, 1.0)),
            pore_fluid=mpm.PoreFluid(0.02, density=1.0, drained=[(0.1, 1)]),
        ),
        bcs=[held(p)],
        terms=terms([p]),
        solver=mpm.Solver(petsc_options=TIGHT),
    )
    return problem, lambda problem, _: problem.step(0.1)


def on_an_obstacle(terms):
    p = body()
    die = contact.Rigid(p, contact.disc((0.5, 1.51), 0.5), 0.4)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(p, Hencky(1e3, 0.3)),
        bcs=[held(p)],
        terms=[die, *terms([p])],
        solver=mpm.Solver(petsc_options=TIGHT),
    )

    def step(problem, load):
        die.move((0.1 * load, -0.15 * load))
        problem.step()

    return problem, step


def in_motion(terms):
    p = body()
    ball = contact.RigidBody(
        p, contact.disc((0.5, 1.36), 0.35), 0.2, inertia=0.01, friction=0.4, velocity=(0.3, -2.0)
    )
    problem = mpm.DynamicProblem(
        mpm.Body(p, VonMises(1e2, 0.3, rho_y=2.0), density=1.0),
        scheme="conserving",
        bcs=[held(p)],
        terms=[ball, *terms([p])],
        solver=mpm.Solver(petsc_options=TIGHT),
    )
    return problem, lambda problem, _: problem.step(0.02)


def of_a_pair(terms):
    grid = scenes.box([-0.6, -0.4], [1.8, 2.8], [6, 8], QUADRILATERAL)
    lower, upper = (body(low=low, V=scenes.vectors(grid)) for low in (0.0, 1.0))
    motion = fem.Constant(grid, np.zeros(2))
    problem = mpm.QuasiStaticProblem(
        [mpm.Body(p, Hencky(1e3, 0.3)) for p in (lower, upper)],
        bcs=[held(lower), held(upper, lambda x: x[1] > 1.9, motion)],
        terms=[contact.Pair(lower, upper, 0.3), *terms([lower, upper])],
        solver=mpm.Solver(petsc_options=TIGHT),
    )

    def step(problem, load):
        motion.value[:] = (0.05 * load, -0.04 * load)
        problem.step()

    return problem, step


KINDS = {
    "UFL": in_ufl,
    "temperature": with_temperature,
    "plastic": of_materials,
    "pressure": lambda terms: of_materials(terms, mixed="pressure"),
    "F-bar": lambda terms: of_materials(terms, f_bar="patch"),
    "free nodes": with_free_nodes,
    "fracture": cracking,
    "softening": softening,
    "water table": lambda terms: of_law(
        terms, Hencky(1e3, 0.3), pore_pressure=mpm.WaterTable(0.7, 10.0)
    ),
    "water": with_water,
    "obstacle": on_an_obstacle,
    "motion": in_motion,
    "pair": of_a_pair,
}


def captured(problem):
    """Return all that a checkpoint would hold, but for what tells of attempts and was asked for."""
    snapshot = problem.state.capture()
    arrays = {
        f"{number} {name}": np.array(values)
        for number, table in enumerate(snapshot.tables)
        for name, values in table.columns.items()
    }
    asked = ("aim", "push")
    numbers = {
        name: value
        for name, value in snapshot.numbers.items()
        if name not in COUNTS and not name.endswith(asked)
    }
    return json.dumps(numbers, sort_keys=True), arrays


@pytest.mark.parametrize("kind", [KeyboardInterrupt, *slow(ZeroDivisionError)])
@pytest.mark.parametrize("name", KINDS)
def test_an_interrupted_step_leaves_all_as_it_was(name, kind):
    ends = Interrupts(())
    problem, step = KINDS[name](lambda bodies: [ends])
    step(problem, 0.5)
    before = captured(problem)
    positions = [particles.displacement.x.array.copy() for particles in problem.bodies]
    for number in (1, 2, 4):
        ends.kind, ends.left = kind, number
        with pytest.raises((kind, mpm.MPMError)):
            step(problem, 1.0)
        ends.kind = None
        for particles, values in zip(problem.bodies, positions, strict=True):
            assert np.array_equal(particles.displacement.x.array, values)
        numbers, arrays = captured(problem)
        assert numbers == before[0]
        scenes.assert_same_state(before[1], arrays)
    step(problem, 1.0)
    other, again = KINDS[name](lambda bodies: [])
    again(other, 0.5)
    again(other, 1.0)
    ours, theirs = (
        {str(i): scenes.in_order(p, p.domains) for i, p in enumerate(each.bodies)}
        for each in (problem, other)
    )
    same_run(ours, theirs, 1e-9)
    moved = max(scenes.largest(p.displacement.x.array) for p in problem.bodies)
    assert moved > 1e-3
