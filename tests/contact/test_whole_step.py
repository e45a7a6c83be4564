# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Forces of a whole step: the work they do, their derivative, what they leave as it was."""

import numpy as np
import pytest

from mpm_dolfinx.contact import whole_step

TOUCH = 1e-12


def gaps(count=200, seed=3):
    some = np.random.default_rng(seed)
    k = some.uniform(1.0, 5.0, count)
    return k, some.uniform(-0.1, 0.1, count), some.uniform(-0.1, 0.1, count)


def test_pressure_over_a_step_does_the_work_of_the_penetration():
    k, before, gap = gaps()
    p = whole_step.mean_pressure(k, before, gap, TOUCH)
    energy = [0.5 * k * np.minimum(g, 0.0) ** 2 for g in (before, gap)]
    np.testing.assert_allclose(-p * (gap - before), energy[1] - energy[0], atol=1e-16)
    assert np.all(p >= 0.0) and np.all((p > 0.0) == (np.minimum(before, gap) < 0.0))
    rest = whole_step.mean_pressure(k, before, before, TOUCH)
    np.testing.assert_allclose(rest, -k * np.minimum(before, 0.0), rtol=1e-15)


def test_its_slope_is_that_of_the_complex_step():
    k, before, gap = gaps()
    exact = whole_step.mean_pressure(k, before, gap + 1e-30j, TOUCH).imag / 1e-30
    slope = whole_step.pressure_slope(k, before, gap, TOUCH)
    np.testing.assert_allclose(slope, exact, rtol=1e-12, atol=1e-14)
    assert np.all(slope <= 0.0)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_corrected_gradient_has_no_sum_no_moment_and_the_difference_asked_for(dim):
    some = np.random.default_rng(8)
    middle = some.normal(size=(50, dim + 1, dim))
    change = 0.1 * some.normal(size=middle.shape)
    difference = some.normal(size=50)
    v = whole_step.deformation(middle, change)
    none = np.zeros_like(v)
    gradient, _ = whole_step.corrected(none, change, v, difference, 1.0)
    np.testing.assert_allclose((gradient * change).sum(axis=(1, 2)), difference, rtol=1e-10)
    size = np.abs(gradient).max()
    assert np.abs(gradient.sum(axis=1)).max() < 1e-13 * size
    turn = middle[..., 0] * gradient[..., 1] - middle[..., 1] * gradient[..., 0]
    assert np.abs(turn.sum(axis=1)).max() < 1e-13 * size
    # a rigid motion has nothing to correct
    W = some.normal(size=(dim, dim))
    rigid = middle @ (W - W.T) + some.normal(size=dim)
    assert np.abs(whole_step.deformation(middle, rigid)).max() < 1e-12
    same, factor = whole_step.corrected(middle, rigid, none, difference, 1.0)
    assert np.array_equal(same, middle) and not factor.any()


@pytest.mark.parametrize("dim", [2, 3])
def test_the_slope_of_a_corrected_gradient_is_that_of_the_complex_step(dim):
    # The gap of a sphere over a step, corrected along the step, as for what is rigid.
    some = np.random.default_rng(5)
    start = some.uniform(0.5, 1.0, size=(30, dim))
    change = 0.2 * some.normal(size=start.shape)

    def corrected(dz):
        before, middle, end = (np.sqrt((x * x).sum(axis=1)) for x in places(dz))
        n = places(dz)[1] / middle[:, None]
        return whole_step.corrected(n, dz, dz, end - before, 1.0)

    def places(dz):
        return start, start + 0.5 * dz, start + dz

    radii = [np.linalg.norm(x, axis=1)[:, None] for x in places(change)]
    _, n, slope = (x / r for x, r in zip(places(change), radii, strict=True))
    bend = 0.5 * (np.eye(dim) - n[:, :, None] * n[:, None, :]) / radii[1][:, :, None]
    _, factor = corrected(change)
    found = whole_step.corrected_slope(n, bend, change, factor, slope)
    for j in range(dim):
        step = 1e-30j * np.eye(dim)[j]
        exact = corrected(change + step)[0].imag / 1e-30
        np.testing.assert_allclose(found[:, :, j], exact, atol=1e-12 * np.abs(found).max())
    assert np.abs(factor).min() > 0.0
