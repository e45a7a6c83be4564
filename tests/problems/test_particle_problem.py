# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Problems written in UFL, against stock finite elements and dense algebra."""

from itertools import pairwise

import numpy as np
import pytest
import scenes
import stock
from bad_input import body, held_background
from compare import raises
from posed import posed
from routes import ROUTES, ReferenceForms
from scenes import PLANE, QUADRILATERAL, TRIANGLE, WORLD

import ufl
from dolfinx import fem
from dolfinx.fem.petsc import assemble_matrix

import mpm_dolfinx as mpm
from mpm_dolfinx import _compat


def test_a_problem_with_an_error_of_python():
    class Wrong(mpm.ParticleProblem):
        def evaluate(self):
            if self.particles.load.value > 0.5 and WORLD.rank == WORLD.size - 1:
                raise KeyError("history")

    p = mpm.Particles(body(), scenes.vectors(held_background()))
    d, v = p.displacement, ufl.TestFunction(p.W)
    R = ufl.inner(scenes.linear_stress(d, 1e3, 0.3), ufl.grad(v)) * p.dx
    R -= p.load * v[1] * p.dx_exact
    problem = Wrong(R, p, bcs=[scenes.fix(p.V, scenes.at(0, 0.0))])
    raises(lambda: problem.solve(steps=2), mpm.MPMError, r"evaluate\(\) failed with KeyError")
    assert problem.history.load == [0.5] and p.load.value == 0.5


FEM_OPTIONS = {
    "snes_rtol": 1e-13,
    "snes_atol": 1e-13,
    "snes_linesearch_type": "none",
    "ksp_type": "preonly",
    "pc_type": "lu",
    "pc_factor_mat_solver_type": "mumps",
}


# A body that fills its background leaves it in the last step, which is a warning.
leaves = pytest.mark.filterwarnings("ignore:The run is complete")


def beam(cell):
    """Return a distorted mesh of a beam, the same each time."""
    return scenes.shear(scenes.bend(scenes.unit(5, cell), 0.03), ((2.0, 0.0), (0.0, 1.0)))


def twin(cell, quadrature_degree=None):
    """Return particles that are the cells of their background."""
    return mpm.Particles(
        beam(cell), scenes.vectors(beam(cell)), quadrature_degree=quadrature_degree
    )


def grips(V, end=(-0.3, 0.1)):
    """Return conditions at both ends, the last one imposed on one component only."""
    return [
        scenes.fix(V, scenes.at(0, 0.0)),
        scenes.fix(V, scenes.at(0, 2.0), end[0], component=0),
        scenes.fix(V, scenes.at(0, 2.0), end[1], component=1),
    ]


def finite_elements(particles, residual, bcs, J=None):
    """Return the displacement of stock finite elements on a mesh of the body."""
    W = scenes.vectors(particles.mesh)
    d = fem.Function(W)
    F = residual(d, ufl.TestFunction(W))
    tangent = None if J is None else J(d, ufl.TestFunction(W), ufl.TrialFunction(W))
    problem = stock.NonlinearProblem(
        F, d, bcs=bcs(W), J=tangent, petsc_options_prefix="fem_", petsc_options=FEM_OPTIONS
    )
    problem.solve()
    assert problem.solver.getConvergedReason() > 0
    return d


