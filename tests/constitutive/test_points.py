# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Materials at points: by tags, by parameters, and where they fail."""

import numpy as np
import pytest
import scenes
from bad_input import held_background, particles, with_one_value
from compare import raises
from scenes import QUADRILATERAL, WORLD, A, B, top
from scipy.integrate import quad

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.constitutive import points
from mpm_dolfinx.materials import Hencky, VonMises

LAYERS = {1: 1e4, 2: 3e4}


def layered(kind):
    """Return a function that makes the materials of a column with a stiff lower half."""

    def make(body):
        tags = scenes.cell_tags(body, lambda x: np.where(x[:, 1] > A.length / 2, 1, 2))
        if kind == "materials":
            return {tag: Hencky(young, 0.0) for tag, young in LAYERS.items()}, {"cell_tags": tags}
        space = fem.functionspace(body, ("Discontinuous Lagrange", 0))
        young = fem.Function(space)
        young.x.array[space.dofmap.list[tags.indices, 0]] = [LAYERS[t] for t in tags.values]
        return Hencky(young, 0.0), {}

    return make


def test_materials_by_tag_and_parameters_by_cell():
    problems = []
    for kind in ("materials", "parameters"):
        problem = scenes.column(A, 16, QUADRILATERAL, None, material_of=layered(kind))
        problem.solve(steps=20)
        problems.append(problem)
    one, two = (problem.particles for problem in problems)
    np.testing.assert_allclose(one.stress, two.stress, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose(one.displacement.x.array, two.displacement.x.array, atol=1e-12)
    Y = one.initial_centroid[:, 1]
    assert scenes.stress_error(problems[0], A, 1, -A.g0 * (A.length - Y)) < 1.5e-2
    stiff = A._replace(young=LAYERS[2])
    layers = (stiff, 0.0, A.length / 2), (A, A.length / 2, A.length)
    height = sum(quad(lambda y, c=c: np.exp(-c.strain(y)), a, b)[0] for c, a, b in layers)
    assert abs(top(problems[0]) - height) < 0.05
    assert abs(height - 24.06) > 5.0


def test_materials_with_different_histories():
    # An elastic layer on a plastic one: each particle has its own law's variables.
    def make(body):
        tags = scenes.cell_tags(body, lambda x: np.where(x[:, 1] > 2.0, 7, 3))
        materials = {7: Hencky(B.young, B.poisson), 3: VonMises(B.young, B.poisson, rho_y=B.rho_y)}
        return materials, {"cell_tags": tags}

    problem = scenes.column(B, 10, QUADRILATERAL, None, material_of=make)
    problem.solve(steps=10)
    particles = problem.particles
    Y = particles.initial_centroid[:, 1]
    elastic = Y > 2.0
    assert np.all(particles.plastic_strain[elastic] == 0.0)
    assert np.all(particles.plastic_strain[~elastic] > 0.0)
    np.testing.assert_allclose(problem.yield_function[elastic], -1.0)
    np.testing.assert_allclose(problem.yield_function[~elastic], 0.0, atol=1e-12)
    across = np.where(elastic, B._replace(rho_y=np.inf).stress(Y)[0], B.stress(Y)[0])
    assert scenes.stress_error(problem, B, 0, across) < 6e-3


class Touchy(Hencky):
    """A law that fails at points whose Young's modulus is 7."""

    def update(self, displacement_gradient, state, tangent=True):
        weak = np.flatnonzero(self.parameters["young"] == 7.0)
        if len(weak) and np.abs(displacement_gradient).max() > 0.0:
            raise mpm.ConvergenceError("The law failed", weak)
        return super().update(displacement_gradient, state, tangent)


@pytest.mark.parametrize("quadrature_degree", [None, 3])
def test_law_that_fails_at_one_particle(quadrature_degree):
    V = scenes.vectors(held_background())
    domain = scenes.unit(4, QUADRILATERAL)
    young = fem.Function(fem.functionspace(domain, ("DG", 0)))
    X = scenes.mesh.compute_midpoints(domain, 2, np.arange(len(young.x.array), dtype=np.int32))
    bad = (X[:, 0] > 0.75) & (X[:, 1] < 0.25)
    young.x.array[young.function_space.dofmap.list[: len(X), 0]] = np.where(bad, 7.0, 1e3)
    p = mpm.Particles(domain, V, quadrature_degree=quadrature_degree)
    failed = mpm.QuasiStaticProblem(
        p,
        Touchy(young, 0.3),
        body_force=(0.0, -1.0),
        bcs=[scenes.fix(V, scenes.at(0, 0.0))],
    )
    expected = [int(i) for i in scenes.gather(p.global_index[bad[: p.num_local]])]
    assert len(expected) == 1
    error = raises(
        lambda: failed.solve(steps=2), mpm.ConvergenceError, r"The law failed \(.*particle \d+\)"
    )
    assert error.particles == expected and error.load == 0.0
    assert f"particle {expected[0]}" in str(error)


class Broken(Hencky):
    """A law whose program has an error, on one rank and from some strain on."""

    def update(self, displacement_gradient, state, tangent=True):
        if WORLD.rank == WORLD.size - 1 and np.abs(displacement_gradient).max(initial=0.0) > 1e-3:
            raise ValueError("no such thing")
        return super().update(displacement_gradient, state, tangent)


def test_a_law_with_an_error_of_python():
    problem = scenes.block(material=Broken(1e3, 0.3), force=(0.0, -2.0))
    cause = r"update of Broken failed with ValueError: no such thing"
    raises(lambda: problem.solve(steps=1), mpm.MPMError, cause)
    assert problem.particles.load.value == 0.0 and not problem.history.steps
    assert not np.any(problem.particles.displacement.x.array)


def test_one_parameter_out_of_range():
    # Only the rank that owns the particle sees that its modulus is negative.
    young = with_one_value(particles(), 1e3, -1.0)
    raises(lambda: Hencky(young, 0.3), mpm.MPMError, r"young is -1")


@pytest.mark.parametrize(
    ("name", "value", "match"),
    [
        ("young", -1.0, "young is -1 but"),
        ("yield_stress", np.nan, "yield_stress is nan but"),
        ("hardening", -2.0, "hardening is -2 but"),
    ],
)
def test_one_value_out_of_range_in_arrays_of_the_ranks(name, value, match):
    p = particles()
    values = np.full(p.num_local, 1e3)
    values[p.global_index == 0] = value
    parameters = {"young": 1e3, "yield_stress": 1.0, name: values}
    raises(
        lambda: mpm.QuasiStaticProblem(p, VonMises(poisson=0.3, **parameters)), mpm.MPMError, match
    )


def test_one_array_of_another_length():
    p = particles()
    young = np.full(p.num_local + (WORLD.rank == WORLD.size - 1), 1e3)
    raises(lambda: mpm.QuasiStaticProblem(p, Hencky(young, 0.3)), mpm.MPMError, "young has")


class Own(VonMises):
    """A law of the user's, with the numbers of one of this package."""


@pytest.mark.parametrize("law", [VonMises, Own])
def test_how_much_of_an_answer_is_read_to_find_what_is_not_finite(law, monkeypatch):
    read = []
    finite = points._all_finite
    monkeypatch.setattr(points, "_all_finite", lambda v: read.append(v.shape[1:]) or finite(v))
    problem = scenes.block(law(1e3, 0.3, rho_y=1e3))
    problem.solve(steps=1)
    kinds = set(read)
    if law is VonMises:
        assert kinds == {(2, 2)}
    else:
        assert {(2, 2), (2, 2, 2, 2), ()} <= kinds
    # A law of the package gives its arrays away: its history is not copied at each step.
    stress = problem._stresses[0]
    assert (stress._last.stress is stress.first_piola) == (law is VonMises)


def test_an_update_that_fails_leaves_the_last_converged_step():
    problem = scenes.block(VonMises(1e3, 0.3, rho_y=60.0))
    problem.solve(steps=1)
    (body,), (stress,) = problem.bodies, problem.points
    at_rest = stress.strain_energy()
    good = body.displacement.x.array.copy()
    x = body.W.tabulate_dof_coordinates()[:, :2]
    body.displacement.x.array[:] += 0.3 * x.ravel()
    stress.update()
    assert not stress.elastic() and (stress.strain_energy(trial=True) != at_rest).any()
    body.displacement.x.array[:] = (x * (-2.0, 0.0)).ravel()  # turned inside out
    with pytest.raises(mpm.MPMError):
        stress.update()
    assert stress.elastic()
    np.testing.assert_array_equal(stress.strain_energy(trial=True), at_rest)
    body.displacement.x.array[:] = good
    stress.roll_back()
    np.testing.assert_array_equal(stress.strain_energy(), at_rest)
