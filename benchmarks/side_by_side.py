# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Particles, freed nodes, finite element bodies and stock DOLFINx: error and seconds in turns.

    python benchmarks/side_by_side.py [--cases A,E] [--turns 2]

The scenes of `work_precision.py` in small sizes, each on one mesh of the body: carried by a
background with cells twice as large, with nodes freed where that errs (`adapt=`), as a finite
element body, and by stock DOLFINx. All of a size run in one process, in turns, so that a machine
that is busy with other things slows down all alike; of several turns the least user CPU seconds
of the run count. The first turn, which may compile forms, counts for none.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mpi4py import MPI  # noqa: F401 (before DOLFINx)

import work_precision
from work_precision import IMAGES, draw, made

import mpm_dolfinx as mpm

RESULTS = Path(__file__).resolve().parent / "results" / "side_by_side.json"
PLANE = {1: ("quad1", "adapt1", "free1", "fem1"), 2: ("quad2", "adapt2", "free2", "fem2")}
SPACE = {1: ("hex1", *PLANE[1][1:]), 2: ("hex2", *PLANE[2][1:])}
#: Sizes by degree.
SIZES: dict[str, dict[int, Sequence[float]]] = {
    "A": {1: (64,), 2: (16,)},
    "B": {1: (64,), 2: (16,)},
    "C": {1: (1.0, 0.5), 2: (1.0,)},
    "D": {1: (2,), 2: (1,)},
    "E": {1: (0.5, 0.25), 2: (2.0, 1.0)},
    "H": {1: (8,), 2: (4,)},
    "P": {1: (2, 4), 2: (1, 2)},
    "V": {1: (8, 16), 2: (4, 8)},
}
#: Nodes are freed in problems at rest.
MOVING = ("V",)


def ran(case: str, kind: str, size: float, reference: float | None) -> dict[str, Any]:
    """Run a scene; return what it took and what came out."""
    scene = made(case, kind, size)
    start, failure = resource.getrusage(resource.RUSAGE_SELF).ru_utime, None
    try:
        scene.solve()
    except mpm.MPMError as error:
        failure = type(error).__name__
    run = resource.getrusage(resource.RUSAGE_SELF).ru_utime - start
    row = {"case": case, "kind": kind, "size": size, "run": run, "failure": failure}
    row |= scene.account() | scene.measure()
    if reference is not None:
        row["error"] = abs(row["y_mean"] / reference - 1.0)
    return row


def measured(case: str, turns: int, reference: float | None) -> list[dict[str, Any]]:
    """Run all kinds of a case in turns."""
    rows = []
    for degree, sizes in SIZES[case].items():
        kinds = (SPACE if case in ("D", "P") else PLANE)[degree]
        kinds = tuple(k for k in kinds if case not in MOVING or not k.startswith("adapt"))
        for size in sizes:
            best: dict[str, dict[str, Any]] = {}
            for turn in range(turns + 1):
                for kind in kinds:
                    row = ran(case, kind, size, reference)
                    if turn > 0 and (kind not in best or row["run"] < best[kind]["run"]):
                        best[kind] = row
            for kind in kinds:
                row = best[kind]
                told = row["failure"] or f"error {row['error']:.3e}"
                solves = f"{row['iterations']} solves, {row['cutbacks']} cutbacks"
                print(
                    f"{case} {kind:7s} {size:6g} {row['run']:8.3f} s  {solves}  {told}", flush=True
                )
            rows += best.values()
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", default=",".join(SIZES), help="which to run, e.g. A,E")
    parser.add_argument("--turns", type=int, default=1, help="runs of each, least seconds taken")
    parser.add_argument("--draw", action="store_true", help="run nothing, draw an earlier run")
    args = parser.parse_args()
    cases = [] if args.draw else args.cases.split(",")
    if unknown := [case for case in cases if case not in SIZES]:
        parser.error(f"there is no case {unknown[0]!r}; choose from {','.join(SIZES)}")
    points = json.loads(RESULTS.read_text())["points"] if RESULTS.exists() else []
    known = json.loads(work_precision.RESULTS.read_text())["points"]
    height = next(p["y_mean"] for p in known if p["case"] == "C" and "reference" in p)
    for case in cases:
        points = [p for p in points if p["case"] != case]
        points += measured(case, args.turns, height if case == "C" else None)
        points.sort(key=lambda p: p["case"])
        results = {"machine": work_precision.machine(), "points": points}
        RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    there = [case for case in SIZES if any(p["case"] == case for p in points)]
    draw(points, there, "run", IMAGES / "side_by_side.png")


if __name__ == "__main__":
    sys.exit(main())
