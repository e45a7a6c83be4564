# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Elastic laws against closed forms, energies and linear elasticity."""

import numpy as np
import pytest
from materials.reference import dev, embed, moduli, rotation
from scipy.linalg import logm

from mpm_dolfinx.errors import DomainDistortionError
from mpm_dolfinx.materials import Hencky, LinearElastic, VonMises, check_tangent

YOUNG, POISSON = 3.0, 0.3
K, G = moduli(YOUNG, POISSON)


def random_gradients(n, dim, size, seed=0):
    return size * np.random.default_rng(seed).normal(size=(n, dim, dim))


def update(material, H):
    return material.update(H, material.initial_state(len(H), H.shape[1]))


def hencky_energy(F):
    eps = 0.5 * np.real(logm(F @ F.T))
    return 0.5 * K * np.trace(eps) ** 2 + G * np.sum(dev(eps) ** 2)


@pytest.mark.parametrize("dim", [2, 3])
def test_linear_elasticity(dim):
    H = random_gradients(10, dim, 0.3)
    eps = embed(0.5 * (H + H.swapaxes(1, 2)))
    trace = np.trace(eps, axis1=1, axis2=2)
    sigma = (K - 2 * G / 3) * trace[:, None, None] * np.eye(3) + 2 * G * eps
    material = LinearElastic(YOUNG, POISSON)
    answer = update(material, H)
    np.testing.assert_allclose(answer.first_piola, sigma[:, :dim, :dim], atol=1e-14)
    np.testing.assert_allclose(material.cauchy_stress(H, answer.state), sigma, atol=1e-14)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("stretch", [0.2, 0.9, 1.0, 1.7])
def test_hencky_in_confined_compression(dim, stretch):
    """tau_yy = (K + 4G/3) ln(stretch), the other two (K - 2G/3) ln(stretch)."""
    H = np.zeros((1, dim, dim))
    H[0, 1, 1] = stretch - 1.0
    material = Hencky(YOUNG, POISSON)
    answer = update(material, H)
    log = np.log(stretch)
    tau = np.diag([K - 2 * G / 3, K + 4 * G / 3, K - 2 * G / 3]) * log
    np.testing.assert_allclose(
        material.cauchy_stress(H, answer.state)[0], tau / stretch, atol=1e-14
    )
    piola = tau[:dim, :dim].copy()
    piola[1, 1] /= stretch
    np.testing.assert_allclose(answer.first_piola[0], piola, atol=1e-14)


def test_hencky_in_uniaxial_tension():
    """With lateral stretch exp(-poisson e) the stress is uniaxial, tau = young e."""
    e = 0.8
    H = np.diag(np.expm1([e, -POISSON * e, -POISSON * e]))[None]
    answer = update(Hencky(YOUNG, POISSON), H)
    np.testing.assert_allclose(
        answer.first_piola[0], np.diag([YOUNG * e / np.exp(e), 0.0, 0.0]), atol=1e-14
    )


