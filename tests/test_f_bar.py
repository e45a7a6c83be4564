# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""F-bar: its energy, its tangent, its groups, and what it does to locking and stress."""

import numpy as np
import pytest
import scenes
from scenes import (
    HEXAHEDRON,
    QUADRILATERAL,
    TETRAHEDRON,
    TRIANGLE,
    WORLD,
    A,
    B,
    box,
    vectors,
)

from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.f_bar import deviation
from mpm_dolfinx.materials import Hencky, ReturnMapping, VonMises, mandel

YOUNG, POISSON = 1e3, 0.3
ELASTIC = Hencky(YOUNG, POISSON)
PLASTIC = VonMises(YOUNG, POISSON, rho_y=40.0, hardening=100.0)
WAVES = np.array([[3.0, 1.0, 2.0], [1.0, 4.0, 1.0], [2.0, 1.0, 3.0]])
CASES = [
    (QUADRILATERAL, "domain", 2, False),
    (QUADRILATERAL, "domain", 2, True),
    (QUADRILATERAL, "patch", 2, False),
    (QUADRILATERAL, "patch", 1, False),
    (TRIANGLE, "pair", 1, False),
    (TRIANGLE, "pair", 1, True),
    (TRIANGLE, "patch", 1, False),
    (TRIANGLE, "patch", 1, True),
    (HEXAHEDRON, "domain", 2, False),
    (HEXAHEDRON, "patch", 2, False),
    (TETRAHEDRON, "patch", 1, False),
]


def label(value):
    return scenes.name(value) or str(value)


def block(
    cell, f_bar, rule, axisymmetric=False, material=ELASTIC, comm=WORLD, bent=False, **options
):
    """Return a block that cuts the cells of its background, with domains half as long."""
    dim = 3 if cell in (TETRAHEDRON, HEXAHEDRON) else 2
    n = 6 if dim == 2 else 4
    grid = QUADRILATERAL if dim == 2 else HEXAHEDRON
    V = vectors(box([-1.0] * dim, [2.0] * dim, [n] * dim, grid, comm))
    body = box([0.1] * dim, [1.1] * dim, [n - 2] * dim, cell, comm)
    if bent:
        x = body.geometry.x[:, :dim]
        x[:] = scenes.bend(scenes.unit(n - 2, cell, comm), 0.04).geometry.x[:, :dim] + 0.1
    return mpm.QuasiStaticProblem(
        mpm.Particles(body, V, quadrature_degree=rule, **options),
        material,
        f_bar=f_bar,
        axisymmetric=axisymmetric,
        assembly="reference",
    )


def waves(particles, size=0.1, step=0.0):
    """Return a displacement of all nodes, and another one to go on in."""
    dim = particles.mesh.geometry.dim
    X = particles.W.tabulate_dof_coordinates()[:, :dim]
    return size * np.sin(X @ WAVES[:dim, :dim]) + step * np.cos(X @ (3 - WAVES[:dim, :dim]))


def residual(problem, displacement):
    problem.particles.displacement.x.array[:] = displacement.ravel()
    assert problem.evaluate() is None
    return problem.shares[0].forms.assemble_residual().array_r.copy()


def norm(values):
    return np.sqrt(WORLD.allreduce(values @ values))


def require_exact_tangent(problem, size, tolerance=1e-8, eps=1e-6):
    """Compare the tangent times a direction with differences of the residual."""
    particles = problem.particles
    residual(problem, waves(particles, size))
    K = problem.shares[0].forms.assemble_tangent()
    direction, product = K.createVecRight(), K.createVecLeft()
    direction.array_w[:] = waves(particles, 0.0, 1.0).ravel()[: direction.getLocalSize()]
    K.mult(direction, product)
    ahead, behind = (residual(problem, waves(particles, size, s * eps)) for s in (1.0, -1.0))
    difference = (ahead - behind) / (2.0 * eps)
    assert norm(difference - product.array_r) < tolerance * norm(difference)


@pytest.mark.parametrize("material", [ELASTIC, PLASTIC], ids=["elastic", "plastic"])
@pytest.mark.parametrize(("cell", "f_bar", "rule", "axisymmetric"), CASES, ids=label)
def test_tangent_is_exact_and_symmetric(cell, f_bar, rule, axisymmetric, material):
    problem = block(cell, f_bar, rule, axisymmetric, material)
    particles = problem.particles
    size = 0.05 if particles.mesh.geometry.dim == 3 else 0.15
    require_exact_tangent(problem, size)
    residual(problem, waves(particles, size))
    K = problem.shares[0].forms.assemble_tangent()
    skew = K.copy()
    skew.transpose()
    skew.axpy(-1.0, K)
    assert skew.norm() < 1e-14 * K.norm()


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
    J, weights = np.linalg.det(F), particles.quadrature.weights
    history = problem.shares[0].forms.low_rank._averaging
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


# -- Groups ------------------------------------------------------------------------------


def members(problem):
    """Return the group of each particle by its smallest member, in the order of the input."""
    particles = problem.particles
    averaging = problem.shares[0].forms.low_rank._averaging
    number = scenes.in_order(particles, averaging.groups.number)
    first = np.full(number.max() + 1, len(number))
    np.minimum.at(first, number, np.arange(len(number)))
    return first[number]


