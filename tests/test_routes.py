# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The fast route against the reference route: DOLFINx's assembly and PETSc's products."""

import numpy as np
import pytest
import scenes

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx._core import loops

pytestmark = pytest.mark.skipif(loops is None, reason="the package was built without a compiler")

QUADRILATERAL, TRIANGLE = mesh.CellType.quadrilateral, mesh.CellType.triangle
HEXAHEDRON, TETRAHEDRON = mesh.CellType.hexahedron, mesh.CellType.tetrahedron
PLASTIC = mpm.materials.VonMises(1e3, 0.3, rho_y=5.0, hardening=20.0)


def space(dim, degree=1, cell=None):
    cell = cell or (QUADRILATERAL if dim == 2 else HEXAHEDRON)
    n = 6 if dim == 2 else 4
    return scenes.vectors(scenes.box([-1.0] * dim, [2.0] * dim, [n] * dim, cell), degree)


def bent(cell, corner=0.1):
    dim = 3 if cell in (HEXAHEDRON, TETRAHEDRON) else 2
    n = 4 if dim == 2 else 2
    body = scenes.box([corner] * dim, [corner + 1.0] * dim, [n] * dim, cell)
    x = body.geometry.x[:, :dim]
    x += 0.04 * np.sin(3.0 * x[:, ::-1])
    return body


def floor(V):
    """Fix a row of dofs, so that some columns of T go."""
    dim = V.mesh.geometry.dim
    component, _ = V.sub(dim - 1).collapse()
    at = fem.locate_dofs_geometrical(
        (V.sub(dim - 1), component), lambda x: np.isclose(x[dim - 1], 0.5)
    )
    moved = fem.Function(component)
    moved.x.array[:] = -0.05
    return fem.dirichletbc(moved, at, V.sub(dim - 1))


def quasi_static(particles, assembly, **options):
    V = (particles[0] if isinstance(particles, list) else particles).V
    dim = V.mesh.geometry.dim
    options.setdefault("material", PLASTIC)
    return mpm.QuasiStaticProblem(
        particles,
        density=2.0,
        body_force=(0.5,) * dim,
        bcs=[floor(V)],
        assembly=assembly,
        **options,
    )


def compare(make):
    """Compare residual, tangent and lift of both routes at the same state (collective)."""
    found = []
    for assembly in ("fast", "reference"):
        problem = make(assembly)
        system = problem.reduced
        change = np.zeros(len(problem.bodies[0].increment.x.array))
        problem.bcs[0].set(change, None, 1.0)
        for body in problem.bodies:
            body.load.value = 1.0
        system.begin(change, 1.0)
        first, local = system.sizes[1], system.sizes[0]
        problem._newton._start(system.sizes)
        x, F = problem._newton.x, problem._newton.F
        assert system.residual(x, F) is None
        system.tangent()
        system.impose()
        start = x.getOwnershipRange()[0]
        x.array_w[:] = 0.02 * np.sin(1.7 * (start + np.arange(local)))
        assert system.residual(x, F) is None
        K = system.tangent()
        lift = system.lift()
        modulus = [share.shear_modulus() for share in problem.shares]
        found.append((F.copy(), K.copy(), lift, system.motion(x), modulus, first))
    fast, reference = found
    assert fast[5] == reference[5] > 0
    for a, b in zip(fast[:3], reference[:3], strict=True):
        size = b.norm()
        assert size > 0.0
        a.axpy(-1.0, b)
        assert a.norm() < 1e-12 * size
    assert fast[3] == pytest.approx(reference[3], rel=1e-12)
    assert fast[4] == pytest.approx(reference[4], rel=1e-10)


CELLS = [QUADRILATERAL, TRIANGLE, HEXAHEDRON, TETRAHEDRON]


@pytest.mark.parametrize("cell", CELLS, ids=scenes.name)
@pytest.mark.parametrize("rule", [None, 2])
def test_domains_of_any_cell_and_rule(cell, rule):
    dim = 3 if cell in (HEXAHEDRON, TETRAHEDRON) else 2
    particles = mpm.Particles(bent(cell), space(dim), quadrature_degree=rule)
    compare(lambda assembly: quasi_static(particles, assembly))


@pytest.mark.parametrize("method", ["cpdi", "gimp", "mpm"])
def test_other_methods(method):
    body = scenes.box([0.1, 0.1], [1.1, 1.1], [4, 4], QUADRILATERAL)
    particles = mpm.Particles(body, space(2), method=method)
    compare(lambda assembly: quasi_static(particles, assembly))


