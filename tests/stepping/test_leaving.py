# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Particles that leave the background: the policies, and what deletion does to a body."""

from contextlib import nullcontext

import numpy as np
import pytest
import scenes
from marks import slow, thinned
from posed import posed
from scenes import QUADRILATERAL, TRIANGLE, WORLD, falling

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import LinearElastic, VonMises


def test_flow_over_the_edge():
    # A column spreads over the end of the background: mass is accounted for, the rest is in
    # equilibrium and plastically admissible, and the same on any number of ranks.
    runs = []
    for comm in [WORLD, scenes.MPI.COMM_SELF][: WORLD.size]:
        problem = slumping("delete", comm)
        history = problem.solve(steps=12)
        p = problem.particles
        assert history.load[-1] == 1.0 and history.losses
        here = scenes.total(p, p.initial_volume[~p.deleted]) * 1000.0
        assert abs(here + history.statistics["lost_mass"] - 32e3) < 1e-12 * 32e3
        assert np.all(problem.yield_function < 1e-8)
        inside = p.domains[~p.deleted]
        assert np.all(inside[..., 0] <= 10.0 + 1e-9)
        weight = sum(problem.reaction(bc)[1] for bc in problem.bcs)
        lost = sum(loss.mass for loss in history.losses if loss.load < 1.0)
        np.testing.assert_allclose(weight, 20.0 * (32e3 - lost), rtol=1e-7)
        runs.append((history.losses, scenes.in_order(p, p.centroid), history.iterations))
    for other in runs[1:]:
        assert [x.particles for x in other[0]] == [x.particles for x in runs[0][0]]
        np.testing.assert_allclose(other[1], runs[0][1], atol=1e-9 * 10)


def slumping(outside, comm=WORLD):
    V = scenes.vectors(scenes.box([0.0, 0.0], [10.0, 10.0], [10, 10], QUADRILATERAL, comm))
    body = scenes.box([0.0, 0.0], [4.0, 8.0], [8, 16], TRIANGLE, comm)
    bcs = [scenes.fix(V, scenes.at(i, 0.0), component=i) for i in (0, 1)]
    return mpm.QuasiStaticProblem(
        mpm.Body(
            mpm.Particles(body, V, outside=outside),
            VonMises(1e6, 0.3, rho_y=20e3),
            density=1000.0,
            body_force=(0.0, -20.0),
        ),
        bcs=bcs,
    )


def test_stop_ends_the_run_without_an_error():
    stopped, failed = slumping("stop"), slumping("error")
    kept = None
    with pytest.raises(mpm.ParticleOutsideError) as caught:
        for _ in failed.steps(12):
            kept = scenes.state(failed)
    if WORLD.rank == 0:
        with pytest.warns(UserWarning, match="The run stopped. The domains of particle"):
            history = stopped.solve(steps=12)
    else:
        history = stopped.solve(steps=12)
    assert type(history.stopped) is mpm.ParticleOutsideError
    assert history.stopped.particles == caught.value.particles
    assert history.stopped.load == caught.value.load == history.load[-1] < 1.0
    assert failed.history.stopped is None
    now = scenes.state(stopped)
    for key in kept:
        size = max(1.0, scenes.largest(kept[key]))
        np.testing.assert_allclose(now[key], kept[key], rtol=0, atol=1e-9 * size)
    assert scenes.largest(stopped.particles.displacement.x.array) < 10.0


@pytest.mark.parametrize("outside", ["stop", "delete"])
def test_a_body_must_be_inside_at_first(outside):
    V = scenes.vectors(scenes.unit(2, QUADRILATERAL))
    body = scenes.box([0.5, 0.5], [1.5, 0.9], [2, 2], TRIANGLE)
    with pytest.raises(mpm.ParticleOutsideError) as caught:
        mpm.Particles(body, V, outside=outside)
    assert caught.value.particles


def test_the_last_particle_is_not_deleted():
    problem = falling(depth=4.0)
    p = problem.particles
    with pytest.raises(mpm.ParticleOutsideError, match="the last that were not deleted"):
        problem.solve(steps=8)
    assert problem.history.load[-1] == 0.25
    assert 0 < scenes.total(p, ~p.deleted) <= 8
    np.testing.assert_allclose(p.centroid[~p.deleted, 1], p.initial_centroid[~p.deleted, 1] - 1.0)


