# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Laws of friction of a user's own, with a memory: on obstacles and between bodies."""

import numpy as np
import pytest
from compare import EXACT, outcome, raises, same_run
from marks import slow
from obstacles import dragged
from pairs import two
from scenes import WORLD

import mpm_dolfinx as mpm
from mpm_dolfinx import contact
from mpm_dolfinx.contact import law as laws

TOUCH = 1e-12


class Wear(contact.Friction):
    """A coefficient that goes from one value to another with the way that a point has slipped."""

    memory = (0.0,)

    def __init__(self, first, last, length=0.02):
        self.first, self.last, self.length = first, last, length

    def bound(self, at):
        slipped = at.memory[:, 0] + at.slip
        change = (self.first - self.last) * np.exp(-slipped / self.length)
        return (self.last + change) * at.pressure

    def remember(self, at):
        return at.memory + at.slip[:, None]


def points(dim, count=300):
    """Return points of which some stick, slip, and have just come, and where they are."""
    some = np.random.default_rng(3)
    k, normal = some.uniform(50.0, 150.0, count), some.normal(size=(count, dim))
    gap = -some.uniform(0.0, 0.02, count)
    known = laws.Points(
        k,
        k * some.uniform(0.5, 2.0, count),
        some.uniform(size=count) < 0.6,
        np.zeros((count, 0)),
        some.uniform(0.0, 0.05, count),
        some.uniform(0.9, 1.1, count),
        some.uniform(0.0, 0.02, (count, 1)),
    )
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    return known, laws.Separation(gap, normal, some.normal(0.0, 0.01, normal.shape), TOUCH)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("wear", [Wear(0.2, 0.5), Wear(0.5, 0.2), Wear(0.4, 0.3, 1e-3)])
def test_the_bound_is_that_of_the_slip_of_the_step(wear, dim):
    known, at = points(dim)
    acts, slipped = laws.traction(wear, known, at), laws.remembered(wear, known, at)
    slip = (slipped - known.memory)[:, 0]
    assert 0.3 < acts.slips.mean() < 0.95 and ((slip > 0.0) == acts.slips).all()
    size = np.linalg.norm(acts.shear, axis=1)
    mu = wear.last + (wear.first - wear.last) * np.exp(-slipped[:, 0] / wear.length)
    np.testing.assert_allclose(size[acts.slips], (mu * acts.pressure)[acts.slips], rtol=1e-10)
    assert (size <= mu * acts.pressure * (1.0 + 1e-10)).all()
    # what is left of the way stretches the spring between the anchor and the point
    n, delta = at.normal, at.delta
    way = np.linalg.norm(delta - n * (n * delta).sum(axis=1)[:, None], axis=1)
    share = np.where(known.touched, 1.0, -at.gap / (known.gap - at.gap))
    np.testing.assert_allclose(size, known.tangential * share * (way - slip), atol=1e-10)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("pressed", [False, True])
def test_slopes_are_those_of_differences(dim, pressed):
    wear, (known, at) = Wear(0.2, 0.5), points(dim)
    if pressed:
        behind = np.random.default_rng(6).normal(0.0, 2.0, at.normal.shape)
        at = at._replace(behind=behind)
    # as gaps and normals may grow with positions
    some, h = np.random.default_rng(7), 1e-7
    n, bends = some.normal(size=(len(at.gap), dim)), some.normal(size=(len(at.gap), dim, dim))
    found, before = laws.slopes(wear, known, at, n, bends), laws.traction(wear, known, at)
    assert before.slips.any()
    for i in range(dim):
        ends = []
        for step in (h, -h):
            gap, normal = at.gap + step * n[:, i], at.normal + step * bends[:, :, i]
            moved = at._replace(gap=gap, normal=normal, delta=at.delta + step * np.eye(dim)[i])
            ends.append(laws.traction(wear, known, moved))
        same = (ends[0].slips == ends[1].slips) & (ends[0].inside == ends[1].inside)
        first, second = (one.normal + one.shear for one in ends)
        exact = (first - second)[same] / (2.0 * h)
        assert same.mean() > 0.99
        np.testing.assert_allclose(found[same, :, i], exact, atol=1e-6 * np.abs(found).max())


def on_obstacle(law):
    problem, die, path = dragged(friction=law)
    return problem, die, path, 6


def between_bodies(law):
    problem, touch, path = two(friction=law)
    return problem, touch, path, 6


def slipped(touch):
    """Return the mean way that points have slipped, by their areas, times the area."""
    area = touch.area[: len(touch.friction_memory)]
    return WORLD.allreduce(float(area @ touch.friction_memory[:, 0]))


SCENES = [on_obstacle, between_bodies]


