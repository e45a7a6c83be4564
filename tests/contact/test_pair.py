# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Two bodies that touch: patch test, balance, derivatives, sliding, and no false gap."""

import numpy as np
import pytest
import scenes
from compare import EXACT, error_of_a_term, outcome, same_run
from marks import slow, thinned
from obstacles import on_plane
from pairs import POISSON, YOUNG, balance, fail_after, go_on_other_meshes, hertz, patch, spaces, two
from scenes import HEXAHEDRON, QUADRILATERAL, TETRAHEDRON, TRIANGLE, WORLD

from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx import contact
from mpm_dolfinx.contact.pair import DEGREES
from mpm_dolfinx.materials import Hencky, LinearElastic


@pytest.mark.parametrize(
    ("passes", "degree", "cells", "bound"),
    [
        (1, 9, (QUADRILATERAL, QUADRILATERAL), 1e-3),
        (2, 19, (QUADRILATERAL, QUADRILATERAL), 1e-3),
        (2, 9, (TRIANGLE, QUADRILATERAL), 1e-2),
    ],
)
def test_pressure_goes_through_facets_that_do_not_match(passes, degree, cells, bound, monkeypatch):
    monkeypatch.setitem(DEGREES, 2, degree)
    problem, touch, error, Q = patch(passes, cells=cells)
    assert error < bound
    assert np.abs(problem.reaction(touch) - Q[:, 1]).max() < 1e-7
    p = scenes.gather(touch.pressure[touch.touches])
    assert np.abs(p - 1.0).max() < 30 * bound
    assert sum(problem.history.iterations) <= 3


@pytest.mark.slow
@pytest.mark.parametrize(("passes", "order"), [(1, (0, 1)), (1, (1, 0)), (2, (0, 1))])
def test_pressure_between_cylinders_is_that_of_hertz(passes, order):
    problem, touch, radius = hertz(passes, order)
    force = np.abs(problem.reaction(touch)[1])
    half = np.sqrt(4.0 * force * (radius / 2) / np.pi * 2.0 * (1 - POISSON**2) / YOUNG)
    most = 2.0 * force / np.pi / half
    x, p, w = (scenes.gather(v) for v in (touch.points[:, 0], touch.pressure, touch.area))
    exact = most * np.sqrt(np.maximum(1.0 - (x / half) ** 2, 0.0))
    assert np.sqrt((w @ (p - exact) ** 2) / (w @ exact**2)) < 0.05
    assert p.max() == pytest.approx(most, rel=0.03)
    assert np.sqrt(4.0 * (w * p) @ x**2 / (w @ p)) == pytest.approx(half, rel=0.03)
    total, _ = balance(problem, touch)
    assert np.abs(total).max() < 1e-12 * force
    assert problem.history.cutbacks == 0


def test_forces_and_moments_of_friction_balance():
    problem, touch, path = two()
    for _ in problem.steps(8, update=path):
        total, moment = balance(problem, touch)
        size = np.abs(problem.reaction(touch)).max()
        assert np.abs(total).max() < 1e-12 * size
        assert abs(moment) < 1e-12 * size
    force = problem.reaction(touch)
    assert np.abs(problem.reaction(problem.bcs[0]) + force).max() < 1e-6 * np.abs(force).max()
    assert np.abs(problem.reaction(problem.bcs[1]) - force).max() < 1e-6 * np.abs(force).max()
    assert force[0] / force[1] == pytest.approx(-0.3, abs=0.03)
    assert not touch.sticks.all() and touch.touches.any()


