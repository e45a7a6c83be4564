# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What each rank holds and sends with multigrid in space, as the body grows with the ranks.

The column of ``multigrid.py`` on 1, 2, 4, ... ranks, with about as many domains on each, which are
where the background around them is. Counted, the most of all ranks, over the second load step:

- iterations of conjugate gradients a solve, and how uneven unknowns and domains are,
- bytes that a product with K, and one with each matrix of a V cycle, bring from other ranks,
- bytes of arrays that ranks exchange besides in the step (location, transfer, pattern, values),
- bytes of coarse levels that every rank has a copy of.

Seconds are not: on more ranks than cores they mean nothing. Two functions are fitted. What crosses
the borders of parts is ``c (1 - R^(-1/3)) (n / R)^(2/3)`` with n unknowns on R ranks, as for cubes;
what every rank has of the whole is ``c n``. From these follows what 1e9 domains on 1 000 ranks
take.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from launcher import launched
from multigrid import column
from numpy.typing import NDArray

import mpm_dolfinx as mpm
from mpm_dolfinx.parallel import exchange

COMM = MPI.COMM_WORLD
#: Bytes of a number, and numbers that come over borders or that every rank has.
BYTES, BORDER, WHOLE = 8, ("product", "cycle", "exchanged"), ("replicated",)


def received(matrix: PETSc.Mat) -> int:
    """Return the bytes that a product with a matrix brings from other ranks."""
    first, last = matrix.getOwnershipRangeColumn()
    columns = np.unique(matrix.getValuesCSR()[1])
    return BYTES * int(np.count_nonzero((columns < first) | (columns >= last)))


def distinct(matrix: PETSc.Mat) -> int:
    """Return how many columns the rows of this rank have entries in."""
    return len(np.unique(matrix.getValuesCSR()[1]))


def count_exchanged(counts: dict[str, int]) -> None:
    """Count from now on what ranks exchange besides products."""
    swap = exchange.swap

    def count_swap(comm: MPI.Comm, parts: Sequence[NDArray[Any]]) -> list[NDArray[Any]]:
        counts["exchanged"] += sum(p.nbytes for r, p in enumerate(parts) if r != comm.rank)
        return swap(comm, parts)

    for module in list(sys.modules.values()):
        if getattr(module, "swap", None) is swap:
            module.swap = count_swap  # type: ignore[attr-defined]


def count_levels(counts: dict[str, int], pc: PETSc.PC) -> None:
    """Count what a V cycle brings from other ranks, and what all ranks have of its levels.

    That is, for each coarse dof that a rank's rows of the finest interpolation have, its number,
    the rank, and how much that uses it: by these the dofs are given to ranks.
    """
    levels = range(1, pc.getMGLevels())
    operators = [pc.getMGSmoother(level).getOperators()[1] for level in levels]
    interpolations = [pc.getMGInterpolation(level) for level in levels]
    coarsest = pc.getMGCoarseSolve().getOperators()[0]
    counts["product"] = received(operators[-1])
    counts["cycle"] = sum(map(received, (*operators, coarsest, *interpolations)))
    counts["replicated"] = 3 * BYTES * COMM.allreduce(distinct(interpolations[-1]))


def run(n: int) -> dict[str, Any]:
    """Make two load steps on the ranks there are; return what the second one takes."""
    problem = column(n, "multigrid", spread=True)
    path = problem.steps(4)
    next(path)
    statistics = problem.history.statistics
    before = statistics["krylov_iterations"]
    counts = dict.fromkeys((*BORDER, *WHOLE), 0)
    count_exchanged(counts)
    step = next(path)
    count_levels(counts, problem.solver.getKSP().getPC())
    unknowns = statistics["free_dofs"]
    return {
        "ranks": COMM.size,
        "domains": problem.particles.num_global,
        "unknowns": unknowns,
        "solves": step.iterations,
        "its": (statistics["krylov_iterations"] - before) / step.iterations,
        "dof_imbalance": statistics["dof_imbalance"],
        "particle_imbalance": statistics["particle_imbalance"],
        **{name: COMM.allreduce(count, MPI.MAX) for name, count in counts.items()},
    }


def fitted(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Fit what ranks take, and say what 1e9 domains on 1 000 ranks would."""
    several = [row for row in rows if row["ranks"] > 1]
    share = several[-1]["unknowns"] / several[-1]["domains"]
    large = {"ranks": 1000, "unknowns": 1e9 * share}
    found: dict[str, Any] = {}
    for names, size in ((BORDER, borders), (WHOLE, lambda row: row["unknowns"])):
        for name in names:
            sizes = np.array([size(row) for row in several])
            values = np.array([row[name] for row in several])
            c = float(sizes @ values / (sizes @ sizes))
            off = float(np.abs(c * sizes / np.maximum(values, 1) - 1.0).max())
            found[name] = {"c": c, "off": off, "large": c * size(large)}
    return found


def borders(row: dict[str, Any]) -> float:
    """Return the faces between cubes of unknowns, of one of them on average."""
    inner = 1.0 - row["ranks"] ** (-1.0 / 3.0)
    return float(inner * (row["unknowns"] / row["ranks"]) ** (2.0 / 3.0))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object, no more")
    parser.add_argument("--ranks", default="1,2,4,8,16", help="numbers of ranks")
    parser.add_argument("--size", type=int, default=6, help="background cells of the width, 1 rank")
    parser.add_argument("--smoke", action="store_true", help="tiny sizes: does it run?")
    parser.add_argument("--task", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.task:
        result = run(args.task)
        if COMM.rank == 0:
            print(json.dumps(result))
        return
    if args.smoke:
        args.ranks, args.size = "1,2", 5
    rows = []
    for ranks in (int(n) for n in args.ranks.split(",")):
        n = round(args.size * ranks ** (1.0 / 3.0))
        rows.append(launched(ranks, Path(__file__), "--task", str(n)))
        if not args.json:
            told = "{ranks:3d} ranks {domains:7d} domains {unknowns:8.0f} unknowns {its:6.1f} its"
            print(told.format(**rows[-1]), end="")
            print(
                "  uneven {dof_imbalance:.2f} {particle_imbalance:.2f}".format(**rows[-1]), end=""
            )
            print("".join(f"  {k} {rows[-1][k]:8d}" for k in (*BORDER, *WHOLE)), flush=True)
    found = fitted(rows)
    if args.json:
        print(json.dumps({"rows": rows, "fitted": found, "version": mpm.__version__}))
        return
    for name, fit in found.items():
        print(f"{name:12s} c {fit['c']:8.3g}, off by up to {fit['off']:.0%}", end="")
        print(f"; 1e9 domains on 1000 ranks: {fit['large']:.2g} bytes a rank")


if __name__ == "__main__":
    main()
