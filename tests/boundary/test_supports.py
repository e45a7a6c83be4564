# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Supports on the body's own boundary, off the lines of the background."""

import warnings

import numpy as np
import pytest
import scenes
from marks import slow, thinned
from obstacles import wall
from posed import posed
from scenes import QUADRILATERAL, TRIANGLE, WORLD

import dolfinx
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import LinearProblem

import mpm_dolfinx as mpm
from mpm_dolfinx.boundary.supports import fixed, roller
from mpm_dolfinx.materials import Hencky, LinearElastic, VonMises


def turned(angle, lower, upper, n, cell, markers, h, pad=1.4, comm=WORLD, far=(0.0, 0.0)):
    """Return particles of a rectangle turned about the origin, its facet tags, and the turn.

    The background is made of squares along the axes, wherever the body's faces are.
    """
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    Q = np.array([[c, -s], [s, c]])
    body = scenes.box(lower, upper, n, cell, comm)
    tags = scenes.facet_tags(body, *markers)
    body.geometry.x[:, :2] = body.geometry.x[:, :2] @ Q.T
    corners = np.array([lower, [upper[0], lower[1]], np.add(upper, far), [lower[0], upper[1]]])
    corners = corners @ Q.T
    low = corners.min(axis=0) - pad * h
    cells = np.ceil((corners.max(axis=0) + pad * h - low) / h).astype(int)
    V = scenes.vectors(scenes.box(low, low + cells * h, list(cells), QUADRILATERAL, comm))
    return mpm.Particles(body, V), tags, Q


def inclined_column(case, ne, angle, cell, material, comm=WORLD, **options):
    """Return a turned column between rollers on its own sides, and its error of stress."""
    h = case.length / ne
    markers = scenes.at(1, 0.0), scenes.at(0, 0.0, h)
    p, tags, Q = turned(
        angle, [0.0, 0.0], [h, case.length], [2, 2 * ne], cell, markers, h, comm=comm
    )
    supports = [roller(p, tags, 1, Q @ [0, 1]), roller(p, tags, 2, Q @ [1, 0])]
    problem = posed(
        mpm.QuasiStaticProblem,
        p,
        material,
        density=case.density,
        body_force=tuple(Q @ [0.0, -10.0]),
        supports=supports,
        **options,
    )

    def error(component=1):
        stress = np.einsum("ia,nij,jb->nab", Q, p.stress[:, :2, :2], Q)
        exact = case.stress((p.initial_centroid @ Q)[:, 1])[component]
        gap = np.abs(stress[:, component, component] - exact) * p.initial_volume
        return scenes.total(p, gap) / (case.g0 * case.length * h * case.length)

    return problem, supports, Q, error


@pytest.mark.parametrize(
    ("angle", "cell", "aligned"),
    thinned(
        3,
        [
            (angle, *on)
            for angle in (0, 30, 77)
            for on in ((QUADRILATERAL, 2.57e-3), (TRIANGLE, 6.16e-3))
        ],
    ),
)
def test_column_on_an_inclined_roller(angle, cell, aligned):
    case = scenes.A
    problem, supports, Q, error = inclined_column(
        case, 16, angle, cell, Hencky(case.young, case.poisson)
    )
    history = problem.solve(steps=40)
    assert history.cutbacks == 0
    assert history.total_iterations <= 130  # 126 on rollers of the background
    assert error() < 2 * aligned
    weight = case.g0 * case.length * case.length / 16
    force = [problem.reaction(support) @ Q / weight for support in supports]
    np.testing.assert_allclose(force, [[0.0, 1.0], [0.0, 0.0]], atol=1e-8)


def test_error_of_the_inclined_column_falls():
    case = scenes.B
    errors = []
    for ne in (8, 32):
        law = VonMises(case.young, case.poisson, rho_y=case.rho_y)
        problem, _, _, error = inclined_column(case, ne, 30, QUADRILATERAL, law)
        problem.solve(steps=20)
        errors.append([error(1), error(0)])
    assert np.all(np.array(errors[1]) < [1.2e-3, 1e-3])  # on rollers of the background: 1.1e-3
    assert np.all(np.array(errors[1]) < 0.35 * np.array(errors[0]))


