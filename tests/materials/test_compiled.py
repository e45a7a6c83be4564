# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The compiled updates against NumPy's."""

import contextlib
import copy
import functools
import inspect
import types

import numpy as np
import pytest
import scenes
from laws import in_python
from marks import slow
from materials.test_von_mises import random_path

import mpm_dolfinx.materials
from mpm_dolfinx import DomainDistortionError, MPMError
from mpm_dolfinx._core import loops
from mpm_dolfinx.materials import (
    DruckerPrager,
    Hencky,
    ModifiedCamClay,
    MohrCoulomb,
    MuIRheology,
    NeoHooke,
    Tresca,
    VonMises,
)
from mpm_dolfinx.materials.compiled import BY_HEART, CompiledMaterial
from mpm_dolfinx.materials.softening import SofteningMaterial

RETURNS = (CompiledMaterial.integrate, SofteningMaterial.integrate, MuIRheology.integrate)
COUNT = 50
SPREAD = np.linspace(1.0, 2.0, COUNT)
LAWS = {
    "hencky": Hencky(1e3, 0.3),
    "hencky by point": Hencky(1e3 * SPREAD, 0.2 * SPREAD),
    "neo-hooke": NeoHooke(1e3, 0.3),
    "neo-hooke by point": NeoHooke(1e3 * SPREAD, 0.2 * SPREAD),
    "perfect": VonMises(1e3, 0.3, rho_y=2.0),
    "hardening by point": VonMises(
        1e3 * SPREAD, 0.49, yield_stress=2.0 * SPREAD, hardening=50.0 * SPREAD
    ),
    "tresca": Tresca(1e3, 0.3, 2.0),
    "mohr-coulomb": MohrCoulomb(1e3, 0.3, 2.0, 30.0, 10.0),
    "mohr-coulomb without cohesion": MohrCoulomb(1e3, 0.3, 0.0, 30.0),
    "mohr-coulomb by point, cut off": MohrCoulomb(
        1e3 * SPREAD, 0.3, 2.0 * SPREAD, 20.0 * SPREAD, 5.0 * SPREAD, tension_cutoff=SPREAD
    ),
    "cam clay": ModifiedCamClay(0.2, 0.04, 1.2, 300.0, 20.0, 5.0),
    "cam clay by point": ModifiedCamClay(0.2, 0.04, SPREAD, 300.0, 20.0 * SPREAD, 10.0 * SPREAD),
    "mohr-coulomb, corrected and softening by point": MohrCoulomb(
        *(1e3, 0.3, 2.0 * SPREAD, 20.0 * SPREAD, 5.0 * SPREAD, 0.5 * SPREAD),
        volume_correction=True,
    ).with_softening(10.0 * SPREAD, cohesion=SPREAD, friction_angle=2.0),
    "drucker-prager, corrected and softening": DruckerPrager(
        *(1e3, 0.3, 2.0, 30.0, 10.0), volume_correction=True
    ).with_softening(20.0, cohesion=0.5),
    "mu(i)": MuIRheology(1e3, 0.3, 0.4, 0.7, 0.02, 3.0).in_time(0.01),
    "mu(i) by point, without rates": MuIRheology(1e3, 0.3, 0.4, 0.7 * SPREAD, 0.02, 3.0),
    "mu(i) by point": MuIRheology(
        1e3 * SPREAD, 0.3, 0.4, 0.7 * SPREAD, 0.02 * SPREAD, 3.0 * SPREAD, 0.3 * SPREAD
    ).in_time(1e-4),
    "drucker-prager": DruckerPrager(1e3, 0.3, 2.0, 30.0, 10.0, match="plane_strain"),
    "drucker-prager without cohesion": DruckerPrager(1e3, 0.3, 0.0, 30.0),
    "drucker-prager by point, cut off": DruckerPrager(
        1e3 * SPREAD, 0.3, 2.0 * SPREAD, 20.0 * SPREAD, 5.0 * SPREAD, tension_cutoff=SPREAD
    ),
}


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("size", [*slow(1e-10), 1e-3, 0.1])
def test_compiled_update_is_that_of_numpy(law, dim, size):
    compiled, reference = LAWS[law], in_python(LAWS[law])
    state = compiled.initial_state(COUNT, dim)
    turn = 0.3 if size > 1e-6 else 0.0
    for H in random_path(COUNT, dim, 4, size=size, turn=turn):
        H[0] = 0.0
        H[1] = 0.05 * np.eye(dim)
        H[2] = -0.05 * np.eye(dim)
        mine, theirs = compiled.update(H, state), reference.update(H, state)
        assert mine.state.keys() == theirs.state.keys()
        pairs = [(mine.first_piola, theirs.first_piola), (mine.tangent, theirs.tangent)]
        pairs += [(mine.state[name], theirs.state[name]) for name in mine.state]
        for a, b in pairs:
            np.testing.assert_allclose(a, b, rtol=0.0, atol=2e-13 * np.abs(b).max())
        assert compiled.update(H, state, tangent=False).tangent is None
        state = theirs.state


