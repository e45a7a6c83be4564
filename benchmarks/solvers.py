# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Seconds in the linear solver by strategy, on an elastic, a flowing and a 3-D scene.

All strategies of a scene run in this process, step by step in turn, so that what else the
machine does is shared out fairly. Seconds are this process's CPU time in the phases factorise and
solve.
"""

from __future__ import annotations

import argparse
import json
import time
from types import SimpleNamespace
from typing import Any

from mpi4py import MPI

import numpy as np

from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx import history as history_module

QUADRILATERAL, HEXAHEDRON = mesh.CellType.quadrilateral, mesh.CellType.hexahedron
FRESH = {"ksp_type": "preonly", "pc_type": "cholesky"}
STRATEGIES: dict[str, dict[str, Any]] = {
    "default": {},
    "fresh LDLT": {"petsc_options": FRESH},
    "fresh LDLT, no predictor": {"petsc_options": FRESH, "predictor": False},
    "fresh LU": {"petsc_options": {**FRESH, "pc_type": "lu"}},
}
COLUMNS = ("seconds", "solves", "factorisations", "cutbacks")


def box(upper: list[float], cells: list[int], cell: mesh.CellType) -> mesh.Mesh:
    """Return a mesh of a rectangle or a box with a corner at the origin."""
    lower = [0.0] * len(upper)
    if len(upper) == 3:
        return mesh.create_box(MPI.COMM_WORLD, [lower, upper], cells, cell)
    diagonal = mesh.DiagonalType.left_right
    return mesh.create_rectangle(MPI.COMM_WORLD, [lower, upper], cells, cell, diagonal=diagonal)


def rollers(V: fem.FunctionSpace, *planes: tuple[int, float]) -> list[fem.DirichletBC]:
    """Return rollers on planes x[axis] = place of the background."""
    dim = V.mesh.topology.dim - 1
    bcs = []
    for axis, place in planes:
        facets = mesh.locate_entities_boundary(
            V.mesh, dim, lambda x, axis=axis, place=place: np.isclose(x[axis], place)
        )
        dofs = fem.locate_dofs_topological(V.sub(axis), dim, facets)
        bcs.append(fem.dirichletbc(0.0, dofs, V.sub(axis)))
    return bcs


def problem(
    background: mesh.Mesh,
    body: mesh.Mesh,
    planes: list[tuple[int, float]],
    law: mpm.materials.Material,
    weight: float,
    options: dict[str, Any],
) -> mpm.QuasiStaticProblem:
    """Return a heavy body on rollers."""
    dim = body.geometry.dim
    V = fem.functionspace(background, ("Lagrange", 1, (dim,)))
    force = (*[0.0] * (dim - 1), -weight)
    return mpm.QuasiStaticProblem(
        mpm.Body(mpm.Particles(body, V), law, body_force=force),
        bcs=rollers(V, *planes),
        solver=mpm.Solver(**options),
    )


def elastic(size: float, options: dict[str, Any]) -> mpm.QuasiStaticProblem:
    """Compaction of a square, ``size`` cells wide and high (case A, wide)."""
    n, length = int(size), 50.0
    return problem(
        box([length] * 2, [n, n], QUADRILATERAL),
        box([length] * 2, [2 * n, 2 * n], QUADRILATERAL),
        [(0, 0.0), (0, length), (1, 0.0)],
        mpm.materials.Hencky(1e4, 0.0),
        800.0,
        options,
    )


def flow(size: float, options: dict[str, Any]) -> mpm.QuasiStaticProblem:
    """Column that slumps, in cells of ``size`` (case C, triangles, 20 kN/m3)."""
    return problem(
        box([20.0, 10.0], [round(20 / size), round(10 / size)], QUADRILATERAL),
        box([4.0, 8.0], [round(8 / size), round(16 / size)], mesh.CellType.triangle),
        [(0, 0.0), (1, 0.0)],
        mpm.materials.VonMises(1e6, 0.3, rho_y=20e3),
        20e3,
        options,
    )


def block(size: float, options: dict[str, Any]) -> mpm.QuasiStaticProblem:
    """A quarter of a block that slumps in space, ``size`` cells wide and high."""
    n = int(size)
    return problem(
        box([2.0, 2.0, 1.0], [2 * n, 2 * n, n], HEXAHEDRON),
        box([1.0] * 3, [2 * n] * 3, HEXAHEDRON),
        [(axis, 0.0) for axis in range(3)],
        mpm.materials.VonMises(1e4, 0.3, rho_y=50.0),
        100.0,
        options,
    )


# Scene, its key in the JSON object, sizes (of the smoke test last), load steps.
SCENES = {
    "elastic": (elastic, "ratio_elastic", [64], [8]),
    "flow": (flow, "ratio_flow", [0.125, 0.0625], [1.0]),
    "3d": (block, "ratio_3d", [6], [2]),
}


def measure(scene: str, size: float, steps: int, names: list[str]) -> dict[str, dict[str, float]]:
    """Run a scene's first steps (of 40) with each strategy in turn."""
    make = SCENES[scene][0]
    runs = {name: make(size, STRATEGIES[name]) for name in names}
    paths = {name: run.steps(40) for name, run in runs.items()}
    for _ in range(steps):
        for path in paths.values():
            next(path)
    rows = {}
    for name, run in runs.items():
        counts = run.history.statistics
        numbers = (
            counts["factorise"] + counts["solve"],
            run.history.total_iterations,
            counts["factorisations"],
            run.history.cutbacks,
        )
        rows[name] = {**dict(zip(COLUMNS, numbers, strict=True)), "dofs": counts["free_dofs"]}
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object, no more")
    parser.add_argument("--smoke", action="store_true", help="tiny sizes, a few seconds")
    parser.add_argument("--steps", type=int, default=8, help="load steps of 40 to run")
    parser.add_argument("--scene", choices=[*SCENES, "all"], default="all")
    parser.add_argument(
        "--size",
        type=float,
        action="append",
        help="size of the scene (elastic, 3d: cells along a side; flow: cell size, m); may be "
        "given several times, with --scene",
    )
    args = parser.parse_args()
    if args.size and args.scene == "all":
        parser.error("--size needs --scene")
    if args.steps < 1 or any(size <= 0 for size in args.size or ()):
        parser.error("--steps and --size must be positive")
    history_module.time = SimpleNamespace(perf_counter=time.process_time)
    results: dict[str, Any] = {"scenes": []}
    root = MPI.COMM_WORLD.rank == 0
    for scene in SCENES if args.scene == "all" else [args.scene]:
        _, key, sizes, smoke = SCENES[scene]
        for size in args.size or (smoke if args.smoke else sizes):
            steps = 3 if args.smoke else args.steps
            rows = measure(scene, size, steps, list(STRATEGIES))
            ratio = rows["fresh LDLT"]["seconds"] / rows["default"]["seconds"]
            results[key] = ratio  # of the largest size
            results["scenes"].append({"scene": scene, "size": size, "strategies": rows})
            if root and not args.json:
                print(f"\n{scene}, size {size:g}, {rows['default']['dofs']:.0f} unknowns")
                print(f"{'':26s}" + "".join(f"{name:>16s}" for name in COLUMNS))
                for name, row in rows.items():
                    line = "".join(f"{row[column]:16.5g}" for column in COLUMNS)
                    print(f"{name:26s}{line}")
                print(f"fresh over default: {ratio:.2f}", flush=True)
    if root and args.json:
        print(json.dumps(results))


if __name__ == "__main__":
    main()
