# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Blocks of each kind of domain, and their materials."""

import scenes
from scenes import HEXAHEDRON, QUADRILATERAL, TETRAHEDRON, TRIANGLE, WORLD, box, vectors

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, VonMises

YOUNG, POISSON = 1e3, 0.3


ELASTIC = Hencky(YOUNG, POISSON)


PLASTIC = VonMises(YOUNG, POISSON, rho_y=40.0, hardening=100.0)


CASES = [
    (QUADRILATERAL, "domain", 2, False),
    (QUADRILATERAL, "domain", 2, True),
    (QUADRILATERAL, "patch", 2, False),
    (QUADRILATERAL, "patch", 1, False),
    (TRIANGLE, "patch", 1, False),
    (TRIANGLE, "patch", 1, True),
    (HEXAHEDRON, "domain", 2, False),
    (HEXAHEDRON, "patch", 2, False),
    (TETRAHEDRON, "patch", 1, False),
]


def label(value):
    return scenes.name(value) or str(value)


def block(
    cell, f_bar, rule, axisymmetric=False, material=ELASTIC, comm=WORLD, bent=False, **options
):
    """Return a block that cuts the cells of its background, with domains half as long."""
    dim = 3 if cell in (TETRAHEDRON, HEXAHEDRON) else 2
    n = 6 if dim == 2 else 4
    grid = QUADRILATERAL if dim == 2 else HEXAHEDRON
    V = vectors(box([-1.0] * dim, [2.0] * dim, [n] * dim, grid, comm))
    body = box([0.1] * dim, [1.1] * dim, [n - 2] * dim, cell, comm)
    if bent:
        x = body.geometry.x[:, :dim]
        x[:] = scenes.bend(scenes.unit(n - 2, cell, comm), 0.04).geometry.x[:, :dim] + 0.1
    return mpm.QuasiStaticProblem(
        mpm.Body(mpm.Particles(body, V, quadrature_degree=rule, **options), material, f_bar=f_bar),
        axisymmetric=axisymmetric,
    )
