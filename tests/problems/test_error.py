# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The estimated error beside the true one, by fine finite elements of degree 2."""

from functools import cache

from mpi4py import MPI

import numpy as np
import pytest
from compare import raises
from marks import slow
from scenes import (
    HEXAHEDRON,
    QUADRILATERAL,
    TETRAHEDRON,
    TRIANGLE,
    WORLD,
    at,
    box,
    facet_tags,
    fix,
    in_order,
    neo_hookean,
    total,
    vectors,
)

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import materials

LOAD = 1e-6


def sheared(x):
    """Map a unit square to Cook's membrane, over 48."""
    height = (44.0 - 28.0 * x[:, 0]) / 48.0
    return np.column_stack([x[:, 0], 44.0 / 48.0 * x[:, 0] + height * x[:, 1]])


def cantilever(cells, offset, degree, free=False, cell=QUADRILATERAL, turn=0.0, unit=1.0, law=None):
    """Return a beam that its end's load bends, held by a support on its side."""
    h = 1.0 / cells
    body = box([0, 0], [4, 1], [8 * cells, 2 * cells], cell)
    lower = np.array([-h, -h - offset * h])
    grid = box(
        lower, lower + h * np.array([4 * cells + 3, cells + 3]), [4 * cells + 3, cells + 3], cell
    )
    return bent(body, grid, 4.0, degree, free, turn, unit, law)


def cook(cells, offset, degree, free=False):
    """Return Cook's membrane, whose elements are no squares."""
    h = 1.0 / cells
    body = box([0, 0], [1, 1], [2 * cells, 2 * cells], QUADRILATERAL)
    body.geometry.x[:, :2] = sheared(body.geometry.x[:, :2].copy())
    lower = np.full(2, -h + offset * h)
    counts = np.array([cells + 3, int(np.ceil(1.25 / h)) + 3])
    grid = box(lower, lower + h * counts, counts, QUADRILATERAL)
    return bent(body, grid, 1.0, degree, free)


def bent(body, grid, end, degree, free, turn=0.0, unit=1.0, law=None):
    """Return a problem with a load on one end, and that end's tags; turned, in another unit."""
    tags = facet_tags(body, at(0, 0.0), at(0, end))
    c, s = np.cos(turn), np.sin(turn)
    for domain in (body, grid):
        domain.geometry.x[:, :2] = unit * domain.geometry.x[:, :2] @ np.array([[c, s], [-s, c]])
    V = None if free else vectors(grid, degree)
    particles = mpm.Particles(body, V, degree=degree, quadrature_degree=2 * degree)
    young = 2.5 / unit**2
    own = mpm.Body(
        particles,
        materials.LinearElastic(young, 0.25) if law is None else law,
        tractions=[((LOAD / unit**2 * s, -LOAD / unit**2 * c), 2)],
        facet_tags=tags,
    )
    problem = mpm.QuasiStaticProblem(own, supports=[mpm.boundary.fixed(particles, tags, 1)])
    problem.solve(1)
    return problem


def work(problem):
    """Return the work of the load, over its square."""
    (traction, tag), *_ = problem.body().tractions
    body = problem.particles
    ds = ufl.Measure("ds", domain=body.mesh, subdomain_data=problem.body().facet_tags)
    form = ufl.inner(ufl.as_vector(traction), body.displacement) * ds(tag)
    return WORLD.allreduce(fem.assemble_scalar(fem.form(form))) / LOAD**2


@cache
def exact(case):
    """Return the work in the limit, extrapolated."""
    coarse, middle, fine = (work(case(n, 0.0, 2, free=True)) for n in (4, 8, 16))
    ratio = (middle - coarse) / (fine - middle)
    return fine + (fine - middle) / (ratio - 1.0)


@pytest.mark.parametrize("size", [(4, 1), (4, 2), *slow((8, 1), (8, 2))])
@pytest.mark.parametrize("offset", [0.0, 0.37])
@pytest.mark.parametrize("case", [cantilever, cook])
def test_effectivity(case, offset, size):
    cells, degree = size
    problem = case(cells, offset, degree)
    truth = np.sqrt(1.0 - work(problem) / exact(case))
    assert 0.75 * truth < problem.error() < 1.3 * truth


