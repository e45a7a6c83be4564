# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The arrays of Particles under known motions, and its measures."""

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from bad_input import background, touching
from compare import raises
from marks import slow
from scenes import ALL, HEXAHEDRON, PLANE, QUADRILATERAL, TETRAHEDRON, TRIANGLE, WORLD
from scipy.linalg import logm, polar

import basix
import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.meshes.remesh import Remesh


def far_corner(scale):
    """Return a body of triangles, one corner of which is moved out by a factor."""
    domain = scenes.unit(4, TRIANGLE)
    x = domain.geometry.x
    x[(x[:, 0] > 0.9) & (x[:, 1] > 0.9), :2] *= scale
    return domain


def test_one_particle_outside():
    domain = far_corner(3.0)
    expected = touching(domain, lambda x: x[..., 0] > 2.0)
    assert 1 <= len(expected) <= 2
    error = raises(
        lambda: mpm.Particles(domain, scenes.vectors(background())),
        mpm.ParticleOutsideError,
        r"outside the background mesh",
    )
    assert error.particles == expected
    for p in expected:
        assert str(p) in str(error)


def test_outside_is_said_by_a_corner_that_is():
    V = scenes.vectors(scenes.box([0.0, 0.0], [1.0, 1.0], [2, 2], QUADRILATERAL))
    domain = scenes.box([0.5, 0.0], [1.25, 0.5], [1, 1], QUADRILATERAL)
    raises(lambda: mpm.Particles(domain, V), mpm.ParticleOutsideError, r"at \(1\.25, 0\.[05]\)")


STRETCH = np.array([[1.2, 0.3, 0.1], [-0.15, 0.8, 0.05], [0.1, -0.2, 1.1]])


def scene(cell, comm=WORLD, **options):
    """Return particles on a distorted body in a structured background."""
    dim = 3 if cell in (TETRAHEDRON, HEXAHEDRON) else 2
    background = scenes.box(
        [-1.0] * dim, [2.0] * dim, [6] * dim, QUADRILATERAL if dim == 2 else HEXAHEDRON, comm
    )
    body = scenes.bend(scenes.unit(4 if dim == 2 else 2, cell, comm), 0.04)
    return mpm.Particles(body, scenes.vectors(background), **options)


def wave(X):
    """An inhomogeneous displacement, by its values at the nodes."""
    k = np.array([[3.0, 2.0, 1.0], [-1.0, 4.0, 2.0], [2.0, 1.0, -3.0]])[: X.shape[1], : X.shape[1]]
    return 0.05 * np.sin(X @ k + 0.5)


def by_particle(particles, expression, degree=6):
    """Integrate a UFL expression over each undeformed domain with stock DOLFINx."""
    space = fem.functionspace(particles.mesh, ("Discontinuous Lagrange", 0, expression.ufl_shape))
    dx = ufl.dx(domain=particles.mesh, metadata={"quadrature_degree": degree})
    values = fem.assemble_vector(fem.form(ufl.inner(expression, ufl.TestFunction(space)) * dx))
    values = values.array.reshape(-1, *expression.ufl_shape)
    return values[space.dofmap.list[: particles.num_local, 0]]


@pytest.mark.parametrize("cell", ALL, ids=scenes.name)
def test_homogeneous_motion(cell):
    particles = scene(cell)
    dim = particles.mesh.geometry.dim
    A = STRETCH[:dim, :dim]
    X, V0 = particles.initial_centroid.copy(), particles.initial_volume.copy()
    assert abs(scenes.total(particles, V0) - 1.0) < 1e-13
    scenes.move(particles, lambda X: X @ A.T - X + 0.1)
    n = particles.num_local
    F = np.eye(3)
    F[:dim, :dim] = A
    assert particles.deformation_gradient.shape == (n, 3, 3)
    np.testing.assert_allclose(particles.deformation_gradient, np.tile(F, (n, 1, 1)), atol=1e-13)
    np.testing.assert_allclose(particles.volume, np.linalg.det(A) * V0, rtol=1e-12)
    np.testing.assert_allclose(particles.centroid, X @ A.T + 0.1, atol=1e-13)
    np.testing.assert_allclose(particles.initial_centroid, X, atol=1e-15)
    np.testing.assert_allclose(particles.initial_volume, V0, rtol=1e-14)


