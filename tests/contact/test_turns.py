# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Obstacles and rigid bodies that turn far in a step."""

import numpy as np
import pytest
import scenes
from marks import slow
from scenes import QUADRILATERAL, box

import mpm_dolfinx as mpm
from mpm_dolfinx import contact
from mpm_dolfinx.contact.rotation import Pose
from mpm_dolfinx.materials import Hencky


def pressed(friction=0.3):
    """Return a block with a disc pressed into it, the disc and its height."""
    V = scenes.vectors(box([0.0, -0.2], [2.0, 1.4], [10, 8], QUADRILATERAL))
    body = mpm.Particles(box([0.2, 0.0], [1.8, 1.0], [16, 8], QUADRILATERAL), V)
    disc = contact.Rigid(body, contact.disc((1.0, 1.3), 0.3), friction)
    base = [scenes.below(V, 0.01)]
    problem = mpm.QuasiStaticProblem(mpm.Body(body, Hencky(1e3, 0.3)), bcs=base, terms=[disc])
    problem.solve(2, update=lambda t: disc.move((0.0, -0.05 * t)))
    return problem, disc


@pytest.mark.parametrize("turn", [1.0, *slow(4.0), 2.0 * np.pi])
def test_friction_is_against_the_turn_however_far_a_step_goes(turn):
    problem, disc = pressed()
    problem.solve(1, update=lambda t: disc.move((0.0, -0.05), turn * t))
    fine, same = pressed()
    fine.solve(12, update=lambda t: same.move((0.0, -0.05), turn * t))
    assert fine.history.cutbacks == 0 and fine.reaction(same)[0] > 1.0
    np.testing.assert_allclose(problem.reaction(disc), fine.reaction(same), rtol=0.03)
    assert (problem.history.cutbacks > 0) == (turn > 0.5 * np.pi)
    # Without a path there are no smaller steps.
    disc.move((0.0, -0.05), turn + 2.0 * np.pi)
    with pytest.raises(mpm.ConvergenceError, match=r"turns by 6\.28 rad in one step"):
        problem.step()
    assert np.all(disc.angle == turn)


def test_an_obstacle_that_rubs_nothing_turns_as_far_as_it_likes():
    problem, disc = pressed(0.0)
    disc.move((0.0, -0.05), 7.0)
    problem.step()
    problem, disc = pressed()
    disc.move((0.0, 0.2))
    problem.step()
    disc.move((0.0, 0.2), 7.0)
    problem.step()
    assert disc.angle == 7.0


def test_turns_between_poses():
    some = np.random.default_rng(1)
    for size in (1e-3, 1.0, 3.0):
        axis = some.normal(size=3)
        axis *= size / np.linalg.norm(axis)
        last = Pose(np.zeros(3), 0.7 * axis / size)
        pose = Pose(np.zeros(3), last.angle + axis)
        assert pose.turn_from(last) == pytest.approx(size)
        assert pose.least_turn_from(last) == pytest.approx(size, rel=1e-9)
    for angle in (1e-3, 1.0, 3.0):
        flat = Pose(np.zeros(2), np.array([0.4])), Pose(np.zeros(2), np.array([0.4 - angle]))
        assert flat[1].turn_from(flat[0]) == pytest.approx(angle)
        assert flat[1].least_turn_from(flat[0]) == pytest.approx(angle, rel=1e-9)


@pytest.mark.parametrize("scheme", ["conserving", *slow("euler")])
def test_a_body_that_spins_fast_turns_as_far_as_it_should(scheme):
    V = scenes.vectors(box([0.0, -0.2], [2.0, 3.0], [5, 8], QUADRILATERAL))
    body = mpm.Particles(box([0.2, 0.0], [1.8, 1.0], [4, 3], QUADRILATERAL), V)
    disc = contact.RigidBody(body, contact.disc((1.0, 2.0), 0.3), 1.0, inertia=0.05, spin=50.0)
    problem = mpm.DynamicProblem(
        mpm.Body(body, Hencky(1e3, 0.3), density=1.0), scheme=scheme, terms=[disc]
    )
    problem.solve(time=0.1, dt=0.1)
    assert disc.angle == pytest.approx(5.0, rel=0.02) and disc.spin == pytest.approx(50.0)
    assert problem.history.cutbacks > 0
