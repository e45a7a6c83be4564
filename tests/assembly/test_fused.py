# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Tangents of the compiled loops against DOLFINx's assembly and PETSc's products."""

from itertools import product

import numpy as np
import pytest
import scenes
from marks import thinned
from posed import posed
from routes import on_route

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx._core import loops
from mpm_dolfinx.assembly import supports

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
    lower = np.full(dim, corner) if np.isscalar(corner) else np.array(corner)
    body = scenes.box(lower, lower + 1.0, [n] * dim, cell)
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


def quasi_static(particles, **options):
    V = (particles[0] if isinstance(particles, list) else particles).V
    dim = V.mesh.geometry.dim
    options.setdefault("material", PLASTIC)
    return posed(
        mpm.QuasiStaticProblem,
        particles,
        density=2.0,
        body_force=(0.5,) * dim,
        bcs=[floor(V)],
        **options,
    )


def evaluated(make, symmetric):
    """Return residual, tangent and what follows from them in one state (collective)."""
    problem = make()
    system = problem.reduced
    change = np.zeros(len(problem.bodies[0].increment.x.array))
    problem.bcs[0].set(change, None, 1.0)
    for body in problem.bodies:
        body.load.value = 1.0
    system.begin([change], 1.0)
    first, local = system.unknowns.sizes[1], system.unknowns.sizes[0]
    problem.trial.newton._start(system.unknowns.sizes)
    x, F = problem.trial.newton.x, problem.trial.newton.F
    assert system.residual(x, F) is None
    system.tangent()
    system.impose()
    start = x.getOwnershipRange()[0]
    x.array_w[:] = 0.02 * np.sin(1.7 * (start + np.arange(local)))
    assert system.residual(x, F) is None
    K = system.tangent()
    lift = system.lift()
    modulus = [share.shear_modulus() for share in problem.built.body_terms]
    if symmetric:
        skew = K.copy()
        skew.transpose()
        skew.axpy(-1.0, K)
        assert skew.norm() < 1e-13 * K.norm()
    return F.copy(), K.copy(), lift, system.resistance.motion(x), modulus, first, system.balance


def compare(make, symmetric=False, sizes=False):
    """Compare residual, tangent and lift with the reference at the same state (collective).

    And the forces that domains add in absolute values, which that tests domain by domain.
    """
    found = evaluated(make, symmetric)
    with on_route("reference"):
        reference = evaluated(make, symmetric)
    assert found[5] == reference[5] > 0
    for a, b in zip(found[:3], reference[:3], strict=True):
        size = b.norm()
        assert size > 0.0
        a.axpy(-1.0, b)
        assert a.norm() < 1e-12 * size
    assert found[3] == pytest.approx(reference[3], rel=1e-12)
    assert found[4] == pytest.approx(reference[4], rel=1e-10)
    if sizes:
        scales = [balance.internal_scale() for *_, balance in (found, reference)]
        assert scales[0] == pytest.approx(scales[1], rel=1e-12)


CELLS = [QUADRILATERAL, TRIANGLE, HEXAHEDRON, TETRAHEDRON]


@pytest.mark.parametrize("cell", CELLS, ids=scenes.name)
@pytest.mark.parametrize("rule", [None, 2])
def test_domains_of_any_cell_and_rule(cell, rule):
    dim = 3 if cell in (HEXAHEDRON, TETRAHEDRON) else 2
    particles = mpm.Particles(bent(cell), space(dim), quadrature_degree=rule)
    compare(lambda: quasi_static(particles))


@pytest.mark.parametrize("method", ["cpdi", "gimp", "mpm"])
def test_other_methods(method):
    body = scenes.box([0.1, 0.1], [1.1, 1.1], [4, 4], QUADRILATERAL)
    particles = mpm.Particles(body, space(2), method=method)
    compare(lambda: quasi_static(particles))


@pytest.mark.parametrize("cell", [QUADRILATERAL, TRIANGLE], ids=scenes.name)
def test_degree_two(cell):
    particles = mpm.Particles(bent(cell), space(2, 2), degree=2)
    compare(lambda: quasi_static(particles))


def test_stabilised():
    particles = mpm.Particles(bent(QUADRILATERAL), space(2, 2), degree=2)
    compare(lambda: quasi_static(particles, stabilisation="ghost"))


def test_motion_with_moving_supports():
    particles = mpm.Particles(bent(QUADRILATERAL), space(2))
    compare(
        lambda: posed(
            mpm.DynamicProblem,
            particles,
            PLASTIC,
            density=2.0,
            body_force=(0.5, 0.5),
            bcs=[floor(particles.V)],
        )
    )


