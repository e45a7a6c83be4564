# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Multigrid on boxes of the background, compared with factorisations."""

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from compare import outcome, same_run
from posed import posed
from scenes import HEXAHEDRON, QUADRILATERAL, TETRAHEDRON, TRIANGLE

import mpm_dolfinx as mpm
from mpm_dolfinx.assembly.fused import FusedTangent
from mpm_dolfinx.errors import MPMError
from mpm_dolfinx.materials import Hencky, LinearElastic, MohrCoulomb, VonMises
from mpm_dolfinx.solvers import linear, strategies

TIGHT = {"snes_rtol": 1e-12}
PLASTIC = VonMises(1e6, 0.3, rho_y=20e3)


SAND = MohrCoulomb(1e6, 0.3, 2e4, 30.0, 5.0)


def heavy(
    n,
    cell=QUADRILATERAL,
    degree=1,
    material=PLASTIC,
    weight=8e3,
    bent=0.0,
    comm=scenes.WORLD,
    **options,
):
    """Return a column, half as large as its background, with n background cells over its width."""
    dim = 3 if cell in (TETRAHEDRON, HEXAHEDRON) else 2
    grid = scenes.box([0.0] * dim, [1.0] * dim, [2 * n] * dim, cell, comm)
    grid = scenes.bend(grid, bent)
    grid.geometry.x[:, :dim] *= 8.0
    V = scenes.vectors(grid, degree)
    finer = 2 if degree == 1 else 1
    domains = cell if degree == 1 else TRIANGLE
    body = scenes.box([0.0] * dim, [4.0] * dim, [finer * n] * dim, domains, comm)
    bcs = [scenes.fix(V, scenes.at(axis, 0.0), component=axis) for axis in range(dim)]
    options.setdefault("petsc_options", TIGHT)
    return posed(
        mpm.QuasiStaticProblem,
        mpm.Particles(body, V, degree=degree),
        material,
        density=1.0,
        body_force=(*[0.0] * (dim - 1), -weight),
        bcs=bcs,
        **options,
    )


def assert_same(direct, multigrid, failures=0):
    """Compare the runs of two problems, of which the second one has used multigrid."""
    a, b = (scenes.own(run.particles.displacement) for run in (direct, multigrid))
    assert scenes.largest(a - b) < 1e-9 * scenes.largest(a)
    assert direct.history.statistics["krylov_iterations"] == 0
    statistics = multigrid.history.statistics
    assert statistics["krylov_iterations"] > 0
    assert statistics["multigrid_failures"] == failures


@pytest.mark.parametrize(
    ("n", "options"),
    [
        (20, {}),
        (20, {"cell": TRIANGLE}),
        (20, {"bent": 0.004, "stabilisation": "ghost"}),
        (20, {"stabilisation": None}),
        (9, {"degree": 2}),
        (9, {"degree": 2, "cell": TRIANGLE}),
        (6, {"degree": 3}),
        (5, {"cell": HEXAHEDRON}),
        pytest.param(5, {"cell": TETRAHEDRON}, marks=pytest.mark.slow),
        (20, {"material": VonMises(1e6, 0.49, rho_y=20e3)}),
        (20, {"material": SAND, "weight": 4e3}),
    ],
    ids=lambda given: "-".join(f"{k}" for k in given) if isinstance(given, dict) else str(given),
)
def test_displacements_are_those_of_a_factorisation(n, options):
    runs = [heavy(n, linear_solver=name, **options) for name in ("direct", "multigrid")]
    for run in runs:
        run.solve(steps=2)
    assert_same(*runs)