@pytest.mark.parametrize(("cell", "f_bar", "rule", "axisymmetric"), CASES[2:], ids=label)
def test_groups_do_not_depend_on_the_ranks(cell, f_bar, rule, axisymmetric):
    problem = block(cell, f_bar, rule, axisymmetric)
    alone = block(cell, f_bar, rule, axisymmetric, comm=scenes.MPI.COMM_SELF)
    number = alone.shares[0].forms.low_rank._averaging.groups.number
    order = np.argsort(alone.particles.global_index)
    first = np.full(number.max() + 1, len(number))
    np.minimum.at(first, number[order], np.arange(len(number)))
    np.testing.assert_array_equal(members(problem), first[number[order]])


@pytest.mark.parametrize("diagonal", ["left", "right", "left_right", "right_left"])
def test_pairs_are_the_quadrilaterals(diagonal):
    V = vectors(box([0.0, 0.0], [1.0, 1.0], [2, 2], QUADRILATERAL))
    body = box([0.0, 0.0], [1.0, 1.0], [4, 4], TRIANGLE, diagonal=diagonal)
    problem = mpm.QuasiStaticProblem(mpm.Particles(body, V), ELASTIC, f_bar="pair")
    centre = scenes.in_order(problem.particles, problem.particles.initial_centroid)
    square = np.floor(centre * 4.0) @ [1.0, 4.0]
    group = members(problem)
    assert len(np.unique(group)) == 16
    assert (square == square[group]).all()


@pytest.mark.parametrize("cell", scenes.PLANE, ids=label)
@pytest.mark.parametrize("offset", [0.0, 0.1])
def test_patches_fill_about_a_background_cell(cell, offset):
    V = vectors(box([0.0, 0.0], [2.0, 2.0], [8, 8], QUADRILATERAL))
    body = box([offset, offset], [1.0 + offset, 1.0 + offset], [8, 8], cell)
    problem = mpm.QuasiStaticProblem(mpm.Particles(body, V), ELASTIC, f_bar="patch")
    group = members(problem)
    volume = scenes.in_order(problem.particles, problem.particles.initial_volume)
    size = np.bincount(group, volume)[np.unique(group)] * 16.0
    if offset == 0.0:
        np.testing.assert_allclose(size, 1.0)
    assert size.min() >= 0.4 and size.max() <= 2.0
    assert len(size) <= 25


def test_patches_keep_materials_apart():
    V = vectors(box([0.0, 0.0], [1.0, 1.0], [2, 2], QUADRILATERAL))
    body = box([0.0, 0.0], [1.0, 1.0], [4, 4], QUADRILATERAL)
    tags = scenes.cell_tags(body, lambda x: 1 + (x[:, 0] > 0.25))
    laws = {1: ELASTIC, 2: PLASTIC}
    problem = mpm.QuasiStaticProblem(mpm.Particles(body, V), laws, cell_tags=tags, f_bar="patch")
    centre = scenes.in_order(problem.particles, problem.particles.initial_centroid)
    left = centre[:, 0] < 0.25
    assert (left == left[members(problem)]).all()


# -- What it is for ----------------------------------------------------------------------


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
    [
        (QUADRILATERAL, "domain", 2, (1.001, 1.001, 1.001)),
        (QUADRILATERAL, "patch", 2, (1.6, 0.9, 0.9)),
        (TRIANGLE, "pair", 1, (0.85, 0.85, 0.6)),
        (TRIANGLE, "patch", 1, (0.8, 0.7, 0.5)),
    ],
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
        return mpm.QuasiStaticProblem(mpm.Particles(body, V, **options), ELASTIC, f_bar=f_bar)

    with pytest.raises(mpm.MPMError, match="quadrature_degree=2"):
        problem(QUADRILATERAL, "domain")
    with pytest.raises(mpm.MPMError, match="'domain' or 'patch'"):
        problem(QUADRILATERAL, "pair")
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
    [(QUADRILATERAL, "domain", 2), (QUADRILATERAL, "patch", 2), (TRIANGLE, "pair", 1)],
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
    particles.leaving()
    particles.delete(np.flatnonzero(particles.global_index % 3 == 0))
    require_exact_tangent(problem, 0.1)
    problem.commit()
    assert np.isfinite(particles.stress).all()


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
        mpm.Particles(body, V, quadrature_degree=2),
        VonMises(1e7, 0.48, rho_y=490.0 * np.sqrt(2.0)),
        bcs=[held(0, 0.0, scenes.at(0, 0.0, 3.0)), held(1, 0.0, scenes.at(1, 0.0)), strip],
        f_bar=f_bar,
    )
    pressure = [-problem.reaction(strip)[1] for _ in problem.steps(16)]
    return 2.0 * pressure[-1] / ((2.0 + np.pi) * 490.0), pressure[-1] / pressure[-4] - 1.0


def test_a_footing_locks_without_patches_and_reaches_its_limit_with_them():
    ratio, rise = footing("domain")
    assert ratio > 1.5 and rise > 0.03
    ratio, rise = footing("patch")
    assert 0.95 < ratio < 1.2 and abs(rise) < 0.01
