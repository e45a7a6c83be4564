# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Nitsche's method: the stress of a body's material that presses, as a part of the tangent.

The pressure is that of :func:`.law.traction`, by the traction that :mod:`.behind` takes from the
domains behind the facets. As that depends on the displacement of all nodes of a domain, and with
F-bar on that of a group of domains, so do the forces on both bodies.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..assembly.petsc import MatrixSum
from ..constitutive.averaging import VolumeAveraging
from ..errors import MPMError, not_with
from ..system.term import PointMaterial
from .behind import At, Behind
from .surface import Blocks, PointMatrix, Surface, global_dofs

__all__ = ["Nitsche", "Spread", "require_stress"]

type Array = NDArray[np.float64]


def require_stress(material: PointMaterial | None, what: str) -> None:
    """Raise an error where no material gives the stress behind the facets of a contact.

    Args:
        material: The material of its body.
        what: The class of the contact.

    Raises:
        MPMError: There is none, or it has no stress of the displacement alone.
    """
    instead = "use law='penalty'"
    if material is None:
        raise MPMError(
            f"law='nitsche' of a {what} takes the stress of the body's material, which is in the "
            f"forms of this problem alone; use a QuasiStaticProblem, or {instead}."
        )
    if material.mean_stress is not None:
        raise not_with(
            f"law='nitsche' of a {what}",
            "mixed='pressure', whose stress depends on another field",
            f"{instead}, or f_bar='patch'",
        )


class Spread(NamedTuple):
    """Forces on nodes by units at points, in blocks of points with the same nodes.

    Attributes:
        keys: What each block is known by, shape ``(b,)``.
        facets: Numbers of the points' own facets, shape ``(b,)``.
        dofs: Global dofs of the nodes, shape ``(b, r)``.
        block: Block of each point, shape ``(n,)``.
        forces: Shape ``(n, r)``.
    """

    keys: NDArray[np.int64]
    facets: NDArray[np.int64]
    dofs: NDArray[np.int64]
    block: NDArray[np.int64]
    forces: Array

    @classmethod
    def over_facets(cls, surface: Surface, at: At, forces: Array) -> Spread:
        """Return forces by units at points of a surface, shape ``(n, gdim)``, on its nodes."""
        facets, block = np.unique(at.facets, return_inverse=True)
        dofs = global_dofs(surface.particles.W, surface.layout.nodes[facets])
        on_nodes = surface.shapes[at.places][:, :, None] * forces[:, None]
        return cls(facets, facets, dofs, block, on_nodes.reshape(len(block), dofs.shape[1]))

    @classmethod
    def over_met(
        cls, at: At, met: NDArray[np.int64], dofs: NDArray[np.int64], forces: Array, count: int
    ) -> Spread:
        """Return forces on nodes of facets of another body.

        Args:
            at: The points.
            met: Numbers of the facets that they meet, shape ``(n,)``.
            dofs: Global dofs of these, shape ``(n, k gdim)``.
            forces: By units at the points, shape ``(n, k, gdim)``.
            count: Number of facets of the points' surface.
        """
        keys = met * count + at.facets
        keys, first, block = np.unique(keys, return_index=True, return_inverse=True)
        return cls(keys, at.facets[first], dofs[first], block, forces.reshape(dofs.shape))

    def times(self, values: Array) -> Array:
        """Return the sums of forces times values ``(n, c)``, shape ``(b, r, c)``."""
        total = np.zeros((len(self.keys), self.forces.shape[1], values.shape[1]))
        np.add.at(total, self.block, self.forces[:, :, None] * values[:, None, :])
        return total