@pytest.mark.filterwarnings("ignore:The run is complete, but")
@pytest.mark.parametrize("kind", ["roller", "fixed"])
@pytest.mark.parametrize("cell", [TRIANGLE, *slow(QUADRILATERAL)], ids=scenes.name)
def test_support_is_the_penalty_of_finite_elements(kind, cell):
    # Where the background is the body's mesh, T is the identity and stock FEM the same problem.
    def grid():
        return scenes.bend(scenes.unit(3, cell), 0.05)

    law, penalty = LinearElastic(1e3, 0.3), 7.0
    M = sum(scenes.lame(1e3, 0.3)) + scenes.lame(1e3, 0.3)[1]
    body = grid()
    p = mpm.Particles(body, scenes.vectors(grid()), quadrature_degree=2)
    normal = np.array([0.6, 0.8])
    tags = scenes.facet_tags(body, scenes.at(1, 0.0))
    more = {"modulus": M, "penalty": penalty}
    if kind == "roller":
        supports = [roller(p, tags, 1, normal * 3.0, 0.02, **more)]
        supports += [roller(p, tags, 1, [0.8, -0.6], 0.0, **more)]
    else:
        supports = [fixed(p, tags, 1, (0.012, 0.016), **more)]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(p, law, density=1.0, body_force=(3.0, -2.0)), supports=supports
    )
    problem.solve(steps=1)

    domain = grid()
    W = scenes.vectors(domain)
    u, v = ufl.TrialFunction(W), ufl.TestFunction(W)
    ds = ufl.Measure("ds", domain=domain, subdomain_data=scenes.facet_tags(domain, scenes.at(1, 0)))
    each = ufl.TestFunction(fem.functionspace(domain, ("DG", 0)))
    stiffness = fem.Function(each.ufl_function_space())
    area, volume = scenes.assembled(each * ds(1)), scenes.assembled(each * ufl.dx(domain))
    stiffness.x.array[: len(area)] = penalty * M * area / volume
    stiffness.x.scatter_forward()
    dx = ufl.Measure("dx", domain=domain, metadata={"quadrature_degree": 2})
    a = ufl.inner(scenes.linear_stress(u, 1e3, 0.3), ufl.grad(v)) * dx
    a += stiffness * ufl.inner(u, v) * ds(1)
    L = ufl.inner(ufl.as_vector([3.0, -2.0]), v) * ufl.dx(domain)
    L += stiffness * ufl.inner(ufl.as_vector(0.02 * normal), v) * ds(1)
    options = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}
    names = {} if dolfinx.__version__.startswith("0.9") else {"petsc_options_prefix": "twin_"}
    reference = LinearProblem(a, L, petsc_options=options, **names).solve()
    mine = in_space(p.W, p.displacement)
    twin = in_space(W, reference)
    np.testing.assert_allclose(mine, twin, rtol=0, atol=1e-10)


def in_space(W, function):
    """Return values by position on all ranks."""
    x = W.tabulate_dof_coordinates()[:, :2]
    owned = W.dofmap.index_map.size_local
    rows = scenes.gather(np.hstack([x, function.x.array.reshape(-1, 2)])[:owned])
    return rows[np.lexsort(np.round(rows[:, :2], 9).T)]


