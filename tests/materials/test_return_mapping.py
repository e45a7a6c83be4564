# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The general return mapping against closed forms: von Mises and Drucker-Prager."""

from itertools import product

import numpy as np
import pytest
from marks import slow, thinned
from materials.reference import moduli

from mpm_dolfinx.errors import ConvergenceError, DomainDistortionError
from mpm_dolfinx.materials import ReturnMapping, SmallStrainVonMises, VonMises, check_tangent
from mpm_dolfinx.materials.mandel import deviator, deviatoric_projector, identity, norm, trace

YOUNG, POISSON, RHO = 1e3, 0.3, 2.0
K, G = moduli(YOUNG, POISSON)


class Mises(ReturnMapping):
    """Von Mises, with nothing but its yield function, which may have a unit."""

    unit = 1.0

    def __init__(self, young=YOUNG, poisson=POISSON, rho_y=RHO, hardening=0.0):
        super().__init__(young, poisson)
        self.parameters = {**self.parameters, "rho_y": rho_y, "hardening": hardening}

    def rho(self, plastic_strain):
        hardening = np.sqrt(2.0 / 3.0) * self.parameters["hardening"]
        return self.parameters["rho_y"] + hardening * plastic_strain

    def yield_function(self, stress, plastic_strain):
        return self.unit * (norm(deviator(stress)) / self.rho(plastic_strain) - 1.0)


class SmallMises(Mises):
    kinematics = "small"


class StressUnitMises(Mises):
    unit = 1e9


class GradientMises(Mises):
    def yield_gradient(self, stress, plastic_strain):
        s = deviator(stress)
        return s / (norm(s) * self.rho(plastic_strain))[:, None]


class HessianMises(GradientMises):
    def potential_hessian(self, stress, plastic_strain):
        s = deviator(stress)
        size = norm(s)[:, None, None]
        n = s[:, :, None] / size
        projector = deviatoric_projector(stress.shape[1])
        return (projector - n * n.swapaxes(1, 2)) / size / self.rho(plastic_strain)[:, None, None]


class DruckerPrager(ReturnMapping):
    """f = sqrt(|s|^2 + apex^2) + slope tr(stress) - cohesion, its dilation apart.

    The cone is sharp for apex = 0.
    """

    kinematics = "small"

    def __init__(self, slope=0.2, dilation=0.05, cohesion=2.0, apex=0.0, hardening=0.0):
        super().__init__(YOUNG, POISSON)
        self.parameters = {
            **self.parameters,
            "slope": slope,
            "dilation": dilation,
            "cohesion": cohesion,
            "apex": apex,
            "hardening": hardening,
        }

    def cone(self, stress, slope):
        s = deviator(stress)
        size = np.sqrt(np.sum(s * s, axis=1) + self.parameters["apex"] ** 2)
        return size + slope * trace(stress)

    def yield_function(self, stress, plastic_strain):
        p = self.parameters
        return self.cone(stress, p["slope"]) - p["cohesion"] - p["hardening"] * plastic_strain

    def plastic_potential(self, stress, plastic_strain):
        return self.cone(stress, self.parameters["dilation"])


class LogarithmicDruckerPrager(DruckerPrager):
    kinematics = "logarithmic"


class AssociatedDruckerPrager(DruckerPrager):
    """Associated and perfectly plastic: symmetric."""

    symmetric = True
    plastic_potential = ReturnMapping.plastic_potential


def random_strains(n, m, size, seed=0):
    return size * np.random.default_rng(seed).normal(size=(n, m))


def none(n):
    return {"plastic_strain": np.zeros(n)}


@pytest.mark.parametrize(
    ("dim", "hardening", "law"),
    thinned(
        3,
        product(
            [2, 3],
            [0.0, 100.0],
            [Mises, StressUnitMises, GradientMises, HessianMises, SmallMises],
        ),
    ),
)
def test_von_mises_in_closed_form(dim, law, hardening):
    general = law(hardening=hardening)
    closed_law = SmallStrainVonMises if law is SmallMises else VonMises
    closed = closed_law(YOUNG, POISSON, rho_y=RHO, hardening=hardening)
    random = np.random.default_rng(0)
    H, state = np.zeros((200, dim, dim)), closed.initial_state(200, dim)
    for _ in range(4):
        H = H + 2e-3 * random.normal(size=H.shape)
        one, two = general.update(H, state), closed.update(H, state)
        assert set(one.state) == set(two.state)
        for name in two.state:
            scale = np.abs(two.state[name]).max()
            np.testing.assert_allclose(one.state[name], two.state[name], atol=1e-12 * scale)
        np.testing.assert_allclose(one.first_piola, two.first_piola, atol=1e-12 * RHO)
        precision = 1e-12 if issubclass(law, GradientMises) else 1e-10
        np.testing.assert_allclose(one.tangent, two.tangent, atol=precision * YOUNG)
        state = two.state
    assert (state["plastic_strain"] > 0.0).mean() > 0.9


