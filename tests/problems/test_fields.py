# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Several unknowns on a body, against stock finite elements, differences and themselves."""

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from bad_input import body, held_background
from compare import EXACT, error_of_blocks, outcome, raises, same_run
from posed import posed
from scenes import QUADRILATERAL, TRIANGLE, WORLD
from stock import held, mixed_space, newton, same_values

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.solvers import linear

TIGHT = {"snes_rtol": 1e-12}
# A body that fills its background leaves it in the last step, which is a warning.
leaves = pytest.mark.filterwarnings("ignore:The run is complete")


def scalars(domain, degree=1):
    return fem.functionspace(domain, ("Lagrange", degree))


def beam(cell):
    return scenes.shear(scenes.bend(scenes.unit(4, cell), 0.03), ((2.0, 0.0), (0.0, 1.0)))


def potential(d, p, bulk):
    """Return the energy of a neo-Hookean body with a pressure as its own unknown."""
    F = ufl.Identity(2) + ufl.grad(d)
    J = ufl.det(F)
    shear = 10.0 / 2 * ((ufl.tr(F.T * F) + 1.0) * J ** (-2.0 / 3.0) - 3.0)
    return shear + p * ufl.ln(J) - p**2 / (2.0 * bulk)


def taylor_hood(cell, fields=("nodes",), bulk=1e6, degree=2, **options):
    """Return a problem of a nearly incompressible beam that bends, particles being cells."""
    particles = mpm.Particles(beam(cell), scenes.vectors(beam(cell), degree), degree=degree)
    V_p = scalars(particles.V.mesh, degree - 1)
    p = mpm.ParticleField(particles, V_p, at=fields[0], name="pressure")
    d, v, q = particles.displacement, ufl.TestFunction(particles.W), ufl.TestFunction(p.W)
    dx = particles.dx
    psi = potential(d, p, bulk) * dx
    load = particles.load * 0.3 * v[1] * particles.dx_exact
    R = [ufl.derivative(psi, d, v) - load, ufl.derivative(psi, p, q)]
    bcs = [scenes.fix(particles.V, scenes.at(0, 0.0))]
    options = {"stabilisation": None, "symmetric": True} | options
    problem = posed(mpm.ParticleProblem, R, particles, bcs=bcs, fields=[p], **options)
    return problem, p


@leaves
@pytest.mark.parametrize("cell", [TRIANGLE, QUADRILATERAL], ids=scenes.name)
def test_taylor_hood_against_stock_finite_elements(cell):
    problem, p = taylor_hood(cell, petsc_options=TIGHT)
    problem.solve(steps=1)
    domain = beam(cell)
    W = mixed_space(domain, 2, 1)
    w = fem.Function(W)
    d, pressure = ufl.split(w)
    degree = problem.particles.dx.metadata()["quadrature_degree"]
    dx = ufl.dx(domain, metadata={"quadrature_degree": degree})
    v, _ = ufl.split(ufl.TestFunction(W))
    F = ufl.derivative(potential(d, pressure, 1e6) * dx, w, ufl.TestFunction(W))
    newton(F - 0.3 * v[1] * dx, w, [held(W, 0, scenes.at(0, 0.0))])
    same_values(problem.particles.displacement, w.sub(0).collapse())
    same_values(p, w.sub(1).collapse())
    assert np.array_equal(p.previous.x.array, p.x.array)
    domain = problem.particles.mesh
    mean = fem.assemble_scalar(fem.form(p * problem.particles.dx))
    shown = problem.particles.fields()["pressure"] @ problem.particles.initial_volume
    assert domain.comm.allreduce(shown) == pytest.approx(domain.comm.allreduce(mean), rel=1e-12)