@pytest.mark.parametrize("passes", [1, 2])
def test_stiffness_is_per_area_of_facets_that_have_become_wider(passes):
    wider, deep, n = 0.5, 0.05, 4
    bodies, values = [], []
    for low in (1.0, 0.0):
        V = scenes.vectors(scenes.box([-0.3, -0.3], [2.1, 2.4], [8, 9], QUADRILATERAL))
        body = scenes.box([0.0, low], [1.0, low + 1.0], [n, n], QUADRILATERAL)
        bodies.append(mpm.Particles(body, V))
        values.append(fem.Function(V))
    everywhere = np.arange(len(values[0].x.array) // 2, dtype=np.int32)
    touch = contact.Pair(*bodies, passes=passes)
    problem = mpm.QuasiStaticProblem(
        [mpm.Body(body, Hencky(YOUNG, POISSON)) for body in bodies],
        bcs=[fem.dirichletbc(value, everywhere) for value in values],
        terms=[touch],
    )

    def path(t):  # wider first, at a distance, then into each other
        for value, up in zip(values, (0.1 if t < 1.0 else -deep, 0.0), strict=True):
            value.interpolate(lambda x, up=up: (wider * x[0], 0.0 * x[1] + up))

    problem.solve(2, update=path)  # (values are of places, so each in one step)
    confined = YOUNG * (1 - POISSON) / (1 + POISSON) / (1 - 2 * POISSON)
    pressure = deep * confined * n / 2.0  # of both layers one behind the other
    assert problem.history.cutbacks == 0
    assert problem.reaction(touch) == pytest.approx([0.0, pressure * (1.0 + wider)], rel=1e-9)


def test_cohesion_is_borne_once_by_two_passes():
    dragged = []
    for passes in (1, 2):
        problem, touch, path = two(friction=contact.Coulomb(0.0, cohesion=0.5), passes=passes)
        problem.solve(8, update=path)
        dragged.append(problem.reaction(touch))
    # along the width of the block; the rest is that of the ground that heaps up before it
    assert dragged[1][0] == pytest.approx(-0.5 * 0.63, rel=0.15)
    assert dragged[1] == pytest.approx(dragged[0], rel=0.03)


@pytest.mark.parametrize("degree", [1, 2])
def test_tangent_is_the_derivative_of_the_forces(degree):
    problem, touch, path = two(degree=degree)
    steps = problem.steps(8, update=path)
    for _ in range(5):
        next(steps)
    bodies = problem.bodies
    # (in the middle of a step: at its end points that slip are about to stick)
    start = [body.displacement.x.array.copy() for body in bodies]
    start[0].reshape(-1, 2)[:] += (0.01, -0.002)
    touch.begin()
    assert error_of_a_term(touch, bodies, start) < 1e-6


def test_bodies_with_fields_of_their_own_meet_where_their_facets_do():
    Va, Vb = spaces([-0.4, -0.2], [2.4, 2.0], [14, 11])
    a = mpm.Particles(scenes.box([0.2, 1.1], [0.83, 1.6], [5, 4], QUADRILATERAL), Va)
    b = mpm.Particles(scenes.box([0.0, 0.0], [2.0, 1.0], [16, 8], QUADRILATERAL), Vb)
    touch = contact.Pair(a, b)
    top = fem.locate_dofs_geometrical(Va, lambda x: x[1] > 1.39)
    base = fem.locate_dofs_geometrical(Vb, lambda x: x[1] < 0.01)
    motion = fem.Constant(Va.mesh, np.zeros(2))
    bcs = [fem.dirichletbc(motion, top, Va), fem.dirichletbc(np.zeros(2), base, Vb)]
    problem = mpm.QuasiStaticProblem(
        [mpm.Body(p, Hencky(YOUNG, POISSON)) for p in (a, b)], bcs=bcs, terms=[touch]
    )

    def path(t):
        motion.value[:] = [0.0, -0.12 * t]

    # cells are 0.2 in size; with one field the bodies would feel each other from there on
    for step in problem.steps(12, update=path):
        gap = 0.1 - 0.12 * step.load
        force = problem.reaction(touch)[1]
        assert (force > 1e-9) == (gap < -1e-9), gap
        near = WORLD.allreduce(touch.gap.min(initial=np.inf), scenes.MPI.MIN)
        if gap >= 0.0:
            assert near == pytest.approx(gap, abs=1e-9)


@pytest.mark.mpi
def test_a_dragged_block_is_the_same_on_any_number_of_ranks():
    problem, touch, path = two(cells=(TRIANGLE, QUADRILATERAL))
    other, alone, same = two(cells=(TRIANGLE, QUADRILATERAL), comm=scenes.MPI.COMM_SELF)
    problem.solve(8, update=path)
    other.solve(8, update=same)
    force = other.reaction(alone)
    assert np.abs(problem.reaction(touch) - force).max() < 1e-9 * np.abs(force).max()
    assert abs(touch.moment((0, 0)) - alone.moment((0, 0)))[0] < 1e-9 * np.abs(force).max()
    same_run(outcome(problem), outcome(other), 1e-9)


@pytest.mark.mpi
def test_ranks_without_facets_of_a_body_take_part():
    def pressed(comm):
        def tags(a, b):
            foot = scenes.facet_tags(a, lambda x: np.isclose(x[1], 1.0) & (x[0] < 0.33))
            return [foot, scenes.facet_tags(b, scenes.at(1, 1.0))]

        problem, touch, path = two(comm=comm, tags_of=tags)
        problem.solve(2, update=lambda t: path(0.25 * t))
        return problem.reaction(touch), comm.allgather(len(touch.points))

    force, points = pressed(WORLD)
    alone, _ = pressed(scenes.MPI.COMM_SELF)
    assert np.abs(force - alone).max() < 1e-9 * np.abs(alone).max() and 0 in points


def test_a_step_through_the_other_body_is_refused():
    Va, Vb = spaces([-0.5, -0.5], [1.5, 2.0], [8, 10])
    upper = scenes.box([0.3, 1.02], [0.7, 1.42], [4, 4], QUADRILATERAL)
    lower = scenes.box([0.0, 0.5], [1.0, 1.0], [8, 4], QUADRILATERAL)
    a, b = mpm.Particles(upper, Va), mpm.Particles(lower, Vb)
    way = fem.Constant(Va.mesh, np.zeros(2))
    base = fem.locate_dofs_geometrical(Vb, lambda x: x[1] < 0.6)
    problem = mpm.QuasiStaticProblem(
        [mpm.Body(p, Hencky(YOUNG, POISSON)) for p in (a, b)],
        bcs=[
            fem.dirichletbc(way, fem.locate_dofs_geometrical(Va, lambda x: x[1] > -1.0), Va),
            fem.dirichletbc(np.zeros(2), base, Vb),
        ],
        terms=[touch := contact.Pair(a, b)],
    )
    way.value[1] = -1.2  # it comes out below, and touches nothing there
    with pytest.raises(mpm.ConvergenceError, match="goes through the other one"):
        problem.step()
    assert scenes.largest(a.displacement.x.array) == 0.0
    way.value[1] = -0.03
    problem.step()
    assert touch.reaction[1] > 0.0


def test_a_step_that_fails_leaves_everything_as_it_was():
    fail_after(5)


def test_a_checkpoint_goes_on_as_the_run_does(mpi_tmp_path):
    problem, touch, path = two()
    for _ in problem.steps(6, update=path):
        if len(problem.history.steps) == 4:
            problem.save(mpi_tmp_path / "half.ckpt")
            force = problem.reaction(touch)
    other, again, path = two()
    other.restore(mpi_tmp_path / "half.ckpt")
    assert np.abs(other.reaction(again) - force).max() < 1e-9 * np.abs(force).max()
    other.solve(6, update=path)
    end = problem.reaction(touch)
    assert np.abs(other.reaction(again) - end).max() < 1e-7 * np.abs(end).max()
    same_run(outcome(other), outcome(problem), EXACT)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["move", "rebase", "split"])