@pytest.mark.parametrize("quadrature_degree", [None, *slow(3)])
@pytest.mark.parametrize("cell", ALL, ids=scenes.name)
def test_inhomogeneous_motion(cell, quadrature_degree):
    particles = scene(cell, quadrature_degree=quadrature_degree)
    dim, d = particles.mesh.geometry.dim, particles.displacement
    scenes.move(particles, wave)
    X = ufl.SpatialCoordinate(particles.mesh)
    J = ufl.det(ufl.Identity(dim) + ufl.grad(d))
    one = fem.Constant(particles.mesh, 1.0)
    V0 = by_particle(particles, one)
    np.testing.assert_allclose(particles.initial_volume, V0, rtol=1e-13)
    np.testing.assert_allclose(particles.volume, by_particle(particles, J), rtol=1e-12)
    middle, now = (by_particle(particles, x) / V0[:, None] for x in (X, X + d))
    np.testing.assert_allclose(particles.initial_centroid, middle, atol=1e-14)
    np.testing.assert_allclose(particles.centroid, now, atol=1e-14)
    degree = quadrature_degree or 1
    H = by_particle(particles, ufl.grad(d), degree)
    F = np.eye(dim) + H / by_particle(particles, one, degree)[:, None, None]
    np.testing.assert_allclose(particles.deformation_gradient[:, :dim, :dim], F, atol=1e-12)
    assert np.all(particles.deformation_gradient[:, dim:, :dim] == 0.0)
    assert np.all(particles.deformation_gradient[:, dim:, dim:] == (1.0 if dim == 2 else 0.0))


