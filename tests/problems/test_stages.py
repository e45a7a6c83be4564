# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Stages: what is taken away or added goes over the run that follows, by exact solutions."""

import numpy as np
import pytest
from posed import posed
from scenes import (
    HEXAHEDRON,
    QUADRILATERAL,
    TETRAHEDRON,
    TRIANGLE,
    at,
    box,
    cell_tags,
    everywhere,
    facet_tags,
    fix,
    gather,
    in_order,
    largest,
    total,
    vectors,
)

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import materials

STIFF, POISSON, DENSITY, G = 1e10, 0.3, 2.0, 10.0
MODULUS = STIFF * (1 - POISSON) / (1 + POISSON) / (1 - 2 * POISSON)


def layer(cell=QUADRILATERAL, dim=2, material=None, space=1, problem=None, **options):
    """Return 10 of level elastic ground that carries its weight, in cells of 0.5."""
    width = [2.0] * (dim - 1)
    V = vectors(box([0.0] * dim, [*width, 12.0], [2] * (dim - 1) + [12], cell), space)
    mesh = box([0.0] * dim, [*width, 10.0], [4] * (dim - 1) + [20], cell)
    names = ("method", "degree", "quadrature_degree", "outside", "on_distortion")
    body = mpm.Particles(mesh, V, **{k: options.pop(k) for k in names if k in options})
    gravity = (*[0.0] * (dim - 1), -G)
    sides = [fix(V, at(i, 0, 2), component=i) for i in range(dim - 1)]
    K0 = POISSON / (1 - POISSON)
    return posed(
        problem or mpm.QuasiStaticProblem,
        body,
        material or materials.Hencky(STIFF, POISSON),
        density=DENSITY,
        body_force=gravity,
        bcs=[fix(V, at(dim - 1, 0), component=dim - 1), *sides],
        initial_stress=mpm.geostatic(10.0, DENSITY, K0, gravity),
        **options,
    )


def heave(problem, depth=3.0):
    """Return the largest relative error of the heave after a depth is dug out."""
    body = problem.bodies[0]
    there = ~body.deleted
    y = body.initial_centroid[there, -1]
    moved = (body.centroid[there] - body.initial_centroid[there])[:, -1]
    exact = DENSITY * G * depth * y / MODULUS  # a column under the same tension everywhere
    return largest(np.abs(moved / exact - 1))


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"cell": TRIANGLE},
        {"method": "cpdi"},
        {"method": "mpm"},
        {"quadrature_degree": 2, "f_bar": "domain"},
        {"quadrature_degree": 2, "axisymmetric": True},
        {"degree": 2, "space": 2, "cell": TRIANGLE},
        {"cell": HEXAHEDRON, "dim": 3},
        {"cell": TETRAHEDRON, "dim": 3},
        {"outside": "delete"},
        {"route": "reference"},
        {"degree": 2, "space": 2, "mixed": "pressure"},
        {"degree": 2, "space": 2, "mixed": "pressure", "route": "reference"},
    ],
    ids=lambda options: ",".join(f"{v}" for v in options.values()) or "plain",
)
def test_excavation_heaves_the_floor(options, take):
    options = dict(options)
    take(options.pop("route", "loops"))
    problem = layer(**options)
    problem.solve()
    problem.remove(lambda x: x[2 if "dim" in options else 1] > 7.0, name="pit")
    shares = []
    for step in problem.steps(2):
        shares.append(heave(problem, 3.0 * step.load))
    assert max(shares) < 1e-6
    history = problem.history
    assert [step.time for step in history.steps] == [1.0, 1.5, 2.0]
    assert [(stage.name, stage.time) for stage in history.stages] == [("pit", 1.0)]
    body = problem.bodies[0]
    y = body.initial_centroid[~body.deleted, -1]
    error = body.stress[~body.deleted][:, -1 if "dim" in options else 1]
    error = error[:, -1 if "dim" in options else 1] + DENSITY * G * (7.0 - y)
    assert largest(np.abs(error)) < 1e-7 * DENSITY * G * 7.0
    assert not history.losses


