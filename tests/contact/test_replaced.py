# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Contacts that come, go, change places and stand in for others: what each remembers is its own."""

from itertools import product

import numpy as np
import pairs
import pytest
import scenes
from marks import slow, thinned
from posed import posed
from scenes import QUADRILATERAL, WORLD, box

import mpm_dolfinx as mpm
from mpm_dolfinx import contact
from mpm_dolfinx.io import Column, Kept
from mpm_dolfinx.materials import Hencky

TIGHT = {"petsc_options": {"snes_rtol": 1e-13}}
CENTRE, RADIUS = (1.5, 1.3), 0.3


def soil():
    """Return a block that stands on its base, and what holds it."""
    V = scenes.vectors(box([-1.0, -0.2], [4.0, 1.8], [15, 6], QUADRILATERAL))
    particles = mpm.Particles(box([0.2, 0.0], [2.8, 1.0], [26, 6], QUADRILATERAL), V)
    return particles, [scenes.below(V, 0.01)]


def pressed(law="penalty", count=1, names=(None,), order=1):
    """Return a block into which discs are pressed and dragged, and these."""
    particles, base = soil()
    discs = [
        contact.Rigid(particles, contact.disc((1.5 - 0.9 * i, 1.3), RADIUS), 0.3, law=law)
        for i in range(count)
    ]
    for disc, name in zip(discs, names, strict=False):
        disc.name = name
    problem = posed(
        mpm.QuasiStaticProblem, particles, Hencky(1e3, 0.3), bcs=base, terms=discs[::order], **TIGHT
    )
    return problem, discs


def press(problem, discs, steps=2):
    def path(t):
        for number, disc in enumerate(discs):
            disc.move((0.002 * t, -0.04 * t - 0.01 * number * t), 0.002 * t)

    problem.solve(steps, update=path)


def forces(contacts):
    return np.array([one.reaction for one in contacts])


def in_all(which):
    """Return how many points of all ranks are meant."""
    return WORLD.allreduce(int(which.sum()))


def above(particles):
    """Return a plate that does not touch the block."""
    return contact.Rigid(particles, contact.plane((1.5, 1.02), (0.0, -1.0)))


@pytest.mark.parametrize("axisymmetric", [False, True])
def test_a_new_contact_knows_the_undeformed_areas_of_a_body_that_was_rebased(axisymmetric):
    particles, base = soil()
    options = {"axisymmetric": axisymmetric}
    disc = contact.Rigid(particles, contact.disc(CENTRE, RADIUS), **options)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, Hencky(100.0, 0.3)), bcs=base, terms=[disc], **options
    )
    problem.solve(3, update=lambda t: disc.move((0.0, -0.1 * t)))
    problem.rebase()
    new = contact.Rigid(problem.particles, contact.disc((9.0, 9.0), 0.1), **options)
    problem.stage(terms=[disc, new])
    np.testing.assert_allclose(new.area, disc.area, rtol=1e-9)
    stiffness = [one.kept()[0].columns(0)["thickness"].values for one in (new, disc)]
    np.testing.assert_allclose(*stiffness, rtol=1e-9)


def test_a_new_contact_knows_the_boundary_of_a_body_that_was_split():
    """Diagonals that cuts have laid bare are none of it, and halves are as stiff as they were."""
    problem, (disc,) = pressed()
    before = {}
    for cuts in ([], np.arange(0, 156, 4), [1]):
        if len(cuts):
            problem.split(cuts)
        top = mpm.facet_tags(problem.particles.mesh, {1: mpm.region(y=1.0)})
        far = contact.disc((9.0 + len(cuts), 9.0), 0.1)
        new = contact.Rigid(problem.particles, far)
        upper = contact.Rigid(problem.particles, far, facets=(top, 1))
        problem.stage(terms=[disc, new, upper])
        for name, one, length in (("disc", disc, 7.2), ("new", new, 7.2), ("upper", upper, 2.6)):
            columns = one.kept()[0].columns(0)
            area, height = columns["area"].values, columns["thickness"].values
            assert WORLD.allreduce(area.sum()) == pytest.approx(length, rel=1e-12)
            behind = WORLD.allreduce((area * height).sum())
            assert behind == pytest.approx(before.setdefault(name, behind), rel=1e-12)


