# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Laws that come in place of others: an equal one changes nothing, another carries the stress."""

import numpy as np
import pytest
import scenes
from marks import slow, thinned
from posed import posed, staged
from scenes import QUADRILATERAL, TRIANGLE, at, box, cell_tags, facet_tags, fix, vectors

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import materials
from mpm_dolfinx.constitutive.succession import equals
from mpm_dolfinx.materials import Hencky, LinearElastic, MohrCoulomb, VonMises

E, NU = 1e4, 0.3
#: Laws under a strip load of 300 kPa: elastic, yielding, hardening; of small and of finite strain.
LAWS = {
    "hencky": Hencky(E, NU),
    "linear": LinearElastic(E, NU),
    "hardening": VonMises(E, NU, rho_y=100.0, hardening=2e3),
    "small hardening": materials.SmallStrainVonMises(E, NU, rho_y=100.0, hardening=2e3),
    "sand": MohrCoulomb(E, NU, cohesion=80.0, friction_angle=30.0, dilation_angle=5.0),
    "cone": materials.DruckerPrager(E, NU, cohesion=80.0, friction_angle=30.0),
    "clay": materials.ModifiedCamClay(0.02, 0.004, 2.0, 3e3, 700.0, 300.0),
}
#: Ways in which a law sees the strain.
WAYS = {
    "quadrilaterals": {},
    "triangles": {"cell": TRIANGLE},
    "patches": {"f_bar": "patch"},
    "patches of triangles": {"f_bar": "patch", "cell": TRIANGLE},
    "domains": {"f_bar": "domain", "quadrature_degree": 2},
    "axisymmetric patches": {"f_bar": "patch", "axisymmetric": True},
    "pressure": {"mixed": "pressure", "degree": 2},
    "stabilised pressure": {"mixed": "stabilised pressure"},
}
#: A clay that may soften under a given shape has no pressure of its own.
PAIRS = [(n, w) for n in LAWS for w in WAYS if n != "clay" or "pressure" not in w]


def pressed(law, half=False, degree=1, cell=QUADRILATERAL, quadrature_degree=None, **options):
    """Return a block under a strip load, after its first stage; two laws govern it by halves."""
    left = 0.0 if "axisymmetric" in options else -1.0
    V = vectors(box([left, 0], [3, 3], [int(3 - left), 3], QUADRILATERAL), degree)
    mesh = box([0, 0], [2, 2], [4, 4], cell)
    body = mpm.Particles(mesh, V, degree=degree, quadrature_degree=quadrature_degree)
    tags = cell_tags(mesh, lambda x: np.where(x[:, 1] < 1.2, 1, 2))
    bcs = [fix(V, at(1, 0.0))]
    if "axisymmetric" in options:
        bcs.append(fix(V, at(0, 0.0), component=0))
    top = facet_tags(mesh, lambda x: np.isclose(x[1], 2.0) & (x[0] > 0.49) & (x[0] < 1.51))
    problem = posed(
        mpm.QuasiStaticProblem,
        body,
        {1: law, 2: law} if half else law,
        bcs=bcs,
        tractions=[((-60.0, -300.0), 1)],
        facet_tags=top,
        cell_tags=tags,
        petsc_options={"snes_rtol": 1e-13},
        **options,
    )
    problem.solve(4)
    return problem


def nudged(law):
    """Return a law of which the stiffness differs by round-off."""
    name = "shear_modulus" if "shear_modulus" in law.parameters else "young"
    return law.with_parameters(**{name: float(np.nextafter(law.parameters[name], np.inf))})


@pytest.mark.parametrize(("name", "way"), thinned(7, PAIRS))
@pytest.mark.parametrize("half", [*slow(False), True])
def test_an_equal_law_changes_nothing(name, way, half):
    law, options = LAWS[name], WAYS[way]
    if name == "clay":
        options = options | {"initial_stress": np.diag([-300.0] * 3)}
    others = [None, law.with_parameters()]
    if not (half and options.get("f_bar") == "patch"):  # (where another law has other patches)
        others.append(nudged(law))
    ends = []
    for other in others:
        problem = pressed(law, half, **options)
        body = problem.particles
        before = body.stress, body.plastic_strain
        if other is not None:
            staged(problem, material={1: law, 2: other} if half else other)
            np.testing.assert_allclose(body.stress, before[0], atol=1e-9)
            np.testing.assert_array_equal(body.plastic_strain, before[1])
        body.load.value = 1.02  # (sand with a pressure of its own bears 1.032)
        problem.step()
        ends.append((body.displacement.x.array, body.stress))
    for tolerance, end in zip((1e-12, 1e-10), ends[1:], strict=False):
        for one, two in zip(end, ends[0], strict=True):
            assert scenes.largest(np.abs(one - two)) <= tolerance * scenes.largest(np.abs(two))