@pytest.mark.parametrize("m", [4, 6])
@pytest.mark.parametrize("law", [DruckerPrager, AssociatedDruckerPrager])
def test_drucker_prager_cone_in_closed_form(m, law):
    """dgamma = f_trial/(2G + 9K slope dilation) where the deviator is large enough for it."""
    material = law()
    slope, flow = 0.2, 0.05 if law is DruckerPrager else 0.2
    trial = random_strains(400, m, 3e-3) - 5e-4 * identity(m)
    stress = K * trace(trial)[:, None] * identity(m) + 2 * G * deviator(trial)
    size = norm(deviator(stress))
    f = size + slope * trace(stress) - 2.0
    multiplier = np.maximum(f, 0.0) / (2 * G + 9 * K * slope * flow)
    cone = 2 * G * multiplier < 0.95 * size
    trial, stress, multiplier = trial[cone], stress[cone], multiplier[cone]
    assert 50 < (multiplier > 0.0).sum() < len(trial)
    answer = material.integrate(trial, none(len(trial)), True)
    direction = deviator(stress) / size[cone][:, None]
    plastic = multiplier[:, None] * (direction + flow * identity(m))
    expected = stress - K * trace(plastic)[:, None] * identity(m) - 2 * G * deviator(plastic)
    np.testing.assert_allclose(answer.stress, expected, atol=1e-12)
    np.testing.assert_allclose(answer.elastic_strain, trial - plastic, atol=1e-15)
    np.testing.assert_allclose(
        answer.variables["plastic_strain"], np.sqrt(2 / 3) * norm(plastic), atol=1e-15
    )
    symmetric = np.allclose(answer.tangent, answer.tangent.swapaxes(1, 2), atol=1e-8 * YOUNG)
    assert symmetric == material.symmetric


def apex_strains(m):
    """Return an elastic, a cone and an apex point."""
    shear = np.zeros((3, m))
    shear[1, 3] = 5e-3
    shear[2, 3] = 1e-6
    shear[2, :3] = 1e-2
    return shear


@pytest.mark.parametrize("m", [4, 6])
def test_sharp_apex_ends_in_a_clear_error(m):
    with pytest.raises(ConvergenceError, match="DruckerPrager failed at 1 of 3 points") as caught:
        DruckerPrager().integrate(apex_strains(m), none(3), True)
    assert caught.value.particles == [2]


@pytest.mark.parametrize("m", [4, 6])
@pytest.mark.parametrize("hardening", [0.0, 10.0])
def test_rounded_apex_returns(m, hardening):
    """The equations of the step are checked with the cone's gradients written out."""
    material = DruckerPrager(apex=0.2, hardening=hardening)
    trial = np.vstack((apex_strains(m), random_strains(300, m, 1e-2)))
    answer = material.integrate(trial, none(len(trial)), True)
    kappa = answer.variables["plastic_strain"]
    f = material.yield_function(answer.stress, kappa)
    s = deviator(answer.stress)
    gradient = s / np.sqrt(norm(s) ** 2 + 0.04)[:, None] + 0.05 * identity(m)
    plastic = trial - answer.elastic_strain
    yields = kappa > 0.0
    multiplier = norm(plastic) / norm(gradient)
    assert np.abs(f[yields]).max() < 1e-12 * YOUNG and f.max() < 1e-12 * YOUNG
    assert yields[2] and not yields[0]
    np.testing.assert_allclose(plastic, multiplier[:, None] * gradient, atol=1e-15)
    np.testing.assert_allclose(kappa, np.sqrt(2 / 3) * norm(plastic), atol=1e-15)
    assert np.isfinite(answer.tangent).all()


@pytest.mark.parametrize("dim", [2, *slow(3)])
@pytest.mark.parametrize(
    "law", [*slow(DruckerPrager, LogarithmicDruckerPrager), AssociatedDruckerPrager]
)
def test_drucker_prager_tangents(dim, law):
    assert check_tangent(law(apex=0.2), dim, strain=1e-2, points=8, steps=2) < 1e-7
    if law is not AssociatedDruckerPrager:
        assert (
            check_tangent(law(apex=0.2, hardening=20.0), dim, strain=1e-2, points=8, steps=2) < 1e-7
        )


@pytest.mark.parametrize(
    ("hardening", "dim"), thinned(3, [(0.0, 3), (0.0, 2), (100.0, 3), (100.0, 2)])
)
def test_von_mises_tangents(dim, hardening):
    assert check_tangent(Mises(hardening=hardening), dim, points=8, steps=2) < 1e-7


def test_parameters_per_point():
    rho = np.linspace(1.0, 4.0, 50)
    H = 5e-3 * np.random.default_rng(3).normal(size=(50, 2, 2))
    general, closed = Mises(rho_y=rho), VonMises(YOUNG, POISSON, rho_y=rho)
    state = closed.initial_state(50, 2)
    one, two = general.update(H, state), closed.update(H, state)
    np.testing.assert_allclose(one.first_piola, two.first_piola, atol=1e-12)
    np.testing.assert_allclose(one.tangent, two.tangent, atol=1e-10 * YOUNG)


def test_given_variables_are_not_modified():
    trial, variables = random_strains(30, 4, 1e-2), none(30)
    before = trial.copy()
    Mises().integrate(trial, variables, True)
    np.testing.assert_array_equal(trial, before)
    np.testing.assert_array_equal(variables["plastic_strain"], 0.0)


def test_a_yield_function_that_is_not_a_number_is_an_error():
    class Broken(Mises):
        def yield_function(self, stress, plastic_strain):
            return super().yield_function(stress, plastic_strain) * np.where(
                np.arange(len(stress)) == 1, np.nan, 1.0
            )

    with pytest.raises(ConvergenceError, match="Broken"):
        Broken().integrate(random_strains(3, 4, 1e-2), none(3), True)


def test_points_that_no_deformation_brings_there_are_named():
    """Inverted, without a volume, crushed to round-off, or no numbers."""
    H = np.zeros((6, 2, 2))
    H[1, 0, 0] = -1.5
    H[2, 1, 1] = -1.0
    H[3, 0, 0] = -1.0 + 1e-12
    H[4, 0, 1] = np.nan
    for which in ([0, 1], [0, 2, 5], [3, 0], [4]):
        with pytest.raises(DomainDistortionError) as caught:
            Mises().update(H[which], Mises().initial_state(len(which), 2))
        assert [which[p] for p in caught.value.particles] == [p for p in which if 0 < p < 5]
    Mises().update(H[[0, 5]], Mises().initial_state(2, 2))
