# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bodies of which some nodes are free and the others carried."""

from itertools import product

import numpy as np
import pytest
import scenes
from marks import thinned
from scenes import HEXAHEDRON, QUADRILATERAL, TRIANGLE, WORLD, at

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, LinearElastic, VonMises
from mpm_dolfinx.particles.free import chosen_nodes

YOUNG, POISSON = 1e3, 0.3


def every(x):
    """All nodes are free."""
    return np.ones(x.shape[1], dtype=bool)


def right(x):
    """Nodes in the right half of a unit block are free."""
    return x[0] > 0.49


def body_in(cell, n=4, height=0.5, comm=WORLD):
    """Return the mesh of a block of unit length."""
    dim = 3 if cell == HEXAHEDRON else 2
    return scenes.box([0.0] * dim, [1.0, *[height] * (dim - 1)], [2 * n, *[n] * (dim - 1)], cell)


def around(dim=2, degree=1, shift=0.13, n=5, comm=WORLD):
    """Return a background space about a block, off its grid lines or with lines at its ends."""
    cell = HEXAHEDRON if dim == 3 else QUADRILATERAL
    lower = np.full(dim, -1.0 - shift)
    return scenes.vectors(scenes.box(lower, lower + 3.0, [3 * n] * dim, cell, comm), degree)


def difference(one, other):
    """Return the largest difference of the displacements of two bodies on one mesh."""
    return scenes.largest(scenes.own(one.displacement) - scenes.own(other.displacement))


@pytest.mark.parametrize(
    ("cell", "degree"), [(QUADRILATERAL, 1), (TRIANGLE, 2), (HEXAHEDRON, 1)], ids=str
)
def test_with_all_nodes_free_they_are_finite_elements(cell, degree):
    mesh, runs = body_in(cell, 2), []
    dim = mesh.geometry.dim
    tags = scenes.facet_tags(mesh, at(0, 1.0))
    for own in (
        mpm.Particles(mesh, degree=degree),
        mpm.Particles(mesh, around(dim, degree, n=2), degree=degree, free=every),
    ):
        hold = scenes.fix(own.W, at(0, 0.0))
        problem = mpm.QuasiStaticProblem(
            mpm.Body(
                own,
                Hencky(YOUNG, POISSON),
                density=1.0,
                body_force=(*[0.0] * (dim - 1), -50.0),
                tractions=[((20.0, *[-10.0] * (dim - 1)), 1)],
                facet_tags=tags,
            ),
            bcs=[hold],
        )
        problem.solve(3)
        count = problem.history.total_iterations, problem.history.statistics["free_dofs"]
        runs.append((own, problem.reaction(hold), count))
    (one, force, counts), (two, its, its_counts) = runs
    assert scenes.largest(one.displacement.x.array) > 0.1
    assert difference(one, two) < 1e-10
    assert np.abs(force - its).max() < 1e-9 * np.abs(force).max()
    assert counts == its_counts


def test_conditions_on_the_background_hold_free_nodes_too():
    mesh, runs = body_in(QUADRILATERAL), []
    V = around(shift=0.0)
    for own in (mpm.Particles(mesh), mpm.Particles(mesh, V, free=every)):
        space = own.V
        conditions = [
            scenes.fix(space, at(1, 0.0), component=1) if space is own.W else mpm.held(V, 1, y=0.0),
            scenes.fix(space, at(0, 0.0), 0.0, 0) if space is own.W else mpm.held(V, 0, x=0.0),
            scenes.fix(space, at(0, 1.0), 0.2, 0)
            if space is own.W
            else mpm.held(V, 0, x=1.0, value=0.2),
        ]
        law = VonMises(YOUNG, POISSON, rho_y=60.0, hardening=100.0)
        problem = mpm.QuasiStaticProblem(mpm.Body(own, law), bcs=conditions)
        problem.solve(1)
        runs.append((own, [problem.reaction(bc) for bc in conditions]))
    (one, forces), (two, its) = runs
    assert scenes.largest(one.displacement.x.array) == pytest.approx(0.2, abs=1e-9)
    assert difference(one, two) < 1e-10
    assert np.abs(np.array(forces) - its).max() < 1e-9 * np.abs(forces).max()


