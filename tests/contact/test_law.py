# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Tractions of contact at points: against NumPy and the complex step, and Coulomb's law."""

import numpy as np
import pytest
import rubbing

from mpm_dolfinx import contact
from mpm_dolfinx.contact import law as laws
from mpm_dolfinx.contact.slip_changes import SlipChanges

TOUCH = 1e-12


def shape(dim):
    if dim == 2:
        return contact.disc((0.0, 0.0), 0.7)
    return contact.box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5), 0.4)


def scene(dim, seed=4, count=400):
    """Return a shape and points in it, some of which have just come, with anchors around."""
    some = np.random.default_rng(seed)
    body = shape(dim)
    y = some.uniform(-0.8, 0.8, (4 * count, dim))
    phi, n = body.distance(y)
    y = (y - (phi + some.uniform(0.0, 0.02, len(y)))[:, None] * n)[:count]
    k = some.uniform(50.0, 150.0, count)
    points = laws.Points(
        k,
        k * some.uniform(0.5, 2.0, count),
        some.uniform(size=count) < 0.6,
        y + some.normal(0.0, 0.01, y.shape),
        some.uniform(0.0, 0.05, count),
        some.uniform(0.9, 1.1, count),
        np.zeros((count, 0)),
    )
    return body, points, y


def seen(body, points, y, behind=None, start=None):
    """Return where points are, which have started elsewhere in a step of a motion."""
    phi, n = body.distance(y)
    begun = None
    if start is not None:
        before = body.distance(start)[0]
        _, n = body.distance(0.5 * (start + y))
        begun = laws.Begun(before, np.minimum(0.5 * before, 0.0), y - start)
    return laws.Separation(phi, n, y - points.anchor, TOUCH, behind, begun)


def acting(law, body, points, y, behind=None, start=None, by=laws.traction):
    acts = laws.Traction(*by(law, points, seen(body, points, y, behind, start)))
    return acts, acts.normal + acts.shear


def derivative(law, body, points, y, behind=None, start=None):
    at = seen(body, points, y, behind, start)
    _, n = body.distance(y)
    H = body.curvature(y) if start is None else 0.5 * body.curvature(0.5 * (start + y))
    return laws.slopes(law, points, at, n, H)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(
    "law",
    [
        contact.Coulomb(),
        contact.Coulomb(0.4),
        contact.Coulomb(0.0, cohesion=0.3),
        contact.Coulomb(0.5, cohesion=0.1, limit=0.7),
    ],
)
@pytest.mark.parametrize("moves", [False, True])
def test_tractions_and_tangents_are_those_of_numpy_and_the_complex_step(moves, law, dim):
    body, points, y = scene(dim)
    start = y + 0.05 * np.random.default_rng(9).normal(size=y.shape) if moves else None
    D = derivative(law, body, points, y, None, start)
    acts, T = acting(law, body, points, y, None, start)
    known, exact = acting(law, body, points, y, None, start, rubbing.traction)
    assert law.smooth or 0.1 < acts.slips.mean() < 0.99
    assert (acts.slips == known.slips).all() and (acts.inside == known.inside).all()
    np.testing.assert_allclose(T, exact, atol=1e-14 * np.abs(exact).max())
    for i, e in enumerate(np.eye(dim)):
        tried = acting(law, body, points, y + 1e-30j * e, None, start, rubbing.traction)
        assert np.abs(D[:, :, i] - tried[1].imag / 1e-30).max() < 1e-12 * np.abs(D).max()


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("friction", [0.0, 0.4])
def test_nitsches_tangent_is_that_of_the_complex_step(friction, dim):
    law = contact.Coulomb(friction)
    body, points, y = scene(dim)
    phi, n = body.distance(y)
    y = y + np.random.default_rng(5).uniform(0.0, 0.03, len(y))[:, None] * n  # some have a gap
    phi, n = body.distance(y)
    behind = np.random.default_rng(6).normal(0.0, 2.0, y.shape)
    acts, _ = acting(law, body, points, y, behind)
    assert (acts.inside & (phi > TOUCH)).any() and (acts.inside & (phi < 0)).any()
    assert (~acts.inside).any() and (acts.pressure[phi < 0] == 0.0).any()
    D = derivative(law, body, points, y, behind)
    by_stress = laws.by_pressure(law, points, seen(body, points, y, behind))
    for i, e in enumerate(np.eye(dim)):
        moved, pushed = (
            acting(law, body, points, *at, by=rubbing.traction)[1].imag / 1e-30
            for at in ((y + 1e-30j * e, behind), (y, behind + 1e-30j * e))
        )
        assert np.abs(D[:, :, i] - moved).max() < 1e-12 * np.abs(D).max()
        assert np.abs(by_stress * n[:, i : i + 1] - pushed).max() < 1e-12 * np.abs(by_stress).max()


