# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bodies that carry a stress before they move: the K0 procedure and what a user may give."""

import warnings
from contextlib import nullcontext

import numpy as np
import pytest
from compare import outcome, same_run
from marks import slow
from posed import posed
from scenes import (
    HEXAHEDRON,
    PLANE,
    QUADRILATERAL,
    TRIANGLE,
    WORLD,
    at,
    box,
    facet_tags,
    fix,
    in_order,
    largest,
    name,
    vectors,
)

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import materials

HEIGHT, DENSITY, GRAVITY = 5.0, 2.0, (0.0, -10.0)
YOUNG = 1e4
CAM_CLAY = materials.ModifiedCamClay(0.2, 0.04, 1.2, 3e3, 400.0, 50.0)
LAWS = [
    materials.LinearElastic(YOUNG, 0.3),
    materials.Hencky(YOUNG, 0.3),
    materials.VonMises(YOUNG, 0.3, rho_y=200.0),
    materials.Tresca(YOUNG, 0.3, cohesion=60.0),
    materials.MohrCoulomb(YOUNG, 0.3, cohesion=1.0, friction_angle=40.0),
    materials.MohrCoulomb(YOUNG, 0.3, 1.0, 40.0, dilation_angle=10.0, tension_cutoff=0.0),
    materials.DruckerPrager(YOUNG, 0.3, cohesion=1.0, friction_angle=40.0),
    CAM_CLAY,
]


def ground(material, cell=QUADRILATERAL, stress=None, problem=mpm.QuasiStaticProblem, **options):
    """Return level ground between smooth walls on a rough base, 4 wide and 5 high."""
    V = vectors(box([0, 0], [4, 6], [4, 6], cell))
    kind = {k: options.pop(k) for k in ("method", "quadrature_degree") if k in options}
    body = mpm.Particles(box([0, 0], [4, HEIGHT], [8, 10], cell), V, **kind)
    return posed(
        problem,
        body,
        material,
        density=DENSITY,
        body_force=GRAVITY,
        bcs=[fix(V, at(0, 0, 4), component=0), fix(V, at(1, 0), component=1)],
        initial_stress=mpm.geostatic(HEIGHT, DENSITY, 0.5, GRAVITY) if stress is None else stress,
        **options,
    )


def stays(problem):
    """Assert that nothing has moved, and that the stress is the weight above."""
    body = problem.bodies[0]
    assert largest(np.abs(body.displacement.x.array)) <= 1e-12 * HEIGHT
    depth = HEIGHT - body.initial_centroid[:, 1]
    error = body.stress[:, 1, 1] + DENSITY * 10.0 * depth
    assert largest(np.abs(error)) < 1e-11 * DENSITY * 10.0 * HEIGHT