@pytest.mark.parametrize(
    ("kind", "free"),
    thinned(2, product([mpm.QuasiStaticProblem, mpm.DynamicProblem], [every, right, "auto"])),
)
@pytest.mark.filterwarnings("ignore:Time steps of")
def test_held_dofs_of_the_background_lead_free_nodes_over_steps(kind, free, mpi_tmp_path):
    """They go on to follow what holds them, to and fro, off the lines where that is, and let go.

    On their way they leave the background, come from a checkpoint and to other ranks.
    """

    def made(free):
        mesh = body_in(QUADRILATERAL, 3)
        V = scenes.vectors(scenes.box([-0.4, -0.25], [1.2, 0.75], [8, 4], QUADRILATERAL))
        if free is None:
            own = mpm.Particles(mesh)
        else:
            own = mpm.Particles(mesh, V, free=free, quadrature_degree=2)
        pull = fem.Constant(own.V.mesh, 0.0)
        law = VonMises(YOUNG, POISSON, rho_y=60.0, hardening=100.0)
        ends = [mpm.held(own.V, 0, x=1.0, value=pull), mpm.held(own.V, 1, y=0.0)]
        problem = kind(
            mpm.Body(own, law, density=100.0, tractions=[((2.0, 0.0), 1)], facet_tags=top(mesh)),
            bcs=[mpm.held(own.V, 0, x=0.0), *ends],
            solver=mpm.Solver(petsc_options={"snes_rtol": 1e-11}),
        )
        return problem, pull

    def top(mesh):
        return scenes.facet_tags(mesh, at(1, 0.5))

    def run(problem, pull, until):
        path = lambda t: setattr(pull, "value", 0.25 * np.sin(2.0 * t))  # noqa: E731
        if kind is mpm.DynamicProblem:
            problem.solve(time=until, dt=0.25, update=path)
        else:
            start = until - 1.0
            problem.solve(4, update=lambda t: path(start + t))
        return scenes.in_order(problem.particles, problem.particles.centroid)

    runs = []
    for nodes in (None, free):
        problem, pull = made(nodes)
        run(problem, pull, 1.0)
        if nodes is not None:
            problem.save(mpi_tmp_path / "state")
            problem, pull = made(nodes)
            pull.value = 0.25 * np.sin(2.0)
            problem.restore(mpi_tmp_path / "state")
            problem.repartition(0.0)
        led, force = run(problem, pull, 2.0), problem.reaction(problem.bcs[1])
        problem.stage("let go", bcs=[problem.bcs[0], problem.bcs[2]])
        runs.append((led, force, run(problem, pull, 3.0)))
    for mine, other in zip(*runs, strict=True):
        gap = np.abs(mine - other).max() / np.abs(mine).max()
        assert gap < 1e-8 if free is not right else 1e-8 < gap < 0.1


@pytest.mark.parametrize("degree", [1, 2])
def test_equilibrium_in_the_larger_space_is_that_of_dense_algebra(degree):
    mesh = body_in(QUADRILATERAL, 3)
    own = mpm.Particles(mesh, around(degree=degree, n=2), degree=degree, free=right)
    assert 0 < WORLD.allreduce(own.free.sum()) < WORLD.allreduce(len(own.free))
    tags = scenes.facet_tags(mesh, at(0, 0.0), at(0, 1.0))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(own, LinearElastic(YOUNG, POISSON), tractions=[((3.0, -2.0), 2)], facet_tags=tags),
        supports=[mpm.boundary.fixed(own, tags, 1)],
        solver=mpm.Solver(stabilisation=None),
    )
    T = scenes.dense(own.T)
    chosen = scenes.gather(own.free[: own.W.dofmap.index_map.size_local])
    free = np.repeat(chosen, 2)
    assert not T[free].any() and T[~free].any(axis=1).all()
    space = np.column_stack([T[:, T.any(axis=0)], np.eye(len(free))[:, free]])
    problem.solve(1)
    d = scenes.gather(scenes.own(own.displacement))
    inside = space @ np.linalg.lstsq(space, d, rcond=None)[0]
    assert np.abs(inside - d).max() < 1e-11 * np.abs(d).max()
    force = scenes.gather(problem.reduced.terms.nodal_forces()[0])
    assert np.abs(space.T @ force).max() < 1e-8 < 1e-3 * np.abs(force).max()


