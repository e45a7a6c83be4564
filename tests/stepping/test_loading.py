# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Load steps: totals, cutback, roll-back, paths, and what a failed run leaves."""

import warnings

import numpy as np
import pytest
import scenes
from compare import raises
from laws import Brittle, Sulky
from posed import posed
from scenes import PLANE, QUADRILATERAL, TRIANGLE, WORLD, pulled

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, LinearElastic
from mpm_dolfinx.stepping.control import StepControl


def test_load_that_is_not_a_number():
    failed = scenes.block()
    failed.particles.load.value = np.nan
    raises(failed.step, mpm.MPMError, r"finite")
    assert float(failed.particles.load.value) == 0.0
    failed.solve(steps=1)


class Unsendable(Exception):
    """An error that cannot be made again from its arguments."""

    def __init__(self, table, place):
        super().__init__(f"There is no {table} in {place}.")


@pytest.mark.parametrize(
    "error", [mpm.MPMError("No table."), ValueError("No table."), Unsendable("table", "here")]
)
def test_path_that_fails_on_one_rank(error):
    problem = scenes.block()
    last = WORLD.rank == WORLD.size - 1

    def path(t):
        if t > 0.5 and last:
            raise error

    kind = RuntimeError if isinstance(error, Unsendable) and not last else type(error)
    with pytest.raises(kind, match=r"[Nn]o table") as caught:
        problem.solve(2, update=path)
    if not isinstance(error, Unsendable):
        assert len(set(WORLD.allgather(str(caught.value)))) == 1
    # The state is that of the last converged step.
    assert problem.history.load == [0.5] and problem.particles.load.value == 0.5
    problem.solve(2)
    assert problem.history.load[-1] == 1.0


def right_side(problem):
    """Return the positions of the nodes that were at x = 1 (or right of it)."""
    particles = problem.particles
    X = particles.W.tabulate_dof_coordinates()[:, 0]
    d = particles.displacement.x.array.reshape(-1, 2)
    return d[np.isclose(X, 1.0)]


def assert_same_run(one, two, tolerance=1e-12, size=0.0):
    """Compare arrays of two runs: bit by bit on one rank.

    On several, MUMPS adds contributions in the order in which messages arrive.
    """
    if WORLD.size == 1:
        assert np.array_equal(one, two)
    else:
        size = max(size, scenes.largest(one))
        np.testing.assert_allclose(one, two, rtol=0.0, atol=tolerance * size)


def test_dirichlet_values_are_totals():
    problem, _ = pulled(Hencky(1e3, 0.3))
    for step in problem.steps(5):
        np.testing.assert_allclose(right_side(problem)[:, 0], 0.4 * step.load, atol=1e-12)
        assert float(problem.particles.load.value) == step.load
    force = problem.reaction(problem.bcs[0]) + problem.reaction(problem.bcs[1])
    np.testing.assert_allclose(force, 0.0, atol=1e-6 * abs(problem.reaction(problem.bcs[0])[0]))


def test_cutback_keeps_totals_and_grows_again():
    tight = {"petsc_options": {"snes_rtol": 1e-12}}
    problem, _ = pulled(Brittle(0.15), **tight)
    other, value = pulled(Hencky(1e3, 0.3), **tight)
    for step in problem.steps(2):
        np.testing.assert_allclose(right_side(problem)[:, 0], 0.4 * step.load, atol=1e-12)
    history = problem.history
    assert history.cutbacks > 0 and history.load[-1] == 1.0
    sizes = np.diff([0.0, *history.load])
    assert np.all(sizes > 0) and np.all(sizes <= 0.5)
    assert sizes.min() < 0.5
    assert history.failed_iterations > 0
    assert history.total_iterations == sum(history.iterations) + history.failed_iterations
    # The same path in the same steps, prescribed by the user.
    for load in history.load:
        other.particles.load.value = load
        value.value[:] = [0.4 * load, 0.0]
        other.step()
    gap = problem.particles.displacement.x.array - other.particles.displacement.x.array
    assert scenes.largest(gap) < 1e-10