def test_contact_follows_other_meshes_of_the_bodies(what):
    go_on_other_meshes(what)


def test_a_pair_of_a_body_that_is_split_goes_on_from_a_checkpoint(mpi_tmp_path):
    cells = (QUADRILATERAL, QUADRILATERAL)
    problem, touch, path = two(cells)
    for number, _ in enumerate(problem.steps(6, update=path)):
        if number == 3:
            before = problem.reaction(touch)
            problem.split(np.arange(0, problem.bodies[1].num_global, 3), body=1)
            assert np.abs(problem.reaction(touch) - before).max() < 1e-8 * np.abs(before).max()
        if number == 4:
            problem.save(mpi_tmp_path / "split")
    other, again, path = two(cells)
    other.restore(mpi_tmp_path / "split")
    other.solve(6, update=path)
    end = problem.reaction(touch)
    assert np.abs(other.reaction(again) - end).max() < 1e-9 * np.abs(end).max()
    same_run(outcome(other), outcome(problem), EXACT)


@pytest.mark.parametrize("passes", [*slow(1), 2])
def test_a_pair_of_a_body_that_has_lost_domains_is_that_of_a_shorter_body(passes):
    # Nothing depends on the past here: elastic bodies without friction.
    found = []
    for columns, outside in ((14, "delete"), (13, "error")):
        Va, Vb = spaces([-0.3, -0.3], [1.5, 1.2], [12, 10])
        shape = scenes.box([0.0, 0.0], [0.1 * columns, 0.4], [columns, 4], QUADRILATERAL)
        lower = mpm.Particles(shape, Va, outside=outside)
        upper = mpm.Particles(scenes.box([0.1, 0.4], [0.9, 0.8], [6, 3], TRIANGLE), Vb)
        touch = contact.Pair(upper, lower, passes=passes)
        base, top = (
            fem.locate_dofs_geometrical(V, where)
            for V, where in ((Va, lambda x: x[1] < 0.01), (Vb, lambda x: x[1] > 0.7))
        )
        aside, down = (fem.Constant(V.mesh, np.zeros(2)) for V in (Va, Vb))
        problem = mpm.QuasiStaticProblem(
            [mpm.Body(p, Hencky(YOUNG, POISSON)) for p in (lower, upper)],
            bcs=[fem.dirichletbc(aside, base, Va), fem.dirichletbc(down, top, Vb)],
            terms=[touch],
        )

        def path(t, aside=aside, down=down):
            aside.value[0] = 0.34 * min(t, 0.5)
            down.value[1] = -0.04 * max(t - 0.5, 0.0)

        problem.solve(4, update=path)
        stress = scenes.in_order(upper, upper.stress)
        found.append((problem.reaction(touch), stress, int(lower.deleted.sum())))
    (force, stress, lost), (known, exact, _) = found
    assert WORLD.allreduce(lost) == 4
    assert abs(known[1]) > 1.0
    assert np.abs(force - known).max() < 1e-8 * np.abs(known).max()
    assert np.abs(stress - exact).max() < 1e-8 * np.abs(exact).max()