@pytest.mark.parametrize("f_bar", ["none", "domain", "patch"])
def test_a_uniform_strain_is_exact_across_the_joint(f_bar):
    mesh = scenes.bend(scenes.unit(8, QUADRILATERAL), 0.02)
    mesh.geometry.x[:] *= 0.93
    own = mpm.Particles(mesh, around(shift=0.0), free=right)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            own,
            LinearElastic(YOUNG, POISSON),
            f_bar=f_bar,
            tractions=[((10.0, 0.0), 1)],
            facet_tags=scenes.facet_tags(mesh, at(0, 0.93)),
        ),
        bcs=[mpm.held(own.V, 0, x=0.0), mpm.held(own.V, 1, y=0.0)],
    )
    problem.solve(1)
    strain = np.array([1.0 - POISSON**2, -POISSON * (1.0 + POISSON)]) * 10.0 / YOUNG
    x = own.W.tabulate_dof_coordinates()[:, :2]
    d = own.displacement.x.array.reshape(-1, 2)
    assert scenes.largest(d - strain * x) < 1e-10 * strain[0]


@pytest.mark.parametrize("scheme", ["conserving", "midpoint"])
def test_a_body_that_flies_keeps_its_momenta(scheme):
    mesh = body_in(QUADRILATERAL)
    own = mpm.Particles(mesh, around(), free=right)
    velocity = lambda x: np.array([0.3 - 0.8 * x[1], 0.2 + 0.8 * x[0]])  # noqa: E731
    problem = mpm.DynamicProblem(
        mpm.Body(own, Hencky(YOUNG, POISSON), density=1.0, velocity=velocity), scheme=scheme
    )
    rows = []
    x0, v = ufl.SpatialCoordinate(own.mesh), problem.velocity
    x = x0 + own.displacement
    forms = [v[0] * own.dx_exact, v[1] * own.dx_exact, (x[0] * v[1] - x[1] * v[0]) * own.dx_exact]
    compiled = [fem.form(form) for form in forms]
    for _ in problem.steps(time=0.2, dt=0.02):
        rows.append([WORLD.allreduce(fem.assemble_scalar(form)) for form in compiled])
    rows = np.array(rows)
    assert len(rows) == 10
    assert np.ptp(rows[:, :2], axis=0).max() < 1e-12
    assert scenes.largest(own.displacement.x.array) > 0.03
    if scheme == "conserving":
        assert np.ptp(rows[:, 2]) < 1e-11


def test_nodes_may_be_freed_and_carried_between_runs():
    mesh = body_in(QUADRILATERAL)
    own = mpm.Particles(mesh, around(shift=0.0), free=[])
    tags = scenes.facet_tags(mesh, at(0, 1.0))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(own, Hencky(YOUNG, POISSON), tractions=[((0.0, -5.0), 1)], facet_tags=tags),
        bcs=[mpm.held(own.V, x=0.0)],
        solver=mpm.Solver(petsc_options={"snes_rtol": 1e-12}),
    )
    problem.solve(2)
    carried = own.displacement.x.array.copy()
    own.free = right
    for _ in range(4):  # each from where the background is evaluated anew
        problem.step()
    freed = own.displacement.x.array.copy()
    assert scenes.largest(freed - carried) > 1e-4
    own.free = []
    problem.step()
    # What is in equilibrium in the larger space is so in the smaller one.
    assert scenes.largest(own.displacement.x.array - freed) < 1e-10


def test_free_nodes_may_leave_the_background():
    mesh = body_in(QUADRILATERAL)
    V = scenes.vectors(scenes.box([-0.4, -0.4], [0.7, 0.9], [11, 13], QUADRILATERAL))
    own = mpm.Particles(mesh, V, free=right)
    tags = scenes.facet_tags(mesh, at(0, 1.0))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(own, Hencky(YOUNG, POISSON), tractions=[((0.0, -5.0), 1)], facet_tags=tags),
        bcs=[mpm.held(V, x=0.0)],
    )
    problem.solve(1)
    assert scenes.largest(own.displacement.x.array) > 0.01