@pytest.mark.parametrize("degree", [1, 2])
def test_finite_elements_have_the_error_of_their_mesh(degree):
    problem = cook(8, 0.0, degree, free=True)
    truth = np.sqrt(1.0 - work(problem) / exact(cook))
    assert 0.85 * truth < problem.error() < 1.3 * truth


def test_uniform_strain_has_none():
    """What the background can do exactly has no error, wherever its cells are."""
    V = vectors(box([-0.3, -0.3], [1.5, 1.5], [6, 6], QUADRILATERAL))
    body = mpm.Particles(box([0, 0], [1, 1], [8, 8], QUADRILATERAL), V)
    tags = facet_tags(body.mesh, at(1, 0.0), at(1, 1.0), at(0, 0.0))
    own = mpm.Body(
        body, materials.Hencky(1e3, 0.3), tractions=[((0.0, -100.0), 2)], facet_tags=tags
    )
    held = [
        mpm.boundary.roller(body, tags, 1, (0.0, -1.0), penalty=1e6),
        mpm.boundary.roller(body, tags, 3, (-1.0, 0.0), penalty=1e6),
    ]
    problem = mpm.QuasiStaticProblem(own, supports=held)
    problem.solve(2)
    assert problem.error() < 1e-4
    assert problem.history.steps[-1].error == problem.error()
    assert problem.history.steps[0].error is None


def test_shares_of_particles_add_up_and_tell_where():
    problem = cantilever(4, 0.37, 1)
    body, shares = problem.particles, problem.error_of_particles()
    assert total(body, shares**2) == pytest.approx(problem.error() ** 2, rel=1e-12)
    clamped = body.initial_centroid[:, 0] < 1.0  # of a length of 4
    assert total(body, shares[clamped] ** 2) > 0.5 * problem.error() ** 2


@pytest.mark.parametrize("degree", [1, 2])
def test_it_is_the_same_turned_and_in_other_units(degree):
    plain = cantilever(4, 0.37, degree).error()
    assert cantilever(4, 0.37, degree, turn=0.7).error() == pytest.approx(plain, rel=1e-6)
    assert cantilever(4, 0.37, degree, unit=1e3).error() == pytest.approx(plain, rel=1e-6)


def test_locking_is_seen():
    """Nearly incompressible material: without F-bar the error stays, with patches it is small."""
    law = materials.LinearElastic(2.5, 0.4999)
    locked = cantilever(4, 0.37, 1, law=law)
    free = cantilever(4, 0.37, 2, law=law)
    assert locked.error() > 0.6 > 0.15 > free.error()


@pytest.mark.parametrize("cell", [TRIANGLE, QUADRILATERAL, TETRAHEDRON, HEXAHEDRON])
def test_it_falls_with_the_cells(cell):
    errors = []
    for n in (2, 4):
        dim = 3 if cell in (TETRAHEDRON, HEXAHEDRON) else 2
        V = vectors(box([-0.5] * dim, [1.5] * dim, [2 * n] * dim, cell))
        body = mpm.Particles(box([0] * dim, [1] * dim, [2 * n] * dim, cell), V)
        force = np.eye(dim)[0] * 10.0
        own = mpm.Body(body, materials.Hencky(1e3, 0.3), density=1.0, body_force=tuple(force))
        tags = facet_tags(body.mesh, at(dim - 1, 0.0))
        problem = mpm.QuasiStaticProblem(own, supports=[mpm.boundary.fixed(body, tags, 1)])
        problem.solve(2)
        errors.append(problem.error())
    assert 0.3 < errors[1] / errors[0] < 0.85


def test_a_residual_in_ufl():
    """Without a material only what the background cannot do is seen."""
    V = vectors(box([-0.3, -0.3], [1.5, 1.5], [6, 6], QUADRILATERAL))
    body = mpm.Particles(box([0, 0], [1, 1], [12, 12], QUADRILATERAL), V, quadrature_degree=2)
    d, v = body.displacement, ufl.TestFunction(body.W)
    force = body.load * fem.Constant(body.mesh, (20.0, -50.0))
    R = ufl.derivative(neo_hookean(d) * body.dx, d, v) - ufl.inner(force, v) * body.dx
    R += 1e6 * ufl.inner(d, v) * ufl.ds(subdomain_data=facet_tags(body.mesh, at(1, 0.0)))(1)
    problem = mpm.ParticleProblem(R, body)
    problem.solve(2)
    assert 0.02 < problem.error() < 0.2


