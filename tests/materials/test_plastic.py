# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Plastic laws whose flow takes time, against closed forms and the law of Perzyna."""

from itertools import product

import numpy as np
import pytest
from laws import assert_as_in_python, in_python
from materials.test_von_mises import random_path

from mpm_dolfinx import MPMError
from mpm_dolfinx.materials import (
    DruckerPrager,
    Hencky,
    LinearElastic,
    MohrCoulomb,
    ReturnMapping,
    SmallStrainVonMises,
    Tresca,
    VonMises,
    check_tangent,
    mandel,
)

COUNT, TIME = 30, 0.5
SPREAD = np.linspace(1.0, 2.0, COUNT)


class Rounded(ReturnMapping):
    """A law of one's own, which gets its time as a parameter like any."""

    symmetric = True

    def __init__(self):
        super().__init__(1e3, 0.3)
        self.parameters = {**self.parameters, "strength": 2.0}

    def yield_function(self, stress, plastic_strain):
        size = np.sqrt((mandel.deviator(stress) ** 2).sum(axis=1))
        return size - self.parameters["strength"] - 5.0 * plastic_strain


FALL = {"decay": 20.0, "cohesion": 0.5}
LAWS = {
    "von mises": VonMises(1e3, 0.3, rho_y=2.0, hardening=50.0),
    "small strain": SmallStrainVonMises(1e3, 0.3, rho_y=2.0, hardening=50.0),
    "tresca": Tresca(1e3, 0.3, 2.0),
    "mohr-coulomb": MohrCoulomb(1e3, 0.3, 2.0, 30.0, 10.0, 1.0),
    "softening": MohrCoulomb(1e3, 0.3, 2.0, 30.0, 10.0).with_softening(**FALL),
    "sand": MohrCoulomb(1e3, 0.3, 0.0, 30.0, volume_correction=True),
    "cone": DruckerPrager(1e3, 0.3, 2.0, 30.0, 10.0, match="plane_strain"),
    "averaged": Tresca(1e3, 0.3, 2.0).with_softening(**FALL).softening_by(0.02 * SPREAD),
    "by point": VonMises(1e3 * SPREAD, 0.3, rho_y=2.0 * SPREAD),
    "one's own": Rounded(),
}
#: Whose derivatives in space cost a second.
COSTLY = ("averaged", "one's own")
COMPILED = [name for name in LAWS if name not in ("small strain", "one's own")]


def taking(time, name, duration):
    return LAWS[name].with_relaxation(time).in_time(duration)


@pytest.mark.parametrize(
    ("name", "dim"),
    [
        *product([name for name in LAWS if name not in COSTLY], [2, 3]),
        *((name, 2) for name in COSTLY),
        *(pytest.param(name, 3, marks=pytest.mark.slow) for name in COSTLY),
    ],
)
def test_the_tangent_is_the_derivative(name, dim):
    law = taking(TIME, name, 0.3)
    assert check_tangent(law, dim, strain=0.05) < 1e-7
    if name in COMPILED:
        assert check_tangent(in_python(law), dim, strain=0.05) < 1e-7


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("name", COMPILED)
@pytest.mark.parametrize("time", [TIME, TIME * SPREAD])
def test_compiled_update_is_that_of_numpy(time, name, dim):
    law = taking(time, name, 0.2)
    assert_as_in_python(law, random_path(COUNT, dim, 4, size=0.05, turn=0.3))


@pytest.mark.parametrize("name", LAWS)
def test_long_steps_are_those_without_time_and_short_ones_elastic(name):
    without, law = LAWS[name], LAWS[name].with_relaxation(TIME)
    state = without.initial_state(COUNT, 2)
    H = random_path(COUNT, 2, 1, size=0.05)[0]
    plain = without.update(H, state)
    assert (plain.state["plastic_strain"] > 0.0).any()
    size = np.abs(plain.first_piola).max()
    for duration in (np.inf, 1e14 * TIME):
        slow = law.in_time(duration).update(H, state)
        np.testing.assert_allclose(slow.first_piola, plain.first_piola, atol=1e-11 * size)
        np.testing.assert_allclose(slow.tangent, plain.tangent, atol=1e-11 * 1e4)
    fast = law.in_time(0.0).update(H, state)
    assert (fast.state["plastic_strain"] == 0.0).all()
    kind = LinearElastic if law.kinematics == "small" else Hencky
    elastic = kind(law.parameters["young"], 0.3).update(H, {})
    np.testing.assert_allclose(fast.first_piola, elastic.first_piola, atol=1e-11 * size)
    assert np.abs(fast.first_piola - plain.first_piola).max() > 0.1 * size