def test_control_tries_larger_steps_of_hard_ones():
    # Steps that take many linear solves whatever their size come back to the full one.
    control, count = StepControl(1), 0
    for _ in range(10):
        assert control.cut_back()
    while not control.finished:
        control.accept(12)
        count += 1
    assert count < 40  # 1024 at the smallest
    # Where a larger step fails, the next try comes later each time.
    control, failures, count = StepControl(1), 0, 0
    control.cut_back()
    while not control.finished:
        if control.target * 1024 - count > 64:
            assert control.cut_back()
            failures += 1
        else:
            count = round(control.target * 1024)
            control.accept(12)
    assert failures <= 8


def test_hard_steps_grow_again_after_a_cutback():
    # The tangent is too stiff, so small steps take nine to twelve linear solves and large ones
    # nineteen; the first tries fail down to 1/1024 of the full step.
    law = Sulky(range(1, 11), factor=1.8)
    problem, _ = pulled(law, end=0.1, line_search=False, predictor=False)
    history = problem.solve(steps=10)
    assert history.cutbacks == 10 and history.load[-1] == 1.0
    assert np.median(history.iterations) > 8
    assert history.total_iterations < 800
    other, _ = pulled(Hencky(1e3, 0.3), end=0.1)
    other.solve(steps=10)
    gap = problem.particles.displacement.x.array - other.particles.displacement.x.array
    assert scenes.largest(gap) < 1e-4


def test_slump_with_cutback():
    # In few large steps some fail. The loads end at 1 all the same, and the result is near that
    # of small steps, which do not fail.
    runs = {}
    for steps in (3, 20):  # with few iterations each, so that large ones fail
        problem = scenes.slump(
            QUADRILATERAL, 80e3, h=1.0, width=80.0, petsc_options={"snes_max_it": 14}
        )
        history = problem.solve(steps=steps)
        assert history.load[-1] == 1.0
        assert np.all(np.diff(history.load) > 0)
        nodes = scenes.node_positions(problem.particles)
        runs[steps] = (history.cutbacks, nodes[:, 0].max())
    assert runs[20][0] == 0
    assert runs[3][0] >= 1
    assert abs(runs[3][1] / runs[20][1] - 1) < 0.1


def check_failure(problem, error, steps):
    """Run until an error; compare the state with that after the last converged step."""
    kept = scenes.state(problem)
    with pytest.raises(error) as caught:
        for _ in problem.steps(steps):
            kept = scenes.state(problem)
    scenes.assert_same_state(kept, scenes.state(problem))
    failure = caught.value
    last = problem.history.load[-1] if problem.history.load else 0.0
    assert failure.load == last == float(problem.particles.load.value)
    assert failure.particles == sorted(set(failure.particles))
    assert all(0 <= p < problem.particles.num_global for p in failure.particles)
    messages = WORLD.allgather((type(failure), str(failure), failure.particles, failure.load))
    assert all(m == messages[0] for m in messages)
    assert f"after load {last:.6g}" in str(failure)
    assert "\n" not in str(failure) and str(failure).endswith(".")
    return failure


