# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The tables of docs/step-size.md."""

from __future__ import annotations

from functools import partial
from typing import Any

from case_runs import Table, run, scientific

STEPS = (10, 20, 40, 80)
SCENES: dict[str, tuple[str, tuple[Any, ...]]] = {
    "rollers": ("column_roller", ()),
    "free-10": ("column_free", ("--g0", 10e3)),
    "free-20": ("column_free", ("--g0", 20e3)),
}
HEAD = ["steps", "completed", "solves", "solves a step", "cutbacks", "top, m", "largest f"]


def cells(case: str, domain: str, steps: int, options: tuple[Any, ...]) -> list[Any]:
    r = run(case, "--domain", domain, "--steps", steps, *options)
    return [
        "yes" if r["completed"] else f"to {100 * r['load']:.1f} %",
        r["iterations"],
        f"{r['iterations'] / steps:.1f}",
        r["cutbacks"],
        f"{r['top']:.4f}",
        scientific(max(r["yield_violation"], 0.0), 0),
    ]


def tables() -> dict[str, Table]:
    return {
        f"step-size/{name}-{domain}": Table(
            "step-size",
            HEAD,
            {str(n): partial(cells, case, domain, n, options) for n in STEPS},
            quick=["10"],
            cases=[case],
        )
        for name, (case, options) in SCENES.items()
        for domain in ("quad", "tri")
    }