def test_a_new_contact_begins_where_it_was_made():
    problem, (disc,) = pressed()
    press(problem, [disc])
    plate = above(problem.particles)
    problem.stage(terms=[plate])
    assert np.all(plate.offset == 0.0)
    problem.solve(2)
    assert np.all(plate.offset == 0.0) and np.all(problem.reaction(plate) == 0.0)
    # (what the disc has pressed in comes back, but for what other increments cannot have)
    assert scenes.largest(problem.particles.displacement.x.array) < 0.01 * 0.04


@pytest.mark.parametrize("first", [True, False])
def test_a_contact_comes_beside_another_one_in_any_order(first):
    other, (same,) = pressed()
    press(other, [same])
    other.stage(terms=[same])
    other.solve(1)
    problem, (disc,) = pressed()
    press(problem, [disc])
    plate = above(problem.particles)
    problem.stage(terms=[plate, disc] if first else [disc, plate])
    problem.solve(1)
    assert np.all(problem.reaction(plate) == 0.0)
    np.testing.assert_allclose(disc.reaction, same.reaction, rtol=1e-11)
    press(problem, [disc, plate], 1)
    assert problem.reaction(plate)[1] < -1.0


def test_a_contact_that_comes_back_begins_anew():
    problem, (disc,) = pressed()
    press(problem, [disc])
    lifted = np.add(disc.offset, (0.0, 0.2))
    problem.stage(terms=[])
    problem.solve(1)
    assert scenes.largest(problem.particles.displacement.x.array) < 0.01 * 0.04
    disc.move(lifted)
    problem.stage(terms=[disc])
    assert np.all(disc.offset == lifted) and not disc.touches.any()
    press(problem, [disc])
    other, (same,) = pressed()
    same.move(lifted)
    other.step()
    press(other, [same])
    np.testing.assert_allclose(forces([disc]), forces([same]), rtol=0.01)
    sticks = [in_all(one.sticks) for one in (disc, same)]
    assert sticks[0] == sticks[1]


@pytest.mark.parametrize("scheme", ["euler", "conserving"])
def test_a_new_rigid_body_moves_as_it_was_made(scheme):
    particles, base = soil()

    def boulder(centre, **motion):
        return contact.RigidBody(
            particles, contact.disc(centre, RADIUS), 1.0, inertia=0.045, **motion
        )

    old = boulder((0.9, 1.31), velocity=(1.0, -2.0), spin=3.0)
    problem = mpm.DynamicProblem(
        mpm.Body(particles, Hencky(1e3, 0.3), density=1.0), scheme=scheme, terms=[old], bcs=base
    )
    problem.solve(time=0.02, dt=0.01)
    new = boulder((2.2, 1.5), velocity=(0.5, 0.0))
    new.push((0.0, 4.0))
    problem.stage(terms=[new])
    assert np.all(new.centre == (2.2, 1.5)) and np.all(new.velocity == (0.5, 0.0))
    assert np.all(new.spin == 0.0)
    problem.solve(time=0.03, dt=0.01)
    share = 0.5 if scheme == "conserving" else 1.0  # (its force was nothing to begin with)
    np.testing.assert_allclose(new.velocity, (0.5, 0.04 * share), rtol=1e-12)


def equal_rigid(law):
    """Return a problem, its contact, how it is moved, and another contact in its place."""
    problem, (disc,) = pressed(law)
    press(problem, [disc])

    def move(one, t):
        offset, angle = ((0.002, -0.04), 0.002) if one is disc else ((-0.998, 0.26), 0.5)
        one.move(np.add(offset, (0.004 * t, 0.0)), angle + 0.004 * t)

    def other():
        # (made elsewhere, and turned)
        one = contact.Rigid(problem.particles, contact.disc((2.5, 1.0), RADIUS), 0.3, law=law)
        one.move((-0.998, 0.26), 0.5)
        return one

    return problem, disc, move, other


