# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What is taken for real numbers."""

import numpy as np
import pytest
import scenes
from scenes import QUADRILATERAL

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.reals import as_reals, as_wholes, is_one_of


def test_numbers_and_constants():
    body = scenes.unit(2, QUADRILATERAL)
    given = (1, fem.Constant(body, 2.5))
    assert as_reals(given).tolist() == [1.0, 2.5]
    assert as_reals(np.float32(0.5)) == 0.5
    values = np.zeros(3)
    assert not np.shares_memory(as_reals(values), values)


@pytest.mark.parametrize(
    "value", [None, (0.0, None), 1j, (0.0, 1j), np.ones(2) * 1j, "up", [[1.0], [1.0, 2.0]], {}]
)
def test_what_is_no_number(value):
    with pytest.raises((TypeError, ValueError)):
        as_reals(value)
    with pytest.raises(mpm.MPMError, match="point must be"):
        mpm.contact.plane(value, (0.0, 1.0))


def test_ufl_without_a_value():
    # NumPy takes a scalar for a sequence of sequences without end.
    body = scenes.unit(2, QUADRILATERAL)
    scalar = fem.Function(fem.functionspace(body, ("Lagrange", 1)))
    for value in (scalar, (0.0, scalar), ufl.SpatialCoordinate(body)[0]):
        with pytest.raises(TypeError, match="UFL"):
            as_reals(value)
    with pytest.raises(ValueError, match="large"):
        as_reals(10**400)
    V = scenes.vectors(scenes.box([-1.0, -1.0], [2.0, 2.0], [3, 3], QUADRILATERAL))
    wall = mpm.contact.Rigid(mpm.Particles(body, V), mpm.contact.plane((0.0, 0.0), (0.0, 1.0)))
    with pytest.raises(mpm.MPMError, match="offset of an obstacle must be 2 finite numbers"):
        wall.move((0.0, scalar))


def test_truths_are_no_numbers_among_others_either():
    for value in ((True, 0.0), [[1.0, np.False_]], (np.True_,), True):
        with pytest.raises(TypeError):
            as_reals(value)
        with pytest.raises(TypeError):
            as_wholes(value)


def test_whole_numbers():
    assert as_wholes([3, 1]).dtype == np.int64 and as_wholes([]).size == 0
    given = np.arange(3)
    assert not np.shares_memory(as_wholes(given), given)
    for value in ([1.0], "a", 1.5, None, [[1], [1, 2]], lambda: 1):
        with pytest.raises((TypeError, ValueError)):
            as_wholes(value)


def test_names():
    assert is_one_of("a", ("a", "b"))
    assert not any(is_one_of(v, ("a", "b")) for v in (None, "c", ["a"], np.array(["a", "b"])))
