# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Make the tables of the documentation again, and say which pages no longer follow.

    python docs/studies/make.py [NAME ...] [--check] [--times]

What a study prints is kept in docs/studies/results. Each row of a table there must stand in the
study's page, else the page no longer follows: the status is 1. ``--check`` runs nothing but the
quick studies, changes no file, and compares what they print with the results too. Rows that hold
times are not compared; ``--times`` makes them with the others.
"""

from __future__ import annotations

import argparse
import hashlib
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
RESULTS = HERE / "results"


class Study(NamedTuple):
    """A script with the parts it prints, the page that holds its tables, and what it runs."""

    script: str
    page: str
    parts: tuple[str, ...] = ()
    quick: bool = False
    cases: tuple[str, ...] = ()


STUDIES = {
    "load-steps": Study("load_steps", "load-steps"),
    "step-size": Study("step_size", "step-size", cases=("column_roller", "column_free")),
    "locking": Study("locking", "locking", cases=("cantilever",)),
    "methods": Study("methods", "methods", ("crossing", "compaction"), cases=("compaction",)),
    "distortion": Study("methods", "methods", ("distortion",), True, ("domain_distortion",)),
    "patches": Study("methods", "methods", ("patches",), True),
    "cycle": Study("methods", "methods", ("cycle",), True),
    "times": Study("methods", "methods", ("times",)),
    "high-order": Study("high_order", "high-order"),
    "solver": Study("solver", "solver"),
    "kernel": Study("kernel", "solver"),
}
TIMES = {"times", "solver", "high-order"}


def inputs(study: Study) -> str:
    """Return a hash of the scripts that a study is made of."""
    scripts = [
        HERE / f"{study.script}.py",
        *(ROOT / f"benchmarks/cases/{c}.py" for c in study.cases),
    ]
    return hashlib.sha256(b"".join(path.read_bytes() for path in scripts)).hexdigest()[:16]


def rows(text: str) -> list[str]:
    """Return the rows of all tables of a text."""
    return [line.strip() for line in text.splitlines() if line.startswith("| ")]


def printed(study: Study) -> str:
    """Run a study and return what it prints."""
    done = subprocess.run(
        [sys.executable, str(HERE / f"{study.script}.py"), *study.parts],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return done.stdout.strip() + "\n"


def complaints(name: str, check: bool) -> list[str]:
    """Return what does not follow of a study, which is made again unless ``check``."""
    study, kept = STUDIES[name], RESULTS / f"{name}.md"
    head = f"<!-- inputs {inputs(study)} -->\n"
    if not check:
        RESULTS.mkdir(exist_ok=True)
        kept.write_text(head + printed(study), "utf-8")
    if not kept.exists():
        return []
    text, found = kept.read_text("utf-8"), []
    if not text.startswith(head):
        found.append(f"{name}: the scripts have changed since its results were made.")
    page = set(rows((ROOT / f"docs/{study.page}.md").read_text("utf-8")))
    lost = [] if name in TIMES else [row for row in rows(text) if row not in page]
    found += [f"{name}: docs/{study.page}.md has no row {row}" for row in lost]
    if check and study.quick and rows(printed(study)) != rows(text):
        found.append(f"{name}: a run prints other numbers than its results.")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(STUDIES))
    parser.add_argument("--check", action="store_true", help="change nothing")
    parser.add_argument("--times", action="store_true", help="also studies of run times")
    args = parser.parse_args()
    unknown = set(args.names) - STUDIES.keys()
    if unknown:
        parser.error(f"no such study: {', '.join(sorted(unknown))}")
    found = []
    for name in args.names or STUDIES:
        if name in TIMES and not (args.times or name in args.names):
            continue
        if args.check and not (RESULTS / f"{name}.md").exists():
            print(f"{name}: no results are kept", flush=True)
            continue
        new = complaints(name, args.check)
        print("\n".join(new) or f"{name}: follows", flush=True)
        found += new
    raise SystemExit(1 if found else 0)


if __name__ == "__main__":
    main()
