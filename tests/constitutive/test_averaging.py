# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""F-bar: its energy, its tangent, its groups, and what it does to locking and stress."""

import numpy as np
import pytest
import scenes
from constitutive.blocks import CASES, ELASTIC, PLASTIC, POISSON, YOUNG, block, label
from marks import thinned
from scenes import QUADRILATERAL, TRIANGLE, WORLD, A, B, at, box, vectors

from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.constitutive.averaging import FREE, deviation, deviation_energy
from mpm_dolfinx.materials import Hencky, ReturnMapping, VonMises, mandel

WAVES = np.array([[3.0, 1.0, 2.0], [1.0, 4.0, 1.0], [2.0, 1.0, 3.0]])


def waves(particles, size=0.1, step=0.0):
    """Return a displacement of all nodes, and another one to go on in."""
    dim = particles.mesh.geometry.dim
    X = particles.W.tabulate_dof_coordinates()[:, :dim]
    return size * np.sin(X @ WAVES[:dim, :dim]) + step * np.cos(X @ (3 - WAVES[:dim, :dim]))


def residual(problem, displacement):
    problem.particles.displacement.x.array[:] = displacement.ravel()
    assert problem.built.body_terms[0].update() is None
    return problem.built.body_terms[0].forms.assemble_residual().array_r.copy()


def norm(values):
    return np.sqrt(WORLD.allreduce(values @ values))


def require_exact_tangent(problem, size, tolerance=1e-8, eps=1e-6):
    """Compare the tangent times a direction with differences of the residual."""
    particles = problem.particles
    residual(problem, waves(particles, size))
    product = scenes.times_tangent(problem, waves(particles, 0.0, 1.0))
    ahead, behind = (residual(problem, waves(particles, size, s * eps)) for s in (1.0, -1.0))
    difference = (ahead - behind) / (2.0 * eps)
    assert norm(difference - product) < tolerance * norm(difference)


@pytest.mark.parametrize("material", [ELASTIC, PLASTIC], ids=["elastic", "plastic"])
@pytest.mark.parametrize(("cell", "f_bar", "rule", "axisymmetric"), CASES, ids=label)
def test_tangent_is_exact_and_symmetric(cell, f_bar, rule, axisymmetric, material):
    problem = block(cell, f_bar, rule, axisymmetric, material)
    particles = problem.particles
    size = 0.05 if particles.mesh.geometry.dim == 3 else 0.15
    require_exact_tangent(problem, size)
    residual(problem, waves(particles, size))
    nodes = particles.W.tabulate_dof_coordinates()[:, : particles.mesh.geometry.dim]
    modes = [np.sin(nodes @ WAVES[: nodes.shape[1], : nodes.shape[1]] * k) for k in range(1, 7)]
    products = [scenes.times_tangent(problem, mode) for mode in modes]
    K = np.array([[m.ravel()[: len(p)] @ p for p in products] for m in modes])
    K = WORLD.allreduce(K)
    assert np.linalg.norm(K - K.T) < 1e-13 * np.linalg.norm(K) > 0.0


class Friction(ReturnMapping):
    """Drucker and Prager's yield surface with isochoric flow: the tangent is not symmetric."""

    def yield_function(self, stress, plastic_strain):
        return self.plastic_potential(stress, plastic_strain) + 0.2 * mandel.trace(stress) - 30.0

    def plastic_potential(self, stress, plastic_strain):
        return mandel.norm(mandel.deviator(stress))


def test_tangent_of_a_law_without_symmetry_is_exact():
    law = Friction(YOUNG, POISSON)
    problem = block(QUADRILATERAL, "patch", 2, material=law)
    require_exact_tangent(problem, 0.05, tolerance=1e-6, eps=1e-7)


def hencky_energy(F):
    """Return Hencky's energy per volume, by singular values."""
    strain = np.log(np.linalg.svd(F, compute_uv=False))
    lame, shear = scenes.lame(YOUNG, POISSON)
    return lame / 2.0 * strain.sum(axis=-1) ** 2 + shear * (strain**2).sum(axis=-1)


