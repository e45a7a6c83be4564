# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The estimated error beside the true one, known or by fine finite elements of degree 2."""

import warnings
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
    cell_tags,
    facet_tags,
    fix,
    in_order,
    neo_hookean,
    total,
    vectors,
)
from scipy.spatial import cKDTree

import basix.ufl
import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx import materials
from mpm_dolfinx.contact import facet_pass

LOAD = 1e-6


def sheared(x):
    """Map a unit square to Cook's membrane, over 48."""
    height = (44.0 - 28.0 * x[:, 0]) / 48.0
    return np.column_stack([x[:, 0], 44.0 / 48.0 * x[:, 0] + height * x[:, 1]])


def cantilever(cells, offset, degree, free=False, cell=QUADRILATERAL, **given):
    """Return a beam that its end's load bends, held by a support on its side."""
    h = 1.0 / cells
    body = box([0, 0], [4, 1], [8 * cells, 2 * cells], cell)
    lower = np.array([-h, -h - offset * h])
    grid = box(
        lower, lower + h * np.array([4 * cells + 3, cells + 3]), [4 * cells + 3, cells + 3], cell
    )
    return bent(body, grid, 4.0, degree, free, **given)


def cook(cells, offset, degree, free=False, **given):
    """Return Cook's membrane, whose elements are no squares."""
    h = 1.0 / cells
    body = box([0, 0], [1, 1], [2 * cells, 2 * cells], QUADRILATERAL)
    body.geometry.x[:, :2] = sheared(body.geometry.x[:, :2].copy())
    lower = np.full(2, -h + offset * h)
    counts = np.array([cells + 3, int(np.ceil(1.25 / h)) + 3])
    grid = box(lower, lower + h * counts, counts, QUADRILATERAL)
    return bent(body, grid, 1.0, degree, free, **given)


def bent(body, grid, end, degree, free, turn=0.0, unit=1.0, law=None, **options):
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
    held = [mpm.boundary.fixed(particles, tags, 1)]
    problem = mpm.QuasiStaticProblem(own, supports=held, **options)
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


SIZES = pytest.mark.parametrize("size", [(4, 1), (4, 2), *slow((8, 1), (8, 2))])
OFFSETS = pytest.mark.parametrize("offset", [0.0, 0.37])


@SIZES
@OFFSETS
@pytest.mark.parametrize("case", [cantilever, cook])
def test_effectivity(case, offset, size):
    cells, degree = size
    problem = case(cells, offset, degree)
    truth = np.sqrt(1.0 - work(problem) / exact(case))
    assert 0.75 * truth < problem.error() < 1.3 * truth


def around(upper, cells, offset, degree):
    """Return a space on a background around a body whose lower corner is the origin."""
    h = 1.0 / cells
    lower = np.full(2, -h - offset * h)
    counts = np.ceil((np.array(upper) - lower) / h + 1.0).astype(int)
    return vectors(box(lower, lower + h * counts, counts.tolist(), QUADRILATERAL), degree)