@pytest.mark.parametrize("K0", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("law", LAWS, ids=lambda law: type(law).__name__)
def test_level_ground_is_in_equilibrium(law, K0):
    problem = ground(law, stress=mpm.geostatic(HEIGHT, DENSITY, K0, GRAVITY))
    assert problem.solve(1).total_iterations <= 1
    stays(problem)
    body = problem.bodies[0]
    np.testing.assert_allclose(body.stress[:, 0, 0], K0 * body.stress[:, 1, 1], rtol=1e-11)
    np.testing.assert_allclose(body.stress[:, 2, 2], K0 * body.stress[:, 1, 1], rtol=1e-11)


@pytest.mark.parametrize("cell", PLANE, ids=name)
@pytest.mark.parametrize(
    "options",
    [
        {"method": "gimp"},
        {"method": "mpm"},
        {"quadrature_degree": 2, "f_bar": "domain"},
        {"f_bar": "patch"},
        {"route": "reference"},
        {"problem": mpm.DynamicProblem},
    ],
    ids=str,
)
def test_other_ways(cell, options, take):
    options = dict(options)
    take(options.pop("route", "loops"))
    if cell == TRIANGLE and ("gimp" in options.values() or "domain" in options.values()):
        cell = QUADRILATERAL  # gimp has boxes, a triangle one point
    problem = ground(LAWS[4], cell, **options)
    if "problem" in options:
        problem.solve(time=0.1, dt=0.05)
    else:
        problem.solve(3)
    stays(problem)


def off_the_lines(cell, **options):
    """Ground of which patches and background cells have no corners in common."""
    V = vectors(box([0, 0], [4, 6], [5, 7], QUADRILATERAL))
    body = mpm.Particles(box([0, 0], [4, HEIGHT], [9, 11], cell, diagonal="right"), V, **options)
    return mpm.QuasiStaticProblem(
        mpm.Body(
            body,
            LAWS[4],
            DENSITY,
            GRAVITY,
            f_bar="patch" if not options else "domain",
            initial_stress=mpm.geostatic(HEIGHT, DENSITY, 0.5, GRAVITY),
        ),
        bcs=[fix(V, at(0, 0, 4), component=0), fix(V, at(1, 0), component=1)],
    )


@pytest.mark.parametrize(
    ("cell", "options"),
    [(TRIANGLE, {}), (QUADRILATERAL, {}), (QUADRILATERAL, {"quadrature_degree": 2})],
)
def test_averages_leave_level_ground_at_rest_whatever_comes_after(cell, options, mpi_tmp_path):
    problem = off_the_lines(cell, **options)
    for change in ("begin", "stage", "rebase", "repartition", "restore"):
        if change == "stage":
            problem.stage("equal", problem.body().replace(material=LAWS[4].with_parameters()))
        elif change in ("rebase", "repartition"):
            getattr(problem, change)()
        elif change == "restore":
            problem = off_the_lines(cell, **options)
            problem.solve(1)
            problem.save(mpi_tmp_path / "ground")
            problem = off_the_lines(cell, **options)
            problem.restore(mpi_tmp_path / "ground")
        problem.solve(1) if change in ("begin", "stage") else problem.step()
        assert largest(problem.particles.displacement.x.array) <= 1e-12 * HEIGHT, change


@pytest.mark.parametrize("scheme", ["conserving", "midpoint"])
def test_averages_account_for_all_energy_of_stressed_ground_that_shakes(scheme):
    whole = off_the_lines(TRIANGLE)
    (body,) = whole.setup.given
    body = body.replace(material=materials.Hencky(YOUNG, 0.3), velocity=(0.5, -0.5))
    problem = mpm.DynamicProblem(body, whole.bcs, scheme=scheme)
    problem.solve(time=0.05, dt=0.01)
    energies = problem.history.energies
    size = max(energy.kinetic for energy in energies)
    assert np.ptp([energy.balance for energy in energies]) < 1e-9 * size
    if scheme == "conserving":
        assert abs(energies[-1].dissipated) < 1e-9 * size


def test_averages_keep_no_pressure_that_there_is_not_at_first():
    """Ground without a stress settles as ever, and one that carries its weight feels a new load."""
    moved = []
    for stress in (None, 0.0):
        problem = off_the_lines(TRIANGLE)
        if stress is None:
            (body,) = problem.setup.given
            problem = mpm.QuasiStaticProblem(body.replace(initial_stress=None), problem.bcs)
        assert (problem.points[0].averaging.uneven == 0.0).all() == (stress is None)
        problem.solve(1)
        problem.stage(None, problem.body().replace(body_force=(0.0, -12.0)))
        problem.solve(1)
        moved.append(largest(problem.particles.displacement.x.array))
    assert 0.15 < moved[1] / moved[0] < 0.2  # 2 of 12, as nothing yields


def test_in_space():
    V = vectors(box([0, 0, 0], [1, 1, 4], [1, 1, 4], HEXAHEDRON))
    body = mpm.Particles(box([0, 0, 0], [1, 1, 3], [2, 2, 6], HEXAHEDRON), V)
    gravity = (0.0, 0.0, -10.0)
    sides = [fix(V, at(i, 0, 1), component=i) for i in (0, 1)]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            body,
            LAWS[4],
            density=DENSITY,
            body_force=gravity,
            initial_stress=mpm.geostatic(3.0, DENSITY, 0.6, gravity),
        ),
        bcs=[*sides, fix(V, at(2, 0), component=2)],
    )
    problem.solve()
    assert largest(np.abs(body.displacement.x.array)) <= 1e-12
    np.testing.assert_allclose(body.stress[:, 0, 0], 0.6 * body.stress[:, 2, 2], rtol=1e-11)


