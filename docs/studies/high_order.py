# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Print the tables of docs/high-order.md.

python docs/studies/high_order.py [pairs|fronts|beam|flow]
"""

from __future__ import annotations

import sys
from typing import Any

from mpi4py import MPI

import numpy as np
from case_runs import run, table

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.particles import options as validation

CELLS = {"quadrilaterals": mesh.CellType.quadrilateral, "triangles": mesh.CellType.triangle}
PAIRS = [(k, m) for k in (1, 2, 3) for m in (1, 2, 3)]
LENGTH, YOUNG, WEIGHT = 50.0, 1e4, 800.0  # the column of benchmarks/cases/compaction.py


def rectangle(upper: list[float], cells: list[int], kind: mesh.CellType) -> mesh.Mesh:
    diagonal = mesh.DiagonalType.left_right
    return mesh.create_rectangle(
        MPI.COMM_WORLD, [[0.0, 0.0], upper], cells, kind, diagonal=diagonal
    )


def particles_of(
    upper: list[float], grid: list[int], per_cell: int, kind: Any, k: int, m: int
) -> mpm.Particles:
    background = rectangle(upper, grid, mesh.CellType.quadrilateral)
    V = fem.functionspace(background, ("Lagrange", k, (2,)))
    return mpm.Particles(rectangle(upper, [per_cell * n for n in grid], kind), V, degree=m)


def modes(kind: Any, k: int, m: int, per_cell: int) -> int:
    """Motions of a free block of 3 by 3 cells without strain at any point, rigid ones apart."""
    body = particles_of([3.0, 3.0], [3, 3], per_cell, kind, k, m)
    u, v = ufl.TrialFunction(body.W), ufl.TestFunction(body.W)
    stiffness = ufl.inner(ufl.sym(ufl.grad(u)), ufl.grad(v)) * body.dx
    K = fem.assemble_matrix(fem.form(stiffness)).to_scipy().toarray()
    T = body.T.convert("dense").getDenseArray()
    moved, size, _ = np.linalg.svd(T, full_matrices=False)
    moved = moved[:, size > 1e-9 * size[0]]
    values = np.linalg.eigvalsh(moved.T @ K @ moved)
    return int((values < 1e-10 * values[-1]).sum()) - 3


def lambert(x: Any) -> Any:
    w = np.log1p(x)
    for _ in range(50):
        w = w - (w - x * np.exp(-w)) / (1.0 + w)
    return w


def errors(kind: Any, k: int, m: int, elements: int) -> tuple[float, float]:
    """Errors of the stress at the points and of the nodes' positions in the elastic column."""
    width = LENGTH / elements
    body = particles_of([width, LENGTH], [1, elements], 2, kind, k, m)
    V = body.V
    bcs = []
    for axis, ends in ((0, (0.0, width)), (1, (0.0,))):
        facets = mesh.locate_entities_boundary(
            V.mesh, 1, lambda x, i=axis, ends=ends: np.isclose(x[i][:, None], ends).any(axis=1)
        )
        dofs = fem.locate_dofs_topological(V.sub(axis), 1, facets)
        bcs.append(fem.dirichletbc(0.0, dofs, V.sub(axis)))
    problem = mpm.QuasiStaticProblem(
        body, mpm.materials.Hencky(YOUNG, 0.0), body_force=(0.0, -WEIGHT), bcs=bcs
    )
    problem.solve(steps=40)
    volumes = body.point_volumes()
    gap = body.point_stress[..., 1, 1] + WEIGHT * (LENGTH - body.initial_points[..., 1])
    Y = body.W.tabulate_dof_coordinates()[:, 1]
    w, bottom = (lambert(WEIGHT / YOUNG * (LENGTH - y)) for y in (Y, 0.0))
    exact = ((bottom + bottom**2 / 2) - (w + w**2 / 2)) * YOUNG / WEIGHT
    return (
        float((np.abs(gap) * volumes).sum() / volumes.sum()) / (WEIGHT * LENGTH),
        float(np.abs(body.node_positions[:, 1] - exact).mean()) / LENGTH,
    )


