# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Print the tables of docs/step-size.md: python docs/studies/step_size.py"""

from __future__ import annotations

from case_runs import run, table

STEPS = (10, 20, 40, 80)
NAMES = {"quad": "quadrilaterals", "tri": "triangles"}
SCENES = [
    ("Between rollers, 32 cells high", "column_roller", ()),
    ("Free side, 10 kN/m³", "column_free", ("--g0", 10e3)),
    ("Free side, 20 kN/m³", "column_free", ("--g0", 20e3)),
]
HEAD = [
    "steps",
    "completed",
    "solves",
    "solves a step",
    "cutbacks",
    "top, m",
    "largest f",
]


def main() -> None:
    for title, demo, options in SCENES:
        for domain, name in NAMES.items():
            rows = []
            for steps in STEPS:
                r = run(demo, "--domain", domain, "--steps", steps, *options)
                rows.append(
                    [
                        steps,
                        "yes" if r["completed"] else f"to {100 * r['load']:.1f} %",
                        r["iterations"],
                        f"{r['iterations'] / steps:.1f}",
                        r["cutbacks"],
                        f"{r['top']:.4f}",
                        f"{r['yield_violation']:.0e}" if r["yield_violation"] > 0 else "0",
                    ]
                )
            print(f"\n{title}, {name}:\n\n{table(HEAD, rows)}", flush=True)


if __name__ == "__main__":
    main()
