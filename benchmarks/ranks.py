# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Numbers of all cases on several ranks against those on the first number of ranks.

Each case runs with its main variants. No number of its JSON object may differ by more than 1e-9,
relatively, or absolutely where it is an error's norm or a relative rise; counts of solves and
cutbacks must be the same. Printed is the largest difference of each run and the number that it is
of; the exit status is 1 where one is too large.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from launcher import launched

import mpm_dolfinx as mpm

CASES = Path(__file__).parent / "cases"
BOUND = 1e-9
#: Ratios of two numbers of a run, less one.
RISES = ("plateau", "energy_change", "energy_largest")

#: Cases and their arguments.
RUNS = (
    "compaction --elements 16",
    "compaction --elements 16 --domain tri",
    "compaction --elements 4 --domain hex --steps 10",
    "compaction --elements 4 --domain tet --steps 10",
    "compaction --elements 16 --method cpdi",
    "compaction --elements 16 --method gimp",
    "compaction --elements 16 --method mpm",
    "compaction --elements 8 --degree 2",
    "compaction --elements 8 --degree 3 --domain tri --steps 20",
    "column_roller --elements 16",
    "column_roller --elements 8 --domain tri --f-bar patch --steps 20",
    "column_roller --elements 8 --domain hex --steps 10",
    "column_roller --elements 8 --small-strain --young 2e8 --steps 10",
    "column_roller --elements 8 --method gimp --steps 20",
    "column_free --g0 20e3",
    "column_free --g0 80e3",
    "column_free --domain quad --g0 20e3",
    "column_free --domain quad --g0 20e3 --on-distortion split",
    "column_free --domain quad --g0 20e3 --f-bar domain",
    "column_free --domain quad --cell 1 --g0 20e3 --f-bar patch",
    "column_free --cell 1 --g0 20e3 --f-bar patch",
    "column_free --domain quad --cell 1 --g0 20e3 --degree 2",
    "column_free --cell 1 --g0 40e3 --width 8 --outside stop",
    "column_free --cell 1 --g0 40e3 --width 8 --outside delete",
    "cantilever --degree 2",
    "cantilever --degree 2 --offset 0.05",
    "cantilever --domain tri --root pinned",
    "block3d --elements 2 --steps 20",
    "block3d --elements 2 --steps 20 --domain tet --plates smooth",
    "collapse --cell 2 --particles-per-cell 2 --steps 20",
    "collapse --cell 2 --f-bar patch --steps 20",
    "footing --cell 0.25 --steps 16",
    "gmsh_body",
    "cylinder --elements 8",
    "cell_crossing --steps 20",
    "snap_through",
    "domain_distortion --steps 8",
    "ufl_material --elements 8",
    "ufl_material --elements 8 --domain tri --degree 2 --steps 20",
    "sphere --cells 2 --steps 2",
    "sphere --cells 2 --domain tet --steps 2",
    "sphere --cells 2 --law nitsche --steps 2",
    "penetration --cell 0.25 --depth 0.1 --friction 0.3 --steps 8",
    "penetration --cell 0.25 --domain tri --obstacle pile --depth 0.1 --friction 0.5 --steps 8",
    "colliding_discs --fields two --cell 0.2 --dt 0.2 --steps 12 --friction 0.5 --beside 0.08",
)


def difference(key: str, one: Any, other: Any) -> float:
    """Return how far two values of a key are apart: 0 where they are the same."""
    if one == other:
        return 0.0
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        return max(difference(key, a, b) for a, b in zip(one, other, strict=True))
    if not (isinstance(one, float) and isinstance(other, float)):
        return float("inf")
    gap = abs(one - other)
    absolute = "error" in key or key in RISES
    return float(gap if absolute else gap / max(abs(one), abs(other)))


def compare(case: str, ranks: list[int]) -> dict[str, Any]:
    """Run a case on each number of ranks, and compare."""
    name, *arguments = case.split()
    runs = [launched(n, CASES / f"{name}.py", *arguments, "--json") for n in ranks]
    result: dict[str, Any] = {"case": case, "completed": runs[0]["completed"]}
    for n, run in zip(ranks[1:], runs[1:], strict=True):
        gaps = {key: difference(key, value, run.get(key)) for key, value in runs[0].items()}
        worst = max(gaps, key=lambda key: gaps[key])
        result[str(n)] = {"difference": gaps[worst], "number": worst}
    return result


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object, no more")
    parser.add_argument("--ranks", default="1,2,3,4", help="numbers of ranks")
    parser.add_argument("--only", default="", help="cases that begin so")
    parser.add_argument("--smoke", action="store_true", help="one tiny case: does it run?")
    args = parser.parse_args()
    ranks = [int(n) for n in args.ranks.split(",")]
    cases = [case for case in RUNS if case.startswith(args.only)]
    if args.smoke:
        ranks, cases = [1, 2], ["compaction --elements 4 --steps 4"]
    rows = []
    for case in cases:
        rows.append(compare(case, ranks))
        if not args.json:
            parts = [f"{rows[-1][str(n)]['difference']:8.1e}" for n in ranks[1:]]
            last = rows[-1][str(ranks[-1])]["number"]
            print(f"{case:70s}" + "".join(parts) + f"  {last}", flush=True)
    worst = max(row[str(n)]["difference"] for row in rows for n in ranks[1:])
    if args.json:
        print(json.dumps({"ranks": ranks, "runs": rows, "version": mpm.__version__}))
    else:
        print(f"\nlargest difference {worst:.1e}, bound {BOUND:.0e}")
    raise SystemExit(worst > BOUND)


if __name__ == "__main__":
    main()
