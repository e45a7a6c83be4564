# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Ghost penalty and aggregation: exact on polynomials, bounded condition, right in parallel."""

import numpy as np
import pytest
import scenes
from scenes import ALL, HEXAHEDRON, PLANE, QUADRILATERAL, TETRAHEDRON, TRIANGLE, WORLD

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.cell_fill import CellFill, CellPairs
from mpm_dolfinx.history import Statistics
from mpm_dolfinx.stabilisation import PENALTY, Aggregation, GhostPenalty


def sliver(cell, degree, offset, domain=None, n=4, ghosts=mesh.GhostMode.shared_facet):
    """Return particles that fill a background's lower cells and reach a little into the next."""
    dim = 3 if cell in (TETRAHEDRON, HEXAHEDRON) else 2
    grid = scenes.box([0.0] * dim, [1.0] * dim, [n] * dim, cell, ghost_mode=ghosts)
    height = (n // 2) / n + offset
    body = scenes.box([0.0] * dim, [1.0] * (dim - 1) + [height], [n] * dim, domain or cell)
    return mpm.Particles(body, scenes.vectors(grid, degree), degree=degree)


def polynomial(V, degree):
    """Return a polynomial of total degree `degree` in V."""
    u = fem.Function(V)
    dim = V.mesh.geometry.dim
    u.interpolate(
        lambda x: np.array([(1 + i - x[0] + (2 + i) * x[dim - 1]) ** degree for i in range(dim)])
    )
    return u


def weighted(particles):
    """Return which own nodes of V have weight."""
    active = np.zeros(particles.V.dofmap.index_map.size_local, dtype=bool)
    active[particles.active_nodes] = True
    return active


def vector(matrix, function):
    x = matrix.createVecRight()
    x.array_w[:] = scenes.own(function)
    return x


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("cell", ALL, ids=scenes.name)
def test_penalty_vanishes_on_polynomials_alone(cell, degree):
    n = 4 if cell in PLANE else 2
    particles = sliver(cell, degree, 1e-3, n=n)
    ghost = GhostPenalty([particles])
    statistics = Statistics()
    ghost.unknowns(weighted(particles), statistics)
    assert statistics["ghost_facets"] > 0
    G = ghost.matrix([1.0])
    kernel = vector(G, polynomial(particles.V, degree))
    residual = G.createVecLeft()
    G.mult(kernel, residual)
    assert residual.norm() < 1e-12 * G.norm() * kernel.norm()
    rough = vector(G, polynomial(particles.V, degree))
    rough.setRandom()
    G.mult(rough, residual)
    assert rough.dot(residual) > 0.0
    assert G.isSymmetric(1e-12 * PENALTY)


def test_penalty_vanishes_on_bent_cells():
    grid = scenes.bend(scenes.unit(4, QUADRILATERAL), 0.03)
    body = scenes.box([0.1, 0.1], [0.9, 0.6], [4, 3], TRIANGLE)
    particles = mpm.Particles(body, scenes.vectors(grid, 2), degree=2)
    ghost = GhostPenalty([particles])
    ghost.unknowns(weighted(particles), Statistics())
    G = ghost.matrix([1.0])
    x = vector(G, polynomial(ghost._V, 2))
    y = G.createVecLeft()
    G.mult(x, y)
    assert y.norm() < 1e-12 * G.norm() * x.norm()


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_penalty_is_the_jump_of_normal_derivatives(degree):
    # On two unit squares: sum_j 2/((2j+1) (j!)^2) h^(2j-1) int [d_n^j u][d_n^j v] bounds the
    # direct form from both sides; for a jump in one derivative alone they are compared exactly.
    grid = mesh.create_rectangle(
        WORLD, [[0.0, 0.0], [2.0, 1.0]], [2, 1], QUADRILATERAL, ghost_mode=mesh.GhostMode.none
    )
    body = scenes.box([0.0, 0.0], [1.0 + 1e-6, 1.0], [2, 2], QUADRILATERAL)
    V = scenes.vectors(grid, degree)
    particles = mpm.Particles(body, V, degree=degree)
    ghost = GhostPenalty([particles])
    ghost.unknowns(weighted(particles), Statistics())
    G = ghost.matrix([3.0])
    u = fem.Function(V)
    u.interpolate(lambda x: np.array([np.where(x[0] > 1.0, (x[0] - 1.0) ** degree, 0.0), 0 * x[1]]))
    x, y = vector(G, u), G.createVecLeft()
    G.mult(x, y)
    # (u_1 - u_2)^2 = (x - 1)^(2 k) over both cells, G / h^2 = 3
    assert np.isclose(x.dot(y), PENALTY * 3.0 * 2.0 / (2 * degree + 1), rtol=1e-10)


@pytest.mark.parametrize("degree", [2, 3])
@pytest.mark.parametrize("cell", [*PLANE, HEXAHEDRON], ids=scenes.name)
def test_aggregation_continues_polynomials(cell, degree):
    n = 4 if cell in PLANE else 2
    particles = sliver(cell, degree, 1e-9, n=n)
    aggregation = Aggregation([particles])
    statistics = Statistics()
    aggregation.unknowns(weighted(particles), statistics)
    assert statistics["aggregated_dofs"] > 0
    V = particles.V
    fixed = np.zeros(V.dofmap.index_map.size_local * V.dofmap.index_map_bs, dtype=bool)
    E = aggregation.extension(fixed)
    x = vector(E, polynomial(V, degree))
    y = E.createVecLeft()
    E.mult(x, y)
    y.axpy(-1.0, x)
    assert y.norm() < 1e-10 * x.norm()
    E = aggregation.extension(~fixed)
    E.mult(x, y)
    y.axpy(-1.0, x)
    assert y.norm() == 0.0


def test_pairs_do_not_need_ghost_cells():
    counts = set()
    for ghosts in (mesh.GhostMode.none, mesh.GhostMode.shared_facet):
        grid = scenes.box([0.0, 0.0], [1.0, 1.0], [5, 4], TRIANGLE, ghost_mode=ghosts)
        cells = CellPairs(scenes.vectors(grid))
        pairs = cells.pairs[cells.mine]
        counts.add(WORLD.allreduce(len(pairs)))
        middles = cells.vertices.mean(axis=1)
        gap = np.linalg.norm(np.diff(middles[pairs], axis=1), axis=2)
        assert WORLD.allreduce(int((gap > 0.2).sum())) == 0
    assert counts == {20 + 16 + 15}  # diagonals, upright and level edges


def test_fill_is_the_share_of_the_body():
    grid = scenes.box([0.0, 0.0], [4.0, 2.0], [4, 2], QUADRILATERAL)
    body = scenes.box([0.0, 0.0], [2.5, 1.0], [20, 8], QUADRILATERAL)
    particles = mpm.Particles(body, scenes.vectors(grid, 2), degree=2)
    cells = CellPairs(particles.V)
    found = CellFill.of([particles], cells.num_own)
    middle = cells.vertices[: cells.num_own].mean(axis=1)
    exact = np.where(middle[:, 1] < 1.0, np.clip(2.5 - (middle[:, 0] - 0.5), 0.0, 1.0), 0.0)
    assert np.allclose(found.fill[:, 0], exact, atol=1e-12)
    assert np.array_equal(found.active, exact > 0.0)


def cantilever(offset, stabilisation, degree=2, h=0.5, **options):
    """Return a short elastic beam, clamped, that bends under a load on its end."""
    V = scenes.vectors(
        scenes.box([0.0, 0.0], [4.0, 4.0], [round(4 / h)] * 2, QUADRILATERAL), degree
    )
    n = round(2 / h)
    body = scenes.box([0.0, 2.5 - offset], [3.0, 3.5 - offset], [3 * n, n], QUADRILATERAL)
    tags = scenes.facet_tags(body, scenes.at(0, 3.0))
    return mpm.QuasiStaticProblem(
        mpm.Particles(body, V, degree=degree),
        mpm.materials.Hencky(1e4, 0.2),
        bcs=[scenes.fix(V, scenes.at(0, 0.0))],
        tractions=[((0.0, -400.0), 1)],
        facet_tags=tags,
        stabilisation=stabilisation,
        **options,
    )


@pytest.mark.parametrize("stabilisation", ["ghost", "aggregate"])
def test_slivers_do_not_matter(stabilisation):
    tips = []
    for offset in (0.0, 1e-9, 0.05, 0.185):
        problem = cantilever(offset, stabilisation)
        problem.solve(steps=4)
        assert problem.history.cutbacks == 0
        volume = problem.particles.initial_volume
        drop = problem.particles.centroid - problem.particles.initial_centroid
        tips.append(scenes.total(problem.particles, drop * volume[:, None]))
    tips = np.array(tips)
    assert np.abs(tips - tips[0]).max() < 3e-3 * np.abs(tips[0]).max()


def condition(problem):
    """Return the condition number of the reduced tangent scaled to unit diagonal."""
    problem.solve(steps=1)
    K = scenes.dense(problem.A)
    scale = 1.0 / np.sqrt(np.diag(K))
    size = np.linalg.eigvalsh(K * np.outer(scale, scale))
    return size[-1] / max(size[0], 1e-300)


@pytest.mark.parametrize("stabilisation", ["ghost", "aggregate"])
def test_condition_is_bounded(stabilisation):
    conditions = [condition(cantilever(s, stabilisation)) for s in (0.25, 0.1, 1e-3, 1e-6)]
    assert max(conditions) < 1e3 * min(conditions)


def test_auto_acts_for_degree_2_and_where_a_cut_is_small():
    problem = cantilever(0.1, "auto", degree=1)
    problem.solve(steps=1)
    assert problem.history.statistics["ghost_facets"] == 0
    assert problem.reduced.moduli is None
    problem = cantilever(0.05, "auto")
    problem.solve(steps=1)
    assert problem.history.statistics["ghost_facets"] > 0
    grid = scenes.vectors(scenes.unit(3, QUADRILATERAL), 2)
    particles = mpm.Particles(scenes.unit(6, QUADRILATERAL), grid, degree=2)
    sides = [(0, (0.0, 1.0)), (1, (0.0,))]
    problem = mpm.QuasiStaticProblem(
        particles,
        mpm.materials.Hencky(1e3, 0.3),
        body_force=(0.0, -1.0),
        bcs=[scenes.fix(grid, scenes.at(i, *ends), component=i) for i, ends in sides],
    )
    problem.solve(steps=1)
    assert problem.history.statistics["ghost_facets"] == 0
    assert np.isclose(problem.reduced.moduli[0], 1e3 / 2.6, rtol=1e-6)


def test_modulus_and_answer_do_not_depend_on_units():
    tips = []
    for unit in (1.0, 1e9):
        problem = cantilever(0.05, "ghost")
        particles = problem.particles
        d, v = particles.displacement, ufl.TestFunction(particles.W)
        R = ufl.inner(scenes.linear_stress(d, 1e3 * unit, 0.3), ufl.grad(v)) * particles.dx
        b = ufl.as_vector([0.0, -unit])
        R -= particles.load * ufl.inner(b, v) * particles.dx_exact
        mine = mpm.ParticleProblem(R, particles, bcs=problem.bcs, stabilisation="ghost")
        mine.solve(steps=2)
        assert np.isclose(mine.reduced.moduli[0], unit * 1e3 / 2.6)
        tips.append(scenes.in_order(particles, particles.centroid))
    assert np.abs(tips[1] - tips[0]).max() < 1e-9


@pytest.mark.parametrize("stabilisation", ["ghost", "aggregate"])
def test_imposed_displacement(stabilisation):
    # A uniform strain is imposed on the background's boundary; slivers follow.
    V = scenes.vectors(scenes.box([0.0, 0.0], [1.0, 2.0], [2, 4], QUADRILATERAL), 2)
    body = scenes.box([0.0, 0.0], [1.0, 1.5 + 1e-7], [4, 6], QUADRILATERAL)
    bcs = [
        scenes.fix(V, scenes.at(0, 0.0), component=0),
        scenes.fix(V, scenes.at(0, 1.0), -0.1, component=0),
        scenes.fix(V, scenes.at(1, 0.0), component=1),
    ]
    particles = mpm.Particles(body, V, degree=2)
    problem = mpm.QuasiStaticProblem(
        particles, mpm.materials.Hencky(1e3, 0.3), bcs=bcs, stabilisation=stabilisation
    )
    problem.solve(steps=1)
    stress = particles.stress
    assert scenes.largest(stress[:, 1, 1]) < 1e-6 * scenes.largest(stress[:, 0, 0])
    force = problem.reaction(bcs[1])
    assert np.isclose(force[0], -problem.reaction(bcs[0])[0], rtol=1e-9)
