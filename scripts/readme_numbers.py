# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Write tables of README.md and docs/performance.md from benchmarks/results.

usage: readme_numbers.py [--check]    (--check: change nothing, fail where a table is another)
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "work_precision.json"
BESIDE = RESULTS.with_name("side_by_side.json")
SIZES = (16, 64, 256)
KINDS = {
    "quad1": "**CPDI2, quadrilaterals**",
    "tri1": "CPDI2, triangles",
    "gimp": "contiguous GIMP",
    "mpm": "point MPM",
    "quad2": "CPDI2, quadrilaterals, degree 2",
    "quad3": "CPDI2, quadrilaterals, degree 3",
}


#: Rows of the tables of seconds, each with the kinds that stand in it.
ROWS = {
    "plane": {
        "quadrilaterals, degree 1": ("quad1",),
        "triangles, degree 1": ("tri1",),
        "GIMP": ("gimp",),
        "quadrilaterals, degree 2": ("quad2",),
        "triangles, degree 2": ("tri2",),
        "quadrilaterals, degree 3": ("quad3",),
        "finite elements, degree 1": ("fem1",),
        "finite elements, degree 2": ("fem2",),
    },
    "more": {
        "degree 1": ("hex1", "quad1"),
        "degree 1, F-bar": ("hexf",),
        "degree 2": ("hex2", "quad2"),
        "finite elements, degree 1": ("fem1",),
        "finite elements, degree 2": ("fem2",),
    },
}
CASES = {"plane": ("A", "B", "C", "E"), "more": ("D", "P", "V", "H")}
NAMES = {
    "A": "elastic",
    "B": "roller",
    "C": "collapse",
    "D": "column in space",
    "E": "cantilever",
    "H": "contact",
    "P": "block in space",
    "V": "vortex",
}


def seconds(results: dict[str, Any], which: str) -> str:
    """Return a table: CPU seconds of the run at errors, *extrapolated* in italics."""
    columns = [
        (case, name) for case in CASES[which] for name in results["summary"] if name[0] == case
    ]
    heads = [f"{NAMES[case]}, {power(name.rpartition(' ')[2])}" for case, name in columns]
    lines = ["| | " + " | ".join(heads) + " |", "| --- |" + " ---: |" * len(columns)]
    for row, kinds in ROWS[which].items():
        entries = []
        for case, name in columns:
            found = results["summary"][name]
            tried = any(p["case"] == case and p["kind"] in kinds for p in results["points"])
            at = next((found[kind] for kind in kinds if kind in found), None)
            entries.append(entry(at) if at else "not reached" if tried else "")
        lines.append(f"| {row} | {' | '.join(entries)} |")
    return "\n".join(lines) + "\n"


def power(number: str) -> str:
    """Return a number with one digit and a short exponent."""
    return f"{float(number):.0e}".replace("e-0", "e-")


def entry(at: dict[str, Any]) -> str:
    """Return an entry of a table of seconds."""
    text = f"{float(format(at['run'], '.2g')):g}"
    if at["at"] == "extrapolated":
        return f"*{text}*"
    return f"≤ {text}" if at["at"] == "coarsest point" else text


def load_steps(results: dict[str, Any]) -> str:
    """Return a table of case F: steps or tolerance, linear solves, seconds and error."""
    lines = [
        "| | quadrilaterals: solves | CPU s | error | triangles: solves | CPU s | error |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    points = {
        (p["kind"], p["size"]): p
        for p in results["points"]
        if p["case"] == "F" and "reference" not in p
    }
    for kind, size in points:
        if kind.endswith("-tri"):
            continue
        name = f"{size:g} equal steps" if kind == "equal" else f"automatic, tolerance {size:g}"
        pair = [points[kind, size], points[f"{kind}-tri", size]]
        row = " | ".join(f"{p['iterations']} | {p['run']:.2g} | {p['error']:.1e}" for p in pair)
        lines.append(f"| {name} | {row} |")
    return "\n".join(lines) + "\n"


def machine(results: dict[str, Any]) -> str:
    """Return the sentence that says what the runs were made on."""
    on = results["machine"]
    return (
        f"Made on {on['processor']} ({on['cores']} cores, one used), DOLFINx {on['dolfinx']}, "
        f"Python {on['python']}.\n"
    )


def columns(results: dict[str, Any]) -> str:
    """Return the table: error of the stress, linear solves and seconds by size and code."""
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


def side_by_side(_: dict[str, Any]) -> str:
    """Return a table: errors and seconds of bodies that are carried, wholly or in part, or not."""
    points = json.loads(BESIDE.read_text("utf-8"))["points"]
    lines = [
        "| | error: carried | freed | elements | CPU s: carried | freed | elements | stock |",
        "| --- |" + " ---: |" * 7,
    ]
    runs = dict.fromkeys((p["case"], p["kind"][-1], p["size"]) for p in points)
    for case, degree, size in runs:
        kinds = ("hex" if case in ("D", "P") else "quad", "adapt", "free", "fem")
        some = [
            next(
                (p for p in points if p["case"] == case and p["size"] == size and p["kind"] == k),
                {},
            )
            for k in (kind + degree for kind in kinds)
        ]
        told = [f"{p['error']:.2g}" if "error" in p and not p["failure"] else "" for p in some[:3]]
        told += [f"{p['run']:.2g}" if p else "" for p in some]
        name = f"{NAMES[case]}, degree {degree}, {some[0]['particles']} domains"
        lines.append(f"| {name} | {' | '.join(told)} |")
    return "\n".join(lines) + "\n"


#: What stands between the marks of a name in a file.
PARTS: dict[str, dict[str, Callable[[dict[str, Any]], str]]] = {
    "README.md": {"numbers": columns},
    "docs/performance.md": {
        "machine": machine,
        "seconds": partial(seconds, which="plane"),
        "more seconds": partial(seconds, which="more"),
        "side by side": side_by_side,
        "load steps": load_steps,
    },
}


def main() -> None:
    """Write the tables, or compare."""
    results = json.loads(RESULTS.read_text("utf-8"))
    for name, parts in PARTS.items():
        page = ROOT / name
        text = whole = page.read_text("utf-8")
        for mark, make in parts.items():
            begin, end = f"<!-- {mark}: begin -->\n", f"<!-- {mark}: end -->"
            before, _, rest = whole.partition(begin)
            old, _, after = rest.partition(end)
            # what stands above a table, where it comes from, is kept
            head = old.partition("| |")[0] if "<!-- table" in old else ""
            whole = before + begin + head + make(results) + end + after
        if whole == text:
            continue
        if "--check" in sys.argv:
            sys.exit(f"{name} does not follow: python scripts/readme_numbers.py")
        page.write_text(whole, "utf-8")


if __name__ == "__main__":
    main()
