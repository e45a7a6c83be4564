# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The tables of docs/high-order-measured.md."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from mpi4py import MPI

import numpy as np
from case_runs import Table, run, scientific

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.particles import options as validation
from mpm_dolfinx.stabilisation import ghost_penalty

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
        mpm.Body(body, mpm.materials.Hencky(YOUNG, 0.0), body_force=(0.0, -WEIGHT)), bcs=bcs
    )
    problem.solve(steps=40)
    volumes = body.undeformed.point_volumes()
    gap = body.point_stress[..., 1, 1] + WEIGHT * (LENGTH - body.initial_points[..., 1])
    Y = body.W.tabulate_dof_coordinates()[:, 1]
    w, bottom = (lambert(WEIGHT / YOUNG * (LENGTH - y)) for y in (Y, 0.0))
    exact = ((bottom + bottom**2 / 2) - (w + w**2 / 2)) * YOUNG / WEIGHT
    return (
        float((np.abs(gap) * volumes).sum() / volumes.sum()) / (WEIGHT * LENGTH),
        float(np.abs(body.node_positions[:, 1] - exact).mean()) / LENGTH,
    )


def pair(kind: Any, k: int, m: int) -> list[Any]:
    validation._validate_degrees = lambda *_: None  # to see what is refused, and why
    found = np.array([errors(kind, k, m, ne) for ne in (8, 16, 32)])
    order = np.log2(found[1] / found[2])
    stress = [scientific(e) for e in found[:, 0]]
    last = [f"{order[0]:.1f}", scientific(found[2, 1]), f"{order[1]:.1f}"]
    return [*(modes(kind, k, m, n) for n in (1, 2)), *stress, *last]


def front(options: Sequence[Any]) -> list[Any]:
    found = [run("column_roller", "--elements", ne, *options) for ne in (16, 32, 64)]
    return [*(scientific(r["error_syy"]) for r in found), found[0]["iterations"]]


def beam(degree: int, h: float) -> list[Any]:
    found = [
        run("cantilever", "--degree", degree, "--cell", h, "--offset", offset)
        for offset in (0.0, 0.1 * h, 0.37 * h, 1e-9)
    ]
    return [*(scientific(r["error"]) for r in found), max(r["iterations"] for r in found)]


def flow(weight: int, h: float, domain: str, kind: str) -> list[Any]:
    options = ["--domain", domain, "--g0", 1e3 * weight, "--cell", h, "--degree", 2]
    options += ["--quadrature-degree", {"quad": 3, "tri": 2}[domain], "--stabilisation", kind]
    r = run("column_free", *options)
    reached = "" if r["completed"] else f" (to {100 * r['load']:.0f} %)"
    return [r["cutbacks"], r["iterations"], f"{r['toe']:.2f}{reached}", f"{r['y_mean']:.4f}"]


def condition(degree: int, stabilisation: str | None, offset: float) -> float:
    """Condition number of a held block's reduced tangent, scaled to unit diagonal."""
    h, side = 0.5, 1.0
    background = rectangle([1.5, 3.0], [3, 6], mesh.CellType.quadrilateral)
    V = fem.functionspace(background, ("Lagrange", degree, (2,)))
    cells = 2 * round(side / h)
    body = rectangle([side, side], [cells, cells], mesh.CellType.quadrilateral)
    body.geometry.x[:, 1] += side - offset
    facets = mesh.locate_entities_boundary(background, 1, lambda x: np.isclose(x[0], 0.0))
    dofs = fem.locate_dofs_topological(V, 1, facets)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            mpm.Particles(body, V, degree=degree),
            mpm.materials.Hencky(YOUNG, 0.2),
            body_force=(0.0, -1.0),
        ),
        bcs=[fem.dirichletbc(np.zeros(2), dofs, V)],
        solver=mpm.Solver(stabilisation=stabilisation),
    )
    problem.solve(steps=1)
    K = problem.A.convert("dense").getDenseArray()
    scale = 1.0 / np.sqrt(np.diag(K))
    values = np.linalg.eigvalsh(K * np.outer(scale, scale))
    return float(values[-1] / values[0]) if values[0] > 1e-14 * values[-1] else np.inf