@leaves
def test_biot_against_stock_finite_elements():
    """One step of consolidation from a pressure that is there."""
    domain, dt, conductivity, storage = beam(TRIANGLE), 0.1, 0.2, 1e-3
    particles = mpm.Particles(domain, scenes.vectors(beam(TRIANGLE), 2), degree=2)
    V_p = scalars(particles.V.mesh)
    p = mpm.ParticleField(particles, V_p, at="nodes", name="p")
    x = p.W.tabulate_dof_coordinates()
    p.set(1.0 + x[:, 0] * x[:, 1])
    d, v, q, dx = (
        particles.displacement,
        ufl.TestFunction(particles.W),
        ufl.TestFunction(p.W),
        ufl.dx,
    )

    def residuals(d, p, before, v, q):
        stress = scenes.linear_stress(d, 30.0, 0.2) - p * ufl.Identity(2)
        flow = (ufl.div(d) + storage * (p - before)) * q
        flow += dt * conductivity * ufl.dot(ufl.grad(p), ufl.grad(q))
        return (ufl.inner(stress, ufl.grad(v)) - v[0]) * dx, flow * dx

    facets = scenes.at(0, 2.0)
    bcs = [scenes.fix(particles.V, scenes.at(0, 0.0))]
    drained = fem.locate_dofs_geometrical(V_p, facets)
    bcs.append(fem.dirichletbc(0.5, drained, V_p))
    R = residuals(d, p, p.previous, v, q)
    problem = mpm.ParticleProblem(
        list(R),
        particles,
        bcs=bcs,
        fields=[p],
        solver=mpm.Solver(petsc_options=TIGHT, stabilisation=None),
    )
    particles.load.value = 1.0
    problem.step()

    W = mixed_space(domain, 2, 1)
    w, (v, q) = fem.Function(W), ufl.TestFunctions(W)
    before = fem.Function(scalars(domain))
    x = before.function_space.tabulate_dof_coordinates()
    before.x.array[:] = 1.0 + x[:, 0] * x[:, 1]
    u, pressure = ufl.split(w)
    F = sum(residuals(u, pressure, before, v, q))
    newton(F, w, [held(W, 0, scenes.at(0, 0.0)), held(W, 1, facets, 0.5)])
    same_values(particles.displacement, w.sub(0).collapse())
    same_values(p, w.sub(1).collapse())
    flux = problem.reaction(bcs[1])
    assert flux.shape == (1,) and flux[0] != 0.0


def heat(cell, **options):
    """Return a problem of heat alone in a body at rest."""
    particles = mpm.Particles(beam(cell), scenes.vectors(beam(cell)))
    V_T = scalars(particles.V.mesh, 2)
    T = mpm.ParticleField(particles, V_T, at="nodes", name="T")
    hot = fem.Constant(V_T.mesh, 0.0)
    dofs = fem.locate_dofs_geometrical(V_T, scenes.at(0, 0.0))
    bcs = [fem.dirichletbc(hot, dofs, V_T)]
    R = conduction(T, T.previous, ufl.TestFunction(T.W))
    problem = posed(mpm.ParticleProblem, [None, R], particles, bcs=bcs, fields=[T], **options)
    return problem, T, hot


def conduction(T, before, q, dt=0.05):
    flow = (1.0 + T**2) * ufl.dot(ufl.grad(T), ufl.grad(q))
    return ((T - before) * q + dt * flow - dt * q) * ufl.dx(metadata={"quadrature_degree": 6})


@leaves
@pytest.mark.parametrize("cell", [TRIANGLE, QUADRILATERAL], ids=scenes.name)
def test_heat_alone_against_stock_finite_elements(cell):
    """Nonlinear conduction in three steps, without a displacement that is unknown."""
    problem, T, hot = heat(cell, petsc_options=TIGHT)

    def warm(t):
        hot.value = 3.0 * t

    problem.solve(steps=3, update=warm)
    domain = beam(cell)
    V = scalars(domain, 2)
    t, before, value = fem.Function(V), fem.Function(V), fem.Constant(domain, 0.0)
    dofs = fem.locate_dofs_geometrical(V, scenes.at(0, 0.0))
    for step in range(3):
        value.value = step + 1.0
        newton(conduction(t, before, ufl.TestFunction(V)), t, [fem.dirichletbc(value, dofs, V)])
        before.x.array[:] = t.x.array
    same_values(T, t)
    assert len(problem.history.steps) == 3


def test_heat_alone_by_multigrid(monkeypatch):
    monkeypatch.setattr(linear, "COARSEST", 20)
    found = []
    for name in ("direct", "multigrid"):
        problem, T, hot = heat(QUADRILATERAL, petsc_options=TIGHT, linear_solver=name)
        hot.value = 2.0
        problem.solve(steps=1)
        found.append(scenes.own(T))
        assert (problem.history.statistics["krylov_iterations"] > 0) == (name == "multigrid")
        assert problem.history.statistics["multigrid_failures"] == 0
    assert scenes.largest(found[0] - found[1]) < 1e-9 * scenes.largest(found[0])


