# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Cures of background dofs that the bodies support badly: here, none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..transfer.touched import TouchedNodes

__all__ = ["Cure"]


class Cure:
    """Decides which dofs of a background space are unknowns, and what ties them together.

    This one takes all dofs with weight for unknowns, and ties none; heirs change what they need.
    All calls are collective.

    Attributes:
        extends: Whether :meth:`extension` has one.
        counts: What :meth:`unknowns` found, by the names of the statistics.
    """

    extends: ClassVar[bool] = False

    def __init__(self) -> None:
        self.counts: dict[str, int] = {}

    @property
    def penalises(self) -> bool:
        """Whether :meth:`penalty` has one now."""
        return False

    def unknowns(self, touched: TouchedNodes, held: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Look at the bodies where they are at the last converged step.

        Args:
            touched: The nodes of V that they touch.
            held: Own dofs of V with a Dirichlet condition or a term on the background.

        Returns:
            Which of this rank's own dofs of V are unknowns, unless they have a condition.
        """
        return touched.on_dofs(touched.has_weight)

    def followers(self, owned: int) -> NDArray[np.bool_]:
        """Return which of this rank's own dofs of V follow others, after :meth:`unknowns`.

        Args:
            owned: Number of own dofs.
        """
        return np.zeros(owned, dtype=bool)

    def extension(self, fixed: NDArray[np.bool_]) -> PETSc.Mat | None:
        """Return E, which gives all dofs of V from the unknowns and the fixed ones.

        Args:
            fixed: Own dofs with a Dirichlet condition, which follow nobody.

        Returns:
            E, or ``None`` where no dof follows others.
        """
        return None

    def penalty(self, moduli: Sequence[float]) -> PETSc.Mat | None:
        """Return an addition to the tangent on all dofs of V, its product one to the residual.

        Args:
            moduli: Shear modulus of each body.
        """
        return None

    def stand_in(self, u: NDArray[np.float64]) -> None:
        """Move values of dofs that are no unknowns to those that stand in for them.

        Args:
            u: Values of this rank's own dofs of V; changed.
        """
