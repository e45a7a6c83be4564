# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The tables of docs/error.md."""

from __future__ import annotations

from functools import partial
from typing import Any

from case_runs import Table, run

ROWS = {
    f"{degree}, {'off' if offset else 'on'} the grid, 1/{cells}": (degree, offset, cells)
    for degree, sizes in ((1, (8, 16, 32)), (2, (8, 16)))
    for offset in (0.0, 0.37)
    for cells in sizes
}
IN_SPACE = {"1, on the grid, 1/3, in space": "--space 3 --cells 3"}


def of(arguments: str) -> list[Any]:
    found = run("lshape", *arguments.split())
    return [
        found["unknowns"],
        f"{found['error']:.4f}",
        f"{found['estimate'] / found['error']:.2f}",
        f"{found['error_all_free']:.4f}",
    ]


def adapted(arguments: str) -> list[Any]:
    found = run("lshape", *arguments.split(), "--adapt", "0.01")
    before = run("lshape", *arguments.split())
    return [
        f"{before['error']:.4f}",
        before["unknowns"],
        f"{found['error']:.4f}",
        found["unknowns"],
        f"{found['error_all_free']:.4f}",
    ]


def tables() -> dict[str, Table]:
    rows = {
        label: partial(of, f"--degree {degree} --offset {offset} --cells {cells}")
        for label, (degree, offset, cells) in ROWS.items()
    }
    lines = {
        label: partial(adapted, row.args[0]) for label, row in rows.items() if "1/8" not in label
    }
    rows |= {label: partial(of, arguments) for label, arguments in IN_SPACE.items()}
    header = ("degree, cells", "unknowns", "error", "estimate over it", "the body's elements alone")
    told = (
        "degree, cells",
        "carried",
        "unknowns",
        "adapted",
        "unknowns",
        "the body's elements alone",
    )
    return {
        "error/lshape": Table("error", header, rows, tuple(rows)[:1], ("lshape",)),
        "error/adapted": Table("error", told, lines, tuple(lines)[:1], ("lshape",)),
    }