@leaves
def test_a_pressure_at_nodes_by_multigrid(monkeypatch):
    monkeypatch.setattr(linear, "COARSEST", 50)
    found = []
    for name in ("direct", "multigrid"):
        problem, p = taylor_hood(QUADRILATERAL, petsc_options=TIGHT, linear_solver=name)
        problem.solve(steps=1)
        found.append((scenes.own(problem.particles.displacement), scenes.own(p)))
        assert problem.history.statistics["multigrid_failures"] == 0
    for a, b in zip(*found, strict=True):
        assert scenes.largest(a - b) < 1e-8 * scenes.largest(a)


def immersed(at="points", kind="total", cells=QUADRILATERAL, outside="error", comm=WORLD, **given):
    """Return a soft beam that bends through cells of the background, nearly incompressible."""
    background = scenes.box([0.0, 0.0], [2.5, 2.0], (5, 4), cells, comm)
    shape = scenes.box([0.0, 0.61], [2.0, 1.11], (8, 2), cells, comm)
    particles = mpm.Particles(shape, scenes.vectors(background, 2), degree=2, outside=outside)
    p = mpm.ParticleField(particles, scalars(background), at=at, kind=kind, name="p")
    d, v, q = particles.displacement, ufl.TestFunction(particles.W), ufl.TestFunction(p.W)
    psi = potential(d, p, 1e5) * particles.dx
    load = particles.load * 0.1 * v[1] * particles.dx_exact
    R = [ufl.derivative(psi, d, v) + load, ufl.derivative(psi, p, q)]
    bcs = [scenes.fix(particles.V, scenes.at(0, 0.0))]
    options = {"symmetric": True} | given
    return posed(mpm.ParticleProblem, R, particles, bcs=bcs, fields=[p], **options), p


def outcome_of(problem, p):
    found = outcome(problem)
    own = p.W.dofmap.list[: problem.particles.num_local]
    found["field"] = scenes.in_order(problem.particles, p.x.array[own])
    return found


@pytest.mark.parametrize(
    ("at", "kind"), [("points", "total"), ("nodes", "total"), ("points", "body")]
)
def test_blocks_of_the_tangent_against_differences(at, kind):
    problem, _ = immersed(at, kind)
    problem.solve(steps=4)
    assert error_of_blocks(problem) <= 1e-6


def test_results_do_not_depend_on_the_ranks():
    problem, p = immersed()
    problem.solve(steps=3)
    together = outcome_of(problem, p)
    if WORLD.rank == 0:
        alone, q = immersed(comm=MPI.COMM_SELF)
        alone.solve(steps=3)
        own = q.W.dofmap.list[: alone.particles.num_local]
        index = np.argsort(alone.particles.global_index)
        expected = q.x.array[own][index]
        assert np.abs(together["field"] - expected).max() <= 1e-9 * np.abs(expected).max()
        centroid = alone.particles.centroid[index]
        assert np.abs(together["centroid 0"] - centroid).max() <= 1e-9


@pytest.mark.parametrize("at", ["points", "nodes"])
def test_a_restart_goes_on_as_if_nothing_had_been(at, tmp_path):
    path = WORLD.bcast(tmp_path / "run.ckpt")
    problem, p = immersed(at)
    for step in problem.steps(4):
        if step.load == 0.5:
            problem.save(path)
    whole = outcome_of(problem, p)
    other, q = immersed(at)
    other.restore(path)
    assert np.abs(q.previous.x.array).max(initial=0.0) > 0.0 or q.x.array.size == 0
    other.solve(steps=4)
    same_run(outcome_of(other, q), whole, EXACT)


def test_a_state_of_another_field_is_refused(tmp_path):
    path = WORLD.bcast(tmp_path / "run.ckpt")
    problem, _ = immersed("points")
    problem.solve(steps=2)
    problem.save(path)
    other, _ = immersed("nodes")
    raises(lambda: other.restore(path), mpm.MPMError, "the field p of body 0 is not the same")


def test_a_failed_step_leaves_values_as_they_were():
    problem, p = immersed(petsc_options={"snes_max_it": 1})
    problem.particles.load.value = 1.0
    before = p.x.array.copy()
    raises(problem.step, mpm.ConvergenceError, "Newton")
    assert np.array_equal(p.x.array, before) and np.array_equal(p.previous.x.array, before)


