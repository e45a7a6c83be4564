# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Inputs of a user on the body mesh that are refused."""

import numpy as np
import pytest
import scenes
from bad_input import held, particles, problem, tags_of_facets, with_one_value
from compare import raises
from posed import posed
from scenes import QUADRILATERAL, TRIANGLE

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky


def test_a_facet_that_is_tagged_twice():
    V = scenes.vectors(scenes.unit(4, QUADRILATERAL))
    p = mpm.Particles(scenes.box([0.0, 0.0], [0.5, 0.5], [4, 4], QUADRILATERAL), V)
    once = scenes.facet_tags(p.mesh, scenes.at(1, 0.5))
    twice = scenes.mesh.meshtags(
        p.mesh, 1, np.repeat(once.indices, 2), np.repeat(once.values, 2).astype(np.int32)
    )
    told = r"name a facet twice with the tag 1, and tractions on it would count twice"
    raises(
        lambda: mpm.QuasiStaticProblem(
            mpm.Body(p, Hencky(1e3, 0.3), tractions=[((0.0, -1.0), 1)], facet_tags=twice)
        ),
        mpm.MPMError,
        told,
    )
    raises(lambda: mpm.boundary.fixed(p, twice, 1), mpm.MPMError, r"supports on it would count")


def test_tags_of_another_mesh_or_of_no_boundary():
    p, other = particles(), scenes.unit(3, TRIANGLE)
    tags = scenes.facet_tags(other, scenes.at(0, 1.0))
    loads = [((1.0, 0.0), 1)]

    def made(facets):
        return lambda: mpm.QuasiStaticProblem(
            mpm.Body(p, Hencky(1e3, 0.3), tractions=loads, facet_tags=facets)
        )

    raises(
        made(tags),
        mpm.MPMError,
        r"tags of tractions must be those of facets of the present body mesh",
    )
    inner = scenes.mesh.locate_entities(p.mesh, 1, scenes.at(0, 0.5)).astype(np.int32)
    inside = scenes.mesh.meshtags(p.mesh, 1, np.sort(inner), np.full(len(inner), 1, np.int32))
    raises(
        made(inside),
        mpm.MPMError,
        r"No facet of the boundary has the tag 1 .* there are \[\]",
    )


def test_one_negative_density():
    p = particles()
    density = with_one_value(p, 1.0, -3.0)
    raises(
        lambda: mpm.QuasiStaticProblem(mpm.Body(p, Hencky(1e3, 0.3), density=density)),
        mpm.MPMError,
        "density must not be negative, not -3",
    )


@pytest.mark.parametrize("tag", [1.0, [1], True, "1"])
@pytest.mark.parametrize("what", ["tractions", "pressures", "support"])
def test_tag_that_is_no_whole_number(tag, what):
    value = 1.0 if what == "pressures" else (1.0, 0.0)
    build = problem(facet_tags=tags_of_facets, **{what: [(value, tag)]})
    if what == "support":
        build = held("fixed", tag=tag)
    raises(build, mpm.MPMError, rf"A tag of {what}s? is a whole number, not .*\.$")


@pytest.mark.parametrize("what", ["tractions", "pressures", "support"])
def test_tag_that_is_on_facets_inside_too(what):
    def tags(p):
        found = scenes.mesh.locate_entities(p.mesh, 1, scenes.at(0, 0.0, 0.5)).astype(np.int32)
        return scenes.mesh.meshtags(p.mesh, 1, np.sort(found), np.full(len(found), 1, np.int32))

    sentence = r"tag 1 of \w+ is on facets inside the body too"
    if what == "support":
        raises(held("fixed", facet_tags=tags), mpm.MPMError, sentence)
        return
    value = 1.0 if what == "pressures" else (1.0, 0.0)
    raises(problem(facet_tags=tags, **{what: [(value, 1)]}), mpm.MPMError, sentence)


def test_a_constant_among_numbers_is_followed():
    p, other = (particles() for _ in range(2))
    gravity = fem.Constant(p.mesh, -1.0)
    options = {"density": 2.0, "stabilisation": None}
    bcs = [[scenes.fix(q.V, scenes.at(1, -1.0))] for q in (p, other)]
    tags = tags_of_facets(p)
    held = [mpm.boundary.fixed(q, tags_of_facets(q), 1) for q in (p, other)]
    problem = posed(
        mpm.QuasiStaticProblem,
        p,
        Hencky(1e3, 0.3),
        body_force=(0.0, gravity),
        tractions=[((gravity, 0.0), 1)],
        facet_tags=tags,
        bcs=bcs[0],
        supports=held[:1],
        **options,
    )
    problem.solve(2, update=lambda t: np.copyto(gravity.value, -5.0 * t))
    expected = posed(
        mpm.QuasiStaticProblem,
        other,
        Hencky(1e3, 0.3),
        body_force=(0.0, -5.0),
        tractions=[((-5.0, 0.0), 1)],
        facet_tags=tags_of_facets(other),
        bcs=bcs[1],
        supports=held[1:],
        **options,
    )
    expected.solve(2)
    gap = scenes.in_order(p, p.centroid) - scenes.in_order(other, other.centroid)
    assert np.abs(scenes.own(other.displacement)).max(initial=0.0) < 1.0
    assert np.abs(gap).max() < 1e-9
    assert scenes.largest(other.displacement.x.array) > 1e-4