@pytest.mark.parametrize("plain", [False, True])
@pytest.mark.parametrize("cell", PLANE, ids=scenes.name)
def test_beyond_the_limit_load_fails_whole(cell, plain):
    # A block is pulled by twice the traction sqrt(2) rho_y that it bears in plane strain: there
    # is no equilibrium beyond half of the load.
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 1.5], [8, 6], QUADRILATERAL))
    body = scenes.box([0.0, 0.0], [1.1, 0.9], [8, 8], cell)
    problem = posed(
        mpm.QuasiStaticProblem,
        mpm.Particles(body, V),
        mpm.materials.SmallStrainVonMises(1e4, 0.3, rho_y=10.0),
        bcs=[scenes.fix(V, scenes.at(i, 0.0), component=i) for i in (0, 1)],
        tractions=[((2 * np.sqrt(2) * 10.0, 0.0), 1)],
        facet_tags=scenes.facet_tags(body, scenes.at(0, 1.1)),
        petsc_options={"snes_max_it": 12},
        **({"shift": 0.0, "line_search": False} if plain else {}),
    )
    failure = check_failure(problem, (mpm.ConvergenceError, mpm.DomainDistortionError), 4)
    assert failure.particles
    assert 0.49 < failure.load < 0.501
    assert problem.history.cutbacks >= 5
    particles = problem.particles
    assert np.all(particles.plastic_strain > 0.0)
    np.testing.assert_allclose(particles.stress[:, 0, 0], failure.load * 20 * np.sqrt(2), rtol=1e-6)


def test_load_far_too_large_fails_whole():
    problem = scenes.block(Hencky(1.0, 0.3), force=(1e9, -1e9), shift=0.0, line_search=False)
    failure = check_failure(problem, mpm.MPMError, 2)
    assert failure.load == 0.0
    assert not problem.history.load
    assert np.all(problem.particles.displacement.x.array == 0.0)


def test_failing_law_names_its_particles_and_the_run_can_go_on():
    law = Brittle(0.15)
    problem, value = pulled(law)
    steps = problem.steps(8)
    for _ in range(4):
        next(steps)
    law.limit = 1e-12
    for part in problem.particles._response.laws.governed:
        part.material.limit = 1e-12
    kept = scenes.state(problem)
    with pytest.raises(mpm.ConvergenceError, match="too large for the law") as caught:
        next(steps)
    assert caught.value.particles and caught.value.load == 0.5
    scenes.assert_same_state(kept, scenes.state(problem))
    assert problem.history.load == [k / 8 for k in range(1, 5)]
    assert problem.history.cutbacks == 10
    # A step of its own fails too, and leaves all as it was.
    problem.particles.load.value = 0.625
    with pytest.raises(mpm.ConvergenceError):
        problem.step()
    scenes.assert_same_state(kept, scenes.state(problem))
    # With the law mended, the rest of the load brings it where a run without a stop ends.
    for part in problem.particles._response.laws.governed:
        part.material.limit = 0.15
    problem.solve(steps=4)
    assert problem.history.load == [k / 8 for k in range(1, 9)]
    whole, _ = pulled(Brittle(0.15))
    whole.solve(steps=8)
    assert whole.history.cutbacks == 0
    gap = problem.particles.displacement.x.array - whole.particles.displacement.x.array
    assert scenes.largest(gap) < 1e-12
    np.testing.assert_allclose(problem.particles.stress, whole.particles.stress, atol=1e-8)
    assert float(value.value[0]) == 0.4


class Overflowing(Hencky):
    """A law whose tangent is not finite in one update."""

    def __init__(self, young, poisson, when):
        super().__init__(young, poisson)
        self.calls, self.when = 0, when

    def update(self, displacement_gradient, state, tangent=True):
        answer = super().update(displacement_gradient, state, tangent)
        self.calls += 1
        if self.calls != self.when:
            return answer
        return answer._replace(tangent=np.full_like(answer.tangent, np.inf))


@pytest.mark.parametrize("when", [1, 7])
def test_a_factorisation_that_fails_is_not_the_end(when):
    # The matrix of the next try is factorised anew, not in what is left of the failed factor.
    problem, _ = pulled(Overflowing(1e3, 0.3, when))
    problem.solve(steps=4)
    assert problem.history.cutbacks == 1
    assert problem.history.load[-1] == 1.0
    whole, _ = pulled(Hencky(1e3, 0.3))
    whole.solve(steps=8)
    gap = problem.particles.displacement.x.array - whole.particles.displacement.x.array
    assert scenes.largest(gap) < 1e-3


