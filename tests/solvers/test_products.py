# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Products by compiled loops: those of NumPy's dense matrices and of PETSc."""

from __future__ import annotations

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest

from mpm_dolfinx.solvers.products import acting, galerkin, keep_rows

COMM = MPI.COMM_SELF


def sparse(rng: np.random.Generator, shape: tuple[int, int], equal: int) -> np.ndarray:
    """Return a dense matrix with few entries, of which some rows are empty and some alike."""
    pattern = np.repeat(rng.random((-(-shape[0] // equal), shape[1])) < 0.3, equal, axis=0)
    pattern[rng.random(len(pattern)) < 0.1] = False
    return np.where(pattern[: shape[0]], rng.normal(size=shape), 0.0)


def with_rows(dense: np.ndarray) -> PETSc.Mat:
    """Return a PETSc matrix that lives in known arrays."""
    rows, columns = np.nonzero(dense)
    ends = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=len(dense)))])
    arrays = ends.astype(np.int32), columns.astype(np.int32), dense[rows, columns]
    matrix = PETSc.Mat().createAIJWithArrays(dense.shape, arrays, comm=COMM)
    keep_rows(matrix, *arrays)
    return matrix


@pytest.mark.parametrize("equal", [1, 3])
@pytest.mark.parametrize("shape", [(1, 1), (40, 40), (61, 17)])
def test_products_are_those_of_dense_matrices(shape: tuple[int, int], equal: int) -> None:
    """So they are after values have changed, where rows are empty or alike."""
    rng = np.random.default_rng(shape[0] + equal)
    dense = sparse(rng, shape, equal)
    matrix = with_rows(dense)
    other = acting(matrix)
    assert other.getType() == "python"
    assert acting(matrix) == other
    for _ in range(2):
        x, y = matrix.createVecs()
        x.array_w[:] = rng.normal(size=shape[1])
        other.mult(x, y)
        size = np.abs(dense) @ np.abs(x.array_r)
        assert np.all(np.abs(y.array_r - dense @ x.array_r) <= 1e-14 * size)
        matrix.scale(3.0)
        dense *= 3.0


@pytest.mark.parametrize("equal", [1, 3])
def test_galerkin_products_are_those_of_dense_matrices(equal: int) -> None:
    """So they are where a row of P is empty, where A is not symmetric, and for new values of it.

    Of coarse nodes with several numbers each, all but the first see what that sees.
    """
    rng = np.random.default_rng(equal)
    dense = sparse(rng, (51, 51), equal)
    down = np.kron(sparse(rng, (51 // equal, 12 // equal), 1), np.eye(equal))
    A, P = with_rows(dense), with_rows(down)
    result = None
    for _ in range(2):
        result = galerkin(A, P, result)
        expected = down.T @ dense @ down
        assert np.allclose(result[:, :], expected, rtol=0.0, atol=1e-13 * np.abs(expected).max())
        again = acting(result)
        x, y = result.createVecs()
        x.set(1.0)
        again.mult(x, y)
        assert np.allclose(y.array_r, expected.sum(axis=1), rtol=0.0, atol=1e-12)
        A.scale(-2.0)
        dense *= -2.0


def test_matrices_whose_arrays_are_not_known_have_petscs_products() -> None:
    """They act for themselves."""
    rng = np.random.default_rng(5)
    dense, down = sparse(rng, (20, 20), 3), sparse(rng, (20, 7), 1)
    A, P = with_rows(dense).copy(), with_rows(down)
    assert acting(A) == A
    result = galerkin(A, P)
    expected = down.T @ dense @ down
    assert np.allclose(result[:, :], expected, rtol=0.0, atol=1e-13 * np.abs(expected).max())
    galerkin(A, P, result)
    assert np.allclose(result[:, :], expected, rtol=0.0, atol=1e-13 * np.abs(expected).max())