def test_a_state_is_that_of_its_own_particles_where_as_many_others_have_left(mpi_tmp_path):
    # A plate heavier on one side slides off one end of its background; others before off the other.
    straight, other = plate(), plate()
    for problem, ways in ((straight, (8.0,)), (other, (8.0, -8.0))):
        problem.save(mpi_tmp_path / "first")
        for way in ways:
            problem.restore(mpi_tmp_path / "first")
            slide(problem, way, 0.3)
            if way > 0.0:
                problem.save(mpi_tmp_path / "then")
    lost = [scenes.total(p.particles, p.particles.deleted) for p in (straight, other)]
    assert lost[0] == lost[1] > 0
    other.restore(mpi_tmp_path / "then")
    for problem in (straight, other):
        slide(problem, 0.0, 0.4)
    one, two = straight, other
    np.testing.assert_allclose(two.particles.centroid, one.particles.centroid, rtol=0, atol=1e-12)
    np.testing.assert_allclose(two.momentum, one.momentum, rtol=1e-12, atol=1e-13)
    energies = [list(vars(p.history.energies[-1]).values()) for p in (one, two)]
    np.testing.assert_allclose(energies[1], energies[0], rtol=1e-10, atol=1e-12)


def plate():
    """Return a plate that forces may move over both ends of its background."""
    V = scenes.vectors(scenes.box([-1.0, -0.5], [1.0, 1.0], [8, 6], QUADRILATERAL))
    body = scenes.box([-0.8, 0.0], [0.8, 0.5], [8, 2], TRIANGLE)
    particles = mpm.Particles(body, V, outside="delete")
    density = fem.Function(fem.functionspace(body, ("DG", 0)))
    density.interpolate(lambda x: 1.0 + 0.5 * x[0])
    force = fem.Constant(body, np.zeros(2))
    law = LinearElastic(1e3, 0.3)
    one = mpm.Body(particles, law, density=density, body_force=force)
    return mpm.DynamicProblem(one, scheme="euler")


def slide(problem, way, time):
    """Go on under a horizontal force."""
    problem.body().body_force.value[0] = way
    problem.solve(time=time, dt=0.05)


def test_a_boundary_that_has_been_moved_holds_nothing_beyond_it_at_rest_either():
    V = scenes.vectors(scenes.box([-0.5, -0.5], [1.5, 1.5], [4, 4], QUADRILATERAL))
    bc, u = scenes.everywhere(V)
    u.x.array.reshape(-1, 2)[:] = [0.0, -0.52]
    body = mpm.Body(mpm.Particles(scenes.unit(4, TRIANGLE), V), LinearElastic(1e4, 0.3))
    problem = mpm.QuasiStaticProblem(body, bcs=[bc])
    with pytest.warns(UserWarning, match="outside the back") if WORLD.rank == 0 else nullcontext():
        problem.solve(steps=5)
    with pytest.raises(mpm.ParticleOutsideError):
        problem.step()


def test_two_bodies_one_of_which_must_stay():
    V = falling().particles.V
    bc, u = scenes.everywhere(V)
    u.x.array.reshape(-1, 2)[:] = [0.0, -1.0]
    bodies = [
        mpm.Particles(scenes.box([0.0, low], [1.0, low + 0.5], [4, 2], TRIANGLE), V, outside=policy)
        for low, policy in ((0.0, "delete"), (0.5, "error"))
    ]
    problem = posed(mpm.QuasiStaticProblem, bodies, LinearElastic(1e4, 0.3), density=2.0, bcs=[bc])
    with pytest.raises(mpm.ParticleOutsideError):
        problem.solve(steps=10)
    # The last of the first body, and the first of the second, would leave at once.
    assert problem.history.load[-1] == 0.7
    first, second = bodies
    assert scenes.total(first, first.deleted) == 8
    assert not second.deleted.any()
    assert all(loss.body == 0 for loss in problem.history.losses)


def test_pictures_and_series_know_deleted_particles(tmp_path):
    plt = pytest.importorskip("matplotlib.pyplot")
    problem = falling()
    problem.solve(steps=4)
    p = problem.particles
    values = p.fields()["deleted"]
    assert np.array_equal(values == 1.0, p.deleted)
    artist = mpm.plot.domains(p, p.plastic_strain)
    left = scenes.total(p, ~p.deleted)
    if WORLD.rank == 0:
        assert len(artist.get_paths()) == left
        plt.close()


