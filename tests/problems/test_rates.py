# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Laws whose stress depends on rates, in motions: time steps, restarts, ranks, stages."""

from mpi4py import MPI

import numpy as np
import pytest
from marks import slow
from posed import posed
from scenes import (
    HEXAHEDRON,
    QUADRILATERAL,
    TRIANGLE,
    WORLD,
    at,
    box,
    everywhere,
    fix,
    in_order,
    vectors,
)

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import MohrCoulomb, MuIRheology, Undrained, VonMises, mandel

STATIC, LIMIT, GRAIN, DENSITY, NUMBER = 0.5, 0.76, 0.02, 3.0, 0.279
LAW = MuIRheology(1e4, 0.3, STATIC, LIMIT, GRAIN, DENSITY, NUMBER)
LAGGING = MohrCoulomb(1e4, 0.3, 0.1, 30.0).with_softening(2.0, cohesion=0.05).with_relaxation(5e-3)


@pytest.mark.parametrize("scheme", ["midpoint", "euler"])
def test_a_sheared_block_has_the_friction_of_its_rate(scheme):
    """Shear at a given rate under a given pressure, in steps of which one is a tenth as long."""
    rate, pressure, dt = 5.0, 10.0, 2e-3
    V = vectors(box([-1.0, -1.0], [3.0, 2.0], [8, 6], QUADRILATERAL))
    particles = mpm.Particles(box([0.1, 0.1], [1.1, 1.1], [3, 3], QUADRILATERAL), V)
    bc, u = everywhere(V)
    stress = -pressure * np.eye(3)
    problem = mpm.DynamicProblem(
        mpm.Body(particles, LAW, density=2.0, initial_stress=stress), bcs=[bc], scheme=scheme
    )
    y = V.tabulate_dof_coordinates()[:, 1]

    def shear(time):
        u.x.array[::2] = rate * time * y

    inertial = GRAIN * rate / np.sqrt(pressure / DENSITY)
    expected = STATIC + (LIMIT - STATIC) * inertial / (NUMBER + inertial)
    frictions = []
    for _ in problem.steps(time=20 * dt, dt=dt, update=shear, output_at=[15.1 * dt]):
        found = mandel.to_vector(particles.stress, 2)
        np.testing.assert_allclose(-found[:, :3].mean(axis=1), pressure, rtol=1e-9)
        q = np.linalg.norm(mandel.deviator(found), axis=1) / np.sqrt(2.0)
        frictions.append(q / pressure)
    np.testing.assert_allclose(frictions[-8:], expected, rtol=2e-3)
    assert expected > STATIC + 0.03


def collapse(comm=WORLD, law=LAW, cell=TRIANGLE, particles=(), **options):
    """Return a column of grains that falls apart, in the plane or in space."""
    dim = 3 if cell == HEXAHEDRON else 2
    rows = slice(0, dim)
    ends = [3.0, 1.5, 0.25][rows], [1.0, 1.0, 0.25][rows]
    origin, down = [0.0] * dim, (0.0, -10.0, 0.0)[:dim]
    ground = HEXAHEDRON if dim == 3 else QUADRILATERAL
    V = vectors(box(origin, ends[0], [12, 6, 1][rows], ground, comm))
    body = box(origin, ends[1], [8, 8, 2][rows], cell, comm)
    bcs = [fix(V, at(0, 0.0), 0.0, 0), fix(V, at(1, 0.0))]
    if dim == 3:
        bcs.append(fix(V, at(2, 0.0, 0.25), 0.0, 2))
    return posed(
        mpm.DynamicProblem,
        mpm.Particles(body, V, **dict(particles)),
        law,
        density=2.0,
        body_force=down,
        bcs=bcs,
        initial_stress=mpm.geostatic(1.0, 2.0, 0.5, down),
        **{"scheme": "euler", "petsc_options": {"snes_rtol": 1e-12}, **options},
    )


def state_of(problem):
    """Return where the particles of a problem are, and how they are stressed, in their order."""
    particles = problem.particles
    return [in_order(particles, values) for values in (particles.centroid, particles.stress)]