def test_the_tangent_is_one_matrix_where_a_penalty_ties_cells():
    for corner in (0.0, 0.1, 0.26):
        particles = mpm.Particles(bent(QUADRILATERAL, corner), space(2))
        problem = quasi_static(particles, stabilisation="ghost")
        K = evaluated(lambda made=problem: made, False)[1]
        assert problem.history.statistics["ghost_facets"] > 0
        bare = problem.reduced.tangent.loops.assemble()
        whole = problem.reduced.tangent()
        assert whole is bare  # no sum of two matrices
        whole.axpy(-1.0, K)
        assert whole.norm() < 1e-13 * K.norm()


@pytest.mark.parametrize("degree", [1, 2])
def test_groups_of_domains_do_not_matter(degree, monkeypatch):

    def tangent(most):
        monkeypatch.setattr(supports, "GROUP", most)
        particles = mpm.Particles(bent(QUADRILATERAL), space(2, degree), degree=degree)
        problem = quasi_static(particles)
        return evaluated(lambda: problem, False)[1]

    reference = tangent(1)
    scale = reference.norm()
    for most in (12, 48, 1000):
        K = tangent(most)
        assert K.getInfo()["nz_used"] == reference.getInfo()["nz_used"]
        K.axpy(-1.0, reference)
        assert K.norm() < 1e-14 * scale


def test_groups_see_fewer_pairs_than_their_domains():
    dofmap = np.array([[0, 1], [1, 2], [2, 3], [3, 4]], dtype=np.int32)
    near = np.array([0, 0, 1, 1, 9], dtype=np.int32)  # the node of each row of T
    ends, weights = np.arange(6, dtype=np.int64), np.ones(5)
    order, free = np.arange(4, dtype=np.int32), np.zeros(0, dtype=np.int64)
    first, (offsets, slots, starts, nodes) = loops.supports(
        dofmap, ends, near, weights, order, free, 3
    )
    # Nodes {0}, {0, 1}, {1}, {1, 9}: ten pairs one by one, nine of the three nodes together.
    assert first.tolist() == [0, 4] and nodes.tolist() == [0, 1, 9] and starts.tolist() == [0, 3]
    assert offsets.tolist() == [0, 1, 3, 4, 6] and slots.tolist() == [0, 0, 1, 1, 1, 2]
    apart = loops.supports(dofmap, ends, np.arange(5, dtype=np.int32), weights, order, free, 9)
    assert apart[0].tolist() == [0, 1, 2, 3, 4]  # 16 pairs one by one, 25 together


@pytest.mark.parametrize(("count", "size"), [(40, 1), (300, 2)])
def test_positions_take_as_many_bytes_as_rows_are_long(count, size):
    nodes = np.arange(0, 2 * count, 2, dtype=np.int32)
    offsets = np.array([0, count, 2 * count], dtype=np.int64)
    seen = offsets, np.concatenate([nodes, nodes + 1]), 2 * count
    ends, columns, pairs, positions, found = loops.pattern(
        *seen, *seen, np.zeros(0, dtype=np.uint8)
    )
    assert found == size and pairs.tolist() == [0, count**2, 2 * count**2]
    places = positions.view(f"u{size}").reshape(2, count, count)
    for domain in range(2):
        for row in (0, count - 1):
            begin = ends[2 * row + domain]
            assert np.array_equal(columns[begin + places[domain, row]], nodes + domain)


def boundary_tags(body):
    """Tag all facets of the boundary with 7."""
    dim = body.topology.dim - 1
    body.topology.create_connectivity(dim, dim + 1)
    facets = mesh.exterior_facet_indices(body.topology)
    return mesh.meshtags(body, dim, facets, np.full(len(facets), 7, dtype=np.int32))


@pytest.mark.parametrize(
    ("kind", "f_bar", "degree", "follower", "bodies"),
    thinned(
        7,
        product(
            ["plane", "axisymmetric", "space"],
            ["none", "domain", "patch"],
            [1, 2],
            [False, True],
            [1, 2],
        ),
    ),
)
def test_every_combination(kind, f_bar, degree, follower, bodies):
    plane = kind != "space"
    cell = QUADRILATERAL if plane else HEXAHEDRON
    V = space(2 if plane else 3, degree)
    corners = [[0.1, 0.1, 0.1], [0.1, -0.9, -0.9]][:bodies]
    meshes = [bent(cell, corner[: 2 if plane else 3]) for corner in corners]
    rule = 2 if f_bar == "domain" and degree == 1 else None
    particles = [mpm.Particles(body, V, degree=degree, quadrature_degree=rule) for body in meshes]
    loads = {}
    if follower:
        loads = {
            "pressures": [[(3.0, 7)] for _ in meshes],
            "facet_tags": [boundary_tags(body) for body in meshes],
        }

    def make():
        return quasi_static(particles, f_bar=f_bar, axisymmetric=kind == "axisymmetric", **loads)

    compare(make, symmetric=not follower)