@pytest.mark.parametrize("at", ["points", "nodes"])
def test_deleted_domains(at):
    if at == "nodes":
        raises(lambda: immersed(at, outside="delete"), mpm.MPMError, "Fields at nodes cannot")
        return
    problem, p = immersed(at, outside="delete")
    problem.solve(steps=2)
    assert np.isfinite(p.x.array).all()


def test_two_bodies_share_a_field_on_one_space():
    """Two halves of a beam are the whole one, their pressure on one space too."""
    whole, p = immersed("points")
    whole.solve(steps=2)
    background = scenes.box([0.0, 0.0], [2.5, 2.0], (5, 4), QUADRILATERAL)
    V, V_p = scenes.vectors(background, 2), scalars(background)
    bodies, fields, residuals = [], [], []
    for start in (0.0, 1.0):
        half = scenes.box([start, 0.61], [start + 1.0, 1.11], (4, 2), QUADRILATERAL)
        bodies.append(mpm.Particles(half, V, degree=2))
        fields.append(mpm.ParticleField(bodies[-1], V_p, name="p"))
    for each in (0, 1):
        body, field = bodies[each], fields[each]
        psi = potential(body.displacement, field, 1e5) * body.dx
        v, q = ufl.TestFunction(body.W), ufl.TestFunction(field.W)
        load = body.load * 0.1 * v[1] * body.dx_exact
        residuals.insert(each, ufl.derivative(psi, body.displacement, v) + load)
        residuals.append(ufl.derivative(psi, field, q))
    bcs = [scenes.fix(V, scenes.at(0, 0.0))]
    problem = mpm.ParticleProblem(residuals, bodies, bcs=bcs, fields=fields, symmetric=True)
    problem.solve(steps=2)
    tip = max(scenes.largest(b.displacement.x.array) for b in bodies)
    expected = scenes.largest(whole.particles.displacement.x.array)
    assert abs(tip - expected) <= 1e-9 * expected
    pressure = max(scenes.largest(f.x.array) for f in fields)
    assert abs(pressure - scenes.largest(p.x.array)) <= 1e-8 * pressure


def test_values_at_the_start_of_a_step_fit_those_of_the_body():
    """A linear field is what the background has, wherever the body has moved."""
    background = scenes.unit(5, QUADRILATERAL)
    shape = scenes.box([0.13, 0.21], [0.53, 0.61], (6, 6), QUADRILATERAL)
    particles = mpm.Particles(shape, scenes.vectors(background))
    T = mpm.ParticleField(particles, scalars(background), at="nodes", name="T")
    q = ufl.TestFunction(T.W)
    R = ((T - T.previous) * q) * ufl.dx
    problem = mpm.ParticleProblem([None, R], particles, fields=[T])
    x = T.W.tabulate_dof_coordinates()
    T.set(2.0 + x[:, 0] - 3.0 * x[:, 1])
    before = T.x.array.copy()

    def shift(t):
        particles.displacement.x.array[:] = 0.3 * t

    problem.solve(steps=4, update=shift)
    assert abs(scenes.largest(particles.centroid) - (0.61 - 0.4 / 12 + 0.3)) < 1e-12
    assert scenes.largest(T.x.array - before) <= 1e-10


