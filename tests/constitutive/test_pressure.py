# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A pressure in place of a mean stress, against differences and NumPy."""

import numpy as np
import pytest

from mpm_dolfinx.constitutive.pressure import slope_of_volume, with_pressure, without_bulk
from mpm_dolfinx.materials import Hencky, LinearElastic

COUNT = 7


def answered(law, dim):
    """Return the answer of a law without its bulk modulus to some strains, and that modulus."""
    soft, _, bulk = without_bulk(law)
    gradient = 0.2 * np.random.default_rng(3).uniform(-1.0, 1.0, (COUNT, dim, dim))
    answer = soft.update(gradient, soft.initial_state(COUNT, dim))
    stress = answer.state["stress"]
    return (gradient, answer.first_piola, answer.tangent, stress), np.full(COUNT, bulk)


def by_numpy(gradient, first_piola, tangent, stress, pressure, bulk, small):
    """Return what ``with_pressure`` does, for all points at once."""
    mean = stress[:, :3].sum(axis=1) / 3.0
    change = pressure - mean
    slope = slope_of_volume(gradient, small)
    turning = np.where(small, 0.0, change)[:, None, None, None, None]
    product = slope[:, :, :, None, None] * slope[:, None, None, :, :]
    whole = tangent - bulk[:, None, None, None, None] * product
    whole -= turning * product.swapaxes(2, 4)
    own = stress.copy()
    own[:, :3] += change[:, None]
    return first_piola + change[:, None, None] * slope, whole, own, mean / bulk, slope


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("law", [Hencky(3.0, 0.4), LinearElastic(3.0, 0.4)], ids=["large", "small"])
def test_compiled_is_numpy(law, dim):
    answer, bulk = answered(law, dim)
    small = np.full(COUNT, isinstance(law, LinearElastic))
    pressure = np.linspace(-1.0, 2.0, COUNT)
    given = [values.copy() for values in answer]
    fast = with_pressure(answer, pressure, bulk, small)
    plain = by_numpy(*answer, pressure, bulk, small)
    for one, other in zip(fast, plain, strict=True):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-14 * np.abs(other).max())
    for before, after in zip(given, answer, strict=True):
        assert np.array_equal(before, after)  # a law may keep what it has answered


def test_the_volume_strain_and_the_mean_stress():
    """``theta = ln J``, the mean of the stress is p, and a step in F changes theta by its slope."""
    (gradient, *_), _ = answered(Hencky(3.0, 0.4), 2)
    pressure = np.linspace(-1.0, 2.0, COUNT)
    found = []
    for moved in (0.0, 1e-6):
        changed = gradient.copy()
        changed[:, 0, 1] += moved
        law, _, bulk = without_bulk(Hencky(3.0, 0.4))
        answer = law.update(changed, law.initial_state(COUNT, 2))
        parts = (changed, answer.first_piola, answer.tangent, answer.state["stress"])
        small = np.zeros(COUNT, dtype=bool)
        found.append(with_pressure(parts, pressure, np.full(COUNT, bulk), small))
    before, after = found
    J = np.linalg.det(gradient + np.eye(2))
    np.testing.assert_allclose(before.volume, np.log(J), atol=1e-14)
    np.testing.assert_allclose(before.stress[:, :3].mean(axis=1), pressure, atol=1e-13)
    slope = (after.volume - before.volume) / 1e-6
    np.testing.assert_allclose(before.slope[:, 0, 1], slope, atol=1e-5)
    by_strain = (after.first_piola - before.first_piola) / 1e-6
    np.testing.assert_allclose(before.tangent[:, :, :, 0, 1], by_strain, atol=1e-4)
