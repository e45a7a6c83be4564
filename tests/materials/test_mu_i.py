# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Friction by the inertial number against roots, steady flow, and the law without rates."""

import math

import numpy as np
import pytest
from marks import slow
from materials.reference import moduli, rotation
from materials.test_von_mises import random_path
from scipy.optimize import brentq

from mpm_dolfinx.errors import MPMError
from mpm_dolfinx.materials import DruckerPrager, MuIRheology, mandel

YOUNG, POISSON, GRAIN, DENSITY, NUMBER = 1e4, 0.3, 0.02, 3.0, 0.279
STATIC, LIMIT = 0.5, 0.76
K, G = moduli(YOUNG, POISSON)
LAW = MuIRheology(YOUNG, POISSON, STATIC, LIMIT, GRAIN, DENSITY, NUMBER)


def friction(rate, pressure):
    """Return mu(I) as it is published."""
    inertial = GRAIN * rate / np.sqrt(pressure / DENSITY)
    return STATIC + (LIMIT - STATIC) * inertial / (NUMBER + inertial)


@pytest.mark.parametrize("duration", [1e-9, 1e-4, 1e-2, 1.0, math.inf])
def test_the_return_is_the_root_of_the_equation_of_flow(duration):
    """q = mu(I) P with the rate (q_trial - q)/(G dt), sought between mu_s P and mu_2 P."""
    random = np.random.default_rng(3)
    strain = 4e-3 * random.normal(size=(200, 6))
    strain[:, :3] -= random.uniform(0.0, 4e-3, (200, 1))
    law = LAW.in_time(duration)
    stress = law.integrate(strain, {"plastic_strain": np.zeros(200)}, False).stress
    flowing = 0
    for eps, found in zip(strain, stress, strict=True):
        pressure = -K * eps[:3].sum()
        trial = np.sqrt(2.0) * G * np.linalg.norm(mandel.deviator(eps[None])[0])
        q = np.linalg.norm(mandel.deviator(found[None])[0]) / np.sqrt(2.0)
        if pressure <= 0.0:
            assert not found.any()
            continue
        np.testing.assert_allclose(-found[:3].sum() / 3.0, pressure, rtol=1e-12)

        def excess(q, trial=trial, pressure=pressure):
            return q - friction((trial - q) / G / duration, pressure) * pressure

        low, high = STATIC * pressure, min(trial, LIMIT * pressure)
        if trial <= low:
            expected = trial
        elif excess(high) <= 0.0:
            expected = high  # of no duration, below the limit
        else:
            expected, flowing = brentq(excess, low, high, xtol=1e-14 * high), flowing + 1
        assert abs(q - expected) < 1e-9 * trial
    assert flowing > 50


@pytest.mark.parametrize("rate", [1.0, 30.0])
def test_steady_shear_has_the_friction_of_its_rate(rate):
    """Simple shear at a constant volume, whatever the time steps that it is cut in."""
    squeeze = np.exp(-2e-4)
    for dt in (1e-3 / rate, 4e-3 / rate):
        law = LAW.in_time(dt)
        state, gamma = law.initial_state(1, 2), 0.0
        for _ in range(60):
            gamma += rate * dt
            H = squeeze * np.array([[1.0, gamma], [0.0, 1.0]]) - np.eye(2)
            state = law.update(H[None], state, tangent=False).state
        stress = state["stress"]
        pressure = -stress[0, :3].mean()
        q = np.linalg.norm(mandel.deviator(stress)) / np.sqrt(2.0)
        np.testing.assert_allclose(pressure, 2.0 * K * 2e-4, rtol=1e-10)
        assert abs(q / pressure / friction(rate, pressure) - 1.0) < 1e-3


@pytest.mark.parametrize("dim", [2, 3])
def test_without_rates_it_is_the_cone_of_plane_strain(dim):
    angle = np.degrees(np.arcsin(STATIC))
    cone = DruckerPrager(YOUNG, POISSON, 0.0, angle, match="plane_strain", volume_correction=True)
    slow_grains = MuIRheology(YOUNG, POISSON, STATIC, LIMIT, 0.0, DENSITY).in_time(0.01)
    for law in (LAW, slow_grains):
        state = law.initial_state(200, dim)
        for H in random_path(200, dim, 4, size=5e-3):
            mine, theirs = law.update(H, state), cone.update(H, state)
            size = np.abs(theirs.first_piola).max()
            np.testing.assert_allclose(mine.first_piola, theirs.first_piola, atol=1e-12 * size)
            np.testing.assert_allclose(mine.tangent, theirs.tangent, atol=1e-10 * YOUNG)
            state = mine.state
            np.testing.assert_allclose(
                state["plastic_strain"], theirs.state["plastic_strain"], atol=1e-13
            )