def footing(cells, offset, degree, free=False):
    """Return half of a stiff footing that is pressed on elastic ground, and sticks to it."""
    whole = box([0, 0], [2, 1.25], [4 * cells, 5 * cells // 2], QUADRILATERAL)
    own = np.arange(whole.topology.index_map(2).size_local, dtype=np.int32)
    middle = mesh.compute_midpoints(whole, 2, own)
    kept = own[(middle[:, 1] < 1.0) | (middle[:, 0] < 0.5)]
    V = None if free else around([2, 1.25], cells, offset, degree)
    body = mpm.Particles(
        mesh.create_submesh(whole, 2, kept)[0], V, degree=degree, quadrature_degree=2 * degree
    )
    tags = facet_tags(body.mesh, at(1, 0.0), at(1, 1.25))
    soil, steel = (materials.LinearElastic(young, 0.25) for young in (2.5, 250.0))
    given = mpm.Body(
        body,
        {1: soil, 2: steel},
        cell_tags=cell_tags(body.mesh, lambda x: 1 + (x[:, 1] > 1.0)),
        tractions=[((0.0, -LOAD), 2)],
        facet_tags=tags,
    )
    problem = mpm.QuasiStaticProblem(given, supports=[mpm.boundary.fixed(body, tags, 1)])
    problem.solve(1)
    return problem


@SIZES
@OFFSETS
def test_effectivity_at_the_edge_of_a_footing(offset, size):
    cells, degree = size
    problem = footing(cells, offset, degree)
    truth = np.sqrt(1.0 - work(problem) / exact(footing))
    assert 0.55 * truth < problem.error() < 1.1 * truth


def strain_energy(v, domain, degree=4, lame=1.0):
    """Return twice the elastic energy of a displacement; the shear modulus is 1."""
    strain = ufl.sym(ufl.grad(v))
    dx = ufl.dx(domain=domain, metadata={"quadrature_degree": degree})
    form = fem.form((2.0 * ufl.inner(strain, strain) + lame * ufl.tr(strain) ** 2) * dx)
    return WORLD.allreduce(fem.assemble_scalar(form))


def vortex(cells, offset, degree):
    """Return a ring that shears in its middle, slowly, and its exact displacement."""
    angle, radius = np.meshgrid(
        2.0 * np.pi * np.arange(8 * cells) / (8 * cells), np.linspace(0.75, 1.25, cells + 1)
    )
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1).reshape(-1, 2)
    number = np.arange(len(points)).reshape(cells + 1, -1)
    after = np.roll(number, -1, axis=1)
    corners = np.stack([number[:-1], number[1:], after[:-1], after[1:]], axis=-1).reshape(-1, 4)
    if WORLD.rank > 0:
        corners, points = corners[:0], points[:0]
    element = basix.ufl.element("Lagrange", "quadrilateral", 1, shape=(2,))
    ring = mesh.create_mesh(WORLD, corners.astype(np.int64), element, points)
    h = 2.0 / cells
    count = int(np.ceil(2.5 / h)) + 3
    lower = np.full(2, -1.25 - h - offset * h)
    grid = box(lower, lower + h * count, [count, count], QUADRILATERAL)
    body = mpm.Particles(ring, vectors(grid, degree), degree=degree, quadrature_degree=2 * degree)
    X = ufl.SpatialCoordinate(ring)
    R = ufl.sqrt(ufl.dot(X, X))
    s, turned = R - 1.0, ufl.as_vector([-X[1], X[0]])
    h0, h1, h2 = 1 - 32 * s**2 + 256 * s**4, -64 * s + 1024 * s**3, -64 + 3072 * s**2
    force = -LOAD * (3.0 * h1 + R * h2) / R * turned
    tags = facet_tags(ring, lambda x: np.hypot(x[0], x[1]) < 0.8)
    given = mpm.Body(body, materials.LinearElastic(2.5, 0.25), density=1.0, body_force=force)
    problem = mpm.QuasiStaticProblem(given, supports=[mpm.boundary.fixed(body, tags, 1)])
    problem.solve(1)
    return problem, LOAD * h0 * turned


@pytest.mark.parametrize("size", [(8, 1), (8, 2), *slow((16, 1), (16, 2))])
@OFFSETS
def test_effectivity_in_a_vortex(offset, size):
    cells, degree = size
    problem, exact_motion = vortex(cells, offset, degree)
    body = problem.particles
    off = strain_energy(body.displacement - exact_motion, body.mesh, 8)
    truth = np.sqrt(off / strain_energy(exact_motion, body.mesh, 8))
    assert 0.55 * truth < problem.error() < 1.1 * truth


def hertz(cells, offset, degree, free=False):
    """Return an elastic block into which a disc is pressed."""
    V = None if free else around([1, 1], cells, offset, degree)
    block = box([0, 0], [1, 1], [2 * cells, 2 * cells], QUADRILATERAL)
    body = mpm.Particles(block, V, degree=degree, quadrature_degree=2 * degree)
    tags = facet_tags(block, at(1, 0.0), at(1, 1.0))
    disc = mpm.contact.disc((0.5, 9.0), 8.0)
    ball = mpm.contact.Rigid(body, disc, facets=(tags, 2), law="nitsche")
    problem = mpm.QuasiStaticProblem(
        mpm.Body(body, materials.LinearElastic(2.5, 0.25)),
        supports=[mpm.boundary.fixed(body, tags, 1)],
        terms=[ball],
    )
    problem.solve(2, update=lambda t: ball.move((0.0, -0.008 * t)))
    return problem.particles, problem.error()


@cache
def fine_hertz():
    return hertz(16, 0.0, 2, free=True)[0]


@SIZES
@OFFSETS
def test_effectivity_in_contact(offset, size):
    """The strain is compared with that of fine finite elements of degree 2."""
    cells, degree = size
    body, found = hertz(cells, offset, degree)
    truth = off_by(body, fine_hertz())
    assert 0.75 * truth < found < 1.3 * truth


def off_by(body, fine, lame=1.0):
    """Return the error of a body's strain beside that of fine finite elements."""
    W, reference = fine.W, fine.displacement
    here = np.arange(W.mesh.topology.index_map(2).size_local, dtype=np.int32)
    between = fem.create_interpolation_data(W, body.W, here, 1e-8)
    moved = fem.Function(W)
    moved.interpolate_nonmatching(body.displacement, here, between)
    moved.x.scatter_forward()
    off = strain_energy(moved - reference, W.mesh, lame=lame)
    return np.sqrt(off / strain_energy(reference, W.mesh, lame=lame))


@cache
def fine_and_incompressible(case):
    return nearly_incompressible(case, 16, 0.0, free=True).particles


def nearly_incompressible(case, cells, offset, free=False):
    law = materials.LinearElastic(2.5, 0.499)
    return case(cells, offset, 2, free, law=law, mixed="pressure")


@pytest.mark.parametrize("cells", [4, *slow(8)])
@pytest.mark.parametrize(("offset", "free"), [(0.0, False), (0.37, False), (0.0, True)])
@pytest.mark.parametrize("case", [*slow(cantilever), cook])
def test_effectivity_with_a_pressure(case, offset, free, cells):
    """Where the pressure is not that of the volume strain, this errs; shear's modulus weighs it."""
    problem = nearly_incompressible(case, cells, offset, free)
    truth = off_by(problem.particles, fine_and_incompressible(case), lame=0.0)
    assert 0.89 * truth < problem.error() < 1.1 * truth


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


def ground(cells, degree, offset=0.37, free=False, law=None, load=0.01, **stress):
    """Return ground that a strip loads, not yet solved, and its loads."""
    V = None if free else around([2, 1], cells, offset, degree)
    body = mpm.Particles(
        box([0, 0], [2, 1], [4 * cells, 2 * cells], QUADRILATERAL),
        V,
        degree=degree,
        quadrature_degree=2 * degree,
    )
    where = {1: mpm.region(y=0.0), 2: mpm.region(x=(-1.0, 0.5), y=1.0), 3: mpm.region(x=0.0)}
    tags = mpm.facet_tags(body.mesh, where | {4: mpm.region(x=2.0)})
    pressure = fem.Constant(body.mesh, (0.0, -load))
    given = mpm.Body(
        body,
        law or materials.LinearElastic(100.0, 0.3),
        tractions=[(pressure, 2)],
        facet_tags=tags,
        f_bar="patch" if law and degree == 1 else "none",
        **stress,
    )
    held = [mpm.boundary.fixed(body, tags, 1)]
    held += [mpm.boundary.roller(body, tags, tag, (side, 0.0)) for tag, side in ((3, -1), (4, 1))]
    return mpm.QuasiStaticProblem(given, supports=held), pressure


@pytest.mark.parametrize("degree", [*slow(1), 2])
def test_initial_stress_is_no_deformation(degree, mpi_tmp_path):
    """Ground that carries its weight already errs by as much as weightless one under a load."""
    plain, _ = ground(4, degree)
    plain.solve(1)
    gravity = (0.0, -1.0)
    weight = {"density": 0.1, "body_force": gravity}  # ten times the load
    weight["initial_stress"] = mpm.geostatic(1.0, 0.1, 0.5, gravity)
    heavy, again = (ground(4, degree, **weight)[0] for _ in range(2))
    heavy.solve(1)
    assert heavy.error() == pytest.approx(plain.error(), rel=0.01)
    heavy.save(mpi_tmp_path / "state")
    again.restore(mpi_tmp_path / "state")
    assert again.error() == pytest.approx(heavy.error(), rel=1e-9)


CLAY = materials.VonMises(1e3, 0.3, rho_y=np.sqrt(2.0))  # its strip bears 2 + pi = 5.14
SAND = materials.MohrCoulomb(1e3, 0.3, 1.0, 20.0, dilation_angle=20.0)  # and this one's 14.83


@cache
def pressed(law, cells, degree, offset, load, free=False):
    """Return ground that a strip loads in steps."""
    problem, pressure = ground(cells, degree, offset, free, law)

    def path(t):
        problem.particles.load.value = 1.0
        pressure.value[1] = -load * t

    problem.solve(4, update=path)
    return problem


def at_points(problem):
    """Return places, weights, stress and logarithmic strain of a body's points."""
    body, points = problem.particles, problem.points[0]
    F = body.point_deformation_gradient
    squares, axes = np.linalg.eigh(F @ F.swapaxes(-1, -2))
    strain = np.einsum("nqik,nqk,nqjk->nqij", axes, 0.5 * np.log(squares), axes)
    stress = points.last.gained_stress(F)
    places = np.einsum("qk,nki->nqi", body.undeformed.rule.shapes, body.initial_domains)
    weights = points.strain.weights.reshape(-1, 1, 1)
    return places.reshape(-1, 2), weights, *(v.reshape(-1, 3, 3) for v in (stress, strain))


def stress_off_by(problem, fine, shear=1e3 / 2.6, bulk=1e3 / 1.2):
    """Return the error of a stress beside that of fine finite elements, in energy."""

    def parts(v):
        mean = np.trace(v, axis1=1, axis2=2)[:, None, None] / 3.0
        return mean, np.linalg.norm(v - mean * np.eye(3), axis=(1, 2))[:, None, None]

    places, _, stress, _ = at_points(problem)
    there, weights, exact, strain = at_points(fine)
    off, size = parts(stress[cKDTree(places).query(there)[1]] - exact), parts(exact)
    whole = 3.0 * np.abs(size[0] * parts(strain)[0]) + size[1] * parts(strain)[1]
    energy = off[0] ** 2 / bulk + off[1] ** 2 / (2.0 * shear)
    return np.sqrt((weights * energy).sum() / (weights * whole).sum())


@pytest.mark.skip_in_parallel
@pytest.mark.parametrize("size", [(4, 1), *slow((4, 2), (8, 1), (8, 2))])
@pytest.mark.parametrize("offset", [0.37, *slow(0.0)])
@pytest.mark.parametrize(
    "case",
    [(CLAY, 4.8, True), *slow((SAND, 10.0, True), (CLAY, 2.3, False), (SAND, 5.0, False))],
    ids=["clay near its limit", "sand near its limit", "clay that hardly yields", "sand"],
)
def test_where_ground_yields_it_is_the_error_of_the_stress(case, offset, size):
    """And that of strains, which is three to six times as large, is told of."""
    (law, load, flows), (cells, degree) = case, size
    fine = pressed(law, 16 if cells == 8 else 8, 2, 0.0, load, free=True)
    problem = pressed(law, cells, degree, offset, load)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        found = problem.error()
    assert any("plastic flow" in str(one.message) for one in told) == flows
    assert 0.5 < found / stress_off_by(problem, fine) < 1.3


@pytest.mark.filterwarnings("ignore:More than a tenth of the distortion")
def test_strain_that_plastic_flow_has_left_is_deformation():
    """Ground that is unloaded has errors of the size that it had under the load."""
    law = materials.VonMises(1e3, 0.3, rho_y=np.sqrt(2.0))
    problem, pressure = ground(4, 1, law=law)

    def load(t):
        problem.particles.load.value = 1.0
        pressure.value[1] = -4.2 * min(2.0 * t, 2.0 - 2.0 * t)

    errors = [problem.error() for _ in problem.steps(4, update=load)]
    assert np.all(problem.particles.plastic_strain < 0.1)
    assert total(problem.particles, problem.particles.plastic_strain) > 0.1
    assert 0.7 * errors[1] < errors[3] < 1.5 * errors[1] < 0.3


def test_locking_is_seen():
    """Nearly incompressible material: without F-bar the error stays, with patches it is small."""
    law = materials.LinearElastic(2.5, 0.4999)
    locked = cantilever(4, 0.37, 1, law=law)
    free = cantilever(4, 0.37, 2, law=law)
    assert locked.error() > 0.6 > 0.15 > free.error()


@pytest.mark.parametrize("cell", [TRIANGLE, *slow(QUADRILATERAL, TETRAHEDRON), HEXAHEDRON])
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


def pressed_by(way):
    """Return a block after a step, what loads it, and the function that sets that.

    By a traction, an obstacle, a support that moves, or a load factor that is found.
    """
    V = vectors(box([-0.5, 0], [2, 2.25], [10, 9], QUADRILATERAL))
    body = mpm.Particles(box([0.2, 0], [1.2, 1], [8, 8], QUADRILATERAL), V)
    tags = facet_tags(body.mesh, at(1, 1.0), at(1, 0.0))
    force, moved = (fem.Constant(body.mesh, (0.0, 0.0)) for _ in range(2))
    own = mpm.Body(
        body,
        materials.VonMises(1e3, 0.3, rho_y=30.0),
        facet_tags=tags,
        tractions=[(force, 1)] if way in ("traction", "control") else [],
    )
    die = mpm.contact.Rigid(body, mpm.contact.disc((0.7, 1.4), 0.4), friction=0.3)
    problem = mpm.QuasiStaticProblem(
        own,
        bcs=[fix(V, at(1, 0.0))],
        supports=[mpm.boundary.fixed(body, tags, 1, value=moved)] if way == "support" else [],
        terms=[die] if way == "obstacle" else [],
    )

    def put(t):
        force.value[:] = (2.0 * t, -20.0 * t)
        moved.value[:] = (0.0, -0.02 * t)
        die.move((0.0, -0.03 * t))

    if way == "control":
        put(1.0)
        control = mpm.DisplacementControl(body, -0.02, point=(0.7, 1.0), direction=(0.0, 1.0))
        problem.solve(2, control=control)
    return problem, put


@pytest.mark.parametrize("way", ["traction", "obstacle", "support", "control"])
def test_it_is_of_the_last_step_or_none(way, mpi_tmp_path):
    """What is set for the next step, or by no path after a restart, is in no error of the last."""
    problem, put = pressed_by(way)
    if way != "control":
        problem.solve(2, update=put)
    found = problem.error()
    assert 0.01 < found < 0.9
    problem.save(mpi_tmp_path / "state")
    put(1.5)
    for ask in (problem.error, problem.error_of_particles):
        raises(ask, mpm.MPMError, "not those of the last converged step any more")
    assert problem.history.steps[-1].error == found
    put(1.0)
    assert problem.error() == pytest.approx(found, rel=1e-6)
    again, put = pressed_by(way)
    again.restore(mpi_tmp_path / "state")
    put(0.0)
    raises(again.error, mpm.MPMError, "not those of the last")
    put(1.0)
    assert again.error() == pytest.approx(found, rel=1e-6)
    put(1.1)
    again.step()
    assert again.error() == again.history.steps[-1].error


def test_it_goes_on_where_particles_leave_and_over_stages():
    """What a step deletes has taken its forces away, and a stage holds back what it changes."""
    V = vectors(box([0, 0], [1.05, 2], [4, 8], QUADRILATERAL))
    body = mpm.Particles(box([0, 0], [1, 1], [8, 8], QUADRILATERAL), V, outside="delete")
    own = mpm.Body(body, materials.Hencky(1e2, 0.3), density=1.0, body_force=(8.0, -20.0))
    problem = mpm.QuasiStaticProblem(own, bcs=[fix(V, at(1, 0.0))])
    for _ in problem.steps(4):
        assert problem.error() > 0.0
    assert problem.history.losses
    before = problem.error()
    problem.stage("dug", problem.body().replace(body_force=(0.0, -20.0)))
    assert problem.error() == pytest.approx(before, rel=1e-6)
    problem.solve(2)
    assert problem.error() > 0.0


def test_contact_that_changes_facets_after_a_step(monkeypatch):
    """Points kept to facets of a step's beginning, which they leave, share their forces anew."""
    monkeypatch.setattr(facet_pass, "FREEZE", 0)
    ground = mpm.Particles(box([0.0, -0.5], [2.0, 0.0], [8, 2], QUADRILATERAL))
    block = mpm.Particles(box([0.3, 0.0], [0.9, 0.4], [3, 2], QUADRILATERAL))
    moved = fem.Constant(block.mesh, (0.0, 0.0))
    top = mpm.facet_tags(block.mesh, {1: mpm.region(y=0.4)})
    problem = mpm.QuasiStaticProblem(
        [mpm.Body(body, materials.Hencky(1e3, 0.3)) for body in (ground, block)],
        bcs=[mpm.held(ground.W, y=-0.5)],
        supports=[mpm.boundary.fixed(block, top, 1, value=moved)],
        terms=[mpm.contact.Pair(block, ground, friction=0.3)],
    )

    def push(t):
        moved.value[:] = (0.4 * t, -0.02)

    for _ in problem.steps(4, update=push):
        assert 0.0 < problem.error() < 1.0
    moved.value[:] = (0.5, -0.02)
    raises(problem.error, mpm.MPMError, "not those of the last converged step any more")
