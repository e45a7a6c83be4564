# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Nodes that are freed until the estimated error is what was asked for."""

import warnings

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from compare import raises
from scenes import HEXAHEDRON, QUADRILATERAL, TRIANGLE, WORLD, at, box, facet_tags, vectors

from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, LinearElastic, Tresca
from mpm_dolfinx.stepping.adaptivity import Adaptivity
from mpm_dolfinx.system.errors import Errors

ELASTIC = LinearElastic(1e3, 0.25)


def angle(free=(), degree=1, cell=QUADRILATERAL, n=4, comm=WORLD, law=ELASTIC, kind=None, load=0.1):
    """An L-shaped body under its own weight, its upper end held across the cells of the background.

    ``free=None`` is carried alone, and ``"elements"`` finite elements.
    """
    dim, h = (3 if cell == HEXAHEDRON else 2), 1.0 / n
    square = box([0.0] * dim, [2.0, 2.0, 0.5][:dim], [4 * n, 4 * n, n][:dim], cell, comm)
    cells = np.arange(square.topology.index_map(dim).size_local, dtype=np.int32)
    middle = mesh.compute_midpoints(square, dim, cells)
    kept = cells[(middle[:, 0] < 1.0) | (middle[:, 1] < 1.0)]
    body = mesh.create_submesh(square, dim, kept)[0]
    lower = np.array([-1.37 * h, -1.37 * h, -h][:dim])
    counts = np.array([2 * n + 3, 2 * n + 3, n // 2 + 2][:dim])
    around = HEXAHEDRON if dim == 3 else QUADRILATERAL
    V = vectors(box(lower, lower + h * counts, counts.tolist(), around, comm), degree)
    order = {"degree": degree, "quadrature_degree": 2 * degree}
    if isinstance(free, str) and free == "elements":
        own = mpm.Particles(body, **order)
    else:
        own = mpm.Particles(body, V, free=free if free is None else list(free), **order)
    tags = facet_tags(own.mesh, at(1, 2.0))
    given = mpm.Body(own, law, density=1.0, body_force=(0.0, -load, 0.0)[:dim])
    held = [mpm.boundary.fixed(own, tags, 1)]
    return (kind or mpm.QuasiStaticProblem)(given, supports=held), own


def sag(problem):
    """The work of the weight, but for a factor: what the energy of the error is a part of."""
    body = problem.particles
    volume = body.initial_volume
    moved = (body.centroid - body.initial_centroid)[:, 1]
    return -scenes.total(body, volume * moved)


def freed(problem):
    """How many nodes were freed at the end of each step."""
    return [step.freed for step in problem.history.steps]


@pytest.mark.parametrize(
    "cell, degree, tolerance",
    [
        *((QUADRILATERAL, 2, 0.1), (TRIANGLE, 1, 0.25)),
        pytest.param(QUADRILATERAL, 1, 0.18, marks=pytest.mark.slow),
        pytest.param(HEXAHEDRON, 1, 0.35, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_the_error_is_what_was_asked_for(cell, degree, tolerance):
    n = 2 if cell == HEXAHEDRON else 4
    carried, _ = angle(None, degree, cell, n)
    carried.solve(1)
    elements, _ = angle("elements", degree, cell, n)
    elements.solve(1)
    finer, _ = angle("elements", 2, cell, n if cell == HEXAHEDRON else 2 * n)
    finer.solve(1)
    problem, own = angle((), degree, cell, n)
    problem.solve(1, adapt=tolerance)
    (step,) = problem.history.steps
    assert step.error == problem.error() <= tolerance < carried.error()
    nodes = own.mesh.comm.allreduce(int(own.free[: own.W.dofmap.index_map.size_local].sum()))
    assert step.freed == nodes > 0
    assert f"{nodes} of {own.W.dofmap.index_map.size_global} nodes free" in problem.summary()
    unknowns = [one.history.statistics["free_dofs"] for one in (carried, problem, elements)]
    assert unknowns[0] < unknowns[1] < unknowns[2]
    # The energy of the true error, by finite elements that are much finer, is no larger either.
    whole = sag(finer)
    assert np.sqrt(1.0 - sag(problem) / whole) < 1.25 * tolerance
    gap = (sag(elements) - sag(problem)) / (sag(elements) - sag(carried))
    assert 0.0 < gap < 0.4


def test_where_the_elements_err_more_the_background_stops_and_it_is_said():
    elements, _ = angle("elements")
    elements.solve(1)
    problem, own = angle()
    with pytest.warns(UserWarning, match=r"adapt=0\.01 is not met") if WORLD.rank == 0 else quiet():
        problem.solve(1, adapt=0.01)
    assert elements.error() < problem.error() < 1.2 * elements.error()
    assert 1.0 - sag(problem) / sag(elements) < 0.2 * problem.error() ** 2
    assert not scenes.gather(own.free).all()


def quiet():
    """Nothing warns on the other ranks."""
    return warnings.catch_warnings()


@pytest.mark.parametrize("beyond", [1.1, 2.0, 10.0])
def test_the_fewest_nodes_that_leave_half_of_what_is_allowed_but_for_a_fifth(beyond):
    """Beside a search through all nodes in order, where the background errs by more than it may."""
    _, own = angle()
    mine = own.W.dofmap.index_map.size_local
    generator = np.random.default_rng(7 + WORLD.rank)
    errors = generator.random(mine) ** 4
    every = np.sort(np.concatenate(WORLD.allgather(errors)))[::-1]
    tolerance, energy = 0.1, every.sum() / beyond / 0.1**2
    nothing = np.zeros(own.num_local)
    ((body, free),) = Adaptivity(tolerance).chosen([own], Errors([errors], [nothing], energy))
    wanted = 0.8 * (every.sum() - 0.5 * tolerance**2 * energy)
    count = np.searchsorted(np.cumsum(every), wanted) + 1
    assert body is own and WORLD.allreduce(int(free[:mine].sum())) == count
    assert (errors[free[:mine]] >= every[count - 1]).all()
    enough = Errors([errors], [nothing], every.sum() / tolerance**2 * (1.0 + 1e-9))
    assert Adaptivity(tolerance).chosen([own], enough) == []


@pytest.mark.filterwarnings("ignore:adapt=0.02 is not met")
def test_what_stays_carried_is_held_as_if_nothing_were_free():
    """Few carried nodes: outer functions of the background have tiny weights at one of them only.

    A penalty keeps them from moving it as round-off wants, so that no state hangs on how tightly it
    is solved, and what is freed makes the error smaller.
    """
    places, errors = [], []
    for rtol, adapt in ((1e-7, 0.02), (1e-12, 0.02), (1e-12, None)):
        V = vectors(box([-0.5, -0.5], [1.5, 1.5], [4, 4], QUADRILATERAL))
        own = mpm.Particles(box([0.0, 0.0], [1.0, 1.0], [4, 4], QUADRILATERAL), V, free=[])
        lift = fem.Constant(V.mesh, np.zeros(2))
        base = mpm.held(V, value=lift, where=lambda x: x[1] < 1e-9)
        problem = mpm.QuasiStaticProblem(
            mpm.Body(own, Hencky(1e3, 0.3), density=1.0, body_force=(0.0, -10.0)),
            bcs=[base, mpm.held(V, 0, where=lambda x: x[0] < 1e-9)],
            solver=mpm.Solver(petsc_options={"snes_rtol": rtol}),
        )
        problem.solve(1)
        problem.solve(2, update=lambda t, lift=lift: lift.value.put(1, 0.01 * t), adapt=adapt)
        places.append(scenes.in_order(own, own.centroid))
        errors.append(problem.error())
    assert freed(problem) == [0, 0, 0]
    assert np.abs(places[0] - places[1]).max() < 1e-8
    assert errors[1] < 0.8 * errors[2]


def test_body_of_revolution():
    """A plate held at its rim: the estimate and the nodes are those of the whole of it."""
    found = []
    for adapt in (None, 0.17):
        grid = box([0.0, -0.4], [2.2, 0.8], [11, 6], QUADRILATERAL)
        V = vectors(grid)
        body = box([0.0, 0.0], [2.0, 0.3], [32, 6], QUADRILATERAL)
        own = mpm.Particles(body, V, free=[])
        tags = facet_tags(own.mesh, at(0, 2.0))
        given = mpm.Body(own, ELASTIC, density=1.0, body_force=(0.0, -0.1))
        problem = mpm.QuasiStaticProblem(
            given,
            bcs=[mpm.held(V, 0, x=0.0)],
            supports=[mpm.boundary.fixed(own, tags, 1)],
            axisymmetric=True,
        )
        problem.solve(2, adapt=adapt)
        found.append((problem.error(), sag(problem)))
    assert found[1][0] <= 0.17 < 0.25 < found[0][0]
    assert found[1][1] > 1.05 * found[0][1]


def strip(free=(), comm=WORLD, **options):
    """A strip presses on clay that yields; returns the problem and its support."""
    body = box([0.0, 0.0], [2.0, 1.0], [16, 8], QUADRILATERAL, comm)
    V = vectors(box([0.0, 0.0], [2.0, 1.5], [8, 6], QUADRILATERAL, comm))
    own = mpm.Particles(body, V, free=free, quadrature_degree=2)
    tags = mpm.facet_tags(own.mesh, {1: mpm.region(x=(0.0, 0.5), y=1.0)})
    under = mpm.boundary.roller(own, tags, 1, normal=(0.0, -1.0), value=0.012)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(own, Tresca(1e3, 0.45, cohesion=1.0), f_bar="patch"),
        bcs=[mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=2.0), mpm.held(V, y=0.0)],
        supports=[under],
        **options,
    )
    return problem, under


def test_plastic_steps():
    """The edge of a strip: a few nodes, chosen early, give what all of them would."""
    pressures = []
    for free in (None, [], lambda x: np.ones(x.shape[1], bool)):
        problem, under = strip(free)
        problem.solve(8, adapt=0.15 if free == [] else None)
        pressures.append(-problem.reaction(under)[1])
        if free == []:
            errors = [step.error for step in problem.history.steps]
            counts, unknowns = freed(problem), problem.history.statistics["free_dofs"]
            assert problem.history.cutbacks == 0
    carried, adapted, all_free = pressures
    assert abs(adapted - all_free) < 0.15 * (carried - all_free)
    assert counts[0] > 0 and np.count_nonzero(counts) <= 3
    assert errors[-1] <= 0.15 and unknowns < 0.5 * problem.history.statistics["free_dofs"]


@pytest.mark.slow
def test_bearing_capacity_of_a_strip_on_an_even_background():
    """Cells of a quarter of the half width b; the body's halved once at the edge, on no line."""
    half, h, lengths = 0.5, 0.125, (3.0, 2.0)
    lines = [
        mpm.grid_lines(0.0, length, 0.5 * h, finer_at=edge, halvings=1)
        for length, edge in zip(lengths, (half, lengths[1]), strict=True)
    ]
    found = []
    for adapt in (None, 0.13):
        counts = [round(lengths[0] / h), round(lengths[1] / h) + 2]
        V = vectors(box([0.0, 0.0], [lengths[0], lengths[1] + 2.0 * h], counts, QUADRILATERAL))
        own = mpm.Particles(mpm.grid(WORLD, lines), V, quadrature_degree=2, free=[])
        tags = mpm.facet_tags(own.mesh, {1: mpm.region(x=(0.0, half), y=lengths[1])})
        under = mpm.boundary.roller(own, tags, 1, normal=(0.0, -1.0), value=0.004)
        problem = mpm.QuasiStaticProblem(
            mpm.Body(own, Tresca(1e4, 0.49, cohesion=1.0), f_bar="patch"),
            bcs=[mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=lengths[0]), mpm.held(V, y=0.0)],
            supports=[under],
        )
        pressure = 0.0
        for _ in problem.steps(30, adapt=adapt):
            before, pressure = pressure, -problem.reaction(under)[1] / half
        assert pressure < 1.005 * before
        found.append((pressure / (2.0 + np.pi), problem.history.statistics["free_dofs"]))
    assert found[0][0] > 1.2 and abs(found[1][0] - 1.0) < 0.015
    assert found[1][1] < 1.1 * found[0][1]


def test_steps_chosen_by_their_error_and_levels():
    problem, under = strip([])
    problem.solve("auto", tolerance=0.05, output_at=[0.5], adapt=0.15)
    assert [step.load for step in problem.history.steps if step.output] == [0.5, 1.0]
    assert problem.error() <= 0.15 and sum(freed(problem)) > 0
    equal, other = strip([])
    equal.solve(10, adapt=0.15)
    ends = [p.reaction(s)[1] for p, s in ((problem, under), (equal, other))]
    assert ends[0] == pytest.approx(ends[1], rel=0.02)


def test_one_tolerance_for_nodes_and_steps():
    runs = []
    for tolerance in (None, 0.15**2, 1e-2):
        problem, _ = angle(law=Hencky(1e3, 0.25), load=5.0)
        problem.solve("auto", tolerance=tolerance, adapt=0.15)
        runs.append([(step.load, step.freed) for step in problem.history.steps])
    assert runs[0] == runs[1] != runs[2]


def test_a_controlled_displacement():
    """The load is found for the displacement, with nodes freed at the end of the step too."""
    problem, own = angle()
    control = mpm.DisplacementControl(own, -1e-4, point=(2.0, 0.5), direction=(0.0, 1.0))
    problem.solve(3, control=control, adapt=0.2)
    assert control.present() == pytest.approx(-1e-4, rel=1e-8)
    assert problem.error() <= 0.2 and sum(freed(problem)) > 0
    steps = problem.history.steps
    assert [step.load for step in steps] == sorted(step.load for step in steps)
    assert float(own.load.value) == steps[-1].load
    again, _ = angle()
    again.solve(1, update=lambda t: setattr(again.particles.load, "value", steps[-1].load * t))
    again.particles.free = own.free.nonzero()[0]
    again.step()
    assert again.particles.displacement.x.array == pytest.approx(
        own.displacement.x.array, rel=1e-6, abs=1e-9
    )


def test_a_path_and_a_stage():
    """A stage that turns the load frees other nodes, and those from before stay free."""
    problem, own = angle()
    push = {"value": 0.0}
    problem.solve(2, update=lambda t: push.update(value=t), adapt=0.2)
    assert push["value"] == 1.0 and problem.error() <= 0.2
    before = own.free
    problem.stage("turned", problem.body().replace(body_force=(2.0, 0.0)))
    problem.solve(2, adapt=0.2)
    assert problem.error() <= 0.2
    assert (own.free >= before).all()


@pytest.mark.parametrize("slipped", [0.0, 0.04])
def test_nodes_that_a_moving_side_of_the_background_leads_do_not_come_loose(slipped):
    """The side is a line of the background, which stays there; carried nodes slip beside it."""
    rises = []
    for free in (None, [], "elements"):
        V = vectors(box([-0.5, -0.5], [2.0, 1.0], [10, 6], QUADRILATERAL))
        body = box([0.0, 0.0], [1.0, 0.5], [8, 4], QUADRILATERAL)
        if free == "elements":
            own = mpm.Particles(body)
        else:
            own = mpm.Particles(body, V, free=free, quadrature_degree=2)
        pull = fem.Constant(own.V.mesh, np.zeros(2))
        end = mpm.held(own.V, x=1.0, value=pull)
        problem = mpm.QuasiStaticProblem(
            mpm.Body(own, Hencky(1e3, 0.3)), bcs=[mpm.held(own.V, x=0.0), end]
        )
        if slipped:
            problem.solve(2, update=lambda t, pull=pull: pull.value.put(0, slipped * t))
        path = lambda t, pull=pull: pull.value.put(0, slipped + 0.08 * t)  # noqa: E731
        adapt = {"adapt": 0.07} if free == [] else {}
        forces = [problem.reaction(end)[0] for _ in problem.steps(4, update=path, **adapt)]
        rises.append(np.diff(forces))
    carried, adapted, elements = rises
    assert np.abs(adapted / elements - 1.0).max() < 0.05
    assert slipped or np.abs(carried / elements - 1.0).max() > 0.1


def test_several_bodies_and_contact():
    """Only bodies that were made so have nodes freed; finite elements bear on one of them."""
    ground = box([0.0, 0.0], [2.0, 1.0], [16, 8], QUADRILATERAL)
    V = vectors(box([-0.3, -0.2], [2.2, 1.4], [10, 7], QUADRILATERAL))
    soil = mpm.Particles(ground, V, free=[])
    steel = mpm.Particles(box([0.6, 1.0], [1.2, 1.5], [6, 5], QUADRILATERAL))
    tags = facet_tags(soil.mesh, at(1, 0.0))
    down = mpm.held(steel.W, value=(0.0, -0.01), y=1.5)
    problem = mpm.QuasiStaticProblem(
        [mpm.Body(soil, Hencky(1e3, 0.3)), mpm.Body(steel, Hencky(1e4, 0.3))],
        bcs=[down],
        supports=[mpm.boundary.fixed(soil, tags, 1)],
        terms=[mpm.contact.Pair(steel, soil)],
    )
    problem.solve(2)
    carried = problem.error()
    problem.solve(2, update=lambda t: None, adapt=0.95 * carried)
    assert problem.error() <= 0.95 * carried
    assert sum(freed(problem)) == np.count_nonzero(soil.free) > 0 or WORLD.size > 1
    assert problem.reaction(down)[1] < 0.0


def test_bodies_that_stick_are_not_parted():
    """A lift on the ground, on one background: what carries both keeps their nodes together."""
    V = vectors(box([-0.3, -0.2], [2.2, 1.7], [10, 8], QUADRILATERAL))
    ground = mpm.Particles(box([0.0, 0.0], [2.0, 1.0], [16, 8], QUADRILATERAL), V, free=[])
    lift = mpm.Particles(box([0.0, 1.0], [1.0, 1.25], [8, 2], QUADRILATERAL), V, free=[])
    tags = facet_tags(ground.mesh, at(1, 0.0))
    law = Hencky(1e3, 0.3)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(ground, law, density=1.0, body_force=(0.0, -5.0)),
        supports=[mpm.boundary.fixed(ground, tags, 1)],
    )
    problem.solve(1)
    problem.add(mpm.Body(lift, law, density=1.0, body_force=(0.0, -5.0)))
    carried = problem.state.capture()
    problem.solve(2)
    before, sunk = problem.error(), scenes.total(lift, lift.centroid[:, 1])
    problem.state.adopt(carried)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        problem.solve(2, adapt=0.5 * before)
    assert sum(freed(problem)) > 0 and problem.error() < before
    assert scenes.total(lift, lift.centroid[:, 1]) == pytest.approx(sunk, abs=2e-3 * abs(sunk))


def test_a_better_equilibrium_that_is_not_found_leaves_the_step_as_it_was():
    class Reluctant(mpm.QuasiStaticProblem):
        def evaluate(self):
            if scenes.gather(self.particles.free).any():
                return mpm.ConvergenceError("no")
            return None

    ends = []
    for kind in (mpm.QuasiStaticProblem, Reluctant):
        problem, own = angle(kind=kind)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            problem.solve(3, adapt=0.2 if kind is Reluctant else None)
        ends.append(scenes.in_order(own, own.centroid))
        assert problem.history.load == pytest.approx([1 / 3, 2 / 3, 1.0])
    assert freed(problem) == [0, 0, 0] and not own.free.any()
    assert problem.history.cutbacks == 0
    np.testing.assert_allclose(ends[1], ends[0], rtol=0.0, atol=1e-12)


def test_a_run_goes_on_from_a_checkpoint_as_it_was(mpi_tmp_path):
    whole, under = strip([])
    steps = whole.steps(6, adapt=0.15)
    next(steps)
    next(steps)
    whole.save(mpi_tmp_path / "state")
    for _ in steps:
        pass
    again, other = strip([])
    again.restore(mpi_tmp_path / "state")
    raises(lambda: again.solve(6), mpm.MPMError, "6 steps with no path .* and adapt=0.15; go on")
    again.solve(6, adapt=0.15)
    assert freed(again) == freed(whole)
    assert [s.error for s in again.history.steps] == pytest.approx(
        [s.error for s in whole.history.steps], rel=1e-8
    )
    if WORLD.size == 1:
        scenes.assert_same_state(scenes.state(whole), scenes.state(again))
        assert np.array_equal(whole.reaction(under), again.reaction(other))


def test_any_number_of_ranks_frees_the_same_nodes():
    found = []
    for comm in (WORLD, MPI.COMM_SELF):
        problem, under = strip([], comm)
        problem.solve(4, adapt=0.15)
        found.append((freed(problem), problem.reaction(under)[1], problem.error()))
    assert found[0][0] == found[1][0]
    assert found[0][1:] == pytest.approx(found[1][1:], rel=1e-7)


def test_what_cannot_be_is_refused():
    problem, _ = angle()
    for wrong in (0.0, 1.0, -0.1, True, "a", np.nan):
        raises(
            lambda wrong=wrong: problem.solve(1, adapt=wrong),
            mpm.MPMError,
            "adapt must be an error between 0 and 1",
        )
    carried, _ = angle(None)
    raises(lambda: carried.solve(1, adapt=0.1), mpm.MPMError, r"make them with free=\[\]")
    _, own = angle(range(3))
    one = mpm.QuasiStaticProblem(
        mpm.Body(own, ELASTIC),
        bcs=[mpm.held(own.W, where=lambda x: own.free[: x.shape[1]])],
    )
    raises(lambda: one.solve(1, adapt=0.1), mpm.MPMError, "condition on particles.W holds nodes")


def test_nodes_that_are_carried_for_good_are_not_freed():
    """Those that the background had to take, as domains around them were bad."""
    problem, own = angle()
    own.placement.choose_free(own.free, np.ones(len(own.free), dtype=bool))
    with pytest.warns(UserWarning, match="is not met") if WORLD.rank == 0 else quiet():
        problem.solve(1, adapt=0.1)
    assert freed(problem) == [0] and not own.free.any()
