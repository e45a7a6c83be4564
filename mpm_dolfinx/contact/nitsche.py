# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Nitsche's method for a body on an obstacle: the stress of its material, as a part of the tangent.

The pressure is that of :func:`.law.nitsche`, by the traction that :mod:`.behind` takes from the
domains behind the facets. As that depends on the displacement of all nodes of a domain, and with
F-bar on that of a group of domains, so do the forces.
"""

from __future__ import annotations

from functools import cached_property

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..system.term import PointMaterial
from .behind import Behind, ThroughGroups
from .surface import Blocks, Surface, global_dofs

__all__ = ["Nitsche"]


class Nitsche:
    """The stress behind the facets of a body as it is now, and what depends on it.

    A body that has another mesh, or another material, needs another one.

    Args:
        surface: The facets.
        material: The body's material.
    """

    def __init__(self, surface: Surface, material: PointMaterial) -> None:
        self._surface, self._material = surface, material

    @cached_property
    def _behind(self) -> Behind:
        return Behind(self._surface)

    @cached_property
    def _groups(self) -> ThroughGroups | None:
        averaging = self._material.averaging
        if averaging is None:
            return None
        return ThroughGroups(self._behind, self._surface, averaging)

    def tractions(self) -> NDArray[np.float64]:
        """Return the tractions of the stress at the points, shape ``(m, nq, gdim)``."""
        return self._behind.tractions(self._material)

    def blocks(
        self,
        which: NDArray[np.int64],
        rows: NDArray[np.int64],
        along: NDArray[np.float64],
        force: NDArray[np.float64],
    ) -> Blocks:
        """Return what residuals have from displacements of the domains behind some facets.

        Args:
            which: The facets.
            rows: Dofs of their nodes.
            along: Normals of the obstacle at all points, shape ``(m, nq, gdim)``.
            force: What residuals have at all points by traction along these, of the same shape.
        """
        behind, N = self._behind, self._surface.shapes
        slopes = behind.slopes(self._material, along[which], which)
        blocks = np.einsum("qa,mqi,mqbj->maibj", N, force[which], slopes, optimize=True)
        columns = global_dofs(self._surface.particles.W, behind.nodes[which])
        shape = (len(which), rows.shape[1], columns.shape[1])
        return Blocks(which, rows, columns, blocks.reshape(shape))

    def with_groups(
        self, K: PETSc.Mat, along: NDArray[np.float64], force: NDArray[np.float64]
    ) -> PETSc.Mat:
        """Return a tangent on W plus what tractions have through the groups of F-bar (collective).

        Args:
            K: The tangent.
            along: As for :meth:`blocks`.
            force: As there.
        """
        return K if self._groups is None else self._groups.added_to(K, along, force)