@pytest.mark.skipif(scenes.WORLD.size == 1, reason="compares several ranks with one")
@pytest.mark.parametrize(
    ("n", "options"),
    [
        pytest.param(24, {}, marks=pytest.mark.slow),
        pytest.param(24, {"cell": TRIANGLE, "stabilisation": "ghost"}, marks=pytest.mark.slow),
        pytest.param(11, {"degree": 2}, marks=pytest.mark.slow),
        pytest.param(6, {"cell": HEXAHEDRON, "stabilisation": "ghost"}, marks=pytest.mark.slow),
        (24, {"material": SAND, "weight": 4e3}),
    ],
)
def test_several_ranks_take_the_same_way(n, options):
    runs = []
    for comm in (scenes.WORLD, MPI.COMM_SELF):
        run = heavy(n, linear_solver="multigrid", comm=comm, **options)
        run.solve(steps=2)
        statistics = run.history.statistics
        assert statistics["multigrid_failures"] == 0
        runs.append((run, statistics["krylov_iterations"] / statistics["factorisations"]))
    (several, its), (one, alone) = runs
    assert abs(its - alone) <= 2.0
    assert abs(several.history.total_iterations - one.history.total_iterations) <= 2
    same_run(outcome(several), outcome(one), 1e-9)


def change(monkeypatch, dim=2, **numbers):
    """Let solvers take turns at other numbers of unknowns."""
    table = strategies.STRATEGIES
    monkeypatch.setitem(table, dim, table[dim]._replace(**numbers))


def test_factors_of_low_rank_give_the_same(monkeypatch):
    full = heavy(5, cell=HEXAHEDRON, linear_solver="direct")
    full.solve(steps=2)
    change(monkeypatch, 3, compressed=100)
    monkeypatch.setattr(strategies, "LOW_RANK", {"mat_mumps_icntl_35": 1, "mat_mumps_cntl_7": 1e-2})
    run = heavy(5, cell=HEXAHEDRON, linear_solver="direct")
    run.solve(steps=2)
    a, b = scenes.own(full.particles.displacement), scenes.own(run.particles.displacement)
    assert scenes.largest(a - b) < 1e-9 * scenes.largest(a)
    assert run.history.total_iterations == full.history.total_iterations
    given = heavy(3, cell=HEXAHEDRON, petsc_options={"pc_type": "lu"})
    given.solve(steps=1)
    assert given.history.statistics["factorisations"] > 0


@pytest.mark.parametrize(
    ("n", "law"), [(8, VonMises(1e6, 0.4999, rho_y=20e3)), (12, Hencky(1e6, 0.499999))]
)
def test_a_saddle_point_in_the_plane(n, law):
    runs = [
        heavy(n, degree=2, material=law, mixed="pressure", linear_solver=name)
        for name in ("direct", "multigrid")
    ]
    for run in runs:
        run.solve(steps=2)
    assert_same(*runs)
    statistics = runs[1].history.statistics
    assert statistics["krylov_iterations"] < 60 * statistics["factorisations"]


def test_a_saddle_point_in_space_whose_body_may_swell(monkeypatch):
    # Without its pressure the body has no stiffness to its volume, and nothing holds that.
    monkeypatch.setattr(linear, "COARSEST", 100)
    runs = []
    for name in ("direct", "multigrid"):
        grid = scenes.box([0.0] * 3, [4.0] * 3, [4] * 3, HEXAHEDRON)
        body = scenes.box([0.0] * 3, [2.0] * 3, [2] * 3, HEXAHEDRON)
        V = scenes.vectors(grid, 2)
        run = mpm.QuasiStaticProblem(
            mpm.Body(
                mpm.Particles(body, V, degree=2, quadrature_degree=4),
                Hencky(1e6, 0.49999),
                density=1.0,
                body_force=(0.0, 0.0, -4e4),
            ),
            bcs=[scenes.fix(V, scenes.at(axis, 0.0), component=axis) for axis in range(3)],
            mixed="pressure",
            solver=mpm.Solver(petsc_options=TIGHT, linear=name),
        )
        run.solve(steps=1)
        runs.append(run)
    assert_same(*runs)