class Nitsche:
    """The stress behind the facets of a body as it is now, and what depends on it.

    A body that has another mesh, or another material, needs another one.

    Args:
        surface: The facets.
        material: The body's material.
        spaces: W of the bodies on which forces act.
    """

    def __init__(
        self,
        surface: Surface,
        material: PointMaterial,
        spaces: Sequence[fem.FunctionSpace],
    ) -> None:
        self._surface, self._material = surface, material
        self._spaces = list(spaces)

    @cached_property
    def _behind(self) -> Behind:
        return Behind(self._surface)

    @cached_property
    def _groups(self) -> ThroughGroups | None:
        averaging = self._material.averaging
        if averaging is None:
            return None
        return ThroughGroups(self._behind, averaging, self._spaces)

    def tractions(self, which: NDArray[np.int64] | None = None) -> Array:
        """Return the tractions of the stress at the points, shape ``(m, nq, gdim)``.

        Args:
            which: Numbers of facets; ``None``: all.
        """
        return self._behind.tractions(self._material, which)

    def new_pattern(self) -> None:
        """Forget which blocks there have been (collective)."""
        self._matrices = [PointMatrix(W, self._surface.particles.W) for W in self._spaces]
        if self._groups is not None:
            self._groups.new_pattern()

    def tangents(self, at: At, spreads: Sequence[Spread]) -> list[PETSc.Mat | None]:
        """Return derivatives of forces on the bodies by displacements of that of the facets.

        They are the same objects as before as long as no other blocks come up; ``None`` where
        there has never been any (collective).

        Args:
            at: Points, and directions in which the tractions of the stress count.
            spreads: Forces on nodes of each body by units of these.
        """
        behind = self._behind
        slopes = behind.slopes(self._material, at)
        found = []
        for matrix, spread in zip(self._matrices, spreads, strict=True):
            columns = global_dofs(self._surface.particles.W, behind.nodes[spread.facets])
            blocks = Blocks(spread.keys, spread.dofs, columns, spread.times(slopes))
            found.append(matrix.of(blocks))
        return found if self._groups is None else self._groups.added_to(found, at, spreads)


class ThroughGroups:
    """Part of such derivatives that comes from all points of the groups of F-bar.

    Args:
        behind: The stress behind the facets.
        averaging: F-bar.
        spaces: W of the bodies on which forces act.
    """

    def __init__(
        self, behind: Behind, averaging: VolumeAveraging, spaces: Sequence[fem.FunctionSpace]
    ) -> None:
        self._behind, self._averaging, self._spaces = behind, averaging, spaces
        groups = averaging.groups
        self._size = groups.owned, groups.count
        particles = behind.surface.particles
        self._right = [PointMatrix(self._size, particles.W) for _ in range(2)]
        self._dofs = global_dofs(particles.W, particles.domain_nodes.astype(np.int64))
        self._products: dict[tuple[int, int], tuple[PETSc.Mat, PETSc.Mat, PETSc.Mat]] = {}
        self._sums = [MatrixSum() for _ in spaces]

    def new_pattern(self) -> None:
        """Forget which forces there have been (collective)."""
        self._left = [[PointMatrix(self._size, W) for _ in range(2)] for W in self._spaces]

    def added_to(
        self, matrices: Sequence[PETSc.Mat | None], at: At, spreads: Sequence[Spread]
    ) -> list[PETSc.Mat | None]:
        """Return matrices plus these parts, the same objects for the same ones (collective).

        Args:
            matrices: The rest of what :meth:`Nitsche.tangents` returns.
            at: As there.
            spreads: As there.
        """
        number = self._averaging.groups.number
        _, gamma, _, right = self._averaging.grouped_tangent()
        factors = self._behind.through_groups(self._averaging, at)
        every = np.arange(len(self._dofs))
        rights = [
            matrix.of(_row_blocks(every, number, self._dofs, self._averaging.nodal(part)))
            for matrix, part in zip(self._right, (gamma, right), strict=True)
        ]
        cells, found = self._behind.surface.layout.cells, []
        for i, (K, spread) in enumerate(zip(matrices, spreads, strict=True)):
            parts = []
            for j, (left, factor, other) in enumerate(
                zip(self._left[i], factors, rights, strict=True)
            ):
                values = spread.times(factor[:, None])
                rows = number[cells[spread.facets]]
                L = left.of(_row_blocks(spread.keys, rows, spread.dofs, values))
                if K is not None and L is not None:
                    parts.append(self._product((i, j), L, other))
            found.append(None if K is None else self._sums[i].of([K, *parts]))
        return found

    def _product(self, place: tuple[int, int], left: PETSc.Mat, right: PETSc.Mat) -> PETSc.Mat:
        """Return the product of two matrices, the same object for the same ones (collective)."""
        known = self._products.get(place)
        same = known is not None and known[0] is left and known[1] is right
        product = left.transposeMatMult(right, result=known[2] if known and same else None)
        self._products[place] = left, right, product
        return product


def _row_blocks(
    keys: NDArray[np.int64], rows: NDArray[np.int64], dofs: NDArray[np.int64], values: Array
) -> Blocks:
    """Return entries in some rows, those at dofs ``(m, r)``."""
    return Blocks(keys, rows[:, None], dofs, values.reshape(len(dofs), 1, dofs.shape[1]))