def equal_rigid_body():
    particles, base = soil()
    shape = contact.box((1.2, 1.0), (1.8, 1.4), 0.1)
    footing = contact.RigidBody(particles, shape, friction=0.3)
    problem = posed(
        mpm.QuasiStaticProblem, particles, Hencky(1e3, 0.3), bcs=base, terms=[footing], **TIGHT
    )
    problem.solve(2, update=lambda t: footing.push((3.0 * t, -30.0 * t)))

    def other():
        (angle,) = footing.angle
        c, s = np.cos(angle), np.sin(angle)
        corners = np.array([(1.2, 1.0), (1.8, 1.0), (1.8, 1.4), (1.2, 1.4)]) - shape.pivot
        corners = corners @ [[c, s], [-s, c]] + shape.pivot + footing.offset
        one = contact.RigidBody(
            particles,
            contact.polygon(corners, 0.1),
            friction=0.3,
            centre=footing.centre,
        )
        one.push((3.0, -30.0))
        return one

    return problem, footing, lambda one, t: one.push((3.0 + t, -30.0)), other


@pytest.mark.parametrize("kind", ["penalty", "nitsche", "rigid body"])
def test_an_equal_contact_in_its_place_changes_nothing(kind):
    found = []
    for replaced in (False, True):
        problem, old, move, other = equal_rigid_body() if " " in kind else equal_rigid(kind)
        new = other() if replaced else old
        forces = old.reaction
        problem.stage(terms=[new])
        np.testing.assert_allclose(new.reaction, forces, rtol=0.0, atol=1e-12 * 30.0)
        problem.solve(2, update=lambda t, new=new, move=move: move(new, t))
        x = scenes.in_order(problem.particles, problem.particles.centroid)
        found.append((x, problem.reaction(new)))
        sticks = (new.contacts[0] if " " in kind else new).sticks
        assert in_all(sticks) > 0
    for one, two in zip(*found, strict=True):
        assert np.abs(one - two).max() < 1e-12 * np.abs(one).max()


@pytest.mark.parametrize(
    ("law", "passes", "swapped"),
    thinned(
        2,
        [("penalty", 2, True), ("penalty", 2, False), ("nitsche", 2, False), ("penalty", 1, False)],
    ),
)
def test_an_equal_pair_in_its_place_changes_nothing(law, passes, swapped):
    found = []
    for replaced in (False, True):
        problem, old, path = pairs.two(friction=0.3, law=law, passes=passes)
        problem.solver.setTolerances(rtol=1e-13)
        problem.solve(2, update=lambda t, path=path: path(0.5 * t))
        a, b = problem.bodies[::-1] if swapped else problem.bodies
        new = contact.Pair(a, b, 0.3, law=law, passes=passes) if replaced else old
        force = old.reaction
        problem.stage(terms=[new])
        sign = -1.0 if replaced and swapped else 1.0
        np.testing.assert_allclose(sign * new.reaction, force, rtol=0.0, atol=1e-12 * 30.0)
        problem.solve(1, update=lambda t, path=path: path(0.5 + 0.1 * t))
        places = [scenes.in_order(body, body.centroid) for body in problem.bodies]
        found.append((np.concatenate(places), sign * problem.reaction(new)))
    for one, two in zip(*found, strict=True):
        assert np.abs(one - two).max() < 1e-12 * np.abs(one).max()


