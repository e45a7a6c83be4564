# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Equilibrium of bodies with materials, against exact solutions and finite differences."""

from itertools import pairwise

import numpy as np
import pytest
import scenes
from marks import thinned
from posed import posed
from scenes import PLANE, QUADRILATERAL, TRIANGLE, WORLD, A, B, top
from scipy.integrate import quad, solve_ivp
from scipy.linalg import logm
from scipy.optimize import brentq

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, LinearElastic, SmallStrainVonMises, VonMises


@pytest.mark.parametrize(
    ("cell", "bound", "rate"), [(QUADRILATERAL, 2.7e-3, 1.6), (TRIANGLE, 6.4e-3, 1.1)]
)
def test_elastic_column(cell, bound, rate):
    errors, positions = [], []
    for ne in (8, 16):
        problem = scenes.column(A, ne, cell, Hencky(A.young, A.poisson))
        history = problem.solve(steps=40)
        assert history.cutbacks == 0 and sum(history.iterations) <= 130
        particles = problem.particles
        Y = particles.initial_centroid[:, 1]
        errors.append(scenes.stress_error(problem, A, 1, A.stress(Y)[1]))
        exact = [quad(lambda y: np.exp(-A.strain(y)), 0.0, y)[0] for y in Y]
        gap = np.abs(particles.centroid[:, 1] - exact) * particles.initial_volume
        volume = scenes.total(particles, particles.initial_volume)
        positions.append(scenes.total(particles, gap) / (A.length * volume))
        weight = A.g0 * A.length * A.length / ne
        sides, base = (problem.reaction(bc) for bc in problem.bcs)
        np.testing.assert_allclose(base, [0.0, weight], rtol=1e-8, atol=1e-8)
        # nu = 0: nothing on the rollers at the sides, but what triangles' errors leave
        assert abs(sides[0]) < 1e-6 * weight
    assert errors[1] < bound
    assert np.log2(errors[0] / errors[1]) > rate
    assert np.log2(positions[0] / positions[1]) > rate
    assert abs(top(problem) - 24.059646) < 5 * bound


@pytest.mark.parametrize(
    ("ne", "syy", "sxx"), thinned(2, [(16, 2.9e-3, 2.4e-3), (32, 1.2e-3, 9.7e-4)])
)
def test_plastic_column(ne, syy, sxx):
    problem = scenes.column(B, ne, QUADRILATERAL, VonMises(B.young, B.poisson, rho_y=B.rho_y))
    violation = -1.0
    for _ in problem.steps(40):
        violation = max(violation, float(problem.yield_function.max(initial=-1.0)))
    assert WORLD.allreduce(violation, scenes.MPI.MAX) <= 1e-8
    assert problem.history.total_iterations <= 135
    particles = problem.particles
    across, along = B.stress(particles.initial_centroid[:, 1])
    assert scenes.stress_error(problem, B, 1, along) < syy
    assert scenes.stress_error(problem, B, 0, across) < sxx
    assert abs(top(problem) - 8.7817867) < 5e-3
    # It has yielded below the exact depth of 6.283052, and above is elastic.
    depth = B.length - particles.initial_centroid[:, 1]
    h = B.length / ne
    assert np.all(particles.plastic_strain[depth > 6.283052 + h] > 0.0)
    assert np.all(particles.plastic_strain[depth < 6.283052 - h] == 0.0)


@pytest.mark.parametrize("ne", [16, 32])
def test_stiff_small_strain_column_is_finite_elements(ne):
    stiff = B._replace(young=2e8)
    law = SmallStrainVonMises(stiff.young, stiff.poisson, rho_y=stiff.rho_y)
    problem = scenes.column(stiff, ne, QUADRILATERAL, law)
    problem.solve(steps=10)
    depth = B.length - problem.particles.initial_centroid[:, 1]
    along = -B.g0 * depth
    yielded = depth > np.sqrt(3 / 2) * B.rho_y * 0.7 / (0.4 * B.g0)
    across = np.where(yielded, along + np.sqrt(3 / 2) * B.rho_y, 3 / 7 * along)
    error = scenes.stress_error(problem, B, 1, along)
    assert abs(error * 4 * ne - 1.0) < 0.05
    assert scenes.stress_error(problem, B, 0, across) <= error


