# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Options of a body that are refused, and why."""

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from bad_input import background, body
from compare import raises
from scenes import TRIANGLE, WORLD

import basix.ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm


def on(space, what=body, **options):
    """Return a function that makes particles of a body on a space."""
    return lambda: mpm.Particles(what(), space(), **options)


def vectors(**options):
    """Return a function that makes particles with other options."""
    return on(lambda: scenes.vectors(background()), **options)


def tagged(wanted):
    """Return a function that makes particles with nodes free by tags of cells that are all 1."""

    def build():
        domain = body()
        tags = scenes.cell_tags(domain, lambda x: np.ones(len(x)))
        return mpm.Particles(domain, scenes.vectors(background()), free=(tags, wanted))

    return build


def same_mesh():
    domain = body()
    return mpm.Particles(domain, scenes.vectors(domain))


def surface():
    """A flat mesh of triangles in space."""
    cells = np.array([[0, 1, 2], [1, 2, 3]]) if WORLD.rank == 0 else np.zeros((0, 3), int)
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1]])
    x = x if WORLD.rank == 0 else np.zeros((0, 3))
    element = basix.ufl.element("Lagrange", "triangle", 1, shape=(3,))
    return mesh.create_mesh(WORLD, cells=cells, e=element, x=x)


def prisms():
    return mesh.create_unit_cube(WORLD, 1, 1, 1, mesh.CellType.prism)


def taylor_hood():
    cell = "quadrilateral"
    pair = [basix.ufl.element("P", cell, 1, shape=(2,)), basix.ufl.element("P", cell, 1)]
    return fem.functionspace(background(), basix.ufl.mixed_element(pair))


def far_away():
    domain = body()
    domain.geometry.x[:] += [5.0, 0.0, 0.0]
    return domain


def space(*element):
    return lambda: fem.functionspace(background(), element)


PARTICLES = {
    "outside": (
        on(lambda: scenes.vectors(background()), far_away),
        mpm.ParticleOutsideError,
        r"particles 0, 1.*outside the background mesh.*\(5\.0, 0\.0\)|outside the background",
    ),
    "no mesh": (on(lambda: scenes.vectors(background()), lambda: 3), r"Mesh, not int"),
    "no space": (on(background), r"FunctionSpace.*not Mesh"),
    "scalar V": (on(space("Lagrange", 1)), r"continuous Lagrange space of vectors"),
    "DG V": (on(space("DG", 1, (2,))), r"continuous Lagrange space of vectors"),
    "N1curl V": (on(space("RTCE", 1)), r"continuous Lagrange space of vectors"),
    "mixed V": (on(taylor_hood), r"continuous Lagrange space of vectors"),
    "three components": (on(space("Lagrange", 1, (3,))), r"vectors with 2 components"),
    "subspace": (on(lambda: scenes.vectors(background()).sub(0)), r"vectors|subspace"),
    "V on the body": (same_mesh, r"V lives on the body mesh"),
    "V in space": (
        on(lambda: scenes.vectors(scenes.unit(1, scenes.HEXAHEDRON))),
        r"body is 2-dimensional, the background 3-dimensional",
    ),
    "line": (
        on(
            lambda: scenes.vectors(mesh.create_unit_interval(WORLD, 4)),
            lambda: mesh.create_unit_interval(WORLD, 4),
        ),
        r"must fill its space in 2-D or 3-D",
    ),
    "surface": (
        on(lambda: scenes.vectors(scenes.unit(2, scenes.HEXAHEDRON)), surface),
        r"topological dimension 2 in 3",
    ),
    "prisms as body": (
        on(lambda: scenes.vectors(scenes.unit(1, scenes.HEXAHEDRON)), prisms),
        r"body has prism cells",
    ),
    "prisms as background": (
        on(
            lambda: fem.functionspace(prisms(), ("Lagrange", 1, (3,))),
            lambda: scenes.unit(1, scenes.HEXAHEDRON),
        ),
        r"background has prism cells",
    ),
    "degree of V": (on(space("Lagrange", 2, (2,))), r"degree 1 .* degree 2 .*; use degree=2, or"),
    "high degree of V": (on(space("Lagrange", 4, (2,))), r"background has degree 4; use 3"),
    "degree of W": (vectors(degree=4), r"degree must be 1, 2 or 3, not 4"),
    "degree of no number": (vectors(degree="one"), r"1, 2 or 3, not 'one'"),
    "few points": (vectors(degree=2, quadrature_degree=1), r"degree 2; use quadrature_degree=2"),
    "method": (vectors(method="fdm"), r"Unknown method 'fdm'; choose one of 'cpdi2'"),
    "method of no name": (vectors(method=3), r"Unknown method 3"),
    "negative rule": (vectors(quadrature_degree=-1), r"quadrature_degree.*not -1"),
    "broken rule": (vectors(quadrature_degree=1.5), r"quadrature_degree.*not 1\.5"),
    "policy": (vectors(outside="ignore"), r"outside='ignore'"),
    "free, of points": (
        vectors(method="mpm", free=[]),
        r"shared by neighbours; use method='cpdi2'",
    ),
    "free, one point": (
        on(
            lambda: scenes.vectors(background()),
            lambda: scenes.unit(2, scenes.QUADRILATERAL),
            free=[],
            quadrature_degree=1,
        ),
        r"use quadrature_degree=2 or more, as nodes with unknowns of their own need",
    ),
    "points without a background": (
        lambda: mpm.Particles.from_points(np.full((1, 2), 0.5), 0.1, None),
        r"V must be a dolfinx FunctionSpace on the background, not NoneType",
    ),
    "free nowhere": (vectors(free=mpm.region(x=99.0)), r"No node of the body is where free="),
    "free, no place": (
        vectors(free="wall"),
        r"free= is 'auto', a function of coordinates.*not 'wall'",
    ),
    "free, broken": (vectors(free=lambda x: x[5]), r"The function free= failed with IndexError"),
    "free, one for all": (vectors(free=lambda x: True), r"free= must return one bool for each"),
    "free, foreign tags": (
        vectors(free=(scenes.cell_tags(scenes.unit(1, TRIANGLE), lambda x: x[:, 0]), 1)),
        r"tags of free= must be those of cells of the present body mesh",
    ),
    "free, no such tag": (
        tagged((1, 7)),
        r"No cell has the tag 7 of free=; there are \[1\]",
    ),
    "free, a tag that is true": (tagged(True), r"A tag of free= is a whole number, not True"),
    "free, no such node": (vectors(free=[10**6]), r"none of the \d+ local ones"),
    "free, no background": (
        lambda: mpm.Particles(scenes.unit(2, TRIANGLE), free=[]),
        r"Without V all nodes are free; omit free=",
    ),
    "another communicator": (
        lambda: mpm.Particles(
            scenes.unit(2, TRIANGLE, MPI.COMM_SELF), scenes.vectors(background())
        ),
        r"different numbers of ranks",
    ),
}


@pytest.mark.parametrize("case", PARTICLES)
def test_particles(case):
    if case == "another communicator" and WORLD.size == 1:
        PARTICLES[case][0]()  # there is no difference
        return
    build, *expected = PARTICLES[case]
    error, sentence = expected if len(expected) == 2 else (mpm.MPMError, expected[0])
    raises(build, error, sentence)
