# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The tables of docs/solver-measured.md."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from case_runs import Table, run, scientific
from kernel import SCENES, STEPS, column, kernel

import mpm_dolfinx as mpm

LOADS = (20e3, 40e3, 80e3, 160e3)
DOMAINS = {"quad": "quadrilaterals", "tri": "triangles"}
OWN = "-mpm_pc_type lu -mpm_pc_factor_mat_solver_type"
FACTORS = [
    ("MUMPS, LDLᵀ (default)", ""),
    ("MUMPS, LDLᵀ, ordering AMD", "-mpm_mat_mumps_icntl_7 0"),
    ("MUMPS, LU", f"{OWN} mumps"),
    ("PETSc, LU", f"{OWN} petsc -mpm_pc_factor_zeropivot 1e-50"),
]


def outcome(r: dict[str, Any]) -> str:
    """What a table says of a run."""
    if r["completed"]:
        return f"whole, {r['cutbacks']}, toe {r['toe']:.4f}"
    error = {"ConvergenceError": "C", "DomainDistortionError": "D"}.get(r["failure"], "?")
    return f"**{100 * r['load']:.1f} %** {error}, {r['cutbacks']}"


def alone(domain: str, shift: float, search: bool) -> list[str]:
    """Return what shift and line search do, each by itself."""
    row = []
    for g0, width in ((20e3, 20.0), (80e3, 80.0), (160e3, 128.0)):
        _, problem, _ = column(domain, g0, width, shift=shift, line_search=search)
        try:
            history = problem.solve(STEPS)
            row.append(f"whole ({history.cutbacks})")
        except mpm.MPMError as error:
            row.append(f"stops at {100 * error.load:.1f} % ({problem.history.cutbacks})")
    return row


def factors(domain: str, petsc: str, plain: bool) -> list[str]:
    options = ["--domain", domain, *["--plain-solver"] * plain]
    return [outcome(run("column_free", *options, "--g0", g0, petsc=petsc)) for g0 in LOADS]


def predicted(domain: str, g0: float, width: float) -> list[str]:
    """Return solves and cutbacks from zero and predicted, and how many steps were."""
    found = []
    for predictor in (False, True):
        _, problem, _ = column(domain, g0, width, predictor=predictor)
        history = problem.solve(STEPS)
        found.append(f"{history.total_iterations}, {history.cutbacks}")
    kept = int(history.statistics["predictions"])
    return [*found, f"{kept} of {len(history.steps)}"]


def kernels(domain: str, g0: float, width: float) -> list[Any]:
    """Return what is known of the kernel of T in the run of a column."""
    particles, problem, fixed = column(domain, g0, width)
    dimensions, smallest, free = [], np.inf, np.zeros(0)
    for _ in problem.steps(STEPS):
        free, sizes, null = kernel(particles, fixed)
        dimensions.append(len(null))
        smallest = min(smallest, sizes[len(sizes) - len(null) - 1])
    with_one = f"{np.count_nonzero(dimensions)} of {len(dimensions)}"
    return [with_one, max(dimensions), scientific(smallest), len(free)]


def tables() -> dict[str, Table]:
    loads = [f"{g0 / 1e3:g} kN/m³" for g0 in LOADS]
    found = {}
    for name, title, plain in (
        ("plain", "No shift, no line search", True),
        ("default", "Default", False),
    ):
        found[f"solver/{name}"] = Table(
            "solver-measured",
            [title, *loads],
            {
                f"{kind}, {factor}": partial(factors, domain, petsc, plain)
                for domain, kind in DOMAINS.items()
                for factor, petsc in FACTORS
            },
            cases=["column_free"],
        )
    for domain in DOMAINS:
        found[f"solver/alone-{domain}"] = Table(
            "solver-measured",
            ["", "20 kN/m³", "80 kN/m³", "160 kN/m³"],
            {
                label: partial(alone, domain, shift, search)
                for label, shift, search in (
                    ("neither", 0.0, False),
                    ("line search alone", 0.0, True),
                    ("shift alone", 1e-13, False),
                    ("both", 1e-13, True),
                )
            },
        )
    scenes = {f"{DOMAINS[s[0]]}, {s[1] / 1e3:g} kN/m³": s for s in SCENES}
    found["solver/predictor"] = Table(
        "solver-measured",
        ["free column: solves, cutbacks", "from zero", "predicted", "steps from a prediction"],
        {label: partial(predicted, *scene) for label, scene in scenes.items()},
        quick=list(scenes)[-2:-1],
    )
    found["solver/kernel"] = Table(
        "solver-measured",
        [
            "",
            "states with a kernel",
            "largest dimension",
            "smallest other singular value",
            "free dofs at the end",
        ],
        {label: partial(kernels, *scene) for label, scene in scenes.items()},
    )
    return found