@pytest.mark.parametrize("dim", [2, 3])
def test_hencky_stress_is_the_derivative_of_its_energy(dim):
    H = random_gradients(4, dim, 0.2)
    P = update(Hencky(YOUNG, POISSON), H).first_piola
    F, h = embed(H) + np.eye(3), 1e-3
    for p, i, j in np.ndindex(len(H), dim, dim):
        d = np.zeros((3, 3))
        d[i, j] = h
        slope = sum(
            w * hencky_energy(F[p] + k * d)
            for k, w in ((-3, -1), (-2, 9), (-1, -45), (1, 45), (2, -9), (3, 1))
        ) / (60 * h)
        assert abs(P[p, i, j] - slope) < 1e-10 * K


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("material", [LinearElastic, Hencky])
def test_tangents(dim, material):
    assert check_tangent(material(YOUNG, POISSON), dim, strain=0.3) < 1e-8


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("perturbation", [0.0, 1e-14, 1e-10, 1e-6])
def test_hencky_tangent_at_equal_stretches(dim, perturbation):
    """Against differences, which do not see the perturbation of equal eigenvalues."""
    R = rotation(0.7, (1.0, 2.0, 3.0) if dim == 3 else (0.0, 0.0, 1.0))[:dim, :dim]
    stretch = 1.3 * np.eye(dim) + perturbation * np.diag([1.0, -1.0, 0.5][:dim])
    H = (R @ stretch - np.eye(dim))[None]
    material, h = Hencky(YOUNG, POISSON), 1e-3
    A = update(material, H).tangent
    for k, L in np.ndindex(dim, dim):
        d = np.zeros((1, dim, dim))
        d[0, k, L] = h
        slope = sum(
            w * update(material, H + m * d).first_piola
            for m, w in ((-3, -1), (-2, 9), (-1, -45), (1, 45), (2, -9), (3, 1))
        ) / (60 * h)
        np.testing.assert_allclose(A[..., k, L], slope, atol=1e-10 * K)


@pytest.mark.parametrize("dim", [2, 3])
def test_objectivity(dim):
    H = random_gradients(30, dim, 0.2)
    R = rotation(2.0, (1.0, 2.0, 3.0) if dim == 3 else (0.0, 0.0, 1.0))[:dim, :dim]
    P = update(Hencky(YOUNG, POISSON), H).first_piola
    turned = R @ (np.eye(dim) + H) - np.eye(dim)
    P_turned = update(Hencky(YOUNG, POISSON), turned).first_piola
    assert np.abs(P_turned - R @ P).max() < 1e-13 * np.abs(P).max()


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("material", [Hencky(YOUNG, POISSON), VonMises(YOUNG, POISSON, rho_y=1e-3)])
def test_small_strains_keep_their_precision(dim, material):
    """A strain of 1e-9 is far below the round-off of 1 + strain squared."""
    H = random_gradients(30, dim, 1e-9)
    P = update(material, H).first_piola
    linear = update(LinearElastic(YOUNG, POISSON), H).first_piola
    error = np.abs(P - linear).max(axis=(1, 2)) / np.abs(linear).max(axis=(1, 2))
    assert error.max() < 1e-8


def test_inverted_points_are_named():
    H = np.zeros((5, 2, 2))
    H[1, 0, 0] = -1.5
    H[3, 1, 1] = -1.0
    H[4, 0, 1] = np.nan
    for material in (Hencky(YOUNG, POISSON), VonMises(YOUNG, POISSON, rho_y=1.0)):
        with pytest.raises(DomainDistortionError, match="3 of 5 points") as caught:
            update(material, H)
        assert caught.value.particles == [1, 3, 4]


def test_points_that_are_crushed_to_round_off_are_named():
    """Their determinants are positive, and the logarithm of their stretches is none."""
    H = np.zeros((3, 2, 2))
    H[2, 0, 0] = -1.0 + 1e-12
    for material in (Hencky(YOUNG, POISSON), VonMises(YOUNG, POISSON, rho_y=1.0)):
        with pytest.raises(DomainDistortionError, match="1 of 3 points") as caught:
            update(material, H)
        assert caught.value.particles == [2]


def test_overflow_is_reported_as_distortion():
    H = np.zeros((2, 3, 3))
    H[1] = 1e200 * np.eye(3)
    with pytest.raises(DomainDistortionError):
        update(Hencky(YOUNG, POISSON), H)


def test_answer_is_in_c_order_and_tangent_on_demand():
    H = random_gradients(7, 2, 0.1)
    material = Hencky(YOUNG, POISSON)
    answer = update(material, H)
    assert answer.first_piola.flags.c_contiguous and answer.tangent.flags.c_contiguous
    short = material.update(H, material.initial_state(7, 2), tangent=False)
    assert short.tangent is None
    np.testing.assert_array_equal(short.first_piola, answer.first_piola)
