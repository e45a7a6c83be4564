# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What obstacles and bodies do on their way in a step: past each other, but not through."""

import numpy as np
import pytest
import scenes
from obstacles import POISSON, YOUNG, dragged
from scenes import QUADRILATERAL

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import contact
from mpm_dolfinx.contact.ways import goes_through
from mpm_dolfinx.materials import Hencky


def test_an_obstacle_does_not_jump_through_a_body():
    problem, die, _ = dragged(n=4)
    start = die.offset
    problem.solve(1, update=lambda t: die.move((0.0, -0.2 * t)))  # which is less than a domain
    assert np.abs(die.reaction[1]) > 0.0
    die.move((0.0, -9.0))
    with pytest.raises(
        mpm.ConvergenceError, match="moves through the body in one step; move it in smaller"
    ):
        problem.step()
    assert die.offset.tolist() == [0.0, -0.2] and start.tolist() == [0.0, 0.0]
    problem.solve(1, update=lambda t: die.move((0.0, -0.2 - 0.3 * t)))
    taken_back = problem.history.taken_back
    refused = [a.iterations for a in taken_back if "moves through" in a.reason]
    assert refused and set(refused) == {0}  # nothing was solved


#: Obstacles that are thinner than a domain, above a unit block.
THIN = {
    "disc": contact.disc((0.5, 1.5), 0.1),
    "box": contact.box((0.1, 1.3), (0.9, 1.4)),
    "polygon": contact.polygon([(0.4, 1.3), (0.6, 1.3), (0.5, 1.5)]),
    "polyline": contact.polyline([(0.4, 1.3), (0.6, 1.3), (0.5, 1.5), (0.4, 1.3)], radius=0.01),
    "function": contact.signed_distance(
        lambda y: np.hypot(y[:, 0] - 0.5, y[:, 1] - 1.5) - 0.1, (0.5, 1.5)
    ),
}


def under(shape):
    """Return a unit block of domains of 1/4 that stands below an obstacle, and their contact."""
    V = scenes.vectors(scenes.box([-0.3, -0.2], [1.3, 1.3], [6, 6], QUADRILATERAL))
    particles = mpm.Particles(scenes.unit(4, QUADRILATERAL), V)
    rigid = contact.Rigid(particles, shape, 0.3)
    bcs = [fem.dirichletbc(np.zeros(2), fem.locate_dofs_geometrical(V, lambda x: x[1] < 0.01), V)]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, Hencky(YOUNG, POISSON)), bcs=bcs, terms=[rigid]
    )
    return problem, rigid


@pytest.mark.parametrize("name", THIN)
def test_a_thin_obstacle_does_not_jump_through_a_body(name):
    problem, rigid = under(THIN[name])
    for x in (0.0, 0.3):
        rigid.move((x, -3.0))
        with pytest.raises(mpm.ConvergenceError, match="moves through the body in one step"):
            problem.step()
    assert rigid.offset.tolist() == [0.0, 0.0]
    for offset in ((2.0, 0.0), (2.0, -3.0)):  # beside the body nothing is in the way
        rigid.move(offset)
        problem.step()
    assert not np.any(rigid.reaction)


@pytest.mark.parametrize("name", ["box", "disc"])
def test_a_way_that_gets_deep_is_one_through_the_obstacle(name):
    # Depth is concave along a chord of a convex shape, so in its middle it is half of the largest.
    shape = {"box": contact.box((0.0, 0.0), (10.0, 5.0)), "disc": contact.disc((5.0, 2.5), 2.5)}[
        name
    ]
    rng = np.random.default_rng(7)
    a = np.column_stack([rng.uniform(0.0, 10.0, 400), np.full(400, 5.0)])  # on top of the box
    if name == "disc":
        angle = rng.uniform(0.0, 2.0 * np.pi, 400)
        a = np.array([5.0, 2.5]) + 2.5 * np.column_stack([np.cos(angle), np.sin(angle)])
    b = rng.uniform([-3.0, -3.0], [13.0, 8.0], (400, 2))
    b[:100] = a[:100] + rng.uniform([-20.0, -1.5], [20.0, 0.0], (100, 2))  # many are grazing
    thickness, share = np.full(1, 0.05), np.linspace(0.0, 1.0, 501)[:, None]
    gap, normal = shape.distance(a)
    told = 0
    for at, end, phi, n in zip(a, b, gap, normal, strict=True):
        deepest = -shape.distance(at + share * (end - at))[0].min()
        found = goes_through(shape, at[None], end[None], phi[None], n[None], thickness)
        assert found or deepest < 2.0 * thickness
        told += found
    assert 100 < told < 400


def test_a_point_slides_past_the_corner_of_an_obstacle():
    # a sharp box is pressed in, then drawn aside so far that points leave it by its other side
    problem, rigid = under(contact.box((0.3, 1.0), (0.7, 1.1)))
    problem.solve(2, update=lambda t: rigid.move((0.0, -0.02 * t)))
    assert rigid.reaction[1] < 0.0
    for step in range(1, 8):
        rigid.move((0.15 * step, -0.02))
        problem.step()
    assert not np.any(rigid.reaction)
