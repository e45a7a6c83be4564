# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Quadrilaterals split into triangles in the middle of a run: what is kept, and what follows."""

import warnings

import numpy as np
import pytest
import scenes
from compare import outcome, same_run
from posed import posed
from routes import ROUTES, on_route
from scenes import ALL, HEXAHEDRON, QUADRILATERAL, TETRAHEDRON, TRIANGLE, WORLD
from splits import block_of, column, half_way, some, sums

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, LinearElastic, VonMises
from mpm_dolfinx.particles.domains import crossed


@pytest.mark.parametrize("route", ROUTES, indirect=True)
@pytest.mark.usefixtures("route")
def test_split_keeps_everything():
    problem = half_way(column())
    p = problem.particles
    before, which = sums(problem), some(p)
    per_particle = ("stress", "plastic_strain", "deformation_gradient", "point_stress")
    kept = {name: scenes.in_order(p, getattr(p, name)) for name in per_particle}
    total = p.num_global
    problem.split(which)
    same_run(sums(problem), before, 1e-12)
    assert p.num_global == total + len(which)
    assert problem.history.statistics["split_domains"] == len(which)
    origin = scenes.in_order(p, p.origin_index)
    assert np.array_equal(origin, [*range(total), *which])
    triangular = scenes.in_order(p, p.geometry.triangular)
    assert np.array_equal(np.flatnonzero(triangular), [*which, *range(total, p.num_global)])
    assert scenes.largest(p.domain_distortion()[p.geometry.triangular] - 1.0) == 0.0
    assert len(crossed(p)) == len(p.inverted()) == len(p.folded()) == 0
    for name, values in kept.items():
        size = np.abs(values).max()
        now = scenes.in_order(p, getattr(p, name))
        np.testing.assert_allclose(now, values[origin], rtol=0.0, atol=1e-12 * size, err_msg=name)


def split_half_way(**options):
    problem = half_way(column(**options))
    problem.split(some(problem.particles))
    while problem.particles.load.value < 0.9:
        problem.particles.load.value += 0.125
        problem.step()
    return problem


def test_after_a_split_routes_and_ranks_agree():
    results = [outcome(split_half_way())]
    if WORLD.size > 1:
        results.append(outcome(split_half_way(comm=scenes.MPI.COMM_SELF)))
    with on_route("reference"):
        results.append(outcome(split_half_way()))
    for other in results[1:]:
        same_run(other, results[0], 1e-9)


def test_split_at_first_is_a_body_of_triangles():
    # Undeformed, halves are triangles as any others: the answer is that of a mesh of them.
    def bar(body):
        V = scenes.vectors(scenes.box([0.0, -0.5], [3.0, 1.0], [12, 6], QUADRILATERAL))
        return mpm.QuasiStaticProblem(
            mpm.Body(
                mpm.Particles(body, V), Hencky(20.0, 0.3), density=1.0, body_force=(1.0, -0.2)
            ),
            bcs=[scenes.fix(V, scenes.at(0, 0.0))],
            solver=mpm.Solver(stabilisation=None),
        )

    corners = ([0.0, 0.0], [2.0, 0.5], [9, 3])
    split = bar(scenes.box(*corners, QUADRILATERAL))
    p = split.particles
    split.split(range(p.num_global))
    split.particles.undeformed.mass_share.x.array[:] = (
        1.0  # masses of triangles, not of quadrilaterals
    )
    # Split where undeformed, all are cut along the diagonal from the first corner to the last.
    triangles = bar(scenes.box(*corners, TRIANGLE, diagonal="right"))
    histories = [problem.solve(4) for problem in (split, triangles)]
    rows = []
    for problem in (split, triangles):
        q = problem.particles
        middle = np.column_stack([q.initial_centroid, q.centroid, q.stress.reshape(-1, 9)])
        rows.append(scenes.gather(middle))
    one, two = (r[np.lexsort(np.round(r[:, :2], 9).T)] for r in rows)
    np.testing.assert_allclose(one, two, rtol=0, atol=1e-9)
    assert histories[0].iterations == histories[1].iterations