@leaves
@pytest.mark.parametrize(("cell", "degree"), [(TRIANGLE, None), (QUADRILATERAL, 3)])
def test_particles_that_are_cells_are_finite_elements(cell, degree):
    particles = twin(cell, degree)
    tags = scenes.facet_tags(particles.mesh, scenes.at(1, 1.0))
    ds = ufl.Measure("ds", domain=particles.mesh, subdomain_data=tags)
    dx = particles.dx
    b = fem.Constant(particles.mesh, np.array([50.0, -300.0]))
    n = ufl.FacetNormal(particles.mesh)

    def residual(d, v, load=1.0):
        R = ufl.derivative(scenes.neo_hookean(d) * dx, d, v)
        return R - load * (ufl.inner(b, v) * dx - 200.0 * ufl.inner(n, v) * ds(1))

    R = residual(particles.displacement, ufl.TestFunction(particles.W), particles.load)
    bcs = grips(particles.V)
    problem = mpm.ParticleProblem(
        R, particles, bcs=bcs, solver=mpm.Solver(petsc_options_prefix="twin_")
    )
    problem.solve(steps=1)
    d = finite_elements(particles, residual, grips)
    assert scenes.largest(d.x.array) > 0.2
    assert scenes.largest(particles.displacement.x.array - d.x.array) < 1e-10

    # The reaction is the residual of the finite elements at the support.
    F = scenes.assembled(residual(d, ufl.TestFunction(d.function_space)))
    fixed = grips(d.function_space)
    for bc, own in zip(bcs, fixed, strict=True):
        dofs = _compat.own_dofs(own, d.function_space)
        force = np.zeros(2)
        np.add.at(force, dofs % 2, F[dofs])
        np.testing.assert_allclose(problem.reaction(bc), WORLD.allreduce(force), atol=1e-7)


@leaves
def test_interior_facets():
    # A penalty on the jump of the gradient: only where facets see both of their cells.
    particles = twin(TRIANGLE)
    h = 0.2

    def residual(d, v, load=1.0):
        R = ufl.derivative(scenes.neo_hookean(d) * particles.dx, d, v)
        jumps = ufl.inner(ufl.jump(ufl.grad(d)), ufl.jump(ufl.grad(v)))
        return R + 100.0 * h * jumps * ufl.dS(domain=particles.mesh)

    R = residual(particles.displacement, ufl.TestFunction(particles.W))
    problem = mpm.ParticleProblem(R, particles, bcs=grips(particles.V))
    problem.solve(steps=1)
    d = finite_elements(particles, residual, grips)
    without = finite_elements(
        particles,
        lambda d, v: ufl.derivative(scenes.neo_hookean(d) * particles.dx, d, v),
        grips,
    )
    assert scenes.largest(d.x.array - without.x.array) > 1e-4
    assert scenes.largest(particles.displacement.x.array - d.x.array) < 1e-10


def leaning_block(cell, force=600.0, n=8):
    """Return particles of a unit block on a plate, and its support and load."""
    V = scenes.vectors(scenes.box([-0.5, 0.0], [2.0, 1.5], [10, 6], QUADRILATERAL))
    particles = mpm.Particles(scenes.box([0.0, 0.0], [1.0, 1.0], [n, n], cell), V)
    b = fem.Constant(particles.mesh, np.array([force / 4, -force]))
    return particles, [scenes.fix(V, scenes.at(1, 0.0))], b


@pytest.mark.parametrize("cell", PLANE, ids=scenes.name)
def test_hencky_in_ufl_is_the_material(cell):
    young, poisson, steps = 1e3, 0.3, 6
    particles, bcs, b = leaning_block(cell, force=400.0)
    d, v = particles.displacement, ufl.TestFunction(particles.W)
    energy = scenes.hencky(d, young, poisson) * particles.dx
    R = ufl.derivative(energy, d, v) - particles.load * ufl.inner(b, v) * particles.dx_exact
    history = mpm.ParticleProblem(R, particles, bcs=bcs).solve(steps=steps)

    others, bcs, b = leaning_block(cell, force=400.0)
    problem = posed(
        mpm.QuasiStaticProblem,
        others,
        mpm.materials.Hencky(young, poisson),
        density=1.0,
        body_force=b,
        bcs=bcs,
    )
    cells = []
    for _ in problem.steps(steps):
        cells.append(np.floor(4 * scenes.node_positions(others)))
    assert history.cutbacks == problem.history.cutbacks == 0
    crossings = [np.any(one != two, axis=1).sum() for one, two in pairwise(cells)]
    assert min(crossings[1:]) > 5, "nodes cross cells"
    assert scenes.largest(others.displacement.x.array) > 0.3
    gap = particles.displacement.x.array - others.displacement.x.array
    assert scenes.largest(gap) < 1e-6


