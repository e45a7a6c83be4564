# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What acts between points and facets: compiled loops against NumPy and the complex step."""

import numpy as np
import pytest
import rubbing

import basix

from mpm_dolfinx.contact import law as laws
from mpm_dolfinx.contact import stencil
from mpm_dolfinx.contact.law import Coulomb, Friction, Points, Separation
from mpm_dolfinx.contact.pair_matrices import Places

TOUCH = 1e-12
STATES = ("at rest", "pressed", "moving")
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


def meeting(side, law, state="at rest", count=60):
    """Return points that stick, slip, have just come and are away, at bent facets.

    Those that are pressed have a stress behind them, and those in motion a step.
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
    outward = some.choice([-1.0, 1.0], count)
    behind = some.normal(size=(count, e + 1)) if state == "pressed" else None
    start = None
    if state == "moving":  # some come to touch and some lift off, or begin to be pressed deeper
        there = X + 0.05 * some.normal(size=X.shape)
        foot = np.einsum("nk,nki->ni", table(place)[0], there)
        n = rubbing.projected(table(place), foot, there, outward)[3]
        foot = foot + 0.05 * some.normal(size=(count, 1)) * n
        middle, end = (np.concatenate([a[:, None], b], 1) for a, b in ((foot, there), (x, X)))
        offset = np.minimum(0.02 * some.normal(size=count), 0.0)
        gap = some.uniform(-0.1, 0.1, count)
        start = stencil.Start(2.0 * middle - end, table(place), gap, offset)
    return stencil.Stencil(
        np.arange(count),
        place,
        table(place),
        table(anchored)[0],
        np.concatenate(parts, axis=1),
        points,
        outward,
        start,
        behind,
    )


def by_numpy(law, points, z, behind=None):
    """Return forces on points and nodes, ``(n, 1 + k, i)``, at real or complex positions."""
    k, start = points.anchored.shape[1], points.start
    both = z[:, : 1 + k]
    N, dN, A, n, gap = rubbing.projected(points.table, both[:, 0], both[:, 1:], points.outward)
    arm, begun = gap, None
    delta = np.zeros_like(both[:, 0])
    if not law.smooth:
        delta = both[:, 0] - np.einsum("nk,nki->ni", points.anchored, z[:, 1 + k :])
    if start is not None:
        middle = 0.5 * (start.x + both)
        foot = rubbing.projected(start.table, middle[:, 0], middle[:, 1:], points.outward)
        N, dN, A, n, arm = foot
        begun = laws.Begun(start.gap, start.offset, np.zeros_like(n))
    behind = points.behind if behind is None else behind
    at = Separation(gap, n, delta, TOUCH, behind, begun)
    p, _, shear, inside, slips = rubbing.traction(law, points.points, at)
    gradient = np.concatenate([n[:, None], -N[:, :, None] * n[:, None]], axis=1)
    if start is not None:
        change = both - start.x
        v = rubbing.deformation(middle, change)
        gradient = rubbing.corrected(gradient, change, v, gap - start.gap, TOUCH)
    # the arm from the facet to the point turns with the facet
    along = rubbing.solved(A @ A.swapaxes(1, 2), np.einsum("nei,ni->ne", A, shear))
    turn = arm[:, None] * np.einsum("nek,ne->nk", dN, along)
    rubs = turn[:, :, None] * n[:, None] - N[:, :, None] * shear[:, None, :]
    pushes = p[:, None, None] * gradient
    return pushes, np.concatenate([shear[:, None], rubs], axis=1), (p, inside, slips)


def by_complex_step(law, points):
    """Return the derivatives of forces by positions, ``(n, 1 + k, i, z, j)``."""
    count, dim = points.x.shape[1:]
    D = np.zeros((len(points.x), 1 + points.anchored.shape[1], dim, count, dim))
    for node in range(count):
        for j in range(dim):
            z = points.x.astype(complex)
            z[:, node, j] += 1j * rubbing.STEP
            pushes, rubs, _ = by_numpy(law, points, z)
            D[:, :, :, node, j] = (pushes + rubs).imag / rubbing.STEP
    return D


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("friction", FRICTION)
@pytest.mark.parametrize("side", SIDES)
def test_compiled_loops_do_what_numpy_does(side, friction, state):
    law = FRICTION[friction]
    points = meeting(side, law, state)
    pushes, rubs, told = stencil.acting(law, points, TOUCH)
    *forces, known = by_numpy(law, points, points.x)
    assert 10 < known[1].sum() < 55 and (law.smooth or known[2].any())
    for found, value in zip((pushes, rubs), forces, strict=True):
        np.testing.assert_allclose(found, value, atol=1e-13)
    for found, value in zip((told.pressure, told.inside, told.slips), known, strict=True):
        np.testing.assert_allclose(found, value, atol=1e-14)


@pytest.mark.parametrize("side", SIDES)
def test_forces_of_a_step_take_the_energy_of_penetration_and_no_momentum(side):
    law = FRICTION["smooth"]
    points = meeting(side, law, "moving")
    pushes, _, told = stencil.acting(law, points, TOUCH)
    start = points.start
    change, middle = points.x - start.x, 0.5 * (points.x + start.x)
    gap = rubbing.projected(points.table, points.x[:, 0], points.x[:, 1:], points.outward)[-1]
    k = points.points.stiffness
    energy = [0.5 * k * np.minimum(g - start.offset, 0.0) ** 2 for g in (start.gap, gap)]
    work = (pushes * change).sum(axis=(1, 2))
    np.testing.assert_allclose(work, energy[0] - energy[1], atol=1e-14)
    assert (told.pressure >= 0.0).all() and 20 < (told.pressure > 0.0).sum() < 60
    size = np.abs(pushes).max()
    assert np.abs(pushes.sum(axis=1)).max() < 1e-13 * size
    turn = middle[..., 0] * pushes[..., 1] - middle[..., 1] * pushes[..., 0]
    assert np.abs(turn.sum(axis=1)).max() < 1e-12 * size


def sums(points, groups=7, blocks=50):
    """Return blocks to add to, in which points of some groups meet, and meet themselves."""
    some = np.random.default_rng(2)
    (n, count, dim), k, own = points.x.shape, points.anchored.shape[1], 6
    return (
        some.uniform(size=n),
        some.normal(size=(n, own)),
        Places(
            some.integers(0, groups, n),
            some.integers(0, blocks, (groups, own + k, own + count - 1)).astype(np.int32),
            np.zeros((blocks, dim, dim)),
        ),
    )


def add_by_numpy(D, weights, shapes, where):
    """Add derivatives at points to blocks, spread over the nodes of their own facets."""
    N = shapes[:, :, None, None, None]
    rows = np.concatenate([N * D[:, :1], D[:, 1:]], axis=1)
    rows *= weights[:, None, None, None, None]
    own = rows[:, :, :, :1] * shapes[:, None, None, :, None]
    whole = np.concatenate([own, rows[:, :, :, 1:]], axis=3)
    np.add.at(where.values, where.positions[where.group], whole.swapaxes(2, 3))


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("friction", FRICTION)
@pytest.mark.parametrize("side", SIDES)
def test_compiled_tangents_are_the_complex_steps_summed_up(side, friction, state):
    law = FRICTION[friction]
    points = meeting(side, law, state)
    found, known = sums(points), sums(points)
    stencil.add_tangents(law, points, TOUCH, *found)
    add_by_numpy(by_complex_step(law, points), *known)
    found, known = found[-1].values, known[-1].values
    scale = np.abs(known).max()
    assert scale > 1.0
    np.testing.assert_allclose(found, known, atol=1e-14 * scale)


@pytest.mark.parametrize("friction", FRICTION)
@pytest.mark.parametrize("side", SIDES)
def test_forces_grow_with_the_stress_behind_as_a_complex_step_says(side, friction):
    law = FRICTION[friction]
    points = meeting(side, law, "pressed")
    normals, forces = stencil.by_stress(law, points, TOUCH)
    assert 10 < forces.any(axis=(1, 2)).sum() < 50
    for i in range(normals.shape[1]):
        behind = points.behind + 1j * rubbing.STEP * np.eye(len(normals[0]))[i]
        pushes, rubs, _ = by_numpy(law, points, points.x, behind)
        slopes = (pushes + rubs).imag / rubbing.STEP
        np.testing.assert_allclose(forces * normals[:, i, None, None], slopes, atol=1e-12)


def test_no_points_add_nothing():
    law = FRICTION["rough"]
    points = meeting("triangle", law, count=0)
    where = sums(points)
    stencil.add_tangents(law, points, TOUCH, *where)
    assert not where[-1].values.any()


def test_blocks_that_are_not_there_are_refused():
    law = FRICTION["rough"]
    points = meeting("quadrilateral", law)
    *spread, where = sums(points)
    for wrong in (
        where._replace(values=where.values[:-1]),
        where._replace(group=where.group + 1),
        where._replace(positions=where.positions[:, :-1]),
    ):
        with pytest.raises(ValueError, match="shapes do not go together"):
            stencil.add_tangents(law, points, TOUCH, *spread, wrong)


class Own(Friction):
    """Coulomb's law as a user writes it."""

    def __init__(self, law):
        self.law = law

    def bound(self, at):
        return np.minimum(
            self.law.friction * at.pressure + self.law.cohesion * at.stretch,
            self.law.limit * at.stretch,
        )


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("friction", ["rough", "limited"])
@pytest.mark.parametrize("side", SIDES)
def test_a_law_of_a_user_does_what_the_compiled_one_does(side, friction, state):
    law = FRICTION[friction]
    points = meeting(side, law, state)
    found, known = sums(points), sums(points)
    for one, where in ((law, known), (Own(law), found)):
        stencil.add_tangents(one, points, TOUCH, *where)
    found, known = found[-1].values, known[-1].values
    np.testing.assert_allclose(found, known, atol=1e-9 * np.abs(known).max())
    for one, other in zip(
        stencil.acting(Own(law), points, TOUCH)[:2],
        stencil.acting(law, points, TOUCH)[:2],
        strict=True,
    ):
        np.testing.assert_allclose(one, other, atol=1e-14)


def test_a_subclass_that_changes_the_bound_is_asked():
    class Half(Coulomb):
        def bound(self, at):
            return 0.5 * super().bound(at)

    points = meeting("line", Coulomb(0.3))
    forces = [stencil.acting(law, points, TOUCH)[1] for law in (Half(0.6), Coulomb(0.3))]
    assert forces[0].any()
    np.testing.assert_allclose(*forces, atol=1e-14)
    assert type("New", (Coulomb,), {"colour": "red"})(0.3).compiled and not Half(0.3).compiled
