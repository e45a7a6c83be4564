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


def seen(body, points, y, behind=None):
    phi, n = body.distance(y)
    return laws.Separation(phi, n, y - points.anchor, TOUCH, behind)


def acting(law, body, points, y, behind=None, by=laws.traction):
    at = seen(body, points, y, behind)
    acts = laws.Traction(*by(law, points, at))
    return acts, acts.pressure[:, None] * at.normal + acts.shear


def derivative(law, body, points, y, behind=None):
    """Return the derivative of ``p n + t`` by positions."""
    at, H = seen(body, points, y, behind), body.curvature(y)
    dp, dt = laws.slopes(law, points, at).by_position(at.normal, H)
    p = laws.traction(law, points, at).pressure
    return at.normal[:, :, None] * dp[:, None, :] + p[:, None, None] * H + dt


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
def test_tractions_and_tangents_are_those_of_numpy_and_the_complex_step(law, dim):
    body, points, y = scene(dim)
    D = derivative(law, body, points, y)
    acts, T = acting(law, body, points, y)
    known, exact = acting(law, body, points, y, by=rubbing.traction)
    assert law.smooth or 0.1 < acts.slips.mean() < 0.99
    assert (acts.slips == known.slips).all() and (acts.inside == known.inside).all()
    np.testing.assert_allclose(T, exact, atol=1e-14 * np.abs(exact).max())
    for i, e in enumerate(np.eye(dim)):
        for by in (rubbing.traction, laws.traction):
            exact = acting(law, body, points, y + 1e-30j * e, by=by)[1].imag / 1e-30
            assert np.abs(D[:, :, i] - exact).max() < 1e-12 * np.abs(D).max()


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
    by_stress = laws.slopes(law, points, seen(body, points, y, behind)).by_pressure(n)
    for i, e in enumerate(np.eye(dim)):
        exact = acting(law, body, points, y + 1e-30j * e, behind, rubbing.traction)[1].imag / 1e-30
        assert np.abs(D[:, :, i] - exact).max() < 1e-12 * np.abs(D).max()
        exact = acting(law, body, points, y, behind + 1e-30j * e, rubbing.traction)[1].imag / 1e-30
        assert np.abs(by_stress * n[:, i : i + 1] - exact).max() < 1e-12 * np.abs(by_stress).max()


@pytest.mark.parametrize("dim", [2, 3])
def test_a_pressure_that_is_given_counts_as_it_is(dim):
    law = contact.Coulomb(0.5, cohesion=0.1, limit=0.7)
    body, points, y = scene(dim)
    at = seen(body, points, y)._replace(pressure=np.random.default_rng(7).uniform(0, 2, len(y)))
    found, known = laws.traction(law, points, at), rubbing.traction(law, points, at)
    for mine, other in zip(found, known, strict=True):
        np.testing.assert_allclose(mine, other, atol=1e-14)
    D = laws.slopes(law, points, at)
    tried = at._replace(**{name: getattr(at, name) + 0j for name in ("gap", "normal", "delta")})
    tried = tried._replace(pressure=at.pressure + 1e-30j)
    for by in (rubbing.traction, laws.traction):
        exact = by(law, points, tried)[1].imag / 1e-30
        np.testing.assert_allclose(D.shear[:, :, 0], exact, atol=1e-13)
    assert (D.pressure[:, 0] == 1.0).all() and not D.pressure[:, 1:].any()


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
