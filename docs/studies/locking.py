# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Print the table of the cantilever in docs/locking.md: python docs/studies/locking.py"""

from __future__ import annotations

from case_runs import run, table

#: Name and arguments; two sizes of cells each.
ROWS = {
    'one point, `"patch"`': "--quadrature-degree 1 --f-bar patch",
    '2 by 2 points, `"patch"`': "--quadrature-degree 2 --f-bar patch",
    'triangles, `"patch"`': "--domain tri --f-bar patch",
    "degree 2": "--degree 2",
    'degree 2, `"domain"`': "--degree 2 --f-bar domain",
}


def main() -> None:
    rows = []
    for name, arguments in ROWS.items():
        results = [
            run("cantilever", "--poisson", 0.4999, "--cell", cell, *arguments.split())
            for cell in (0.5, 0.25)
        ]
        errors = [
            f"{r['error']:.1e}" if r["completed"] else f"stops at {100 * r['load']:.0f} %"
            for r in results
        ]
        rows.append([name, *errors, ", ".join(str(r["iterations"]) for r in results)])
    print("\nCantilever:\n\n" + table(["", "cells of 0.5 m", "0.25 m", "linear solves"], rows))


if __name__ == "__main__":
    main()