def test_a_body_of_free_nodes_meets_another_as_finite_elements_do():
    runs = []
    for free in (None, every):
        mesh = body_in(QUADRILATERAL, 2)
        above = scenes.box([0.2, 0.5], [0.8, 0.8], [4, 2], QUADRILATERAL)
        first = mpm.Particles(mesh) if free is None else mpm.Particles(mesh, around(), free=free)
        second = mpm.Particles(above)
        tops = scenes.facet_tags(mesh, at(1, 0.5), at(1, 0.0))
        bottoms = scenes.facet_tags(above, at(1, 0.5), at(1, 0.8))
        contact = mpm.contact.Pair(first, second, 0.3, facets=((tops, 1), (bottoms, 1)))
        push = scenes.fix(second.W, at(1, 0.8), np.array([0.01, -0.03]))
        problem = mpm.QuasiStaticProblem(
            [mpm.Body(first, Hencky(YOUNG, POISSON)), mpm.Body(second, Hencky(YOUNG, POISSON))],
            bcs=[scenes.fix(first.W, at(1, 0.0)), push],
            terms=[contact],
        )
        problem.solve(3)
        runs.append((first, problem.reaction(push)))
    (one, force), (two, its) = runs
    assert force[1] < -1.0 and abs(force[0]) > 0.1
    assert difference(one, two) < 1e-9
    assert np.abs(force - its).max() < 1e-7 * np.abs(force).max()


def test_a_run_goes_on_from_a_checkpoint_as_it_was(mpi_tmp_path):
    def made():
        mesh = body_in(QUADRILATERAL)
        own = mpm.Particles(mesh, around(shift=0.0), free=[])
        tags = scenes.facet_tags(mesh, at(0, 1.0))
        law = VonMises(YOUNG, POISSON, rho_y=10.0, hardening=50.0)
        return mpm.QuasiStaticProblem(
            mpm.Body(own, law, tractions=[((1.0, -1.0), 1)], facet_tags=tags),
            bcs=[mpm.held(own.V, x=0.0)],
        )

    whole = made()
    whole.particles.free = right
    steps = whole.steps(4)
    for _ in range(2):
        next(steps)
    whole.save(mpi_tmp_path / "state")
    for _ in steps:
        pass
    again = made()
    again.restore(mpi_tmp_path / "state")
    assert np.array_equal(again.particles.free, whole.particles.free)
    again.solve(4)
    assert len(again.history.steps) == len(whole.history.steps) == 4
    scenes.assert_same_state(scenes.state(whole), scenes.state(again))


def test_conditions_on_carried_nodes_are_refused():
    own = mpm.Particles(body_in(QUADRILATERAL), around(), free=right)
    body = mpm.Body(own, Hencky(YOUNG, POISSON))
    with pytest.raises(mpm.MPMError, match=r"on particles\.W holds carried nodes, e\.g\. at \("):
        mpm.QuasiStaticProblem(body, bcs=[scenes.fix(own.W, at(0, 0.0))])
    problem = mpm.QuasiStaticProblem(body, bcs=[scenes.fix(own.W, at(0, 1.0))])
    own.free = []
    with pytest.raises(mpm.MPMError, match="holds carried nodes"):
        problem.solve(1)


def test_conditions_on_free_nodes_do_not_follow_to_another_mesh():
    own = mpm.Particles(body_in(QUADRILATERAL), around(), free=right)
    hold = scenes.fix(own.W, at(0, 1.0))
    problem = mpm.QuasiStaticProblem(mpm.Body(own, Hencky(YOUNG, POISSON)), bcs=[hold])
    for move in (problem.repartition, problem.rebase):
        with pytest.raises(mpm.MPMError, match="conditions on W lie on the present body mesh"):
            move()