def hardening_column(hardening):
    """Integrate the column's law along its confined compression, with SciPy.

    Returns:
        Functions of the load: Kirchhoff stress across and along, and plastic strain at depth;
        and the height of the top.
    """

    def rate(w, y):
        # y: uniaxial difference q = |tau_yy - tau_xx|, plastic strain; pressure is K w.
        q, kappa = y
        if q < np.sqrt(3 / 2) * B.rho_y + hardening * kappa - 1e-9:
            return [2 * B.G, 0.0]
        flow = 2 * B.G / (3 * B.G + hardening)
        return [hardening * flow, flow]

    first = np.sqrt(3 / 2) * B.rho_y / (2 * B.G)
    plastic = solve_ivp(
        rate, (first, 0.6), [2 * B.G * first, 0.0], rtol=1e-11, atol=1e-9, dense_output=True
    )

    def law(w):
        q, kappa = (2 * B.G * w, 0.0) if w <= first else plastic.sol(w)
        return -B.K * w + q / 3, -B.K * w - 2 * q / 3, kappa

    def strain(Y):
        # Cauchy stress along the column is -g0 depth, since its section stays.
        load = B.g0 * (B.length - Y)
        return brentq(lambda w: -law(w)[1] * np.exp(w) - load, 0.0, 0.6, xtol=1e-14)

    yielding = B.length - B.M * first * np.exp(first) / B.g0
    height = quad(lambda y: np.exp(-strain(y)), 0.0, B.length, points=[yielding])[0]
    return law, strain, height


def test_hardening_column_against_one_dimension():
    hardening = 1e5
    law, strain, height = hardening_column(hardening)
    material = VonMises(B.young, B.poisson, rho_y=B.rho_y, hardening=hardening)
    errors = []
    for ne in (8, 16):
        problem = scenes.column(B, ne, QUADRILATERAL, material)
        problem.solve(steps=20)
        particles = problem.particles
        exact = []
        for Y in particles.initial_centroid[:, 1]:
            w = strain(Y)
            across, along, kappa = law(w)
            exact.append((across * np.exp(w), along * np.exp(w), kappa))
        across, along, kappa = np.array(exact).reshape(-1, 3).T
        error = [scenes.stress_error(problem, B, i, e) for i, e in ((0, across), (1, along))]
        gap = np.abs(particles.plastic_strain - kappa) * particles.initial_volume
        error.append(scenes.total(particles, gap) / (B.length**2 / ne))
        errors.append(error)
        assert WORLD.allreduce(problem.yield_function.max(initial=-1.0), scenes.MPI.MAX) < 1e-10
        peak = WORLD.allreduce(particles.plastic_strain.max(initial=0.0), scenes.MPI.MAX)
    assert peak > 0.02
    assert errors[1][0] < 3e-3 and errors[1][1] < 3e-3
    assert errors[1][2] < 0.05 * peak
    assert np.all(np.log2(np.divide(*errors)) > 0.9)
    assert abs(top(problem) - height) < 5e-3


def patch_background(kind):
    """Return an affine background of the unit square."""
    if kind == "triangles":
        return scenes.bend(scenes.unit(4, TRIANGLE), 0.05)
    return scenes.unit(4, QUADRILATERAL)


LINEAR = np.array([[0.06, -0.03], [0.05, -0.04]])