def averaged_energy(problem, displacement):
    """Return the energy of the averaged deformation gradient, from the definition alone."""
    particles = problem.particles
    particles.displacement.x.array[:] = displacement.ravel()
    dim = particles.mesh.geometry.dim
    F = np.eye(dim) + particles.displacement_gradient()
    J, weights = np.linalg.det(F), particles.undeformed.rule.weights
    history = problem.points[0].averaging
    groups = np.concatenate(WORLD.allgather(history.groups.number))
    sizes = np.stack([weights.sum(axis=1), (weights * J).sum(axis=1)], axis=1)
    totals = np.zeros((groups.max() + 1, 2))
    np.add.at(totals, groups, np.concatenate(WORLD.allgather(sizes)))
    mean = (totals[:, 1] / totals[:, 0])[history.groups.number][:, None]
    scale = (mean / J) ** (1.0 / dim)
    energy = (weights * hencky_energy(scale[:, :, None, None] * F)).sum()
    free, width = (0.1, 0.4) if history.kind == "patch" else (0.2, 0.4)
    beyond = np.maximum(np.abs(np.log(J / mean)) - free, 0.0)
    outer = width**2 / 6.0 + (beyond - width) * width / 2.0 + (beyond - width) ** 2 / 2.0
    cost = np.where(beyond < width, beyond**3 / (6.0 * width), outer)
    energy += 3.0 * scenes.lame(YOUNG, POISSON)[1] * (weights * cost).sum()
    return WORLD.allreduce(energy)


@pytest.mark.parametrize(
    ("cell", "f_bar", "rule"), [case[:3] for case in CASES if not case[3]], ids=label
)
def test_residual_is_the_derivative_of_the_energy(cell, f_bar, rule):
    problem = block(cell, f_bar, rule, bent=True)
    particles, eps = problem.particles, 1e-6
    size = 0.05 if particles.mesh.geometry.dim == 3 else 0.15
    force = residual(problem, waves(particles, size))
    direction = waves(particles, 0.0, 1.0).ravel()[: len(force)]
    ahead, behind = (averaged_energy(problem, waves(particles, size, s * eps)) for s in (1.0, -1.0))
    expected = (ahead - behind) / (2.0 * eps)
    assert abs(WORLD.allreduce(force @ direction) - expected) < 1e-8 * abs(expected)


def test_cost_of_deviation_is_smooth_and_convex():
    d = np.linspace(-0.6, 0.6, 161) + 1e-3
    force, stiffness = deviation(d, 0.1, 0.5)
    eps = 1e-7
    difference = (deviation(d + eps, 0.1, 0.5)[0] - deviation(d - eps, 0.1, 0.5)[0]) / (2 * eps)
    np.testing.assert_allclose(difference, stiffness, atol=1e-8)
    np.testing.assert_allclose(deviation(-d, 0.1, 0.5)[0], -force, atol=1e-16)
    assert (force[np.abs(d) < 0.099] == 0.0).all() and (stiffness[np.abs(d) > 0.51] == 1.0).all()
    assert (np.abs(np.diff(stiffness)) < 6.0 * np.diff(d)).all() and (stiffness >= 0.0).all()


@pytest.mark.parametrize(("cell", "f_bar", "rule", "axisymmetric"), CASES, ids=label)
def test_a_homogeneous_motion_is_felt_as_it_is(cell, f_bar, rule, axisymmetric):
    problem = block(cell, f_bar, rule, axisymmetric, bent=True)
    particles = problem.particles
    dim = particles.mesh.geometry.dim
    H = np.array([[0.2, 0.1, 0.05], [-0.1, 0.15, 0.0], [0.1, 0.0, -0.1]])[:dim, :dim]
    if axisymmetric:
        H = np.diag([0.2, -0.1])
    plain = block(cell, "none", rule, axisymmetric, bent=True)
    values = []
    for scene in (problem, plain):
        body = scene.particles
        X = body.W.tabulate_dof_coordinates()[:, :dim]
        values.append(residual(scene, X @ H.T))
        scene.commit()
    assert norm(values[0] - values[1]) < 1e-12 * norm(values[1])
    np.testing.assert_allclose(particles.stress, plain.particles.stress, atol=1e-10 * YOUNG)


@pytest.mark.parametrize(
    ("cell", "f_bar", "rule", "bounds"),
    thinned(
        2,
        [
            (QUADRILATERAL, "domain", 2, (1.001, 1.001, 1.001)),
            (QUADRILATERAL, "patch", 2, (1.6, 0.9, 0.9)),
            (TRIANGLE, "patch", 1, (0.8, 0.7, 0.5)),
        ],
    ),
    ids=label,
)
def test_stress_of_columns_is_as_good_as_without(cell, f_bar, rule, bounds):
    def errors(**options):
        found = []
        for case, law in ((A, Hencky(1e4, 0.0)), (B, VonMises(2e5, 0.3, rho_y=20e3))):
            problem = scenes.column(case, 16, cell, law, **options)
            problem.solve(steps=10)
            exact = case.stress(problem.particles.initial_centroid[:, 1])
            parts = (1,) if case is A else (0, 1)
            found += [scenes.stress_error(problem, case, i, exact[i]) for i in parts]
        return np.array(found)

    with_f_bar = errors(f_bar=f_bar, quadrature_degree=rule)
    assert (with_f_bar < np.array(bounds) * errors()).all()


