# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bodies of boxes without a mesh."""

import numpy as np
import pytest
import scenes
from compare import raises
from scenes import QUADRILATERAL, WORLD, box, vectors

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky


@pytest.mark.parametrize("wrong", [np.nan, 99.0, "shape", "text"])
def test_one_box_that_is_wrong(wrong):
    V = scenes.vectors(scenes.box([0.0, 0.0], [4.0, 4.0], [8, 8], QUADRILATERAL))
    x = np.array([[0.5 + 0.25 * WORLD.rank, 0.5], [0.5 + 0.25 * WORLD.rank, 0.75]])
    if WORLD.rank == WORLD.size - 1:
        if isinstance(wrong, float):
            x[1, 0] = wrong
        else:
            x = x[:, :1] if wrong == "shape" else "text"
    kind, match = mpm.MPMError, "points must be finite and of shape"
    if wrong == 99.0:
        kind, match = mpm.ParticleOutsideError, f"particle {2 * WORLD.size - 1} "
    raises(lambda: mpm.Particles.from_points(x, 0.25, V), kind, match)


def test_boxes_in_one_place():
    V = scenes.vectors(scenes.box([0.0, 0.0], [4.0, 4.0], [8, 8], QUADRILATERAL))
    x = np.array([[0.5 + WORLD.rank, 0.5], [0.5 + WORLD.rank, 0.75]])
    mpm.Particles.from_points(x, 0.25, V)
    if WORLD.rank == WORLD.size - 1:
        x = np.concatenate([x, [[0.5, 0.75 + 1e-12]]])
    last = 2 * WORLD.size
    error = raises(
        lambda: mpm.Particles.from_points(x, 0.25, V), mpm.MPMError, "others in the same place"
    )
    assert error.particles == [1, last]


@pytest.mark.parametrize("unit", [1e-8, 1.0, 1e8])
def test_boxes_in_one_place_in_any_unit(unit):
    V = scenes.vectors(scenes.box([0.0, 0.0], [4.0 * unit] * 2, [8, 8], QUADRILATERAL))
    x = unit * np.array([[0.5 + WORLD.rank, 0.5], [0.5 + WORLD.rank, 0.75]])
    mpm.Particles.from_points(x, 0.25 * unit, V)
    near = np.concatenate([x, x[:1] + 1e-12 * unit])
    raises(
        lambda: mpm.Particles.from_points(near, 0.25 * unit, V),
        mpm.MPMError,
        "others in the same place",
    )


def test_boxes_without_a_mesh_are_those_of_a_mesh():
    V = vectors(box([0.0, -0.25], [2.0, 1.25], [8, 6], QUADRILATERAL))
    held = scenes.fix(V, scenes.at(0, 0.0))
    bodies = [mpm.Particles(box([0.0, 0.0], [1.0, 1.0], [8, 8], QUADRILATERAL), V, method="gimp")]
    mine = bodies[0].initial_centroid
    bodies.append(mpm.Particles.from_points(mine, 0.125, V))
    stresses = []
    for particles in bodies:
        problem = mpm.QuasiStaticProblem(
            mpm.Body(particles, Hencky(1e3, 0.3), density=2.0, body_force=(0.0, -10.0)), bcs=[held]
        )
        problem.solve(steps=4)
        stresses.append(particles.stress)
    scale = scenes.largest(stresses[0])
    assert scenes.largest(stresses[0] - stresses[1]) < 1e-9 * scale


def test_clouds_that_are_none():
    V = vectors(box([0.0, 0.0], [1.0, 1.0], [4, 4], QUADRILATERAL))
    with pytest.raises(mpm.MPMError, match="shape"):
        mpm.Particles.from_points(np.zeros((3, 3)), 0.1, V)
    with pytest.raises(mpm.MPMError, match="lengths"):
        mpm.Particles.from_points(np.full((3, 2), 0.5), np.ones(5), V)
    with pytest.raises(mpm.MPMError, match="positive"):
        mpm.Particles.from_points(np.full((3, 2), 0.5), -0.1, V)
    with pytest.raises(mpm.ParticleOutsideError):
        mpm.Particles.from_points(np.array([[1.5, 1.5 + WORLD.rank]]), 0.1, V)


def test_a_rank_without_boxes():
    V = vectors(box([0.0, 0.0], [1.0, 1.0], [4, 4], QUADRILATERAL))
    points = np.array([[0.4, 0.4], [0.6, 0.6]])[: 2 if WORLD.rank == 0 else 0]
    particles = mpm.Particles.from_points(points.reshape(-1, 2), 0.2, V)
    assert particles.num_global == 2
    assert scenes.total(particles, particles.volume) == pytest.approx(0.08)