def test_water_in_the_pores():
    results = []
    for name in ("direct", "multigrid"):
        n = 8
        grid = scenes.box([0.0, 0.0], [1.5, 1.5], [3 * n // 2] * 2, QUADRILATERAL)
        shape = scenes.box([0.0, 0.01], [1.0, 1.01], [2 * n] * 2, QUADRILATERAL)
        body = mpm.Particles(shape, scenes.vectors(grid, 2), degree=2, quadrature_degree=4)
        tags = scenes.facet_tags(shape, scenes.at(1, 1.01), scenes.at(1, 0.01))
        problem = mpm.PorousProblem(
            mpm.Body(
                body,
                Hencky(1e3, 0.25),
                tractions=[((0.0, -100.0), 1)],
                facet_tags=tags,
                pore_fluid=mpm.PoreFluid(1e-4, drained=[(0.0, 1)]),
            ),
            bcs=[scenes.fix(body.V, scenes.at(0, 0.0), component=0)],
            supports=[mpm.boundary.roller(body, tags, 2, (0.0, -1.0))],
            solver=mpm.Solver(petsc_options=TIGHT, linear=name),
        )
        problem.solve(time=0.2, dt=0.1)
        results.append((problem, scenes.own(problem.pore_pressure[0])))
    (direct, a), (multigrid, b) = results
    assert_same(direct, multigrid)
    assert scenes.largest(a - b) < 1e-8 * scenes.largest(a)


def test_iterations_do_not_grow_with_the_number_of_unknowns():
    counts = []
    for n in (18, 36, 54):
        run = heavy(n, material=Hencky(1e6, 0.3), linear_solver="multigrid", petsc_options={})
        run.solve(steps=1)
        statistics = run.history.statistics
        counts.append(statistics["krylov_iterations"] / run.history.total_iterations)
    assert counts[2] <= 1.3 * counts[0] + 1.0


def test_a_tangent_is_let_go_of_before_the_next_has_room(monkeypatch):
    run, make, kept = heavy(20, linear_solver="multigrid"), FusedTangent._make_matrix, []

    def make_matrix(self, *given):
        kept.append(run.A)
        make(self, *given)

    monkeypatch.setattr(FusedTangent, "_make_matrix", make_matrix)
    run.solve(steps=3)
    assert len(kept) > 1 and kept == [None] * len(kept)
    assert run.A is not None
    factored = heavy(20, linear_solver="direct")
    factored.solve(steps=3)
    assert_same(factored, run)


def tied(linear_solver):
    """Return a block that is tied to another one, each on a background of its own."""
    bodies, bcs = [], []
    for low, n in ((0.0, 37), (2.0, 34)):
        V = scenes.vectors(scenes.box([0.0, 0.0], [4.0, 6.0], [n, n], QUADRILATERAL))
        body = scenes.box([0.0, low], [2.0, low + 2.0], [n] * 2, QUADRILATERAL)
        bodies.append(mpm.Particles(body, V))
        bcs.append(scenes.fix(V, scenes.at(0, 0.0), component=0))
    bcs.append(scenes.fix(bodies[0].V, scenes.at(1, 0.0), component=1))
    tags = scenes.facet_tags(bodies[1].mesh, scenes.at(1, 2.0))
    return posed(
        mpm.QuasiStaticProblem,
        bodies,
        Hencky(1e5, 0.3),
        density=1.0,
        body_force=(0.0, -5e3),
        bcs=bcs,
        terms=[mpm.Tie(bodies[1], bodies[0], tags, 1, 1e7)],
        linear_solver=linear_solver,
        petsc_options=TIGHT,
    )


def test_bodies_on_backgrounds_of_their_own():
    moved = [tied("direct"), tied("multigrid")]
    for run in moved:
        run.solve(steps=1)
    a, b = ([scenes.own(body.displacement) for body in run.bodies] for run in moved)
    assert max(scenes.largest(x - y) for x, y in zip(a, b, strict=True)) < 1e-9
    assert moved[1].history.statistics["krylov_iterations"] > 0


def test_a_factorisation_takes_over_where_multigrid_comes_to_nothing():
    runs = [
        heavy(20, linear_solver="direct"),
        heavy(20, linear_solver="multigrid", petsc_options={**TIGHT, "ksp_max_it": 1}),
    ]
    for run in runs:
        run.solve(steps=4)
    assert_same(*runs, failures=4)


def test_many_unknowns_are_for_multigrid(monkeypatch):
    change(monkeypatch, crossover=(700, 700))
    for n, used in ((12, False), (20, True)):
        run = heavy(n, linear_solver="auto")
        run.solve(steps=1)
        assert (run.history.statistics["krylov_iterations"] > 0) == used
    run = heavy(20, linear_solver="auto", petsc_options={"pc_type": "lu"})
    run.solve(steps=1)
    assert run.history.statistics["krylov_iterations"] == 0
    still = heavy(20)
    motion = posed(
        mpm.DynamicProblem, still.particles, PLASTIC, 1.0, body_force=(0.0, -8e3), bcs=still.bcs
    )
    motion.step(1e-3)
    assert motion.history.statistics["krylov_iterations"] > 0


@pytest.mark.parametrize(
    ("n", "options", "least"),
    [
        (20, {}, 700),
        (20, {"bent": 0.01}, 2000),
        (20, {"cell": TRIANGLE}, 700),
        (10, {"degree": 2}, 700),
        (10, {"degree": 2, "bent": 0.01}, 2000),
        (10, {"degree": 2, "cell": TRIANGLE}, 2000),
    ],
)
def test_what_coarsens_badly_is_for_multigrid_later(monkeypatch, n, options, least):
    change(monkeypatch, crossover=(700, 2000))
    run = heavy(n, linear_solver="auto", **options)
    run.solve(steps=1)
    assert 700 < run.history.statistics["free_dofs"] < 2000
    assert (run.history.statistics["krylov_iterations"] > 0) == (least == 700)
    assert run.reduced.levels.nested == (least == 700)


def test_backgrounds_that_a_tie_couples_are_for_multigrid_later(monkeypatch):
    change(monkeypatch, crossover=(700, 10**6))
    run = tied("auto")
    run.solve(steps=1)
    assert run.history.statistics["free_dofs"] > 700
    assert run.history.statistics["krylov_iterations"] == 0
    assert not run.reduced.levels.nested


@pytest.mark.parametrize(
    ("material", "friction", "least"),
    [(PLASTIC, None, 700), (SAND, None, 1000), (PLASTIC, 0.0, 700), (PLASTIC, 0.3, 1000)],
)
def test_unsymmetric_tangents_are_for_multigrid_later(monkeypatch, material, friction, least):
    change(monkeypatch, crossover=(700, 1000))
    for n in (20, 24):
        run = heavy(n, material=material, weight=4e3, linear_solver="auto")
        if friction is not None:
            wall = mpm.contact.plane((6.0, 0.0), (-1.0, 0.0))
            floor = mpm.contact.Rigid(run.particles, wall, friction)
            run = posed(
                mpm.QuasiStaticProblem,
                run.particles,
                material,
                density=1.0,
                body_force=(0.0, -4e3),
                bcs=run.bcs,
                terms=[floor],
                linear_solver="auto",
            )
        run.solve(steps=1)
        unknowns = run.history.statistics["free_dofs"]
        assert 700 < unknowns and (unknowns < 1000) == (n == 20)
        assert (run.history.statistics["krylov_iterations"] > 0) == (unknowns > least)


def test_a_factorisation_goes_on_where_multigrid_takes_longer(monkeypatch):
    change(monkeypatch, crossover=(700, 700))
    counts = []
    for bearable in (1e9, 0.6):
        change(monkeypatch, bearable=(0.0, 1.0 / bearable))
        run = heavy(20, linear_solver="auto")
        run.solve(steps=3)
        counts.append(run.history.statistics["krylov_iterations"])
        factored = heavy(20, linear_solver="direct")
        factored.solve(steps=3)
        assert_same(factored, run)
    assert counts[1] < 0.3 * counts[0]


def test_multigrid_that_no_factor_takes_over_from_goes_on(monkeypatch):
    change(monkeypatch, crossover=(700, 700), taken_over=0, bearable=(0.0, 1e9))
    run = heavy(20, linear_solver="auto")
    iterations = []
    for _ in run.steps(3):
        iterations.append(run.history.statistics["krylov_iterations"])
    assert run.history.cutbacks == 0 and run.history.statistics["multigrid_failures"] == 0
    assert 1 < iterations[0] < iterations[1] < iterations[2]


def test_a_background_of_degree_3_is_factorised(monkeypatch):
    change(monkeypatch, crossover=(100, 10**6))
    for degree, used in ((2, True), (3, False)):
        run = heavy(24 // degree, degree=degree, linear_solver="auto")
        run.solve(steps=1)
        assert (run.history.statistics["krylov_iterations"] > 0) == used


def test_a_linear_problem_takes_no_more_than_one_solve_besides():
    law = LinearElastic(1e6, 0.3)
    options = {"material": law, "weight": 1e3, "petsc_options": {}}
    run = heavy(20, linear_solver="multigrid", **options)
    run.solve(steps=4)
    assert run.history.total_iterations <= 4 + 2
    direct = heavy(20, linear_solver="direct", **options)
    direct.solve(steps=4)
    a, b = (scenes.own(one.particles.displacement) for one in (direct, run))
    assert scenes.largest(a - b) < 1e-7 * scenes.largest(a)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"linear_solver": "magic"}, "Unknown linear='magic'; choose one of 'auto'"),
        (
            {"linear_solver": "multigrid", "petsc_options": {"pc_type": "gamg"}},
            "linear='multigrid' chooses ksp_type and pc_type",
        ),
    ],
)
def test_what_cannot_be_is_refused(options, sentence):
    with pytest.raises(MPMError, match=sentence):
        heavy(2, **options)


