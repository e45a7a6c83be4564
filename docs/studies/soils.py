# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The table of factors of safety in docs/limit-loads.md."""

from __future__ import annotations

from functools import partial

from case_runs import Table, run, share


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
        )
    }
