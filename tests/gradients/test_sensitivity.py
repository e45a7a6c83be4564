# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Derivatives of runs against central differences of whole runs."""

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from gradients.runs import (
    LOADS,
    VON_MISES,
    Loaded,
    Slump,
    Stacked,
    Written,
    check,
    looked,
    size,
    von_mises,
)
from laws import in_python
from marks import all_but, slow
from scenes import HEXAHEDRON, TRIANGLE, WORLD, in_order

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import materials

ELASTIC = {"young": 2e4, "poisson": 0.3, "weight": 1e3}
LAWS = {
    "hencky": (materials.Hencky, ELASTIC),
    "linear": (materials.LinearElastic, ELASTIC),
    "von Mises": (von_mises, VON_MISES),
    "small von Mises": (
        lambda young, strength: materials.SmallStrainVonMises(
            young, 0.3, yield_stress=strength, hardening=2e3
        ),
        VON_MISES,
    ),
    "in python": (lambda **numbers: in_python(von_mises(**numbers)), VON_MISES),
    "Mohr-Coulomb": (
        lambda young, cohesion, friction: materials.MohrCoulomb(
            young, 0.3, cohesion, friction, 5.0
        ),
        {"young": 5e4, "cohesion": 4e2, "friction": 20.0, "weight": 1e3},
    ),
    "Tresca": (
        lambda young, cohesion: materials.Tresca(young, 0.3, cohesion),
        {"young": 5e4, "cohesion": 6e2, "weight": 1e3},
    ),
    "Drucker-Prager": (
        lambda young, cohesion, friction, dilation: materials.DruckerPrager(
            young, 0.3, cohesion, friction, dilation
        ),
        {"young": 5e4, "cohesion": 3e2, "friction": 20.0, "dilation": 5.0, "weight": 1e3},
    ),
    "Cam clay": (
        lambda compression, swelling, ratio, shear, pc, p: materials.ModifiedCamClay(
            compression, swelling, ratio, shear, pc, p
        ),
        {
            "compression": 0.1,
            "swelling": 0.02,
            "ratio": 1.0,
            "shear": 2e4,
            "pc": 1.5e3,
            "p": 1e3,
            "weight": 500.0,
        },
    ),
}


@pytest.mark.parametrize("law", all_but(["von Mises"], LAWS))
def test_each_law(law):
    make, values = LAWS[law]
    check(lambda **numbers: Slump(make, numbers), values)


KINDS = {
    "triangles": {"cell": TRIANGLE, "quadrature_degree": 1},
    "F-bar domain": {"f_bar": "domain"},
    "F-bar patch": {"f_bar": "patch"},
    "axisymmetric": {"axisymmetric": True},
    "axisymmetric patch": {"axisymmetric": True, "f_bar": "patch"},
    "degree 2": {"degree": 2, "quadrature_degree": 4},
    "ghost": {"stabilisation": "ghost"},
    "finite elements": {"free": True},
    "space": {"gdim": 3, "cell": HEXAHEDRON},
    "space patch": {"gdim": 3, "cell": HEXAHEDRON, "f_bar": "patch", "stabilisation": "ghost"},
}


@pytest.mark.parametrize("kind", all_but(["axisymmetric patch", "degree 2"], KINDS))
def test_each_kind_of_body(kind):
    names = ["young", "strength"]
    # (at 1e-6 of the strength a point begins to yield in one of them)
    check(lambda **numbers: Slump(von_mises, numbers, **KINDS[kind]), VON_MISES, names, change=5e-7)


@pytest.mark.parametrize("support", all_but(["roller"], ["fixed", "roller"]))
def test_each_load_and_condition(support):
    check(lambda **numbers: Loaded(**numbers, support=support), LOADS, change=1e-5)


def by_hand(scene):
    """Run in steps of one's own: a run, a path that goes on, and a single step."""
    problem = scene.problem
    problem.solve(3)

    def path(t):
        scene.particles.load.value = 1.0 + 0.2 * t

    problem.solve(2, update=path)
    scene.particles.load.value = 1.3
    problem.step()


def to_others(scene):
    """Go on from Dirichlet values that depend on the same number as those of the end."""
    scene.particles.load.value = 0.3
    scene.problem.step()
    scene.problem.solve(2)