@pytest.mark.parametrize(
    ("law", "split"), thinned(3, product(["penalty", "nitsche"], [False, True]))
)
def test_equals_of_two_contacts_in_their_places_change_nothing(law, split):
    """Also where one of them was made after the body was split, and has areas of its own."""
    found = []
    for replaced in (False, True):
        problem, discs = pressed(law)
        press(problem, discs)
        if split:
            problem.split(np.arange(3, 156, 6))
        other = contact.Rigid(problem.particles, contact.disc((0.6, 1.3), 0.3), 0.3, law=law)
        problem.stage(terms=[*discs, other])
        other.move((0.0, -0.03))
        problem.solve(1)
        both = [discs[0], other]
        forces = [one.reaction for one in both]
        assert min(abs(force[1]) for force in forces) > 1.0
        if replaced:
            made = [((1.5, 1.3), discs[0]), ((0.6, 1.3), other)]
            both = []
            for centre, old in made:
                both.append(
                    contact.Rigid(problem.particles, contact.disc(centre, 0.3), 0.3, law=law)
                )
                both[-1].move(old.offset, old.angle)
        problem.stage(terms=both)
        now = [one.reaction for one in both]
        np.testing.assert_allclose(now, forces, rtol=0.0, atol=1e-12 * 30.0)
        problem.solve(2, update=lambda t, both=both: both[1].move((0.01 * t, -0.03 - 0.01 * t)))
        x = scenes.in_order(problem.particles, problem.particles.centroid)
        found.append((x, np.array([problem.reaction(one) for one in both])))
    for one, two in zip(*found, strict=True):
        assert np.abs(one - two).max() < 1e-12 * np.abs(one).max()


@pytest.mark.parametrize("law", [*slow("penalty"), "nitsche"])
def test_equals_of_two_pairs_in_their_places_change_nothing(law):
    """Each has facets of its own of the same bodies."""
    found = []
    for replaced in (False, True):
        problem, _, path = pairs.two(friction=0.3, law=law)
        problem.solver.setTolerances(rtol=1e-13)
        a, b = problem.bodies
        sides = {
            1: lambda x: (x[1] < 1.01) & (x[0] < 0.58),
            2: lambda x: (x[1] < 1.01) & (x[0] > 0.57),
        }
        bottom = mpm.facet_tags(a.mesh, sides)
        top = mpm.facet_tags(b.mesh, {1: mpm.region(y=1.0)})

        def of_sides(a=a, b=b, tags=(bottom, top)):
            return [
                contact.Pair(a, b, 0.3, law=law, passes=1, facets=((tags[0], side), (tags[1], 1)))
                for side in (1, 2)
            ]

        old = of_sides()
        problem.stage(terms=old)
        problem.solve(2, update=lambda t, path=path: path(0.5 * t))
        new = of_sides() if replaced else old
        forces = np.array([one.reaction for one in old])
        assert np.abs(forces[:, 1]).min() > 1.0
        problem.stage(terms=new)
        now = [one.reaction for one in new]
        np.testing.assert_allclose(now, forces, rtol=0.0, atol=1e-12 * 30.0)
        problem.solve(1, update=lambda t, path=path: path(0.5 + 0.1 * t))
        places = [scenes.in_order(body, body.centroid) for body in problem.bodies]
        found.append((np.concatenate(places), np.array([problem.reaction(one) for one in new])))
    for one, two in zip(*found, strict=True):
        assert np.abs(one - two).max() < 1e-12 * np.abs(one).max()


def test_an_obstacle_elsewhere_takes_nothing_over():
    problem, (disc,) = pressed()
    press(problem, [disc])
    assert in_all(disc.touches) > 0
    lower = contact.Rigid(problem.particles, contact.disc((1.52, 1.27), RADIUS), 0.3)
    problem.stage(terms=[lower])
    assert in_all(lower.touches) == 0


def test_what_is_asked_of_an_obstacle_outlives_a_stage():
    problem, (disc,) = pressed()
    press(problem, [disc])
    disc.move((0.0, -0.06))
    problem.stage(terms=[disc])
    problem.solve(1)
    assert np.all(disc.offset == (0.0, -0.06))
    disc.move((0.0, -0.07))
    problem.split(np.array([0]))
    problem.step()
    assert np.all(disc.offset == (0.0, -0.07))


