# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Laws that soften with their plastic strain, by their own or by an average over a length."""

import numpy as np
import pytest
from laws import assert_as_in_python, in_python
from marks import thinned
from materials.test_von_mises import random_path

from mpm_dolfinx import MPMError
from mpm_dolfinx.materials import (
    DruckerPrager,
    Hencky,
    MohrCoulomb,
    SmallStrainVonMises,
    Tresca,
    VonMises,
    check_tangent,
)

COUNT = 30
AVERAGE = np.linspace(0.0, 0.1, COUNT)
FALL = {"decay": 20.0, "cohesion": 0.5}
LAWS = {
    "von mises": VonMises(1e3, 0.3, rho_y=2.0).with_softening(20.0, residual=0.3),
    "hardening too": VonMises(1e3, 0.3, yield_stress=2.0, hardening=20.0).with_softening(
        20.0, residual=0.3
    ),
    "small strain": SmallStrainVonMises(1e3, 0.3, yield_stress=2.0).with_softening(
        20.0, residual=0.3
    ),
    "tresca": Tresca(1e3, 0.3, 2.0, 1.0).with_softening(**FALL),
    "mohr-coulomb": MohrCoulomb(1e3, 0.3, 2.0, 30.0, 10.0).with_softening(
        friction_angle=15.0, **FALL
    ),
    "corrected": MohrCoulomb(
        *(1e3, 0.3, 2.0, 30.0, 10.0, 0.5), volume_correction=True
    ).with_softening(**FALL),
    "sand": MohrCoulomb(1e3, 0.3, 0.0, 30.0, 30.0).with_softening(20.0, friction_angle=15.0),
    "cone": DruckerPrager(1e3, 0.3, 2.0, 30.0, 10.0).with_softening(friction_angle=15.0, **FALL),
    "inner cone": DruckerPrager(1e3, 0.3, 2.0, 30.0, 10.0, match="inner").with_softening(**FALL),
    "plane strain": DruckerPrager(
        *(1e3, 0.3, 2.0, 30.0, 10.0, 0.5), match="plane_strain"
    ).with_softening(**FALL),
}


@pytest.mark.parametrize(
    ("name", "dim"),
    [*thinned(3, [(name, 2) for name in LAWS]), *thinned(7, [(name, 3) for name in LAWS])],
)
def test_tangent_with_an_average_is_the_derivative(name, dim):
    law = LAWS[name].softening_by(AVERAGE)
    assert check_tangent(law, dim, strain=0.05, steps=6) < 1e-8
    assert check_tangent(in_python(law), dim, strain=0.05, steps=6) < 1e-8


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("name", [name for name in LAWS if name != "small strain"])
def test_compiled_update_with_an_average_is_that_of_numpy(name, dim):
    law = LAWS[name].softening_by(AVERAGE)
    assert_as_in_python(law, random_path(COUNT, dim, 5, size=0.03, turn=0.3))


@pytest.mark.parametrize("name", LAWS)
def test_strength_is_that_of_the_end_of_a_step(name):
    law = LAWS[name].softening_by(AVERAGE)
    state = law.initial_state(COUNT, 2)
    for H in random_path(COUNT, 2, 4, size=0.03, turn=0.0):
        before, state = state["plastic_strain"], law.update(H, state).state
    yields = state["plastic_strain"] > before
    assert yields.any()
    f = law.yield_function(state["stress"], state["plastic_strain"])
    size = np.abs(state["stress"]).max(axis=1) + 1.0
    assert np.all(f <= 1e-12 * size)
    assert np.all(f[yields] >= -1e-12 * size[yields])


def sheared(law, shears):
    """Return shear stresses of one point at shear strains one after the other."""
    state, stresses = law.initial_state(1, 2), []
    for shear in shears:
        H = np.zeros((1, 2, 2))
        H[0, 0, 1] = shear
        state = law.update(H, state).state
        stresses.append(float(state["stress"][0, 3]) / np.sqrt(2.0))
    return np.array(stresses), float(state["plastic_strain"][0])


def test_von_mises_softens_to_a_share_of_its_strength():
    law = SmallStrainVonMises(1e3, 0.3, yield_stress=np.sqrt(3.0))
    law = law.with_softening(30.0, residual=0.25)
    stresses, kappa = sheared(law, np.linspace(0.0, 0.4, 4001))
    assert abs(stresses.max() - 1.0) < 1e-12
    assert abs(stresses[-1] - (0.25 + 0.75 * np.exp(-30.0 * kappa))) < 1e-4
    ends, _ = sheared(law.with_parameters(decay=1e4), np.linspace(0.0, 0.4, 401))
    assert abs(ends[-1] - 0.25) < 1e-12


