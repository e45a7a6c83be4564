# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A pressure as an unknown of built-in materials, against UFL, differences and exact solutions."""

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from compare import EXACT, error_of_blocks, outcome, raises, same_run
from scenes import HEXAHEDRON, QUADRILATERAL, TETRAHEDRON, TRIANGLE, WORLD

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import (
    DruckerPrager,
    Hencky,
    LinearElastic,
    SmallStrainVonMises,
    VonMises,
)

STIFF = Hencky(30.0, 0.49999)
YIELDING = VonMises(30.0, 0.4999, yield_stress=1.0, hardening=3.0)
LAWS = [STIFF, YIELDING, LinearElastic(30.0, 0.4999)]
LAWS.append(SmallStrainVonMises(30.0, 0.4999, yield_stress=1.0, hardening=3.0))


def beam(material=STIFF, cell=QUADRILATERAL, comm=WORLD, load=0.1, degree=2, **options):
    """Return a beam that bends under its weight through cells of the background."""
    if cell in (TETRAHEDRON, HEXAHEDRON):
        background = scenes.box([0.0] * 3, [1.5, 1.0, 1.0], (3, 2, 2), cell, comm)
        shape = scenes.box([0.0, 0.2, 0.3], [1.0, 0.6, 0.7], (3, 2, 2), cell, comm)
    else:
        background = scenes.box([0.0, 0.0], [2.5, 2.0], (5, 4), cell, comm)
        shape = scenes.box([0.0, 0.61], [2.0, 1.11], (8, 2), cell, comm)
    particles = mpm.Particles(shape, scenes.vectors(background, degree), degree=degree)
    force = (0.0,) * (shape.geometry.dim - 1) + (-load,)
    bcs = [scenes.fix(particles.V, scenes.at(0, 0.0))]
    options = {"mixed": "pressure", "bcs": bcs, "body_force": force} | options
    return mpm.QuasiStaticProblem(particles, material, **options)


def test_the_same_as_in_ufl():
    """Hencky's energy with a pressure, written out, and as a material."""
    problem = beam()
    problem.solve(steps=2)
    background = scenes.box([0.0, 0.0], [2.5, 2.0], (5, 4), QUADRILATERAL)
    shape = scenes.box([0.0, 0.61], [2.0, 1.11], (8, 2), QUADRILATERAL)
    particles = mpm.Particles(shape, scenes.vectors(background, 2), degree=2)
    p = particles.field(fem.functionspace(background, ("Lagrange", 1)), name="p")
    d, v, q = particles.displacement, ufl.TestFunction(particles.W), ufl.TestFunction(p.W)
    F = ufl.Identity(2) + ufl.grad(d)
    J = ufl.det(F)
    half = ufl.tr(F * F.T) / 2.0 / J - 1.0  # cosh of twice the stretch, less 1
    near = 2.0 * half - half**2 / 3.0 + 4.0 / 45.0 * half**3 - half**4 / 35.0
    far = ufl.ln(1.0 + half + ufl.sqrt(ufl.max_value(half * (half + 2.0), 1e-12))) ** 2
    squares = ufl.conditional(ufl.lt(half, 1e-3), near, far)
    shear, bulk = STIFF.shear, STIFF.bulk
    psi = shear * (squares / 2.0 + ufl.ln(J) ** 2 / 6.0) + p * ufl.ln(J) - p**2 / (2.0 * bulk)
    psi *= particles.dx
    load = particles.load * 0.1 * v[1] * particles.dx_exact
    R = [ufl.derivative(psi, d, v) + load, ufl.derivative(psi, p, q)]
    bcs = [scenes.fix(particles.V, scenes.at(0, 0.0))]
    other = mpm.ParticleProblem(R, particles, bcs=bcs, fields=[p], symmetric=True)
    other.solve(steps=2)
    one, two = problem.particles, particles
    for name in ("centroid", "deformation_gradient"):
        np.testing.assert_allclose(getattr(one, name), getattr(two, name), rtol=0.0, atol=1e-9)
    (pressure,) = problem.pressure
    size = scenes.largest(p.x.array)
    assert scenes.largest(pressure.x.array - p.x.array) <= 1e-8 * size
    mean = np.trace(one.point_stress, axis1=2, axis2=3) / 3.0
    ratio = np.linalg.det(one.point_deformation_gradient)
    own = pressure.x.array[: mean.size].reshape(mean.shape)
    assert scenes.largest(mean * ratio - own) <= 1e-12 * size


@pytest.mark.parametrize("law", LAWS, ids=lambda law: type(law).__name__)
def test_the_tangent_against_differences(law):
    problem = beam(law, load=0.1)
    problem.solve(steps=3)
    assert law.inelastic is bool(scenes.largest(problem.particles.plastic_strain) > 0.0)
    assert error_of_blocks(problem, step=1e-6, size=1e-4) <= 1e-6


@pytest.mark.parametrize("cell", [TRIANGLE, TETRAHEDRON, HEXAHEDRON], ids=scenes.name)
def test_other_cells(cell):
    problem = beam(cell=cell)
    problem.solve(steps=1)
    body = problem.particles
    logarithm = np.log(np.linalg.det(body.point_deformation_gradient))
    weighted = (body.point_volumes() * logarithm).sum(axis=1)
    assert abs(scenes.total(body, weighted)) <= 1e-7
    assert error_of_blocks(problem) <= 1e-6


def test_both_routes():
    fast, slow = beam(YIELDING, load=0.1), beam(YIELDING, load=0.1, assembly="reference")
    for problem in (fast, slow):
        problem.solve(steps=2)
    same_run(outcome(fast), outcome(slow), 1e-9)