class Friction(mpm.materials.ReturnMapping):
    """Drucker and Prager's yield surface with isochoric flow: the tangent is not symmetric."""

    def yield_function(self, stress, plastic_strain):
        trace = mpm.materials.mandel.trace(stress)
        return self.plastic_potential(stress, plastic_strain) + 0.03 * trace - 40.0

    def plastic_potential(self, stress, plastic_strain):
        return mpm.materials.mandel.norm(mpm.materials.mandel.deviator(stress))


@pytest.mark.parametrize("axisymmetric", [False, True], ids=["plane", "axisymmetric"])
@pytest.mark.parametrize(
    ("f_bar", "rule"),
    thinned(3, [("none", 2), ("none", 1), ("domain", 2), ("patch", 1), ("patch", 2)]),
)
def test_a_law_without_symmetry_beside_deleted_domains(f_bar, rule, axisymmetric):
    particles = mpm.Particles(
        bent(QUADRILATERAL), space(2), quadrature_degree=rule, outside="delete"
    )
    particles.commit()
    particles.placement.leaving(True)
    particles.placement.delete(np.flatnonzero(particles.global_index == 5))
    law = Friction(1e3, 0.3)
    compare(lambda: quasi_static(particles, material=law, f_bar=f_bar, axisymmetric=axisymmetric))


def test_stabilised_patches_of_revolution():
    particles = mpm.Particles(bent(QUADRILATERAL), space(2, 2), degree=2)
    compare(
        lambda: quasi_static(particles, stabilisation="ghost", f_bar="patch", axisymmetric=True)
    )


@pytest.mark.parametrize(("over", "rule"), [("domain", 2), ("patch", 1)])
def test_averaged_volume_ratio(over, rule):
    particles = mpm.Particles(bent(QUADRILATERAL), space(2), quadrature_degree=rule)
    F = ufl.Identity(2) + ufl.grad(particles.displacement)

    def make():
        ratio = mpm.AveragedVolumeRatio(particles, over)
        energy = 5.0 * ufl.inner(F, F) / ufl.det(F) + 300.0 * (ratio - 1.0) ** 2
        R = ratio.residual(energy * particles.dx)
        return mpm.ParticleProblem(R, particles, bcs=[floor(particles.V)])

    compare(make)


def test_triangular_background():
    particles = mpm.Particles(bent(TRIANGLE), space(2, 1, TRIANGLE))
    compare(lambda: quasi_static(particles))


def test_two_bodies():
    V = space(2)
    bodies = [mpm.Particles(bent(QUADRILATERAL, c), V) for c in (0.1, -0.9)]
    compare(lambda: quasi_static(bodies))


def test_body_of_revolution():
    particles = mpm.Particles(bent(QUADRILATERAL), space(2))
    compare(lambda: quasi_static(particles, axisymmetric=True))


def test_follower_pressure():
    body = bent(QUADRILATERAL)
    tags = boundary_tags(body)
    particles = mpm.Particles(body, space(2))
    compare(lambda: quasi_static(particles, pressures=[(3.0, 7)], facet_tags=tags), sizes=True)


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
    compare(lambda: mpm.ParticleProblem(R, particles, bcs=[floor(particles.V)]), sizes=True)


def sink():
    """Let a block sink a little into itself, its bottom held in both directions."""
    V = space(2)
    particles = mpm.Particles(bent(QUADRILATERAL), V)
    held = fem.locate_dofs_geometrical(V, lambda x: x[1] < 0.6)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, mpm.materials.Hencky(1e4, 0.3), body_force=(0.0, -300.0)),
        bcs=[fem.dirichletbc(np.zeros(2), held, V)],
    )
    problem.solve(4)
    return problem


def test_pattern_lasts_while_no_node_changes_its_cell():
    problem = sink()
    with on_route("reference"):
        reference = sink()
    statistics = problem.history.statistics
    assert 1 <= statistics["patterns"] < statistics["transfers"] == 4
    there = reference.particles.displacement.x.array
    largest = scenes.largest(there)
    assert largest > 1e-3
    assert problem.particles.displacement.x.array == pytest.approx(there, abs=1e-11 * largest)
