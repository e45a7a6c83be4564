# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Seconds of each phase on several ranks, and what a step sends.

The slumping column of case C (triangles, 20 kN/m3): one size on all numbers of ranks (strong), and
a size that grows with them (weak). Seconds are wall time, the most of all ranks, the least of
several runs in turn; on more ranks than there are cores only the counters mean something. From the
counters follows a model of the traffic: the unknowns that ranks need of each other for a product
with T are c sqrt(unknowns x ranks), the length of the borders between them.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from mpi4py import MPI

from solvers import flow

import mpm_dolfinx as mpm

COUNTERS = ("free_dofs", "off_rank_rows", "off_rank_columns", "dof_imbalance")
BYTES = 8


def run(cell: float, steps: int) -> dict[str, Any]:
    """Run the first load steps of 40 on the ranks there are (collective)."""
    comm = MPI.COMM_WORLD
    problem = flow(cell, {})
    comm.barrier()
    start = MPI.Wtime()
    path = problem.steps(40)
    for _ in range(steps):
        next(path)
    wall = comm.allreduce(MPI.Wtime() - start, MPI.MAX)
    statistics = problem.history.statistics
    seconds = {
        name: comm.allreduce(value, MPI.MAX) / steps for name, value in statistics.seconds.items()
    }
    products = 2 * statistics["residuals"] / steps + 2  # T u and T^T r, and once for each step
    return {
        "ranks": comm.size,
        "cell": cell,
        "particles": problem.particles.num_global,
        "step": wall / steps,
        "seconds": seconds,
        **{name: statistics[name] for name in COUNTERS},
        "bytes_per_step": BYTES * statistics["off_rank_columns"] * products,
    }


def launched(ranks: int, cell: float, steps: int) -> dict[str, Any]:
    """Run in processes of their own."""
    beside = Path(sys.executable).with_name("mpirun")
    launcher = str(beside) if beside.exists() else shutil.which("mpirun")
    if launcher is None:
        raise SystemExit("There is no mpirun, neither beside this Python nor on PATH.")
    command = [launcher, "-n", str(ranks), sys.executable, __file__, "--task", "run"]
    command += ["--cell", str(cell), "--steps", str(steps)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    return dict(json.loads(done.stdout))


def least(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """The run with the shortest step."""
    return min(runs, key=lambda one: float(one["step"]))


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
    phases = list(rows[0]["seconds"])
    print(f"{'ranks':>5s} {'particles':>9s}" + "".join(f"{p:>13s}" for p in (*phases, "step")))
    for row in rows:
        values = [*(row["seconds"][p] for p in phases), row["step"]]
        line = "".join(f"{value:13.4f}" for value in values)
        print(f"{row['ranks']:5d} {row['particles']:9d}{line}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object, no more")
    parser.add_argument("--ranks", default="1,2,4", help="numbers of ranks")
    parser.add_argument("--cell", type=float, default=0.0625, help="background cell, m")
    parser.add_argument("--steps", type=int, default=2, help="load steps of 40 to run")
    parser.add_argument("--repeats", type=int, default=3, help="runs of each")
    parser.add_argument("--smoke", action="store_true", help="tiny sizes: does it run?")
    parser.add_argument("--task", choices=["run"], help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.task:
        result = run(args.cell, args.steps)
        if MPI.COMM_WORLD.rank == 0:
            print(json.dumps(result))
        return
    if args.smoke:
        args.ranks, args.cell, args.repeats, args.steps = "1,2", 0.5, 1, 1
    counts = [int(n) for n in args.ranks.split(",")]
    strong: dict[int, list[dict[str, Any]]] = {n: [] for n in counts}
    weak: dict[int, list[dict[str, Any]]] = {n: [] for n in counts}
    for _ in range(args.repeats):
        for n in counts:
            strong[n].append(launched(n, args.cell, args.steps))
            cells = round(8.0 / args.cell / 2 * n**0.5) * 2
            weak[n].append(launched(n, 8.0 / cells, args.steps))
    rows = {
        "strong": [least(r) for r in strong.values()],
        "weak": [least(r) for r in weak.values()],
    }
    fitted = model([*rows["strong"], *rows["weak"]])
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