def mixed(d, v, rules, body):
    """Return the terms of a residual whose volumetric part has a rule of its own."""
    F = ufl.variable(ufl.Identity(2) + ufl.grad(d))
    J = ufl.det(F)
    volumetric = ufl.diff(500.0 * (J - 1) ** 2, F)
    shape = ufl.diff(100.0 * (ufl.tr(F.T * F) / J - 2), F)
    b = ufl.as_vector([1.0, ufl.SpatialCoordinate(body)[0] ** 2])
    one, full, rich = (
        ufl.dx(domain=body, metadata={"quadrature_degree": degree}) for degree in rules
    )
    return [
        ufl.inner(volumetric, ufl.grad(v)) * one,
        ufl.inner(shape, ufl.grad(v)) * full,
        -ufl.inner(b, v) * rich,
    ]


@pytest.mark.parametrize("cell", PLANE, ids=scenes.name)
def test_each_rule_of_a_residual_is_kept(cell):
    # FFCx miscompiles a form that mixes a one-point rule with others; on affine cells it does
    # so without a trace, so that the mesh is distorted.
    body = scenes.bend(scenes.unit(4, cell), 0.06)
    V = scenes.vectors(scenes.box([-1.0, -1.0], [2.0, 2.0], [6, 6], QUADRILATERAL))
    particles = mpm.Particles(body, V)
    scenes.move(particles, lambda X: 0.1 * np.sin(4 * X[:, ::-1]))
    d, v, du = particles.displacement, ufl.TestFunction(particles.W), ufl.TrialFunction(particles.W)
    terms = mixed(d, v, (0, 3, 5), body)
    forms = ReferenceForms(sum(terms[1:], terms[0]), None, particles)
    forms.assemble_external()
    vector, matrix = forms.assemble_residual().copy(), forms.assemble_tangent().copy()
    size, stiffness = vector.norm(), matrix.norm()
    for term in terms:
        vector.array_w[:] -= scenes.assembled(term)
    for term in terms[:2]:
        separate = assemble_matrix(fem.form(ufl.derivative(term, d, du)))
        separate.assemble()
        matrix.axpy(-1.0, separate)
    assert vector.norm() < 1e-13 * size
    assert matrix.norm() < 1e-13 * stiffness


@leaves
def test_mixed_rules_in_a_run():
    # The same in the whole: finite elements with the same terms in forms of their own.
    particles = twin(QUADRILATERAL)
    body = particles.mesh
    terms = mixed(particles.displacement, ufl.TestFunction(particles.W), (0, 3, 5), body)
    R = terms[0] + terms[1] + particles.load * terms[2]
    mpm.ParticleProblem(R, particles, bcs=grips(particles.V)).solve(steps=1)
    d = fem.Function(scenes.vectors(body))
    d.x.array[:] = particles.displacement.x.array
    terms = mixed(d, ufl.TestFunction(d.function_space), (0, 3, 5), body)
    residual = sum(scenes.assembled(term) for term in terms)
    size = scenes.largest(residual)
    for bc in grips(d.function_space):
        residual[_compat.own_dofs(bc, d.function_space)] = 0.0
    assert scenes.largest(residual) < 1e-9 * size


def linear_problem(J=None):
    """Return a problem of linear elasticity whose tangent is given."""
    particles, bcs, b = leaning_block(TRIANGLE, force=50.0)
    d, v, du = particles.displacement, ufl.TestFunction(particles.W), ufl.TrialFunction(particles.W)

    def work(u):
        return ufl.inner(scenes.linear_stress(u, 1e3, 0.3), ufl.grad(v)) * particles.dx

    R = work(d) - particles.load * ufl.inner(b, v) * particles.dx_exact
    tangent = None if J is None else J * work(du)
    return mpm.ParticleProblem(R, particles, J=tangent, bcs=bcs)