@pytest.mark.parametrize(
    "given", [(LAGGING, "patch"), *slow((LAW, "none"), (LAW, "patch"), (LAGGING, "none"))]
)
def test_a_flow_goes_on_after_a_restart_and_on_other_ranks(tmp_path, given):
    law, f_bar = given
    path = WORLD.bcast(tmp_path) / "flow.ckpt"
    whole = collapse(law=law, f_bar=f_bar)
    for number, _ in enumerate(whole.steps(time=0.2, dt=0.02), 1):
        if number == 6:
            whole.save(path)
    restored = collapse(law=law, f_bar=f_bar)
    restored.restore(path)
    restored.solve(time=0.2, dt=0.02)
    alone = collapse(MPI.COMM_SELF, law, f_bar=f_bar)
    alone.solve(time=0.2, dt=0.02)
    for mine, again, single in zip(*map(state_of, (whole, restored, alone)), strict=True):
        np.testing.assert_array_equal(again, mine)
        np.testing.assert_allclose(mine, single, atol=1e-9 * np.abs(single).max())


def test_friction_by_rate_slows_the_flow_and_vanishes_with_the_grains():
    angle = float(np.degrees(np.arcsin(STATIC)))
    cone = mpm.materials.DruckerPrager(
        1e4, 0.3, 0.0, angle, match="plane_strain", volume_correction=True
    )
    coarse = LAW.with_parameters(grain_size=0.2)
    fine = LAW.with_parameters(grain_size=0.0)
    problems = [collapse(law=law) for law in (cone, fine, LAW, coarse)]
    for problem in problems:
        problem.solve(time=0.12, dt=0.02)
    centres = [np.concatenate(WORLD.allgather(p.particles.centroid[:, 0])) for p in problems]
    np.testing.assert_allclose(centres[1], centres[0], rtol=1e-7)
    assert centres[3].mean() < centres[2].mean() < centres[1].mean()


@pytest.mark.parametrize("law", [LAW, LAGGING])
def test_a_stage_leaves_the_stress_of_what_flows(law):
    problem = collapse(law=law)
    problem.solve(time=0.12, dt=0.02)
    before = problem.points[0].first_piola.copy()
    over = problem.points[0].last.yield_function()
    assert WORLD.allreduce(over.max(initial=0.0), MPI.MAX) > 0.1
    problem.stage(bodies=problem.body().replace(body_force=(1.0, -10.0)))
    np.testing.assert_allclose(
        problem.points[0].first_piola, before, atol=1e-12 * np.abs(before).max()
    )
    problem.solve(time=0.16, dt=0.02)


@pytest.mark.parametrize(
    "options",
    [
        {"f_bar": "patch"},
        *slow(
            {"mixed": "stabilised pressure"},
            {"scheme": "midpoint", "out_of_range": "reflect"},
            {"scheme": "conserving"},
            {"rayleigh": (0.1, 1e-4)},
            {"axisymmetric": True},
            {"cell": HEXAHEDRON},
            {"cell": QUADRILATERAL, "particles": {"method": "gimp"}},
            {"cell": QUADRILATERAL, "particles": {"on_distortion": "split"}},
        ),
    ],
    ids=str,
)
def test_friction_stays_between_its_ends_with(options):
    """With each option, and after a rebase and a move of all particles to other ranks."""
    problem = collapse(**{"petsc_options": {}, **options})
    for number, _ in enumerate(problem.steps(time=0.1, dt=0.02)):
        points = problem.points[0]
        pressure = -points.last.mean_stress()
        over = points.last.yield_function().ravel()
        assert (over <= (LIMIT - STATIC) * pressure * (1.0 + 1e-9) + 1e-9).all()
        if number == 2 and options.get("particles", {}).get("method") != "gimp":
            problem.rebase()
        if number == 3:
            problem.repartition(0.0)
    assert problem.history.stopped is None


def moving(particles, bc, law):
    return mpm.DynamicProblem(mpm.Body(particles, law, density=2.0), bcs=[bc], scheme="euler")


def dry(particles, bc, law):
    return mpm.PorousProblem(mpm.Body(particles, law), bcs=[bc])