@pytest.mark.parametrize("m", [4, 6])
@pytest.mark.parametrize("duration", [0.0, 1e-5, 1e-2, math.inf])
def test_the_tangent_is_the_derivative_of_the_stress(duration, m):
    """Under pressure, where the stress is smooth, and free of it; at equal strains too."""
    random = np.random.default_rng(5)
    strain = mandel.deviator(4e-3 * random.normal(size=(300, m)))
    strain[:, :3] -= random.uniform(5e-4, 2e-3, (300, 1))
    strain[::10] = [-2e-3, -2e-3, 2e-3, *[0.0] * (m - 3)]
    strain[::15] = [2e-3, 1e-3, 1e-3, *[1e-4] * (m - 3)]
    law, variables = LAW.in_time(duration), {"plastic_strain": np.zeros(len(strain))}
    answer = law.integrate(strain, variables, True)
    assert (answer.variables["plastic_strain"] > 0.0).mean() > 0.5
    h = 1e-8
    for j, shift in enumerate(h * np.eye(m)):
        ends = [law.integrate(strain + s * shift, variables, False).stress for s in (1.0, -1.0)]
        slope = (ends[0] - ends[1]) / (2.0 * h)
        np.testing.assert_allclose(answer.tangent[:, :, j], slope, atol=1e-6 * YOUNG)


@pytest.mark.parametrize("dim", [*slow(2), 3])
@pytest.mark.parametrize("duration", [1e-4, 1e-2])
def test_a_thousand_random_paths(duration, dim):
    """Frame indifference, dissipation, and strength between its ends."""
    law = LAW.in_time(duration)
    state, turned = (law.initial_state(1000, dim) for _ in range(2))
    axes = (1.0, 2.0, -1.0) if dim == 3 else (0.0, 0.0, 1.0)
    for step, H in enumerate(random_path(1000, dim, 6, seed=dim, size=4e-3), 1):
        frame = law._kinematics(H, state)
        variables = {"plastic_strain": state["plastic_strain"]}
        answer = law.integrate(frame.trial_strain, variables, False)
        flow = frame.trial_strain - answer.elastic_strain
        work = np.einsum("ni,ni->n", answer.stress, flow)
        assert work.min() > -1e-12 * np.abs(flow).max()
        update = law.update(H, state)
        R = rotation(0.9 * step, axes)[:dim, :dim]
        other = law.update(R @ (np.eye(dim) + H) - np.eye(dim), turned)
        size = np.abs(update.first_piola).max()
        assert np.abs(other.first_piola - R @ update.first_piola).max() < 1e-10 * size
        plastic = update.state["plastic_strain"] > state["plastic_strain"]
        state, turned = update.state, other.state
        pressure = -mandel.trace(state["stress"]) / 3.0
        over = law.yield_function(state["stress"], state["plastic_strain"])
        assert (over <= (LIMIT - STATIC) * pressure + 1e-9).all()
    assert plastic.mean() > 0.4 and (over > 1e-3).any()


def test_what_has_opened_closes_again_before_there_is_pressure():
    law = LAW.in_time(1e-2)
    state = law.initial_state(1, 2)
    sheared = np.array([[0.1, 0.05], [0.0, 0.0]])
    for H in (0.06 * np.eye(2), sheared):
        state = law.update(H[None], state).state
        assert not state["stress"].any()
    close = -0.004 * np.eye(2)
    stress = law.update(close[None], state).state["stress"][0]
    volume = np.log(np.linalg.det(np.eye(2) + close))
    np.testing.assert_allclose(-stress[:3].sum() / 3.0, -K * volume, rtol=1e-10)


def test_strength_is_reduced_and_given_by_point():
    half = LAW.weakened(2.0)
    assert half.parameters["static_friction"] == 0.25 and half.parameters["limit_friction"] == 0.38
    sizes = np.array([0.0, GRAIN, 3.0 * GRAIN])
    several = MuIRheology(YOUNG, POISSON, STATIC, LIMIT, sizes, DENSITY).in_time(1e-3)
    H = np.tile([[-1e-3, 5e-3], [0.0, -1e-3]], (3, 1, 1))
    stress = several.update(H, several.initial_state(3, 2)).state["stress"]
    for size, found in zip(sizes, stress, strict=True):
        one = several.with_parameters(grain_size=float(size))
        expected = one.update(H[:1], one.initial_state(1, 2)).state["stress"][0]
        np.testing.assert_allclose(found, expected, rtol=1e-13)
    assert (np.diff(stress[:, 3]) > 0.0).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, 0.7, 0.01, 3.0), "static_friction is 0 but must be finite, greater than 0"),
        ((0.5, 0.4, 0.01, 3.0), "limit_friction is less than static_friction"),
        ((0.5, 0.7, -0.01, 3.0), "grain_size is -0.01"),
        ((0.5, 0.7, 0.01, 0.0), "grain_density is 0"),
        ((0.5, 0.7, 0.01, 3.0, 0.0), "inertial_number is 0"),
    ],
)
def test_bad_parameters(arguments, message):
    with pytest.raises(MPMError, match=message):
        MuIRheology(YOUNG, POISSON, *arguments)