def test_own_tangent():
    problem, exact, soft = linear_problem(), linear_problem(1.0), linear_problem(1.25)
    for each in (problem, exact, soft):
        each.solve(steps=2)
    d = problem.particles.displacement.x.array
    assert scenes.largest(exact.particles.displacement.x.array - d) < 1e-14
    # A quarter too stiff: each iteration leaves a fifth of the residual.
    assert scenes.largest(soft.particles.displacement.x.array - d) < 1e-9
    assert problem.history.iterations == exact.history.iterations == [1, 1]
    assert all(10 <= n <= 16 for n in soft.history.iterations)
    for step in soft.history.steps:
        rates = np.divide(step.residuals[1:], step.residuals[:-1])
        # (relative to reactions, which converge too)
        np.testing.assert_allclose(rates[4:], 0.2, rtol=2e-3)


def test_background_form_against_dense_algebra():
    # An elastic body on springs that see the increments of the background's own nodes.
    young, poisson, k = 1e3, 0.3, 40.0
    particles, bcs, b = leaning_block(TRIANGLE, force=900.0, n=4)
    V, body = particles.V, particles.mesh
    d, v = particles.displacement, ufl.TestFunction(particles.W)
    stress = scenes.linear_stress(d, young, poisson)
    R = ufl.inner(stress, ufl.grad(v)) * particles.dx
    R -= particles.load * ufl.inner(b, v) * particles.dx_exact
    spring = k * ufl.inner(particles.increment, ufl.TestFunction(V)) * ufl.dx
    problem = mpm.ParticleProblem(R, particles, bcs=bcs, background=spring)

    u, du, w = ufl.TrialFunction(particles.W), ufl.TrialFunction(V), ufl.TestFunction(V)
    work = ufl.inner(scenes.linear_stress(u, young, poisson), ufl.grad(v)) * ufl.dx(domain=body)
    matrices = [fem.form(work), fem.form(k * ufl.inner(du, w) * ufl.dx)]
    K, M = (assemble_matrix(form) for form in matrices)
    K.assemble()
    M.assemble()
    K, M = scenes.dense(K), scenes.dense(M)
    f = scenes.gather(scenes.assembled(ufl.inner(b, v) * particles.dx_exact))
    dofs = _compat.own_dofs(bcs[0], V)
    fixed = scenes.gather(dofs + V.dofmap.index_map.local_range[0] * 2)
    free = np.setdiff1d(np.arange(len(M)), fixed)

    dense, transfers = np.zeros(len(K)), []
    for load in (0.5, 1.0):
        T = scenes.dense(particles.T)
        transfers.append(T)
        A = (T.T @ K @ T + M)[np.ix_(free, free)]
        increment = np.zeros(len(M))
        increment[free] = np.linalg.solve(A, (T.T @ (load * f - K @ dense))[free])
        dense = dense + T @ increment
        particles.load.value = load
        problem.step()
        np.testing.assert_allclose(
            scenes.gather(scenes.own(particles.increment)), increment, atol=1e-12
        )
        np.testing.assert_allclose(scenes.gather(scenes.own(d)), dense, atol=1e-12)
    assert np.abs(dense).max() > 0.05
    assert np.any((transfers[0] != 0) != (transfers[1] != 0)), "nodes cross cells"


def test_data_at_points_need_the_rule_of_the_particles():
    particles, bcs, _ = leaning_block(QUADRILATERAL)
    d, v = particles.displacement, ufl.TestFunction(particles.W)
    stiffness = particles.quadrature_function("stiffness")
    stiffness.x.array[:] = 100.0
    right = stiffness * ufl.inner(ufl.grad(d), ufl.grad(v)) * particles.dx
    mpm.ParticleProblem(right, particles, bcs=bcs).solve()
    for dx in (particles.dx_exact, ufl.dx(domain=particles.mesh, degree=3)):
        wrong = stiffness * ufl.inner(ufl.grad(d), ufl.grad(v)) * dx
        with pytest.raises(mpm.MPMError, match=r"'stiffness'.*particles\.dx"):
            mpm.ParticleProblem(wrong, particles, bcs=bcs)
    with pytest.raises(mpm.MPMError, match=r"'stiffness'.*particles\.dx"):
        mpm.ParticleProblem(right, particles, J=ufl.derivative(wrong, d), bcs=bcs)