def test_failed_step_leaves_the_next_one_as_if_it_had_not_been():
    # A try that fails after some iterations, then the same smaller step with and without it.
    runs = []
    for fails in (False, True):
        problem = scenes.slump(TRIANGLE, 15e3, h=1.0)
        steps = problem.steps(10)
        for _ in range(6):
            next(steps)
        if fails:
            problem.particles.load.value = 500.0
            with pytest.raises(mpm.MPMError):
                problem.step()
            assert float(problem.particles.load.value) == 0.6
        for _ in steps:
            pass
        assert problem.history.load == [k / 10 for k in range(1, 11)]
        runs.append(scenes.state(problem))
    for key in runs[0]:
        weight = 4.0 * 8.0 * 15e3 if key.startswith("reaction") else 0.0
        assert_same_run(runs[0][key], runs[1][key], 1e-9, weight)


def test_leaving_the_background_stops_the_run():
    problem = falling(LinearElastic(1e4, 0.3))
    kept = None
    with pytest.raises(mpm.ParticleOutsideError) as caught:
        for _ in problem.steps(10):
            kept = scenes.state(problem)
    scenes.assert_same_state(kept, scenes.state(problem))
    failure = caught.value
    # It moves by 1 in all; 0.5 of it is room. The step that would leave it is not taken.
    assert problem.history.load[-1] == failure.load == 0.5
    lowest = problem.particles.centroid[:, 1] < -0.2
    assert set(problem.particles.global_index[lowest]) == set(failure.particles) & set(
        problem.particles.global_index
    )
    assert failure.particles and "outside the background" in str(failure)
    assert str(failure).endswith("after load 0.5.")  # and no word of nodes that are held at rest
    assert all(m == str(failure) for m in WORLD.allgather(str(failure)))


def falling(material, depth=1.0):
    """Return a unit block, 0.5 above the end of the background, moved down as a whole."""
    V = scenes.vectors(scenes.box([-0.5, -0.5], [1.5, 1.5], [4, 4], QUADRILATERAL))
    bc, u = scenes.everywhere(V)
    u.x.array.reshape(-1, 2)[:] = [0.0, -depth]
    particles = mpm.Particles(scenes.unit(4, TRIANGLE), V)
    return mpm.QuasiStaticProblem(mpm.Body(particles, material), bcs=[bc])


def test_leaving_in_the_last_step_is_a_warning():
    problem = falling(LinearElastic(1e4, 0.3), depth=0.52)
    if WORLD.rank == 0:
        with pytest.warns(UserWarning, match="outside the background"):
            problem.solve(steps=5)
    else:
        problem.solve(steps=5)
    assert problem.history.load[-1] == 1.0
    np.testing.assert_allclose(
        problem.particles.centroid - problem.particles.initial_centroid,
        np.tile([0.0, -0.52], (problem.particles.num_local, 1)),
        atol=1e-13,
    )
    with pytest.raises(mpm.ParticleOutsideError):
        problem.step()


def test_path_is_called_again_with_a_smaller_parameter():
    problem, value = pulled(Brittle(0.15))
    asked = []

    def path(t):
        asked.append(t)
        value.value[:] = [0.4 * np.sin(0.5 * np.pi * t), 0.1 * t]

    for step in problem.steps(2, update=path):
        expected = [0.4 * np.sin(0.5 * np.pi * step.load), 0.1 * step.load]
        d = right_side(problem)
        np.testing.assert_allclose(d, np.tile(expected, (len(d), 1)), atol=1e-12)
        assert float(problem.particles.load.value) == step.load
    assert problem.history.cutbacks > 0
    assert min(np.diff(asked)) < 0.0
    assert asked[0] == 0.5 and asked[-1] == 1.0
    assert len(asked) == len(problem.history.steps) + problem.history.cutbacks


