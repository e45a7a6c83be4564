# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""How T changes as the nodes of a body move: gradients of the background at these.

With v the motion of nodes, ``D_v`` has the rows ``grad N . v``, so that ``D_v y`` is the gradient
of y along v.
"""

from __future__ import annotations

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..particles.field import CarriedField
from ..particles.particles import Particles
from ..transfer.matrix import transfer_matrix

__all__ = ["Slopes", "along"]

type Array = NDArray[np.float64]


class Slopes:
    """Derivatives of functions on V at the nodes of a body, or a field on it (collective).

    Args:
        thing: The body or the field, where it is at the beginning of a step.
    """

    def __init__(self, thing: Particles | CarriedField) -> None:
        basis = thing.node_gradients()
        assert basis.gradients is not None
        self._matrices = [
            transfer_matrix(
                basis._replace(values=np.ascontiguousarray(basis.gradients[:, :, i])),
                thing.W,
                thing.V,
            )
            for i in range(basis.gradients.shape[2])
        ]
        self._components = thing.W.dofmap.index_map_bs

    def of(self, y: PETSc.Vec) -> Array:
        """Return ``grad y`` at own nodes, shape ``(N, components, gdim)`` (collective)."""
        part, found = self._matrices[0].createVecLeft(), []
        for matrix in self._matrices:
            matrix.mult(y, part)
            found.append(part.array_r.reshape(-1, self._components).copy())
        return np.stack(found, axis=2)

    def add_transposed(self, motion: Array, force: PETSc.Vec, total: PETSc.Vec) -> None:
        """Add ``D_v^T r`` to a vector on V (collective).

        Args:
            motion: v at nodes, own ones first, shape ``(N, gdim)``.
            force: r on W.
            total: To be added to.
        """
        at_nodes, part = force.array_r.reshape(-1, self._components), force.duplicate()
        for i, matrix in enumerate(self._matrices):
            part.array_w[:] = (at_nodes * motion[: len(at_nodes), i, None]).ravel()
            matrix.multTransposeAdd(part, total, total)


def along(slope: Array, motion: Array) -> Array:
    """Return ``D_v y`` at own nodes, on dofs of W.

    Args:
        slope: See :meth:`Slopes.of`.
        motion: v at nodes, own ones first, shape ``(N, gdim)``.
    """
    moved: Array = np.einsum("nci,ni->nc", slope, motion[: len(slope)])
    return moved.ravel()
