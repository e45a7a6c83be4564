# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Physics of one's own on facets, with a history on a submesh of them: friction in UFL."""

import numpy as np
import pytest
import scenes
from marks import thinned
from scenes import QUADRILATERAL, TRIANGLE, WORLD, at, box

import basix.ufl
import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm

E, NU, MU = 1e3, 0.3, 0.3
DEGREE = 3


def rubbing(cell, on_facets=True):
    """Return a block on a rough plane, whose friction remembers where each point sticks."""
    V = scenes.vectors(box([-1.0, -1.0], [4.0, 4.0], [10, 10], QUADRILATERAL))
    block = box([1.03, 1.07], [2.03, 1.57], [4, 2], cell)
    body = mpm.Particles(block, V, quadrature_degree=2)
    tags = scenes.facet_tags(block, at(1, 1.07), at(1, 1.57))
    found = mesh.create_submesh(block, 1, tags.find(1))
    element = basix.ufl.quadrature_element("interval", degree=DEGREE)
    anchor = fem.Function(fem.functionspace(found[0], element))
    load = fem.Constant(block, (0.0, 0.0))
    d, v = body.displacement, ufl.TestFunction(body.W)
    ds = ufl.Measure(
        "ds", domain=block, subdomain_data=tags, metadata={"quadrature_degree": DEGREE}
    )
    lame, G = E * NU / (1 + NU) / (1 - 2 * NU), E / (2 * (1 + NU))
    k = (lame + 2 * G) / 0.25
    gap = (ufl.SpatialCoordinate(block) + d)[1] - 1.07
    pressure = ufl.conditional(ufl.le(gap, 1e-12), -k * gap, 0.0)
    trial = -k * (d[0] - anchor)
    most = MU * ufl.max_value(pressure, 0.0)
    shear = ufl.conditional(ufl.gt(abs(trial), most + 1e-12 * k), most * ufl.sign(trial), trial)
    strain = ufl.sym(ufl.grad(d))
    stress = lame * ufl.tr(strain) * ufl.Identity(2) + 2 * G * strain
    R = ufl.inner(stress, ufl.grad(v)) * body.dx - ufl.inner(load, v) * ds(2)
    R -= (pressure * v[1] + shear * v[0]) * ds(1)
    maps = [found[1]]

    class Rubbing(mpm.ParticleProblem):
        """It moves the anchors of points that have slipped."""

        def commit(self):
            points = basix.make_quadrature(basix.CellType.interval, DEGREE)[0]
            new = fem.Expression(d[0] + shear / k, points, entity_maps=maps)
            anchor.x.array[:] = new.eval(block, self.facets()).ravel()

        def facets(self):
            """Return cell and local facet of each cell of the submesh."""
            block.topology.create_connectivity(1, 2)
            block.topology.create_connectivity(2, 1)
            of_cell, of_facet = (block.topology.connectivity(*pair) for pair in ((2, 1), (1, 2)))
            there = found[0].topology.index_map(1)
            count = there.size_local + there.num_ghosts
            every = maps[0].sub_topology_to_topology(np.arange(count, dtype=np.int32), False)
            cells = [of_facet.links(facet)[0] for facet in every]
            local = [
                int(np.flatnonzero(of_cell.links(c) == f)[0])
                for c, f in zip(cells, every, strict=True)
            ]
            return np.array([cells, local], dtype=np.int32).T.copy()

    kind = Rubbing if on_facets else mpm.ParticleProblem
    # (a term says that the body may be let go, so that smaller steps are tried where it is)
    options = {"entity_maps": maps, "terms": [mpm.Term([body])]} if on_facets else {}
    problem = kind(R, body, **options)
    sums = [fem.form(part * ds(1), entity_maps=maps) for part in (pressure, shear)]

    def path(t):
        load.value[:] = 20.0 * 0.32 * max(0.0, 2 * t - 1), -20.0 * min(1.0, 2 * t)

    return problem, path, lambda: [WORLD.allreduce(fem.assemble_scalar(f)) for f in sums]


@pytest.mark.parametrize(
    ("cell", "route"),
    thinned(3, [(QUADRILATERAL, "loops"), (TRIANGLE, "loops"), (QUADRILATERAL, "reference")]),
    indirect=["route"],
)
@pytest.mark.usefixtures("route")
def test_friction_with_a_history_on_facets_slides_at_its_coefficient(cell):
    problem, path, forces = rubbing(cell)
    reached = []
    with pytest.raises(mpm.ConvergenceError):
        for step in problem.steps(8, update=path):
            reached.append((step.load, *forces()))
    for load, normal, tangential in reached:
        assert normal == pytest.approx(20.0 * min(1.0, 2 * load), rel=1e-7)
        assert tangential == pytest.approx(-20.0 * 0.32 * max(0.0, 2 * load - 1), abs=1e-6)
    # it slides where the push is the coefficient times the weight
    limit = 0.5 + 0.5 * MU / 0.32
    assert limit - 1e-3 < reached[-1][0] <= limit * (1 + 1e-9)
    assert -reached[-1][2] / reached[-1][1] == pytest.approx(MU, rel=3e-3)


def test_what_cannot_be_is_said():
    with pytest.raises(mpm.MPMError, match="of another mesh, but must be written on"):
        rubbing(QUADRILATERAL, on_facets=False)
    problem, _, _ = rubbing(QUADRILATERAL)
    with pytest.raises(mpm.MPMError, match="data on another mesh than the body's"):
        problem.save("never.ckpt")
    body = problem.particles
    R = ufl.inner(body.displacement, ufl.TestFunction(body.W)) * body.dx
    for wrong in (5, ["facets"], "facets"):
        with pytest.raises(mpm.MPMError, match="must be a list of dolfinx"):
            mpm.ParticleProblem(R, body, entity_maps=wrong)
