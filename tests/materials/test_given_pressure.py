# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Laws at a given pressure: their own answer to another volume, and its derivatives."""

from copy import copy

import numpy as np
import pytest
from laws import in_python
from materials.test_compiled import COUNT, LAWS

from mpm_dolfinx.errors import DomainDistortionError
from mpm_dolfinx.materials import MohrCoulomb, SmallStrainVonMises, VonMises
from mpm_dolfinx.materials.given_pressure import ALPHA

SHEAR = np.full(COUNT, 400.0)


class Whole(SmallStrainVonMises):
    """A law of small strains that does not say that a pressure can replace its mean stress."""


OTHERS = "hencky", "neo-hooke", "perfect"
SOILS = {name: law for name, law in LAWS.items() if not name.startswith(OTHERS)}
SMALL = Whole(1e3, 0.3, yield_stress=2.0, hardening=50.0)


def moved(law, dim, size=0.02):
    """Return gradient, state and pressure of points with a history that yield, or do not."""
    draw = np.random.default_rng(7)
    before = size * draw.normal(size=(COUNT, dim, dim))
    state = law.update(before, law.initial_state(COUNT, dim)).state
    gradient = before + 0.3 * size * draw.normal(size=before.shape)
    mean = state["stress"][:, :3].mean(axis=1)
    pressure = np.minimum(mean, -0.5) * draw.uniform(0.7, 1.3, COUNT)
    return gradient, state, pressure


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("name", [*SOILS, "small strain"])
def test_the_answer_is_that_to_another_volume(name, dim):
    """The stress is that of the update under a spherical stretch, and its mean the pressure."""
    law = SOILS.get(name, SMALL)
    gradient, state, pressure = moved(law, dim)
    answer = law.at_pressure(gradient, state, pressure, SHEAR)
    stretched = dict(state)
    if law.kinematics == "small":
        stretched["elastic_strain"] = state["elastic_strain"].copy()
        stretched["elastic_strain"][:, :3] -= answer.gap[:, None] / 3.0
    else:
        factor = np.exp(-2.0 / 3.0 * answer.gap)[:, None]
        growth = state["elastic_b_minus_identity"] * factor
        growth[:, :3] += factor - 1.0
        stretched["elastic_b_minus_identity"] = growth
    expected = law.update(gradient, stretched)
    size = np.abs(expected.state["stress"]).max()
    found = answer.state["stress"]
    np.testing.assert_allclose(found, expected.state["stress"], atol=1e-8 * size)
    np.testing.assert_allclose(answer.first_piola, expected.first_piola, atol=1e-8 * size)
    met = found[:, :3].mean(axis=1) - ALPHA * SHEAR * answer.gap
    np.testing.assert_allclose(met, pressure, atol=1e-10 * size)
    for variable in law.internal_variables:
        other = expected.state[variable]
        np.testing.assert_allclose(answer.state[variable], other, rtol=1e-7, atol=1e-10)
    # what is kept of the elastic strain has the volume of the body, less what was plastic
    again = law.at_pressure(gradient, answer.state, pressure, SHEAR)
    at_rest = law.yield_function(
        answer.state["stress"], *(answer.state[v] for v in law.internal_variables)
    )
    has_rates = law.in_time(np.inf) is not law
    if law.kinematics == "logarithmic" and "decay" not in law.parameters and not has_rates:
        scale = 1.0 if "cam" in name else size
        assert at_rest.max() <= 1e-9 * scale
        np.testing.assert_allclose(again.state["stress"], found, atol=1e-6 * size)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("name", [*SOILS, "small strain"])
def test_the_derivatives(name, dim):
    """Differences by F and by the pressure, at points that stay on their side of a kink."""
    law = SOILS.get(name, SMALL)
    gradient, state, pressure = moved(law, dim)
    draw = np.random.default_rng(8)
    along, by, step = draw.normal(size=gradient.shape), draw.normal(size=COUNT), 1e-6
    by *= np.abs(pressure).max()
    middle = law.at_pressure(gradient, state, pressure, SHEAR)
    for dH, dp in ((along, 0.0 * by), (0.0 * along, by)):
        one, two = (
            law.at_pressure(gradient + s * dH, state, pressure + s * dp, SHEAR)
            for s in (step, -step)
        )
        P = np.einsum("niJkL,nkL->niJ", middle.tangent, dH)
        P += dp[:, None, None] * middle.by_pressure
        gap = np.einsum("niJ,niJ->n", middle.slope, dH) - middle.compliance * dp
        stress = (one.first_piola - two.first_piola) / (2.0 * step)
        wrong = np.abs(stress - P).max(axis=(1, 2)) > 1e-5 * np.abs(P).max()
        volume = (one.gap - two.gap) / (2.0 * step)
        wrong |= np.abs(volume - gap) > 1e-5 * np.abs(gap).max()
        assert wrong.sum() <= COUNT // 10  # points at a kink


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("name", SOILS)
def test_compiled_is_numpy(name, dim):
    compiled, reference = SOILS[name], in_python(SOILS[name])
    gradient, state, pressure = moved(compiled, dim)
    one, two = (law.at_pressure(gradient, state, pressure, SHEAR) for law in (compiled, reference))
    for mine, theirs in zip(one[:-1], two[:-1], strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-9 * np.abs(theirs).max())
    for key, values in two.state.items():
        size = np.abs(values).max()
        np.testing.assert_allclose(one.state[key], values, rtol=1e-9, atol=1e-10 * size)


@pytest.mark.parametrize("route", [copy, in_python])
def test_a_pressure_beyond_the_apex(route):
    """The stress is that of the apex, and the volume as large as the augmentation makes it."""
    law = route(MohrCoulomb(1e3, 0.3, 2.0, 30.0))
    state = law.initial_state(COUNT, 2)
    apex, none = 2.0 / np.tan(np.radians(30.0)), np.zeros((COUNT, 2, 2))
    pressure = np.linspace(apex, 2.0 * apex, COUNT)
    answer = law.at_pressure(none, state, pressure, SHEAR)
    stress = answer.state["stress"]
    np.testing.assert_allclose(stress[1:, :3], apex, rtol=1e-9)
    opened = (pressure - apex) / (ALPHA * SHEAR)
    np.testing.assert_allclose(-answer.gap[1:], opened[1:], rtol=1e-6, atol=1e-2)


@pytest.mark.parametrize("route", [copy, in_python])
def test_what_cannot_be_names_its_points(route):
    law = route(VonMises(1e3, 0.3, rho_y=2.0))
    turned = np.zeros((3, 2, 2))
    turned[1, 0, 0] = -2.0
    with pytest.raises(DomainDistortionError) as error:
        law.at_pressure(turned, law.initial_state(3, 2), np.zeros(3), np.ones(3))
    assert list(error.value.particles) == [1]
