# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""check_tangent finds what is wrong; parameters are checked and follow their points."""

import numpy as np
import pytest

from mpm_dolfinx.errors import MPMError
from mpm_dolfinx.materials import (
    Hencky,
    LinearElastic,
    Material,
    SmallStrainVonMises,
    Update,
    VonMises,
    check_tangent,
    mandel,
)


class Wrong(VonMises):
    """A tangent that is off by one per cent."""

    def update(self, displacement_gradient, state, tangent=True):
        answer = super().update(displacement_gradient, state, tangent)
        return answer if answer.tangent is None else answer._replace(tangent=1.01 * answer.tangent)


class Continuum(VonMises):
    """The rate's tangent: the secant part of the consistent one is missing."""

    symmetric = False

    def integrate(self, trial_strain, variables, tangent):
        answer = super().integrate(trial_strain, variables, tangent)
        if not tangent:
            return answer
        s = mandel.deviator(answer.stress)
        n = s / mandel.norm(s)[:, None]
        D = np.array(self.elastic_tangent(*trial_strain.shape))
        plastic = answer.variables["plastic_strain"] > variables["plastic_strain"]
        D[plastic] -= 2.0 * self.shear * n[plastic, :, None] * n[plastic, None, :]
        return answer._replace(tangent=D)


class Careless(SmallStrainVonMises):
    """Writes into the state that it was given."""

    def update(self, displacement_gradient, state, tangent=True):
        answer = super().update(displacement_gradient, state, tangent)
        state["plastic_strain"][:] = answer.state["plastic_strain"]
        return answer


class Follower(Material):
    """A pressure p = stiffness (det F - 1) written straight in F, plane strain only."""

    symmetric = True

    def __init__(self, stiffness, error=0.0):
        self.parameters = {"stiffness": stiffness}
        self.error = error

    def initial_state(self, n, dim):
        return {"stress": np.zeros((n, mandel.num_components(dim)))}

    def update(self, displacement_gradient, state, tangent=True):
        F = np.eye(2) + displacement_gradient
        k = self.parameters["stiffness"]
        spin = np.array([[0.0, 1.0], [-1.0, 0.0]])
        J, cofactor = np.linalg.det(F), spin @ F @ spin.T
        A = k * np.einsum("niJ,nkL->niJkL", cofactor, cofactor)
        A += k * (J - 1.0)[:, None, None, None, None] * np.einsum("ik,JL->iJkL", spin, spin)
        A[:, 0, 1, 1, 0] += self.error * k
        pressure = (k * (J - 1.0))[:, None] * mandel.identity(4)
        P = k * (J - 1.0)[:, None, None] * cofactor
        return Update(P, A if tangent else None, {"stress": pressure})

    def cauchy_stress(self, displacement_gradient, state):
        return mandel.to_tensor(state["stress"])


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("law", [Wrong, Continuum])
def test_wrong_tangents_are_found(dim, law):
    with pytest.raises(MPMError, match=f"tangent of {law.__name__} differs"):
        check_tangent(law(1.0, 0.3, rho_y=1e-3), dim)


def test_a_modified_state_is_found():
    with pytest.raises(MPMError, match="modified the state"):
        check_tangent(Careless(1.0, 0.3, rho_y=1e-3))


def test_a_material_of_ones_own():
    assert check_tangent(Follower(2.0)) < 1e-7
    with pytest.raises(MPMError, match="claims a symmetric tangent"):
        check_tangent(Follower(2.0, error=1e-3))


