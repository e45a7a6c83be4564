# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Run cases and read the JSON objects they print, for the tables of the documentation."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

CASES = Path(__file__).resolve().parents[2] / "benchmarks" / "cases"


def run(case: str, *arguments: Any, petsc: str = "") -> dict[str, Any]:
    """Return what a case reports; ``petsc`` are options for its solver."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PETSC_OPTIONS": petsc}
    command = [sys.executable, str(CASES / f"{case}.py"), "--json", *map(str, arguments)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900)
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(command)} ended with {done.returncode}:\n{done.stderr}")
    return json.loads(done.stdout)


def table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a Markdown table; all columns but the first are numbers."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)