@pytest.mark.parametrize("scene", [on_obstacle, *slow(between_bodies)])
def test_a_law_that_wears_to_where_it_was_is_coulombs(scene):
    found = []
    for law in (Wear(0.3, 0.3), contact.Coulomb(0.3)):
        problem, touch, path, steps = scene(law)
        problem.solver.setTolerances(rtol=1e-12)
        problem.solve(steps, update=path)
        assert WORLD.allreduce(int((touch.touches & ~touch.sticks).sum())) > 0
        found.append(touch.reaction)
    np.testing.assert_allclose(found[0], found[1], rtol=1e-8)
    assert touch.friction_memory.shape == (len(touch.gap), 0)


@pytest.mark.parametrize("scene", SCENES)
def test_shear_of_points_that_slip_is_that_of_what_they_remember(scene):
    law = Wear(0.1, 0.4)
    problem, touch, path, steps = scene(law)
    problem.solve(steps, update=path)
    slips, p = touch.touches & ~touch.sticks, touch.pressure
    traction, slipped = touch.traction, touch.friction_memory[:, 0]
    assert WORLD.allreduce(int(slips.sum())) > 3
    assert WORLD.allreduce(int((slipped[slips] > 0.01).sum())) > 3
    mu = 0.4 - 0.3 * np.exp(-slipped / 0.02)
    size = np.sqrt(np.maximum((traction**2).sum(axis=1) - p**2, 0.0))
    np.testing.assert_allclose(size[slips], (mu * p)[slips], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("scene", SCENES)
def test_what_points_have_slipped_goes_on_from_a_checkpoint(scene, mpi_tmp_path):
    law = Wear(0.1, 0.4)
    problem, touch, path, steps = scene(law)
    for _ in problem.steps(steps, update=path):
        if len(problem.history.steps) == steps - 2:
            problem.save(mpi_tmp_path / "half.ckpt")
            before = touch.friction_memory
    other, again, path, _ = scene(law)
    other.restore(mpi_tmp_path / "half.ckpt")
    np.testing.assert_allclose(again.friction_memory, before, rtol=1e-12)
    assert WORLD.allreduce(float(before.sum())) > 0.0
    other.solve(steps, update=path)
    np.testing.assert_allclose(again.friction_memory, touch.friction_memory, EXACT, EXACT)
    same_run(outcome(other), outcome(problem), EXACT)


def test_what_points_have_slipped_goes_with_a_body_that_is_rebased():
    problem, die, path, _ = on_obstacle(Wear(0.1, 0.4))
    other, alone, same, _ = on_obstacle(Wear(0.1, 0.4))
    for number, _ in enumerate(problem.steps(6, update=path)):
        if number == 3:
            before = slipped(die)
            problem.rebase()
            assert slipped(die) == pytest.approx(before, rel=1e-12)
    other.solve(6, update=same)
    assert before > 0.01
    np.testing.assert_allclose(die.reaction, alone.reaction, rtol=1e-5)
    assert slipped(die) == pytest.approx(slipped(alone), rel=1e-5)


def raising(at):
    raise KeyError("no table")


BOUNDS = {
    "a number": (lambda at: 0.3, "One.bound must return finite numbers of shape"),
    "nan": (lambda at: np.nan * at.pressure, "One.bound must return finite numbers of shape"),
    "negative": (lambda at: -at.pressure, "One.bound must return shear tractions from 0 on"),
    "a word": (lambda at: "rough", "One.bound failed with"),
    "an error": (raising, "One.bound failed with KeyError: 'no table'"),
    "writes": (lambda at: np.multiply(at.pressure, 0.0, out=at.gap), "One.bound failed with"),
}


@pytest.mark.parametrize("kind", BOUNDS)
@pytest.mark.parametrize("scene", SCENES)
def test_a_law_that_gives_no_bound_for_each_point_is_refused(scene, kind):
    bound, sentence = BOUNDS[kind]

    class One(contact.Friction):
        def bound(self, at):
            return bound(at)

    problem, _, path, steps = scene(One())
    raises(lambda: problem.solve(steps, update=path), mpm.MPMError, sentence)


@pytest.mark.parametrize("scene", SCENES)
def test_a_law_that_remembers_no_numbers_is_refused(scene):
    class One(contact.Friction):
        memory = (0.0,)

        def bound(self, at):
            return 0.3 * at.pressure

        def remember(self, at):
            return at.slip

    problem, _, path, steps = scene(One())
    sentence = "One.remember must return finite numbers of shape"
    raises(lambda: problem.solve(steps, update=path), mpm.MPMError, sentence)
    for wrong in (0.0, "new", (np.nan,), None):
        One.memory = wrong
        raises(lambda: scene(One()), mpm.MPMError, "One.memory must be a list of finite numbers")