def test_a_point_by_itself_hardens_against_its_average():
    """The strength at 2 k - kappa, with the odd continuation below zero."""
    law = SmallStrainVonMises(1e3, 0.3, yield_stress=np.sqrt(3.0))
    law = law.with_softening(30.0, residual=0.25)
    for average in (0.0, 0.01, 0.2):
        stresses, kappa = sheared(law.softening_by(np.array([average])), [0.01, 0.1])
        driving = 30.0 * (2.0 * average - kappa)
        left = np.exp(-driving) if driving > 0.0 else 2.0 - np.exp(driving)
        assert abs(stresses[-1] - (0.25 + 0.75 * left)) < 1e-12


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"residual": 1.5, "decay": 5.0}, "residual is 1.5"),
        ({"residual": 0.5, "decay": -5.0}, "decay is -5"),
    ],
)
def test_softening_that_makes_no_sense_is_refused(given, words):
    with pytest.raises(MPMError, match=words):
        VonMises(1e3, 0.3, yield_stress=1.0).with_softening(**given)


def pressure_of_sheared_sand(steps, angle=12.0, decay=15.0):
    """Return how far the mean pressure of sand has grown, over its bulk modulus, in shear.

    Its volume is held, so that this is the volume by which it has dilated; and what is exact:
    dv = sqrt(3) sin(psi)/sqrt(1 + sin(psi)^2) dkappa in the plane, up to the last kappa.
    """
    sand = MohrCoulomb(1e4, 0.3, 1.0, friction_angle=35.0, dilation_angle=angle)
    sand = sand.with_softening(decay, dilation_angle=0.0)
    state = sand.stressed_state(-10.0 * np.eye(3)[None], np.zeros((1, 2, 2)))
    for shear in np.linspace(0.0, 1.0, steps + 1)[1:]:
        H = np.array([[[0.0, shear], [0.0, 0.0]]])
        state = sand.update(H, state, tangent=False).state
    grown = -state["stress"][0, :3].sum() / 3.0 - 10.0
    kappa = np.linspace(0.0, state["plastic_strain"][0], 20001)
    sine = np.sin(np.radians(angle) * np.exp(-decay * kappa))
    exact = np.trapezoid(np.sqrt(3.0) * sine / np.sqrt(1.0 + sine**2), kappa)
    return grown / sand.bulk, exact


def test_dilation_that_falls_ends_at_a_volume():
    errors = []
    for steps in (400, 800, 1600):
        found, exact = pressure_of_sheared_sand(steps)
        errors.append(abs(found / exact - 1.0))
    assert errors[-1] < 3e-3 and np.abs(np.log2(np.divide(errors[:-1], errors[1:])) - 1).max() < 0.1
    assert exact == pytest.approx(np.sqrt(3.0) * np.radians(12.0) / 15.0, rel=0.02)


def test_dilation_falls_for_all_that_asks_for_the_law():
    sand = MohrCoulomb(1e4, 0.3, 1.0, friction_angle=35.0, dilation_angle=35.0)
    falls = sand.with_softening(15.0, dilation_angle=5.0)
    assert sand.symmetric and not falls.symmetric
    for law in (falls, falls.with_softening(15.0, friction_angle=30.0)):
        after = law.softened(np.array([0.0, 0.1, 9.0])).parameters["dilation_angle"]
        np.testing.assert_allclose(after, 5.0 + 30.0 * np.exp([0.0, -1.5, -135.0]))
    weak, most = falls.weakened(10.0), np.degrees(np.arctan(np.tan(np.radians(35.0)) / 10.0))
    after = weak.softened(np.ones(1)).parameters["dilation_angle"]
    np.testing.assert_allclose([weak.parameters["dilation_residual"], after[0]], most)
    for law, words in (
        (lambda: falls.softening_by(AVERAGE), "with length= the dilation"),
        (lambda: sand.with_softening(15.0, dilation_angle=36.0), "dilation_residual is larger"),
        (lambda: sand.with_softening(15.0), "Softening needs decay and a residual"),
    ):
        with pytest.raises(MPMError, match=words):
            law()


def test_laws_that_do_not_soften_stay_as_they_are():
    for law in (Hencky(1e3, 0.3), VonMises(1e3, 0.3, yield_stress=1.0)):
        assert not law.softens
        assert law.softening_by(AVERAGE) is law
    assert LAWS["tresca"].softens
