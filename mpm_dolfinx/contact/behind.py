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
from typing import Any

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

import basix

from .. import _compat
from ..assembly.petsc import MatrixSum
from ..constitutive.averaging import VolumeAveraging
from ..meshes.quadrature import quadrature_rule
from ..system.term import PointMaterial
from .surface import Surface, global_dofs

__all__ = ["Behind", "ThroughGroups", "extrapolation"]

type Array = NDArray[np.float64]

#: Least ratio of singular values with which a polynomial is fitted.
FITTED = 1e-6


def extrapolation(cell: basix.CellType, points: Array, places: Array, degree: int) -> Array:
    """Return what takes values at some points to values at others, by a fitted polynomial.

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
        if len(points) >= len(powers) and sizes.min() > FITTED * sizes.max():
            return np.asarray(asked @ np.linalg.pinv(known))
    return np.full((len(places), len(points)), 1.0 / len(points))


class Behind:
    """Tractions ``P N`` at the points of a surface by the stress of the domains behind it.

    They are per undeformed area.

    Args:
        surface: The surface, settled on the present mesh.
    """

    def __init__(self, surface: Surface) -> None:
        particles = surface.particles
        body = particles.mesh
        cell, gdim = body.basix_cell(), surface.gdim
        self._surface, self._cells = surface, surface.cells
        self.nodes: NDArray[np.int64] = particles.domain_nodes[surface.cells].astype(np.int64)
        rule, _ = quadrature_rule(cell, particles.quadrature_degree)
        degree = int(particles.W.ufl_element().degree)
        taken = np.zeros((len(self._cells), surface.nq, len(rule)))
        for side, places in enumerate(surface.reference_points):
            here = surface.facets == side
            taken[here] = extrapolation(cell, rule, places, degree)
        self._weights = taken[:, :, :, None] * surface.undeformed_normals()[:, :, None, :]
        # What was cut has a gradient of its own, not that of its corners; it is the same everywhere
        # in the cell, so that the traction may be taken from the mesh.
        cut = np.flatnonzero(particles.triangular[self._cells])
        if len(cut) and particles.rebased:
            G = np.eye(gdim) + particles.reference.gradient[self._cells[cut]]
            normals = surface.mesh_normals()[cut]
            turned = np.einsum("mpJK,mqK->mqpJ", G.swapaxes(2, 3), normals)
            turned *= (taken[cut] / np.linalg.det(G)[:, None])[:, :, :, None]
            self._weights[cut] = turned * surface.mesh_area_ratio[cut, :, None, None]

    def tractions(self, stress: PointMaterial) -> Array:
        """Return the tractions, shape ``(m, nq, gdim)``."""
        P = self._of_cells(stress.first_piola)
        return np.asarray(np.einsum("mpiJ,mqpJ->mqi", P, self._weights))

    def _of_cells(self, values: Array) -> Array:
        """Return values at all points at those behind the facets, in the body's dimensions."""
        count, gdim = self._weights.shape[2], self._surface.gdim
        dim = values.shape[-1]
        found = values.reshape(-1, count, *values.shape[1:])[self._cells]
        if dim == gdim:
            return np.asarray(found)
        return np.asarray(found[:, :, :gdim, :gdim])

    def slopes(self, stress: PointMaterial, along: Array, which: NDArray[np.integer[Any]]) -> Array:
        """Return the derivatives of tractions in some directions by the domains' nodes.

        Without what F-bar has from other points of a group.

        Args:
            stress: The stress.
            along: Directions, shape ``(f, nq, gdim)``.
            which: Numbers of the facets, shape ``(f,)``.

        Returns:
            Shape ``(f, nq, k, gdim)``.
        """
        gdim, cells, M = self._surface.gdim, self._cells[which], self._weights[which]
        A = stress.tangent.reshape(-1, M.shape[2], *stress.tangent.shape[1:])[cells]
        change = np.einsum("fqi,fqpJ,fpiJkL->fqpkL", along, M, A[:, :, :gdim, :gdim], optimize=True)
        gradients = self._surface.particles.quadrature.gradients[cells]
        slopes = np.einsum("fqpkL,fpaL->fqak", change[..., :gdim, :gdim], gradients, optimize=True)
        if stress.hoop is not None:
            slopes[..., 0] += np.einsum("fqp,fpa->fqa", change[..., 2, 2], stress.hoop[cells])
        return np.asarray(slopes)

    def through_groups(self, averaging: VolumeAveraging, along: Array) -> tuple[Array, Array]:
        """Return by how much tractions in some directions grow with what is summed over groups.

        Args:
            averaging: F-bar.
            along: Directions at all points, shape ``(m, nq, gdim)``.

        Returns:
            Factors of the sums of ``gamma : dF`` and of ``right : dF`` (:class:`GroupedTangent`),
            each of shape ``(m, nq)``.
        """
        h, gamma, left, _ = averaging.grouped_tangent()
        whole = h[self._cells][:, None, None, None] * gamma[self._cells] + left[self._cells]
        gdim = self._surface.gdim
        first, second = (
            np.einsum("mqi,mqpJ,mpiJ->mq", along, self._weights, part, optimize=True)
            for part in (whole[:, :, :gdim, :gdim], gamma[self._cells][:, :, :gdim, :gdim])
        )
        return first, second