def test_a_missing_tangent_is_found():
    class Lazy(Hencky):
        def update(self, displacement_gradient, state, tangent=True):
            return super().update(displacement_gradient, state, tangent=False)

    with pytest.raises(MPMError, match="no tangent"):
        check_tangent(Lazy(1.0, 0.3))


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"young": 0.0}, "young is 0 but must be finite, greater than 0"),
        ({"young": np.inf}, "young is inf"),
        ({"young": "stiff"}, "young must be a finite number"),
        ({"young": np.ones((2, 2))}, "young must be a finite number, one number per point"),
        ({"young": np.array([1.0, -2.0])}, "young is -2"),
        ({"poisson": 0.5}, "poisson is 0.5 but must be .*greater than -1, less than 0.5"),
        ({"poisson": -1.0}, "poisson is -1"),
        ({"rho_y": 0.0}, "rho_y is 0"),
        ({"rho_y": None, "yield_stress": -3.0}, "yield_stress is -3"),
        ({"hardening": -1.0}, "hardening is -1 but must be finite, at least 0"),
        ({"rho_y": None}, "exactly one of rho_y and yield_stress"),
        ({"yield_stress": 1.0}, "exactly one of rho_y and yield_stress"),
    ],
)
def test_bad_parameters(arguments, message):
    with pytest.raises(MPMError, match=message):
        law = VonMises(**{"young": 1.0, "poisson": 0.3, "rho_y": 1.0, **arguments})
        law.initial_state(2, 2)  # an array of one rank is refused when it is used


@pytest.mark.parametrize("law", [VonMises, SmallStrainVonMises])
def test_parameters_per_point(law):
    n = 40
    young, rho = np.linspace(1.0, 3.0, n), np.linspace(1e-3, 5e-3, n)
    H = 5e-3 * np.random.default_rng(0).normal(size=(n, 2, 2))
    material = law(young, 0.3, rho_y=rho, hardening=np.linspace(0.0, 0.1, n))
    assert check_tangent(material) < 1e-6
    together = material.update(H, material.initial_state(n, 2))
    for p in (0, 7, 39):
        alone = law(young[p], 0.3, rho_y=rho[p], hardening=0.1 * p / (n - 1))
        answer = alone.update(H[p : p + 1], alone.initial_state(1, 2))
        np.testing.assert_allclose(together.tangent[p], answer.tangent[0], rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(together.first_piola[p], answer.first_piola[0], rtol=1e-12)


def test_material_restricted_to_points():
    material = LinearElastic(np.array([1.0, 2.0, 3.0]), 0.3)
    some = material.at(np.array([2, 0]))
    np.testing.assert_array_equal(some.parameters["young"], [3.0, 1.0])
    assert some.parameters["poisson"] == 0.3
    np.testing.assert_array_equal(material.parameters["young"], [1.0, 2.0, 3.0])
    scalar = Hencky(1.0, 0.3)
    assert scalar.at(np.array([1])) is scalar


def test_a_function_stays_until_its_values_are_put_in_its_place():
    class Vector:
        array = np.array([1.0, 2.0])

    class Function:
        x = Vector()

    field = Function()
    material = VonMises(field, 0.3, yield_stress=field)
    assert material.parameters["young"] is field
    there = material.with_parameters(young=np.array([1.0, 2.0]), yield_stress=np.ones(2))
    np.testing.assert_allclose(there.rho_y, np.sqrt(2.0 / 3.0))
    assert check_tangent(there, strain=10.0 * 0.1) < 1e-6
    Vector.array = np.array([1.0, -2.0])
    with pytest.raises(MPMError, match="young is -2"):
        VonMises(field, 0.3, rho_y=1.0)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"material": "steel"}, "needs a material, not 'steel'"),
        ({"dim": 4}, "dim must be a whole number from 2 to 3, not 4"),
        ({"seed": -1}, "seed must be a whole number from 0 on, not -1"),
        ({"points": 0}, "points must be a whole number from 1 on, not 0"),
        ({"steps": 0}, "steps must be a whole number from 1 on, not 0"),
        ({"steps": True}, "steps must be .* not True"),
        ({"strain": -0.1}, "strain must be a positive number"),
        ({"strain": [0.1]}, "strain must be a positive number"),
        ({"rotation": np.nan}, "rotation must be a finite number"),
        ({"tolerance": np.inf}, "tolerance must be a positive number"),
    ],
)
def test_a_check_of_nothing_is_refused(options, sentence):
    with pytest.raises(MPMError, match=sentence):
        check_tangent(**{"material": Hencky(1e3, 0.3)} | options)
