# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Where Newton's method starts: the last increments of the bodies, extrapolated."""

from __future__ import annotations

from collections.abc import Sequence

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..assembly.petsc import absolute
from ..tolerances import EQUAL, LOCAL_ITERATIONS

__all__ = ["Predictor", "extrapolated", "map_to_background"]

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

    def record(self, size: float, increments: Increments, again: bool = False) -> None:
        """Take note of a converged step.

        Args:
            size: Its size, in load factor or parameter of the path.
            increments: Change of displacement on this rank's own dofs of W, for each body.
            again: Whether it corrects the step before, of which no next one is a continuation.
        """
        if self.moved is not None:
            before = self.moved or [np.zeros_like(u) for u in increments]
            self.moved = [d + u for d, u in zip(before, increments, strict=True)]
        if again:
            return
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
        return extrapolated(self._past, size)


def extrapolated(past: Sequence[tuple[float, Increments]], size: float) -> Increments:
    """Return the increments that follow on those of the last step or two.

    Args:
        past: Sizes of these steps, and their increments.
        size: Size of the next one.
    """
    last, now = past[-1]
    velocities = [d / last for d in now]
    if len(past) == 2:
        first, before = past[0]
        ahead = (size + last) / (last + first)
        velocities = [v + ahead * (v - d / first) for v, d in zip(velocities, before, strict=True)]
    return [size * v for v in velocities]


def map_to_background(
    transfers: Sequence[PETSc.Mat],
    increments: Increments,
    fit: bool = True,
    positive: bool = False,
) -> NDArray[np.float64]:
    """Map increments of the bodies' nodes to the background, so that it gives them back.

    First as MPM maps mass, ``u_i = sum_c |T_ci| w_c / sum_c |T_ci|``, sums over the nodes of all
    bodies (Sulsky, Chen & Schreyer 1994, with equal masses; the basis is positive where it has
    degree 1), which smooths over a cell. Conjugate gradients then lower ``sum_c |w - T u|^2``, with
    these weights as preconditioner: what the background can follow it gives back, such as the
    motion of a body that flows steadily, and few steps leave alone what hardly moves a node.

    Args:
        transfers: T of each body.
        increments: w of each body, on this rank's own dofs of W.
        fit: Whether to lower the gap. Where bodies touch something with a few nodes, an increment
            that is met to the last node carries them through it, and the smooth one does not.
        positive: Whether no entry of T is negative, but for round-off.

    Returns:
        u on this rank's own dofs of V, zero without weight.
    """
    total = transfers[0].createVecRight()
    weight = total.duplicate()
    for T, increment in zip(transfers, increments, strict=True):
        size = T if positive else absolute(T)
        rows = size.createVecLeft()
        rows.array_w[:] = increment
        size.multTransposeAdd(rows, total, total)
        rows.set(1.0)
        size.multTransposeAdd(rows, weight, weight)
    u = total.duplicate()
    seen = weight.array_r > 0.0
    inverse = np.zeros(len(seen))
    inverse[seen] = 1.0 / weight.array_r[seen]
    u.array_w[:] = inverse * total.array_r
    if fit:
        _fit(transfers, increments, inverse, u)
    return np.array(u.array_r)


def _fit(
    transfers: Sequence[PETSc.Mat],
    increments: Increments,
    inverse: NDArray[np.float64],
    u: PETSc.Vec,
) -> None:
    """Lower ``sum_c |w - T u|^2`` by conjugate gradients.

    Args:
        transfers: T of each body.
        increments: w of each body.
        inverse: The preconditioner, a diagonal.
        u: The unknowns; replaced.
    """
    nodal = [T.createVecLeft() for T in transfers]
    rest, image = u.duplicate(), u.duplicate()
    rest.set(0.0)
    for T, w, increment in zip(transfers, nodal, increments, strict=True):
        T.mult(u, w)
        w.array_w[:] = increment - w.array_r
        T.multTransposeAdd(w, rest, rest)
    direction = rest.duplicate()
    direction.array_w[:] = inverse * rest.array_r
    scaled = direction.copy()
    first = size = rest.dot(scaled)
    for _ in range(LOCAL_ITERATIONS):
        if not (np.isfinite(size) and size > EQUAL * first):
            break
        image.set(0.0)
        for T, w in zip(transfers, nodal, strict=True):
            T.mult(direction, w)
            T.multTransposeAdd(w, image, image)
        curvature = direction.dot(image)
        if not curvature > 0.0:
            break
        u.axpy(size / curvature, direction)
        rest.axpy(-size / curvature, image)
        scaled.array_w[:] = inverse * rest.array_r
        before, size = size, rest.dot(scaled)
        direction.aypx(size / before, scaled)