def test_plastic_steps_and_several_bodies():
    law = materials.VonMises(1e3, 0.3, rho_y=8.0)
    V = vectors(box([0, 0], [2, 2.25], [8, 9], QUADRILATERAL))
    bodies = [
        mpm.Particles(box([0.2, low], [1.2, low + 1.0], [8, 8], QUADRILATERAL), V)
        for low in (0.0, 1.0)
    ]
    given = [mpm.Body(b, law, density=1.0, body_force=(0.0, -4.0), f_bar="patch") for b in bodies]
    problem = mpm.QuasiStaticProblem(given, bcs=[fix(V, at(1, 0.0))])
    for _ in problem.steps(4):
        assert 0.0 < problem.error() < 0.5
    assert all(step.error is not None for step in problem.history.steps)
    whole = sum(total(b, problem.error_of_particles(n) ** 2) for n, b in enumerate(bodies))
    assert whole == pytest.approx(problem.error() ** 2, rel=1e-12)
    before = [body.stress for body in bodies]
    problem.error()
    for body, stress in zip(bodies, before, strict=True):
        np.testing.assert_array_equal(body.stress, stress)
    raises(lambda: problem.error_of_particles(2), mpm.MPMError, "no body 2")


def test_it_is_the_same_on_any_number_of_ranks():
    found = []
    for comm in (MPI.COMM_SELF, WORLD):
        V = vectors(box([0, 0], [2, 2.25], [8, 9], QUADRILATERAL, comm))
        body = mpm.Particles(box([0.2, 0], [1.2, 2], [8, 16], QUADRILATERAL, comm), V)
        law = materials.VonMises(1e3, 0.3, rho_y=8.0)
        own = mpm.Body(body, law, density=1.0, body_force=(0.0, -4.0), f_bar="patch")
        problem = mpm.QuasiStaticProblem(own, bcs=[fix(V, at(1, 0.0))])
        problem.solve(3)
        found.append((problem.error(), in_order(body, problem.error_of_particles())))
    assert found[1][0] == pytest.approx(found[0][0], rel=1e-9)
    np.testing.assert_allclose(found[1][1], found[0][1], rtol=1e-7, atol=1e-9 * found[0][0])


def test_it_does_not_disturb_a_run():
    """Steps with an estimate between them are those without."""
    ends = []
    for asked in (False, True):
        law = materials.VonMises(1e3, 0.3, rho_y=8.0)
        V = vectors(box([0, 0], [2, 2.25], [8, 9], QUADRILATERAL))
        body = mpm.Particles(box([0.2, 0], [1.2, 2], [8, 16], QUADRILATERAL), V)
        own = mpm.Body(body, law, density=1.0, body_force=(0.0, -4.0), f_bar="patch")
        problem = mpm.QuasiStaticProblem(own, bcs=[fix(V, at(1, 0.0))])
        for _ in problem.steps(4):
            _ = problem.error() if asked else None
        ends.append(in_order(body, body.centroid))
    np.testing.assert_allclose(ends[1], ends[0], rtol=0.0, atol=1e-13)


def test_it_is_the_same_after_a_restart(mpi_tmp_path):
    def made():
        V = vectors(box([0, 0], [2, 2.25], [8, 9], QUADRILATERAL))
        body = mpm.Particles(box([0.2, 0], [1.2, 2], [8, 16], QUADRILATERAL), V)
        law = materials.VonMises(1e3, 0.3, rho_y=8.0)
        own = mpm.Body(body, law, density=1.0, body_force=(0.0, -4.0), f_bar="patch")
        return mpm.QuasiStaticProblem(own, bcs=[fix(V, at(1, 0.0))])

    problem, again = made(), made()
    problem.solve(3)
    problem.save(mpi_tmp_path / "state")
    again.restore(mpi_tmp_path / "state")
    assert again.error() == pytest.approx(problem.error(), rel=1e-9)


def test_a_motion_has_none():
    V = vectors(box([0, 0], [1, 1], [2, 2], QUADRILATERAL))
    body = mpm.Particles(box([0, 0], [1, 1], [4, 4], QUADRILATERAL), V)
    problem = mpm.DynamicProblem(mpm.Body(body, materials.Hencky(1e3, 0.3), density=1.0))
    raises(problem.error, mpm.MPMError, "in no equilibrium")
