# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Modified Cam clay against closed forms of critical state soil mechanics, and differences."""

from itertools import product

import numpy as np
import pytest
import returns
from marks import thinned
from materials.reference import rotation
from materials.test_von_mises import random_path
from scenes import QUADRILATERAL, at, box, fix, vectors
from scipy.optimize import brentq

import mpm_dolfinx as mpm
from mpm_dolfinx.errors import MPMError
from mpm_dolfinx.materials import ModifiedCamClay, check_tangent, mandel

LAMBDA, KAPPA, M, G, P0 = 0.2, 0.04, 1.2, 3e3, 100.0
RATIO = 1.0 - KAPPA / LAMBDA


def clay(overconsolidation=1.0, **options):
    arguments = {
        "compression": LAMBDA,
        "swelling": KAPPA,
        "critical_ratio": M,
        "shear_modulus": G,
        "preconsolidation": overconsolidation * P0,
        "reference_pressure": P0,
    }
    return ModifiedCamClay(**{**arguments, **options})


def overconsolidated(ratio, **options):
    """Return that clay with a p_c in proportion to its first stress."""
    numbers = {"reference_pressure": P0, "overconsolidation": ratio} | options
    return ModifiedCamClay(LAMBDA, KAPPA, M, G, **numbers)


def invariants(state):
    """Return p and q of states."""
    stress = state["stress"]
    return -mandel.trace(stress) / 3.0, np.sqrt(1.5) * mandel.norm(mandel.deviator(stress))


def moved(material, strains, state):
    """Return the answer to principal logarithmic strains (3,) of one point."""
    return material.update(np.diag(np.expm1(strains))[None], state, tangent=False).state


@pytest.mark.parametrize(
    ("overconsolidation", "dim"), thinned(3, product([1.0, 2.5, 10.0], [2, 3]))
)
def test_random_paths(overconsolidation, dim):
    material = clay(overconsolidation)
    for strain in (1e-2, 2e-1):
        assert check_tangent(material, dim, strain=strain, points=500, steps=3) < 1e-6
    state, turned = material.initial_state(1000, dim), material.initial_state(1000, dim)
    axis = (1.0, 2.0, -1.0) if dim == 3 else (0.0, 0.0, 1.0)
    for step, H in enumerate(random_path(1000, dim, 6, seed=dim, size=3e-2, turn=0.3), 1):
        frame = material._kinematics(H, state)
        variables = {name: state[name] for name in material.internal_variables}
        answer = material.integrate(frame.trial_strain, variables, False)
        flow = frame.trial_strain - answer.elastic_strain
        assert np.einsum("ni,ni->n", answer.stress, flow).min() >= -1e-12 * P0 * np.abs(flow).max()
        update = material.update(H, state)
        R = rotation(0.9 * step, axis)[:dim, :dim]
        other = material.update(R @ (np.eye(dim) + H) - np.eye(dim), turned)
        size = np.abs(update.first_piola).max()
        assert np.abs(other.first_piola - R @ update.first_piola).max() < 1e-10 * size
        yields = update.state["plastic_strain"] > state["plastic_strain"]
        state, turned = update.state, other.state
        f = material.yield_function(
            state["stress"], state["plastic_strain"], state["preconsolidation"]
        )
        assert f.max() < 1e-9 and np.abs(f[yields]).max() < 1e-9
    assert yields.mean() > 0.2


def test_bounded_search_finds_what_newton_finds(monkeypatch):
    random = np.random.default_rng(0)
    volume, shape = 0.1 * random.normal(size=300), 0.05 * np.abs(random.normal(size=300))
    material = clay(2.0)
    strain = np.zeros((300, 6))
    strain[:, :3] = -volume[:, None] / 3.0
    strain[:, 3] = np.sqrt(1.5) * shape
    variables = {"plastic_strain": np.zeros(300), "preconsolidation": np.full(300, 200.0)}
    newton = material.integrate(strain, variables, False)
    assert (newton.variables["plastic_strain"] > 0.0).sum() > 200
    monkeypatch.setattr(returns, "STEPS", 0)
    search = returns.integrate(material, strain, variables, False)
    np.testing.assert_allclose(search.stress, newton.stress, rtol=1e-10, atol=1e-8)


@pytest.mark.parametrize("volume", [8.0, -8.0])
@pytest.mark.parametrize("shape", [0.0, 3.0])
def test_huge_steps_have_an_answer(volume, shape):
    """The trial pressure is exp(200) times the old one, or exp(-200) times."""
    material = clay()
    strain = np.zeros((1, 6))
    strain[0, :3], strain[0, 3] = -volume / 3.0, shape
    variables = {"plastic_strain": np.zeros(1), "preconsolidation": np.full(1, P0)}
    answer = material.integrate(strain, variables, True)
    assert np.isfinite(answer.stress).all() and np.isfinite(answer.tangent).all()
    f = material.yield_function(answer.stress, *answer.variables.values())
    assert f[0] < 1e-9