def test_excavation_at_once_ends_where_a_gradual_one_does():
    ends = []
    for sudden in (False, True):
        problem = layer()
        problem.solve()
        problem.remove(lambda x: x[1] > 7.0, sudden=sudden)
        errors = [heave(problem) for _ in problem.steps(3)]
        assert (errors[0] < 1e-6) == sudden and errors[-1] < 1e-6
        ends.append(in_order(problem.particles, problem.particles.centroid))
    np.testing.assert_allclose(*ends, atol=1e-13)


def test_lifts():
    """Each lift is placed at its design level; what it moves by is what comes above it."""
    n, H, weight, modulus, scale = 5, 10.0, DENSITY * G, 5000.0, 1e6
    b = H / n
    V = vectors(box([0, 0], [2, 12], [2, 12], QUADRILATERAL))
    law = materials.Hencky(modulus * scale, 0.0)
    given = {"density": DENSITY, "body_force": (0.0, -G)}

    def lift(k):
        return mpm.Particles(box([0, b * k], [2, b * (k + 1)], [4, 4], QUADRILATERAL), V)

    def tops(problem):
        found = []
        for k, body in enumerate(problem.bodies):
            X = body.W.tabulate_dof_coordinates()
            d = body.displacement.x.array.reshape(-1, 2)[np.isclose(X[:, 1], b * (k + 1)), 1]
            found.append(gather(d).mean() * scale)
        return np.array(found)

    bcs = [fix(V, at(0, 0, 2), component=0), fix(V, at(1, 0), component=1)]
    problem = posed(mpm.QuasiStaticProblem, lift(0), law, bcs=bcs, **given)
    problem.solve(2)
    placed = [tops(problem)[-1]]
    for k in range(1, n):
        problem.add(mpm.Body(lift(k), law, **given))
        assert problem.particles is not problem.bodies and len(problem.particles) == k + 1
        problem.solve(2)
        placed.append(tops(problem)[-1])
        weights = problem.reaction(bcs[1])[1]
        assert weights == pytest.approx(2 * (k + 1) * b * weight, rel=1e-9)
    moved = placed - tops(problem)
    k = np.arange(1, n + 1)
    np.testing.assert_allclose(moved, (n - k) * weight * b * (k * b) / modulus, atol=1e-6)
    np.testing.assert_allclose(moved, [0.064, 0.096, 0.096, 0.064, 0.0], atol=1e-6)
    assert problem.history.time == n