@pytest.mark.parametrize("law", [*LAWS, "fracture"])
def test_updates_do_not_read_the_stress_of_the_step_before(law):
    """What goes back through a run keeps no stress, see ``Governed.memory``."""
    fracture = mpm_dolfinx.materials.Fracture(Hencky(1e3, 0.3), 1.0, 0.1)
    compiled = LAWS.get(law, fracture)
    for one in (compiled, in_python(compiled)) if law in LAWS else (fracture,):
        state = one.initial_state(COUNT, 2)
        for H in random_path(COUNT, 2, 2, size=0.05):
            unknown = state | {"stress": np.full_like(state["stress"], np.nan)}
            mine, theirs = one.update(H, unknown), one.update(H, state)
            np.testing.assert_array_equal(mine.first_piola, theirs.first_piola)
            np.testing.assert_array_equal(mine.tangent, theirs.tangent)
            for name, values in theirs.state.items():
                np.testing.assert_array_equal(mine.state[name], values)
            state = theirs.state


@pytest.mark.parametrize("dim", [2, 3])
def test_derived_laws_keep_their_own_integration(dim):
    class Doubled(Hencky):
        def integrate(self, trial_strain, variables, tangent):
            return super().integrate(2.0 * trial_strain, variables, tangent)

    H = random_path(5, dim, 1, size=0.1)[0]
    plain, doubled = (law(1e3, 0.3).update(H, {}).state["stress"] for law in (Hencky, Doubled))
    np.testing.assert_allclose(doubled, 2.0 * plain, rtol=1e-12)


@pytest.mark.parametrize("law", ["hencky", "perfect"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0, -2.0])
def test_impossible_deformations_are_named(law, bad):
    H = np.zeros((COUNT, 2, 2))
    H[[3, 7], 0, 0] = bad
    with pytest.raises(DomainDistortionError) as caught:
        LAWS[law].update(H, LAWS[law].initial_state(COUNT, 2))
    assert list(caught.value.particles) == [3, 7]


def test_unknown_laws_are_refused():
    H, empty = np.zeros((3, 2, 2)), np.empty(0)
    with pytest.raises(ValueError, match="no compiled law rubber"):
        loops.update_plastic("rubber", H, H, H, [], [], empty, 0.0, H, empty, empty, empty, [])
    with pytest.raises(ValueError, match="parameters of the law"):
        loops.update_plastic("von_mises", H, H, H, [], [], empty, 0.0, H, empty, empty, empty, [])


def test_shapes_that_do_not_fit_are_refused():
    H = np.zeros((3, 2, 2))
    empty = np.empty(0)
    with pytest.raises(ValueError, match="one parameter"):
        loops.update_elastic("hencky", H, [np.ones(2), np.ones(1)], H, empty, empty)


def test_a_gradient_that_may_be_written_to_is_copied():
    """What is read-only is given away, as by the points of a body; what one may change is not."""
    law = VonMises(1e3, 0.3, rho_y=10.0)
    H = np.full((3, 2, 2), 0.01)
    own = law.update(H, law.initial_state(3, 2)).state["displacement_gradient"]
    H[:] = 0.5
    np.testing.assert_array_equal(own, 0.01)
    H.flags.writeable = False
    given = law.update(H, law.initial_state(3, 2)).state["displacement_gradient"]
    assert np.shares_memory(given, H)


def test_an_heir_that_overrides_anything_has_no_compiled_update(monkeypatch):
    # Any use of other loops than those of the return is an error.
    alone = types.SimpleNamespace(integrate=loops.integrate)
    monkeypatch.setattr(mpm_dolfinx.materials.compiled, "loops", alone)
    H = 1e-3 * np.random.default_rng(1).normal(size=(COUNT, 2, 2))
    every = {type(law): law for law in LAWS.values()}
    known = {law for law in vars(mpm_dolfinx.materials).values() if "_loop" in vars_of(law)}
    assert known == set(every)
    for law, made in every.items():
        state, new = made.initial_state(COUNT, 2), type("New", (law,), {"colour": "red"})
        for its in (law, new):
            with pytest.raises(AttributeError, match=r"update_(elastic|plastic)"):
                as_a(its, made).update(H, state)
        for name in dir(law):
            if not name.startswith("__") and name not in ("_abc_impl", "_loop"):
                heir = type("Heir", (law,), {name: inspect.getattr_static(law, name)})
                known_by_heart = name in BY_HEART and law.integrate in RETURNS
                told = pytest.raises(MPMError, match=f"overrides {name} of {law.__name__}")
                with told if known_by_heart else contextlib.nullcontext():
                    as_a(heir, made).update(H, state)
    own = as_a(VonMises, LAWS["perfect"])
    own.integrate = functools.partial(VonMises.integrate, own)
    own.update(H, own.initial_state(COUNT, 2))


def test_an_heir_with_a_strength_of_its_own_is_refused_in_a_problem():
    class Stronger(VonMises):
        def strength(self, plastic_strain):
            return 2.0 * super().strength(plastic_strain)

    problem = scenes.block(Stronger(1e3, 0.3, rho_y=2.0), force=(0.0, -2.0))
    with pytest.raises(MPMError, match="whose return does not ask it; override integrate"):
        problem.solve(steps=1)


def vars_of(one):
    return vars(one) if isinstance(one, type) else ()


def as_a(law, made):
    """Return a law as one of another class."""
    other = copy.copy(made)
    other.__class__ = law
    return other
