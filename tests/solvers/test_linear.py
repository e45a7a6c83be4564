# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""PETSc options, direct and iterative solvers."""

import warnings

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest
import scenes
from scenes import QUADRILATERAL, TRIANGLE, WORLD

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky
from mpm_dolfinx.solvers import linear
from mpm_dolfinx.solvers.strategies import STRATEGIES as TABLE


def test_results_do_not_depend_on_the_direct_solver():
    runs = []
    for solver in ("superlu_dist", "mumps"):
        options = {"pc_type": "lu", "pc_factor_mat_solver_type": solver}
        problem = scenes.slump(TRIANGLE, 15e3, h=1.0, petsc_options=options)
        problem.solve(steps=10)
        runs.append(problem.particles.displacement.x.array.copy())
        assert problem.solver.getKSP().getPC().getFactorSolverType() == solver
    assert scenes.largest(runs[0]) > 1.0
    assert scenes.largest(runs[0] - runs[1]) < 1e-6


def test_petsc_options_reach_their_problem_and_no_other():
    options = {"snes_rtol": 1e-5, "snes_max_it": 17}
    problem = scenes.block(petsc_options=options)
    rtol, _, _, max_it = problem.solver.getTolerances()
    assert (rtol, max_it) == (1e-5, 17)
    assert scenes.block().solver.getTolerances() == (1e-9, 0.0, 0.0, 30)
    problem.solve(steps=1)
    assert 1e-12 < problem.history.steps[0].residuals[-1] < 1e-5


def test_petsc_options_by_prefix():
    # Options from the command line or the database, as in any PETSc program.
    database = PETSc.Options()
    database["lines_snes_max_it"] = 7
    problem = scenes.block(petsc_options_prefix="lines_", petsc_options={"snes_rtol": 1e-6})
    rtol, _, _, max_it = problem.solver.getTolerances()
    assert (rtol, max_it) == (1e-6, 7)
    assert problem.solver.getOptionsPrefix() == "lines_"
    database.delValue("lines_snes_max_it")


def test_multigrid_knows_the_rigid_motions():
    # Without conditions these are what the tangent of a body at rest gives no force to.
    V = scenes.vectors(scenes.box([0.0, 0.0], [4.0, 3.0], [20, 15], QUADRILATERAL))
    body = scenes.box([0.5, 0.3], [3.5, 2.7], [30, 24], TRIANGLE)
    options = {"ksp_type": "cg", "pc_type": "gamg", "ksp_rtol": 1e-10}
    problem = mpm.QuasiStaticProblem(
        mpm.Body(mpm.Particles(body, V), Hencky(1e4, 0.3), density=1.0, body_force=(0.0, -1.0)),
        bcs=[scenes.fix(V, scenes.at(1, 0.6))],
        solver=mpm.Solver(petsc_options=options),
    )
    problem.bcs.clear()
    problem.reduced.begin([np.zeros_like(problem.particles.increment.x.array)], 1.0)
    x = PETSc.Vec().createMPI(problem.reduced.unknowns.sizes, comm=WORLD)
    problem.reduced.residual(x, x.duplicate())
    K = problem.reduced.tangent()
    motions = problem.reduced.levels.rigid_motions().getVecs()
    assert len(motions) == 3
    for number, motion in enumerate(motions):
        assert abs(motion.norm() - 1.0) < 1e-14
        assert all(abs(motion.dot(other)) < 1e-14 for other in motions[:number])
        assert (K * motion).norm() < 1e-12 * K.norm()


def test_iterative_solver():
    options = {"ksp_type": "cg", "pc_type": "gamg", "ksp_rtol": 1e-10, "ksp_max_it": 200}
    moved = []
    for given in ({}, options):
        problem = scenes.slump(TRIANGLE, 5e3, h=0.25, petsc_options=given)
        problem.solve(steps=2)
        body = problem.particles
        moved.append(scenes.in_order(body, body.centroid - body.initial_centroid))
    assert problem.solver.getKSP().getPC().getType() == "gamg"
    assert np.abs(moved[0]).max() > 1e-3
    assert np.abs(moved[0] - moved[1]).max() < 1e-8


def test_a_solver_that_does_not_solve_is_told_as_one_and_not_as_a_limit():
    options = {"ksp_type": "cg", "pc_type": "jacobi", "ksp_max_it": 2}
    with pytest.raises(mpm.ConvergenceError) as told:
        scenes.block(petsc_options=options).solve(steps=1)
    text = str(told.value)
    assert "ksp_type cg with pc_type jacobi did not solve" in text
    assert "DIVERGED_MAX_IT after 2 iterations" in text
    assert "limit" not in text and text.endswith("leave ksp_type and pc_type out.")