def strip(supported=True, **options):
    """Return a stiff elastic cantilever, with a prop at its end or without."""
    V = vectors(box([0, -1], [9, 3], [9, 4], QUADRILATERAL))
    body = mpm.Particles(box([0, 0.25], [7.75, 1.25], [16, 2], QUADRILATERAL), V, "cpdi2", 1, 2)
    nodes = V.tabulate_dof_coordinates()
    prop = np.flatnonzero(np.isclose(nodes[:, 0], 8) & np.isclose(nodes[:, 1], 1))
    bcs = [fix(V, at(0, 0))]
    if supported:
        dofs = V.sub(1).dofmap.list  # the prop's own component of V
        owned = np.unique(dofs.ravel())
        own = owned[np.isin(owned // 2, prop)].astype(np.int32)
        bcs.append(fem.dirichletbc(0.0, own, V.sub(1)))
    return posed(
        mpm.QuasiStaticProblem,
        body,
        materials.LinearElastic(1e9, 0.3),
        body_force=(0.0, -1.0),
        bcs=bcs,
        **options,
    )


def test_a_stage_while_a_prop_still_goes_changes_nothing_at_once():
    problem, free = strip(), strip(supported=False)
    free.solve()
    problem.solve()
    clamp = problem.bcs[0]
    problem.stage("no prop", bcs=problem.bcs[:1])
    next(problem.steps(2))
    half = problem.reaction(clamp)[1]
    problem.stage("the same", bcs=problem.bcs)
    for _ in problem.steps(1000):
        break
    assert problem.reaction(clamp)[1] == pytest.approx(half, rel=5e-3)
    problem.stage("the same again", bcs=problem.bcs)
    problem.solve(1)
    mine, its = (largest(np.abs(p.particles.displacement.x.array)) for p in (problem, free))
    assert mine == pytest.approx(its, rel=1e-6)


def test_a_prop_is_taken_away():
    problem, free = strip(), strip(supported=False)
    free.solve()
    problem.solve()
    clamp = problem.bcs[0]
    before = problem.reaction(clamp)[1]
    bent = largest(np.abs(problem.particles.displacement.x.array))
    problem.stage("no prop", bcs=problem.bcs[:1])
    half, _ = (problem.reaction(clamp)[1] for _ in problem.steps(2))
    after = problem.reaction(clamp)[1]
    assert 0.3 < before / after < 0.8
    assert half == pytest.approx((before + after) / 2, rel=1e-6)
    mine, its = (in_order(p.particles, p.particles.centroid) for p in (problem, free))
    np.testing.assert_allclose(mine, its, atol=1e-6 * bent)


def test_what_conditions_let_go_is_a_force_by_which_residuals_are_judged():
    """It is alone where what still holds, three rollers under a stretched square, bears nothing."""
    V = vectors(box([0.0, 0.0], [1.75, 1.75], [7, 7], QUADRILATERAL))
    body = mpm.Particles(box([0.0, 0.0], [1.125, 1.125], [9, 9], QUADRILATERAL), V)
    all_dofs, values = everywhere(V)
    values.interpolate(lambda x: np.array([0.01 * x[0], 0.0 * x[0]]))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(body, materials.LinearElastic(1e3, 0.0)), bcs=[all_dofs]
    )
    problem.solve(1)
    before = problem.reduced.scale()

    def roller(component, *corner):
        space = V.sub(component)
        nodes = fem.locate_dofs_geometrical(
            (space, space.collapse()[0]), lambda x: np.isclose(x[:2].T, corner).all(axis=1)
        )
        return fem.dirichletbc(0.0, nodes[0], space)

    problem.stage(bcs=[roller(0, 0.0, 0.0), roller(1, 0.0, 0.0), roller(1, 1.0, 0.0)])
    shares = [problem.reduced.scale() / before for _ in problem.steps(4)]
    np.testing.assert_allclose(shares, [0.75, 0.5, 0.25, 0.0], atol=0.1)
    assert max(np.abs(problem.reaction(bc)).max() for bc in problem.bcs) < 1e-8 * before


def test_loads_are_changed():
    """A load that is taken away goes; one that comes in its place comes."""
    body = layer().particles
    mine = []
    for first, second in (((0.0, -30.0), (0.0, -12.0)), ((0.0, -12.0), None)):
        problem = layer()
        body = problem.particles
        tags = facet_tags(body.mesh, at(1, 10.0))
        problem.stage(bodies=problem.body().replace(tractions=[(first, 1)], facet_tags=tags))
        problem.solve(2)
        if second is not None:
            problem.stage(
                bodies=problem.body().replace(tractions=[(second, 1)], body_force=(0.0, -G))
            )
            for step in problem.steps(2):
                held = problem.reaction(problem.bcs[0])[1]
                load = 30.0 + (12.0 - 30.0) * step.load
                assert held == pytest.approx(2 * (DENSITY * G * 10 + load), rel=1e-9)
        mine.append(in_order(body, body.centroid))
    np.testing.assert_allclose(*mine, atol=1e-13)
    with pytest.raises(mpm.MPMError, match="whole load"):
        problem.solve()


def test_a_stage_goes_on_from_what_it_is_given():
    """An unfinished stage keeps what it holds back; so does the one after it."""
    problem = layer()
    problem.solve()
    problem.remove(lambda x: x[1] > 7.0)
    steps = problem.steps(4)
    next(steps)
    steps.close()
    assert heave(problem, 0.75) < 1e-6
    problem.step()
    assert heave(problem, 0.75) < 1e-6
    with pytest.raises(mpm.MPMError, match="75 % of what the last stage"):
        problem.stage(sudden=True)
    problem.stage("nothing changes")
    problem.solve(3)
    assert heave(problem) < 1e-6


def test_other_materials_carry_the_stress():
    """Cement is poured into elastic ground: stress stays, and so does the rest's history."""
    soft, hard = materials.VonMises(1e4, 0.3, rho_y=100.0), materials.Hencky(1e6, 0.2)
    problem = layer(material=soft)
    tags = cell_tags(problem.particles.mesh, lambda x: np.where(x[:, 1] > 5.0, 2, 1))
    problem.stage("tags", problem.body().replace(material={1: soft, 2: soft}, cell_tags=tags))
    facets = facet_tags(problem.particles.mesh, at(1, 10.0))
    problem.stage("load", problem.body().replace(tractions=[((0.0, -200.0), 1)], facet_tags=facets))
    problem.solve(4)
    body = problem.particles
    stress, plastic = body.stress, body.plastic_strain
    assert total(body, plastic > 1e-3) > 50
    problem.stage("cement", problem.body().replace(material={1: soft, 2: hard}))
    np.testing.assert_allclose(body.stress, stress, rtol=1e-9, atol=1e-9)
    below = body.initial_centroid[:, 1] < 5.0
    assert np.array_equal(body.plastic_strain, np.where(below, plastic, 0.0))
    before = in_order(body, body.centroid)
    history = problem.solve(2)
    np.testing.assert_allclose(in_order(body, body.centroid), before, atol=1e-5)
    assert history.iterations[-1] <= 2


def test_what_cannot_be_leaves_all_as_it_was():
    problem = layer(material=materials.VonMises(1e4, 0.3, rho_y=100.0))
    problem.solve()
    body, x = problem.particles, in_order(problem.particles, problem.particles.stress)
    with pytest.raises(mpm.MPMError, match="facet_tags"):
        problem.stage(bodies=problem.body().replace(tractions=[((0.0, -1.0), 1)]))
    with pytest.raises(mpm.MPMError, match="beyond yield"):
        problem.stage(
            bodies=problem.body().replace(material=materials.VonMises(1e4, 0.3, rho_y=1.0))
        )
    with pytest.raises(mpm.MPMError, match="Nothing would be left"):
        problem.remove(lambda x: x[1] > -1.0)
    with pytest.raises(mpm.MPMError, match="no cells 5000"):
        problem.remove([3, 5000])
    with pytest.raises(mpm.MPMError, match="either"):
        problem.remove()
    with pytest.raises(mpm.MPMError, match=r"remove\(\) needs cell_tags="):
        problem.remove(tags=1)
    with pytest.raises(mpm.MPMError, match="No particle is to be removed"):
        problem.remove([])
    with pytest.raises(mpm.MPMError, match="given twice"):
        problem.add(mpm.Body(body, problem.setup.bodies[0].material))
    with pytest.raises(mpm.MPMError, match="given twice"):
        problem.stage(bodies=[problem.body(), problem.body().replace(density=1.0)])
    with pytest.raises(mpm.MPMError, match=r"takes one mpm\.Body"):
        problem.add([problem.body(), problem.body()])
    with pytest.raises(mpm.MPMError, match="no body 1"):
        problem.remove([0], body=1)
    V = vectors(box([0, 0], [2, 12], [2, 12], QUADRILATERAL))
    with pytest.raises(mpm.MPMError, match=r"not on the background space|is not on"):
        problem.stage(bcs=[fix(V, at(0, 0))])
    assert problem.particles is body and not problem.history.stages and body.deletion is None
    np.testing.assert_array_equal(in_order(body, body.stress), x)
    problem.remove(lambda x: x[1] > 7.0)
    problem.solve()
    assert total(body, body.deleted) == 24


@pytest.mark.parametrize(
    ("kind", "change", "sentence"),
    [
        (mpm.QuasiStaticProblem, {"velocity": (0.0, 1.0)}, "velocity= of a Body is for a Dynamic"),
        (
            mpm.QuasiStaticProblem,
            {"pore_fluid": mpm.PoreFluid(permeability=1.0, density=1.0)},
            "pore_fluid= of a Body is for a Porous",
        ),
        (mpm.QuasiStaticProblem, {"f_bar": "patch"}, "f_bar cannot change in a stage"),
        (mpm.QuasiStaticProblem, {"initial_stress": np.zeros((3, 3))}, "initial_stress cannot"),
        (mpm.DynamicProblem, {"density": None}, "needs a density"),
        (mpm.DynamicProblem, {"velocity": (0.0, 1.0)}, "velocity cannot change in a stage"),
    ],
)
def test_a_stage_gives_a_body_nothing_that_it_must_begin_with(kind, change, sentence):
    V = vectors(box([0, 0], [1, 2], [2, 4], QUADRILATERAL))
    body = mpm.Particles(box([0, 0], [1, 1], [4, 4], QUADRILATERAL), V)
    own = mpm.Body(body, materials.Hencky(1e4, 0.3), density=1.0, initial_stress=np.eye(3))
    problem = kind(own, bcs=[fix(V, at(1, 0))])
    with pytest.raises(mpm.MPMError, match=sentence):
        problem.stage(bodies=own.replace(**change))
    assert problem.body() is own and not problem.history.stages
    problem.stage(bodies=own.replace(initial_stress=own.initial_stress, f_bar="none"))


def staged(tags=False):
    """Return ground that yields, after its stages were begun: a pit, and a lift beside it."""
    law = materials.MohrCoulomb(1e4, 0.3, cohesion=5.0, friction_angle=30.0)
    problem = layer(material=law, cell=QUADRILATERAL)
    V = problem.particles.V
    problem.remove(lambda x: (x[1] > 8.0) & (x[0] < 1.0))
    lift = mpm.Particles(box([1, 10], [2, 11], [2, 2], QUADRILATERAL), V)
    problem.add(mpm.Body(lift, law, density=DENSITY, body_force=(0.0, -G)))
    return problem


def outcome(problem):
    """Return stress and position of all particles, in order."""
    return [
        np.hstack([in_order(b, b.centroid), in_order(b, b.stress).reshape(b.num_global, -1)])
        for b in problem.bodies
    ]


def test_restart_in_a_stage(mpi_tmp_path):
    problem = staged()
    steps = problem.steps(4)
    next(steps)
    next(steps)
    problem.save(mpi_tmp_path / "stage.mpm")
    at_half = outcome(problem)
    for _ in steps:
        pass
    end = outcome(problem)
    other = layer(material=materials.MohrCoulomb(1e4, 0.3, cohesion=5.0, friction_angle=30.0))
    with pytest.raises(mpm.MPMError, match="after the stages"):
        other.restore(mpi_tmp_path / "stage.mpm")
    other = staged()
    other.restore(mpi_tmp_path / "stage.mpm")
    for mine, its in zip(outcome(other), at_half, strict=True):
        np.testing.assert_array_equal(mine, its)
    other.solve(4)
    assert other.history.time == problem.history.time == 1.0
    for mine, its in zip(outcome(other), end, strict=True):
        np.testing.assert_allclose(mine, its, atol=1e-9)


def test_split_and_repartition_in_a_stage():
    plain, moved = staged(), staged()
    weights = []
    for number, problem in enumerate((plain, moved)):
        weights.append([])
        for step in problem.steps(4):
            weights[-1].append(problem.reaction(problem.bcs[0])[1])
            if number and step.load == 0.5:
                problem.repartition(0.0)
                before = problem.reaction(problem.bcs[0])
                body = problem.bodies[0]
                middle = body.initial_centroid  # those below the pit, where forces are held back
                below = (np.abs(middle[:, 1] - 7.75) < 0.1) & (middle[:, 0] < 1.0)
                problem.split([0, 33, *body.global_index[below]])
                np.testing.assert_allclose(problem.reaction(problem.bcs[0]), before)
                assert body.num_global == 84
    exact = DENSITY * G * (20.0 - 2.0 + 1.0) * np.arange(1, 5) / 4
    np.testing.assert_allclose(weights, [exact, exact], rtol=1e-9)
    mine, its = (largest(p.bodies[0].centroid[:, 1]) for p in (plain, moved))
    assert mine == pytest.approx(its, abs=1e-3)


def test_dynamics():
    """Mass and momentum of what stays do not change, whatever is taken away or comes."""
    problem = layer(problem=mpm.DynamicProblem, velocity=(0.0, -0.1))
    problem.solve(time=0.02, dt=0.01)
    body = problem.bodies[0]
    v = problem.velocity
    before = problem.momentum
    problem.remove(lambda x: x[1] > 9.0)
    rest = problem.momentum
    assert abs(rest[1]) < abs(before[1])
    assert problem.velocity.x.array is not None and v.function_space is body.W
    lift = mpm.Particles(box([0, 10], [2, 11], [4, 2], QUADRILATERAL), body.V)
    problem.add(mpm.Body(lift, materials.Hencky(STIFF, POISSON), DENSITY, (0.0, -G)))
    np.testing.assert_allclose(problem.momentum, rest, rtol=1e-12)
    problem.solve(time=0.04, dt=0.01)
    assert problem.history.time == 0.04
    energies = [e.balance for e in problem.history.energies]
    np.testing.assert_allclose(energies, energies[0], rtol=1e-6)