@pytest.mark.parametrize("cell", [QUADRILATERAL, TRIANGLE], ids=scenes.name)
def test_degree_two(cell):
    particles = mpm.Particles(bent(cell), space(2, 2), degree=2)
    compare(lambda assembly: quasi_static(particles, assembly))


@pytest.mark.parametrize("stabilisation", ["ghost", "aggregate"])
def test_stabilised(stabilisation):
    particles = mpm.Particles(bent(QUADRILATERAL), space(2, 2), degree=2)
    compare(lambda assembly: quasi_static(particles, assembly, stabilisation=stabilisation))


@pytest.mark.parametrize("cell", [QUADRILATERAL, HEXAHEDRON], ids=scenes.name)
def test_f_bar_over_domains(cell):
    dim = 3 if cell == HEXAHEDRON else 2
    particles = mpm.Particles(bent(cell), space(dim), quadrature_degree=2)
    compare(lambda assembly: quasi_static(particles, assembly, f_bar="domain"))


def test_triangular_background():
    particles = mpm.Particles(bent(TRIANGLE), space(2, 1, TRIANGLE))
    compare(lambda assembly: quasi_static(particles, assembly))


def test_two_bodies():
    V = space(2)
    bodies = [mpm.Particles(bent(QUADRILATERAL, c), V) for c in (0.1, -0.9)]
    compare(lambda assembly: quasi_static(bodies, assembly))


def test_body_of_revolution():
    particles = mpm.Particles(bent(QUADRILATERAL), space(2))
    compare(lambda assembly: quasi_static(particles, assembly, axisymmetric=True))


def test_follower_pressure():
    body = bent(QUADRILATERAL)
    facets = (
        mesh.exterior_facet_indices(body.topology)
        if body.topology.create_connectivity(1, 2) is None
        else None
    )
    tags = mesh.meshtags(body, 1, facets, np.full(len(facets), 7, dtype=np.int32))
    particles = mpm.Particles(body, space(2))
    compare(
        lambda assembly: quasi_static(particles, assembly, pressures=[(3.0, 7)], facet_tags=tags)
    )


@pytest.mark.parametrize("term", ["cells", "tagged cells", "facets", "inner facets"])
def test_ufl_terms(term):
    body = bent(QUADRILATERAL)
    particles = mpm.Particles(body, space(2))
    d, v = particles.displacement, ufl.TestFunction(particles.W)
    C = (ufl.Identity(2) + ufl.grad(d)).T * (ufl.Identity(2) + ufl.grad(d))
    k = fem.Constant(body, 3.0)
    R = ufl.derivative(k * ufl.inner(C, C) * particles.dx, d, v)
    if term == "tagged cells":
        n = body.topology.index_map(2).size_local
        tags = mesh.meshtags(
            body, 2, np.arange(n, dtype=np.int32), np.arange(n, dtype=np.int32) % 2
        )
        dx = ufl.Measure("dx", domain=body, subdomain_data=tags)
        R += k * ufl.inner(d, v) * dx(1)
    if term == "facets":
        R += k * ufl.inner(d, v) * ufl.ds(body)
    if term == "inner facets":
        R += k * ufl.inner(ufl.jump(ufl.grad(d)), ufl.jump(ufl.grad(v))) * ufl.dS(body)
    compare(
        lambda assembly: mpm.ParticleProblem(
            R, particles, bcs=[floor(particles.V)], assembly=assembly
        )
    )


def sink(assembly):
    """Let a block sink a little into itself, its bottom held in both directions."""
    V = space(2)
    particles = mpm.Particles(bent(QUADRILATERAL), V)
    held = fem.locate_dofs_geometrical(V, lambda x: x[1] < 0.6)
    problem = mpm.QuasiStaticProblem(
        particles,
        mpm.materials.Hencky(1e4, 0.3),
        body_force=(0.0, -300.0),
        bcs=[fem.dirichletbc(np.zeros(2), held, V)],
        assembly=assembly,
    )
    problem.solve(4)
    return problem


def test_pattern_lasts_while_no_node_changes_its_cell():
    fast, reference = sink("fast"), sink("reference")
    statistics = fast.history.statistics
    assert 1 <= statistics["patterns"] < statistics["transfers"] == 4
    there = reference.particles.displacement.x.array
    largest = scenes.largest(there)
    assert largest > 1e-3
    assert fast.particles.displacement.x.array == pytest.approx(there, abs=1e-11 * largest)


def test_unknown_route():
    particles = mpm.Particles(bent(QUADRILATERAL), space(2))
    with pytest.raises(mpm.MPMError, match="assembly='fused'; choose 'auto', 'fast'"):
        quasi_static(particles, "fused")