def test_path_may_set_the_load_factor():
    # Gravity first, at once; then a push.
    problem = scenes.block()
    V = problem.particles.V
    value = fem.Constant(V.mesh, np.zeros(2))
    nodes = np.flatnonzero(V.tabulate_dof_coordinates()[:, 0] < 0.3).astype(np.int32)
    problem = posed(
        mpm.QuasiStaticProblem,
        problem.particles,
        Hencky(1e3, 0.3),
        density=2.0,
        body_force=(0.0, -10.0),
        bcs=[fem.dirichletbc(value, nodes, V)],
    )

    def path(t):
        problem.particles.load.value = min(1.0, 2 * t)
        value.value[:] = [0.05 * max(0.0, 2 * t - 1), 0.0]

    loads = []
    for _ in problem.steps(6, update=path):
        loads.append(float(problem.particles.load.value))
        weight = 2.0 * 10.0 * loads[-1]
        np.testing.assert_allclose(problem.reaction(problem.bcs[0]), [0.0, weight], atol=1e-6)
    np.testing.assert_allclose(loads, [1 / 3, 2 / 3, 1, 1, 1, 1], rtol=1e-14)
    assert problem.history.load == [k / 6 for k in range(1, 7)]


def test_single_steps_are_those_of_a_run():
    one, two = scenes.block(), scenes.block()
    one.solve(steps=4)
    for load in (0.25, 0.5, 0.75, 1.0):
        two.particles.load.value = load
        step = two.step()
        assert step.load == load
    assert two.history.load == one.history.load
    assert_same_run(one.particles.displacement.x.array, two.particles.displacement.x.array)
    assert one.history.iterations == two.history.iterations[:4]
    assert two.step().iterations <= 1  # nothing changed


def test_a_second_run_needs_a_path():
    problem, value = pulled(Hencky(1e3, 0.3), end=0.2)
    problem.solve(steps=2)
    with pytest.raises(mpm.MPMError, match="whole load"):
        problem.solve(steps=2)
    one = scenes.state(problem)["displacement"]

    def back(t):
        value.value[:] = [0.2 * (1 - t), 0.0]

    problem.solve(steps=2, update=back)
    assert problem.history.load == [0.5, 1.0, 0.5, 1.0]
    np.testing.assert_allclose(right_side(problem)[:, 0], 0.0, atol=1e-12)
    assert scenes.largest(one) > 0.19
    assert scenes.largest(problem.reaction(problem.bcs[1])) < 1.0


def test_two_problems_on_one_background_do_not_disturb_each_other():
    alone = scenes.block()
    alone.solve(steps=3)
    V = alone.particles.V
    first, second = (
        mpm.QuasiStaticProblem(
            mpm.Body(
                mpm.Particles(scenes.unit(4, TRIANGLE), V),
                Hencky(1e3, 0.3),
                density=2.0,
                body_force=(0.0, -10.0),
            ),
            bcs=alone.bcs,
        )
        for _ in range(2)
    )
    for _ in zip(first.steps(3), second.steps(3), strict=True):
        pass
    for problem in (first, second):
        d = problem.particles.displacement.x.array
        assert_same_run(d, alone.particles.displacement.x.array)