def test_options_of_the_factor_reach_it():
    # PETSc reads them when it makes the factor, at the first solve.
    problem = scenes.block(petsc_options={"mat_mumps_icntl_7": 0, "mat_mumps_icntl_14": 77})
    problem.solve(steps=1)
    factor = problem.solver.getKSP().getPC().getFactorMatrix()
    assert factor.getMumpsIcntl(7) == 0 and factor.getMumpsIcntl(14) == 77
    assert not PETSc.Options().hasName("mpm_mat_mumps_icntl_7")


def test_options_that_petsc_does_not_read_are_named_once(mpi_tmp_path):
    unread = {"pc_typ": "lu", "snes_max_its": 9, "mat_mumps_icntl_14": 40}
    view = {"ksp_view": f":{mpi_tmp_path / 'view.txt'}"}
    problem = scenes.block(petsc_options=unread | view)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        problem.solve(steps=3)
    named = "does not read 'pc_typ' and 'snes_max_its' of"
    told = [one for one in caught if named in str(one.message)]
    assert len(told) == len(caught) == (1 if WORLD.rank == 0 else 0)


class Alone:
    """What a factor asks about unknowns that are displacements alone."""

    constrained = False
    held = False
    nested = True

    def diagonal(self, K):
        diagonal = K.getDiagonal()
        diagonal.abs()
        return diagonal


@pytest.mark.parametrize("few", [True, False])
@pytest.mark.parametrize("negative", [0, 1, 7])
def test_negative_pivots_are_the_negative_eigenvalues(few, negative, monkeypatch):
    n = 40
    if not few:
        monkeypatch.setitem(TABLE, 2, TABLE[2]._replace(few=0))
    random = np.random.default_rng(negative)
    basis = np.linalg.qr(random.standard_normal((n, n)))[0]
    eigenvalues = random.uniform(1.0, 100.0, n)
    eigenvalues[:negative] *= -1.0
    dense = (basis * eigenvalues) @ basis.T
    dense = 0.5 * (dense + dense.T)
    own = MPI.COMM_SELF
    csr = np.arange(0, n * n + 1, n, dtype=np.int32), np.tile(np.arange(n, dtype=np.int32), n)
    K = PETSc.Mat().createAIJ((n, n), csr=(*csr, dense.ravel()), comm=own)
    snes = PETSc.SNES().create(own)
    factor = linear.ShiftedFactor(snes, "pivots_", {}, True, 1e-13, 2, mpm.Statistics())
    factor.begin(n, Alone())
    factor.set(K, Alone())
    package = snes.getKSP().getPC().getFactorSolverType()
    assert package == ("petsc" if few else "mumps")
    assert factor.negative_pivots() == negative
    b = K.createVecLeft()
    b.array_w[:] = random.standard_normal(n)
    x = b.duplicate()
    factor.solve(b, x)
    np.testing.assert_allclose(x.array_r, np.linalg.solve(dense, b.array_r), rtol=1e-9)


def test_a_tangent_without_a_shift_is_damped_in_a_copy():
    n, own = 8, MPI.COMM_SELF
    csr = np.arange(n + 1, dtype=np.int32), np.arange(n, dtype=np.int32)
    K = PETSc.Mat().createAIJ((n, n), csr=(*csr, np.full(n, 2.0)), comm=own)
    levels = Alone()
    levels.held = True
    snes = PETSc.SNES().create(own)
    factor = linear.ShiftedFactor(snes, "damped_", {}, True, 1e-13, 2, mpm.Statistics())
    factor.begin(n, levels)
    b = K.createVecLeft()
    b.set(1.0)
    x = b.duplicate()
    for damping, value in ((0.0, 0.5), (0.25, 0.4), (0.0, 0.5), (0.5, 1.0 / 3.0)):
        factor.set(K, levels, damping)
        snes.getKSP().solve(b, x)
        np.testing.assert_allclose(x.array_r, value)
        np.testing.assert_array_equal(K.getDiagonal().array_r, 2.0)


