# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Grid lines that draw together at places, and meshes of them."""

import numpy as np
import pytest
from compare import raises
from scenes import TRIANGLE, WORLD

from dolfinx import mesh

import mpm_dolfinx as mpm


def test_equal_cells_longer_ones_and_halved_ones():
    found = mpm.grid_lines(0.0, 4.0, 0.25, equal=(0.0, 2.0), finer_at=1.0, halvings=3)
    assert found[0] == 0.0 and found[-1] == 4.0
    lengths = np.diff(found)
    near = np.argmin(np.abs(found - 1.0))
    assert found[near] == pytest.approx(1.0, abs=1e-14)
    towards = [0.25, 0.125, 0.0625, 0.03125, 0.03125]
    assert lengths[near - 5 : near] == pytest.approx(towards)
    assert lengths[near : near + 5] == pytest.approx(towards[::-1])
    beyond = lengths[found[:-1] > 2.0 - 1e-9]
    assert beyond[1:] / beyond[:-1] == pytest.approx(1.2)
    assert 0.7 * 0.3 < beyond[0] <= 0.3


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_lines_are_mirrored_and_scaled_with_their_numbers(scale):
    to_the_right = mpm.grid_lines(0.0, 5.0, 0.5, equal=(0.0, 1.5), finer_at=(0.0, 0.5), halvings=4)
    to_the_left = mpm.grid_lines(
        -5.0 * scale,
        0.0,
        0.5 * scale,
        equal=(-1.5 * scale, 0.0),
        finer_at=(-0.5 * scale, 0.0),
        halvings=4,
    )
    # two places beside each other halve the cell between them once
    assert np.diff(to_the_right).min() == pytest.approx(0.5 / 16)
    assert -to_the_left[::-1] / scale == pytest.approx(to_the_right, abs=1e-13)


def test_no_cells_are_longer_or_finer_unless_asked_for():
    assert mpm.grid_lines(1.0, 3.0, 0.4) == pytest.approx(np.linspace(1.0, 3.0, 6))


@pytest.mark.parametrize("dim", [2, 3])
def test_a_mesh_has_the_lines(dim):
    places = [
        mpm.grid_lines(0.0, 3.0, 0.5, finer_at=1.0, halvings=2),
        [0.0, 0.1, 1.0],
        [-2.0, 0.0, 5.0],
    ]
    domain = mpm.grid(WORLD, places[:dim])
    for axis in range(dim):
        x = np.concatenate(WORLD.allgather(domain.geometry.x[:, axis]))
        assert np.unique(np.round(x, 12)) == pytest.approx(places[axis])
    cells = domain.topology.index_map(dim).size_global
    assert cells == np.prod([len(along) - 1 for along in places[:dim]])
    if dim == 2:
        halves = mpm.grid(WORLD, places[:dim], TRIANGLE)
        assert halves.topology.index_map(dim).size_global == 2 * cells


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"size": -1.0}, "positive size"),
        ({"size": np.nan}, "finite"),
        ({"size": 1e-9}, "cells"),
        ({"equal": (0.5, 5.0)}, "equal= from start to stop"),
        ({"equal": (0.0, 1.0, 2.0)}, "a pair"),
        ({"finer_at": 7.0}, "not between"),
        ({"finer_at": "edge"}, "needs numbers"),
        ({"halvings": 1.5}, "whole number"),
    ],
)
def test_what_makes_no_sense_is_said(options, words):
    given = {"start": 0.0, "stop": 2.0, "size": 0.5, **options}
    raises(lambda: mpm.grid_lines(**given), mpm.MPMError, words)


LINES = [0.0, 1.0]


@pytest.mark.parametrize(
    "places", [[LINES], [LINES, [1.0, 0.0]], [LINES, "lines"], [LINES, [0.0, np.inf]]]
)
def test_lines_that_make_no_mesh_are_refused(places):
    raises(lambda: mpm.grid(WORLD, places), mpm.MPMError, r"grid\(\)")


def test_cells_of_another_dimension_are_refused():
    for axes, kind in ((2, "tetrahedron"), (2, "interval"), (3, "quadrilateral"), (3, "prism")):
        wrong = getattr(mesh.CellType, kind)
        raises(
            lambda axes=axes, wrong=wrong: mpm.grid(WORLD, [LINES] * axes, wrong),
            mpm.MPMError,
            f"with {axes} axes is .* not {kind}",
        )