@pytest.mark.parametrize("cell", scenes.PLANE, ids=scenes.name)
def test_nodes_that_would_cross_the_axis(cell):
    def disc(held, strength):
        first = 0.0 if held else -0.5  # where the background begins
        V = scenes.vectors(scenes.box([first, -0.5], [2.0, 1.5], [5, 4], QUADRILATERAL))
        body = scenes.box([0.0, 0.0], [1.0, 1.0], [4, 4], cell)
        bcs = [scenes.fix(V, scenes.at(1, 0.0), component=1)]
        bcs += [scenes.fix(V, scenes.at(0, 0.0), component=0)] if held else []
        return mpm.QuasiStaticProblem(
            mpm.Body(
                mpm.Particles(body, V, quadrature_degree=2),
                mpm.materials.Hencky(1e3, 0.3),
                body_force=(-strength, 0.0),
            ),
            bcs=bcs,
            axisymmetric=True,
        )

    # Nothing holds the nodes on the axis: a force to the inside takes them across it.
    problem = disc(False, 300.0)
    with pytest.raises(
        mpm.DomainDistortionError, match=r"reach across the axis x\[0\] = 0"
    ) as told:
        problem.solve(steps=1)
    p = problem.particles
    near = p.initial_domains[:, :, 0].min(axis=1) < 1e-9
    assert set(told.value.particles) <= set(scenes.gather(p.global_index[near]).tolist())
    assert told.value.particles and problem.history.cutbacks == 10
    assert p.node_positions[:, 0].min(initial=0.0) > -1e-6
    # To the outside nothing crosses, and held nodes stay on it.
    for problem in (disc(True, 300.0), disc(False, -30.0)):
        problem.solve(steps=2)
        assert problem.particles.node_positions[:, 0].min(initial=0.0) > -1e-12


@pytest.mark.parametrize("begun", ["solve", "step", "steps", "stage", "remove", "restore"])
def test_run_in_whose_loop_something_else_is_begun(begun, mpi_tmp_path):
    """Before, the load went 0.5, 1.0, 0.75, and what was removed was let go at once."""
    problem = scenes.block()
    problem.save(mpi_tmp_path / "first.npz")
    run = problem.steps(4)
    next(run), next(run)
    if begun == "remove":
        problem.remove([0])
    elif begun == "restore":
        problem.restore(mpi_tmp_path / "first.npz")
    elif begun == "solve":
        problem.solve(2)
    elif begun == "steps":
        next(problem.steps(2))
    else:
        getattr(problem, begun)()
    before = problem.particles.displacement.x.array.copy()
    raises(lambda: next(run), mpm.MPMError, r"cannot go on: a step, a stage or another run")
    np.testing.assert_array_equal(problem.particles.displacement.x.array, before)
    if begun not in ("solve", "restore"):
        problem.solve(2)
        assert problem.history.load[-1] == 1.0


def stretched(load=None, lid=0.0, way=0.0):
    """Return a unit block with a body force, and a top that a condition or a support moves."""
    V = scenes.vectors(scenes.box([-0.5, -0.5], [1.5, 1.5], [4, 4], QUADRILATERAL))
    particles = mpm.Particles(scenes.unit(4, QUADRILATERAL), V)
    tags = mpm.facet_tags(particles.mesh, {1: mpm.region(y=1.0)})
    top = [mpm.boundary.fixed(particles, tags, 1, value=(0.0, lid))] if lid else []
    return mpm.QuasiStaticProblem(
        mpm.Body(particles, LinearElastic(1e4, 0.3), body_force=load),
        bcs=[mpm.held(V, y=0.0), *([mpm.held(V, 1, y=1.0, value=way)] if way else [])],
        supports=top,
    )


@pytest.mark.parametrize("given", [{"load": (0.0, -1.0)}, {"lid": 0.1}], ids=str)
def test_a_first_step_without_a_load_factor_says_that_nothing_has_moved(given):
    problem = stretched(**given)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        problem.step()
    mine = [w for w in found if "at a load factor of 0" in str(w.message)]
    assert [w.filename for w in mine] == ([__file__] if WORLD.rank == 0 else [])
    assert not problem.particles.displacement.x.array.any()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        problem.step()  # told once
        problem.particles.load.value = 1.0
        problem.step()
        moved = stretched(**given)
        moved.particles.load.value = 0.5
        moved.step()
        moved.particles.load.value = 0.0
        moved.step()
    assert scenes.largest(problem.particles.displacement.x.array) > 1e-5


def test_a_first_step_moves_conditions_as_they_are():
    problem = stretched(way=0.1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        problem.step()
        scenes.block().solve(steps=1)
