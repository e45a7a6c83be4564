# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Seconds of each phase of whole load steps, and how they grow with the number of particles.

The column of case C (triangles, 20 kN/m3) slumps in ever smaller cells; its first load steps of
40 are timed. All phases but the linear solver's should grow as the particles do.
"""

from __future__ import annotations

import argparse
import json
from typing import Any

from solvers import flow

SIZES = "0.5,0.25,0.125,0.04"
SOLVER = ("factorise", "solve")


def measure(size: float, steps: int) -> dict[str, Any]:
    """Run the first steps in cells of one size."""
    problem = flow(size, {})
    path = problem.steps(40)
    for _ in range(steps):
        next(path)
    statistics = problem.history.statistics
    seconds = {name: value / steps for name, value in statistics.seconds.items()}
    n = problem.particles.num_local
    rest = sum(value for name, value in seconds.items() if name not in SOLVER)
    return {
        "cell": size,
        "particles": n,
        "free_dofs": statistics["free_dofs"],
        "solves_per_step": problem.history.total_iterations / steps,
        "seconds": seconds,
        "us_per_particle_and_solve": 1e6 * rest * steps / n / problem.history.total_iterations,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object, no more")
    parser.add_argument("--sizes", default=SIZES, help="background cells, m")
    parser.add_argument("--steps", type=int, default=3, help="load steps of 40 to run")
    parser.add_argument("--smoke", action="store_true", help="tiny sizes: does it run?")
    args = parser.parse_args()
    sizes = [1.0, 0.5] if args.smoke else [float(size) for size in args.sizes.split(",")]
    rows = [measure(size, args.steps) for size in sizes]
    cost = [row["us_per_particle_and_solve"] for row in rows]
    if args.json:
        print(json.dumps({"sizes": rows, "growth": cost[-1] / cost[0]}))
        return
    phases = list(rows[0]["seconds"])
    print("seconds per step".ljust(18) + "".join(f"{name:>13s}" for name in phases))
    for row in rows:
        values = "".join(f"{row['seconds'][name]:13.4f}" for name in phases)
        print(f"{row['particles']:>10} triangles{values}")
    print("microseconds per particle and solve, without the linear solver:")
    print(", ".join(f"{value:.2f}" for value in cost))


if __name__ == "__main__":
    main()