@pytest.mark.parametrize("steps", [1, 7])
def test_isotropic_compression(steps):
    """p = p0 exp(eps_v/lambda), and p0 exp(eps_v/kappa) below p_c, exact in any steps."""
    for overconsolidation in (1.0, 2.0):
        material = clay(overconsolidation)
        state = material.initial_state(1, 3)
        onset = KAPPA * np.log(overconsolidation)
        for eps in np.linspace(0.0, 0.3, steps + 1)[1:]:
            state = moved(material, np.full(3, -eps / 3.0), state)
        expected = overconsolidation * P0 * np.exp((0.3 - onset) / LAMBDA)
        assert abs(invariants(state)[0][0] / expected - 1.0) < 1e-8
        assert abs(state["preconsolidation"][0] / expected - 1.0) < 1e-8
        # Swelling is along kappa.
        state = moved(material, np.full(3, -0.25 / 3.0), state)
        assert abs(invariants(state)[0][0] / (expected * np.exp(-0.05 / KAPPA)) - 1.0) < 1e-8


def undrained(steps, overconsolidation=1.0, last=0.1):
    """Return p and q of each step in triaxial compression at constant volume."""
    material, rows = clay(overconsolidation), []
    state = material.initial_state(1, 3)
    for eps in np.linspace(0.0, last, steps + 1)[1:]:
        state = moved(material, eps * np.array([0.5, -1.0, 0.5]), state)
        rows.append(np.ravel(invariants(state)))
    return np.array(rows).T


def test_undrained_path_from_normal_consolidation():
    """p/p0 = (M^2/(M^2 + eta^2))^Lambda, in steps of any size: 0.83651 at eta = 0.6."""
    assert (M**2 / (M**2 + 0.36)) ** RATIO == pytest.approx(0.83651, abs=1e-5)
    for steps in (3, 400):
        p, q = undrained(steps)
        np.testing.assert_allclose(p / P0, (M**2 / (M**2 + (q / p) ** 2)) ** RATIO, rtol=1e-8)


def exact_strain(eta):
    """Return the axial strain of the undrained test at q = eta p.

    The elastic part is q/(3 G); d eps_s^p = 2 eta/(M^2 - eta^2) d eps_v^p, where the path gives
    d eps_v^p = -kappa dp/p.
    """
    p = P0 * (M**2 / (M**2 + eta**2)) ** RATIO
    plastic = (np.log((M + eta) / (M - eta)) - 2.0 * np.arctan(eta / M)) / M
    return eta * p / (3.0 * G) + KAPPA * RATIO * plastic


def error_of_strength(steps):
    """Return the largest error of q/p0 of the undrained test over 5 % of strain."""
    last = 0.05
    q = undrained(steps, last=last)[1] / P0
    eta = [
        brentq(lambda x, eps=eps: exact_strain(x) - eps, 0.0, M * (1.0 - 1e-12))
        for eps in np.linspace(0.0, last, steps + 1)[1:]
    ]
    eta = np.array(eta)
    return np.abs(q - eta * (M**2 / (M**2 + eta**2)) ** RATIO).max()


def test_undrained_stress_over_strain_is_of_first_order():
    errors = np.array([error_of_strength(steps) for steps in (100, 200, 400, 800)])
    rates = np.log2(errors[:-1] / errors[1:])
    assert errors[2] < 2e-3 and (np.abs(rates - 1.0) < 0.1).all()


@pytest.mark.parametrize("overconsolidation", [1.0, 2.0, 5.0])
def test_undrained_strength(overconsolidation):
    """c_u = (M p0/2) (R/2)^Lambda; 0.34461 p0 at R = 1."""
    p, q = undrained(400, overconsolidation, last=0.5)
    strength = 0.5 * M * (0.5 * overconsolidation) ** RATIO
    assert abs(0.5 * q[-1] / P0 / strength - 1.0) < 1e-4
    assert abs(q[-1] / p[-1] / M - 1.0) < 1e-4


@pytest.mark.parametrize("overconsolidation", [1.0, 2.0])
def test_overconsolidated_ground_has_a_strength_in_proportion_to_its_stress(overconsolidation):
    """c_u = (M p0/2) (R/2)^Lambda at each pressure, whatever the reference pressure is."""
    material = overconsolidated(overconsolidation)
    pressure = np.array([20.0, 100.0, 300.0])
    first = np.multiply.outer(-pressure, np.eye(3))
    state = material.stressed_state(first, np.zeros((3, 3, 3)))
    for eps in np.linspace(0.0, 0.5, 401)[1:]:
        H = np.diag(np.expm1(eps * np.array([0.5, -1.0, 0.5])))
        state = material.update(np.broadcast_to(H, (3, 3, 3)), state, tangent=False).state
    _, q = invariants(state)
    strength = 0.5 * M * pressure * (0.5 * overconsolidation) ** RATIO
    np.testing.assert_allclose(0.5 * q, strength, rtol=3e-3)