@pytest.mark.parametrize("dim", [2, 3])
def test_the_pressure_of_a_step_does_the_work_of_the_penetration(dim):
    body, points, y = scene(dim)
    start = y + 0.05 * np.random.default_rng(9).normal(size=y.shape)
    y = y + 0.05 * np.random.default_rng(5).normal(size=y.shape)
    acts, _ = acting(contact.Coulomb(), body, points, y, None, start)
    at = seen(body, points, y, None, start)
    k, offset = points.stiffness, at.begun.offset
    before, after = (0.5 * k * np.minimum(g - offset, 0.0) ** 2 for g in (at.begun.gap, at.gap))
    work = (acts.normal * at.begun.change).sum(axis=1)
    np.testing.assert_allclose(work, before - after, atol=1e-14 * before.max())
    assert (acts.pressure >= 0.0).all() and 50 < (acts.pressure > 0.0).sum() < len(y)
    still = acting(contact.Coulomb(), body, points, y, None, y)[0]
    rest = -k * np.minimum(0.5 * at.gap, 0.0)
    np.testing.assert_allclose(still.pressure, rest, atol=1e-14 * rest.max())


def test_shear_stays_within_coulombs_cone():
    law = contact.Coulomb(0.5, cohesion=0.1, limit=0.7)
    body, points, y = scene(2)
    acts, _ = acting(law, body, points, y)
    size = np.linalg.norm(acts.shear, axis=1)
    stretch = points.stretch
    bound = np.minimum(0.5 * acts.pressure + 0.1 * stretch, 0.7 * stretch)
    assert np.all(size <= bound * (1 + 1e-9))
    assert np.allclose(size[acts.slips], bound[acts.slips], rtol=1e-14)
    assert (bound == 0.7 * stretch).any() and (bound < 0.7 * stretch).any()


@pytest.mark.parametrize("dim", [2, 3])
def test_the_secant_takes_the_way_from_the_anchor_to_the_shear(dim):
    # On a plane, without pressure in the bound: S delta = t, where the tangent gives nothing.
    law, plane = contact.Coulomb(0.0, cohesion=0.3), contact.plane(np.zeros(dim), np.eye(dim)[-1])
    some = np.random.default_rng(1)
    _, points, y = scene(dim)
    points = points._replace(touched=np.ones(len(y), dtype=bool))
    y[:, -1] = -0.01 * some.uniform(size=len(y))
    at = seen(plane, points, y)
    delta, n = at.delta, at.normal
    acts = laws.traction(law, points, at)
    D = derivative(law, plane, points, y)
    S = D + laws.secant_along(at, acts.shear) * acts.slips[:, None, None]
    along = delta - n * (n * delta).sum(axis=1)[:, None]
    slips = acts.slips
    assert 50 < slips.sum() < len(y)
    tangent, secant = (np.einsum("nij,nj->ni", M, along)[slips] for M in (D, S))
    np.testing.assert_allclose(tangent, 0.0, atol=1e-12)
    np.testing.assert_allclose(secant, acts.shear[slips], atol=1e-12)


def test_points_that_change_their_slip_are_noted():
    changes, right, left = SlipChanges(), np.array([[1.0, 0.0]] * 3), np.array([[-1.0, 0.1]] * 3)
    slips = np.array([True, True, False])
    assert changes.note(slips, right).tolist() == [True, True, False]  # an attempt begins
    assert changes.note(slips, 2.0 * right).tolist() == [False, False, False]
    assert changes.note(~slips, right).tolist() == [False, False, True]
    assert changes.note(slips, right).tolist() == [True, True, False]
    assert changes.note(slips, left).tolist() == [True, True, False]
    changes.begin()
    assert changes.note(slips, left).tolist() == [True, True, False]


def test_nothing_acts_at_a_gap():
    body = contact.plane((0.0, 0.0), (0.0, 1.0))
    one = np.ones(2)
    points = laws.Points(one, one, one > 0, np.zeros((2, 2)), 0 * one, one, np.zeros((2, 0)))
    acts, T = acting(contact.Coulomb(0.5), body, points, np.array([[0.3, 1e-9], [0.3, -1e-9]]))
    assert acts.inside.tolist() == [False, True]
    assert np.all(T[0] == 0.0) and T[1, 1] == 1e-9


def test_a_point_that_touches_without_pressure_sticks():
    body = contact.plane((0.0, 0.0), (0.0, 1.0))
    one = np.ones(1)
    points = laws.Points(one, one, one > 0, np.zeros((1, 2)), 0 * one, one, np.zeros((1, 0)))
    D = derivative(contact.Coulomb(0.5), body, points, np.zeros((1, 2)))
    assert np.allclose(D[0], -np.eye(2))