RUNS = {
    "by hand": by_hand,
    "to others": to_others,
    "automatic": lambda scene: scene.problem.solve("auto", tolerance=0.05),
}


@pytest.mark.parametrize("run", all_but(["to others"], RUNS))
def test_each_way_to_run(run):
    check(lambda **v: Loaded(**v), LOADS, ["young", "moved", "stress"], change=1e-5, run=RUNS[run])


@pytest.mark.parametrize("f_bar", ["patch", *slow("domain")])
def test_an_initial_stress_that_averages_see(f_bar):
    check(lambda **v: Loaded(f_bar=f_bar, **v), LOADS, ["young", "stress"], change=1e-5)


@pytest.mark.parametrize("over", all_but(["patch"], [None, "domain", "patch"]))
def test_a_residual_in_ufl(over):
    values = {"young": 2e4, "poisson": 0.3, "weight": 1e3}
    check(lambda **numbers: Written(**numbers, over=over), values)


def test_bodies_that_stick_by_their_joints():
    values = {"below": 2e4, "above": 1e4, "weight": 300.0}

    def run(scene):
        problem = scene.problem
        counts = [problem.history.statistics["joint_nodes"] for _ in problem.steps(6)]
        assert max(counts) > 0

    check(lambda **numbers: Stacked(**numbers), values, ["below", "above"], run=run)


@pytest.mark.parametrize("law", ["hencky", "Mohr-Coulomb"])
def test_the_remainder_is_of_second_order(law):
    make, values = LAWS[law]
    scene = Slump(make, values)
    names = [name for name in values if name != "weight"]
    gradient = mpm.Sensitivity(scene.problem, [scene.named[name] for name in names])
    scene.problem.solve(4)
    first = looked(scene)["displacement"]
    along = sum(
        values[name] * own.x.array for name, own in zip(names, gradient.displacement, strict=True)
    )
    sizes = 8e-5 * 0.5 ** np.arange(3)
    left = []
    for change in sizes:
        other = Slump(make, values | {name: values[name] * (1.0 + change) for name in names})
        other.problem.solve(4)
        left.append(size(looked(other)["displacement"] - first - change * along))
    rates = np.diff(np.log(left)) / np.diff(np.log(sizes))
    assert np.abs(rates - 2.0).max() < 0.02, rates


def test_numbers_of_laws_functions_and_directions():
    """The same number in all ways to name it; a Function along a direction is a sum."""

    def made(young):
        scene = Slump(lambda: materials.Hencky(young, 0.3), {"weight": 1e3})
        return scene, scene.problem.points[0].laws.given[0]

    scene, law = made(2e4)
    gradient = mpm.Sensitivity(scene.problem, [(law, "young"), (scene.weight, 1.0)])
    scene.problem.solve(3)
    plain = gradient.of(lambda: scene.particles.displacement.x.array)
    assert size(plain[:, 0] - gradient.displacement[0].x.array) < 1e-8 * size(plain[:, 0])
    material = {"material": lambda body: materials.Hencky(fem.Constant(body, 2e4), 0.3)}
    scene = Slump(lambda: None, {"weight": 1e3}, **material)
    law = scene.problem.points[0].laws.given[0]
    gradient = mpm.Sensitivity(scene.problem, [(law, "young")])
    scene.problem.solve(3)
    constant = gradient.of(lambda: scene.particles.displacement.x.array)
    assert size(constant[:, 0] - plain[:, 0]) < 1e-7 * size(plain[:, 0])
    scene = Slump(lambda: None, {"weight": 1e3}, material=lambda body: _layered(body, 2e4))
    young = scene.problem.points[0].laws.given[0].parameters["young"]
    upper = fem.Function(young.function_space)
    upper.interpolate(lambda x: 1.0 * (x[1] > 1.0))
    lower = fem.Function(young.function_space)
    lower.x.array[:] = 1.0 - upper.x.array
    gradient = mpm.Sensitivity(scene.problem, [(young, upper), (young, lower)])
    scene.problem.solve(3)
    parts = gradient.of(lambda: scene.particles.displacement.x.array)
    assert size(parts.sum(axis=1) - plain[:, 0]) < 1e-7 * size(plain[:, 0])
    assert min(size(parts[:, 0]), size(parts[:, 1])) > 0.05 * size(plain[:, 0])


