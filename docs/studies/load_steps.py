# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The table of docs/load-steps.md: errors of steps chosen by a tolerance, and of equal ones."""

from __future__ import annotations

import sys
from functools import cache, partial
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import numpy as np
from case_runs import Table, scientific

from dolfinx import fem, mesh

import mpm_dolfinx as mpm

SCENES = Path(__file__).resolve().parents[2] / "benchmarks" / "scenes.py"
spec = spec_from_file_location("benchmark_scenes", SCENES)  # the tests have a module of that name
assert spec is not None and spec.loader is not None
scenes = sys.modules["benchmark_scenes"] = module_from_spec(spec)
spec.loader.exec_module(scenes)
rollers, kit = scenes.rollers, scenes.kit

QUAD = mesh.CellType.quadrilateral


def collapse() -> mpm.QuasiStaticProblem:
    """A square block that slumps under its weight, half of it; 3 x 3 domains in a cell of 1 m."""
    V = fem.functionspace(kit.box([16.0, 9.0], [16, 9], QUAD), ("Lagrange", 1, (2,)))
    return mpm.QuasiStaticProblem(
        mpm.Particles(kit.box([8.0, 8.0], [24, 24], QUAD), V),
        mpm.materials.VonMises(1e6, 0.3, rho_y=20e3),
        body_force=(0.0, -10e3),
        bcs=rollers(V, (0, 0.0), (1, 0.0)),
    )


def lines(fine: float, h: float, size: float) -> np.ndarray:
    """Return grid lines from 0 to a size, at first h apart."""
    cells = np.full(round(fine / h), h)
    longer = h * 1.2 ** np.arange(1, 100)
    longer = longer[: 1 + np.argmax(np.cumsum(longer) >= size - cells.sum())]
    longer *= (size - cells.sum()) / longer.sum()
    return np.concatenate([[0.0], np.cumsum(cells), cells.sum() + np.cumsum(longer)])


def grid(x: np.ndarray, y: np.ndarray) -> mesh.Mesh:
    """Return a mesh of quadrilaterals with given lines."""
    domain = kit.box([len(x) - 1.0, len(y) - 1.0], [len(x) - 1, len(y) - 1], QUAD)
    for axis, along in enumerate((x, y)):
        place = domain.geometry.x[:, axis]
        place[:] = np.interp(place, np.arange(len(along)), along)
    return domain


def halved(x: np.ndarray) -> np.ndarray:
    """Return lines with one more in the middle of each interval."""
    return np.interp(np.arange(2 * len(x) - 1) / 2.0, np.arange(len(x)), x)


def footing() -> mpm.QuasiStaticProblem:
    """A strip of 1 m that sinks 2 mm into clay, half of it; cells of 0.125 m below it."""
    h, size = 0.125, 5.0
    across, up = lines(1.75, h, size), size - lines(1.0, h, size)[::-1]
    background = grid(across, np.append(up, size + h * np.arange(1, 3)))
    V = fem.functionspace(background, ("Lagrange", 1, (2,)))
    background.topology.create_connectivity(1, 2)
    sides = [
        (0, lambda x: np.isclose(x[0], 0.0) | np.isclose(x[0], size), 0.0),
        (1, lambda x: np.isclose(x[1], 0.0), 0.0),
        (1, lambda x: np.isclose(x[1], size) & (x[0] < 0.5 + 1e-9), -0.002),
    ]
    bcs = []
    for axis, where, value in sides:
        dofs = fem.locate_dofs_topological(
            V.sub(axis), 1, mesh.locate_entities(background, 1, where)
        )
        bcs.append(fem.dirichletbc(value, dofs, V.sub(axis)))
    body = mpm.Particles(grid(halved(across), halved(up)), V, quadrature_degree=2)
    law = mpm.materials.VonMises(1e7, 0.48, rho_y=np.sqrt(2.0) * 490.0)
    return mpm.QuasiStaticProblem(body, law, bcs=bcs, f_bar="patch")


def column(weight: float, domain: str):
    """Return what makes the column with a free side."""
    return lambda: scenes.column_free(0.5, domain, weight=weight).problem


CASES = {
    "free column, 20 kN/m³, quadrilaterals": (column(20e3, "quad"), 640),
    "free column, 20 kN/m³, triangles": (column(20e3, "tri"), 640),
    "free column, 80 kN/m³, quadrilaterals": (column(80e3, "quad"), 640),
    "free column, 80 kN/m³, triangles": (column(80e3, "tri"), 640),
    "block that slumps": (collapse, 640),
    "footing": (footing, 320),
    "column between rollers": (lambda: scenes.column_roller(32).problem, 320),
    "elastic column": (lambda: scenes.compaction(16).problem, 320),
    "elastic cantilever": (lambda: scenes.cantilever(0.5).problem, 320),
}


def nodal(problem: mpm.QuasiStaticProblem) -> np.ndarray:
    """Return the displacements at the nodes of the body."""
    return np.array(problem.particles.displacement.x.array)


@cache
def reference(case: str) -> np.ndarray:
    """Return the end of a run of many equal steps."""
    make, steps = CASES[case]
    problem = make()
    problem.solve(steps)
    return nodal(problem)


def error(problem: mpm.QuasiStaticProblem, case: str) -> float:
    """Return the distance from the reference, relative to the motion."""
    exact = reference(case)
    return float(np.linalg.norm(nodal(problem) - exact) / np.linalg.norm(exact))


def cells(case: str) -> list[str]:
    """Return steps, rejected ones, solves and errors by tolerance, and those of equal steps."""
    make, _ = CASES[case]
    found = []
    for tolerance in (0.02, 0.01):
        problem = make()
        history = problem.solve("auto", tolerance=tolerance)
        rejected = int(history.statistics["rejected_steps"])
        found.append(f"{len(history.steps)}, {rejected}, {history.total_iterations}")
        found.append(scientific(error(problem, case)))
    for count in (20, 80):
        problem = make()
        history = problem.solve(count)
        found.append(f"{history.total_iterations}, {scientific(error(problem, case))}")
    return found


def tables() -> dict[str, Table]:
    head = ["", "0.02: steps, rejected, solves", "error", "0.01: steps, rejected, solves", "error"]
    head += ["20 equal steps: solves, error", "80"]
    rows = {case: partial(cells, case) for case in CASES}
    return {"load-steps/errors": Table("load-steps", head, rows, quick=["elastic cantilever"])}