class Chain(Alone):
    """Unknowns along a line, of which every second one is coarser."""

    def splits(self):
        return [("displacement", slice(0, 0))]

    def diagonal(self, K):
        diagonal = super().diagonal(K)
        diagonal.array_w[diagonal.array_r == 0.0] = diagonal.max()[1]
        return diagonal

    def interpolations(self, coarsest, values):
        n = 801
        weights = np.zeros((n, n // 2 + 1))
        fine = np.arange(n)
        for places in (fine // 2, (fine + 1) // 2):
            weights[fine, places] += 0.5
        P = PETSc.Mat().createDense(weights.shape, array=weights, comm=MPI.COMM_SELF)
        return [P.convert("aij")]


def multigrid_for(n, levels):
    """Return multigrid for so many unknowns."""
    snes = PETSc.SNES().create(MPI.COMM_SELF)
    snes.setOptionsPrefix("chain_")
    given = "chain_", {"ksp_rtol": 1e-12}, True, 1e-13, 2, mpm.Statistics(), "multigrid"
    factor = linear.ShiftedFactor(snes, *given)
    factor.begin(n, levels)
    return factor


def chain():
    """Springs in a row between two walls: the tangent, forces, and multigrid for them."""
    n, own = 801, MPI.COMM_SELF
    dense = 2.0 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    K = PETSc.Mat().createDense((n, n), array=dense, comm=own).convert("aij")
    factor = multigrid_for(n, Chain())
    b = K.createVecLeft()
    b.array_w[:] = np.sin(np.arange(n))
    return dense, K, b, factor


def test_multigrid_copies_a_tangent_only_to_shift_it():
    dense, K, b, factor = chain()
    b.array_w[400] = 0.0
    x = b.duplicate()
    for case in ("plain", "nothing holds an unknown", "damped", "plain"):
        values = dense.copy()
        if case == "nothing holds an unknown":
            values[400] = values[:, 400] = 0.0
        for row in (399, 400, 401):
            near = [row - 1, row, row + 1]
            K.setValues([row], near, values[row, near])
        K.assemble()
        damping = 0.25 if case == "damped" else 0.0
        factor.set(K, Chain(), damping)
        assert (factor.P is K) == (case == "plain")
        assert factor.step(b, x) is None
        exact = values + damping * np.diag(np.diag(values))
        if case == "nothing holds an unknown":
            exact[400, 400] = 1.0
        error = np.abs(x.array_r - np.linalg.solve(exact, b.array_r)).max()
        assert error < 1e-6 * np.abs(x.array_r).max()
        np.testing.assert_array_equal(K.getDiagonal().array_r, np.diag(values))


class Ladder(Chain):
    """Two unknowns at each place of a chain."""

    def interpolations(self, coarsest, values):
        (P,) = super().interpolations(coarsest, values)
        weights = np.kron(P.convert("dense").getDenseArray(), np.eye(2))
        P = PETSc.Mat().createDense(weights.shape, array=weights, comm=MPI.COMM_SELF)
        return [P.convert("aij")]


def test_multigrid_shifts_a_tangent_that_it_cannot_solve_with_as_it_is():
    # Sweeps divide by the blocks of rows with the same columns, of which one is singular, though
    # all diagonals are positive.
    dense, *_ = chain()
    dense = np.kron(dense, [[1.0, 0.3], [0.3, 1.0]])
    pattern = dense != 0.0
    pair = slice(400, 402)
    dense[pair] = dense[:, pair] = 0.0
    dense[pair, pair] = [[1.0, -1.0], [-1.0, 1.0]]
    n = len(dense)
    columns = [np.flatnonzero(row).astype(np.int32) for row in pattern]
    rows = np.concatenate([[0], np.cumsum([len(row) for row in columns])]).astype(np.int32)
    values = np.concatenate([dense[i, columns[i]] for i in range(n)])
    csr = rows, np.concatenate(columns), values
    K = PETSc.Mat().createAIJ((n, n), csr=csr, comm=MPI.COMM_SELF)
    factor = multigrid_for(n, Ladder())
    b = K.createVecLeft()
    b.array_w[:] = np.sin(np.arange(n))
    b.array_w[pair] = 1.0, -1.0
    x = b.duplicate()
    for _ in range(2):
        factor.set(K, Ladder())
        assert factor.step(b, x) is None
        assert factor.iterates and factor.P is not K
        assert (K * x - b).norm() < 1e-6 * b.norm()


@pytest.mark.skip_in_parallel
def test_few_unknowns_are_factorised_by_petsc_with_the_same_result(monkeypatch):
    # Unknowns of the column become more as it spreads over the cells: packages change on the way.
    moved, packages = [], []
    for few in (0, 80, 10000):
        monkeypatch.setitem(TABLE, 2, TABLE[2]._replace(few=few))
        problem = scenes.slump(TRIANGLE, 15e3, h=1.0)
        used = set()
        for _ in problem.steps(10):
            used.add(problem.solver.getKSP().getPC().getFactorSolverType())
        packages.append(used)
        moved.append(scenes.own(problem.particles.displacement).copy())
    assert packages == [{"mumps"}, {"mumps", "petsc"}, {"petsc"}]
    assert scenes.largest(moved[0]) > 1.0
    for other in moved[1:]:
        assert scenes.largest(moved[0] - other) < 1e-6


def test_rows_are_scaled_on_any_number_of_ranks():
    # MUMPS leaves out what it cannot do, and tells what it has done.
    problem = scenes.block(petsc_options={"mat_mumps_icntl_14": 30})
    problem.solve(steps=1)
    factor = problem.solver.getKSP().getPC().getFactorMatrix()
    assert factor.getMumpsInfog(33) == factor.getMumpsIcntl(8) > 0


def test_what_options_say_of_the_factor_holds_for_few_unknowns_too():
    problem = scenes.block(petsc_options={"mat_mumps_icntl_14": 30})
    problem.solve(steps=1)
    assert problem.solver.getKSP().getPC().getFactorSolverType() == "mumps"
    assert problem.history.statistics["free_dofs"] <= TABLE[2].few