def test_what_does_not_go_together_is_refused():
    particles = mpm.Particles(body(), scenes.vectors(held_background()))
    V_p = scalars(particles.V.mesh)
    raises(
        lambda: mpm.ParticleField(particles, particles.V),
        mpm.MPMError,
        "a background space of its own",
    )
    raises(
        lambda: mpm.ParticleField(particles, V_p, at="cells"),
        mpm.MPMError,
        "choose 'nodes' or 'points'",
    )
    raises(lambda: mpm.ParticleField(particles, V_p, kind="rate"), mpm.MPMError, "Unknown kind")
    raises(lambda: mpm.ParticleField(particles, V_p, name="a b"), mpm.MPMError, "identifier")
    p = mpm.ParticleField(particles, V_p, name="p")
    d, v = particles.displacement, ufl.TestFunction(particles.W)
    q = ufl.TestFunction(p.W)
    R_u = ufl.inner(scenes.linear_stress(d, 1e3, 0.3) + p * ufl.Identity(2), ufl.grad(v))
    R_u *= particles.dx
    R_p = (ufl.div(d) - p) * q * particles.dx

    def make(R, **options):
        return lambda: posed(mpm.ParticleProblem, R, particles, **options)

    raises(make(R_u, fields=[p]), mpm.MPMError, "1 bodies and 1 fields")
    raises(make([R_u, R_u], fields=[p]), mpm.MPMError, "must be from the field's W")
    raises(make(R_u), mpm.MPMError, "holds the field 'p', which is no unknown")
    raises(make([R_u, R_p], fields=[p, p]), mpm.MPMError, "given twice")
    raises(make([R_u, R_p], fields=[p], J=R_u), mpm.MPMError, "omit J")
    wrong = (ufl.div(d) - p) * q * ufl.dx(metadata={"quadrature_degree": 7})
    raises(make([R_u, wrong], fields=[p]), mpm.MPMError, "integrate it with particles.dx")
    bent = ufl.dot(ufl.grad(p), ufl.grad(d)[0, :]) * q * particles.dx
    raises(make([R_u, R_p + bent], fields=[p]), mpm.MPMError, "a gradient of 'p', .*at='nodes'")
    smooth = p * ufl.div(ufl.grad(q)) * particles.dx
    raises(make([R_u, R_p + smooth], fields=[p]), mpm.MPMError, "a gradient of a test")
    pushed = ufl.dot(ufl.grad(p.previous), v) * particles.dx
    raises(make([R_u + pushed, R_p], fields=[p]), mpm.MPMError, "a gradient of 'p before'")
    other = mpm.Particles(body(), scenes.vectors(held_background()))
    foreign = mpm.ParticleField(other, scalars(other.V.mesh), name="p")
    raises(make([R_u, R_p], fields=[foreign]), mpm.MPMError, "particles that this problem has not")


@pytest.mark.parametrize("at", ["points", "nodes"])
def test_values_that_make_no_sense_are_refused(at):
    particles = mpm.Particles(body(), scenes.vectors(held_background()))
    p = mpm.ParticleField(particles, scalars(particles.V.mesh), at=at, name="p")
    p.set(np.full(len(p.x.array), 2))
    one = np.ones(len(p.x.array))
    last = WORLD.rank == WORLD.size - 1  # what is wrong on one rank is an error on all
    for values, sentence in [
        (np.ones(len(one) + 1), "have the shape"),
        (one[:, None], "have the shape"),
        ("1.0", "not str"),
        (None, "not NoneType"),
        ([[1.0], [1.0, 2.0]], "not list"),
        (1j, "not complex"),
        (np.nan, "must be finite"),
        (np.where(np.arange(len(one)) == 0, np.inf, one), "must be finite"),
    ]:
        raises(lambda values=values: p.set(values if last else one), mpm.MPMError, sentence)
    assert np.array_equal(p.x.array, 2.0 * one) and np.array_equal(p.previous.x.array, 2.0 * one)


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize("cells", [(7, 8), (8, 8)])  # nodes that could be those of vectors, or not
def test_a_field_that_nothing_holds_is_said_to_be_one(cells, symmetric):
    grid = mesh.create_rectangle(scenes.WORLD, [[0, 0], [1, 1]], [4, 4], scenes.QUADRILATERAL)
    body = mesh.create_rectangle(scenes.WORLD, [[0, 0], [1, 1]], cells, scenes.QUADRILATERAL)
    particles = mpm.Particles(body, fem.functionspace(grid, ("Lagrange", 1, (2,))))
    heat = mpm.ParticleField(
        particles, fem.functionspace(grid, ("Lagrange", 1)), at="nodes", name="heat"
    )
    q = ufl.TestFunction(heat.W)
    flow = (ufl.dot(ufl.grad(heat), ufl.grad(q)) - particles.load * q) * particles.dx

    def posed(residual, shift=1e-13):
        return mpm.ParticleProblem(
            [None, residual],
            particles,
            fields=[heat],
            symmetric=symmetric,
            solver=mpm.Solver(shift=shift),
        )

    for shift in [5e-14, 1e-13, 2e-13, 4e-13, 1e-11]:  # beside round-off of the tangent
        problem = posed(flow, shift)
        raises(lambda p=problem: p.solve(1), mpm.MPMError, "'heat'.*nothing holds its values")
    stored = flow + 1e-6 * heat * q * particles.dx
    posed(stored).solve(1)
    np.testing.assert_allclose(heat.x.array, 1e6, rtol=1e-5)