@pytest.mark.parametrize("law", [LinearElastic(1e3, 0.0), Hencky(1e3, 0.0)], ids=repr)
@pytest.mark.parametrize(
    "other", [LinearElastic(2e3, 0.2), VonMises(5e2, 0.1, rho_y=1e5)], ids=repr
)
def test_another_law_carries_the_stress(law, other):
    """A bar that is compressed by a fifth and more bears its load under any law."""
    V = vectors(box([0, 0], [1, 5], [1, 5], QUADRILATERAL))
    body = mpm.Particles(box([0, 0], [1, 4], [2, 8], QUADRILATERAL), V)
    top = facet_tags(body.mesh, at(1, 4.0))
    bcs = [fix(V, at(1, 0.0)), fix(V, at(0, 0.0, 1.0), component=0)]
    loads = {"tractions": [((0.0, -200.0), 1)], "facet_tags": top}
    problem = posed(mpm.QuasiStaticProblem, body, law, bcs=bcs, **loads)
    problem.solve(4)
    settled, before = body.displacement.x.array.copy(), body.stress
    assert scenes.largest(-settled) > 0.6
    staged(problem, material=other)
    np.testing.assert_allclose(body.stress, before, atol=1e-9)
    problem.solve(2)
    np.testing.assert_allclose(body.displacement.x.array, settled, atol=1e-8)
    np.testing.assert_allclose(body.stress, before, atol=1e-6)


@pytest.mark.parametrize("way", ["patches", "domains", "pressure", "stabilised pressure"])
@pytest.mark.parametrize("half", [False, True])
def test_another_law_is_in_the_balance_of_before(way, half):
    """All forces stay, those on pressures too: no average and no pressure is lost."""
    problem = pressed(LAWS["hencky"], half=half, **WAYS[way])
    before = problem.reduced.terms.nodal_forces()
    # (the stabilisation of a pressure is scaled by the shear modulus)
    young = E if way == "stabilised pressure" else 3 * E
    other = MohrCoulomb(young, NU, 1e4, 30.0)
    staged(problem, material={1: LAWS["hencky"], 2: other} if half else other)
    for one, two in zip(problem.reduced.terms.nodal_forces(), before, strict=True):
        assert scenes.largest(np.abs(one - two)) < 2e-6 * scenes.largest(np.abs(two))


@pytest.mark.parametrize("scheme", ["midpoint", "conserving", "euler"])
@pytest.mark.parametrize("mixed", [None, "stabilised pressure"])
@pytest.mark.parametrize("law", [Hencky(2e3, NU), *slow(LinearElastic(2e3, NU))], ids=repr)
def test_a_motion_after_rest_begins_at_rest(scheme, mixed, law):
    V = vectors(box([-1, 0], [3, 3], [8, 6], QUADRILATERAL))
    body = mpm.Particles(box([0, 0], [2, 2], [8, 8], QUADRILATERAL), V)
    given = {"body_force": (0.0, -10.0), "bcs": [fix(V, at(1, 0.0))], "mixed": mixed}
    problem = posed(mpm.QuasiStaticProblem, body, law, 10.0, **given)
    problem.solve(6)
    for _ in range(12):
        problem.step()
    still = body.displacement.x.array.copy()
    other = law.with_parameters()
    motion = posed(mpm.DynamicProblem, body, other, 10.0, after=problem, scheme=scheme, **given)
    motion.solve(time=0.1, dt=0.02)
    assert scenes.largest(np.abs(body.displacement.x.array - still)) < 1e-9


def test_what_is_equal():
    f = fem.Constant(box([0, 0], [1, 1], [1, 1], QUADRILATERAL), 2.0)

    class Named(Hencky):
        def __init__(self, young, name):
            super().__init__(young, NU)
            self.name = name

    assert equals(Hencky(E, NU), Hencky(E, NU))
    assert not equals(Hencky(E, NU), Hencky(2 * E, NU))
    assert not equals(Hencky(E, NU), LinearElastic(E, NU))
    assert equals(Hencky(f, NU), Hencky(f, NU))
    assert not equals(Hencky(f, NU), Hencky(2.0, NU))
    assert equals(Named(E, "sand"), Named(E, "sand"))
    assert not equals(Named(E, "sand"), Named(E, "clay"))
    assert not equals(Named(E, np.sin), Named(E, np.cos))
