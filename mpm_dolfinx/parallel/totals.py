# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Values of all ranks made one, which costs nothing where there is one rank.

mpi4py pickles what it reduces, on a single rank too: 6 microseconds a call, of which a step of few
cells makes some twenty.
"""

from __future__ import annotations

from mpi4py import MPI

__all__ = ["over_ranks"]


def over_ranks[T](comm: MPI.Comm, value: T, op: MPI.Op = MPI.SUM) -> T:
    """Return ``comm.allreduce(value, op)``, or the value itself on a single rank (collective).

    Args:
        comm: The ranks.
        value: What this rank has: a number or a truth.
        op: What makes one of two.
    """
    if comm.size == 1:
        return value
    result: T = comm.allreduce(value, op)
    return result
