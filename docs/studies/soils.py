# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The tables of factors of safety and of strips in docs/limit-loads.md."""

from __future__ import annotations

from functools import partial

from case_runs import Table, run, share


def factors(case: str, known: str) -> list[str]:
    found = []
    for n in (10, 20):
        r = run("strength", "--case", case, "--cell", 1 / n)
        found += [share(r, f"{r['factor']:.3f}"), r["iterations"]]
    return [*found, known]


#: A strip on soil with weight: one domain of four points in a cell, and no ghost penalty.
WEIGHT = (
    "footing_weight --friction-angle 30 --f-bar none --domains-per-cell 1 --quadrature-degree 3 "
    "--stabilisation none --fine 2"
)


#: Columns of the weight.
RECOMMENDED = ("$N_\\gamma$ smooth", "$N_\\gamma$ rough")


def strip(options: str) -> list[str]:
    found = []
    for n in (4, 8, 16):
        command = f"--degree 2 --steps 12 --cell {1 / n} --case {options}"
        r = run("strength", *command.split())
        found += [share(r, f"{r['ratio']:.3f}"), f"{100 * r['plateau']:.2f} %", r["iterations"]]
    return found


def recommended(angle: int) -> list[str]:
    """The row of an angle of friction: ratio and solves a step of N_c, N_q and N_gamma."""
    found = []
    for case, steps in (("footing", 30), ("footing_surcharge", 30), *(("footing_weight", 50),) * 2):
        rough = ["--rough"] if len(found) == 6 else []
        if angle == 0 and case != "footing":
            found += ["", ""]
            continue
        given = ["--case", case, "--friction-angle", angle, "--recommended", *rough]
        r = run("strength", *given)
        found += [share(r, f"{r['ratio']:.3f}"), f"{r['iterations'] / steps:.0f}"]
    return found


def tables() -> dict[str, Table]:
    rows = {
        "this slope, factor of safety": (
            "slope",
            "1.40 (Griffiths & Lane), 1.38 (Bishop & Morgenstern)",
        ),
        "vertical cut, Tresca, $\\gamma H/c$": ("vertical_cut", "3.775 to 3.786"),
    }
    return {
        "limit-loads/recommended": Table(
            "limit-loads",
            ["", *(t for n in ("$N_c$", "$N_q$", *RECOMMENDED) for t in (n, "solves"))],
            {f"{angle}°": partial(recommended, angle) for angle in (0, 20, 25, 30, 35)},
            cases=["strength"],
        ),
        "limit-loads-measured/safety": Table(
            "limit-loads-measured",
            ["", "cells of H/10", "solves", "H/20", "solves", "known"],
            {label: partial(factors, *asked) for label, asked in rows.items()},
            cases=["strength"],
        ),
        "limit-loads-measured/strips": Table(
            "limit-loads-measured",
            ["", *(text for n in (4, 8, 16) for text in (f"cells of b/{n}", "rise", "solves"))],
            {
                "$N_c$, 20°, smooth": partial(strip, "footing"),
                "$N_\\gamma$, 30°, smooth": partial(strip, WEIGHT),
                "$N_\\gamma$, 30°, rough": partial(strip, f"{WEIGHT} --rough"),
            },
            cases=["strength"],
        ),
    }