def test_layers_and_surcharge():
    layers, ratios, surcharge = [(2.0, 1.6), (1.0, 2.4), (9.0, 2.0)], [0.5, 0.8, 0.6], 30.0
    stress = mpm.geostatic(HEIGHT, layers, ratios, GRAVITY, surcharge)
    x = np.array([[0.0] * 5, [6.0, 4.0, 2.5, 1.0, 0.0], [0.0] * 5])
    vertical = -np.array([0.0, 46.0, 30 + 32 + 12, 30 + 32 + 24 + 20, 30 + 32 + 24 + 40])
    np.testing.assert_allclose(stress(x)[1, 1], vertical, rtol=1e-14)
    np.testing.assert_allclose(stress(x)[0, 0], np.array([0.5, 0.5, 0.8, 0.6, 0.6]) * vertical)
    np.testing.assert_allclose(stress(x)[0, 1], 0.0)

    V = vectors(box([0, 0], [4, 6], [4, 6], QUADRILATERAL))
    body = mpm.Particles(box([0, 0], [4, HEIGHT], [8, 10], QUADRILATERAL), V)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            body,
            LAWS[4],
            density=lambda x: ufl.conditional(
                ufl.gt(x[1], 3.0), 1.6, ufl.conditional(ufl.gt(x[1], 2.0), 2.4, 2.0)
            ),
            body_force=GRAVITY,
            tractions=[((0.0, -surcharge), 1)],
            facet_tags=facet_tags(body.mesh, at(1, HEIGHT)),
            initial_stress=stress,
        ),
        bcs=[fix(V, at(0, 0, 4), component=0), fix(V, at(1, 0), component=1)],
    )
    problem.solve()
    assert largest(np.abs(body.displacement.x.array)) <= 1e-12 * HEIGHT


def test_what_may_be_given():
    given = [[-10.0, 2.0, 0.0], [2.0, -20.0, 0.0], [0.0, 0.0, -5.0]]
    law = materials.Hencky(YOUNG, 0.3)

    def stress(value):
        problem = ground(law, stress=value)
        return problem.bodies[0].stress

    body = ground(law).bodies[0]
    n, x = body.num_local, ufl.SpatialCoordinate(body.mesh)
    for value in (
        given,
        np.tile(given, (n, 1, 1)),
        np.tile(given, (n, 1, 1, 1)),
        lambda x: np.multiply.outer(given, np.ones(x.shape[1])),
        ufl.as_matrix(np.array(given)) + 0 * x[0] * ufl.Identity(3),
    ):
        if isinstance(value, ufl.core.expr.Expr):
            V = body.V
            problem = mpm.QuasiStaticProblem(
                mpm.Body(mpm.Particles(body.mesh, V), law, initial_stress=value)
            )
            found = problem.bodies[0].stress
        else:
            found = stress(value)
        np.testing.assert_allclose(found, np.tile(given, (n, 1, 1)), atol=1e-12)


def test_what_is_refused():
    law = LAWS[4]
    with pytest.raises(mpm.MPMError, match="beyond yield") as caught:
        ground(law, stress=mpm.geostatic(HEIGHT, DENSITY, 0.1, GRAVITY))
    assert len(caught.value.particles) > 10
    with pytest.raises(mpm.MPMError, match="initial_stress must be"):
        ground(law, stress=np.zeros((2, 2)))
    with pytest.raises(mpm.MPMError, match="shape"):
        ground(law, stress=lambda x: np.zeros((2, 2, x.shape[1])))
    with pytest.raises(mpm.MPMError, match="not finite"):
        ground(law, stress=np.full((3, 3), np.nan))
    with pytest.raises(mpm.MPMError, match="gravity"):
        mpm.geostatic(0.0, 1.0, 0.5, (0.0, 0.0))
    with pytest.raises(mpm.MPMError, match="thickness"):
        mpm.geostatic(0.0, [(0.0, 1.0)], 0.5, GRAVITY)
    with pytest.raises(mpm.MPMError, match="level"):
        mpm.geostatic("top", 1.0, 0.5, GRAVITY)
    with pytest.raises(mpm.MPMError, match="not negative"):
        mpm.geostatic(0.0, -1.0, 0.5, GRAVITY)
    with pytest.raises(mpm.MPMError, match="not negative"):
        mpm.geostatic(0.0, 1.0, [-0.5], GRAVITY)
    with pytest.raises(mpm.MPMError, match="third component, but the body has 2"):
        ground(law, stress=mpm.geostatic(HEIGHT, DENSITY, 0.5, (0.0, 0.0, -10.0)))