def sheared(law, shears, duration):
    """Return shear stresses of one point at shear strains one after the other."""
    law, stresses = law.in_time(duration), []
    state = law.initial_state(1, 2)
    for shear in shears:
        answer = law.update(np.array([[[0.0, shear], [0.0, 0.0]]]), state)
        stresses.append(answer.first_piola[0, 0, 1])
        state = answer.state
    return np.array(stresses)


def test_stress_relaxes_and_follows_a_rate_as_in_closed_form():
    """In shear: tau_0 + (tau - tau_0) exp(-t/T), or tau_0 + G rate T (1 - exp(-t/T))."""
    modulus, strength, rate = 1e3 / 2.6, 2.0 / np.sqrt(2.0), 0.1
    law = SmallStrainVonMises(1e3, 0.3, rho_y=2.0).with_relaxation(TIME)
    errors = []
    for steps in (20, 40, 80, 160):
        dt = 2.0 * TIME / steps
        start = strength / modulus
        held = sheared(law, [3.0 * start] * steps, dt)
        pulled = sheared(law, start + rate * dt * np.arange(1, steps + 1), dt)
        t = dt * np.arange(1, steps + 1)
        left = strength * (1.0 + 2.0 * np.exp(-t / TIME))
        drawn = strength + modulus * rate * TIME * (1.0 - np.exp(-t / TIME))
        errors.append([np.abs(held - left).max(), np.abs(pulled - drawn).max()])
    orders = np.log2(np.array(errors)[:-1] / np.array(errors)[1:])
    assert (np.abs(orders[-1] - 1.0) < 0.05).all()
    assert (errors[-1] < [0.01 * strength, 0.01 * modulus * rate * TIME]).all()


def test_von_mises_is_the_law_of_perzyna():
    """With a linear overstress, coded by itself: dgamma = f / (2 G + 2/3 H + eta/dt)."""
    law, dt = LAWS["small strain"].with_relaxation(TIME), 0.2
    G, H = 1e3 / 2.6, 50.0
    eta = (2.0 * G + 2.0 / 3.0 * H) * TIME
    state, kappa = law.initial_state(COUNT, 2), np.zeros(COUNT)
    plastic, flowed = np.zeros((COUNT, 4)), 0
    for gradient in random_path(COUNT, 2, 5, size=0.02, turn=0.0):
        state = law.in_time(dt).update(gradient, state).state
        strain = np.zeros((COUNT, 3, 3))
        strain[:, :2, :2] = 0.5 * (gradient + gradient.transpose(0, 2, 1))
        strain = mandel.to_vector(strain, 2)
        s = 2.0 * G * mandel.deviator(strain - plastic)
        size = mandel.norm(s)
        f = size - (2.0 + np.sqrt(2.0 / 3.0) * H * kappa)
        flow = np.maximum(f, 0.0) / (2.0 * G + 2.0 / 3.0 * H + eta / dt)
        plastic += flow[:, None] * s / size[:, None]
        kappa += np.sqrt(2.0 / 3.0) * flow
        flowed += (flow > 0.0).sum()
        found = mandel.deviator(state["stress"])
        expected = s - 2.0 * G * flow[:, None] * s / size[:, None]
        np.testing.assert_allclose(found, expected, atol=1e-12 * 1e3)
        np.testing.assert_allclose(state["plastic_strain"], kappa, atol=1e-13)
    assert flowed > COUNT


def test_a_stress_beyond_yield_can_be_begun_with():
    law = VonMises(1e3, 0.3, rho_y=2.0).with_relaxation(TIME)
    stress = np.zeros((1, 3, 3))
    stress[:, 0, 1] = stress[:, 1, 0] = 3.0
    state = law.stressed_state(stress, np.zeros((1, 2, 2)))
    found = law.in_time(TIME).update(np.zeros((1, 2, 2)), state).first_piola
    np.testing.assert_allclose(found[0, 0, 1], (3.0 + np.sqrt(2.0)) / 2.0, rtol=1e-12)


@pytest.mark.parametrize("time", [0.0, -1.0, np.nan])
def test_a_time_must_be_positive(time):
    for law in ("von mises", "tresca", "mohr-coulomb", "cone"):
        with pytest.raises(MPMError, match="relaxation_time is"):
            LAWS[law].with_relaxation(time)