def test_bodies_of_different_degrees_come_to_touch():
    Va, Vb = spaces([-0.5] * 3, [1.5, 1.5, 2.5], [2, 2, 3])
    a = mpm.Particles(scenes.box([0.0, 0.0, 1.01], [1.0, 1.0, 2.0], [1] * 3, TETRAHEDRON), Va)
    b = mpm.Particles(scenes.box([0.0] * 3, [1.0] * 3, [1] * 3, TETRAHEDRON), Vb, degree=2)
    touch = contact.Pair(b, a, 0.3)
    top, base = (
        fem.locate_dofs_geometrical(V, where)
        for V, where in ((Va, lambda x: x[2] > 1.4), (Vb, lambda x: x[2] < 0.1))
    )
    motion = fem.Constant(Va.mesh, np.zeros(3))
    bcs = [fem.dirichletbc(motion, top, Va), fem.dirichletbc(np.zeros(3), base, Vb)]
    problem = mpm.QuasiStaticProblem(
        [mpm.Body(p, Hencky(YOUNG, POISSON)) for p in (b, a)], bcs=bcs, terms=[touch]
    )
    steps = problem.steps(2, update=lambda t: np.put(motion.value, 2, -0.018 * t))
    next(steps)
    assert not problem.reaction(touch).any()
    next(steps)
    force = problem.reaction(touch)
    assert force[2] < 0.0
    assert np.abs(problem.reaction(problem.bcs[1]) + force).max() < 1e-6 * abs(force[2])


