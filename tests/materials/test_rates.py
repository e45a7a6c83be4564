# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Exact derivatives of compiled laws, against differences of their updates."""

import numpy as np
import pytest
from materials.test_compiled import COUNT, LAWS
from materials.test_von_mises import random_path

from mpm_dolfinx.materials import MohrCoulomb, VonMises
from mpm_dolfinx.materials.compiled import Taken

LAWS = LAWS | {
    "lagging metal": VonMises(1e3, 0.3, 3.0, hardening=50.0).with_relaxation(0.2).in_time(0.1),
    "lagging soil": MohrCoulomb(1e3, 0.3, 1.0, 30.0, 10.0).with_relaxation(0.2).in_time(0.1),
}
#: Differences that see the next branch of a law are told by a smaller one.
CHANGES = 1e-6, 1e-8


def stepped(law, dim, size=0.05):
    """A step of points with a history, and random rates of all that its update takes."""
    state = law.initial_state(COUNT, dim)
    first, second = random_path(COUNT, dim, 2, size=size, turn=0.3)
    state = law.update(first, state).state
    random = np.random.default_rng(7)
    rates = Taken(
        random.standard_normal(first.shape),
        {
            name: random.standard_normal(v.shape) * max(np.abs(v).max(), 0.1)
            for name, v in state.items()
        },
        np.zeros((1, len(law.numbers(state)))),
    )
    return second, state, rates


def beside(law, H, state, rates, amount):
    """The answer with all that an update takes moved along its rates."""
    moved = {name: values + amount * rates.state[name] for name, values in state.items()}
    return law.update(H + amount * rates.gradient, moved, tangent=False)


def weighed(law, H, state):
    """Random derivatives by what an update gives, those by what it takes, and their products."""
    random = np.random.default_rng(3)
    now = law.update(H, state, tangent=False)
    work = random.standard_normal(H.shape)
    weights = {
        key: random.standard_normal(values.shape) / max(np.abs(values).max(), 1e-3)
        for key, values in now.state.items()
    }

    def product(answer):
        return dotted(work, answer.first_piola) + sum(
            dotted(weights[key], values) for key, values in answer.state.items()
        )

    return law.pull(H, state, work, weights), product


def dotted(one, other):
    return (one * other).reshape(COUNT, -1).sum(axis=1)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("name", LAWS)
def test_derivatives_by_strain_and_history_are_those_of_differences(name, dim):
    law = LAWS[name]
    H, state, rates = stepped(law, dim)
    pulled, product = weighed(law, H, state)
    found = dotted(pulled.gradient, rates.gradient)
    found += sum(dotted(pulled.state[key], rates.state[key]) for key in pulled.state)
    errors = []
    for change in CHANGES:
        a, b = (beside(law, H, state, rates, sign * change) for sign in (1.0, -1.0))
        difference = (product(a) - product(b)) / (2.0 * change)
        errors.append(np.abs(found - difference) / np.abs(difference).max())
    assert np.min(errors, axis=0).max() < 1e-6
    assert np.median(errors[0]) < 1e-8


@pytest.mark.parametrize("name", LAWS)
def test_derivatives_by_parameters_are_those_of_differences(name):
    law = LAWS[name]
    H, state, _ = stepped(law, 2)
    pulled, product = weighed(law, H, state)
    for parameter, value in law.parameters.items():
        change = 1e-6 * np.max(np.abs(value))
        if change == 0.0 or (parameter == "tension_cutoff" and not np.all(np.isfinite(value))):
            continue
        a, b = (law.with_parameters(**{parameter: value + s * change}) for s in (1.0, -1.0))
        plus, minus = a.numbers(state), b.numbers(state)
        ways = np.subtract(plus, minus, where=plus != minus, out=np.zeros_like(plus))
        found = (pulled.numbers * (ways / (2.0 * change)).T).sum(axis=1)
        a, b = (product(one.update(H, state, tangent=False)) for one in (a, b))
        difference = (a - b) / (2.0 * change)
        gap = np.abs(found - difference)
        assert np.quantile(gap, 0.9) <= 1e-6 * np.abs(difference).max(), parameter  # (or a branch)