def _layered(body, value):
    young = fem.Function(fem.functionspace(body, ("DG", 0)))
    young.x.array[:] = value
    return materials.Hencky(young, 0.3)


def test_a_parameter_that_is_zero_has_a_scale():
    """A traction of nothing: its derivative is that of a small one."""
    values = LOADS | {"push": 0.0}
    scene = Loaded(**values)
    with pytest.raises(mpm.MPMError, match="scales="):
        mpm.Sensitivity(scene.problem, [scene.named["push"]])
    gradient = mpm.Sensitivity(scene.problem, [scene.named["push"]], scales=[100.0])
    scene.problem.solve(3)
    ends = []
    for push in (1e-3, -1e-3):
        other = Loaded(**(LOADS | {"push": push}))
        other.problem.solve(3)
        ends.append(looked(other)["displacement"])
    difference = (ends[0] - ends[1]) / 2e-3
    gap = size(gradient.displacement[0].x.array - difference)
    assert gap < 1e-6 * size(difference)


def test_a_path_changes_another_number_of_the_law():
    """What laws are made of beside the state is made anew as a path changes them."""

    def ended(young, follows=False):
        values = VON_MISES | {"young": young}
        scene = Slump(von_mises, values)
        strength = scene.named["strength"]

        def path(t):
            strength.value = (1.0 - 0.3 * t) * values["strength"]

        gradient = mpm.Sensitivity(scene.problem, [scene.named["young"]]) if follows else None
        scene.problem.solve(4, update=path)
        return scene.particles.displacement.x.array.copy(), gradient

    young = VON_MISES["young"]
    _, gradient = ended(young, follows=True)
    after, before = (ended(young * (1.0 + sign * 1e-6))[0] for sign in (1.0, -1.0))
    difference = (after - before) / (2e-6 * young)
    gap = size(gradient.displacement[0].x.array - difference)
    assert gap < 1e-6 * size(difference)


def test_a_run_is_what_it_is_without():
    """Who looks at a run does not change it, not in the last bit."""
    ends = []
    for follows in (False, True):
        scene = Loaded(**LOADS)
        if follows:
            gradient = mpm.Sensitivity(scene.problem, [scene.named["young"], scene.named["moved"]])
        for _ in scene.problem.steps(3):
            if follows:
                gradient.of(lambda scene=scene: scene.particles.stress)
        ends.append(looked(scene))
    for name, values in ends[0].items():
        assert np.array_equal(values, ends[1][name]), name


def test_it_is_the_same_on_any_number_of_ranks():
    found = []
    for comm in (WORLD, MPI.COMM_SELF):
        scene = Slump(von_mises, VON_MISES, f_bar="patch", comm=comm)
        named = [scene.named[name] for name in VON_MISES]
        gradient = mpm.Sensitivity(scene.problem, named)
        scene.problem.solve(4)
        stress = in_order(scene.particles, gradient.of(lambda s=scene: s.particles.stress))
        reaction = gradient.of(lambda s=scene: s.problem.reaction(s.bcs[0]))
        found.append((stress, reaction))
    for one, other in zip(*found, strict=True):
        for number, value in enumerate(VON_MISES.values()):
            gap = np.abs(one - other)[..., number].max()
            largest = max(np.abs(other[..., number]).max(), 1e3 / value)
            assert gap < 1e-8 * largest * (10.0 if one.ndim == 2 else 1.0), (number, gap, largest)