def conditions(degree: int, stabilisation: str | None, gamma: float) -> list[str]:
    """The smallest and the largest of a block that is moved through a cell, and their ratio."""
    usual, ghost_penalty.PENALTY = ghost_penalty.PENALTY, gamma
    offsets = [1e-9, 1e-6, *np.linspace(0.0, 0.5, 200)]
    found = [condition(degree, stabilisation, offset) for offset in offsets]
    ghost_penalty.PENALTY = usual
    smallest, largest = min(found), max(found)
    if np.isinf(largest):
        return [scientific(smallest), "singular", ""]
    ratio = largest / smallest
    written = f"{ratio:.2g}" if ratio < 100.0 else scientific(ratio)
    return [scientific(smallest), scientific(largest), written]


CONDITIONS: dict[str, tuple[int, str | None, float]] = {
    "degree 1, none": (1, None, 0.0),
    "degree 2, none": (2, None, 0.0),
    "ghost penalty, $\\gamma = 10^{-6}$": (2, "ghost", 1e-6),
    "ghost penalty, $\\gamma = 10^{-5}$": (2, "ghost", 1e-5),
    "**ghost penalty, $\\gamma = 10^{-4}$**": (2, "ghost", 1e-4),
    "degree 3, ghost penalty, $\\gamma = 10^{-4}$": (3, "ghost", 1e-4),
}
FRONTS: dict[str, tuple[Any, ...]] = {
    "degree 1": ("--degree", 1),
    "degree 1, 4 x 4 domains in a cell": ("--degree", 1, "--particles-per-cell", 4),
    "degree 1, domains of degree 2": ("--degree", 1, "--domain-degree", 2),
    "degree 2": ("--degree", 2),
    "degree 2, 3 x 3 points": ("--degree", 2, "--quadrature-degree", 5),
    "degree 2, 4 x 4 points": ("--degree", 2, "--quadrature-degree", 7),
    "degree 2, 3 x 3 domains in a cell": ("--degree", 2, "--particles-per-cell", 3),
    "degree 3": ("--degree", 3),
}


def tables() -> dict[str, Table]:
    head = ["background / domains", "modes, 1 per cell", "2 per cell", "stress, ne 8", "16", "32"]
    head += ["order", "position, ne 32", "order"]
    beams = [(k, h) for k in (1, 2, 3) for h in (0.5, 0.25)]
    flows = [(g, h) for g, h in ((20, 1.0), (20, 0.5), (80, 1.0), (80, 0.5), (160, 1.0))]
    found = {
        f"high-order/pairs-{name}": Table(
            "high-order-measured",
            head,
            {
                f"{k} / {m}{' *refused*' if m < k else ''}": partial(pair, kind, k, m)
                for k, m in PAIRS
            },
            quick=["1 / 1", "2 / 2"],
        )
        for name, kind in CELLS.items()
    }
    found["high-order/condition"] = Table(
        "high-order-measured",
        ["degree 2 where no other is named", "smallest", "largest", "ratio"],
        {name: partial(conditions, *options) for name, options in CONDITIONS.items()},
    )
    found["high-order/beam"] = Table(
        "high-order-measured",
        ["degree, cells", "0", "0.1 h", "0.37 h", "1e-9", "solves, at most"],
        {f"{k}, {h:g} m": partial(beam, k, h) for k, h in beams},
        quick=["1, 0.5 m"],
        cases=["cantilever"],
    )
    found["high-order/front"] = Table(
        "high-order-measured",
        ["", "ne 16", "32", "64", "solves, ne 16"],
        {name: partial(front, options) for name, options in FRONTS.items()},
        quick=["degree 2"],
        cases=["column_roller"],
    )
    found["high-order/flow"] = Table(
        "high-order-measured",
        ["kN/m³, cells, domains", "cutbacks", "solves", "toe, m", "mean height, m"],
        {
            f"{g}, {h:g} m, {name}": partial(flow, g, h, domain, "auto")
            for g, h in flows
            for domain, name in (("quad", "quadrilaterals"), ("tri", "triangles"))
        },
        cases=["column_free"],
    )
    return found
