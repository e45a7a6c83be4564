# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A material at its points: laws that fail, and how much of their answers is looked at."""

import numpy as np
import pytest
import scenes
from bad_input import held_background
from compare import raises
from scenes import QUADRILATERAL, WORLD

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.constitutive import governed
from mpm_dolfinx.constitutive.energies import elastic_energy, potential_energy
from mpm_dolfinx.materials import Hencky, VonMises


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
        mpm.Body(p, Touchy(young, 0.3), body_force=(0.0, -1.0)),
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


class Own(VonMises):
    """A law of the user's, with the numbers of one of this package."""


@pytest.mark.parametrize("law", [VonMises, Own])
def test_how_much_of_an_answer_is_read_to_find_what_is_not_finite(law, monkeypatch):
    read = []
    finite = governed._all_finite
    monkeypatch.setattr(governed, "_all_finite", lambda v: read.append(v.shape[1:]) or finite(v))
    problem = scenes.block(law(1e3, 0.3, rho_y=1e3))
    problem.solve(steps=1)
    kinds = set(read)
    if law is VonMises:
        assert kinds == {(2, 2)}
    else:
        assert {(2, 2), (2, 2, 2, 2), ()} <= kinds
    # A law of the package gives its arrays away: its history is not copied at each step.
    stress = problem.points[0]
    assert (stress.last.stress is stress.first_piola) == (law is VonMises)


class Overstressed(VonMises):
    """A law that returns half of the way, so that its stress is no derivative of an energy."""

    def integrate(self, trial_strain, variables, tangent):
        whole = super().integrate(trial_strain, variables, tangent)
        elastic = 0.5 * (trial_strain + whole.elastic_strain)
        flow = 0.5 * (variables["plastic_strain"] + whole.variables["plastic_strain"])
        D = self.elastic_tangent(*trial_strain.shape) if tangent else None
        return whole._replace(
            stress=self.elastic_stress(elastic),
            tangent=D if D is None else 0.5 * (D + whole.tangent),
            elastic_strain=elastic,
            variables={"plastic_strain": flow},
        )


class Silent(Overstressed):
    """The same, which says that it knows no plastic work."""

    def plastic_work(self, state):
        return None


class Told(Overstressed):
    """The same, which says that its plastic work is 1."""

    def plastic_work(self, state):
        return np.ones(len(state["plastic_strain"]))


def spun(law):
    """Return a square that turns and stretches, yields and is as it is after some steps."""
    V = scenes.vectors(scenes.box([-1.0, -1.0], [2.0, 2.0], [6, 6], QUADRILATERAL))
    body = scenes.unit(4, QUADRILATERAL)
    problem = mpm.DynamicProblem(
        mpm.Body(
            mpm.Particles(body, V),
            law(100.0, 0.3, rho_y=1.5, hardening=30.0),
            density=1.0,
            velocity=lambda x: np.stack([2.0 * x[0] - 3.0 * x[1], 3.0 * x[0] - 2.0 * x[1]]),
        ),
        scheme="conserving",
    )
    problem.solve(time=0.1, dt=0.02)
    return problem


def test_plastic_work_is_not_that_of_a_law_that_an_heir_has_changed():
    ends, works = [], []
    for law in (VonMises, Own, Overstressed, Silent, Told):
        problem = spun(law)
        assert scenes.largest(problem.particles.plastic_strain) > 0.01
        points = problem.points[0]
        ends.append(scenes.gather(problem.particles.domains))
        works.append(scenes.largest(potential_energy(points) - elastic_energy(points)))
    np.testing.assert_allclose(ends[1], ends[0], rtol=0, atol=1e-10)
    np.testing.assert_allclose(ends[2], ends[3], rtol=0, atol=1e-14)
    assert works[0] == pytest.approx(works[1]) and works[0] > 0.01
    assert works[2:] == [0.0, 0.0, pytest.approx(1.0)]
