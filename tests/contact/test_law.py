# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Tractions of contact at points: tangents against the complex step, and Coulomb's law."""

import numpy as np
import pytest

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
    )
    return body, points, y


def acting(law, body, points, y):
    phi, n = body.distance(y)
    acts = laws.traction(law, points, y - points.anchor, phi, n, TOUCH)
    return acts, acts.pressure[:, None] * n + acts.shear


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
def test_tangent_is_that_of_the_complex_step(law, dim):
    body, points, y = scene(dim)
    phi, n = body.distance(y)
    D = laws.derivative(law, points, y - points.anchor, phi, n, body.curvature(y), TOUCH)
    acts, _ = acting(law, body, points, y)
    if not law.smooth:
        assert 0.1 < acts.slips.mean() < 0.99
    for i, e in enumerate(np.eye(dim)):
        exact = acting(law, body, points, y + 1e-30j * e)[1].imag / 1e-30
        assert np.abs(D[:, :, i] - exact).max() < 1e-12 * np.abs(D).max()


def pushed(law, body, points, y, behind):
    phi, n = body.distance(y)
    push = laws.nitsche(points, behind, phi, n, TOUCH)
    acts = laws.traction(law, points, y - points.anchor, phi, n, TOUCH, push.pressure)
    return acts, acts.pressure[:, None] * n + acts.shear


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("friction", [0.0, 0.4])
def test_nitsches_tangent_is_that_of_the_complex_step(friction, dim):
    law = contact.Coulomb(friction)
    body, points, y = scene(dim)
    phi, n = body.distance(y)
    y = y + np.random.default_rng(5).uniform(0.0, 0.03, len(y))[:, None] * n  # some have a gap
    phi, n = body.distance(y)
    behind = np.random.default_rng(6).normal(0.0, 2.0, y.shape)
    acts, _ = pushed(law, body, points, y, behind)
    assert (acts.inside & (phi > TOUCH)).any() and (acts.inside & (phi < 0)).any()
    assert (~acts.inside).any() and (acts.pressure[phi < 0] == 0.0).any()
    push = laws.nitsche(points, behind, phi, n, TOUCH, body.curvature(y))
    some = acts.inside
    given = law, points.of(some), (y - points.anchor)[some], phi[some], n[some]
    D = laws.derivative(*given, body.curvature(y[some]), TOUCH, push.of(some))
    by_stress = laws.push_derivative(*given, TOUCH, push.of(some))
    for i, e in enumerate(np.eye(dim)):
        exact = pushed(law, body, points, y + 1e-30j * e, behind)[1].imag[some] / 1e-30
        assert np.abs(D[:, :, i] - exact).max() < 1e-12 * np.abs(D).max()
        exact = pushed(law, body, points, y, behind + 1e-30j * e)[1].imag[some] / 1e-30
        found = by_stress * n[some, i : i + 1]
        assert np.abs(found - exact).max() < 1e-12 * np.abs(by_stress).max()


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
    phi, n = plane.distance(y)
    delta, H = y - points.anchor, np.zeros((len(y), dim, dim))
    acts = laws.traction(law, points, delta, phi, n, TOUCH)
    D = laws.derivative(law, points, delta, phi, n, H, TOUCH)
    S = D + laws.secant_along(points, delta, phi, n, TOUCH, acts)
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
    points = laws.Points(one, one, one > 0, np.zeros((2, 2)), 0 * one, one)
    acts, T = acting(contact.Coulomb(0.5), body, points, np.array([[0.3, 1e-9], [0.3, -1e-9]]))
    assert acts.inside.tolist() == [False, True]
    assert np.all(T[0] == 0.0) and T[1, 1] == 1e-9


def test_a_point_that_touches_without_pressure_sticks():
    body = contact.plane((0.0, 0.0), (0.0, 1.0))
    one = np.ones(1)
    points = laws.Points(one, one, one > 0, np.zeros((1, 2)), 0 * one, one)
    y, H = np.zeros((1, 2)), np.zeros((1, 2, 2))
    phi, n = body.distance(y)
    D = laws.derivative(contact.Coulomb(0.5), points, y, phi, n, H, TOUCH)
    assert np.allclose(D[0], -np.eye(2))