@pytest.mark.parametrize("angle", [*slow(0), 25])
def test_a_moving_plane_squeezes_a_block(angle):
    # Confined between smooth walls: Cauchy's stress is M ln(stretch) / stretch.
    markers = scenes.at(1, 0.0), scenes.at(0, 0.0, 1.0), scenes.at(1, 2.0)
    p, tags, Q = turned(angle, [0.0, 0.0], [1.0, 2.0], [4, 8], TRIANGLE, markers, 0.3)
    top = wall(p, Q @ [0, 2.0], Q @ [0, -1], facets=(tags, 3))
    supports = [roller(p, tags, 1, Q @ [0, 1]), roller(p, tags, 2, Q @ [1, 0])]
    body = mpm.Body(p, Hencky(1e4, 0.25))
    problem = mpm.QuasiStaticProblem(body, supports=supports, terms=[top])

    def path(t):
        top.move(Q @ [0.0, -0.8 * t])
        p.load.value = 1.0

    for step in problem.steps(5, update=path):
        stretch = 1.0 - 0.4 * step.load
        M = 1.2e4
        expected = M * np.log(stretch) / stretch
        np.testing.assert_allclose(
            problem.reaction(top) @ Q, [0.0, expected], rtol=4e-3, atol=1e-6 * M
        )
        np.testing.assert_allclose(
            problem.reaction(supports[0]) + problem.reaction(top), 0.0, atol=1e-5 * M
        )
    # It goes back, and farther than the body follows.
    problem.solve(steps=5, update=lambda t: top.move(Q @ [0.0, t - 0.8]))
    assert scenes.largest(problem.reaction(top)) < 1e-6 * M
    assert scenes.largest(p.displacement.x.array) < 1e-6


def slump(angle, h=1.0, g0=20e3, comm=WORLD):
    """Return case C on a smooth plane that may be inclined, the frame turned with it."""
    markers = (scenes.at(0, 0.0),)
    p, tags, Q = turned(
        angle, [0.0, 0.0], [4.0, 8.0], [8, 16], TRIANGLE, markers, h, comm=comm, far=(11.0, 0.0)
    )
    side, floor = roller(p, tags, 1, Q @ [1, 0]), wall(p, (0.0, 0.0), Q @ [0, 1])
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            p,
            VonMises(1e6, 0.3, rho_y=20e3),
            density=1000.0,
            body_force=tuple(Q @ [0.0, -g0 / 1000.0]),
        ),
        supports=[side],
        terms=[floor],
    )
    return problem, [side, floor], Q


@pytest.mark.slow
def test_a_column_spreads_on_an_inclined_plane():
    on_grid = scenes.slump(TRIANGLE, 20e3, h=1.0)
    on_grid.solve(steps=20)
    x = scenes.node_positions(on_grid.particles)
    toe, mean = x[:, 0].max(), x[:, 1].mean()
    for angle in (0, 30):
        problem, supports, Q = slump(angle)
        history = problem.solve(steps=20)
        assert history.cutbacks <= 1
        x = scenes.node_positions(problem.particles) @ Q
        assert abs(x[:, 0].max() / toe - 1.0) < 0.05
        assert abs(x[:, 1].mean() / mean - 1.0) < 0.01
        assert x[:, 1].min() > -1e-3
        force = sum(problem.reaction(support) for support in supports) @ Q / (32 * 20e3)
        np.testing.assert_allclose(force, [0.0, 1.0], atol=1e-7)


def test_same_on_any_number_of_ranks():
    runs = []
    for comm in (WORLD, scenes.MPI.COMM_SELF):
        problem, supports, _ = slump(30, comm=comm)
        problem.solve(steps=8)
        positions = scenes.in_order(problem.particles, problem.particles.centroid)
        runs.append((positions, np.array([problem.reaction(s) for s in supports])))
    np.testing.assert_allclose(runs[0][0], runs[1][0], rtol=0, atol=1e-8)
    np.testing.assert_allclose(runs[0][1], runs[1][1], rtol=0, atol=1e-8 * 32 * 20e3)


