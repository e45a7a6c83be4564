# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Points that carry a stress where their body is undeformed."""

import copy
from itertools import product

import numpy as np
import pytest
from laws import in_python
from marks import thinned
from materials.reference import rotation
from materials.test_cam_clay import clay
from materials.test_frictional import LAWS as FRICTIONAL
from materials.test_return_mapping import HessianMises, SmallMises

from mpm_dolfinx.errors import MPMError
from mpm_dolfinx.materials import (
    Hencky,
    LinearElastic,
    Material,
    NeoHooke,
    SmallStrainVonMises,
    VonMises,
    check_tangent,
    mandel,
)

LAWS = {
    "linear": LinearElastic(1e4, 0.3),
    "hencky": Hencky(1e4, 0.3),
    "neo-hooke": NeoHooke(1e4, 0.3),
    "von mises": VonMises(1e4, 0.3, rho_y=20.0),
    "small von mises": SmallStrainVonMises(1e4, 0.3, rho_y=20.0),
    "return mapping": HessianMises(rho_y=20.0),
    "small return mapping": SmallMises(rho_y=20.0),
    "clay": clay(3.0),
    **{name: law for name, law in FRICTIONAL.items() if "no cohesion" not in name},
}


def pressures(n, dim, K0=0.6, largest=20.0):
    """Return stresses (n, 3, 3) of level ground, with axes that are turned."""
    depth = np.linspace(0.1, 1.0, n)[:, None, None] * largest
    stress = -depth * np.diag([K0, 1.0, K0])
    Q = rotation(0.4, (1.0, 2.0, 3.0) if dim == 3 else (0.0, 0.0, 1.0))
    return Q @ stress @ Q.T


def unmoved(stress, dim):
    """Return the displacement gradients of points that have a stress and have not moved."""
    return np.zeros((len(stress), dim, dim))


@pytest.mark.parametrize(
    ("law", "dim", "route"), thinned(3, product(LAWS, [2, 3], [copy.copy, in_python]))
)
def test_the_stress_is_that_which_was_asked_for(law, dim, route):
    material, stress = route(LAWS[law]), pressures(9, dim)
    state = material.stressed_state(stress, unmoved(stress, dim))
    H = np.zeros((9, dim, dim))
    answer = material.update(H, state)
    np.testing.assert_allclose(answer.first_piola, stress[:, :dim, :dim], atol=1e-11)
    np.testing.assert_allclose(material.cauchy_stress(H, answer.state), stress, atol=1e-11)
    np.testing.assert_allclose(material.cauchy_stress(H, state), stress, atol=1e-11)
    assert answer.state.keys() == state.keys()
    assert not answer.state.get("plastic_strain", np.zeros(1)).any()
    # What comes after depends on it.
    bent = 1e-4 * np.random.default_rng(0).normal(size=H.shape)
    with_stress = material.update(bent, answer.state)
    A, P = answer.tangent, with_stress.first_piola
    linear = answer.first_piola + np.einsum("niJkL,nkL->niJ", A, bent)
    assert np.abs(P - linear).max() < 2e-2 * np.abs(P - answer.first_piola).max()


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("law", ["hencky", "von mises", "dilation", "cone", "clay"])
def test_tangents_with_an_initial_stress(law, dim):
    kind = type(LAWS[law])

    class Stressed(kind):
        __init__ = None
        begun = False

        def initial_state(self, n, dim):
            if self.begun:
                return super().initial_state(n, dim)
            self.begun = True
            return self.stressed_state(pressures(n, dim), np.zeros((n, dim, dim)))

    material = copy.copy(LAWS[law])
    material.__class__ = Stressed
    assert check_tangent(material, dim, strain=1e-2, points=20) < 1e-6


@pytest.mark.parametrize("law", ["von mises", "dilation", "cone", "cut", "clay", "tresca"])
def test_a_stress_beyond_yield_is_refused(law):
    stress = pressures(5, 2)
    stress[[1, 4]] = np.diag([900.0, -900.0, 0.0])
    with pytest.raises(MPMError, match="cannot bear the initial stress of 2 of 5") as caught:
        LAWS[law].stressed_state(stress, unmoved(stress, 2))
    assert list(caught.value.particles) == [1, 4]


def test_clay_bears_no_tension_and_sand_none_without_cohesion():
    stress = np.broadcast_to(np.eye(3), (2, 3, 3))
    for material in (clay(), FRICTIONAL["no cohesion"], FRICTIONAL["no tension"]):
        with pytest.raises(MPMError, match="cannot bear the initial stress of 2 of 2"):
            material.stressed_state(stress, unmoved(stress, 3))


def test_stresses_of_another_kind_are_refused():
    material = LAWS["hencky"]
    out_of_plane, skew = np.zeros((1, 3, 3)), np.zeros((1, 3, 3))
    out_of_plane[0, 0, 2] = out_of_plane[0, 2, 0] = 1.0
    with pytest.raises(MPMError, match="out of the plane"):
        material.stressed_state(out_of_plane, unmoved(out_of_plane, 2))
    material.stressed_state(out_of_plane, unmoved(out_of_plane, 3))
    skew[0, 0, 1] = 1.0
    with pytest.raises(MPMError, match="cannot bear"):
        material.stressed_state(skew, unmoved(skew, 3))
    with pytest.raises(MPMError, match="cannot bear"):
        material.stressed_state(np.full((1, 3, 3), np.nan), np.zeros((1, 3, 3)))

    class Own(Material):
        symmetric = True
        initial_state = update = cauchy_stress = None

    with pytest.raises(MPMError, match="Own cannot begin with a stress"):
        Own().stressed_state(skew, unmoved(skew, 3))


def test_the_state_of_no_points_and_of_the_stress_itself():
    state = LAWS["clay"].stressed_state(np.zeros((0, 3, 3)), np.zeros((0, 2, 2)))
    assert state["stress"].shape == (0, mandel.num_components(2))
    state = clay().stressed_state(-100.0 * np.eye(3)[None], np.zeros((1, 3, 3)))
    np.testing.assert_allclose(state["elastic_b_minus_identity"], 0.0, atol=1e-15)
