# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Plasticity of von Mises against pointwise and one-dimensional references."""

import numpy as np
import pytest
from materials.reference import embed, moduli, rotation, von_mises_path

from mpm_dolfinx.materials import SmallStrainVonMises, VonMises, check_tangent, mandel

YOUNG, POISSON, RHO = 1e3, 0.3, 2.0
K, G = moduli(YOUNG, POISSON)
LAWS = [VonMises, SmallStrainVonMises]


def random_path(n, dim, steps, seed=0, size=3e-3, turn=0.3):
    """Return displacement gradients (steps, n, dim, dim) that strain, turn and unload."""
    random = np.random.default_rng(seed)
    F, path = np.broadcast_to(np.eye(dim), (n, dim, dim)), []
    for _ in range(steps):
        stretch = random.normal(size=(n, dim, dim)) * size
        R = rotation(turn, (1.0, 1.0, 0.5) if dim == 3 else (0.0, 0.0, 1.0))[:dim, :dim]
        F = R @ (np.eye(dim) + stretch) @ F
        path.append(F - np.eye(dim))
    return np.array(path)


def follow(material, path):
    """Return the last answer along a path of displacement gradients."""
    state = material.initial_state(path.shape[1], path.shape[2])
    for H in path:
        answer = material.update(H, state)
        state = answer.state
    return answer


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("hardening", [0.0, 100.0])
def test_path_against_pointwise_reference(dim, hardening):
    path = random_path(6, dim, 8)
    material = VonMises(YOUNG, POISSON, rho_y=RHO, hardening=hardening)
    answer = follow(material, path)
    cauchy = material.cauchy_stress(path[-1], answer.state)
    for p in range(path.shape[1]):
        F = embed(path[:, p]) + np.eye(3)
        tau, P, kappa = von_mises_path(F, YOUNG, POISSON, RHO, hardening)
        assert kappa > 0.0
        np.testing.assert_allclose(answer.first_piola[p], P[:dim, :dim], atol=1e-10)
        np.testing.assert_allclose(cauchy[p], tau / np.linalg.det(F[-1]), atol=1e-10)
        assert abs(answer.state["plastic_strain"][p] - kappa) < 1e-13


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("hardening", [0.0, 100.0])
def test_yield_is_enforced_to_round_off(dim, law, hardening):
    material = law(YOUNG, POISSON, rho_y=RHO, hardening=hardening)
    path = random_path(300, dim, 5, size=0.1, turn=0.0)
    before, state = follow(material, path[:-1]).state, follow(material, path).state
    f = material.yield_function(state["stress"], state["plastic_strain"])
    plastic = state["plastic_strain"] > before["plastic_strain"]
    assert plastic.sum() > 150
    assert np.abs(f[plastic]).max() < 1e-12
    assert f.max() < 1e-12


def test_uniaxial_yield_stress_and_rho_are_the_same_thing():
    assert VonMises(YOUNG, POISSON, yield_stress=3.0).rho_y == pytest.approx(np.sqrt(6.0))
    path = random_path(5, 2, 3)
    one = follow(VonMises(YOUNG, POISSON, yield_stress=np.sqrt(1.5) * RHO), path)
    two = follow(VonMises(YOUNG, POISSON, rho_y=RHO), path)
    np.testing.assert_allclose(one.first_piola, two.first_piola, rtol=1e-13, atol=1e-13)


def one_dimensional(strains, modulus, hardening, strength):
    """Integrate d stress = modulus d strain up to yield, then with the plastic slope."""
    stress, kappa, last, stresses = 0.0, 0.0, 0.0, []
    for strain in strains:
        change = strain - last
        limit = strength + hardening * kappa
        sign = np.sign(change)
        elastic = min(abs(change), (limit - sign * stress) / modulus)
        plastic = abs(change) - elastic
        stress += sign * modulus * (elastic + plastic * hardening / (modulus + hardening))
        kappa += plastic * modulus / (modulus + hardening)
        last = strain
        stresses.append(stress)
    return np.array(stresses), kappa


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("steps", [3, 50])
def test_hardening_in_one_dimension(law, steps):
    """Isochoric stretch there and back: the deviator's norm follows a law of one variable."""
    hardening, top = 150.0, 0.02
    ramp = np.linspace(0.0, 1.0, steps + 1)[1:]
    strains = top * np.concatenate((ramp, 1.0 - 2.0 * ramp))
    diagonal = np.stack((strains, -strains), axis=1)
    if law is VonMises:
        diagonal = np.expm1(diagonal)
    path = diagonal[:, None, :, None] * np.eye(2)
    material = law(YOUNG, POISSON, rho_y=RHO, hardening=hardening)
    state = material.initial_state(1, 2)
    stresses = []
    for H in path:
        state = material.update(H, state).state
        stresses.append((state["stress"][0, 0] - state["stress"][0, 1]) / np.sqrt(2.0))
    # norm of the strain: sqrt(2) strain; of the plastic one: sqrt(3/2) kappa
    expected, flow = one_dimensional(np.sqrt(2.0) * strains, 2.0 * G, 2.0 / 3.0 * hardening, RHO)
    np.testing.assert_allclose(stresses, expected, rtol=1e-11)
    assert state["plastic_strain"][0] == pytest.approx(np.sqrt(2.0 / 3.0) * flow, rel=1e-11)