@pytest.mark.parametrize("degree", [None, 3])
def test_data_at_points_act_as_written(degree):
    # A stiffness that varies within domains, injected and as an expression.
    def run(injected):
        V = scenes.vectors(scenes.box([-0.5, 0.0], [1.5, 1.5], [8, 6], QUADRILATERAL))
        body = scenes.bend(scenes.unit(5, QUADRILATERAL), 0.03)
        particles = mpm.Particles(body, V, quadrature_degree=degree)
        X = ufl.SpatialCoordinate(body)
        young = 1.0 + X[0] * X[0]
        if injected:
            values = young
            young = particles.quadrature_function("young")
            points = _compat.interpolation_points(young.function_space)
            young.interpolate(fem.Expression(values, points))
        d, v = particles.displacement, ufl.TestFunction(particles.W)
        R = young * ufl.inner(scenes.linear_stress(d, 100.0, 0.2), ufl.grad(v)) * particles.dx
        R -= particles.load * v[0] * particles.dx_exact
        bcs = [scenes.fix(V, scenes.at(1, 0.0))]
        mpm.ParticleProblem(R, particles, bcs=bcs).solve(steps=2)
        return particles.displacement.x.array

    given = run(injected=True)
    assert scenes.largest(given) > 1e-2
    assert scenes.largest(given - run(injected=False)) < 1e-13


def test_elastic_support_on_the_body_sees_the_whole_displacement():
    # Springs on the body's own boundary, in steps that each see the total displacement: a rigid
    # block moves by load / stiffness, however many steps.
    moved = []
    for steps in (1, 3):
        V = scenes.vectors(scenes.box([-1.0, -1.0], [3.0, 2.0], [8, 6], QUADRILATERAL))
        particles = mpm.Particles(scenes.unit(3, TRIANGLE), V)
        d, v = particles.displacement, ufl.TestFunction(particles.W)
        R = ufl.inner(scenes.linear_stress(d, 1e4, 0.3), ufl.grad(v)) * particles.dx
        R += 10.0 * ufl.inner(d, v) * ufl.ds(domain=particles.mesh)
        R -= particles.load * 9.0 * v[0] * ufl.ds(domain=particles.mesh)
        mpm.ParticleProblem(R, particles).solve(steps=steps)
        moved.append(scenes.own(d).reshape(-1, 2).copy())
    for d in moved:
        np.testing.assert_allclose(d, np.tile([0.9, 0.0], (len(d), 1)), atol=1e-9)


def elastic(particles):
    d, v = particles.displacement, ufl.TestFunction(particles.W)
    return ufl.derivative(scenes.neo_hookean(d) * particles.dx, d, v)


def pair_of_bodies(same_mesh=False):
    V = scenes.vectors(scenes.box([-1.0, 0.0], [2.0, 2.0], [6, 4], scenes.QUADRILATERAL))
    meshes = [
        scenes.box([0.0, y], [1.0, y + 0.5], [4, 2], scenes.QUADRILATERAL) for y in (0.0, 0.5)
    ]
    meshes[1] = meshes[0] if same_mesh else meshes[1]
    return [mpm.Particles(body, V) for body in meshes], [scenes.fix(V, scenes.at(1, 0.0))]


@pytest.mark.parametrize("route", ROUTES, indirect=True)
@pytest.mark.usefixtures("route")
def test_a_term_that_is_zero_is_left_out():
    found = []
    for extra in (False, True):
        (a, _), bcs = pair_of_bodies()
        d, v = a.displacement, ufl.TestFunction(a.W)
        R = elastic(a) + a.load * 10.0 * v[1] * a.dx_exact
        J = ufl.derivative(R, d)
        if extra:
            R += 0.0 * (v[0] * a.dx) + 0.0 * (ufl.inner(d, v) * ufl.ds)
            J += 0.0 * (ufl.inner(ufl.TrialFunction(a.W), v) * a.dx)
        problem = mpm.ParticleProblem(R, a, J, bcs)
        problem.solve(2)
        found.append((d.x.array.copy(), problem.history.iterations))
    size = scenes.largest(found[0][0])
    # (A factorisation on several ranks adds up in the order in which messages come.)
    np.testing.assert_allclose(found[0][0], found[1][0], rtol=0.0, atol=1e-14 * size)
    assert found[0][1] == found[1][1] and size > 1e-4