@pytest.mark.skip_in_parallel  # (round-off of ranks decides the way of sand on a row)
@pytest.mark.parametrize(("up", "kind"), thinned(2, [(False, QUADRILATERAL), (True, TRIANGLE)]))
def test_a_floor_is_as_a_row_of_cells_that_is_held(up, kind):
    # What falls in a step into cells that are held stays there; so it does where there are none.
    floor, row = (sand(None, up, kind, more) for more in (False, True))
    for problem in (floor, row):
        problem.solve(time=0.68, dt=0.04)
    p = floor.particles
    beyond = p.domains[..., 1] - 1.5 if up else -p.domains[..., 1]
    assert 1e-6 < scenes.largest(np.maximum(beyond, 0.0)) < 0.25
    np.testing.assert_allclose(p.domains, row.particles.domains, rtol=0, atol=1e-8)
    force, other = (problem.reaction(problem.bcs[1]) for problem in (floor, row))
    np.testing.assert_allclose(force, other, rtol=1e-6)
    weights = p.node_basis.values.sum(axis=1)
    np.testing.assert_allclose(weights, 1.0, rtol=1e-12)


def test_what_is_below_its_floor_stays_there_over_a_restart(mpi_tmp_path):
    path = mpi_tmp_path / "block.ckpt"
    problem, again = thrown_down(), thrown_down()
    problem.step(0.06)
    problem.save(path)
    assert scenes.largest(np.minimum(problem.particles.domains[..., 1], 0.0)) > 1e-3
    again.restore(path)
    for each in (problem, again):
        each.solve(time=0.1, dt=0.02)
    np.testing.assert_allclose(
        again.particles.domains, problem.particles.domains, rtol=0, atol=1e-9
    )


def thrown_down():
    """Return a block whose lowest corners go through its floor in a step of 0.06."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [3.0, 2.5], [6, 5], QUADRILATERAL))
    body = scenes.box([0.57, 0.45], [2.17, 1.55], [7, 6], QUADRILATERAL)
    law = mpm.materials.Hencky(1e3, 0.3)
    one = mpm.Body(mpm.Particles(body, V), law, density=1.0, velocity=(0.5, -10.0))
    return mpm.DynamicProblem(one, bcs=[mpm.held(V, 1, y=0.0)], scheme="euler")


@pytest.mark.skip_in_parallel  # (round-off of ranks decides the way of sand below its floor)
@pytest.mark.parametrize("moves", [*slow(False), True])
def test_what_is_below_a_floor_that_is_let_go_or_moved_is_outside(moves):
    problem = sand(None, up=False)
    V = problem.particles.V
    lift = fem.Constant(V.mesh, np.zeros(2))
    side = mpm.held(V, 0, x=0.0)
    problem.stage(bcs=[side, mpm.held(V, value=lift, y=(-np.inf, 0.0))])
    problem.solve(time=0.68, dt=0.04)
    assert scenes.largest(np.maximum(-problem.particles.domains[..., 1], 0.0)) > 1e-6
    assert problem.particles.node_basis.found.all()  # (known before the step, too)
    if moves:
        lift.value[1] = 0.01
    else:
        problem.stage(bcs=[side])
    with pytest.raises(mpm.ParticleOutsideError) as caught:
        problem.solve(time=0.72, dt=0.04)
    assert caught.value.where[1] < 0.0


def sand(component, up, kind=QUADRILATERAL, row=False):
    """Return a column of sand on a held floor, or one that falls up to a ceiling."""
    low, high = (0.0, 1.5 + 0.5 * row) if up else (-0.5 * row, 1.5)
    cells = [16, 6 + 2 * row]
    V = scenes.vectors(scenes.box([0.0, low], [4.0, high], cells, kind))
    bottom = 0.5 if up else 0.0
    particles = mpm.Particles(scenes.box([0.0, bottom], [1.0, bottom + 1.0], [8, 8], TRIANGLE), V)
    law = mpm.materials.MohrCoulomb(1e6, 0.3, 0.0, 30.0)
    force = (0.0, 10.0 if up else -10.0)
    floor = (1.5, np.inf) if up else (-np.inf, 0.0)
    return mpm.DynamicProblem(
        mpm.Body(particles, law, density=2000.0, body_force=force),
        bcs=[mpm.held(V, 0, x=0.0), mpm.held(V, component, y=floor)],
        scheme="euler",
    )


def test_sand_slides_off_a_smooth_floor():
    # No corner is far below it, and those that are slide on with the others.
    problem = sand(1, up=False)
    with pytest.raises(mpm.ParticleOutsideError) as caught:
        problem.solve(time=1.5, dt=0.05)
    assert caught.value.where[0] > 4.0