@pytest.mark.parametrize("cell", PLANE, ids=scenes.name)
@pytest.mark.parametrize("background", ["triangles", "quadrilaterals"])
@pytest.mark.parametrize("law", [LinearElastic, Hencky])
def test_patch_on_a_whole_background(background, cell, law):
    # The body fills the background, but its cells cut the background's cells anyhow.
    V = scenes.vectors(patch_background(background))
    particles = mpm.Particles(scenes.bend(scenes.unit(11, cell), 0.02), V)
    u = fem.Function(V)
    u.interpolate(lambda x: LINEAR @ x[:2])
    dofs = scenes.fix(V, lambda x: np.full(x.shape[1], True)).dof_indices()[0]
    bc = fem.dirichletbc(u, (np.unique(dofs) // 2)[::1].astype(np.int32))
    problem = mpm.QuasiStaticProblem(mpm.Body(particles, law(1e3, 0.3)), bcs=[bc])
    problem.step()
    F = np.eye(3)
    F[:2, :2] += LINEAR
    strain = (F + F.T) / 2 - np.eye(3) if law is LinearElastic else np.real(logm(F @ F.T)) / 2
    lmbda, mu = scenes.lame(1e3, 0.3)
    stress = lmbda * np.trace(strain) * np.eye(3) + 2 * mu * strain
    if law is Hencky:
        stress /= np.linalg.det(F)
    assert scenes.largest(particles.stress - stress) < 1e-10 * np.abs(stress).max()


@pytest.mark.parametrize("cell", PLANE, ids=scenes.name)
@pytest.mark.parametrize("background", ["triangles", "quadrilaterals"])
def test_patch_of_a_body_that_cuts_the_background(background, cell):
    # Tractions of a homogeneous stress on the body's own faces, anywhere in the grid; some of
    # the background's nodes are held.
    V = scenes.vectors(patch_background(background))
    body = scenes.bend(scenes.unit(10, cell), 0.02)
    body.geometry.x[:, :2] = [0.06, 0.07] + body.geometry.x[:, :2] * [0.83, 0.71]
    particles = mpm.Particles(body, V)
    lmbda, mu = scenes.lame(1e3, 0.3)
    strain = (LINEAR + LINEAR.T) / 2
    stress = np.diag([0.0, 0.0, lmbda * np.trace(strain)])
    stress[:2, :2] = lmbda * np.trace(strain) * np.eye(2) + 2 * mu * strain
    tags = scenes.facet_tags(body, scenes.at(0, 0.06, 0.89), scenes.at(1, 0.07, 0.78))
    traction = ufl.dot(ufl.as_matrix(stress[:2, :2]), ufl.FacetNormal(body))
    u = fem.Function(V)
    u.interpolate(lambda x: LINEAR @ x[:2])
    held = np.flatnonzero(V.tabulate_dof_coordinates()[:, 0] < 0.3).astype(np.int32)
    bc = fem.dirichletbc(u, held)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            particles,
            LinearElastic(1e3, 0.3),
            tractions=[(traction, 1), (traction, 2)],
            facet_tags=tags,
        ),
        bcs=[bc],
    )
    assert problem.solve(steps=1).iterations == [1]
    assert scenes.largest(particles.stress - stress) < 1e-10 * np.abs(stress).max()
    X = particles.W.tabulate_dof_coordinates()[:, :2]
    gap = particles.displacement.x.array.reshape(-1, 2) - X @ LINEAR.T
    assert scenes.largest(gap) < 1e-11


@pytest.mark.parametrize("cell", PLANE, ids=scenes.name)
@pytest.mark.parametrize("law", [Hencky, VonMises])
def test_rigid_motion_across_cells_turns_the_stress(law, cell):
    # All background dofs are prescribed: stretched first, then turned and moved at once.
    squeeze, turns, angle = 2, 10, 0.3
    V = scenes.vectors(scenes.box([-3.0, -3.0], [5.0, 3.0], [16, 12], TRIANGLE))
    body = scenes.bend(scenes.unit(4, cell), 0.03)
    particles = mpm.Particles(body, V)
    bc, u = scenes.everywhere(V)
    strength = {"rho_y": 30.0} if law is VonMises else {}
    problem = mpm.QuasiStaticProblem(mpm.Body(particles, law(1e3, 0.3, **strength)), bcs=[bc])
    stretch = np.array([[0.1, 0.05], [0.05, -0.1]])
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s], [s, c]])
    x = V.tabulate_dof_coordinates()[:, :2]
    steps = squeeze + turns
    forward = np.array([0.1, -0.03])

    def path(t):
        # Totals on the background: the sum of the steps' increments there.
        n = t * steps
        before, after = min(n, squeeze) / squeeze, max(0.0, n - squeeze)
        value = before * (x @ stretch.T) + after * (x @ (R - np.eye(2)).T + forward)
        u.x.array[:] = value.ravel()

    stresses, cells = [], []
    for _ in problem.steps(steps, update=path):
        stresses.append(particles.stress)
        cells.append(np.floor(2 * scenes.node_positions(particles)))
    assert np.all([np.any(a != b, axis=1).mean() > 0.3 for a, b in pairwise(cells[squeeze:])])
    start = stresses[squeeze - 1]
    size = scenes.largest(start)
    assert size > 20.0
    turn = np.eye(3)
    for stress in stresses[squeeze:]:
        turn[:2, :2] = R @ turn[:2, :2]
        assert scenes.largest(stress - turn @ start @ turn.T) < 1e-11 * size
    assert problem.history.iterations == [0] * steps
    ratio = np.linalg.det(np.eye(2) + stretch / squeeze) ** squeeze
    np.testing.assert_allclose(particles.volume / particles.initial_volume, ratio, rtol=1e-11)