class ThroughGroups:
    """What tractions of contact have from all points of the groups of F-bar, as a tangent on W.

    Args:
        behind: The stress behind the facets.
        surface: The surface of these.
        averaging: F-bar.
    """

    def __init__(self, behind: Behind, surface: Surface, averaging: VolumeAveraging) -> None:
        self._behind, self._surface, self._averaging = behind, surface, averaging
        particles = surface.particles
        number = averaging.groups.number
        self._left = [self._empty(number[surface.cells], surface.nodes) for _ in range(2)]
        self._right = [self._empty(number, particles.domain_nodes) for _ in range(2)]
        self._products: list[PETSc.Mat | None] = [None, None]
        self._total = MatrixSum()

    def _empty(self, groups: NDArray[np.int64], nodes: NDArray[Any]) -> PETSc.Mat:
        """Return a matrix with a row for each group and the dofs of W as columns (collective).

        Args:
            groups: Groups of some cells, shape ``(m,)``.
            nodes: Their nodes with entries, shape ``(m, k)``.
        """
        W = self._surface.particles.W
        layout, gdim = W.dofmap.index_map, W.dofmap.index_map_bs
        dofs = global_dofs(W, nodes.astype(np.int64))
        rows = np.repeat(groups, dofs.shape[1])
        matrix = PETSc.Mat().create(comm=W.mesh.comm)
        every = self._averaging.groups
        columns = (layout.size_local * gdim, layout.size_global * gdim)
        matrix.setSizes(((every.owned, every.count), columns))
        matrix.setType("aij")
        places = (part.ravel().astype(PETSc.IntType) for part in (rows, dofs))
        _compat.set_entry_places(matrix, *places)
        return matrix

    def added_to(self, K: PETSc.Mat, along: Array, forces: Array) -> PETSc.Mat:
        """Return K on W plus the part, the same object for the same K (collective).

        Args:
            K: The rest of the tangent.
            along: Directions in which tractions of the stress act, shape ``(m, nq, gdim)``.
            forces: What residuals have by a unit of these, of the same shape.
        """
        _, gamma, _, right = self._averaging.grouped_tangent()
        factors = self._behind.through_groups(self._averaging, along)
        shapes = self._surface.shapes
        for matrix, factor in zip(self._left, factors, strict=True):
            nodal = np.einsum("qa,mqi->mai", shapes, factor[:, :, None] * forces)
            _compat.set_entries(matrix, np.ascontiguousarray(nodal).ravel())
        for matrix, part in zip(self._right, (gamma, right), strict=True):
            nodal = self._averaging.nodal(part)
            _compat.set_entries(matrix, np.ascontiguousarray(nodal).ravel())
        products = [
            left.transposeMatMult(other, result=result)
            for left, other, result in zip(self._left, self._right, self._products, strict=True)
        ]
        self._products = list(products)
        return self._total.of([K, *products])
