# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Dofs that others can stand for: against singular values, and as no unknowns of a run."""

import numpy as np
import pytest
import scenes
from scenes import PLANE, TRIANGLE

from mpm_dolfinx.stabilisation.dependent_dofs import dependent_columns


def of(matrix):
    """Return the dependent columns of a dense matrix, its rows dealt out to the ranks."""
    matrix = np.asarray(matrix, dtype=float)
    rows, columns = np.nonzero(matrix)
    found = dependent_columns(rows, columns, matrix[rows, columns])
    rest = matrix.copy()
    for d, k, c in zip(found.which, found.stand_ins, found.coefficients, strict=True):
        assert k not in found.columns
        rest[:, found.columns[d]] -= c * matrix[:, k]
    np.testing.assert_allclose(
        np.linalg.norm(rest[:, found.columns], axis=0),
        0.0,
        atol=1e-6 * np.abs(matrix).max(initial=0.0),
    )
    return found.columns.tolist()


def test_of_small_matrices():
    assert of(np.eye(3)) == []
    assert of([[1.0, 2.0, 0.0], [0.0, 0.0, 1.0]]) == [1]
    assert of([[2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) in ([0], [1])
    assert len(of([[1.0, 2.0, 3.0, 0.0], [1.0, 0.5, 0.2, 1.0]])) == 2
    assert of([[1.0, 1.0], [1.0, 1.0 + 1e-3]]) == []
    assert len(of([[1.0, 1e9], [1e-12, 1e-3]])) == 1  # whatever the columns' lengths
    assert of(np.zeros((2, 2))) == []


@pytest.mark.parametrize("cell", PLANE, ids=scenes.name)
def test_as_many_as_there_are_singular_values_of_zero(cell):
    problem = scenes.slump(cell, 40e3, h=1.0, width=40.0)
    found = 0
    for _ in problem.steps(12):
        matrix = scenes.dense(problem.particles.T)
        active = np.flatnonzero(np.abs(matrix).max(axis=0))
        matrix = matrix[:, active]
        values = np.linalg.svd(matrix / np.linalg.norm(matrix, axis=0), compute_uv=False)
        zero = int((values < 1e-8).sum())
        dependent = of(matrix)
        assert len(dependent) == zero
        kept = np.delete(matrix, dependent, axis=1)
        kept = np.linalg.svd(kept / np.linalg.norm(kept, axis=0), compute_uv=False)
        assert kept.min(initial=1.0) > 1e-8
        found = max(found, zero)
    assert found > 0


@pytest.mark.parametrize("shift", [1e-13, 0.0])
def test_a_run_without_them_is_that_with_a_shift(shift):
    runs = []
    for options in ({"dependent_dofs": "shift"}, {"dependent_dofs": "remove", "shift": shift}):
        problem = scenes.slump(TRIANGLE, 40e3, h=1.0, width=40.0, **options)
        problem.solve(steps=12)
        runs.append(problem)
    one, two = (scenes.in_order(p.particles, p.particles.centroid) for p in runs)
    np.testing.assert_allclose(one, two, rtol=0, atol=1e-6)
    statistics = [p.history.statistics for p in runs]
    assert statistics[0]["dependent_dofs"] == 0 < statistics[1]["dependent_dofs"]
    assert [p.history.cutbacks for p in runs] == [0, 0]


def test_no_dependent_dofs_where_the_body_fills_its_cells():
    problem = scenes.block(dependent_dofs="remove")
    problem.solve(steps=1)
    assert problem.history.statistics["dependent_dofs"] == 0