def test_in_a_residual_of_the_users_own():
    markers = scenes.at(1, 0.0), scenes.at(1, 1.0)
    p, tags, Q = turned(20, [0.0, 0.0], [1.0, 1.0], [4, 4], QUADRILATERAL, markers, 0.4)
    d, v = p.displacement, ufl.TestFunction(p.W)
    supports = [
        fixed(p, tags, 1, modulus=1.35e4),
        fixed(p, tags, 2, tuple(Q @ [0.0, 0.003]), modulus=1.35e4),
    ]
    dx = p.dx_exact
    R = ufl.derivative(scenes.neo_hookean(d) * dx, d, v)
    R += sum((s.residual for s in supports[1:]), supports[0].residual)
    problem = mpm.ParticleProblem(R, p, symmetric=True)
    problem.solve(steps=3)
    forces = [problem.reaction(s) @ Q for s in supports]
    np.testing.assert_allclose(forces[0], -forces[1], rtol=0, atol=1e-6)
    np.testing.assert_allclose(forces[1][0], 0.0, atol=0.02 * forces[1][1])
    assert 0.003 * 1.1e4 < forces[1][1] < 0.003 * 1.35e4  # plane strain, confined


def test_a_body_of_revolution_stands_on_its_roller():
    V = scenes.vectors(scenes.box([0.0, -0.3], [1.5, 1.2], [8, 8], QUADRILATERAL))
    body = scenes.box([0.0, 0.07], [1.0, 1.07], [6, 6], QUADRILATERAL)
    p = mpm.Particles(body, V)
    base = roller(p, scenes.facet_tags(body, scenes.at(1, 0.07)), 1, (0.0, 1.0))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(p, Hencky(1e4, 0.3), density=2.0, body_force=(0.0, -10.0)),
        bcs=[scenes.fix(V, scenes.at(0, 0.0), component=0)],
        supports=[base],
        axisymmetric=True,
    )
    problem.solve(steps=2)
    np.testing.assert_allclose(problem.reaction(base)[1], 20.0 * np.pi, rtol=1e-8)


def standing(first, *laws):
    """Return a column on a roller of its own, of each of some materials one after the other."""
    V = scenes.vectors(scenes.box([-0.5, -0.3], [1.5, 1.2], [8, 6], QUADRILATERAL))
    body = scenes.box([0.0, 0.07], [1.0, 1.07], [4, 4], QUADRILATERAL)
    p = mpm.Particles(body, V)
    base = fixed(p, scenes.facet_tags(body, scenes.at(1, 0.07)), 1)
    problems = [
        mpm.QuasiStaticProblem(mpm.Body(p, law, body_force=(0.0, -10.0)), supports=[base])
        for law in (first, *laws)
    ]
    return p, base, problems[-1]


def test_a_support_is_as_stiff_as_the_material_of_the_last_problem():
    # (a cell of a notebook that is run again with another material)
    p, _, problem = standing(Hencky(1e3, 0.3), Hencky(1e6, 0.3))
    problem.solve(steps=2)
    fresh, _, expected = standing(Hencky(1e6, 0.3))
    expected.solve(steps=2)
    exact = scenes.in_order(fresh, fresh.volume)
    assert np.abs(scenes.in_order(p, p.volume) - exact).max() < 1e-9
    gap = scenes.in_order(p, p.centroid) - scenes.in_order(fresh, fresh.centroid)
    assert np.abs(gap).max() < 1e-9


def test_a_problem_that_cannot_be_made_leaves_a_support_as_it_was():
    found = []
    for fails in (False, True):
        p, base, problem = standing(Hencky(1e3, 0.3))
        if fails:
            with pytest.raises(mpm.MPMError, match="needs a background and particles of degree 2"):
                mpm.QuasiStaticProblem(
                    mpm.Body(p, Hencky(1e6, 0.3)), supports=[base], mixed="pressure"
                )
        problem.solve(steps=1)
        problem.stage(bodies=problem.body().replace(material=Hencky(5e3, 0.3)))
        problem.solve(steps=1)
        found.append(scenes.in_order(p, p.centroid))
    assert np.array_equal(*found) if WORLD.size == 1 else np.allclose(*found, rtol=0.0, atol=1e-12)