@pytest.mark.skipif(WORLD.size == 1, reason="needs two ranks or more")
def test_ground_that_differs_between_ranks():
    with pytest.raises(mpm.MPMError, match="initial_stress differs between the ranks"):
        ground(LAWS[1], stress=mpm.geostatic(HEIGHT, DENSITY, 0.5 + 0.1 * WORLD.rank, GRAVITY))


def test_what_is_not_in_equilibrium_goes_with_the_load():
    """An elastic body under a stress of twice its weight heaves in proportion."""
    twice = mpm.geostatic(HEIGHT, 2 * DENSITY, 3 / 7, GRAVITY)
    problem = ground(materials.LinearElastic(1e9, 0.3), stress=twice)
    body, modulus = problem.bodies[0], 1e9 * 0.7 / 1.3 / 0.4
    heave = DENSITY * 10.0 * HEIGHT**2 / 2 / modulus
    for step in problem.steps(4):
        top = largest(body.displacement.x.array)
        assert top == pytest.approx(step.load * heave, rel=1e-7)
        weight = problem.reaction(problem.bcs[1])[1]
        assert weight == pytest.approx(step.load * DENSITY * 10.0 * HEIGHT * 4, rel=1e-9)


@pytest.mark.parametrize("law", [LAWS[4], CAM_CLAY, LAWS[0]], ids=lambda law: type(law).__name__)
def test_goes_with_the_body(law, mpi_tmp_path):
    problem = ground(law)
    problem.solve()
    problem.save(mpi_tmp_path / "ground.mpm")
    other = ground(law)
    other.restore(mpi_tmp_path / "ground.mpm")
    stays(other)
    plain = ground(law, stress=mpm.geostatic(HEIGHT, DENSITY, 1.0, GRAVITY))
    plain.restore(mpi_tmp_path / "ground.mpm")
    before = in_order(problem.bodies[0], problem.bodies[0].stress)
    np.testing.assert_allclose(
        in_order(plain.bodies[0], plain.bodies[0].stress), before, atol=1e-13
    )
    other.repartition(0.0)
    stays(other)
    other.split([3, 17])
    other.step()
    assert largest(np.abs(other.bodies[0].displacement.x.array)) <= 1e-12 * HEIGHT