def test_the_pivot_of_an_unstable_body_is_passed_by_smaller_steps():
    # The tangent is indefinite on the way, which conjugate gradients find out.
    runs = [heavy(20, weight=25e3, linear_solver=name) for name in ("direct", "multigrid")]
    for run in runs:
        run.solve(steps=2)
    assert runs[0].history.statistics["redirections"] > 0 or runs[0].history.cutbacks > 0
    assert runs[1].history.cutbacks <= runs[0].history.cutbacks
    a, b = (scenes.own(run.particles.displacement) for run in runs)
    assert scenes.largest(a - b) < 0.02 * scenes.largest(a)
    assert np.isfinite(b).all()


def test_an_indefinite_tangent_whose_step_does_needs_no_smaller_load():
    # The block slides freely on the one below: contact's tangent is indefinite on the way.
    runs = []
    for name in ("direct", "multigrid"):
        grid = scenes.box([0.0, 0.0], [6.0, 6.0], [24, 24], QUADRILATERAL)
        lower, upper = scenes.vectors(grid), scenes.vectors(grid)
        base = scenes.box([0.5, 0.0], [5.5, 2.0], [40, 16], QUADRILATERAL)
        top = scenes.box([1.5, 2.0], [4.5, 4.0], [24, 16], QUADRILATERAL)
        tags = [
            scenes.facet_tags(base, scenes.at(1, 2.0)),
            scenes.facet_tags(top, scenes.at(1, 2.0), scenes.at(1, 4.0)),
        ]
        bodies = [mpm.Particles(base, lower), mpm.Particles(top, upper)]
        touch = mpm.contact.Pair(bodies[1], bodies[0], facets=[(one, 1) for one in tags[::-1]])
        run = posed(
            mpm.QuasiStaticProblem,
            bodies,
            Hencky(1e6, 0.3),
            tractions=[[], [((0.0, -1e5), 2)]],
            facet_tags=tags,
            bcs=[scenes.fix(lower, scenes.at(1, 0.0))],
            terms=[touch],
            linear_solver=name,
        )
        run.solve(steps=2)
        runs.append(run)
    direct, multigrid = runs
    assert multigrid.history.statistics["krylov_iterations"] > 0
    assert multigrid.history.cutbacks == direct.history.cutbacks == 0
    assert multigrid.history.total_iterations <= direct.history.total_iterations + 3
    ends = [scenes.own(run.bodies[1].displacement).reshape(-1, 2)[:, 1].sum() for run in runs]
    sunk = [scenes.WORLD.allreduce(end) for end in ends]  # (what rocks is held by next to nothing)
    assert sunk[1] == pytest.approx(sunk[0], rel=1e-4)
