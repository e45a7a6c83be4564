# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What acts between points and facets: compiled loops against NumPy and the complex step."""

import numpy as np
import pytest

import basix

from mpm_dolfinx._core import loops
from mpm_dolfinx.contact import stencil
from mpm_dolfinx.contact.law import Coulomb, Points

TOUCH, EXTENT = 1e-12, 1.0
SIDES = {
    "line": (basix.CellType.interval, 1),
    "curve": (basix.CellType.interval, 2),
    "triangle": (basix.CellType.triangle, 1),
    "quadrilateral": (basix.CellType.quadrilateral, 1),
    "curved quadrilateral": (basix.CellType.quadrilateral, 2),
}
FRICTION = {
    "smooth": Coulomb(),
    "rough": Coulomb(0.3),
    "limited": Coulomb(0.5, 0.1, 0.12),
}


def meeting(side, law, count=60):
    """Return points that stick, slip, have just come and are away, at bent facets."""
    cell, degree = SIDES[side]
    variant = basix.LagrangeVariant.gll_warped
    element = basix.create_element(basix.ElementFamily.P, cell, degree, variant)
    e, k, some = element.points.shape[1], element.dim, np.random.default_rng(1)
    second = [[(2,)]] if e == 1 else [[(2, 0), (1, 1)], [(1, 1), (0, 2)]]

    def table(places):
        values = element.tabulate(2, places)[:, :, :, 0]
        at = np.array([[basix.index(*powers) for powers in row] for row in second])
        slopes = values[1 : 1 + e].swapaxes(0, 1)
        return values[0], slopes, np.moveaxis(values[at], 2, 0)

    place, anchored = (some.uniform(0.1, 0.5, (count, e)) for _ in range(2))
    flat = np.column_stack([element.points, np.zeros(k)])
    X, anchors = (flat + 0.1 * some.normal(size=(count, k, e + 1)) for _ in range(2))
    x = np.einsum("nk,nki->ni", table(place)[0], X) + 0.05 * some.normal(size=(count, e + 1))
    parts = [x[:, None], X] if law.smooth else [x[:, None], X, anchors]
    points = Points(
        some.uniform(1.0, 2.0, count),
        some.uniform(0.1, 2.0, count),
        some.random(count) < 0.5,
        np.zeros((count, 0)),
        some.uniform(-0.1, 0.1, count),
        some.uniform(0.8, 1.3, count),
    )
    return stencil.Stencil(
        np.arange(count),
        place,
        table(place),
        table(anchored)[0],
        np.concatenate(parts, axis=1),
        points,
        some.choice([-1.0, 1.0], count),
        None,
    )


@pytest.mark.skipif(loops is None, reason="needs the compiled loops")
@pytest.mark.parametrize("friction", FRICTION)
@pytest.mark.parametrize("side", SIDES)
def test_compiled_loops_do_what_numpy_and_the_complex_step_do(side, friction):
    law = FRICTION[friction]
    points = meeting(side, law)
    told = stencil.acting_now(law, points, TOUCH, EXTENT)
    known = stencil.acting(law, points, points.x, TOUCH, EXTENT)
    assert 10 < known.acts.inside.sum() < 50 and (law.smooth or known.acts.slips.any())
    assert np.array_equal(told.acts.inside, known.acts.inside)
    assert np.array_equal(told.acts.slips, known.acts.slips)
    for found, value in zip(
        (*told[:2], *told.acts[:2]), (*known[:2], *known.acts[:2]), strict=True
    ):
        np.testing.assert_allclose(found, value, atol=1e-14)
    D = stencil.derivatives(law, points, TOUCH, EXTENT)
    by_steps = stencil.by_complex_step(law, points, TOUCH, EXTENT)
    np.testing.assert_allclose(D, by_steps, atol=1e-13 * np.abs(by_steps).max())


@pytest.mark.parametrize("side", SIDES)
def test_directions_of_complex_steps_are_the_same_one_by_one(monkeypatch, side):
    law = FRICTION["rough"]
    points = meeting(side, law)
    shape = np.array(points.x[:, : 1 + points.anchored.shape[1]])
    before = shape + 0.01 * np.random.default_rng(3).normal(size=shape.shape)
    gap, offset = points.points.gap, np.minimum(0.1 * points.points.gap, 0.0)
    whole = points._replace(start=stencil.Start(before, points.table, gap, offset))
    for case in (points, whole):
        found = stencil.by_complex_step(law, case, TOUCH, EXTENT)
        with monkeypatch.context() as one_by_one:
            one_by_one.setattr(stencil, "AT_ONCE", 1)
            known = stencil.by_complex_step(law, case, TOUCH, EXTENT)
        scale = np.abs(known).max()
        assert scale > 0.1
        np.testing.assert_allclose(found, known, atol=1e-13 * scale)


@pytest.mark.parametrize("spread", ["rows", "columns", "both"])
def test_compiled_blocks_are_those_of_numpy(monkeypatch, spread):
    some = np.random.default_rng(2)
    n, dim, k = 20, 3, 4
    D = some.normal(size=(n, 1 + k, dim, 1 + 2 * k, dim))
    shapes, none = some.normal(size=(n, 6)), np.zeros((0, k))
    rows = (0, shapes) if spread != "columns" else (1, none)
    columns = (0, shapes) if spread != "rows" else (1 + k, none)
    size = (5, dim * (6 if rows[0] == 0 else k), dim * (6 if columns[0] == 0 else k))
    number, weights = some.integers(0, 5, n), some.uniform(size=n)
    found = stencil.added_blocks(D, weights, number, rows, columns, size)
    monkeypatch.setattr(stencil, "loops", None)
    known = stencil.added_blocks(D, weights, number, rows, columns, size)
    np.testing.assert_allclose(found, known, atol=1e-13)
    assert np.abs(known).max() > 0.1


def test_blocks_of_no_points_are_none_whatever_the_degrees_of_both_bodies():
    k, shapes, none = 3, np.zeros((0, 6)), np.zeros((0, 3))
    D, nothing, number = np.zeros((0, 1 + k, 3, 1 + 2 * k, 3)), np.zeros(0), np.zeros(0, np.int64)
    for rows, columns, size in (
        ((0, shapes), (0, shapes), (0, 18, 18)),
        ((1, none), (0, shapes), (0, 9, 18)),
    ):
        found = stencil.added_blocks(D, nothing, number, rows, columns, size)
        assert found.shape == size