@pytest.mark.parametrize("cell", PLANE, ids=scenes.name)
@pytest.mark.parametrize("kind", ["LinearElastic", "Hencky", "VonMises"])
def test_stress_of_homogeneous_motion(cell, kind):
    # All background dofs are prescribed: the body follows exactly, in one step.
    young, poisson, rho_y = 1e3, 0.3, 20.0
    law = getattr(mpm.materials, kind)
    strength = {"rho_y": rho_y} if kind == "VonMises" else {}
    particles = scene(cell)
    bc, values = scenes.everywhere(particles.V)
    A = STRETCH[:2, :2]
    values.interpolate(lambda x: (A - np.eye(2)) @ x[:2])
    problem = mpm.QuasiStaticProblem(mpm.Body(particles, law(young, poisson, **strength)), bcs=[bc])
    assert np.all(particles.stress == 0.0) and np.all(particles.plastic_strain == 0.0)
    problem.solve(steps=1)

    F = np.eye(3)
    F[:2, :2] = A
    lmbda, mu = scenes.lame(young, poisson)
    small = kind == "LinearElastic"
    strain = (F + F.T) / 2 - np.eye(3) if small else np.real(logm(F @ F.T)) / 2
    dev = 2 * mu * (strain - np.trace(strain) / 3 * np.eye(3))
    kappa = 0.0
    if kind == "VonMises":
        excess = np.linalg.norm(dev) - rho_y
        assert excess > 0
        kappa = np.sqrt(2 / 3) * excess / (2 * mu)
        dev *= rho_y / np.linalg.norm(dev)
    stress = dev + (lmbda + 2 / 3 * mu) * np.trace(strain) * np.eye(3)
    if not small:
        stress /= np.linalg.det(F)
    n = particles.num_local
    assert particles.stress.shape == (n, 3, 3) and particles.plastic_strain.shape == (n,)
    np.testing.assert_allclose(particles.stress, np.tile(stress, (n, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(particles.plastic_strain, kappa, atol=1e-13)
    if kind == "VonMises":
        np.testing.assert_allclose(problem.yield_function, 0.0, atol=1e-13)


def test_particles_without_material_have_no_stress():
    particles = scene(TRIANGLE)
    assert not particles.has_material
    for name in ("stress", "plastic_strain"):
        with pytest.raises(mpm.MPMError, match="no material"):
            getattr(particles, name)


@pytest.mark.parametrize("cell", ALL, ids=scenes.name)
def test_global_index_is_the_same_cell_on_any_number_of_ranks(cell):
    particles, alone = scene(cell), scene(cell, MPI.COMM_SELF)
    assert alone.num_local == alone.num_global == particles.num_global
    assert WORLD.allreduce(particles.num_local) == particles.num_global
    assert particles.global_index.dtype == np.int64
    index = np.sort(scenes.gather(particles.global_index))
    assert np.array_equal(index, np.arange(particles.num_global))
    for particle in (particles, alone):
        scenes.move(particle, wave)
    for name in ("initial_centroid", "centroid", "volume", "deformation_gradient"):
        one = scenes.in_order(alone, getattr(alone, name))
        all_ranks = scenes.in_order(particles, getattr(particles, name))
        np.testing.assert_allclose(all_ranks, one, atol=1e-13)


@pytest.mark.parametrize("cell", ALL, ids=scenes.name)
def test_domain_distortion(cell):
    particles = scene(cell)
    if cell in (TRIANGLE, TETRAHEDRON):
        scenes.move(particles, wave)
        np.testing.assert_allclose(particles.domain_distortion(), 1.0, atol=1e-12)
        return
    dim = particles.mesh.geometry.dim
    scenes.move(particles, lambda X: 3.0 * wave(X))
    # det J at a corner is the volume of the parallelepiped on the edges that meet there.
    offsets = (np.arange(2**dim)[:, None] >> np.arange(dim)) & 1
    x = particles.W.tabulate_dof_coordinates()[:, :dim]
    x = x + particles.displacement.x.array.reshape(-1, dim)
    x = x[particles.W.dofmap.list[: particles.num_local]]
    det = np.empty(x.shape[:2])
    for c, corner in enumerate(offsets):
        edges = [x[:, c ^ (1 << j)] - x[:, c] for j in range(dim)]
        sign = np.prod(1.0 - 2.0 * corner)
        det[:, c] = sign * np.linalg.det(np.stack(edges, axis=1))
    det *= np.sign(det.mean(axis=1))[:, None]
    expected = det.min(axis=1) / particles.volume
    np.testing.assert_allclose(particles.domain_distortion(), expected, atol=1e-11)


def test_domain_distortion_of_a_concave_quadrilateral():
    V = scenes.vectors(scenes.box([-1.0, -1.0], [2.0, 2.0], [3, 3], QUADRILATERAL))
    particles = mpm.Particles(scenes.unit(1, QUADRILATERAL), V)
    expected = []
    for dent in (0.0, 0.25, 0.5, 0.7):
        # the corner (1, 1) goes towards the middle: det J there is 1 - 2 dent, the area 1 - dent
        scenes.move(particles, lambda X, a=dent: -a * (X > 0.5).all(axis=1)[:, None] * [1.0, 1.0])
        expected.append(min(1.0, (1 - 2 * dent) / (1 - dent)))
        np.testing.assert_allclose(particles.domain_distortion(), expected[-1], atol=1e-14)
        assert len(particles.inverted()) == 0


@pytest.mark.filterwarnings("ignore:invalid value encountered in det")
@pytest.mark.parametrize("cell", ALL, ids=scenes.name)
def test_inverted_names_the_domains(cell):
    particles = scene(cell)
    dim = particles.mesh.geometry.dim
    assert len(particles.inverted()) == 0
    mirror = np.diag([-2.0, *[0.0] * (dim - 1)])
    scenes.move(particles, lambda X: X @ mirror, commit=False)
    assert np.array_equal(particles.inverted(), particles.global_index)
    # Only the domains on the left are mirrored.
    scenes.move(particles, lambda X: np.minimum(X - 0.5, 0.0) @ mirror, commit=False)
    left = np.linalg.det(particles.deformation_gradient) <= 0.0
    assert 0 < WORLD.allreduce(left.sum()) < particles.num_global
    assert np.array_equal(particles.inverted(), particles.global_index[left])
    scenes.move(particles, lambda X: np.full_like(X, np.nan), commit=False)
    assert np.array_equal(particles.inverted(), particles.global_index)


@pytest.mark.parametrize("quadrature_degree", [None, 2, *slow(3)])
@pytest.mark.parametrize("shape", [(), *slow((2,)), (2, 3)])
@pytest.mark.parametrize("cell", PLANE, ids=scenes.name)
def test_quadrature_function_layout(cell, shape, quadrature_degree):
    particles = scene(cell, quadrature_degree=quadrature_degree)
    degree = quadrature_degree or 1
    points, _ = basix.make_quadrature(particles.mesh.basix_cell(), degree)
    assert particles.num_points == len(points)
    X = ufl.SpatialCoordinate(particles.mesh)
    cells = np.arange(particles.num_local, dtype=np.int32)
    where = fem.Expression(X, points).eval(particles.mesh, cells).reshape(len(cells), -1, 2)

    data = particles.quadrature_function("data", shape)
    assert data.name == "data" and data.ufl_shape == shape
    factors = np.arange(1.0, 1 + int(np.prod(shape))).reshape(shape)
    values = np.multiply.outer(where[..., 0] + 2 * where[..., 1], factors)
    data.x.array[: values.size] = values.ravel()
    assert data.x.array.reshape(-1, len(points), *shape).shape[1:] == values.shape[1:]

    dx = ufl.dx(domain=particles.mesh, metadata={"quadrature_degree": degree})
    weight = X[0] * X[0] + 0.3
    one = fem.assemble_scalar(fem.form((X[0] + 2 * X[1]) * weight * dx))
    chosen = fem.Constant(particles.mesh, np.zeros(shape))  # one form for all components
    form = fem.form(ufl.inner(data, chosen) * weight * particles.dx)
    for index in np.ndindex(shape):
        chosen.value[...] = 0.0
        chosen.value[index] = 1.0
        injected = fem.assemble_scalar(form)
        direct = factors[index] * one
        assert abs(injected - direct) < 1e-13 * max(1.0, abs(direct))


@pytest.mark.parametrize("cell", [TRIANGLE, *slow(QUADRILATERAL, TETRAHEDRON), HEXAHEDRON])
def test_measures(cell):
    particles = scene(cell)
    u, v = ufl.TrialFunction(particles.W), ufl.TestFunction(particles.W)

    def matrix(dx):
        form = fem.form(ufl.inner(u, v) * dx)
        return fem.assemble_matrix(form).to_scipy().data

    def rule(degree):
        return ufl.dx(domain=particles.mesh, metadata={"quadrature_degree": degree})

    exact = matrix(rule(10))
    size = scenes.largest(exact)
    assert scenes.largest(matrix(particles.dx_exact) - exact) < 1e-13 * size
    assert scenes.largest(matrix(particles.dx) - exact) > 1e-2 * size
    # The history's rule has one point, and it is exact for the linear on simplices.
    constant = fem.Constant(particles.mesh, np.arange(1.0, 1 + len(v)))
    force = [
        fem.assemble_vector(fem.form(ufl.inner(constant, v) * dx)).array
        for dx in (particles.dx, particles.dx_exact, rule(10))
    ]
    assert particles.num_points == 1
    assert scenes.largest(force[1] - force[2]) < 1e-14
    if cell in (TRIANGLE, TETRAHEDRON):
        assert scenes.largest(force[0] - force[2]) < 1e-14


def test_load_and_increment():
    particles = scene(TRIANGLE)
    assert float(particles.load.value) == 0.0
    assert particles.load.ufl_domain() == particles.mesh.ufl_domain()
    assert particles.increment.function_space == particles.V
    assert particles.displacement.function_space == particles.W
    assert particles.W.mesh is particles.mesh


def test_stretched_domain_has_the_polar_parts_of_its_motion():
    # F of a rotated and stretched body: its polar parts are the rotation and the stretch.
    particles = scene(QUADRILATERAL)
    c, s = np.cos(0.7), np.sin(0.7)
    R, U = np.array([[c, -s], [s, c]]), np.array([[1.3, 0.1], [0.1, 0.8]])
    scenes.move(particles, lambda X: X @ (R @ U).T - X)
    for F in particles.deformation_gradient[:3]:
        rotation, stretch = polar(F[:2, :2])
        np.testing.assert_allclose(rotation, R, atol=1e-13)
        np.testing.assert_allclose(stretch, U, atol=1e-13)


def test_tags_of_the_first_mesh_and_of_the_last_eight_are_carried():
    """Each mesh that is known holds communicators, of which there are not many."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 2.0], [4, 4], QUADRILATERAL))
    particles = mpm.Particles(scenes.box([0.2, 0.2], [1.2, 1.2], [3, 3], QUADRILATERAL), V)
    every, none = [], np.zeros((0, 2), dtype=np.int64)
    for _ in range(12):
        every.append(mpm.facet_tags(particles.mesh, {7: mpm.region(x=0.2)}))
        particles.live_on(Remesh(particles.mesh, none), none)
    present = mpm.facet_tags(particles.mesh, {7: mpm.region(x=0.2)})
    own = particles.mesh.topology.index_map(1).size_local
    for number, tags in enumerate(every):
        carried = particles.carry(tags)
        if number == 0 or number >= 12 - 8:
            assert carried is not tags and carried.topology is present.topology, number
            found, here = (tags.indices[tags.indices < own] for tags in (carried, present))
            assert np.array_equal(found, here)
        else:
            assert carried is tags, number


def test_a_body_that_is_dealt_out_anew_at_first_was_not_rebased():
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 2.0], [4, 4], QUADRILATERAL))
    block = scenes.box([0.2, 0.2], [1.2, 1.2], [3, 3], QUADRILATERAL)
    moved = mpm.Particles(block, V)
    moved.repartition()
    assert moved.trail.rebases == 0