@pytest.mark.parametrize("law", LAWS)
def test_plane_strain_is_three_dimensions_without_the_third(law):
    path = random_path(40, 2, 6, turn=0.3 if law is VonMises else 0.0)
    material = law(YOUNG, POISSON, rho_y=RHO, hardening=50.0)
    flat, full = follow(material, path), follow(material, np.array([embed(H) for H in path]))
    atol = 1e-12 * RHO
    np.testing.assert_allclose(flat.first_piola, full.first_piola[:, :2, :2], atol=atol)
    np.testing.assert_allclose(flat.state["stress"], full.state["stress"][:, :4], atol=atol)
    np.testing.assert_allclose(full.state["stress"][:, 4:], 0.0, atol=atol)
    np.testing.assert_allclose(
        flat.tangent, full.tangent[:, :2, :2, :2, :2], atol=1e-11 * np.abs(full.tangent).max()
    )


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("hardening", [0.0, 100.0])
def test_tangents(dim, law, hardening):
    material = law(YOUNG, POISSON, rho_y=RHO, hardening=hardening)
    assert check_tangent(material, dim) < 1e-7
    assert check_tangent(material, dim, strain=0.3, seed=1) < 1e-7


@pytest.mark.parametrize("dim", [2, 3])
def test_objectivity_under_superposed_rotations(dim):
    path = random_path(30, dim, 6, size=0.02, turn=0.0)
    axis = (1.0, 2.0, -1.0) if dim == 3 else (0.0, 0.0, 1.0)
    turns = [rotation(0.9 * k, axis)[:dim, :dim] for k in range(1, 7)]
    turned = np.array(
        [R @ (np.eye(dim) + H) - np.eye(dim) for R, H in zip(turns, path, strict=True)]
    )
    material = VonMises(YOUNG, POISSON, rho_y=0.1 * YOUNG, hardening=10.0)
    P, P_turned = follow(material, path).first_piola, follow(material, turned).first_piola
    assert np.abs(P_turned - turns[-1] @ P).max() < 1e-13 * YOUNG
    plastic = VonMises(YOUNG, POISSON, rho_y=RHO)
    P, P_turned = follow(plastic, path).first_piola, follow(plastic, turned).first_piola
    assert np.abs(P_turned - turns[-1] @ P).max() < 1e-13 * YOUNG


@pytest.mark.parametrize("dim", [2, 3])
def test_rigid_rotation_in_many_increments_gives_no_stress(dim):
    axis = (1.0, 2.0, -1.0) if dim == 3 else (0.0, 0.0, 1.0)
    path = [rotation(0.05 * k, axis)[:dim, :dim] - np.eye(dim) for k in range(1, 301)]
    answer = follow(VonMises(YOUNG, POISSON, rho_y=RHO), np.array(path)[:, None])
    assert np.abs(answer.first_piola).max() < 1e-13 * YOUNG
    assert answer.state["plastic_strain"][0] == 0.0


@pytest.mark.parametrize("law", LAWS)
def test_given_arrays_are_not_modified_and_not_kept(law):
    path = random_path(20, 2, 2)
    material = law(YOUNG, POISSON, rho_y=RHO, hardening=1.0)
    old = material.update(path[0], material.initial_state(20, 2)).state
    copies = {name: values.copy() for name, values in old.items()}
    H = path[1].copy()
    new = material.update(H, old).state
    assert all(np.array_equal(copies[name], old[name]) for name in old)
    H[:] = 7.0
    np.testing.assert_array_equal(new["displacement_gradient"], path[1])


def test_unloading_is_elastic():
    material = VonMises(YOUNG, POISSON, rho_y=RHO)
    load = np.zeros((1, 2, 2))
    load[0, 0, 1] = 0.02
    state = material.update(load, material.initial_state(1, 2)).state
    back = material.update(0.99 * load, state)
    assert state["plastic_strain"][0] > 0.0
    assert back.state["plastic_strain"][0] == state["plastic_strain"][0]
    assert mandel.norm(mandel.deviator(back.state["stress"]))[0] < 0.95 * RHO


def test_no_points_are_fine():
    material = VonMises(YOUNG, POISSON, rho_y=RHO)
    for dim in (2, 3):
        answer = material.update(np.zeros((0, dim, dim)), material.initial_state(0, dim))
        assert answer.tangent.shape == (0, dim, dim, dim, dim)


@pytest.mark.parametrize("law", LAWS)
def test_plastic_work_is_the_area_under_the_uniaxial_curve(law):
    material = law(YOUNG, POISSON, rho_y=RHO, hardening=30.0)
    kappa = np.linspace(0.0, 0.2, 41)
    uniaxial = np.sqrt(1.5) * material.strength(kappa)
    area = np.concatenate([[0.0], np.cumsum((uniaxial[1:] + uniaxial[:-1]) / 2 * np.diff(kappa))])
    np.testing.assert_allclose(material.plastic_work({"plastic_strain": kappa}), area, rtol=1e-12)
