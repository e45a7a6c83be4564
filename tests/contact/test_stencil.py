# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What acts between points and facets: compiled loops against NumPy and the complex step."""

import numpy as np
import pytest
import rubbing

import basix

from mpm_dolfinx._core import loops
from mpm_dolfinx.contact import stencil
from mpm_dolfinx.contact.facets import solved
from mpm_dolfinx.contact.law import Coulomb, Friction, Points, Separation

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
        np.zeros((count, 0)),
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


def by_numpy(law, points, z, behind=None):
    """Return forces on points and nodes, ``(n, 1 + k, i)``, at real or complex positions."""
    k = points.anchored.shape[1]
    x, X = z[:, 0], z[:, 1 : 1 + k]
    foot = stencil.projected(points.table, x, X, points.outward)
    delta = np.zeros_like(x)
    if not law.smooth:
        delta = x - np.einsum("nk,nki->ni", points.anchored, z[:, 1 + k :])
    behind = points.behind if behind is None else behind
    at = Separation(foot.gap, foot.n, delta, TOUCH, behind)
    acts = rubbing.traction(law, points.points, at)
    shear, A = acts[1], foot.along
    # the arm from the facet to the point turns with the facet
    along = solved(A @ A.swapaxes(1, 2), np.einsum("nei,ni->ne", A, shear))
    turn = foot.gap[:, None] * np.einsum("nek,ne->nk", foot.dN, along)
    force = acts[0][:, None] * foot.n + shear
    on_nodes = turn[:, :, None] * foot.n[:, None] - foot.N[:, :, None] * force[:, None]
    return np.concatenate([force[:, None], on_nodes], axis=1), acts


def by_complex_step(law, points):
    """Return the derivatives of forces by positions, ``(n, 1 + k, i, z, j)``."""
    count, dim = points.x.shape[1:]
    D = np.zeros((len(points.x), 1 + points.anchored.shape[1], dim, count, dim))
    for node in range(count):
        for j in range(dim):
            z = points.x.astype(complex)
            z[:, node, j] += 1j * stencil.STEP
            D[:, :, :, node, j] = by_numpy(law, points, z)[0].imag / stencil.STEP
    return D


@pytest.mark.parametrize("pressed", [False, True])
@pytest.mark.parametrize("friction", FRICTION)
@pytest.mark.parametrize("side", SIDES)
def test_compiled_loops_do_what_numpy_does(side, friction, pressed):
    law = FRICTION[friction]
    points = meeting(side, law, pressed=pressed)
    pushes, rubs, told = stencil.acting(law, points, TOUCH, EXTENT)
    force, known = by_numpy(law, points, points.x)
    assert 10 < known[2].sum() < 50 and (law.smooth or known[3].any())
    np.testing.assert_allclose(pushes + rubs, force, atol=1e-14)
    for found, value in zip(told, known, strict=True):
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
    D = by_complex_step(law, points)
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
        behind = points.behind + 1j * stencil.STEP * np.eye(len(normals[0]))[i]
        slopes = by_numpy(law, points, points.x, behind)[0].imag / stencil.STEP
        np.testing.assert_allclose(forces * normals[:, i, None, None], slopes, atol=1e-12)


@pytest.mark.parametrize("side", SIDES)
def test_directions_of_complex_steps_are_the_same_one_by_one(monkeypatch, side):
    law = FRICTION["rough"]
    points = meeting(side, law)
    shape = np.array(points.x[:, : 1 + points.anchored.shape[1]])
    before = shape + 0.01 * np.random.default_rng(3).normal(size=shape.shape)
    gap, offset = points.points.gap, np.minimum(0.1 * points.points.gap, 0.0)
    whole = points._replace(start=stencil.Start(before, points.table, gap, offset))
    found = stencil.by_complex_step(law, whole, TOUCH, EXTENT)
    monkeypatch.setattr(stencil, "AT_ONCE", 1)
    known = stencil.by_complex_step(law, whole, TOUCH, EXTENT)
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


class Own(Friction):
    """Coulomb's law as a user writes it."""

    def __init__(self, law):
        self.law = law

    def bound(self, at):
        return np.minimum(
            self.law.friction * at.pressure + self.law.cohesion * at.stretch,
            self.law.limit * at.stretch,
        )


@pytest.mark.parametrize("pressed", [False, True])
@pytest.mark.parametrize("friction", ["rough", "limited"])
@pytest.mark.parametrize("side", SIDES)
def test_a_law_of_a_user_does_what_the_compiled_one_does(side, friction, pressed):
    law = FRICTION[friction]
    points = meeting(side, law, pressed=pressed)
    found, known = sums(points), sums(points)
    for one, where in ((law, known), (Own(law), found)):
        stencil.add_tangents(one, points, TOUCH, EXTENT, where)
    tol = 1e-9 * np.abs(known.values).max()
    np.testing.assert_allclose(found.values, known.values, atol=tol)
    for one, other in zip(
        stencil.acting(Own(law), points, TOUCH, EXTENT)[:2],
        stencil.acting(law, points, TOUCH, EXTENT)[:2],
        strict=True,
    ):
        np.testing.assert_allclose(one, other, atol=1e-14)


def test_a_subclass_that_changes_the_bound_is_asked():
    class Half(Coulomb):
        def bound(self, at):
            return 0.5 * super().bound(at)

    points = meeting("line", Coulomb(0.3))
    forces = [stencil.acting(law, points, TOUCH, EXTENT)[1] for law in (Half(0.6), Coulomb(0.3))]
    assert forces[0].any()
    np.testing.assert_allclose(*forces, atol=1e-14)
    assert type("New", (Coulomb,), {"colour": "red"})(0.3).compiled and not Half(0.3).compiled