@pytest.mark.slow
@pytest.mark.parametrize("cell", [TETRAHEDRON, HEXAHEDRON], ids=scenes.name)
def test_a_cube_is_dragged_on_another(cell):
    Va, Vb = spaces([-0.3, -0.3, -0.3], [1.3, 1.3, 2.1], [4, 4, 6])
    a = mpm.Particles(scenes.box([0.2, 0.2, 1.0], [0.8, 0.8, 1.5], [2, 2, 2], cell), Va)
    b = mpm.Particles(scenes.box([0.0] * 3, [1.0] * 3, [4, 4, 4], cell), Vb)
    touch = contact.Pair(a, b, 0.3)
    top = fem.locate_dofs_geometrical(Va, lambda x: x[2] > 1.25)
    base = fem.locate_dofs_geometrical(Vb, lambda x: x[2] < 0.15)
    motion = fem.Constant(Va.mesh, np.zeros(3))
    bcs = [fem.dirichletbc(motion, top, Va), fem.dirichletbc(np.zeros(3), base, Vb)]
    problem = mpm.QuasiStaticProblem(
        [mpm.Body(p, Hencky(YOUNG, POISSON)) for p in (a, b)], bcs=bcs, terms=[touch]
    )

    def path(t):
        motion.value[:] = [0.06 * max(2 * t - 1, 0.0), 0.0, -0.04 * min(2 * t, 1.0)]

    problem.solve(2, update=path)
    force = problem.reaction(touch)
    assert force[2] > 0.0 > force[0]
    assert force[0] / force[2] == pytest.approx(-0.3, abs=0.05)
    assert np.abs(problem.reaction(problem.bcs[0]) + force).max() < 1e-6 * force[2]
    assert np.abs(problem.reaction(problem.bcs[1]) - force).max() < 1e-6 * force[2]
    # what the points tell is what acts on both bodies, also of moments
    on_b = problem.reaction(problem.bcs[1])
    assert np.abs(on_b - force).max() < 1e-6 * force[2]


@pytest.mark.parametrize("passes", [1, 2])
def test_a_slit_in_a_body_opens_and_closes(passes):
    # Two leaves on fields of their own, tied at the root. Closed, with a tie as soft as contact,
    # the slit bears an even pressure as if there were none; open, it bears nothing.
    Va, Vb = spaces([-0.4, -0.3], [2.4, 1.8], [14, 11])
    upper = scenes.box([0.0, 0.5], [2.0, 1.0], [16, 4], QUADRILATERAL)
    lower = scenes.box([0.0, 0.0], [2.0, 0.5], [16, 4], QUADRILATERAL)

    def tagged(body, other):
        root = lambda x: np.isclose(x[1], 0.5) & (x[0] < 0.51)  # noqa: E731
        slit = lambda x: np.isclose(x[1], 0.5) & (x[0] > 0.49)  # noqa: E731
        return scenes.facet_tags(body, root, slit, scenes.at(1, other))

    tags = [tagged(upper, 1.0), tagged(lower, 0.0)]
    a, b = (mpm.Particles(m, V, quadrature_degree=2) for m, V in ((upper, Va), (lower, Vb)))
    k = YOUNG / (2 * 0.125)  # of a layer of domains on each side
    root = mpm.Tie(a, b, tags[0], 1, k)
    slit = contact.Pair(a, b, facets=[(one, 2) for one in tags], passes=passes)
    load = fem.Constant(upper, (0.0, 0.0))
    problem = mpm.QuasiStaticProblem(
        [
            mpm.Body(a, LinearElastic(YOUNG, 0.0), tractions=[(load, 3)], facet_tags=tags[0]),
            mpm.Body(b, LinearElastic(YOUNG, 0.0)),
        ],
        supports=[mpm.boundary.fixed(b, tags[1], 3)],
        terms=[root, slit],
    )

    def path(t):
        load.value[:] = 0.0, -0.01 * np.sin(2 * np.pi * t)
        for body in (a, b):
            body.load.value = 1.0

    for step in problem.steps(4, update=path):
        force = problem.reaction(slit)
        if step.load == 0.75:
            assert not slit.touches.any() and not force.any()
            assert WORLD.allreduce(slit.gap.max(initial=0.0), scenes.MPI.MAX) > 1e-5
        if step.load == 0.25:
            assert force == pytest.approx([0.0, 0.01 * 1.5], abs=1e-8 * 0.01)
            for body in (a, b):
                assert scenes.largest(body.stress[:, 1, 1] + 0.01) < 1e-8 * 0.01


