# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Which solver takes the tangents of how many unknowns, as timed."""

from __future__ import annotations

from typing import Any, NamedTuple

__all__ = ["LINEAR_SOLVERS", "STRATEGIES", "Strategy", "mumps_options"]

#: Values of ``linear_solver``.
LINEAR_SOLVERS = ("auto", "direct", "multigrid")


class Strategy(NamedTuple):
    """Numbers of unknowns at which solvers take turns, in one dimension of space.

    Attributes:
        few: Most whose tangent PETSc's own Cholesky factorises: of so few MUMPS takes more to set
            a factor up than to compute it.
        ordered: Least from which PORD orders MUMPS's factors: plane graphs three times as fast as
            METIS and no worse, in space worse. It ends the process where all unknowns are
            neighbours of each other, as few may be.
        compressed: Least from which MUMPS's factors have blocks of low rank.
        crossover: Least from which on multigrid takes less time than a factorisation: where boxes
            follow the tangent and that is symmetric, and where not.
        bearable: Power p and divisor d: with n unknowns ``n^p / d`` iterations for a decade of the
            residual cost as much as a factor, whose operations grow as n^2 in space.
        taken_over: Most up to which a factorisation takes over where multigrid comes to nothing.
    """

    few: int = 0
    ordered: int | None = None
    compressed: int | None = None
    crossover: tuple[int, int] | None = None
    bearable: tuple[float, float] | None = None
    taken_over: int = 0


#: Blocks of low rank of MUMPS's factors, to a share of their size.
LOW_RANK = {"mat_mumps_icntl_35": 1, "mat_mumps_cntl_7": 1e-4}

#: By dimension of space; each number where two solvers took the same time on one machine.
STRATEGIES = {
    1: Strategy(),
    2: Strategy(
        few=400,
        ordered=10000,
        crossover=(40000, 40000),
        bearable=(0.5, 30.0),
        taken_over=500000,
    ),
    3: Strategy(
        few=150,
        compressed=20000,
        crossover=(3000, 8000),
        bearable=(1.0, 450.0),
        taken_over=50000,
    ),
}


def mumps_options(
    strategy: Strategy, size: int, saddle: bool, compressed: bool, ranks: int
) -> dict[str, Any]:
    """Return the options of MUMPS unless others are given.

    Args:
        strategy: What suits the dimension.
        size: Number of unknowns.
        saddle: Whether the diagonal says nothing of the size of a row: rows and columns are scaled
            in turn then, else by the diagonal, as the shift is.
        compressed: Whether factors have blocks of low rank.
        ranks: How many ranks have rows. Of several MUMPS scales in turn or not at all.
    """
    scaling = 7 if saddle or ranks > 1 else 1
    options = {"mat_mumps_icntl_8": scaling, "mg_coarse_mat_mumps_icntl_8": scaling}
    if strategy.ordered is not None and size >= strategy.ordered:
        options["mat_mumps_icntl_7"] = 4
    return {**options, **(LOW_RANK if compressed else {})}
