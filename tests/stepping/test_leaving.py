# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Particles that leave the background: the policies, and what deletion does to a body."""

import numpy as np
import pytest
import scenes
from posed import posed
from scenes import QUADRILATERAL, TRIANGLE, WORLD, falling

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


@pytest.mark.parametrize(
    ("up", "place", "line"),
    [
        (False, "begin at y = -0.25", "mpm.held(V, y=(-0.25, 0))"),
        (True, "end at y = 1.75", "mpm.held(V, y=(1.5, 1.75))"),
    ],
)
def test_sand_that_falls_through_a_held_line_is_told_how_to_hold_it(up, place, line):
    problem = sand(None, up)
    with pytest.raises(mpm.ParticleOutsideError) as caught:
        problem.solve(time=1.0, dt=0.01)
    told = f"let the background {place} and hold the cells that are added, {line}."
    assert str(caught.value).endswith(told)


def sand(component, up):
    """Return a column of sand on a held floor, or one that falls up to a ceiling."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [4.0, 1.5], [16, 6], QUADRILATERAL))
    low = 0.5 if up else 0.0
    particles = mpm.Particles(scenes.box([0.0, low], [1.0, low + 1.0], [8, 8], TRIANGLE), V)
    law = mpm.materials.MohrCoulomb(1e6, 0.3, 0.0, 30.0)
    force = (0.0, 10.0 if up else -10.0)
    return mpm.DynamicProblem(
        mpm.Body(particles, law, density=2000.0, body_force=force),
        bcs=[mpm.held(V, 0, x=0.0), mpm.held(V, component, y=1.5 if up else 0.0)],
    )


def test_sand_that_slides_off_is_told_of_no_held_line():
    problem = sand(1, up=False)
    with pytest.raises(mpm.ParticleOutsideError) as caught:
        problem.solve(time=1.5, dt=0.05)
    assert caught.value.where[0] > 4.0 and "held" not in str(caught.value)