def test_kinds_that_do_not_fit_are_refused():
    def problem(cell, f_bar, **options):
        V = vectors(box([0.0, 0.0], [1.0, 1.0], [2, 2], QUADRILATERAL))
        body = box([0.0, 0.0], [1.0, 1.0], [4, 4], cell)
        return mpm.QuasiStaticProblem(
            mpm.Body(mpm.Particles(body, V, **options), ELASTIC, f_bar=f_bar)
        )

    with pytest.raises(mpm.MPMError, match="quadrature_degree=2"):
        problem(QUADRILATERAL, "domain")
    with pytest.raises(
        mpm.MPMError, match="Unknown f_bar='pair'; choose one of 'none', 'domain', 'patch'"
    ):
        problem(TRIANGLE, "pair")
    with pytest.raises(mpm.MPMError, match="Unknown f_bar='cell'"):
        problem(QUADRILATERAL, "cell")


class Breaks(Hencky):
    """A law that fails where the body is stretched sideways."""

    def update(self, displacement_gradient, state, tangent=True):
        points = np.flatnonzero(displacement_gradient[:, 0, 0] > 0.03)
        if len(points):
            raise mpm.ConvergenceError("the law breaks", points)
        return super().update(displacement_gradient, state, tangent)


def test_a_failure_on_one_rank_ends_on_all():
    # Patches are cut by the ranks: those without a failure must not wait for a sum.
    problem = scenes.slump(
        QUADRILATERAL, 20e3, Breaks(1e6, 0.3), h=1.0, f_bar="patch", quadrature_degree=2
    )
    with pytest.raises(mpm.MPMError):
        problem.solve(steps=2)
    before = scenes.state(problem)
    with pytest.raises(mpm.MPMError):
        problem.solve(steps=2)
    scenes.assert_same_state(before, scenes.state(problem))


@pytest.mark.parametrize(
    ("cell", "f_bar", "rule"),
    thinned(2, [(QUADRILATERAL, "domain", 2), (QUADRILATERAL, "patch", 2), (TRIANGLE, "patch", 1)]),
    ids=label,
)
def test_a_column_slumps_without_folding(cell, f_bar, rule):
    problem = scenes.slump(cell, 20e3, h=1.0, f_bar=f_bar, quadrature_degree=rule)
    problem.solve(steps=20)
    particles = problem.particles
    y_mean = scenes.total(
        particles, particles.centroid[:, 1] * particles.initial_volume
    ) / scenes.total(particles, particles.initial_volume)
    ratio = scenes.gather(particles.volume / particles.initial_volume)
    worst = scenes.gather(particles.domain_distortion()).min()
    assert problem.history.cutbacks <= 2 and worst > 0.0
    assert abs(y_mean / 1.32 - 1.0) < 0.01
    assert 0.6 < ratio.min() and ratio.max() < 1.4


def test_deleted_domains_leave_their_patch():
    problem = block(QUADRILATERAL, "patch", 2, outside="delete")
    particles = problem.particles
    residual(problem, waves(particles))
    particles.commit()
    particles.placement.leaving(True)
    particles.placement.delete(np.flatnonzero(particles.global_index % 3 == 0))
    require_exact_tangent(problem, 0.1)
    problem.commit()
    assert np.isfinite(particles.stress).all()


@pytest.mark.parametrize(("f_bar", "solves"), [("none", 2), ("domain", 2), ("patch", 2)])
def test_an_axisymmetric_tube_needs_two_solves(f_bar, solves):
    # A step of a hundredth of the load is nearly linear: more solves mean a wrong tangent.
    V = vectors(box([0.0, 0.0], [3.0, 0.5], [12, 2], QUADRILATERAL))
    body = box([1.0, 0.0], [2.0, 0.5], [8, 4], QUADRILATERAL)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            mpm.Particles(body, V, quadrature_degree=2),
            ELASTIC,
            pressures=[(0.2, 1)],
            facet_tags=scenes.facet_tags(body, scenes.at(0, 1.0)),
            f_bar=f_bar,
        ),
        bcs=[scenes.fix(V, scenes.at(1, 0.0, 0.5), component=1)],
        axisymmetric=True,
    )
    problem.solve(1)
    assert problem.history.iterations == [solves]
    # Lame's tube in plane strain, of small strains.
    pressure = 0.2 / (2.0**2 - 1.0)
    exact = (1.0 + POISSON) / YOUNG * pressure * ((1.0 - 2.0 * POISSON) * 1.0 + 4.0 / 1.0)
    X = problem.particles.W.tabulate_dof_coordinates()
    inner = problem.particles.displacement.x.array[::2][np.isclose(X[:, 0], 1.0)]
    np.testing.assert_allclose(inner, exact, rtol=0.02)