def test_incompressible_to_the_last_digit():
    """The answer no longer depends on the bulk modulus, nor does the number of solves."""
    found = []
    for poisson in (0.4999999, 0.4999999999):
        problem = beam(Hencky(30.0, poisson))
        problem.solve(steps=2)
        found.append((problem.particles.centroid, problem.history.iterations))
    assert scenes.largest(found[0][0] - found[1][0]) <= 1e-5
    assert found[0][1] == found[1][1]


def shell(law=VonMises(3.0 * 3.8e3, 0.4997, yield_stress=0.5), cells=4):
    """Return a problem of a thick cylinder, one slice of it, that is blown up."""
    inner, outer, height = 1.0, 2.0, 1.0 / cells
    background = scenes.box([0.0, 0.0], [4.0, height], (4 * cells, 1), QUADRILATERAL)
    shape = scenes.box([inner, 0.0], [outer, height], (cells, 1), QUADRILATERAL)
    particles = mpm.Particles(shape, scenes.vectors(background, 2), degree=2, quadrature_degree=4)
    tags = scenes.facet_tags(shape, scenes.at(0, inner))
    axial = fem.locate_dofs_geometrical(
        (particles.V.sub(1), particles.V.sub(1).collapse()[0]), lambda x: x[0] > -1.0
    )
    zero = fem.Function(particles.V.sub(1).collapse()[0])
    bcs = [fem.dirichletbc(zero, axial, particles.V.sub(1))]
    problem = mpm.QuasiStaticProblem(
        particles,
        law,
        axisymmetric=True,
        pressures=[(1.0, 1)],
        facet_tags=tags,
        bcs=bcs,
        mixed="pressure",
    )
    return problem


def test_a_cylinder_against_the_exact_solution():
    """Expansion of a rigid-plastic cylinder (Yu 2000, section 4.2): volume does not change."""
    problem = shell()
    point = mpm.DisplacementControl(problem.particles, 0.6, point=(1.0, 0.0), direction=(1.0, 0.0))
    problem.solve(steps=12, control=point)
    a = 1.6
    exact = -0.5 / np.sqrt(3.0) * np.log(a**2 / (4.0 + a**2 - 1.0))
    assert abs(float(problem.particles.load.value) / exact - 1.0) < 3e-3


def test_the_tangent_of_a_body_of_revolution():
    problem = shell(STIFF)
    point = mpm.DisplacementControl(problem.particles, 0.1, point=(1.0, 0.0), direction=(1.0, 0.0))
    problem.solve(steps=1, control=point)
    assert error_of_blocks(problem, size=1e-4) <= 1e-6


def test_results_do_not_depend_on_the_ranks():
    problem = beam(YIELDING, load=0.1)
    problem.solve(steps=2)
    together = outcome(problem)
    if WORLD.rank == 0:
        alone = beam(YIELDING, comm=MPI.COMM_SELF, load=0.1)
        alone.solve(steps=2)
        index = np.argsort(alone.particles.global_index)
        for name in ("centroid", "stress"):
            expected = getattr(alone.particles, name)[index]
            found = together[f"{name} 0"]
            assert np.abs(found - expected).max() <= 1e-9 * np.abs(expected).max()


def test_restart_and_repartition(tmp_path):
    path = WORLD.bcast(tmp_path / "run.ckpt")
    problem = beam(YIELDING, load=0.1)
    for step in problem.steps(4):
        if step.load == 0.5:
            problem.save(path)
    whole = outcome(problem)
    other = beam(YIELDING, load=0.1)
    other.restore(path)
    before = scenes.largest(other.pressure[0].previous.x.array)
    assert before > 0.0
    other.solve(steps=4)
    same_run(outcome(other), whole, EXACT)
    moved = beam(YIELDING, load=0.1)
    moved.solve(steps=4, repartition=0.0)
    same_run(outcome(moved), whole, 1e-9)


def test_a_failed_step_leaves_the_pressure_as_it_was():
    problem = beam(petsc_options={"snes_max_it": 1})
    problem.particles.load.value = 1.0
    raises(problem.step, mpm.ConvergenceError, "Newton")
    assert not problem.pressure[0].x.array.any()


def test_what_does_not_go_together_is_refused():
    raises(lambda: beam(mixed="volume"), mpm.MPMError, "Unknown mixed='volume'")
    raises(lambda: beam(degree=1), mpm.MPMError, "needs a background and particles of degree 2")
    stress = np.zeros((3, 3))
    raises(lambda: beam(initial_stress=stress), mpm.MPMError, "does not go with mixed=")
    raises(lambda: beam().stage("cut"), mpm.MPMError, "Stages do not go together with fields=")
    raises(lambda: beam(f_bar="domain"), mpm.MPMError, "takes the place of f_bar")
    soil = DruckerPrager(30.0, 0.3, cohesion=1.0, friction_angle=20.0)
    raises(lambda: beam(soil), mpm.MPMError, "not DruckerPrager; use f_bar='patch'")
    raises(lambda: beam().rebase(), mpm.MPMError, "With f_bar, mixed or")
    background = scenes.vectors(scenes.unit(3, QUADRILATERAL), 2)
    body = mpm.Particles(
        scenes.box([0.1] * 2, [0.6] * 2, (3, 3), QUADRILATERAL), background, degree=2
    )
    make = lambda: mpm.DynamicProblem(body, STIFF, 1.0, mixed="pressure")  # noqa: E731
    raises(make, mpm.MPMError, "mixed= is for mpm.QuasiStaticProblem")
