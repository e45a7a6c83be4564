# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Which points slip another way than they did at the tangent before.

The tangent of a point that slips has no stiffness along its slip, whatever holds it in the end.
Where most points of a surface are tried to slip at once nothing holds it, and Newton's method
throws it to the other side of the window in which points stick, and back. A point that has begun to
slip, or has turned round, since the tangent before takes the secant of its friction instead: the
traction over the way from the anchor; and so do all that slip in the first tangent of an attempt.
With the next one it has the derivative again if it goes on, so that the method ends as it does
otherwise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["SlipChanges"]


class SlipChanges:
    """Which points have changed their slip from one tangent of an attempt to the next."""

    def __init__(self) -> None:
        self._last: tuple[NDArray[np.bool_], NDArray[np.float64]] | None = None

    def begin(self) -> None:
        """Begin an attempt."""
        self._last = None

    def note(self, slips: NDArray[np.bool_], shear: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which points slip now and did not before, or the other way, shape ``(n,)``.

        Args:
            slips: Which points slip, shape ``(n,)``.
            shear: Tractions along the surface, shape ``(n, gdim)``.
        """
        last, self._last = self._last, (slips, shear)
        if last is None:
            return slips
        slipped, before = last
        return np.asarray(slips & ~(slipped & ((before * shear).sum(axis=1) > 0.0)))