def footing(f_bar):
    """Return ratio to the limit pressure, and its last rise, of a coarse strip footing."""
    V = vectors(box([0.0, 0.0], [3.0, 2.5], [12, 10], QUADRILATERAL))
    body = box([0.0, 0.0], [3.0, 2.0], [24, 16], QUADRILATERAL)

    def held(component, value, where):
        V.mesh.topology.create_connectivity(1, 2)
        facets = mesh.locate_entities(V.mesh, 1, where)
        dofs = fem.locate_dofs_topological(V.sub(component), 1, facets)
        return fem.dirichletbc(value, dofs, V.sub(component))

    strip = held(1, -0.002, lambda x: np.isclose(x[1], 2.0) & (x[0] < 0.5001))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            mpm.Particles(body, V, quadrature_degree=2),
            VonMises(1e7, 0.48, rho_y=490.0 * np.sqrt(2.0)),
            f_bar=f_bar,
        ),
        bcs=[held(0, 0.0, scenes.at(0, 0.0, 3.0)), held(1, 0.0, scenes.at(1, 0.0)), strip],
    )
    pressure = [-problem.reaction(strip)[1] for _ in problem.steps(16)]
    return 2.0 * pressure[-1] / ((2.0 + np.pi) * 490.0), pressure[-1] / pressure[-4] - 1.0


def test_a_footing_locks_without_patches_and_reaches_its_limit_with_them():
    ratio, rise = footing("domain")
    assert ratio > 1.5 and rise > 0.03
    ratio, rise = footing("patch")
    assert 0.95 < ratio < 1.2 and abs(rise) < 0.01


@pytest.mark.parametrize(
    ("cell", "offset", "f_bar", "degree", "bound"),
    [(0.5, 0.0, "patch", 1, 0.006), (0.25, 0.3, "domain", 2, 5e-4)],
)
def test_pressure_in_a_tube_whose_wall_thins(cell, offset, f_bar, degree, bound):
    # Exact as soon as all of the wall flows, while a row has more unknowns than patches.
    lower, upper = [offset * cell, 0.0], [5.0 + offset * cell, cell]
    V = vectors(box(lower, upper, [round(5.0 / cell), 1], QUADRILATERAL), degree)
    body = box([1.0, 0.0], [2.0, cell], [round(2.0 / cell), 2], QUADRILATERAL)
    axial, _ = V.sub(1).collapse()
    held = fem.locate_dofs_geometrical((V.sub(1), axial), lambda x: x[0] > -1.0)
    particles = mpm.Particles(body, V, degree=degree, quadrature_degree=2 if degree == 1 else None)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            particles,
            VonMises(100.0, 0.49, yield_stress=1.0),
            pressures=[(1.0, 1)],
            facet_tags=scenes.facet_tags(body, at(0, 1.0)),
            f_bar=f_bar,
        ),
        bcs=[fem.dirichletbc(fem.Function(axial), held, V.sub(1))],
        axisymmetric=True,
    )
    control = mpm.DisplacementControl(particles, 1.0, point=(1.0, 0.0), direction=(1.0, 0.0))
    patches = round(1.0 / cell) if f_bar == "patch" else 0
    compared = 0
    for _ in problem.steps(20, control=control):
        r = particles.W.tabulate_dof_coordinates()[:, 0] + particles.displacement.x.array[::2]
        inner = WORLD.allreduce(r.min(initial=np.inf), scenes.MPI.MIN)
        outer = scenes.largest(r)
        exact = 2.0 / np.sqrt(3.0) * np.log(outer / inner)
        unknowns = problem.history.statistics["free_dofs"] // (degree + 1)
        if inner > 1.4 and unknowns > patches:
            compared += 1
            assert abs(float(particles.load.value) / exact - 1.0) < bound
    assert compared >= 8


@pytest.mark.parametrize("kind", sorted(FREE))
def test_energy_of_deviations_has_the_derivatives_that_act(kind):
    free, whole = FREE[kind]
    d = np.linspace(-2.0, 2.0, 161) + 1e-3  # (beside the ends of the parabola)
    step = 1e-4
    ends = [deviation_energy(d + i * step, free, whole) for i in (-1, 0, 1)]
    force, slope = deviation(d, free, whole)
    np.testing.assert_allclose((ends[2] - ends[0]) / (2.0 * step), force, atol=1e-7)
    np.testing.assert_allclose((ends[2] - 2.0 * ends[1] + ends[0]) / step**2, slope, atol=1e-6)
    assert np.all(ends[1][np.abs(d) <= free] == 0.0)
    below, above = deviation_energy(np.array([whole - 1e-9, whole + 1e-9]), free, whole)
    assert above == pytest.approx(below, abs=1e-8)
