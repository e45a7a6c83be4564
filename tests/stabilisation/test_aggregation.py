# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Aggregation continues polynomials."""

import numpy as np
import pytest
import scenes
from posed import posed
from scenes import HEXAHEDRON, PLANE
from stabilisation.slivers import look, polynomial, sliver, vector

import ufl

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky
from mpm_dolfinx.stabilisation.aggregation import Aggregation


@pytest.mark.parametrize("degree", [2, 3])
@pytest.mark.parametrize("cell", [*PLANE, HEXAHEDRON], ids=scenes.name)
def test_aggregation_continues_polynomials(cell, degree):
    n = 4 if cell in PLANE else 2
    particles = sliver(cell, degree, 1e-9, n=n)
    aggregation = Aggregation([particles])
    look(aggregation, particles)
    assert aggregation.counts["aggregated_dofs"] > 0
    V = particles.V
    fixed = np.zeros(V.dofmap.index_map.size_local * V.dofmap.index_map_bs, dtype=bool)
    E = aggregation.extension(fixed)
    x = vector(E, polynomial(V, degree))
    y = E.createVecLeft()
    E.mult(x, y)
    y.axpy(-1.0, x)
    assert y.norm() < 1e-10 * x.norm()
    E = aggregation.extension(~fixed)
    E.mult(x, y)
    y.axpy(-1.0, x)
    assert y.norm() == 0.0


@pytest.mark.parametrize("stiffness", [1e-8, 10.0])
def test_dofs_that_follow_others_are_no_unknowns_beside_a_background_form(stiffness):
    # A form that is next to nothing changes nothing; one that resists makes it smaller.
    ends = []
    for background in (False, True):
        V = scenes.vectors(scenes.box([0.0, -0.5], [1.5, 1.5], [6, 8], scenes.QUADRILATERAL))
        body = scenes.box([0.0, 0.0], [1.01, 1.01], [8, 8], scenes.QUADRILATERAL)
        particles = mpm.Particles(body, V)
        u, v = particles.increment, ufl.TestFunction(V)
        form = stiffness * ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx
        problem = mpm.QuasiStaticProblem(
            mpm.Body(particles, Hencky(1e3, 0.3), body_force=(0.0, -10.0)),
            bcs=[scenes.fix(V, scenes.at(0, 0.0))],
            background=form if background else None,
            solver=mpm.Solver(petsc_options={"snes_rtol": 1e-12}, stabilisation="aggregate"),
        )
        problem.solve()
        assert problem.history.statistics["aggregated_dofs"] > 0
        reaction = problem.reaction(problem.bcs[0])
        assert np.allclose(reaction, [0.0, 10.0 * 1.01**2], rtol=0.0, atol=1e-7)
        ends.append(-scenes.gather(particles.centroid - particles.initial_centroid)[:, 1].min())
    if stiffness < 1.0:
        assert abs(ends[1] / ends[0] - 1.0) < 1e-9
    else:
        assert 0.5 < ends[1] / ends[0] < 0.99


@pytest.mark.parametrize("motion", [False, True])
def test_a_filled_cell_beyond_the_reach_of_all_nodes_is_no_unknown(motion):
    """Domains wider than cells fill cells with nodes that have no weight."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 2.0], [8, 8], scenes.QUADRILATERAL))
    body = scenes.box([0.0, 0.0], [1.41, 1.41], [2, 2], scenes.QUADRILATERAL)
    given = {
        "density": 2.0,
        "body_force": (0.0, -10.0),
        "bcs": [scenes.fix(V, scenes.at(i, 0.0), component=i) for i in (0, 1)],
        "stabilisation": "aggregate",
    }
    kind = mpm.DynamicProblem if motion else mpm.QuasiStaticProblem
    problem = posed(kind, mpm.Particles(body, V), Hencky(1e3, 0.3), **given)
    problem.solve(*((0.02, 0.01) if motion else (2,)))
    assert problem.history.cutbacks == 0
