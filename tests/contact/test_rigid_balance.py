# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Where a rigid body at rest begins a step, and what is left to itself."""

import numpy as np
import pytest
import scenes
from compare import raises
from marks import thinned
from posed import posed
from scenes import HEXAHEDRON, QUADRILATERAL, box

import mpm_dolfinx as mpm
from mpm_dolfinx import contact
from mpm_dolfinx.contact.rotation import QUARTER
from mpm_dolfinx.materials import Hencky

TIGHT = {"snes_rtol": 1e-12}


def on_block(shape, dim=2, **options):
    """Return a problem of a block on a rough base, and a rigid body beside it."""
    low, high = [-0.5] * dim, [1.5] * dim
    V = scenes.vectors(box(low, high, [8] * dim, QUADRILATERAL if dim == 2 else HEXAHEDRON))
    kind = QUADRILATERAL if dim == 2 else HEXAHEDRON
    body = mpm.Particles(box([0.0] * dim, [1.0] * dim, [8 if dim == 2 else 5] * dim, kind), V)
    rigid = contact.RigidBody(body, shape, **options)
    problem = posed(
        mpm.QuasiStaticProblem,
        body,
        Hencky(1e3, 0.3),
        bcs=[scenes.below(V, 0.01)],
        terms=[rigid],
        petsc_options=TIGHT,
    )
    return problem, rigid


@pytest.mark.parametrize(("dim", "steps"), thinned(3, [(2, 1), (2, 5), (3, 2)]))
def test_what_no_friction_holds_does_not_turn(dim, steps):
    names, place = ("x", "y", "z")[:dim], [0.45] * dim
    place[-1] = 1.3
    round_one = contact.disc(place, 0.3) if dim == 2 else contact.sphere(place, 0.3)
    problem, rigid = on_block(round_one, dim, fixed=names)
    down = np.zeros(dim)
    down[-1] = -0.03
    problem.solve(steps, update=lambda t: rigid.move(t * down))
    assert -problem.reaction(rigid)[-1] > 0.1
    assert np.abs(rigid.angle).max() < 1e-12
    # Nothing bears a moment on it, be it small or large.
    for size in (1e-3, 20.0):
        rigid.push(np.zeros(dim), size if dim == 2 else (0.0, 0.0, size))
        raises(problem.step, mpm.ConvergenceError, "of the forces on a RigidBody do not balance")
        assert np.abs(rigid.angle).max() < 1e-12


def test_a_lid_on_two_edges_begins_near_to_its_balance():
    # Two edges of the block touch the inside of a large ring. Newton's method by itself goes to
    # and fro between one edge and the other, and cuts the step back ten times.
    shape = contact.cavity(contact.disc((0.5, 1.0 - np.sqrt(4.0 - 0.25)), 2.0))
    problem, lid = on_block(shape, centre=(0.5, 1.0), friction=2.0)
    problem.solve(2, update=lambda t: lid.push((-0.04 * t, -1.2 * t), 0.04 * t))
    assert np.abs(problem.reaction(lid) - (-0.04, -1.2)).max() < 1e-9
    assert problem.history.cutbacks == 0 and sum(problem.history.iterations) <= 12


def test_a_step_that_failed_is_tried_from_where_it_touches_first():
    gap = 0.02
    shape = contact.box((-0.2, 1.0 + gap), (0.8, 1.4 + gap), 0.05)
    _, plate = on_block(shape, centre=(0.4, 1.0 + gap), friction=0.5)

    def beginning(force):
        plate.push((0.0, force), 0.1 * force)
        plate.begin()
        plate.update()
        return plate.own.start

    near, first, again = (beginning(-8.0) for _ in range(3))
    assert np.abs(np.add(first, (0.0, gap, 0.0))).max() < 1e-5 and near[1] < -gap - 1e-4
    assert abs(near[2]) > 5e-4 and np.array_equal(again, near)
    # Another step begins near to its balance.
    assert beginning(-6.0)[1] < -gap - 1e-4
    plate.roll_back()


def test_what_no_force_acts_on_stays_where_it_is():
    problem, ball = on_block(contact.disc((0.5, 2.0), 0.3))
    problem.particles.load.value = 0.0
    problem.step()
    assert not ball.offset.any() and not ball.angle.any()


@pytest.mark.parametrize("turn", [1.5, 10.0])
def test_no_trial_turns_it_by_more_than_half_a_turn(turn):
    problem, plate = on_block(contact.box((-0.2, 1.0), (1.2, 1.4), 0.05), friction=0.5)
    problem.solve(1, update=lambda t: plate.push((0.0, -5.0 * t)))
    unknowns, most = plate.own, 2.0 * np.tan(0.5 * QUARTER)  # (its Cayley vector)
    unknowns.values = np.array([0.0, 0.0, turn * most])  # (times a length, here 1)
    failure = plate.update()
    assert isinstance(failure, mpm.ConvergenceError) and "turns too far" in str(failure)
    unknowns.values = np.array([0.0, 0.0, 0.9 * most])
    assert plate.update() is None


@pytest.mark.parametrize("gap", [1e-9, 0.02, 0.3])
def test_it_falls_on_what_is_below(gap):
    def pressed(gap):
        shape = contact.box((-0.2, 1.0 + gap), (1.2, 1.4 + gap), 0.05)
        problem, plate = on_block(shape, centre=(0.5, 1.0 + gap), fixed="x")
        problem.solve(2, update=lambda t: plate.push((0.0, -8.0 * t), -0.6 * t))
        return problem, plate

    problem, plate = pressed(gap)
    rests = pressed(0.0)[1]
    assert problem.history.cutbacks == 0
    assert np.abs(plate.offset - rests.offset + (0.0, gap)).max() < 1e-6
    assert plate.angle[0] == pytest.approx(rests.angle[0], abs=1e-6) and abs(rests.angle[0]) > 1e-3
    # Upwards there is nothing.
    problem, plate = on_block(contact.box((-0.2, 1.0 + gap), (1.2, 1.4 + gap), 0.05))
    plate.push((0.0, 1.0))
    raises(problem.step, mpm.ConvergenceError, "Nothing holds a RigidBody against 1.0e")
    assert not plate.offset.any()


def test_it_falls_past_what_is_beside_its_way():
    wall = contact.plane((0.0, 1.2), (0.0, -1.0))
    problem, rigid = on_block(wall)
    rigid.push((1.0, 0.0))  # along the block, as far above it as ever
    raises(problem.step, mpm.ConvergenceError, "Nothing holds a RigidBody against 1.0e")
    problem, rigid = on_block(contact.disc((-0.5, 2.0), 0.3))
    rigid.push((-1.0, -0.1))  # away from it
    raises(problem.step, mpm.ConvergenceError, "Nothing holds a RigidBody against 1.0e")
    assert not rigid.offset.any()
