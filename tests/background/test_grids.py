# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Rectilinear grids over backgrounds of every kind."""

import numpy as np
import pytest
import scenes
from scenes import HEXAHEDRON, TETRAHEDRON

from mpm_dolfinx.background.grids import box_weights, cell_lines, coarser


def graded(n, cell):
    """Return a mesh of the unit square whose columns are finer at the left."""
    domain = scenes.unit(n, cell)
    domain.geometry.x[:, 0] **= 2
    return domain


@pytest.mark.parametrize("cell", scenes.ALL, ids=scenes.name)
@pytest.mark.parametrize("degree", [1, 2])
def test_lines_are_those_of_the_vertices(cell, degree):
    dim = 3 if cell in (TETRAHEDRON, HEXAHEDRON) else 2
    grid = scenes.box([0.0] * dim, [1.0, 2.0, 3.0][:dim], [5, 4, 3][:dim], cell)
    lines = cell_lines(scenes.vectors(grid, degree))
    assert len(lines) == dim
    for line, end, n in zip(lines, [1.0, 2.0, 3.0], [5, 4, 3], strict=False):
        assert np.allclose(line, np.linspace(0.0, end, n + 1), rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("cell", scenes.PLANE, ids=scenes.name)
def test_lines_of_a_graded_grid(cell):
    x, y = cell_lines(scenes.vectors(graded(8, cell)))
    assert np.allclose(x, (np.arange(9) / 8) ** 2, rtol=0.0, atol=1e-14)
    assert np.allclose(y, np.arange(9) / 8, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("cell", scenes.PLANE, ids=scenes.name)
def test_lines_of_other_meshes_are_as_far_apart_as_cells_are_large(cell):
    domain = scenes.bend(graded(16, cell), 0.01)
    for line, exact in zip(
        cell_lines(scenes.vectors(domain)),
        ((np.arange(17) / 16) ** 2, np.arange(17) / 16),
        strict=True,
    ):
        assert line[0] == 0.0 and abs(line[-1] - 1.0) < 1e-14
        assert 12 <= len(line) <= 20
        places = np.linspace(0.1, 0.9, 9)
        mine, theirs = (np.diff(w)[np.searchsorted(w, places) - 1] for w in (line, exact))
        assert np.all((mine > 0.5 * theirs) & (mine < 2.0 * theirs))


def test_every_second_line_is_kept_and_the_last():
    assert [list(line) for line in coarser([np.arange(5.0), np.arange(4.0), np.arange(2.0)])] == [
        [0.0, 2.0, 4.0],
        [0.0, 2.0, 3.0],
        [0.0, 1.0],
    ]


@pytest.mark.parametrize("dim", [2, 3])
def test_weights_are_those_of_multilinear_functions(dim):
    random = np.random.default_rng(3)
    lines = [np.cumsum(random.uniform(0.5, 2.0, n)) for n in (4, 5, 6)[:dim]]
    corners = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, dim)
    low, high = corners[0], corners[-1]
    points = np.concatenate([low + (high - low) * random.uniform(size=(50, dim)), corners])
    numbers, values = box_weights(lines, points)

    def function(x):
        return 1.0 + x @ np.arange(1.0, dim + 1.0) + np.prod(x, axis=1)

    assert np.allclose(values.sum(axis=1), 1.0, rtol=0.0, atol=1e-14)
    assert values.min() >= 0.0
    found = np.einsum("nk,nk->n", function(corners)[numbers], values)
    assert np.allclose(found, function(points), rtol=1e-13)
    assert np.all(np.count_nonzero(values[50:], axis=1) == 1)
