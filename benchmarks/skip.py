# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What is skipped, on and off: CPU seconds, a counter, and that the answer is the same.

Each pair solves the same scene with and without one thing that a scene does not need.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np
from solvers import QUADRILATERAL, box, flow, rollers

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import _compat
from mpm_dolfinx.meshes.cells import disconnected_mesh


def heavy(
    n: int, law: mpm.materials.Material, weight: float, apart: bool = False, **options: Any
) -> mpm.QuasiStaticProblem:
    """Return a square of n x n background cells that sinks under its weight."""
    V = fem.functionspace(box([1.0, 1.0], [n, n], QUADRILATERAL), ("Lagrange", 1, (2,)))
    body = box([1.0, 1.0], [2 * n, 2 * n], QUADRILATERAL)
    if apart:
        corners = body.geometry.x[_compat.geometry_dofmap(body)][:, :, :2]
        body = disconnected_mesh(MPI.COMM_WORLD, corners, body.basix_cell())
    particles = mpm.Particles(body, V)
    bcs = rollers(V, (0, 0.0), (0, 1.0), (1, 0.0))
    heap = mpm.Body(particles, law, body_force=(0.0, -weight))
    return mpm.QuasiStaticProblem(heap, bcs, solver=mpm.Solver(**options))


class InPython(mpm.materials.Hencky):
    """Hencky's law as one that overrides a part of it: without its compiled update."""

    integrate = mpm.materials.Hencky.integrate


def elastic(**options: Any) -> mpm.materials.Material:
    return (mpm.materials.Hencky if options.get("compiled", True) else InPython)(1e3, 0.3)


def run(problem: mpm.QuasiStaticProblem, steps: int, rebuild: bool = False) -> None:
    for _ in problem.steps(steps):
        if rebuild:
            problem.reduced.tangent.loops.forget()


def rise(problem: mpm.QuasiStaticProblem) -> float:
    """Return the height of the body, volume by volume."""
    body = problem.particles
    return float(body.centroid[:, 1] @ body.initial_volume / body.initial_volume.sum())


def cases(n: int, h: float) -> dict[str, tuple[str, Callable[[], Any], Callable[[], Any]]]:
    """Return for each skip its counter, the scene with it and the scene without."""

    def pair(make: Callable[..., Any], on: Any, off: Any, steps: int = 5) -> Any:
        def one(options: dict[str, Any]) -> Callable[[], Any]:
            def solve() -> Any:
                options_of = dict(options)
                rebuild = options_of.pop("rebuild", False)
                problem = make(options_of)
                start = time.process_time()
                run(problem, steps, rebuild)
                return problem, time.process_time() - start

            return solve

        return one(on), one(off)

    def sinks(options: dict[str, Any]) -> Any:
        return heavy(n, elastic(), 50.0, **options)

    def linear(options: dict[str, Any]) -> Any:
        law = {True: mpm.materials.LinearElastic, False: mpm.materials.Hencky}[
            options.pop("linear")
        ]
        return heavy(n, law(1e3, 0.3), 1e-6, **options)

    def history(options: dict[str, Any]) -> Any:
        kept = options.pop("kept")
        law = mpm.materials.VonMises(1e3, 0.3, rho_y=1e9) if kept else elastic()
        return heavy(n, law, 50.0, **options)

    def materials(options: dict[str, Any]) -> Any:
        return heavy(n, elastic(compiled=options.pop("compiled")), 50.0, **options)

    return {
        "shared nodes are located once": ("nodes", *pair(sinks, {}, {"apart": True})),
        "the pattern is kept": ("patterns", *pair(sinks, {}, {"rebuild": True})),
        "compiled update": ("residuals", *pair(materials, {"compiled": True}, {"compiled": False})),
        "no history without plasticity": (
            "residuals",
            *pair(history, {"kept": False}, {"kept": True}),
        ),
        "a linear scene is one solve": (
            "factorisations",
            *pair(linear, {"linear": True}, {"linear": False}, steps=1),
        ),
        "start from the past": ("factorisations", *pair(sinks, {}, {"predictor": False}, 10)),
        "start from the past, in flow": (
            "factorisations",
            *pair(lambda options: flow(h, options), {}, {"predictor": False}, 10),
        ),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object, no more")
    parser.add_argument("--size", type=int, default=64, help="background cells along a side")
    parser.add_argument("--cell", type=float, default=0.25, help="cells of the flowing column, m")
    parser.add_argument("--smoke", action="store_true", help="tiny sizes: does it run?")
    args = parser.parse_args()
    n, h = (6, 1.0) if args.smoke else (args.size, args.cell)
    rows = {}
    for name, (counter, on, off) in cases(n, h).items():
        (with_it, quick), (without, slow) = on(), off()
        counts = []
        for problem in (with_it, without):
            statistics = {
                **problem.history.statistics,
                "nodes": float(len(problem.particles.node_positions)),
            }
            counts.append(statistics[counter])
        difference = abs(rise(with_it) - rise(without)) / np.ptp(without.particles.centroid[:, 1])
        rows[name] = {
            "seconds": [quick, slow],
            "counter": counter,
            "counts": counts,
            "difference": difference,
        }
    if args.json:
        print(json.dumps(rows))
        return
    for name, row in rows.items():
        on, off = row["seconds"]
        print(
            f"{name:38s} {on:8.3f} s, else {off:8.3f} s; {row['counter']} "
            f"{row['counts'][0]:.0f}, else {row['counts'][1]:.0f}; differs by "
            f"{row['difference']:.0e}"
        )


if __name__ == "__main__":
    main()