def test_what_is_not_followed_is_refused():
    scene = Slump(von_mises, VON_MISES)
    problem, young = scene.problem, scene.named["young"]
    law = problem.points[0].laws.given[0]
    for wrong, words in (
        ([], "Name a parameter"),
        ([3.0], "A parameter is"),
        ([(law, "cohesion")], "no parameter 'cohesion'"),
        ([(materials.Hencky(1.0, 0.3), "young")], "no material of this problem"),
        ([(young, [1.0, 2.0])], "must be numbers of its shape"),
        ([(young, "up")], "must be numbers of its shape"),
        ([(young, 0.0)], "must not be zero"),
        ([(young, np.inf)], "must be finite"),
        ([scene.particles.displacement], "many values"),
    ):
        with pytest.raises(mpm.MPMError, match=words):
            mpm.Sensitivity(problem, wrong)
    with pytest.raises(mpm.MPMError, match="2 scales for 1"):
        mpm.Sensitivity(problem, [young], scales=[1.0, 2.0])
    with pytest.raises(mpm.MPMError, match=r"scales .* must be a positive number, not True"):
        mpm.Sensitivity(problem, [young], scales=[True])
    gradient = mpm.Sensitivity(problem, [young])
    control = mpm.DisplacementControl(scene.particles, -0.01, (0.0, 2.0), (0.0, 1.0))
    with pytest.raises(mpm.MPMError, match="displacement control"):
        problem.solve(1, control=control)
    problem.solve(2)
    with pytest.raises(mpm.MPMError, match="from its first step on"):
        mpm.Sensitivity(problem, [young])
    counts = iter(range(100))
    for wrong, words in (
        (lambda: None, "must return a number or an array"),
        (lambda: [[1.0], [1.0, 2.0]], "must return a number or an array"),
        (lambda: scene.particles.displacement, "must return a number or an array"),
        (lambda: np.zeros(next(counts)), "must always return one shape"),
    ):
        with pytest.raises(mpm.MPMError, match=words):
            gradient.of(wrong)
    young.value = 4e4
    with pytest.raises(mpm.MPMError, match="has changed"):
        problem.step()
    young.value = VON_MISES["young"]
    before = problem.state.capture()
    problem.step()
    problem.state.adopt(before)
    with pytest.raises(mpm.MPMError, match="another state"):
        gradient.of(lambda: 1.0)
    other = Slump(von_mises, VON_MISES)
    gradient = mpm.Sensitivity(other.problem, [other.named["young"]])
    other.problem.solve(1)
    other.problem.stage("next", other.problem.body().replace(body_force=(0.0, -1e3)))
    with pytest.raises(mpm.MPMError, match="another state"):
        other.problem.solve(1)


@pytest.mark.parametrize("kind", ["mixed", "contact", "method", "delete"])
def test_problems_that_are_not_followed(kind):
    options = {
        "mixed": {"mixed": "stabilised pressure"},
        "contact": {"lid": True},
        "method": {"method": "gimp", "quadrature_degree": 1},
        "delete": {"outside": "delete"},
    }[kind]
    scene = Slump(von_mises, VON_MISES, **options)
    with pytest.raises(mpm.MPMError, match="A Sensitivity"):
        mpm.Sensitivity(scene.problem, [scene.named["young"]])


@pytest.mark.parametrize(("who", "free"), [(mpm.Sensitivity, []), (mpm.Adjoint, "auto")])
def test_free_nodes_are_not_followed(who, free):
    body = scenes.unit(2, scenes.QUADRILATERAL)
    V = scenes.vectors(scenes.box([-0.5, -0.5], [1.5, 1.5], [4, 4], scenes.QUADRILATERAL))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            mpm.Particles(body, V, free=free, quadrature_degree=2), materials.Hencky(1e3, 0.3)
        ),
        bcs=[mpm.held(V, y=0.0)],
    )
    with pytest.raises(mpm.MPMError, match="does not follow bodies with free nodes"):
        who(problem, [(problem.points[0].laws.given[0], "young")])


@pytest.mark.parametrize("who", [mpm.Sensitivity, mpm.Adjoint])
def test_a_law_of_fracture_is_named_where_it_is_not_followed(who):
    body = scenes.unit(2, scenes.QUADRILATERAL)
    V = scenes.vectors(scenes.box([-0.5, -0.5], [1.5, 1.5], [4, 4], scenes.QUADRILATERAL))
    law = materials.Fracture(materials.Hencky(1e3, 0.3), 0.05, 0.4)
    problem = mpm.QuasiStaticProblem(mpm.Body(mpm.Particles(body, V), law))
    with pytest.raises(mpm.MPMError, match="does not follow a law of fracture"):
        who(problem, [(problem.points[0].laws.given[0], "young")])