@pytest.mark.parametrize("K0", [0.5, 1.0, 1.4])
def test_preconsolidation_goes_with_the_stress_of_the_ground(K0):
    """p_c = R (p + q^2/(M^2 p)) of the stress at rest at each depth, which is in equilibrium."""
    V = vectors(box([0.0, 0.0], [1.0, 5.0], [2, 10], QUADRILATERAL))
    body = mpm.Particles(box([0.0, 0.0], [1.0, 4.0], [4, 16], QUADRILATERAL), V)
    gravity = (0.0, -10.0)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            body,
            overconsolidated(1.5),
            density=2.0,
            body_force=gravity,
            initial_stress=mpm.geostatic(4.0, 2.0, K0, gravity, surcharge=5.0),
            tractions=[((0.0, -5.0), 1)],
            facet_tags=mpm.facet_tags(body.mesh, {1: mpm.region(y=4.0)}),
        ),
        bcs=[mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=1.0), mpm.held(V, 1, y=0.0)],
    )
    problem.solve()
    assert np.abs(body.displacement.x.array).max(initial=0.0) < 1e-10
    down = 5.0 + 20.0 * (4.0 - body.centroid[:, 1])
    p, q = (1.0 + 2.0 * K0) / 3.0 * down, np.abs(1.0 - K0) * down
    known = 1.5 * (p + (q / M) ** 2 / p)
    (points,) = problem.points
    found = points.last.variable("preconsolidation").reshape(known.shape[0], -1).mean(axis=1)
    np.testing.assert_allclose(found, known, rtol=1e-9)


@pytest.mark.parametrize("overconsolidation", [1.0, 5.0])
def test_drained_compression_ends_at_the_critical_state(overconsolidation):
    """q = M p with the lateral stress held, at p = 3 p0/(3 - M)."""
    material = clay(overconsolidation)
    state, side = material.initial_state(1, 3), 0.0
    for axial in -np.linspace(0.0, 3.0, 401)[1:]:

        def excess(x, axial=axial, state=state):
            return moved(material, np.array([x, axial, x]), state)["stress"][0, 0] + P0

        side = brentq(excess, side - 0.02, side + 0.02, xtol=1e-15)
        state = moved(material, np.array([side, axial, side]), state)
    p, q = np.ravel(invariants(state))
    assert abs(q / p / M - 1.0) < 1e-4
    assert abs(p / (3.0 * P0 / (3.0 - M)) - 1.0) < 1e-4


def test_parameters_per_point():
    pressure = np.linspace(20.0, 90.0, 30)
    together = clay(reference_pressure=pressure)
    H = 1e-2 * np.random.default_rng(0).normal(size=(30, 2, 2))
    P = together.update(H, together.initial_state(30, 2)).first_piola
    for p in (0, 11, 29):
        alone = clay(reference_pressure=pressure[p])
        one = alone.update(H[p : p + 1], alone.initial_state(1, 2)).first_piola[0]
        np.testing.assert_allclose(P[p], one, rtol=1e-12)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"swelling": 0.0}, "swelling is 0 but must be finite, greater than 0"),
        ({"swelling": 0.3}, "swelling must be less than compression"),
        ({"reference_pressure": 101.0}, "reference_pressure must be at most preconsolidation"),
    ],
)
def test_bad_parameters(arguments, message):
    with pytest.raises(MPMError, match=message):
        clay(**arguments)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"reference_pressure": None}, "needs a reference_pressure, and either"),
        ({"overconsolidation": None}, "either preconsolidation"),
        ({"preconsolidation": 2.0 * P0}, "either preconsolidation"),
        ({"overconsolidation": 0.9}, "overconsolidation is 0.9 but must be finite, at least 1"),
    ],
)
def test_bad_overconsolidation(arguments, message):
    with pytest.raises(MPMError, match=message):
        overconsolidated(2.0, **arguments)
    with pytest.raises(MPMError, match="not both"):
        clay().with_parameters(overconsolidation=2.0).initial_state(1, 2)


def test_confined_layer_between_plates_is_compressed_along_lambda():
    """A layer of one pressure in all directions, pressed from all sides: its plates' force."""
    V = vectors(box([0.0, 0.0], [1.0, 1.0], [4, 4], QUADRILATERAL))
    body = box([0.0, 0.0], [1.0, 1.0], [8, 8], QUADRILATERAL)
    last = -0.05
    moves = [fix(V, at(i, 0.0), component=i) for i in (0, 1)]
    moves += [fix(V, at(i, 1.0), value=last, component=i) for i in (0, 1)]
    problem = mpm.QuasiStaticProblem(mpm.Body(mpm.Particles(body, V), clay(2.0)), bcs=moves)
    problem.solve(steps=1)
    stress = problem.particles.stress
    H = np.broadcast_to(last * np.eye(2), (1, 2, 2))
    state = clay(2.0).update(H, clay(2.0).initial_state(1, 2)).state
    expected = mandel.to_tensor(state["stress"]) / (1.0 + last) ** 2
    np.testing.assert_allclose(stress, np.broadcast_to(expected, stress.shape), atol=1e-8)
    assert np.abs(problem.yield_function).max() < 1e-9