@pytest.mark.parametrize("route", ROUTES, indirect=True)
@pytest.mark.usefixtures("route")
def test_loads_that_are_zero_load_nothing():
    (a, _), bcs = pair_of_bodies()
    x = ufl.SpatialCoordinate(a.mesh)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            a,
            mpm.materials.Hencky(1e3, 0.3),
            body_force=0.0 * x,
            pressures=[(0.0 * x[0], 1)],
            facet_tags=scenes.facet_tags(a.mesh, scenes.at(1, 0.5)),
        ),
        bcs=bcs,
    )
    problem.solve(1)
    assert scenes.largest(a.displacement.x.array) == 0.0


def test_forms_that_are_zero_are_refused():
    (a, _), bcs = pair_of_bodies()
    with pytest.raises(mpm.MPMError, match="the residual R is zero"):
        mpm.ParticleProblem(0.0 * elastic(a), a, bcs=bcs)
    with pytest.raises(mpm.MPMError, match="the tangent J is zero"):
        mpm.ParticleProblem(elastic(a), a, 0.0 * ufl.derivative(elastic(a), a.displacement), bcs)


@pytest.mark.parametrize("same_mesh", [False, True])
def test_fields_of_another_body_are_refused(same_mesh):
    (a, b), bcs = pair_of_bodies(same_mesh)
    v = ufl.TestFunction(a.W)

    def problem(term, bodies=(a, b)):
        forms = [elastic(body) for body in bodies]
        forms[0] += term
        return mpm.ParticleProblem(forms, list(bodies), bcs=bcs)

    with pytest.raises(mpm.MPMError, match="R of body 0 holds the displacement of body 1, whose"):
        problem(ufl.inner(b.displacement, v) * a.dx)
    for bodies in ((a, b), (a,)):
        with pytest.raises(mpm.MPMError, match="load factor of other particles, which is not"):
            problem(b.load * v[1] * a.dx, bodies)
    with pytest.raises(mpm.MPMError, match="holds 'increment' of another mesh"):
        problem(ufl.inner(a.increment, v) * a.dx, (a,))
    x = ufl.SpatialCoordinate(a.V.mesh)
    with pytest.raises(mpm.MPMError, match="holds SpatialCoordinate of another mesh"):
        problem(x[0] * v[1] * a.dx, (a,))
    with pytest.raises(mpm.MPMError, match="integrates over another mesh than"):
        problem(ufl.inner(a.displacement, v) * ufl.dx(domain=a.V.mesh), (a,))
    problem(a.load * fem.Constant(a.V.mesh, 2.0) * v[1] * a.dx, (a,)).step()


def test_fields_of_another_body_are_refused_on_the_background():
    (a, b), bcs = pair_of_bodies()
    v = ufl.TestFunction(a.V)
    dx = ufl.dx(domain=a.V.mesh)

    def problem(background):
        forms = [elastic(a), elastic(b)]
        return mpm.ParticleProblem(forms, [a, b], bcs=bcs, background=background)

    spring = ufl.inner(a.increment, v) * dx
    with pytest.raises(mpm.MPMError, match="increment of body 1, which is that of all"):
        problem(spring + ufl.inner(b.increment, v) * dx)
    with pytest.raises(mpm.MPMError, match=r"load factor of other particles.*the first one"):
        problem(spring + b.load * v[1] * dx)
    with pytest.raises(mpm.MPMError, match="holds 'displacement' of another mesh"):
        problem(spring + ufl.inner(a.displacement, v) * dx)