def test_a_stage_lets_go_of_free_nodes_that_a_condition_on_the_background_held(mpi_tmp_path):
    # They hang on a wall on a grid line; it is taken away over four steps.
    def made(free):
        mesh = body_in(QUADRILATERAL)
        if free is None:
            own = mpm.Particles(mesh)
        else:
            own = mpm.Particles(mesh, around(shift=0.0), free=free)
        walls = [at(0, 0.0), at(0, 1.0)]
        if free is None:
            bcs = [scenes.fix(own.W, wall) for wall in walls]
        else:
            bcs = [mpm.held(own.V, x=x) for x in (0.0, 1.0)]
        law = VonMises(YOUNG, POISSON, rho_y=30.0, hardening=50.0)
        return mpm.QuasiStaticProblem(
            mpm.Body(own, law, density=1.0, body_force=(0.0, -20.0)), bcs=bcs
        )

    runs = []
    for free in (None, every):
        problem = made(free)
        problem.solve(2)
        if free is not None:
            problem.save(mpi_tmp_path / "state")
            problem = made(free)
            problem.restore(mpi_tmp_path / "state")
        problem.stage("let go", bcs=problem.bcs[:1])
        path, ends = [], problem.steps(4)
        for _ in ends:
            path.append(scenes.own(problem.particles.displacement).copy())
        runs.append((path, problem.reaction(problem.bcs[0])))
    (one, force), (two, its) = runs
    assert scenes.largest(one[0]) < 0.5 * scenes.largest(one[-1])
    for mine, other in zip(one, two, strict=True):
        assert scenes.largest(mine - other) < 1e-9
    assert np.abs(force - its).max() < 1e-8 * np.abs(force).max()


@pytest.mark.parametrize("end", [0.1, 0.0])
def test_conditions_on_free_nodes_move_them_as_those_of_finite_elements(end):
    # and where one on the background holds a node too, its own counts
    mesh, runs = body_in(QUADRILATERAL), []
    V = around(shift=0.0)
    for own in (mpm.Particles(mesh), mpm.Particles(mesh, V, free=every)):
        moved = scenes.fix(own.W, at(0, 1.0), end)
        held = mpm.held(V, x=1.0) if own.V is V else None
        conditions = [scenes.fix(own.W, at(0, 0.0)), moved, *([held] if held else [])]
        problem = mpm.QuasiStaticProblem(
            mpm.Body(own, Hencky(YOUNG, POISSON), body_force=(0.0, -20.0)), bcs=conditions
        )
        problem.solve(2)
        runs.append((own, problem.reaction(moved), problem.history.total_iterations))
    (one, force, count), (two, its, its_count) = runs
    assert difference(one, two) < 1e-10
    assert np.abs(force - its).max() < 1e-9 * np.abs(force).max()
    assert count == its_count


def test_free_nodes_of_removed_cells_alone_are_no_unknowns():
    mesh = body_in(QUADRILATERAL, 2)
    own = mpm.Particles(mesh, around(), outside="delete", free=every)
    hold = scenes.fix(own.W, at(0, 0.0))
    body = mpm.Body(own, Hencky(YOUNG, POISSON), body_force=(0.0, -20.0))
    problem = mpm.QuasiStaticProblem(body, bcs=[hold])
    problem.solve(1)
    assert problem.history.statistics["free_dofs"] == 2 * (5 - 1) * 3
    problem.remove(lambda x: x[0] > 0.75)  # two cells, which have three nodes by themselves
    problem.solve(1)
    assert problem.history.statistics["free_dofs"] == 2 * (4 - 1) * 3
    assert np.isfinite(own.displacement.x.array).all()


@pytest.mark.mpi
def test_nodes_that_one_rank_alone_chooses_are_free_on_their_owner():
    particles = mpm.Particles(scenes.unit(6, QUADRILATERAL), quadrature_degree=2)
    layout = particles.W.dofmap.index_map
    ghosts = np.arange(layout.size_local, layout.size_local + layout.num_ghosts)
    chosen = chosen_nodes(particles.W, ghosts)
    every = np.unique(scenes.gather(layout.ghosts))
    assert len(every) > 0
    own = np.flatnonzero(chosen[: layout.size_local]) + layout.local_range[0]
    np.testing.assert_array_equal(np.sort(scenes.gather(own)), every)
    assert chosen[ghosts].all()