def test_checkpoints_know_contacts_by_name(mpi_tmp_path):
    path = mpi_tmp_path / "names.ckpt"
    problem, discs = pressed(count=2, names=("right", "left"))
    press(problem, discs)
    problem.save(path)
    before = forces(discs)
    again, same = pressed(count=2, names=("right", "left"), order=-1)
    again.restore(path)
    np.testing.assert_allclose(forces(same), before, rtol=0.0, atol=1e-12 * np.abs(before).max())
    assert all(np.array_equal(one.offset, two.offset) for one, two in zip(same, discs, strict=True))
    for wrong, sentence in (
        ({"count": 2, "names": ("right", "middle")}, r"'left', .*here they keep 'middle', "),
        ({"count": 1, "names": ("right",)}, r"keep 'left', .*here they keep 'release', 'right'"),
        ({"count": 2, "names": ("left", "right")}, r"knows the contact 'left' as "),
    ):
        with pytest.raises(mpm.MPMError, match=sentence):
            pressed(**wrong)[0].restore(path)
    problem, discs = pressed(count=2)
    press(problem, discs)
    problem.save(path)
    with pytest.raises(mpm.MPMError, match=r"knows the contact 'contact0' as .* order in which"):
        pressed(count=2, order=-1)[0].restore(path)


def test_a_checkpoint_of_a_stage_with_other_contacts(mpi_tmp_path):
    path = mpi_tmp_path / "stage.ckpt"

    def staged(run):
        problem, (disc,) = pressed()
        if run:
            press(problem, [disc])
        plate = contact.Rigid(problem.particles, contact.plane((1.5, 1.0), (0.0, -1.0)))
        problem.stage(terms=[plate, disc])
        return problem, [disc, plate]

    problem, both = staged(True)
    problem.solve(1)
    press(problem, both)
    problem.save(path)
    again, same = staged(False)
    again.restore(path)
    before = forces(both)
    np.testing.assert_allclose(forces(same), before, rtol=0.0, atol=1e-10)
    for one, two in ((problem, both), (again, same)):
        one.solve(1, update=lambda t, two=two: two[0].move((0.02, -0.04 - 0.01 * t), 0.1))
    np.testing.assert_allclose(forces(same), forces(both), rtol=0.0, atol=1e-9)


class Worn(mpm.Term, Kept):
    """A user's term that counts its steps, also on a background, under the key of its class."""

    key = "worn"

    def __init__(self, particles):
        super().__init__([particles])
        self.steps, self.on_cells = 0, None

    def commit(self):
        self.steps += 1

    def kept(self):
        return [self]

    def numbers(self):
        return {"steps": self.steps}

    def columns(self, body):
        if body is not None:
            return {}
        cells = self.bodies[0].V.mesh.topology.index_map(2).size_local
        return {"steps": Column(np.full((cells, 1), float(self.steps)), "cells")}

    def restore(self, taken):
        self.steps = taken.numbers["steps"]
        self.on_cells = taken.columns[-1]["steps"]


def test_a_users_term_is_known_by_itself_not_by_its_key():
    particles, base = soil()
    old = Worn(particles)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, Hencky(1e3, 0.3), density=1.0, body_force=(0.0, -1.0)),
        bcs=base,
        terms=[old],
    )
    problem.solve(3)
    problem.stage(terms=[old])
    assert old.steps == 3 and np.all(old.on_cells == 3.0)
    new = Worn(particles)
    problem.stage(terms=[new])
    assert new.steps == 0 and np.all(new.on_cells == 0.0) and old.steps == 3
    problem.stage(terms=[])
    with pytest.raises(mpm.MPMError, match=r"'worn' cannot be the key"):
        problem.stage(terms=[Worn(particles), Worn(particles)])
    # (what was refused has left nothing behind)
    problem.stage(terms=[old])
    assert old.steps == 3
    problem.solve(1)
    assert old.steps == 4
