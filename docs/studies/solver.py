# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Print the tables of docs/solver.md: python docs/studies/solver.py"""

from __future__ import annotations

from typing import Any

from case_runs import run, table
from kernel import STEPS, column

import mpm_dolfinx as mpm

LOADS = (20e3, 40e3, 80e3, 160e3)
DOMAINS = {"quad": "quadrilaterals", "tri": "triangles"}
OWN = "-collapse_pc_type lu -collapse_pc_factor_mat_solver_type"
FACTORS = [
    ("MUMPS, LDLᵀ (default)", ""),
    ("MUMPS, LDLᵀ, ordering AMD", "-collapse_mat_mumps_icntl_7 0"),
    ("MUMPS, LU", f"{OWN} mumps"),
    ("PETSc, LU", f"{OWN} petsc -collapse_pc_factor_zeropivot 1e-50"),
]


def outcome(r: dict[str, Any]) -> str:
    """What a table says of a run."""
    if r["completed"]:
        return f"whole, {r['cutbacks']}, toe {r['toe']:.4f}"
    error = {"ConvergenceError": "C", "DomainDistortionError": "D"}.get(r["failure"], "?")
    return f"**{100 * r['load']:.1f} %** {error}, {r['cutbacks']}"


def alone() -> None:
    """Print what shift and line search do, each by itself."""
    for domain, name in DOMAINS.items():
        rows = []
        for shift in (0.0, 1e-13):
            for search in (False, True):
                row = []
                for g0, width in ((20e3, 20.0), (80e3, 80.0), (160e3, 128.0)):
                    _, problem, _ = column(domain, g0, width, shift=shift, line_search=search)
                    try:
                        history = problem.solve(STEPS)
                        row.append(f"whole ({history.cutbacks})")
                    except mpm.MPMError as error:
                        row.append(f"{100 * error.load:.2f} % ({problem.history.cutbacks})")
                rows.append([f"shift {shift:g}, line search {search}", *row])
        print(f"\n{table([name, '20', '80', '160'], rows)}", flush=True)


def main() -> None:
    alone()
    for plain in (False, True):
        rows = []
        for domain, name in DOMAINS.items():
            for factor, petsc in FACTORS:
                options = ["--domain", domain, *["--plain-solver"] * plain]
                runs = [run("column_free", *options, "--g0", g0, petsc=petsc) for g0 in LOADS]
                rows.append([f"{name}, {factor}", *map(outcome, runs)])
                print(rows[-1], [r["worst_domain"] for r in runs], flush=True)
        solver = "No shift, no line search" if plain else "Default"
        head = [solver, *(f"{g0 / 1e3:g} kN/m³" for g0 in LOADS)]
        print(f"\n{table(head, rows)}\n", flush=True)


if __name__ == "__main__":
    main()