def drained(particles, bc, law):
    fluid = mpm.PoreFluid(1e9, drained=[(0.0, 1)])
    tags = mpm.facet_tags(particles.mesh, {1: lambda x: x[0] < 9.0})
    made = mpm.Body(particles, law, pore_fluid=fluid, facet_tags=tags)
    return mpm.PorousProblem(made, bcs=[bc])


@pytest.mark.parametrize(
    ("problem_of", "law"),
    [(moving, "plain"), (moving, "undrained"), (dry, "plain"), (drained, "plain")],
)
def test_stress_beyond_yield_relaxes_with_the_time_of_steps(problem_of, law):
    """A block that is sheared at once and held, in steps of two durations."""
    time, strain, modulus, strength = 0.1, 0.01, 1e3 / 2.6, 2.0
    lagging = VonMises(1e3, 0.3, rho_y=np.sqrt(2.0) * strength).with_relaxation(time)
    lagging = Undrained(lagging, 1e3) if law == "undrained" else lagging
    V = vectors(box([-1.0, -1.0], [3.0, 2.0], [8, 6], QUADRILATERAL), 2)
    body = box([0.1, 0.1], [1.1, 1.1], [3, 3], QUADRILATERAL)
    particles = mpm.Particles(body, V, degree=2, quadrature_degree=4)
    bc, u = everywhere(V)
    problem = problem_of(particles, bc, lagging)
    y = V.tabulate_dof_coordinates()[:, 1]

    def shear(now):
        u.x.array[::2] = strain * y * (now > 0.0)

    expected = modulus * strain
    ends = np.cumsum([0.02, 0.02, 0.02, 0.1, 0.1])
    for end, step in zip(
        ends, problem.steps(time=ends[-1], dt=1.0, update=shear, output_at=ends[:-1]), strict=True
    ):
        assert abs(step.time - end) < 1e-12
        dt = 0.02 if end < 0.07 else 0.1
        expected = strength + (expected - strength) / (1.0 + dt / time)
        np.testing.assert_allclose(particles.stress[:, 0, 1], expected, rtol=1e-3)
    assert problem.points[0].last.states[0]["plastic_strain"].min(initial=1.0) > 0.0


def test_a_law_that_needs_time_is_refused_where_there_is_none():
    body = box([0.1, 0.1], [1.1, 1.1], [3, 3], QUADRILATERAL)
    lagging = VonMises(1e3, 0.3, rho_y=1.0).with_relaxation(1.0)
    particles = mpm.Particles(body)
    bcs = [mpm.held(particles.W, y=0.1)]
    for law in (lagging, Undrained(lagging, 1e3)):
        with pytest.raises(mpm.MPMError, match="relaxation_time needs steps with a duration"):
            mpm.QuasiStaticProblem(mpm.Body(particles, law), bcs=bcs)
    plain = VonMises(1e3, 0.3, rho_y=1.0)
    problem = mpm.QuasiStaticProblem(mpm.Body(particles, plain), bcs=bcs)
    with pytest.raises(mpm.MPMError, match="relaxation_time needs steps with a duration"):
        problem.stage(bodies=problem.body().replace(material=lagging))
    problem.solve(1)
    motion = mpm.DynamicProblem(mpm.Body(particles, lagging, density=1.0), bcs=bcs, after=problem)
    motion.solve(time=0.1, dt=0.1)


@pytest.mark.parametrize(
    "options",
    [
        {"f_bar": "patch"},
        *slow(
            {"mixed": "stabilised pressure"},
            {"scheme": "conserving"},
            {"scheme": "midpoint"},
            {"rayleigh": (0.1, 1e-4)},
            {"axisymmetric": True},
            {"cell": HEXAHEDRON},
            {"length": 0.3},
        ),
    ],
    ids=str,
)
def test_a_lagging_column_runs_with(options):
    """With each option, and after a rebase and a move of all particles to other ranks."""
    problem = collapse(**{"law": LAGGING, "petsc_options": {}, **options})
    for number, _ in enumerate(problem.steps(time=0.1, dt=0.02)):
        if number == 2 and "length" not in options:
            problem.rebase()
        if number == 3:
            problem.repartition(0.0)
    assert problem.history.stopped is None
    assert WORLD.allreduce(problem.particles.plastic_strain.max(initial=0.0), MPI.MAX) > 0.0
