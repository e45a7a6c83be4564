# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Meshes whose cells are folded or lie on each other, or have their vertices in Gmsh's order."""

import numpy as np
import pytest
import scenes
from scenes import HEXAHEDRON, QUADRILATERAL, TETRAHEDRON, TRIANGLE, WORLD

import basix.ufl
from dolfinx import mesh

import mpm_dolfinx as mpm


def made(cell, cells, points, degree=1):
    """Return a mesh of cells given by their nodes."""
    x = np.asarray(points, dtype=np.float64)
    element = basix.ufl.element("Lagrange", cell, degree, shape=(x.shape[1],))
    cells = np.asarray(cells, dtype=np.int64)
    if WORLD.rank > 0:
        cells, x = cells[:0], x[:0]
    return mesh.create_mesh(WORLD, cells=cells, e=element, x=x)


def ground(dim=2, cell=QUADRILATERAL):
    return scenes.box([-1.0] * dim, [2.0] * dim, [3] * dim, cell)


def refused(body, sentence, background=None):
    """Return the particles that an error names."""
    with pytest.raises(mpm.DomainDistortionError, match=sentence) as caught:
        mpm.Particles(body, scenes.vectors(ground() if background is None else background))
    told = WORLD.allgather(str(caught.value))
    assert len(set(told)) == 1, told
    return caught.value.particles


def moved(domain, where, to):
    """Move the vertex at a point to another one."""
    x = domain.geometry.x[:, : domain.geometry.dim]
    x[np.all(np.isclose(x, where), axis=1)] = to
    return domain


@pytest.mark.parametrize("cell", [TRIANGLE, QUADRILATERAL])
def test_vertex_beyond_the_opposite_edge(cell):
    body = moved(scenes.unit(4, cell), [0.5, 0.5], [0.9, 0.5])
    how = "lie on a neighbour" if cell == TRIANGLE else "are folded or concave"
    particles = refused(body, rf"The domains of particles? .* {how}.*; mend the body mesh")
    assert 1 <= len(particles) <= 4


def test_tetrahedra_of_both_orientations():
    # DOLFINx leaves simplices as they are given, so that a negative Jacobian is no fault.
    body = scenes.unit(2, TETRAHEDRON)
    mpm.Particles(body, scenes.vectors(ground(3, HEXAHEDRON)))
    body = moved(scenes.unit(2, TETRAHEDRON), [0.5, 0.5, 0.5], [1.2, 0.5, 0.5])
    assert refused(body, "lie on a neighbour", ground(3, HEXAHEDRON))


def test_one_triangle_of_two_turned():
    points = [[0, 0], [1, 0], [0, 1], [0.2, 0.2]]
    assert refused(made("triangle", [[0, 1, 2], [1, 2, 3]], points), "lie on a neighbour") == [0, 1]
    points[3] = [1, 1]
    for turned in ([1, 2, 3], [2, 1, 3]):
        mpm.Particles(made("triangle", [[0, 1, 2], turned], points), scenes.vectors(ground()))


def test_bow_tie_and_order_of_gmsh():
    square = [[0, 0], [1, 0], [1, 1], [0, 1]]
    gmsh = r"Gmsh's order .*\[0, 1, 3, 2\]\] to create_mesh"
    assert refused(made("quadrilateral", [[0, 1, 2, 3]], square), gmsh) == []
    mpm.Particles(made("quadrilateral", [[0, 1, 3, 2]], square), scenes.vectors(ground()))
    two = [*square, [2, 0], [2, 1]]
    tie = made("quadrilateral", [[0, 1, 3, 2], [1, 5, 2, 4]], two)
    assert refused(tie, "are folded or concave") == [1]
    cube = [[*p, z] for z in (0, 1) for p in square]
    body = made("hexahedron", [range(8)], cube)
    refused(body, r"Gmsh's order .*\[0, 1, 3, 2, 4, 5, 7, 6\]", ground(3, HEXAHEDRON))


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_curved_cells(cell):
    element = basix.ufl.element("Lagrange", cell, 2).basix_element
    right = np.asarray(element.points)
    number = len(right)
    gmsh = {"triangle": [0, 1, 2, 5, 3, 4], "quadrilateral": [0, 1, 3, 2, 4, 6, 7, 5, 8]}[cell]
    mpm.Particles(made(cell, [range(number)], right, 2), scenes.vectors(ground()))
    refused(made(cell, [gmsh], right, 2), "Gmsh's order")
    bulged = right.copy()
    edge = number - (1 if cell == "triangle" else 2)
    for amount, folded in ((0.1, False), (0.9, True)):
        bulged[edge] = right[edge] + [0.0, -amount if right[edge][1] > 0.5 else amount]
        body = made(cell, [range(number)], bulged, 2)
        if folded:
            assert refused(body, "are folded or concave") == [0]
        else:
            mpm.Particles(body, scenes.vectors(ground()))


@pytest.mark.parametrize("to", [[0.9, 0.9], [1.9, 1.9]])
def test_background(to):
    body = scenes.box([-0.9, -0.9], [-0.6, -0.6], [2, 2], QUADRILATERAL)
    background = moved(ground(), [0.0, 0.0], to)
    refused(
        body,
        r"The background mesh has cells that are folded or concave \(cells? \d.*mend it",
        background,
    )
    flat = ground()
    x = flat.geometry.x
    x[np.isclose(x[:, 0], 2.0), 0] = 1.0
    refused(body, "The background mesh has cells that have no volume", flat)


def test_warped_hexahedra_and_split_quadrilaterals_are_fine():
    body = scenes.bend(scenes.unit(3, HEXAHEDRON), 0.05)
    mpm.Particles(body, scenes.vectors(ground(3, HEXAHEDRON)))
    body = scenes.box([0.2] * 3, [0.8] * 3, [2] * 3, TETRAHEDRON)
    mpm.Particles(body, scenes.vectors(scenes.bend(scenes.unit(3, HEXAHEDRON), 0.05)))
    points = [[0, 0], [1, 0], [1, 1], [1, 1]]  # two corners in one place
    mpm.Particles(made("quadrilateral", [[0, 1, 2, 3]], points), scenes.vectors(ground()))
