# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Signed distances of rigid shapes, their gradients and curvatures."""

import numpy as np
import pytest

import mpm_dolfinx as mpm
from mpm_dolfinx import contact

SQUARE = [(-1.0, -0.5), (1.0, -0.5), (1.0, 0.5), (-1.0, 0.5)]
ANGLE = [(0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (1.0, 2.0), (1.0, 1.0), (0.0, 1.0)]


def shapes(dim):
    if dim == 2:
        return {
            "plane": contact.plane((0.1, 0.2), (1.0, 2.0)),
            "disc": contact.disc((0.1, 0.2), 0.7),
            "cavity": contact.cavity(contact.disc((0.1, 0.2), 0.7)),
            "box": contact.box((-1.0, -0.5), (1.0, 0.5), 0.1),
            "sharp box": contact.box((-1.0, -0.5), (1.0, 0.5)),
            "polygon": contact.polygon(ANGLE, 0.1),
            "sharp polygon": contact.polygon(ANGLE[::-1]),
        }
    return {
        "plane": contact.plane((0.1, 0.2, 0.0), (1.0, 2.0, -1.0)),
        "sphere": contact.sphere((0.1, 0.2, 0.0), 0.7),
        "cylinder": contact.cylinder((0.1, 0.2, 0.0), (1.0, 1.0, 0.5), 0.7),
        "box": contact.box((-1.0, -0.5, -0.4), (1.0, 0.5, 0.8), 0.1),
    }


CASES = [(dim, name) for dim in (2, 3) for name in shapes(dim)]


@pytest.mark.parametrize(("dim", "name"), CASES)
def test_gradient_and_curvature_are_the_derivatives_of_the_distance(dim, name):
    shape = shapes(dim)[name]
    y = np.random.default_rng(3).uniform(-1.5, 2.5, (500, dim))
    phi, n = shape.distance(y)
    H = shape.curvature(y)
    step = 1e-30
    for i, e in enumerate(np.eye(dim)):
        ahead = shape.distance(y + 1j * step * e)
        assert np.abs(ahead[0].imag / step - n[:, i]).max() < 1e-12
        bent = ahead[1].imag / step
        # (a sharp corner bends without bound where points are near to it)
        assert np.all(np.abs(bent - H[:, :, i]).max(axis=1) < 1e-12 * (1 + np.abs(H).max((1, 2))))
    assert np.abs(np.linalg.norm(n, axis=1) - 1.0).max() < 1e-12
    # the foot of each point is on the surface, unless another part of that is nearer
    foot, _ = shape.distance(y - phi[:, None] * n)
    out = phi > 0.0
    assert np.abs(foot[out]).max() < 1e-12


def test_a_box_is_a_polygon():
    box, polygon = contact.box((-1.0, -0.5), (1.0, 0.5), 0.1), contact.polygon(SQUARE, 0.1)
    y = np.random.default_rng(1).uniform(-1.5, 1.5, (500, 2))
    near = box.distance(y)[0] > -0.2
    for one, other in zip(box.distance(y[near]), polygon.distance(y[near]), strict=True):
        assert np.abs(one - other).max() < 1e-14
    assert np.abs(box.curvature(y[near]) - polygon.curvature(y[near])).max() < 1e-12


def test_rounding_leaves_faces_where_they_are():
    for radius in (0.0, 0.1, 0.3):
        shape = contact.polygon(SQUARE, radius)
        phi, _ = shape.distance(np.array([[0.0, 0.7], [1.25, 0.0], [0.0, -0.5], [0.0, 0.4]]))
        assert np.allclose(phi, [0.2, 0.25, 0.0, -0.1], atol=1e-14)


def test_a_distance_of_the_users_own():
    own = contact.signed_distance(lambda y: np.hypot(y[:, 0] - 0.1, y[:, 1]) - 0.7, (0.1, 0.0))
    disc = contact.disc((0.1, 0.0), 0.7)
    y = np.random.default_rng(2).uniform(-1.0, 1.0, (100, 2))
    y = y[np.linalg.norm(y - [0.1, 0.0], axis=1) > 0.3]
    for one, other, bound in zip(own.distance(y), disc.distance(y), (1e-14, 1e-9), strict=True):
        assert np.abs(one - other).max() < bound
    assert np.abs(own.curvature(y) - disc.curvature(y)).max() < 1e-5


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: contact.plane((0, 0), (0, 0)), "must not be zero"),
        (lambda: contact.plane((0, 0), (0, 1, 0)), "2 finite numbers"),
        (lambda: contact.plane((0,), (1,)), "2 or 3 finite numbers"),
        (lambda: contact.disc((0, 0), -1.0), "radius must be a positive number"),
        (lambda: contact.sphere((0, 0), 1.0), "3 finite numbers"),
        (lambda: contact.box((0, 0), (1, 0)), "lower below upper"),
        (lambda: contact.box((0, 0), (1, 1), 0.5), "half of its smallest side"),
        (lambda: contact.polygon([(0, 0), (1, 0)]), "three corners"),
        (lambda: contact.polygon([(0, 0), (1, 1), (2, 2)]), "polygon encloses nothing"),
        (lambda: contact.polygon(SQUARE, 0.6), "too small for the radius"),
        (lambda: contact.cavity(1.0), "needs a shape"),
        (lambda: contact.signed_distance(1.0, (0, 0)), "function of points"),
        (lambda: contact.Coulomb(-0.1), "friction must be a number from 0"),
        (lambda: contact.Coulomb(0.1, cohesion=np.inf), "cohesion must be"),
    ],
)
def test_what_makes_no_sense_is_refused(make, sentence):
    with pytest.raises(mpm.MPMError, match=sentence):
        make()


def test_what_is_no_distance_is_refused():
    y = np.array([[0.5, 0.001], [0.0, 1.0]])
    twice = contact.signed_distance(lambda y: 2 * y[:, 1], (0.0, 0.0))
    with pytest.raises(mpm.MPMError, match="length 2 near the surface"):
        twice.distance(y)
    broken = contact.signed_distance(lambda y: y, (0.0, 0.0))
    with pytest.raises(mpm.MPMError, match="2 finite numbers"):
        broken.distance(y)
    wrong = contact.signed_distance(lambda y: y[:, 7], (0.0, 0.0))
    with pytest.raises(mpm.MPMError, match="signed distance of a shape failed with IndexError"):
        wrong.distance(y)