def test_rigid_body_in_a_rigid_shift_has_no_stress():
    # A stress-free block carried along by its left side, through many cells in few steps.
    problem = scenes.block(Hencky(1e3, 0.3), force=None, bcs=[])
    V = problem.particles.V
    bc, u = scenes.everywhere(V)
    problem = posed(mpm.QuasiStaticProblem, problem.particles, Hencky(1e3, 0.3), bcs=[bc])

    def path(t):
        u.x.array.reshape(-1, 2)[:] = [0.9 * t, 0.2 * t]

    problem.solve(steps=5, update=path)
    assert scenes.largest(problem.particles.stress) < 1e-10
    d = problem.particles.displacement.x.array.reshape(-1, 2)
    np.testing.assert_allclose(d, np.tile([0.9, 0.2], (len(d), 1)), atol=1e-14)


def in_each_iteration(problem, check):
    """Call ``check(x)`` at each Newton iterate of a run, and restore the residual after it."""
    calls = []

    def monitor(snes, iteration, norm):
        x = snes.getSolution()
        check(x.copy())
        problem.reduced.residual(x, problem.b)
        calls.append(iteration)

    problem.solver.setMonitor(monitor)
    return calls


def direction(x, seed):
    """Return a random vector, the same for any distribution of ranks."""
    p = x.duplicate()
    first, last = p.getOwnershipRange()
    p.array_w[:] = np.random.default_rng(seed).normal(size=p.getSize())[first:last]
    return p


def plastic_slump(cell):
    V = scenes.vectors(scenes.box([0.0, 0.0], [12.0, 10.0], [12, 10], QUADRILATERAL))
    body = scenes.box([0.0, 0.0], [4.0, 8.0], [8, 16], cell)
    push = scenes.fix(V, scenes.at(0, 0.0), 0.3, component=0)
    return mpm.QuasiStaticProblem(
        mpm.Body(
            mpm.Particles(body, V),
            VonMises(1e6, 0.3, rho_y=20e3, hardening=1e4),
            density=1000.0,
            body_force=(0.0, -8.0),
            tractions=[((3e3, 0.0), 1)],
            facet_tags=scenes.facet_tags(body, scenes.at(1, 8.0)),
        ),
        bcs=[push, scenes.fix(V, scenes.at(1, 0.0), component=1)],
    )


@pytest.mark.parametrize("cell", PLANE, ids=scenes.name)
def test_reduced_tangent_by_finite_differences(cell):
    problem = plastic_slump(cell)
    worst, plastic = [], []

    def check(x):
        K = problem.reduced.tangent()
        p = direction(x, len(worst))
        product, asymmetry = K.createVecLeft(), K.createVecLeft()
        K.mult(p, product)
        K.multTranspose(p, asymmetry)
        h = 1e-6 / p.norm()
        sides = []
        for sign in (1.0, -1.0):
            point, F = x.copy(), x.duplicate()
            point.axpy(sign * h, p)
            assert problem.reduced.residual(point, F) is None
            sides.append(F)
        difference = sides[0]
        difference.axpy(-1.0, sides[1])
        difference.scale(0.5 / h)
        difference.axpy(-1.0, product)
        asymmetry.axpy(-1.0, product)
        worst.append(max(difference.norm(), asymmetry.norm()) / product.norm())
        plastic.append(problem.particles.plastic_strain.max(initial=0.0))

    calls = in_each_iteration(problem, check)
    problem.solve(steps=4)
    problem.solver.cancelMonitor()
    assert len(calls) > 12 and problem.history.cutbacks == 0
    assert WORLD.allreduce(max(plastic), scenes.MPI.MAX) > 1e-3
    assert max(worst) < 1e-6