def pairs() -> None:
    validation._validate_degrees = lambda *_: None  # to see what is refused, and why
    head = ["background / domains", "modes, 1 per cell", "2 per cell", "stress, ne 8", "16", "32"]
    head += ["order", "position, ne 32", "order"]
    for name, kind in CELLS.items():
        rows = []
        for k, m in PAIRS:
            found = np.array([errors(kind, k, m, ne) for ne in (8, 16, 32)])
            order = np.log2(found[1] / found[2])
            counts = [modes(kind, k, m, n) for n in (1, 2)]
            stress = [f"{e:.1e}" for e in found[:, 0]]
            last = [f"{order[0]:.1f}", f"{found[2, 1]:.1e}", f"{order[1]:.1f}"]
            rows.append([f"{k} / {m}", *counts, *stress, *last])
        print(f"\n{name}:\n\n{table(head, rows)}", flush=True)


def fronts() -> None:
    variants = {
        "degree 1": ("--degree", 1),
        "degree 1, 4 x 4 domains in a cell": ("--degree", 1, "--particles-per-cell", 4),
        "degree 2": ("--degree", 2),
        "degree 2, 3 x 3 points": ("--degree", 2, "--quadrature-degree", 5),
        "degree 2, 4 x 4 points": ("--degree", 2, "--quadrature-degree", 7),
        "degree 2, 3 x 3 domains in a cell": ("--degree", 2, "--particles-per-cell", 3),
        "degree 3": ("--degree", 3),
    }
    rows = []
    for name, options in variants.items():
        found = [run("column_roller", "--elements", ne, *options) for ne in (16, 32, 64)]
        rows.append([name, *(f"{r['error_syy']:.1e}" for r in found), found[0]["iterations"]])
    print(table(["", "ne 16", "32", "64", "solves"], rows), flush=True)


def beam() -> None:
    rows = []
    for degree, h in ((1, 0.5), (1, 0.25), (2, 0.5), (2, 0.25), (3, 0.5), (3, 0.25)):
        found = [
            run("cantilever", "--degree", degree, "--cell", h, "--offset", offset)
            for offset in (0.0, 0.1 * h, 0.37 * h, 1e-9)
        ]
        worst = max(r["iterations"] for r in found)
        rows.append([f"{degree}, {h:g} m", *(f"{r['error']:.1e}" for r in found), worst])
    print(table(["degree, cells", "0", "0.1 h", "0.37 h", "1e-9", "solves"], rows), flush=True)


def flow() -> None:
    rows = []
    for g0, h in ((20e3, 1.0), (20e3, 0.5), (80e3, 1.0), (80e3, 0.5), (160e3, 1.0)):
        for domain, rule in (("quad", 3), ("tri", 2)):
            options = ("--domain", domain, "--g0", g0, "--cell", h, "--degree", 2)
            for kind in ("auto", "aggregate", "none"):
                r = run(
                    "column_free", *options, "--quadrature-degree", rule, "--stabilisation", kind
                )
                rows.append(
                    [
                        f"{g0 / 1e3:g}, {h:g} m, {domain}, {kind}",
                        f"{100 * r['load']:.4g} %",
                        r["cutbacks"],
                        r["iterations"],
                        f"{r['toe']:.2f}",
                        f"{r['y_mean']:.4f}",
                    ]
                )
    head = ["kN/m³, cells, domains, stabilisation", "load", "cutbacks", "solves", "toe, m"]
    print(table([*head, "mean height, m"], rows), flush=True)


if __name__ == "__main__":
    for part in sys.argv[1:] or ("pairs", "fronts", "beam", "flow"):
        {"pairs": pairs, "fronts": fronts, "beam": beam, "flow": flow}[part]()
