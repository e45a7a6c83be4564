# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A thick tube that is widened until its wall is thinner than a cell: patches against unknowns.

Inner radius 1, outer radius 2, von Mises without hardening, no axial strain. Once all of the wall
flows, the pressure inside is ``2 / sqrt(3) yield_stress ln(b / a)`` with the present radii a and b.
"""

from __future__ import annotations

import argparse
from collections import defaultdict

from mpi4py import MPI

import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

QUADRILATERAL = mesh.CellType.quadrilateral
#: Cell, domains through the wall, offset of the grid in cells, F-bar, degree.
CASES = [
    (0.5, 4, 0.0, "patch", 1),
    (0.5, 4, 0.3, "patch", 1),
    (0.25, 8, 0.0, "patch", 1),
    (0.25, 8, 0.3, "patch", 1),
    (0.25, 8, 0.3, "none", 2),
    (0.25, 8, 0.3, "domain", 2),
]


def tube(h, layers, offset, f_bar, degree, poisson=0.49, young=100.0):
    """Return a problem of a tube one background cell high, and its number of patches."""
    grid = mesh.create_rectangle(
        MPI.COMM_WORLD,
        [(offset * h, 0.0), (5.0 + offset * h, h)],
        [round(5.0 / h), 1],
        QUADRILATERAL,
    )
    body = mesh.create_rectangle(MPI.COMM_WORLD, [(1.0, 0.0), (2.0, h)], [layers, 2], QUADRILATERAL)
    V = fem.functionspace(grid, ("Lagrange", degree, (2,)))
    axial, _ = V.sub(1).collapse()
    everywhere = fem.locate_dofs_geometrical((V.sub(1), axial), lambda x: x[0] > -1.0)
    facets = mesh.locate_entities_boundary(body, 1, lambda x: np.isclose(x[0], 1.0))
    tags = mesh.meshtags(body, 1, np.sort(facets), np.ones(len(facets), dtype=np.int32))
    particles = mpm.Particles(body, V, degree=degree, quadrature_degree=2 if degree == 1 else None)
    return mpm.QuasiStaticProblem(
        mpm.Body(
            particles,
            mpm.materials.VonMises(young, poisson, yield_stress=1.0),
            pressures=[(1.0, 1)],
            facet_tags=tags,
            f_bar=f_bar,
        ),
        bcs=[fem.dirichletbc(fem.Function(axial), everywhere, V.sub(1))],
        axisymmetric=True,
    )


def errors(problem, steps=60, widest=4.0):
    """Yield inner radius, radial unknowns in a row and error of the pressure, step by step."""
    particles = problem.particles
    control = mpm.DisplacementControl(
        particles, widest - 1.0, point=(1.0, 0.0), direction=(1.0, 0.0)
    )
    rows = particles.V.ufl_element().degree + 1
    for _ in problem.steps(steps, control=control):
        r = particles.W.tabulate_dof_coordinates()[:, 0] + particles.displacement.x.array[::2]
        exact = 2.0 / np.sqrt(3.0) * np.log(r.max() / r.min())
        unknowns = problem.history.statistics["free_dofs"] // rows
        yield r.min(), unknowns, float(particles.load.value) / exact - 1.0


def main():
    """Print the errors beyond a radius of 1.4, by unknowns in a row less patches in a row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poisson", type=float, default=0.49)
    poisson = parser.parse_args().poisson
    for h, layers, offset, f_bar, degree in CASES:
        start = 1.0 / h
        patches = int(np.ceil(start - 1e-9)) + (0.0 < offset < 1.0) if f_bar == "patch" else 0
        found = defaultdict(list)
        problem = tube(h, layers, offset, f_bar, degree, poisson)
        for radius, unknowns, error in errors(problem):
            if radius > 1.4:
                found[unknowns - patches].append(abs(error))
        print(f"cells of {h}, offset {offset}, {f_bar}, degree {degree}: patches {patches}")
        for spare, values in sorted(found.items()):
            print(
                f"  {spare:3d} unknowns to spare, {len(values):3d} steps: median "
                f"{np.median(values):.2%}, largest {max(values):.2%}"
            )


if __name__ == "__main__":
    main()
