# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Groups of domains: patches."""

import numpy as np
import pytest
import scenes
from constitutive.blocks import CASES, ELASTIC, PLASTIC, block, label
from scenes import QUADRILATERAL, box, vectors

import mpm_dolfinx as mpm


def members(problem):
    """Return the group of each particle by its smallest member, in the order of the input."""
    particles = problem.particles
    averaging = problem.points[0].averaging
    number = scenes.in_order(particles, averaging.groups.number)
    first = np.full(number.max() + 1, len(number))
    np.minimum.at(first, number, np.arange(len(number)))
    return first[number]


@pytest.mark.parametrize(("cell", "f_bar", "rule", "axisymmetric"), CASES[2:], ids=label)
def test_groups_do_not_depend_on_the_ranks(cell, f_bar, rule, axisymmetric):
    problem = block(cell, f_bar, rule, axisymmetric)
    alone = block(cell, f_bar, rule, axisymmetric, comm=scenes.MPI.COMM_SELF)
    number = alone.points[0].averaging.groups.number
    order = np.argsort(alone.particles.global_index)
    first = np.full(number.max() + 1, len(number))
    np.minimum.at(first, number[order], np.arange(len(number)))
    np.testing.assert_array_equal(members(problem), first[number[order]])


@pytest.mark.parametrize("cell", scenes.PLANE, ids=label)
@pytest.mark.parametrize("offset", [0.0, 0.1])
def test_patches_fill_about_a_background_cell(cell, offset):
    V = vectors(box([0.0, 0.0], [2.0, 2.0], [8, 8], QUADRILATERAL))
    body = box([offset, offset], [1.0 + offset, 1.0 + offset], [8, 8], cell)
    problem = mpm.QuasiStaticProblem(mpm.Body(mpm.Particles(body, V), ELASTIC, f_bar="patch"))
    group = members(problem)
    volume = scenes.in_order(problem.particles, problem.particles.initial_volume)
    size = np.bincount(group, volume)[np.unique(group)] * 16.0
    if offset == 0.0:
        np.testing.assert_allclose(size, 1.0)
    assert size.min() >= 0.4 and size.max() <= 2.0
    assert len(size) <= 25


@pytest.mark.parametrize("cell", scenes.PLANE, ids=label)
def test_patches_do_not_depend_on_round_off(cell):
    # Of nine domains across four and a half cells, many patches are equally full.
    found = []
    for size, origin in ((1.0, 0.0), (1e3, 0.0), (1.0, [1.1e4, -2.3e4, 0.0])):
        V = vectors(box([0.0, 0.0], [2.0, 2.0], [8, 8], QUADRILATERAL))
        body = box([0.1, 0.13], [1.1, 1.13], [9, 9], cell)
        for domain in (V.mesh, body):
            domain.geometry.x[:] = size * domain.geometry.x + origin
        problem = mpm.QuasiStaticProblem(mpm.Body(mpm.Particles(body, V), ELASTIC, f_bar="patch"))
        found.append(members(problem))
    np.testing.assert_array_equal(found[1], found[0])
    np.testing.assert_array_equal(found[2], found[0])


def test_patches_keep_materials_apart():
    V = vectors(box([0.0, 0.0], [1.0, 1.0], [2, 2], QUADRILATERAL))
    body = box([0.0, 0.0], [1.0, 1.0], [4, 4], QUADRILATERAL)
    tags = scenes.cell_tags(body, lambda x: 1 + (x[:, 0] > 0.25))
    laws = {1: ELASTIC, 2: PLASTIC}
    problem = mpm.QuasiStaticProblem(
        mpm.Body(mpm.Particles(body, V), laws, cell_tags=tags, f_bar="patch")
    )
    centre = scenes.in_order(problem.particles, problem.particles.initial_centroid)
    left = centre[:, 0] < 0.25
    assert (left == left[members(problem)]).all()
