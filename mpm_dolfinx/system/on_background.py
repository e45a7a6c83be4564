# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Forces on a background itself: terms of the user's on it, and the ghost penalty."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..assembly.background_forms import BackgroundForms
from ..assembly.blocks import no_ties
from ..parallel.magnitudes import norm
from ..stabilisation.ghost_penalty import GhostPenalty
from ..transfer.touched import TouchedNodes

__all__ = ["OnBackground"]


class OnBackground:
    """Forces on the dofs of one background by its own increment. All calls are collective.

    Args:
        forms: Terms on it; ``None``: none.
        ghosts: Penalty on dofs that the bodies support badly; ``None``: nothing.

    Attributes:
        moduli: Shear modulus of each body as the first step with a penalty begins, which is scaled
            by them; ``None`` before.
    """

    def __init__(self, forms: BackgroundForms | None, ghosts: GhostPenalty | None) -> None:
        self._forms, self._ghosts = forms, ghosts
        self.moduli: list[float] | None = None
        self._penalty: PETSc.Mat | None = None
        self._reduced_penalty: PETSc.Mat | None = None
        self._product: PETSc.Mat | None = None

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of badly supported dofs, by the names of the statistics."""
        return {} if self._ghosts is None else self._ghosts.counts

    @property
    def lasts(self) -> bool:
        """Whether unknowns are the same as long as nothing moves."""
        return self._ghosts is None

    def unknowns(self, touched: TouchedNodes) -> NDArray[np.bool_]:
        """Return which own dofs of V are unknowns, but for conditions, and tie cells together."""
        ghosts = self._ghosts
        free = touched.on_dofs(touched.has_weight if ghosts is None else ghosts.tie(touched))
        if self._forms is not None:
            free[self._forms.support()] = True
        return np.asarray(free)

    def ties(
        self, touched: TouchedNodes, numbers: NDArray[np.int32], unknowns: int
    ) -> NDArray[np.int32]:
        """Return the blocks of the penalty: first row, height, first column, width of each.

        Args:
            touched: The nodes that bodies touch.
            numbers: Number of the unknown of each own dof of V, or -1, shape ``(n, bs)``.
            unknowns: Number of all unknowns.
        """
        if self._ghosts is None or not self._ghosts.acts:
            return no_ties
        counts, step = np.count_nonzero(numbers >= 0, axis=1), numbers.shape[1] + 1
        firsts = np.where(numbers >= 0, numbers, numbers.max(axis=1, keepdims=True)).min(axis=1)
        known = touched.at_nodes(firsts.astype(np.int64) * step + counts, self._ghosts.tied)
        pairs = np.broadcast_arrays(known[:, :, None], known[:, None, :])
        span = step * max(unknowns, 1)
        rows, columns = np.divmod(np.unique(pairs[0] * span + pairs[1]), span)
        blocks = np.column_stack([*np.divmod(rows, step), *np.divmod(columns, step)])
        return blocks[(blocks[:, 1] > 0) & (blocks[:, 3] > 0)].astype(np.int32)

    def renew(self) -> None:
        """Begin with other unknowns."""
        self._penalty = self._reduced_penalty = self._product = None

    def scale(self, moduli: Callable[[], list[float]]) -> None:
        """Take the shear moduli of the bodies as a step begins, if the penalty needs them."""
        if self._ghosts is not None and self._ghosts.acts and self.moduli is None:
            self.moduli = moduli()

    def add_residual(self, u: PETSc.Vec, force: PETSc.Vec) -> None:
        """Add the forces at the increment u, on all dofs of V, to others."""
        if self._forms is not None:
            force.axpy(1.0, self._forms.assemble_residual())
        penalty = self._matrix()
        if penalty is not None and norm(u) > 0.0:
            penalty.multAdd(u, force, force)

    def add_product(self, u: PETSc.Vec, force: PETSc.Vec) -> None:
        """Add the product of their tangents, on all dofs of V, with an increment."""
        if self._forms is not None:
            self._forms.assemble_tangent().multAdd(u, force, force)
        if (penalty := self._matrix()) is not None:
            penalty.multAdd(u, force, force)

    def tangents(self, prolongation: PETSc.Mat) -> list[PETSc.Mat]:
        """Return their tangents in the unknowns, by what gives increments of V from these."""
        found = []
        if self._forms is not None:
            whole = self._forms.assemble_tangent()
            self._product = whole.ptap(prolongation, result=self._product)
            found.append(self._product)
        if (penalty := self._matrix()) is not None:
            if self._reduced_penalty is None:
                self._reduced_penalty = penalty.ptap(prolongation)
            found.append(self._reduced_penalty)
        return found

    def penalty_force(self, u: PETSc.Vec, moduli: Sequence[float]) -> PETSc.Vec:
        """Return the force of the penalty at an increment with shear moduli."""
        force = u.duplicate()
        force.set(0.0)
        if self._ghosts is not None and self._ghosts.acts:
            self._ghosts.penalty(moduli).mult(u, force)
        return force

    def _matrix(self) -> PETSc.Mat | None:
        """Return the step's penalty on all dofs of V, if there is one."""
        if self._ghosts is None or not self._ghosts.acts:
            return None
        if self._penalty is None:
            assert self.moduli is not None
            self._penalty = self._ghosts.penalty(self.moduli)
        return self._penalty
