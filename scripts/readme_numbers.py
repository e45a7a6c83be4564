# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Write the table of README.md from benchmarks/results/work_precision.json.

usage: readme_numbers.py [--check]    (--check: change nothing, fail where the table is another)
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
RESULTS = ROOT / "benchmarks" / "results" / "work_precision.json"
BEGIN, END = "<!-- numbers: begin -->\n", "<!-- numbers: end -->"
SIZES = (16, 64, 256)
KINDS = {
    "quad1": "**CPDI2, quadrilaterals**",
    "tri1": "CPDI2, triangles",
    "gimp": "contiguous GIMP",
    "mpm": "point MPM",
    "quad2": "CPDI2, quadrilaterals, degree 2",
    "quad3": "CPDI2, quadrilaterals, degree 3",
}


def table() -> str:
    """Return the table: error of the stress, linear solves and seconds by size and code."""
    results = json.loads(RESULTS.read_text("utf-8"))
    rows = [
        "| | n = 16 | 64 | 256 | solves | CPU s |",
        "| --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for name, points in results["peers"]["A"].items():
        errors = [f"{error:.2e}" for _, error in points]
        errors += [""] * (len(SIZES) - len(errors))
        rows.append(f"| {name} | {' | '.join(errors)} | | {points[-1][0]:.3g} |")
    for kind, name in KINDS.items():
        points = {int(p["size"]): p for p in results["points"] if is_of(p, kind)}
        some = [points.get(size) for size in SIZES]
        errors = [f"{p['error']:.2e}" if p else "" for p in some]
        last = [p for p in some if p][-1]
        solves = ", ".join(str(p["iterations"]) for p in some if p)
        rows.append(f"| {name} | {' | '.join(errors)} | {solves} | {last['process']:.2g} |")
    return "\n".join(rows) + "\n"


def is_of(point: dict[str, Any], kind: str) -> bool:
    """Return whether a point is one of the elastic column by a method, of a size that counts."""
    return point["case"] == "A" and point["kind"] == kind and point["size"] in SIZES


def main() -> None:
    """Write the table, or compare."""
    text = README.read_text("utf-8")
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    whole = before + BEGIN + table() + END + after
    if "--check" in sys.argv:
        if whole != text:
            sys.exit("README.md does not follow: python scripts/readme_numbers.py")
    else:
        README.write_text(whole, "utf-8")


if __name__ == "__main__":
    main()