def dented(policy="split", comm=WORLD):
    """Return four quadrilaterals, the middle of which is pushed into the first one."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [1.0, 1.0], [4, 4], QUADRILATERAL, comm))
    bc, u = scenes.everywhere(V)
    x = V.tabulate_dof_coordinates()
    inside = ((x[:, :2] > 0.1) & (x[:, :2] < 0.9)).all(axis=1)
    u.x.array.reshape(-1, 2)[inside] = -0.35
    body = scenes.box([0.0, 0.0], [1.0, 1.0], [2, 2], QUADRILATERAL, comm)
    particles = mpm.Particles(body, V, on_distortion=policy)
    return mpm.QuasiStaticProblem(mpm.Body(particles, Hencky(1e4, 0.3), density=2.0), bcs=[bc])


def test_concave_domains_are_split():
    problem = dented()
    p = problem.particles
    gradients = []
    for _ in problem.steps(10):
        corners = scenes.in_order(p, p.domains)
        gradients.append((corners, scenes.in_order(p, p.deformation_gradient)[:, :2, :2]))
    assert problem.history.statistics["split_domains"] == 1 and p.num_global == 5
    assert list(scenes.in_order(p, p.origin_index)) == [0, 1, 2, 3, 0]
    assert np.all(p.domain_distortion() > 0.0)
    plain = dented("error")
    plain.solve(10)
    q = plain.particles
    assert (scenes.in_order(q, q.domain_distortion()) < 0.0).sum() == 1
    # All nodes move as before, and each other domain has its stress.
    middle = [scenes.in_order(each, each.domains)[1:4] for each in (p, q)]
    np.testing.assert_allclose(*middle, rtol=0, atol=1e-13)
    stress = [scenes.in_order(each, each.stress)[1:4] for each in (p, q)]
    np.testing.assert_allclose(*stress, rtol=0, atol=1e-8)
    # The halves move as triangles from the moment of their split on.
    first = next(i for i, (corners, _) in enumerate(gradients) if len(corners) == 5)
    (then, F_then), (now, F_now) = gradients[first], gradients[-1]
    for half, last in ((0, 1), (4, 2)):
        edges = [
            np.stack([x[half, last] - x[half, 0], x[half, 3] - x[half, 0]]) for x in (then, now)
        ]
        motion = np.linalg.solve(edges[0], edges[1]).T
        np.testing.assert_allclose(F_now[half], motion @ F_then[half], rtol=1e-12)
    np.testing.assert_allclose(F_then[0], F_then[4], rtol=1e-12)
    # A Hencky body knows no history: its stress is that of F.
    state = problem.setup.bodies[0].material.initial_state(2, 2)
    H = F_now[[0, 4]] - np.eye(2)
    expected = problem.setup.bodies[0].material.update(H, state)
    expected = problem.setup.bodies[0].material.cauchy_stress(H, expected.state)
    stress = scenes.in_order(p, p.stress)[[0, 4]]
    np.testing.assert_allclose(stress, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_a_warning_tells_once():
    problem = dented()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        problem.solve(10)
        problem.split([1])
    told = [w for w in caught if "fold and are split" in str(w.message)]
    assert len(told) == (WORLD.rank == 0)


@pytest.mark.skip_in_parallel  # many failing steps
def test_what_keeps_a_step_from_converging_is_split():
    # One particle in a cell: hourglass stops the run at 48 %, and splitting takes it on.
    V = scenes.vectors(scenes.box([0.0, 0.0], [12.0, 9.0], [12, 9], QUADRILATERAL))
    body = scenes.box([0.0, 0.0], [4.0, 8.0], [4, 8], QUADRILATERAL)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            mpm.Particles(body, V, on_distortion="split"),
            VonMises(1e6, 0.3, rho_y=20e3),
            density=1000.0,
            body_force=(0.0, -20.0),
        ),
        bcs=[scenes.fix(V, scenes.at(i, 0.0), component=i) for i in (0, 1)],
        solver=mpm.Solver(stabilisation=None),
    )
    p, failing = problem.particles, 0.0
    for step in problem.steps(10):
        if p.geometry.triangular.any() and not failing:
            failing = step.load
        if failing and step.load > failing + 0.01:
            break
    assert 0.4 < failing < 0.6 and problem.history.cutbacks > 5
    assert np.all(problem.yield_function < 1e-8)
    np.testing.assert_allclose(scenes.total(p, p.initial_volume), 32.0, rtol=1e-12)


def test_loss_after_a_split_adds_up():
    loads = {"body_force": (0.0, -25.0), "pressures": (), "tractions": ()}
    problem = column(outside="delete", density=1000.0, **loads)
    p = problem.particles
    half_way(problem)
    problem.split(some(p))
    p.load.value = 0.6
    while not problem.history.losses or p.load.value < 1.0:
        p.load.value += 0.1
        problem.step()
    statistics = problem.history.statistics
    here = scenes.total(p, problem.built.masses(0)[~p.deleted])
    assert abs(here + statistics["lost_mass"] - 32e3) < 1e-12 * 32e3
    here = scenes.total(p, p.initial_volume[~p.deleted])
    assert abs(here + statistics["lost_volume"] - 32.0) < 1e-12 * 32.0


def test_repartition_after_a_split():
    problem = split_half_way()
    before = outcome(problem)
    problem.repartition(0.0)
    same_run(outcome(problem), before, 1e-13)
    one, two = problem, split_half_way()
    for each in (one, two):
        each.particles.load.value = 1.0
        each.step()
    same_run(outcome(one), outcome(two), 1e-9)


def test_checkpoint_after_a_split(tmp_path):
    path = scenes.WORLD.bcast(tmp_path) / "state"
    whole = column()
    for step in whole.steps(8):
        if step.load == 0.5:
            whole.split(some(whole.particles))
        if step.load == 0.75:
            whole.save(path)
    other = column()
    other.restore(path)
    assert np.array_equal(other.particles.trail.cuts, whole.particles.trail.cuts)
    assert other.history.statistics["split_domains"] == len(some(column().particles))
    other.solve(8)
    same_run(outcome(other), outcome(whole), 1e-9)
    # It can be restored again, but not where other domains are split.
    other.restore(path, resume=False)
    assert other.particles.load.value == 0.75
    third = half_way(column())
    third.split([5])
    with pytest.raises(mpm.MPMError, match="when other domains were split"):
        third.restore(path)
    flag = fem.Function(fem.functionspace(column().particles.mesh, ("DG", 0)), name="flag")
    with pytest.raises(mpm.MPMError, match="cannot be restored; restore it without"):
        column().restore(path, functions=[flag])
    # What could not be restored is not saved.
    flag = fem.Function(fem.functionspace(whole.particles.mesh, ("DG", 0)), name="flag")
    with pytest.raises(mpm.MPMError, match="save the state without them"):
        whole.save(path, functions=[flag])
    other.restore(path)


#: Cells of straight bodies that are rebased, their degree, and options.
REBASED = [
    *(pytest.param(cell, 1, {}, id=scenes.name(cell)) for cell in ALL),
    pytest.param(QUADRILATERAL, 2, {"mixed": "pressure"}, id="degree 2 with a pressure"),
    pytest.param(TRIANGLE, 3, {"mixed": "pressure"}, id="degree 3 with a pressure"),
    pytest.param(
        TETRAHEDRON, 2, {"mixed": "pressure"}, id="tetrahedra of degree 2", marks=pytest.mark.slow
    ),
    pytest.param(HEXAHEDRON, 2, {}, id="hexahedra of degree 2", marks=pytest.mark.slow),
    pytest.param(QUADRILATERAL, 1, {"f_bar": "patch"}, id="patches"),
    pytest.param(TRIANGLE, 1, {"f_bar": "patch"}, id="patches of triangles"),
    pytest.param(QUADRILATERAL, 2, {"f_bar": "domain"}, id="F-bar over the domain"),
    pytest.param(QUADRILATERAL, 2, {"axisymmetric": True}, id="around an axis"),
    pytest.param(
        QUADRILATERAL,
        2,
        {"axisymmetric": True, "mixed": "pressure"},
        id="with a pressure around it",
    ),
    pytest.param(
        TRIANGLE, 1, {"axisymmetric": True, "f_bar": "patch"}, id="patches around an axis"
    ),
    pytest.param(
        QUADRILATERAL,
        2,
        {"axisymmetric": True, "f_bar": "domain", "route": "reference"},
        id="the reference route around an axis",
        marks=pytest.mark.slow,
    ),
]


@pytest.mark.parametrize(("cell", "degree", "options"), REBASED)
def test_rebase_keeps_everything_and_changes_no_step(cell, degree, options, take):
    options = dict(options)
    take(options.pop("route", "loops"))
    problem, plain = (block_of(cell, degree, **options) for _ in range(2))
    for each in (problem, plain):
        half_way(each, 4)
    p, dim = problem.particles, plain.particles.mesh.geometry.dim
    before, state = sums(problem), outcome(problem)
    undeformed = [scenes.in_order(p, a) for a in (p.initial_domains, p.initial_centroid)]
    now = scenes.in_order(p, p.domains)
    problem.rebase()
    same_run(sums(problem), before, 1e-12)
    same_run(outcome(problem), state, 1e-12)
    assert scenes.largest(p.displacement.x.array) == 0.0
    for one, two in zip(undeformed, (p.initial_domains, p.initial_centroid), strict=True):
        np.testing.assert_allclose(scenes.in_order(p, two), one, rtol=0, atol=1e-15)
    x = p.W.tabulate_dof_coordinates()[p.domain_nodes][:, :, :dim]
    np.testing.assert_allclose(scenes.in_order(p, x), now, rtol=0, atol=1e-15)
    for each in (problem, plain):
        for load in (0.75, 1.0):
            each.particles.load.value = load
            each.step()
    assert scenes.largest(plain.particles.plastic_strain) > 1e-3
    assert problem.history.iterations == plain.history.iterations
    same_run(outcome(problem), outcome(plain), 1e-9)


def test_rebased_and_split_state_is_restored(tmp_path):
    path = WORLD.bcast(tmp_path) / "state"
    whole = half_way(block_of(QUADRILATERAL), 4)
    whole.split([1, 4])
    whole.rebase()
    whole.particles.load.value = 0.75
    whole.step()
    whole.split([7])
    whole.save(path)
    other = block_of(QUADRILATERAL)
    other.restore(path)
    same_run(outcome(other), outcome(whole), 1e-13)
    for each in (whole, other):
        each.particles.load.value = 1.0
        each.step()
    same_run(outcome(other), outcome(whole), 1e-9)
    before = sums(whole)
    whole.repartition(0.0)
    for name, value in sums(whole).items():
        size = np.abs(value).max()
        np.testing.assert_allclose(value, before[name], rtol=0, atol=1e-12 * size, err_msg=name)
    block_of(QUADRILATERAL).save(path)
    with pytest.raises(mpm.MPMError, match="when other domains were split"):
        whole.restore(path)
    rebased = half_way(block_of(QUADRILATERAL), 4)
    rebased.rebase()
    with pytest.raises(mpm.MPMError, match="before the body was rebased"):
        rebased.restore(path)


@pytest.mark.parametrize(
    ("degree", "options"),
    [(2, {"mixed": "pressure"}), (1, {"f_bar": "patch", "axisymmetric": True})],
    ids=["pressure", "patches around an axis"],
)
def test_rebased_body_is_restored_and_moves_to_other_ranks(tmp_path, degree, options):
    def block():
        return block_of(QUADRILATERAL, degree, **options)

    path = WORLD.bcast(tmp_path) / "state"
    whole = half_way(block(), 4)
    whole.rebase()
    whole.repartition(0.0)
    whole.particles.load.value = 0.75
    whole.step()
    whole.rebase()
    whole.save(path)
    other = block()
    other.restore(path)
    same_run(outcome(other), outcome(whole), 1e-13)
    for one, two in zip(whole.pressure, other.pressure, strict=True):
        ours, theirs = (
            scenes.in_order(p, f.x.array[: p.num_local * p.num_points].reshape(p.num_local, -1))
            for p, f in ((whole.particles, one), (other.particles, two))
        )
        assert np.array_equal(ours, theirs) and np.abs(ours).max() > 1.0
    straight = half_way(block(), 4)
    straight.particles.load.value = 0.75
    straight.step()
    for each in (whole, other, straight):
        each.particles.load.value = 1.0
        each.step()
    same_run(outcome(other), outcome(whole), 1e-9)
    same_run(outcome(straight), outcome(whole), 1e-9)


@pytest.mark.parametrize(
    ("cell", "degree"),
    [(TRIANGLE, 3), (QUADRILATERAL, 2), pytest.param(HEXAHEDRON, 2, marks=pytest.mark.slow)],
)
def test_rebase_keeps_the_mass_matrices(cell, degree):
    problem = half_way(block_of(cell, degree), 4)
    before = scenes.in_order(
        problem.particles, problem.built.mass_matrices(0, problem.particles.undeformed.volume_ratio)
    )
    problem.rebase()
    after = scenes.in_order(
        problem.particles, problem.built.mass_matrices(0, problem.particles.undeformed.volume_ratio)
    )
    np.testing.assert_allclose(after, before, rtol=0, atol=1e-13 * np.abs(before).max())
    shares = problem.particles.undeformed.mass_shares()
    np.testing.assert_allclose(shares, 1.0, rtol=0, atol=1e-10)


def test_rebase_refused():
    concave = dented("error")
    concave.solve(10)
    with pytest.raises(mpm.MPMError, match="particle 0 are concave or deleted"):
        concave.rebase()
    concave.split([0])
    concave.rebase()
    mild = dented("error")  # at the corner alone, not where mass is integrated
    next(step for step in mild.steps(10) if step.load > 0.75)
    assert (mild.particles.geometry.corner_jacobians(mild.particles.corners()) > -0.3).all()
    with pytest.raises(mpm.MPMError, match="particle 0 are concave or deleted"):
        mild.rebase()
    with pytest.raises(mpm.MPMError, match="density is a function of coordinates"):
        column().rebase()
    tall = scenes.column(scenes.A, 2, QUADRILATERAL, LinearElastic(1.0, 0.0), method="cpdi")
    with pytest.raises(mpm.MPMError, match="needs method='cpdi2' without free nodes"):
        tall.rebase()


def test_one_of_two_bodies():
    def blocks():
        V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 2.0], [4, 4], QUADRILATERAL))
        halves = [
            mpm.Particles(scenes.box([0.0, y], [1.0, y + 0.5], [4, 2], cell), V)
            for y, cell in ((0.0, TRIANGLE), (0.5, QUADRILATERAL))
        ]
        bcs = [scenes.fix(V, scenes.at(i, 0.0), component=i) for i in range(2)]
        law = Hencky(1e3, 0.3)
        return posed(
            mpm.QuasiStaticProblem, halves, law, density=[2.0, 3.0], body_force=(3, -9), bcs=bcs
        )

    problem = half_way(blocks(), 4)
    whole = np.array([problem.reaction(bc) for bc in problem.bcs])
    lower, upper = problem.bodies
    before = [scenes.in_order(lower, lower.centroid), scenes.in_order(lower, lower.stress)]
    with pytest.raises(mpm.MPMError, match="Only quadrilaterals"):
        problem.split([0], body=0)
    problem.split([2, 5], body=1)
    assert (lower.num_global, upper.num_global) == (16, 10)
    after = [scenes.in_order(lower, lower.centroid), scenes.in_order(lower, lower.stress)]
    assert all(map(np.array_equal, before, after))
    assert np.array_equal(whole, [problem.reaction(bc) for bc in problem.bcs])
    for body in problem.bodies:
        body.load.value = 1.0
    problem.step()
    # The supports carry the weight of both, and the force to the side.
    forces = sum(problem.reaction(bc) for bc in problem.bcs)
    np.testing.assert_allclose(forces, [-3 * 2.5, 9 * 2.5], rtol=1e-7)


def test_split_beside_a_body_of_degree_2():
    spaces = [
        scenes.vectors(scenes.box([0.0, 0.0], [2.0, 2.0], [4, 4], QUADRILATERAL), degree)
        for degree in (1, 2)
    ]
    shape = scenes.bend(scenes.box([0.0, 0.0], [1.0, 1.0], [4, 4], QUADRILATERAL), 0.03)
    bodies = [mpm.Particles(shape, V, degree=degree) for degree, V in enumerate(spaces, start=1)]
    bcs = [scenes.fix(V, scenes.at(i, 0.0), component=i) for V in spaces for i in range(2)]
    problem = posed(
        mpm.QuasiStaticProblem, bodies, Hencky(1e3, 0.3), 2.0, body_force=(3, -9), bcs=bcs
    )
    half_way(problem, 4)
    other = bodies[1]
    before = [scenes.in_order(other, a) for a in (other.centroid, other.stress, other.domains)]
    problem.split([2, 5], body=0)
    after = [scenes.in_order(other, a) for a in (other.centroid, other.stress, other.domains)]
    assert all(map(np.array_equal, before, after))
    assert (bodies[0].num_global, other.num_global) == (18, 16)
    for body in bodies:
        body.load.value = 1.0
    problem.step()
    forces = np.array([problem.reaction(bc) for bc in bcs])
    area = WORLD.allreduce(fem.assemble_scalar(fem.form(1.0 * ufl.dx(shape))))
    for part in (forces[:2], forces[2:]):  # each carries its own weight
        np.testing.assert_allclose(part.sum(axis=0), [-6.0 * area, 18.0 * area], rtol=1e-6)


def test_refused():
    problem = half_way(column(), steps=2)
    before = scenes.state(problem)
    with pytest.raises(mpm.MPMError, match="particle 1000 cannot be split: there are no such"):
        problem.split([3, 1000])
    with pytest.raises(mpm.MPMError, match="There is no body 1"):
        problem.split([3], body=1)
    on_one = [3] if WORLD.rank else [3.0]
    for wrong in ([1.7], [True], "3", [[1, 2], [3]], None, on_one):
        with pytest.raises(mpm.MPMError, match="global indices, whole numbers, not"):
            problem.split(wrong)
    scenes.assert_same_state(before, scenes.state(problem))
    problem.split([3])
    with pytest.raises(mpm.MPMError, match="particle 3 cannot be split"):
        problem.split([3])
    problem = scenes.block()
    with pytest.raises(mpm.MPMError, match="Only quadrilaterals in the plane with one quadrature"):
        problem.split([0])
    V, body = problem.particles.V, scenes.unit(4, QUADRILATERAL)
    particles = mpm.Particles(body, V, on_distortion="split")
    for options, reason in (
        ({"f_bar": "patch"}, "where no f_bar= or length= averages"),
        ({"axisymmetric": True}, "Only quadrilaterals in the plane"),
        ({"body_force": ufl.SpatialCoordinate(body)}, "so domains cannot be split"),
    ):
        with pytest.raises(mpm.MPMError, match=reason):
            posed(mpm.QuasiStaticProblem, particles, LinearElastic(1.0, 0.3), **options)
    d, v = particles.displacement, ufl.TestFunction(particles.W)
    R = ufl.derivative(scenes.neo_hookean(d) * particles.dx, d, v)
    with pytest.raises(mpm.MPMError, match=r"is for mpm\.QuasiStaticProblem"):
        mpm.ParticleProblem(R, particles)
    with pytest.raises(mpm.MPMError, match="Unknown policy on_distortion='mend'"):
        mpm.Particles(body, V, on_distortion="mend")
    with pytest.raises(mpm.MPMError, match="Only quadrilaterals"):
        mpm.Particles(body, V, on_distortion="split", quadrature_degree=2)
