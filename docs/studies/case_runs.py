# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Tables of the documentation row by row, and runs of the cases that most of them are made of."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[2]
CASES = ROOT / "benchmarks" / "cases"


class Table(NamedTuple):
    """A table that stands in a page.

    Attributes:
        page: Name of the page in ``docs``.
        head: Its first row.
        rows: A function for each label that returns the row's other cells.
        quick: Labels of rows that take seconds.
        cases: Names of the cases that it runs.
        times: Whether it holds run times, which no second run repeats.
    """

    page: str
    head: Sequence[str]
    rows: Mapping[str, Callable[[], Sequence[Any]]]
    quick: Sequence[str] = ()
    cases: Sequence[str] = ()
    times: bool = False


def run(case: str, *arguments: Any, petsc: str = "") -> dict[str, Any]:
    """Return what a case reports; ``petsc`` are options for its solver."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PETSC_OPTIONS": petsc}
    command = [sys.executable, str(CASES / f"{case}.py"), "--json", *map(str, arguments)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=1800)
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(command)} ended with {done.returncode}:\n{done.stderr}")
    return json.loads(done.stdout)


def scientific(value: float, digits: int = 1) -> str:
    """Return a number as the pages write it: 2.5e-3."""
    if value == 0.0:
        return "0"
    mantissa, power = f"{value:.{digits}e}".split("e")
    return f"{mantissa}e{int(power)}"


def share(result: Mapping[str, Any], what: str) -> str:
    """Return what a table says of a run, or how far it came."""
    return what if result["completed"] else f"stops at {100 * result['load']:.0f} %"


def line(cells: Iterable[Any]) -> str:
    """Return a row of a Markdown table."""
    return "| " + " | ".join(map(str, cells)) + " |"


def head(table: Table) -> list[str]:
    """Return the first two rows of a table; all columns but the first are numbers."""
    return [line(table.head), line(["---", *["---:"] * (len(table.head) - 1)])]


def row(table: Table, label: str) -> str:
    """Run what a row is made of and return it."""
    return line([label, *table.rows[label]()])
