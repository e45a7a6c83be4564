# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Seconds of each phase on several ranks, and what a step sends.

The slumping column of case C (triangles, 20 kN/m3): one size on all numbers of ranks (strong), and
a size that grows with them (weak). Seconds are wall time of a load step after the first one, the
most of all ranks, medians of several runs in turn; on more ranks than there are cores only the
counters mean something. From the counters follows a model of the traffic: the unknowns that ranks
need of each other for a product with T are c sqrt(unknowns x ranks), the length of the borders
between them.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from statistics import median
from typing import Any

from mpi4py import MPI

from launcher import launched
from solvers import flow

import mpm_dolfinx as mpm

COUNTERS = ("free_dofs", "off_rank_rows", "off_rank_columns", "dof_imbalance")
BYTES = 8
ITERATIVE = {
    "petsc_options": {"ksp_type": "cg", "ksp_rtol": 1e-8, "pc_type": "gamg"},
    "stabilisation": "ghost",
}


def run(cell: float, steps: int, iterative: bool) -> dict[str, Any]:
    """Run load steps of 40, after a first one, on the ranks there are (collective)."""
    comm = MPI.COMM_WORLD
    problem = flow(cell, ITERATIVE if iterative else {})
    path = problem.steps(40)
    next(path)
    statistics = problem.history.statistics
    before = dict(statistics)
    iterations = []
    comm.barrier()
    start = MPI.Wtime()
    for _ in range(steps):
        step = next(path)
        iterations.append(problem.solver.getLinearSolveIterations() / step.iterations)
    wall = comm.allreduce(MPI.Wtime() - start, MPI.MAX)
    seconds = {
        name: comm.allreduce(value - before[name], MPI.MAX) / steps
        for name, value in statistics.seconds.items()
    }
    residuals = (statistics["residuals"] - before["residuals"]) / steps
    products = 2 * residuals + 2  # T u and T^T r, and once for each step
    return {
        "ranks": comm.size,
        "cell": cell,
        "particles": problem.particles.num_global,
        "step": wall / steps,
        "seconds": seconds,
        "iterations_per_solve": sum(iterations) / steps,
        **{name: statistics[name] for name in COUNTERS},
        "bytes_per_step": BYTES * statistics["off_rank_columns"] * products,
    }


def middle(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """The medians of the seconds of several runs."""
    seconds = {name: median(one["seconds"][name] for one in runs) for name in runs[0]["seconds"]}
    return {**runs[0], "seconds": seconds, "step": median(one["step"] for one in runs)}


def model(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Fit the borders' length, and say what 1e9 particles on 1 000 ranks would send."""
    several = [row for row in rows if row["ranks"] > 1]
    sizes = [(row["free_dofs"] * row["ranks"]) ** 0.5 for row in several]
    c = sum(s * row["off_rank_columns"] for s, row in zip(sizes, several, strict=True))
    c /= sum(s * s for s in sizes)
    worst = max(
        abs(c * s / row["off_rank_columns"] - 1.0) for s, row in zip(sizes, several, strict=True)
    )
    dofs_per_particle = rows[-1]["free_dofs"] / rows[-1]["particles"]
    columns = c * (1e9 * dofs_per_particle * 1e3) ** 0.5
    return {
        "c": c,
        "largest_deviation": worst,
        "columns_1e9_on_1000": columns,
        "bytes_per_rank_and_product_1e9_on_1000": BYTES * columns / 1e3,
    }


def table(rows: list[dict[str, Any]]) -> None:
    """Print seconds, and how many times faster than the first row the others are."""
    phases = list(rows[0]["seconds"])
    print(f"{'ranks':>5s} {'particles':>9s}" + "".join(f"{p:>13s}" for p in (*phases, "step")))
    times = [[*(row["seconds"][p] for p in phases), row["step"]] for row in rows]
    for row, values in zip(rows, times, strict=True):
        line = "".join(f"{value:13.4f}" for value in values)
        print(f"{row['ranks']:5d} {row['particles']:9d}{line}")
    for row, values in zip(rows[1:], times[1:], strict=True):
        ratios = (a / b if b > 0 else 1.0 for a, b in zip(times[0], values, strict=True))
        print(f"{row['ranks']:5d} {'faster':>9s}" + "".join(f"{ratio:13.2f}" for ratio in ratios))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object, no more")
    parser.add_argument("--ranks", default="1,2", help="numbers of ranks")
    parser.add_argument("--cell", type=float, default=0.04, help="background cell, m")
    parser.add_argument("--steps", type=int, default=3, help="load steps to time")
    parser.add_argument("--repeats", type=int, default=5, help="runs of each")
    parser.add_argument("--only", choices=["strong", "weak"], help="one of the two alone")
    parser.add_argument(
        "--iterative", action="store_true", help="conjugate gradients with GAMG instead of MUMPS"
    )
    parser.add_argument("--smoke", action="store_true", help="tiny sizes: does it run?")
    parser.add_argument("--task", choices=["run"], help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.task:
        result = run(args.cell, args.steps, args.iterative)
        if MPI.COMM_WORLD.rank == 0:
            print(json.dumps(result))
        return
    if args.smoke:
        args.ranks, args.cell, args.repeats, args.steps = "1,2", 0.5, 1, 1
    counts = [int(n) for n in args.ranks.split(",")]
    kinds = [args.only] if args.only else ["strong", "weak"]
    options = ["--task", "run", "--steps", str(args.steps)]
    options += ["--iterative"] if args.iterative else []
    runs: dict[str, dict[int, list[dict[str, Any]]]] = {k: {n: [] for n in counts} for k in kinds}
    for _ in range(args.repeats):
        for n in counts:
            for kind in kinds:
                cells = round(8.0 / args.cell / 2 * n**0.5) * 2
                cell = args.cell if kind == "strong" else 8.0 / cells
                one = launched(n, Path(__file__), *options, "--cell", str(cell))
                runs[kind][n].append(one)
    rows = {kind: [middle(part) for part in runs[kind].values()] for kind in kinds}
    fitted = model([row for part in rows.values() for row in part]) if max(counts) > 1 else {}
    if args.json:
        print(json.dumps({**rows, "model": fitted, "version": mpm.__version__}))
        return
    for name, part in rows.items():
        print(f"\n{name}, seconds per step")
        table(part)
    print()
    for name, value in fitted.items():
        print(f"{name:40s} {value:.4g}")


if __name__ == "__main__":
    main()
