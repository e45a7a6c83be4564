# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Elastic laws with a phase field of fracture: stress, tangent and splits of the energy."""

import numpy as np
import pytest

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Fracture, Hencky, LinearElastic, NeoHooke, VonMises

LAWS = (LinearElastic(100.0, 0.3), Hencky(100.0, 0.3), NeoHooke(100.0, 0.3))
CASES = [
    (law, split)
    for law in LAWS
    for split in ("volumetric", "spectral", "none")
    if split != "spectral" or not isinstance(law, NeoHooke)
]


def random_points(law, dim, damage=None, size=0.2):
    rng = np.random.default_rng(dim)
    gradient = size * rng.standard_normal((60, dim, dim))
    state = law.initial_state(60, dim)
    state["damage"] = rng.random(60) if damage is None else np.full(60, damage)
    return gradient, state


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(("law", "split"), CASES)
def test_stress_and_tangent_are_derivatives_of_the_energy(law, split, dim):
    cracks = Fracture(law, 1.0, 1.0, split=split)
    gradient, state = random_points(cracks, dim)
    answer = cracks.update(gradient, state)
    step = 1e-6
    for i in range(dim):
        for j in range(dim):
            ahead, behind = gradient.copy(), gradient.copy()
            ahead[:, i, j] += step
            behind[:, i, j] -= step
            a, b = (cracks.update(H, state) for H in (ahead, behind))
            work = (a.state["stored_energy"] - b.state["stored_energy"]) / (2 * step)
            np.testing.assert_allclose(answer.first_piola[:, i, j], work, atol=2e-6)
            slope = (a.first_piola - b.first_piola) / (2 * step)
            np.testing.assert_allclose(answer.tangent[..., i, j], slope, atol=5e-6)


@pytest.mark.parametrize(("law", "split"), CASES)
def test_what_is_whole_is_the_law_and_what_is_broken_bears_nothing_in_tension(law, split):
    cracks = Fracture(law, 1.0, 1.0, split=split)
    gradient, state = random_points(cracks, 3, damage=0.0)
    whole = cracks.update(gradient, state)
    np.testing.assert_allclose(
        whole.first_piola,
        law.update(gradient, law.initial_state(60, 3)).first_piola,
        rtol=2e-6,
        atol=2e-4,
    )
    driving = whole.state["driving_energy"]
    assert (driving >= 0.0).all()
    pulled = np.broadcast_to(0.1 * np.eye(3), (60, 3, 3))
    state["damage"][:] = 1.0
    broken = cracks.update(pulled, state)
    assert np.abs(broken.first_piola).max() < 1e-3
    pressed = -0.5 * pulled
    broken = cracks.update(pressed, state)
    bears = law.update(pressed, law.initial_state(60, 3)).first_piola
    expected = 0.0 * bears if split == "none" else bears
    np.testing.assert_allclose(broken.first_piola, expected, atol=1e-3)


def test_a_spectral_split_lets_nothing_drive_a_crack_under_pressure():
    state = (cracks := Fracture(LAWS[0], 1.0, 1.0, split="spectral")).initial_state(1, 2)
    squeezed = np.array([[[-0.1, 0.0], [0.0, 0.0]]])
    assert cracks.update(squeezed, state).state["driving_energy"][0] == 0.0
    shear = Fracture(LAWS[0], 1.0, 1.0, split="volumetric").update(squeezed, state)
    deviator = np.array([-0.1, 0.0, 0.0]) + 0.1 / 3.0
    expected = LAWS[0].shear * (deviator**2).sum()
    np.testing.assert_allclose(shear.state["driving_energy"], expected, rtol=1e-12)


def test_parameters_are_those_of_the_law_and_its_own():
    cracks = Fracture(Hencky(100.0, 0.3), 2.0, 0.1)
    other = cracks.with_parameters(young=50.0, toughness=3.0)
    assert dict(other.parameters) == {
        "young": 50.0,
        "poisson": 0.3,
        "toughness": 3.0,
        "length": 0.1,
    }
    assert other.law.parameters["young"] == 50.0
    assert cracks.law.parameters["young"] == 100.0
    assert "toughness=3, length=0.1" in repr(other)


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: Fracture(VonMises(1.0, 0.3, 1.0), 1.0, 1.0), "elastic law"),
        (lambda: Fracture(LAWS[0], -1.0, 1.0), "toughness is -1"),
        (lambda: Fracture(LAWS[0], 1.0, 0.0), "length is 0"),
        (lambda: Fracture(LAWS[0], 1.0, 1.0, model="AT3"), "AT3"),
        (lambda: Fracture(LAWS[0], 1.0, 1.0, split="half"), "half"),
        (lambda: Fracture(LAWS[2], 1.0, 1.0, split="spectral"), "linear in their strain"),
        (lambda: Fracture(LAWS[0], 1.0, 1.0).with_parameters(tough=1.0), "no parameter"),
    ],
)
def test_what_makes_no_sense_is_refused(make, told):
    with pytest.raises(mpm.MPMError, match=told):
        make()
