# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The stress of the domains behind facets, as a traction at the points of these.

With it the pressure of contact is ``p = <n . P N - k g>``: that of the body itself, corrected by a
penalty on the gap g (Nitsche's method in its incomplete form, theta = 0, for one-sided contact:
Chouly, Hild & Renard 2015, Math. Comp. 84, equation 8). Where body and obstacle touch, the gap is
then zero up to errors of discretisation, for any k.

The stress lives at the quadrature points of a domain. A polynomial is fitted to it there, and
taken at the points of a facet.
"""

from __future__ import annotations

from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import basix

from ..constitutive.averaging import VolumeAveraging
from ..meshes.quadrature import quadrature_rule
from ..system.term import PointMaterial
from ..tolerances import SMALL
from .surface import Surface

__all__ = ["At", "Behind", "extrapolation"]

type Array = NDArray[np.float64]


def extrapolation(cell: basix.CellType, points: Array, places: Array, degree: int) -> Array:
    """Return the matrix from values at some points to values at others, by a fitted polynomial.

    Args:
        cell: The cell, of whose coordinates the points are.
        points: Where values are known, shape ``(n, tdim)``.
        places: Where they are asked for, shape ``(m, tdim)``.
        degree: Degree of the shape functions; stresses have one less, on quadrilaterals and
            hexahedra as many, and less where the points do not tell more.

    Returns:
        Shape ``(m, n)``; rows add up to 1.
    """
    simplex = cell in (basix.CellType.triangle, basix.CellType.tetrahedron)
    middle = points.mean(axis=0)
    for most in range(degree - 1 if simplex else degree, 0, -1):
        powers = [p for p in product(range(most + 1), repeat=points.shape[1]) if sum(p) <= most]
        known, asked = (
            np.stack([np.prod((x - middle) ** np.array(p), axis=1) for p in powers], axis=1)
            for x in (points, places)
        )
        sizes = np.linalg.svd(known, compute_uv=False)
        if len(points) >= len(powers) and sizes.min() > SMALL * sizes.max():
            return np.asarray(asked @ np.linalg.pinv(known))
    return np.full((len(places), len(points)), 1.0 / len(points))


class At(NamedTuple):
    """Points on facets, and a direction at each.

    Attributes:
        facets: Numbers of their facets, shape ``(n,)``.
        places: Numbers of the points on these, shape ``(n,)``.
        along: The directions, shape ``(n, gdim)``.
    """

    facets: NDArray[np.int64]
    places: NDArray[np.int64]
    along: Array


class Behind:
    """Tractions ``P N`` at the points of a surface by the stress of the domains behind it.

    They are per undeformed area.

    Args:
        surface: The surface, settled on the present mesh.

    Attributes:
        surface: As given.
        nodes: Local nodes of W of the domain behind each facet, shape ``(m, k)``.
    """

    def __init__(self, surface: Surface) -> None:
        particles = surface.particles
        body = particles.mesh
        cell, gdim = body.basix_cell(), surface.gdim
        self.surface = surface
        self._cells = surface.layout.cells
        self.nodes: NDArray[np.int64] = particles.domain_nodes[surface.layout.cells].astype(
            np.int64
        )
        rule, _ = quadrature_rule(cell, particles.geometry.quadrature_degree)
        degree = int(particles.W.ufl_element().degree)
        taken = np.zeros((len(self._cells), surface.nq, len(rule)))
        for side, places in enumerate(surface.reference_points):
            here = surface.layout.facets == side
            taken[here] = extrapolation(cell, rule, places, degree)
        self._weights = taken[:, :, :, None] * surface.undeformed_normals()[:, :, None, :]
        # What was cut has a gradient of its own, not that of its corners; it is the same everywhere
        # in the cell, so that the traction may be taken from the mesh.
        cut = np.flatnonzero(particles.geometry.triangular[self._cells])
        if len(cut) and particles.undeformed.differs:
            G = np.eye(gdim) + particles.undeformed.reference.gradient[self._cells[cut]]
            normals = surface.mesh_normals()[cut]
            turned = np.einsum("mpJK,mqK->mqpJ", G.swapaxes(2, 3), normals)
            turned *= (taken[cut] / np.linalg.det(G)[:, None])[:, :, :, None]
            self._weights[cut] = turned * surface.mesh_area_ratio[cut, :, None, None]

    def tractions(self, stress: PointMaterial, which: NDArray[Any] | None = None) -> Array:
        """Return the tractions, shape ``(m, nq, gdim)``.

        Args:
            stress: The stress.
            which: Numbers of the facets; ``None``: all.
        """
        chosen = slice(None) if which is None else which
        P = self._of_cells(stress.first_piola, self._cells[chosen])
        return np.asarray(np.einsum("mpiJ,mqpJ->mqi", P, self._weights[chosen]))

    def _of_cells(self, values: Array, cells: NDArray[Any]) -> Array:
        """Return values at all points at those of some cells, in the body's dimensions."""
        count, gdim = self._weights.shape[2], self.surface.gdim
        dim = values.shape[-1]
        found = values.reshape(-1, count, *values.shape[1:])[cells]
        if dim == gdim:
            return np.asarray(found)
        return np.asarray(found[:, :, :gdim, :gdim])

    def slopes(self, stress: PointMaterial, at: At) -> Array:
        """Return the derivatives of tractions in some directions by the domains' nodes.

        Without what F-bar has from other points of a group.

        Args:
            stress: The stress.
            at: Points and directions.

        Returns:
            Shape ``(n, k gdim)``.
        """
        gdim, nq = self.surface.gdim, self.surface.nq
        which, facet = np.unique(at.facets, return_inverse=True)
        along = np.zeros((len(which), nq, gdim))
        along[facet, at.places] = at.along
        cells, M = self._cells[which], self._weights[which]
        A = stress.tangent.reshape(-1, M.shape[2], *stress.tangent.shape[1:])[cells]
        change = np.einsum("fqi,fqpJ,fpiJkL->fqpkL", along, M, A[:, :, :gdim, :gdim], optimize=True)
        gradients = self.surface.particles.undeformed.rule.gradients[cells]
        slopes = np.einsum("fqpkL,fpaL->fqak", change[..., :gdim, :gdim], gradients, optimize=True)
        if stress.strain.hoop is not None:
            slopes[..., 0] += np.einsum(
                "fqp,fpa->fqa", change[..., 2, 2], stress.strain.hoop[cells]
            )
        return np.asarray(slopes[facet, at.places].reshape(len(facet), slopes.shape[2] * gdim))

    def through_groups(self, averaging: VolumeAveraging, at: At) -> tuple[Array, Array]:
        """Return by how much tractions in some directions grow with what is summed over groups.

        Args:
            averaging: F-bar.
            at: Points and directions.

        Returns:
            Factors of the sums of ``gamma : dF`` and of ``right : dF`` (:class:`GroupedTangent`),
            each of shape ``(n,)``.
        """
        h, gamma, left, _ = averaging.grouped_tangent()
        cells, weights = self._cells[at.facets], self._weights[at.facets, at.places]
        whole = h[cells][:, None, None, None] * gamma[cells] + left[cells]
        gdim = self.surface.gdim
        first, second = (
            np.einsum("ni,npJ,npiJ->n", at.along, weights, part[:, :, :gdim, :gdim], optimize=True)
            for part in (whole, gamma[cells])
        )
        return first, second
