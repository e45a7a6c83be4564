# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Where Newton's method starts: the last increments of the bodies, extrapolated."""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

__all__ = ["Predictor", "map_to_background"]

type Increments = list[NDArray[np.float64]]


class Predictor:
    """Extrapolates the bodies' increments of the last two steps to the next.

    The increment over the size of its step is a velocity at the middle of the step; two of them
    give the next by a straight line, one by a constant. All of it lives on the bodies' nodes:
    the background is another one in each step.

    Args:
        predicts: Whether it does; else it takes notes only for those who measure errors by them.

    Attributes:
        moved: Sum of the increments since :meth:`clear`, if that was asked for: empty before the
            first.
    """

    def __init__(self, predicts: bool = True) -> None:
        self._predicts = predicts
        self._past: list[tuple[float, Increments]] = []
        self.moved: Increments | None = None

    @property
    def past(self) -> list[tuple[float, Increments]]:
        """Size and increments of the last steps, two at most."""
        return list(self._past)

    @past.setter
    def past(self, steps: list[tuple[float, Increments]]) -> None:
        self._past = list(steps)

    def clear(self, measures: bool = False) -> None:
        """Forget the past.

        Args:
            measures: Whether to note the motion from now on, for steps chosen by their errors.
        """
        self._past = []
        self.moved = [] if measures else None

    def record(self, size: float, increments: Increments) -> None:
        """Take note of a converged step.

        Args:
            size: Its size, in load factor or parameter of the path.
            increments: Change of displacement on this rank's own dofs of W, for each body.
        """
        if self.moved is not None:
            before = self.moved or [np.zeros_like(u) for u in increments]
            self.moved = [d + u for d, u in zip(before, increments, strict=True)]
        if size <= 0.0:
            self._past = []
        elif self._predicts or self.moved is not None:
            self._past = [*self._past[-1:], (size, increments)]

    def increments(self, size: float) -> Increments | None:
        """Return the increments to expect in a step, ``None`` where there is no past.

        Args:
            size: Size of the step.
        """
        if not self._predicts or not self._past or size <= 0.0:
            return None
        last, now = self._past[-1]
        velocities = [d / last for d in now]
        if len(self._past) == 2:
            first, before = self._past[0]
            ahead = (size + last) / (last + first)
            velocities = [
                v + ahead * (v - d / first) for v, d in zip(velocities, before, strict=True)
            ]
        return [size * v for v in velocities]


def map_to_background(
    transfers: Sequence[PETSc.Mat], increments: Increments
) -> NDArray[np.float64]:
    """Map increments of the bodies' nodes to the background, as MPM maps mass.

    ``u_i = sum_c |T_ci| w_c / sum_c |T_ci|``, the sums over the nodes of all bodies (Sulsky, Chen
    & Schreyer 1994, with equal masses; the basis is positive where it has degree 1).

    Args:
        transfers: T of each body.
        increments: w of each body, on this rank's own dofs of W.

    Returns:
        u on this rank's own dofs of V, zero without weight.
    """
    total = transfers[0].createVecRight()
    weight = total.duplicate()
    for T, increment in zip(transfers, increments, strict=True):
        indptr, columns, values = T.getValuesCSR()
        size = T
        if T.comm.tompi4py().allreduce(bool(values.min(initial=0.0) < 0.0), MPI.LOR):
            size = T.copy()
            size.setValuesCSR(indptr, columns, np.abs(values))
            size.assemble()
        rows = size.createVecLeft()
        rows.array_w[:] = increment
        size.multTransposeAdd(rows, total, total)
        rows.set(1.0)
        size.multTransposeAdd(rows, weight, weight)
    u = np.zeros(total.getLocalSize())
    seen = weight.array_r > 0.0
    u[seen] = total.array_r[seen] / weight.array_r[seen]
    return u