def test_a_stage_with_a_material_too_stiff_for_its_support():
    _, base, problem = standing(Hencky(1e3, 0.3))
    problem.solve(steps=1)
    problem.stage(bodies=problem.body().replace(material=Hencky(5e3, 0.3)))
    with warnings.catch_warnings(record=True) as told:  # on the first rank
        warnings.simplefilter("always")
        problem.stage(bodies=problem.body().replace(material=Hencky(1e6, 0.3)))
    sentences = [str(each.message) for each in told if "times as stiff" in str(each.message)]
    assert len(sentences) == (WORLD.rank == 0)
    assert all("1e+03 times" in one and "modulus=" in one for one in sentences)
    problem.solve(steps=1)
    np.testing.assert_allclose(problem.reaction(base), [0.0, 10.0], atol=1e-6)


def pressed(kind=mpm.QuasiStaticProblem):
    """Return a block on its base, a plate on it that a Constant moves, and that; in motion a rest.

    What is asked of the plate is what holds the block below.
    """
    V = scenes.vectors(scenes.box([-0.5, 0.0], [1.5, 1.5], [8, 6], QUADRILATERAL))
    p = mpm.Particles(scenes.unit(8, QUADRILATERAL), V)
    tags = scenes.facet_tags(p.mesh, scenes.at(1, 1.0), scenes.at(0, 0.0))
    moved = fem.Constant(p.mesh, np.zeros(2))
    plate, side = fixed(p, tags, 1, value=moved), roller(p, tags, 2, (-1.0, 0.0))
    supports = [plate, side]
    if kind is mpm.DynamicProblem:
        supports.append(mpm.boundary.dashpot(p, tags, 2, 50.0, 20.0))
    body = mpm.Body(p, Hencky(1e3, 0.3), density=1.0)
    base = scenes.fix(V, scenes.at(1, 0.0))
    problem = kind(body, bcs=[base], supports=supports)

    def update(t):
        moved.value[:] = (0.01 * t, -0.05 * t)

    return problem, moved, update


def borne(problem):
    """Return the forces of all supports."""
    return np.array([problem.reaction(one) for one in problem.supports])


def test_forces_of_supports_are_of_the_last_converged_step_whatever_is_set_since(mpi_tmp_path):
    problem, moved, update = pressed()
    problem.solve(2, update=update)
    found, below = borne(problem), problem.reaction(problem.bcs[0])
    np.testing.assert_allclose(found.sum(axis=0), -below, atol=1e-6)
    assert abs(below[1]) > 10.0
    problem.save(mpi_tmp_path / "pressed.ckpt")
    # a step that fails, with values that no step has reached
    moved.value[:] = (0.0, -2.0)
    with pytest.raises(mpm.MPMError):
        problem.step()
    assert np.array_equal(borne(problem), found)

    # a path that ends in the middle
    def stops(t):
        update(1.0 + t)
        if t == 1.0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        problem.solve(2, update=stops)
    assert not np.array_equal(borne(problem), found)
    np.testing.assert_allclose(
        borne(problem).sum(axis=0), -problem.reaction(problem.bcs[0]), atol=1e-6
    )
    # another process, whose path has set nothing yet
    for other in (problem, pressed()[0]):
        other.restore(mpi_tmp_path / "pressed.ckpt")
        np.testing.assert_allclose(borne(other), found, rtol=1e-12)
    # supports in another order
    problem.stage(supports=problem.supports[::-1])
    update(1.0)
    np.testing.assert_allclose(borne(problem), found[::-1], rtol=1e-9, atol=1e-9)


def test_a_dashpot_has_its_force_after_a_restart(mpi_tmp_path):
    problem, _, update = pressed(mpm.DynamicProblem)
    problem.solve(time=0.02, dt=0.01, update=lambda t: update(50.0 * t))
    found = borne(problem)
    assert abs(found[2]).max() > 1e-3
    problem.save(mpi_tmp_path / "pressed.ckpt")
    other, *_ = pressed(mpm.DynamicProblem)
    other.restore(mpi_tmp_path / "pressed.ckpt")
    np.testing.assert_allclose(borne(other), found, rtol=1e-12)