def punched(water):
    """Return ground that a rigid punch presses, with water in it or without, and its path."""
    degree = 2 if water else 1
    V = vectors(box([0, 0], [4, 6], [4, 6], QUADRILATERAL), degree)
    ground = box([0, 0], [4, HEIGHT], [8 // degree, 10 // degree], QUADRILATERAL)
    body = mpm.Particles(ground, V, degree=degree)
    way = fem.Constant(V.mesh, np.zeros(2))
    under = fem.locate_dofs_geometrical(V, lambda x: (x[1] > 4.9) & (x[0] < 1.1))
    bcs = [
        fix(V, at(0, 0, 4), component=0),
        fix(V, at(1, 0), component=1),
        fem.dirichletbc(way, under, V),
    ]
    given = {"density": DENSITY, "body_force": GRAVITY, "bcs": bcs}
    given |= {"petsc_options": {"snes_rtol": 1e-11}}
    given["initial_stress"] = mpm.geostatic(HEIGHT, DENSITY, 0.5, GRAVITY)
    law = materials.MohrCoulomb(YOUNG, 0.3, cohesion=5.0, friction_angle=30.0)
    if not water:
        problem = posed(mpm.QuasiStaticProblem, body, law, **given)
        return problem, lambda: problem.steps(4, update=lambda t: np.put(way.value, 1, -0.1 * t))
    tags = facet_tags(body.mesh, at(1, HEIGHT))
    drained = {"facet_tags": tags, "drained": [(0.0, 1)], "permeability": 1e-3, "storage": 1e-4}
    problem = posed(mpm.PorousProblem, body, law, **given, **drained)
    return problem, lambda: problem.steps(
        time=0.4, dt=0.1, update=lambda t: np.put(way.value, 1, -0.25 * t)
    )


@pytest.mark.parametrize("water", [False, *slow(True)])
def test_ground_that_is_rebased_goes_on_as_ground_that_is_not(water, mpi_tmp_path):
    straight, steps = punched(water)
    for _ in steps():
        pass
    problem, steps = punched(water)
    for number, _ in enumerate(steps()):
        if number in (0, 2):
            problem.rebase()
            assert largest(problem.bodies[0].displacement.x.array) == 0.0
        if number == 1:
            problem.repartition(0.0)
        if number == 2:
            problem.save(mpi_tmp_path / "rebased")
    other, steps = punched(water)
    other.restore(mpi_tmp_path / "rebased")
    for _ in steps():
        pass
    assert largest(straight.bodies[0].plastic_strain) > 1e-3
    for each in (problem, other):
        assert each.history.iterations == straight.history.iterations
        same_run(outcome(each), outcome(straight), 1e-9)


def told(**of_ground):
    """Return ground of which geostatic is told something, by name, that may be wrong."""
    return mpm.geostatic(
        of_ground.pop("surface", HEIGHT),
        of_ground.pop("density", DENSITY),
        0.5,
        of_ground.pop("gravity", GRAVITY),
        **of_ground,
    )


TABLE = mpm.WaterTable(4.0, 10.0)
AS_IT_IS = {
    "plain": ({}, {}),
    "layers": (
        {"density": [(2.0, 1.5), (3.0, 2.5)]},
        {"density": lambda x: ufl.conditional(ufl.gt(x[1], 3.0), 1.5, 2.5)},
    ),
    "water": ({"water": TABLE}, {"pore_pressure": TABLE}),
    "water above": (
        {"water": mpm.WaterTable(7.0, 10.0)},
        {"pore_pressure": mpm.WaterTable(7.0, 10.0)},
    ),
    "water in UFL": (
        {"water": TABLE},
        {"pore_pressure": lambda x: 3.0 * (4.0 - x[1])},
    ),
    "water that slopes": (
        {"water": mpm.WaterTable([(0.0, 2.0), (4.0, 4.0)], 10.0)},
        {"pore_pressure": mpm.WaterTable([(0.0, 2.0), (4.0, 4.0)], 10.0)},
    ),
    "no water in it": ({}, {"pore_pressure": mpm.WaterTable(-1.0, 10.0)}),
    "a Function": (
        {"density": 1.0},
        {"density": lambda x: 0.0 * x[0] + 1.0},
    ),
    "a part": ({"surface": 9.0}, {"load": (0.0, -80.0)}),
    "surcharge": ({"surcharge": 30.0}, {"load": (0.0, -30.0)}),
    "a function that is meant": ({}, {"initial_stress": lambda x: told(density=9.0)(x)}),
}
OTHER = {
    "density": ({"density": 1.1 * DENSITY}, {}, r"a density .* of \(0, -20\), .* of \(0, -22\)"),
    "no weight": ({}, {"body_force": None}, r"of \(0, 0\), and mpm.geostatic of \(0, -20\)"),
    "size of gravity": ({"gravity": (0.0, -9.81)}, {}, r"of \(0, -19.62\)"),
    "upwards": ({"gravity": (0.0, 10.0), "surface": 0.0}, {}, r"of \(0, 20\)"),
    "aside": ({}, {"body_force": (1.0, -10.0)}, r"of \(2, -20\)"),
    "a layer": ({"density": [(2.0, 1.9), (3.0, 2.0)]}, {}, r"of \(0, -19\)"),
    "too low": ({"surface": 4.5}, {}, r"at \(.*4.75\) .*geostatic of \(0, 0\)"),
    "too high": ({"surface": 5.5}, {}, "on its top at 5, .* surface at 5.5, .* stress of 10"),
    "surcharge": ({"surcharge": 5.0}, {}, "nothing acts on its top"),
    "water in geostatic": ({"water": TABLE}, {}, "a pore_pressure of 0, and mpm.geostatic of 3"),
    "water in the body": ({}, {"pore_pressure": TABLE}, "a pore_pressure of 37.5, .* of 0;"),
    "other water": (
        {"water": TABLE},
        {"pore_pressure": mpm.WaterTable(3.5, 10.0)},
        r"pore_pressure of [\d.]+, and",
    ),
}


def body_of(geostatic, given, slope=0.0, problem=mpm.QuasiStaticProblem):
    """Make a problem of ground, whose surface may slope, and what geostatic is told of it."""
    V = vectors(box([0, 0], [4, 6], [4, 6], QUADRILATERAL))
    mesh = box([0, 0], [4, HEIGHT], [8, 10], QUADRILATERAL)
    mesh.geometry.x[:, 1] *= 1 - slope * mesh.geometry.x[:, 0]
    given = {"density": DENSITY, "body_force": GRAVITY, "initial_stress": told(**geostatic)} | given
    if "load" in given:
        given["tractions"] = [(given.pop("load"), 1)]
        given["facet_tags"] = facet_tags(mesh, at(1, HEIGHT))
    body = mpm.Body(mpm.Particles(mesh, V), LAWS[0], **given)
    return problem(body, bcs=[fix(V, at(0, 0, 4), component=0), fix(V, at(1, 0), component=1)])


@pytest.mark.parametrize("slope", [0.0, 0.1])
@pytest.mark.parametrize(("geostatic", "given"), AS_IT_IS.values(), ids=AS_IT_IS.keys())
def test_geostatic_that_was_told_of_the_body_as_it_is_warns_of_nothing(geostatic, given, slope):
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        body_of(geostatic, given, 0.0 if "load" in given else slope)


@pytest.mark.parametrize("problem", [mpm.QuasiStaticProblem, mpm.DynamicProblem])
@pytest.mark.parametrize(("geostatic", "given", "words"), OTHER.values(), ids=OTHER.keys())
def test_geostatic_that_was_told_of_other_ground_says_what_differs(
    geostatic, given, words, problem
):
    expected = pytest.warns(UserWarning, match=words) if WORLD.rank == 0 else nullcontext([])
    with expected as found:
        body_of(geostatic, given, problem=problem)
    assert all(warning.filename == __file__ for warning in found)  # the user's line


def test_the_top_of_ground_is_that_of_all_bodies_and_one_that_is_added_is_looked_at():
    V = vectors(box([0, 0], [4, 6], [4, 6], QUADRILATERAL))
    low = mpm.Particles(box([0, 0], [4, 3], [8, 6], QUADRILATERAL), V)
    high = mpm.Particles(box([0, 3], [4, HEIGHT], [8, 4], QUADRILATERAL), V)
    same = {"material": LAWS[0], "density": DENSITY, "body_force": GRAVITY}
    stress, heavier = told(), told(density=2.5 * DENSITY)
    sides = [fix(V, at(0, 0, 4), component=0), fix(V, at(1, 0), component=1)]
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        bodies = [mpm.Body(one, initial_stress=stress, **same) for one in (low, high)]
        mpm.QuasiStaticProblem(bodies, bcs=sides).solve()
        assert max(largest(one.displacement.x.array) for one in (low, high)) < 1e-12
    low = mpm.Particles(low.mesh, V)
    with pytest.warns(UserWarning, match="on its top at 3") if WORLD.rank == 0 else nullcontext():
        problem = mpm.QuasiStaticProblem(mpm.Body(low, initial_stress=stress, **same), bcs=sides)
    high = mpm.Particles(high.mesh, V)
    with pytest.warns(UserWarning, match=r"\(0, -50\)") if WORLD.rank == 0 else nullcontext():
        problem.add(mpm.Body(high, initial_stress=heavier, **same))
