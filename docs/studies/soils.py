# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The tables of factors of safety and of soil with weight in docs/limit-loads.md."""

from __future__ import annotations

from functools import partial
from typing import Any

from case_runs import Table, run, share

ONE = "--domains-per-cell 1 --f-bar none"
WEIGHT = {
    '2 by 2, 36 points, `f_bar="patch"`, ghost penalty': "",
    "one, 9 points, `None`": f"{ONE} --stabilisation none",
    "one, 4 points, ghost penalty": f"{ONE} --quadrature-degree 3",
    "**one, 4 points, `None`**": f"{ONE} --quadrature-degree 3 --stabilisation none",
}


def weight(options: str) -> list[Any]:
    """Return what a strip on soil with weight bears over the exact values, and linear solves."""
    asked = ["--case", "footing_weight", "--friction-angle", 30, "--degree", 2, "--steps", 12]
    found: list[Any] = []
    for strip in ([], ["--rough"]):
        r = run("strength", *asked, "--cell", 0.25, *strip, *options.split())
        found += [share(r, f"{r['ratio']:.3f}"), r["iterations"]]
    return found


def factors(case: str, known: str) -> list[str]:
    found = []
    for n in (10, 20):
        r = run("strength", "--case", case, "--cell", 1 / n)
        found += [share(r, f"{r['factor']:.3f}"), r["iterations"]]
    return [*found, known]


def tables() -> dict[str, Table]:
    rows = {
        "this slope, factor of safety": (
            "slope",
            "1.40 (Griffiths & Lane), 1.38 (Bishop & Morgenstern)",
        ),
        "vertical cut, Tresca, $\\gamma H/c$": ("vertical_cut", "3.775 to 3.786"),
    }
    return {
        "limit-loads/safety": Table(
            "limit-loads",
            ["", "cells of H/10", "solves", "H/20", "solves", "known"],
            {label: partial(factors, *asked) for label, asked in rows.items()},
            cases=["strength"],
        ),
        "limit-loads/weight": Table(
            "limit-loads",
            ["domains and points in a cell", "smooth", "solves", "rough", "solves"],
            {label: partial(weight, asked) for label, asked in WEIGHT.items()},
            cases=["strength"],
        ),
    }