@pytest.mark.parametrize("cell", PLANE, ids=scenes.name)
def test_residual_is_the_gradient_of_henckys_energy(cell):
    young, poisson = 1e3, 0.3
    lmbda, mu = scenes.lame(young, poisson)
    force = np.array([3.0, -6.0])
    problem = scenes.block(Hencky(young, poisson), cell, force=tuple(force), n=6)
    particles = problem.particles
    gaps = []

    def potential(x):
        """Stored energy of all particles less the work of the body force."""
        problem.reduced.residual(x, x.duplicate())
        F = particles.deformation_gradient
        strain = np.log(np.linalg.eigvalsh(F @ F.swapaxes(1, 2))) / 2
        density = lmbda / 2 * strain.sum(axis=1) ** 2 + mu * (strain**2).sum(axis=1)
        moved = particles.centroid - particles.initial_centroid
        work = 2.0 * float(particles.load.value) * moved @ force
        return scenes.total(particles, (density - work) * particles.initial_volume)

    def check(x):
        F, p = x.duplicate(), direction(x, len(gaps))
        problem.reduced.residual(x, F)
        h, slope = 1e-4, 0.0
        for distance, factor in ((1, 8.0), (-1, -8.0), (2, -1.0), (-2, 1.0)):
            point = x.copy()
            point.axpy(distance * h, p)
            slope += factor * potential(point) / (12 * h)
        gaps.append(abs(slope - F.dot(p)) / (problem.reduced.scale() * p.norm()))

    calls = in_each_iteration(problem, check)
    problem.solve(steps=3)
    problem.solver.cancelMonitor()
    assert len(calls) >= 9
    assert scenes.largest(particles.displacement.x.array) > 0.02
    assert max(gaps) < 1e-7


@pytest.mark.parametrize(
    ("case", "law"),
    [(A, Hencky(A.young, A.poisson)), (B, VonMises(B.young, B.poisson, rho_y=B.rho_y))],
    ids=["elastic", "plastic"],
)
def test_newton_is_quadratic(case, law):
    problem = scenes.column(case, 8, QUADRILATERAL, law, predictor=False)
    exponents = []
    for step in problem.steps(10):
        e = np.log([r for r in step.residuals if r > 1e-12])
        drops = np.diff(e)
        exponents += list(drops[1:] / drops[:-1])
    if case is B:
        peak = WORLD.allreduce(problem.particles.plastic_strain.max(initial=0.0), scenes.MPI.MAX)
        assert peak > 0.05
    assert len(exponents) > 10
    assert np.median(exponents) > 1.8


@pytest.mark.parametrize("cell", PLANE, ids=scenes.name)
def test_traction_on_a_confined_column(cell):
    # A dead load on the top: homogeneous, so exact to round-off.
    young, poisson, q = 1e3, 0.25, 400.0

    def load(body):
        tags = scenes.facet_tags(body, scenes.at(1, 2.0))
        return Hencky(young, poisson), {"tractions": [((0.0, -q), 1)], "facet_tags": tags}

    case = scenes.Column(2.0, young, poisson, 1.0)
    problem = scenes.column(case, 5, cell, None, gravity=0.0, material_of=load)
    problem.solve(steps=4)
    w = brentq(lambda w: case.M * w * np.exp(w) - q, 0.0, 1.0, xtol=1e-15)
    across = -(case.K - 2 * case.G / 3) * w * np.exp(w)
    stress = problem.particles.stress
    np.testing.assert_allclose(stress[:, 1, 1], -q, rtol=1e-8)
    np.testing.assert_allclose(stress[:, 0, 0], across, rtol=1e-8)
    np.testing.assert_allclose(stress[:, 2, 2], across, rtol=1e-8)
    assert abs(top(problem) - 2.0 * np.exp(-w)) < 1e-9
    np.testing.assert_allclose(problem.reaction(problem.bcs[1]), [0.0, 0.4 * q], atol=1e-6)