def test_bodies_that_overlap_at_the_beginning_are_refused():
    Va, Vb = spaces([-0.5, -0.5], [1.5, 2.0], [8, 10])
    a = mpm.Particles(scenes.box([0.2, 0.9], [0.8, 1.5], [4, 4], QUADRILATERAL), Va)
    b = mpm.Particles(scenes.unit(6, QUADRILATERAL), Vb)
    with pytest.raises(mpm.MPMError, match=r"overlap at the beginning: particles .* up to 0\.1"):
        mpm.QuasiStaticProblem(
            [mpm.Body(p, Hencky(1e3, 0.3)) for p in (a, b)], terms=[contact.Pair(a, b)]
        )


@pytest.mark.parametrize("cell", [QUADRILATERAL, HEXAHEDRON], ids=scenes.name)
def test_narrow_blocks_of_one_width_stand_on_each_other(cell):
    # Points on a block's side, near its top, face the far side of the block above.
    dim = 2 if cell == QUADRILATERAL else 3
    Va, Vb = spaces([-0.3] * dim, [0.9] * dim, [4] * dim)
    size, up, n = np.full(dim, 0.3), np.eye(dim)[-1], [2] * (dim - 1) + [1]
    lower = mpm.Particles(scenes.box([0.0] * dim, size, n, cell), Va, quadrature_degree=2)
    body = scenes.box(0.3 * up, size + 0.3 * up, n, cell)
    upper = mpm.Particles(body, Vb, quadrature_degree=2)
    ground = contact.Rigid(lower, contact.plane([0.0] * dim, up), 0.4)
    touch = contact.Pair(upper, lower, 0.4)
    problem = mpm.QuasiStaticProblem(
        [
            mpm.Body(p, Hencky(1e4, 0.3), density=1.0, body_force=-100.0 * up)
            for p in (upper, lower)
        ],
        terms=[ground, touch],
    )
    problem.solve(3)
    weight = 100.0 * np.prod(size)
    assert problem.reaction(touch) == pytest.approx(weight * up, abs=1e-6 * weight)
    assert problem.reaction(ground) == pytest.approx(2.0 * weight * up, abs=1e-6 * weight)
    assert problem.history.cutbacks == 0


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"friction": -1.0}, "friction must be a number from 0"),
        ({"passes": 3}, "has 1 or 2 passes"),
        ({"passes": True}, "has 1 or 2 passes, not True"),
        ({"axisymmetric": 0}, r"axisymmetric of Pair\(\) must be True or False, not 0"),
        ({"facets": 1}, "facets= of a Pair must be two"),
        ({"penalty": 0}, "penalty must be a positive number"),
    ],
)
def test_what_makes_no_sense_is_refused(options, sentence):
    bodies = two()[0].bodies
    with pytest.raises(mpm.MPMError, match=sentence):
        contact.Pair(*bodies, **options)


def test_bodies_on_one_space_are_refused():
    (V,) = spaces([-0.5, -0.5], [1.5, 2.5], [4, 6], 1)
    a = mpm.Particles(scenes.unit(2, TRIANGLE), V)
    b = mpm.Particles(scenes.box([0.0, 1.0], [1.0, 2.0], [2, 2], TRIANGLE), V)
    with pytest.raises(mpm.MPMError, match="on the same V, which makes them stick"):
        contact.Pair(a, b)
    with pytest.raises(mpm.MPMError, match=r"never meet\. Cut the body in two"):
        contact.Pair(a, a)


