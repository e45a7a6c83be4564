# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Norms and products whose squares need not be numbers of the machine.

Forces of 1e-200 have squares that underflow to zero, and a residual of norm zero counts as solved.
Where the plain formula is safe it is used, so that ordinary numbers are the same to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from .totals import over_ranks

__all__ = ["joint_norm", "norm", "sign_of_product", "unit_sized"]

FLOAT = np.finfo(float)
#: Sizes whose squares are numbers of all digits, and sums of 1/eps of these too.
SAFE = float(np.sqrt(FLOAT.tiny / FLOAT.eps)), float(np.sqrt(FLOAT.max * FLOAT.eps))


def _exponent(largest: float) -> int:
    return int(np.frexp(largest)[1])


def _is_safe(size: float) -> bool:
    return SAFE[0] < size < SAFE[1]


def unit_sized(v: PETSc.Vec) -> tuple[PETSc.Vec, int]:
    """Return v, or where its square may not be a number v times a power of two (collective).

    Args:
        v: A vector.

    Returns:
        The vector, of size about one where it is not v itself, and the exponent of what it was
        divided by.
    """
    size = v.norm()
    if _is_safe(size) or np.isnan(size):  # (what the largest is of NaN, ranks do not agree on)
        return v, 0
    largest = v.norm(PETSc.NormType.NORM_INFINITY)
    if largest == 0.0 or not np.isfinite(largest):
        return v, 0
    exponent = _exponent(largest)
    scaled = v.copy()
    scaled.array_w[:] = np.ldexp(v.array_r, -exponent)
    return scaled, exponent


def norm(v: PETSc.Vec) -> float:
    """Return the Euclidean norm of a vector, whatever its size (collective)."""
    size = float(v.norm())
    if _is_safe(size) or np.isnan(size):
        return size
    scaled, exponent = unit_sized(v)
    return float(np.ldexp(scaled.norm(), exponent))


def sign_of_product(a: PETSc.Vec, b: PETSc.Vec) -> float:
    """Return a number with the sign of ``a . b``, whatever their sizes (collective)."""
    return float(unit_sized(a)[0].dot(unit_sized(b)[0]))


def joint_norm(
    values: NDArray[np.float64] | Sequence[float], comm: MPI.Comm = MPI.COMM_SELF
) -> float:
    """Return the Euclidean norm of the numbers of all ranks, whatever their size (collective)."""
    if comm.size == 1 and not isinstance(values, np.ndarray):
        return math.hypot(*values)
    array = np.asarray(values, dtype=np.float64)
    with np.errstate(over="ignore"):
        plain = float(np.sqrt(over_ranks(comm, float(array @ array))))
    if _is_safe(plain) or np.isnan(plain):
        return plain
    largest = over_ranks(comm, float(np.abs(array).max(initial=0.0)), MPI.MAX)
    if largest == 0.0 or not np.isfinite(largest):
        return float(largest)
    exponent = _exponent(largest)
    array = np.ldexp(array, -exponent)
    return float(np.ldexp(np.sqrt(over_ranks(comm, float(array @ array))), exponent))
