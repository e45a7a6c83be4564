# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The tables of docs/load-steps.md: errors of steps chosen by a tolerance, and of equal ones."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
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
type Pressed = tuple[mpm.QuasiStaticProblem, Callable[[float], None]]


def collapse() -> mpm.QuasiStaticProblem:
    """A square block that slumps under its weight, half of it; 3 x 3 domains in a cell of 1 m."""
    V = fem.functionspace(kit.box([16.0, 9.0], [16, 9], QUAD), ("Lagrange", 1, (2,)))
    return mpm.QuasiStaticProblem(
        mpm.Body(
            mpm.Particles(kit.box([8.0, 8.0], [24, 24], QUAD), V),
            mpm.materials.VonMises(1e6, 0.3, rho_y=20e3),
            body_force=(0.0, -10e3),
        ),
        bcs=rollers(V, (0, 0.0), (1, 0.0)),
    )


def footing() -> mpm.QuasiStaticProblem:
    """A strip of 1 m that sinks 2 mm into clay, half of it; cells of 0.125 m below it."""
    h, size = 0.125, 5.0
    across, up = kit.lines(h, 1.75, size), size - kit.lines(h, 1.0, size)[::-1]
    background = kit.grid([across, np.append(up, size + h * np.arange(1, 3))], QUAD)
    V = fem.functionspace(background, ("Lagrange", 1, (2,)))
    background.topology.create_connectivity(1, 2)
    sides = [
        (0, lambda x: np.isclose(x[0], 0.0) | np.isclose(x[0], size), 0.0),
        (1, lambda x: np.isclose(x[1], 0.0), 0.0),
        (1, lambda x: np.isclose(x[1], size) & (x[0] < 0.5 + 1e-9), -0.002),
    ]
    domains = kit.grid([kit.divided(across, 2), kit.divided(up, 2)], QUAD)
    body = mpm.Particles(domains, V, quadrature_degree=2)
    law = mpm.materials.VonMises(1e7, 0.48, rho_y=np.sqrt(2.0) * 490.0)
    return mpm.QuasiStaticProblem(mpm.Body(body, law, f_bar="patch"), bcs=held(V, sides))


def slits() -> mpm.QuasiStaticProblem:
    """A plate of 2 m by 4 m, slit from both sides to its half, pulled by 0.1 m; a quarter of it."""
    h, pulled = 0.125, 0.1
    across, up = h * np.arange(9), h * np.arange(17)
    background = kit.grid([np.append(-h, across), np.append(up, up[-1] + h)], QUAD)
    V = fem.functionspace(background, ("Lagrange", 1, (2,)))
    background.topology.create_connectivity(1, 2)
    sides = [
        (0, lambda x: np.isclose(x[0], 1.0), 0.0),
        (1, lambda x: np.isclose(x[1], 0.0) & (x[0] > 0.5 - 1e-9), 0.0),
        (1, lambda x: np.isclose(x[1], 2.0) | np.isclose(x[1], 2.0 + h), pulled),
    ]
    domains = kit.grid([kit.divided(across, 2), kit.divided(up, 2)], QUAD)
    body = mpm.Particles(domains, V, quadrature_degree=2)
    law = mpm.materials.VonMises(1e7, 0.48, rho_y=np.sqrt(2.0) * 490.0)
    return mpm.QuasiStaticProblem(mpm.Body(body, law, f_bar="patch"), bcs=held(V, sides))


def held(V: fem.FunctionSpace, sides: Sequence[tuple]) -> list[fem.DirichletBC]:
    """Conditions from an axis, a place and a value each."""
    bcs = []
    for axis, where, value in sides:
        edges = mesh.locate_entities(V.mesh, 1, where)
        dofs = fem.locate_dofs_topological(V.sub(axis), 1, edges)
        bcs.append(fem.dirichletbc(value, dofs, V.sub(axis)))
    return bcs


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
    "plate with slits": (slits, 320),
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


def pressed(shape: mpm.contact.Shape, domain: str) -> Pressed:
    """Clay, half of it, into which an obstacle is pressed 0.3 m deep; two domains a cell."""
    h = 0.25
    across, up = kit.lines(h, 1.5, 4.0), -kit.lines(h, 1.0, 2.5)[::-1]
    places = [across, np.append(up, h * np.arange(1, 5))]
    V = fem.functionspace(kit.grid(places, QUAD), ("Lagrange", 1, (2,)))
    rule = 2 if domain == "quad" else None
    halves = [kit.divided(along, 2) for along in (across, up)]
    body = mpm.Particles(kit.grid(halves, kit.DOMAINS[domain]), V, quadrature_degree=rule)
    ground = np.sort(mesh.locate_entities_boundary(body.mesh, 1, lambda x: np.isclose(x[1], 0.0)))
    tags = mesh.meshtags(body.mesh, 1, ground, np.full(len(ground), 1, np.int32))
    obstacle = mpm.contact.Rigid(body, shape, mpm.contact.Coulomb(stiffness=0.1), facets=(tags, 1))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(body, mpm.materials.VonMises(500.0, 0.45, rho_y=np.sqrt(2.0)), f_bar="patch"),
        bcs=rollers(V, (0, 0.0), (0, 4.0), (1, -2.5)),
        terms=[obstacle],
    )
    return problem, lambda t: obstacle.move((0.0, -0.3 * t))


DISC = mpm.contact.disc((0.0, 0.5), 0.5)
WEDGE = mpm.contact.polygon([(0.0, 0.0), (3.0, 3.0), (-3.0, 3.0)])
DRIVEN = {
    "disc": partial(pressed, DISC, "quad"),
    "disc, triangles": partial(pressed, DISC, "tri"),
    "wedge": partial(pressed, WEDGE, "quad"),
}


@cache
def driven_by(case: str, count: int) -> tuple[int, np.ndarray]:
    """Return linear solves and the end of a run of equal steps."""
    problem, path = DRIVEN[case]()
    return problem.solve(count, update=path).total_iterations, nodal(problem)


def driven_cells(case: str) -> list[str]:
    """Return steps, solves and errors by tolerance, and those of equal steps."""
    exact = 2.0 * driven_by(case, 240)[1] - driven_by(case, 120)[1]

    def off(end: np.ndarray) -> str:
        return scientific(float(np.linalg.norm(end - exact) / np.linalg.norm(exact)))

    found = []
    for tolerance in (0.02, 0.01):
        problem, path = DRIVEN[case]()
        history = problem.solve("auto", tolerance=tolerance, update=path)
        found += [f"{len(history.steps)}, {history.total_iterations}", off(nodal(problem))]
    for count in (60, 120):
        solves, end = driven_by(case, count)
        found.append(f"{solves}, {off(end)}")
    return found


def tables() -> dict[str, Table]:
    head = ["", "0.02: steps, rejected, solves", "error", "0.01: steps, rejected, solves", "error"]
    head += ["20 equal steps: solves, error", "80"]
    rows = {case: partial(cells, case) for case in CASES}
    driven = ["", "0.02: steps, solves", "error", "0.01: steps, solves", "error"]
    driven += ["60 equal steps: solves, error", "120"]
    return {
        "load-steps/errors": Table("load-steps-measured", head, rows, quick=["elastic cantilever"]),
        "load-steps/driven": Table(
            "load-steps-measured", driven, {case: partial(driven_cells, case) for case in DRIVEN}
        ),
    }