@pytest.mark.skip_in_parallel
def test_a_slit_in_one_body_does_not_close():
    # Why there is no contact of a body with itself: a cell moves what is in it as one piece.
    left = scenes.box([0.0, 0.0], [2.0, 1.0], [32, 20], QUADRILATERAL, scenes.MPI.COMM_SELF)
    middle = mesh.compute_midpoints(left, 2, np.arange(640, dtype=np.int32))
    open_ = (np.abs(middle[:, 1] - 0.475) < 1e-6) & (middle[:, 0] < 1.5)
    kept = np.flatnonzero(~open_).astype(np.int32)
    body = mesh.create_submesh(left, 2, kept)[0]
    (V,) = spaces([-0.5, -0.25], [2.5, 1.5], [12, 7], 1, scenes.MPI.COMM_SELF)
    bodies = [mpm.Particles(part, V) for part in (body, left)]
    forces = []
    for particles in bodies:
        foot = fem.locate_dofs_geometrical(V, lambda x: x[1] < 1e-9)
        lid = contact.Rigid(particles, contact.plane((0.0, 1.0), (0.0, -1.0)))
        problem = mpm.QuasiStaticProblem(
            mpm.Body(particles, Hencky(1e3, 0.3)),
            bcs=[fem.dirichletbc(np.zeros(2), foot, V)],
            terms=[lid],
        )
        problem.solve(4, update=lambda t, lid=lid: lid.move((0.0, -0.15 * t)))
        forces.append(problem.reaction(lid)[1])
    x = bodies[0].node_positions
    start = body.geometry.x[:, :2]  # (of degree 1, but in another order)
    W = bodies[0].W.tabulate_dof_coordinates()
    faces = [np.flatnonzero(np.isclose(W[:, 1], y) & (W[:, 0] < 1.3)) for y in (0.45, 0.5)]
    low, high = (x[nodes[np.argsort(W[nodes, 0])], 1] for nodes in faces)
    assert len(start) == len(W) and len(low) == len(high) > 15
    gap = (high - low) / 0.05
    assert 0.5 < gap.min() and gap.max() < 1.0  # 0.2 cells at first, and as a material since then
    assert forces[0] == pytest.approx(forces[1], rel=0.05)


class Half(contact.Coulomb):
    """Half the bound of Coulomb's law."""

    def bound(self, at):
        return 0.5 * super().bound(at)


class Flat(contact.Friction):
    """A law of a user's own that is Coulomb's."""

    def bound(self, at):
        return 0.2 * at.pressure + 0.5 * at.stretch


@pytest.mark.parametrize(
    ("own", "law", "passes"),
    thinned(
        2,
        [
            (Half(0.4, 2.0, 12.0), contact.Coulomb(0.2, 1.0, 6.0), 2),
            (Half(0.4), contact.Coulomb(0.2), 2),
            (Flat(), contact.Coulomb(0.2, 0.5), 1),
            (Flat(), contact.Coulomb(0.2, 0.5), 2),
        ],
    ),
)
def test_a_law_of_a_users_own_holds_between_bodies(own, law, passes):
    found = []
    for friction in (own, law):
        problem, touch, path = two(friction=friction, passes=passes)
        problem.solver.setTolerances(rtol=1e-12)
        problem.solve(3, update=path)
        assert WORLD.allreduce(int((touch.touches & ~touch.sticks).sum())) > 0
        found.append(touch.reaction)
    np.testing.assert_allclose(found[0], found[1], rtol=1e-9)


def test_a_law_of_a_users_own_holds_a_block_on_an_obstacle():
    problem, ground, force = on_plane(Flat())
    force.value[:] = (1.0, -10.0)
    problem.solve(2)
    np.testing.assert_allclose(problem.reaction(ground), (-0.5, 5.0), rtol=1e-6)
