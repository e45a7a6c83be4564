# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What acts between points and facets: compiled loops against NumPy and the complex step."""

import inspect

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


def meeting(side, law, count=60, pressed=False):
    """Return points that stick, slip, have just come and are away, at bent facets.

    Those that are pressed have a stress behind them.
    """
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
        some.normal(size=(count, e + 1)) if pressed else None,
    )


@pytest.mark.parametrize("pressed", [False, True])
@pytest.mark.parametrize("friction", FRICTION)
@pytest.mark.parametrize("side", SIDES)
def test_compiled_loops_do_what_numpy_and_the_complex_step_do(side, friction, pressed):
    law = FRICTION[friction]
    points = meeting(side, law, pressed=pressed)
    told = stencil.acting_now(law, points, TOUCH, EXTENT)
    known = stencil.acting(law, points, points.x, TOUCH, EXTENT)
    assert 10 < known.acts.inside.sum() < 50 and (law.smooth or known.acts.slips.any())
    assert np.array_equal(told.acts.inside, known.acts.inside)
    assert np.array_equal(told.acts.slips, known.acts.slips)
    for found, value in zip(
        (*told[:2], *told.acts[:2]), (*known[:2], *known.acts[:2]), strict=True
    ):
        np.testing.assert_allclose(found, value, atol=1e-14)


def sums(points, groups=7, blocks=50):
    """Return blocks to add to, in which points of some groups meet, and meet themselves."""
    some = np.random.default_rng(2)
    (n, count, dim), k, own = points.x.shape, points.anchored.shape[1], 6
    return stencil.Sums(
        some.uniform(size=n),
        some.normal(size=(n, own)),
        some.integers(0, groups, n),
        some.integers(0, blocks, (groups, own + k, own + count - 1)).astype(np.int32),
        np.zeros((blocks, dim, dim)),
    )


def add_by_numpy(D, where):
    """Add derivatives at points to blocks, spread over the nodes of their own facets."""
    N = where.shapes[:, :, None, None, None]
    rows = np.concatenate([N * D[:, :1], D[:, 1:]], axis=1)
    rows *= where.weights[:, None, None, None, None]
    own = rows[:, :, :, :1] * where.shapes[:, None, None, :, None]
    whole = np.concatenate([own, rows[:, :, :, 1:]], axis=3)
    np.add.at(where.values, where.positions[where.group], whole.swapaxes(2, 3))


@pytest.mark.parametrize("pressed", [False, True])
@pytest.mark.parametrize("friction", FRICTION)
@pytest.mark.parametrize("side", SIDES)
def test_compiled_tangents_are_the_complex_steps_summed_up(side, friction, pressed):
    law = FRICTION[friction]
    points = meeting(side, law, pressed=pressed)
    found, known = sums(points), sums(points)
    stencil.add_tangents(law, points, TOUCH, EXTENT, found)
    D = stencil.by_complex_step(law, points, TOUCH, EXTENT)
    add_by_numpy(D, known)
    scale = np.abs(known.values).max()
    assert scale > 1.0
    np.testing.assert_allclose(found.values, known.values, atol=1e-14 * scale)
    again = sums(points)
    loops.add_derivatives(D, *again[:4], again.values)
    np.testing.assert_allclose(again.values, known.values, atol=1e-14 * scale)


@pytest.mark.parametrize("friction", FRICTION)
@pytest.mark.parametrize("side", SIDES)
def test_forces_grow_with_the_stress_behind_as_a_complex_step_says(side, friction):
    law = FRICTION[friction]
    points = meeting(side, law, pressed=True)
    normals, forces = stencil.by_stress(law, points, TOUCH)
    assert 10 < forces.any(axis=(1, 2)).sum() < 50
    for i in range(normals.shape[1]):
        tried = points._replace(
            behind=points.behind + 1j * stencil.STEP * np.eye(len(normals[0]))[i]
        )
        pushes, rubs, _ = stencil.acting(law, tried, points.x, TOUCH, EXTENT)
        slopes = (pushes + rubs).imag / stencil.STEP
        np.testing.assert_allclose(forces * normals[:, i, None, None], slopes, atol=1e-12)


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


def test_no_points_add_nothing():
    law = FRICTION["rough"]
    points = meeting("triangle", law, count=0)
    where = sums(points)
    stencil.add_tangents(law, points, TOUCH, EXTENT, where)
    assert not where.values.any()


def test_blocks_that_are_not_there_are_refused():
    law = FRICTION["rough"]
    points = meeting("quadrilateral", law)
    where = sums(points)
    for wrong in (
        where._replace(values=where.values[:-1]),
        where._replace(group=where.group + 1),
        where._replace(positions=where.positions[:, :-1]),
    ):
        with pytest.raises(ValueError, match="shapes do not go together"):
            stencil.add_tangents(law, points, TOUCH, EXTENT, wrong)


def test_an_heir_that_overrides_anything_has_no_compiled_loops(monkeypatch):
    monkeypatch.setattr(stencil, "loops", object())  # any use of which is an error
    points = meeting("line", Coulomb(0.3))
    new = type("New", (Coulomb,), {"colour": "red"})
    for law in (Coulomb(0.3), new(0.3)):
        with pytest.raises(AttributeError, match="act"):
            stencil.acting_now(law, points, TOUCH, EXTENT)
    names = [name for name in vars(Coulomb) if not name.startswith("__") and name != "_loop"]
    assert {"bound", "smooth", "friction", "limit"} <= set(names)
    for name in names:
        heir = type("Heir", (Coulomb,), {name: inspect.getattr_static(Coulomb, name)})
        stencil.acting_now(heir(0.3), points, TOUCH, EXTENT)
