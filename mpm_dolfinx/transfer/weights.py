# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The published weights of particles in the current configuration."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import basix

from ..background.basis import PointBasis
from ..meshes.quadrature import quadrature_rule

__all__ = ["Weights", "domain_weights", "sum_by_particle"]


class Weights(NamedTuple):
    """Published particle weights in the current configuration, in compressed rows.

    Particle ``p`` has the entries ``offsets[p]:offsets[p + 1]``.

    Attributes:
        offsets: Shape ``(n + 1,)``.
        nodes: Global node (block) numbers of V, shape ``(nnz,)``.
        S: Average of the background basis over the domain, shape ``(nnz,)``.
        grad_S: Average of its gradient, one over length, shape ``(nnz, gdim)``.
    """

    offsets: NDArray[np.int64]
    nodes: NDArray[np.int64]
    S: NDArray[np.float64]
    grad_S: NDArray[np.float64]

    def without(self, left_out: NDArray[np.bool_]) -> Weights:
        """Return the weights, of which some particles have none.

        Args:
            left_out: Whether a particle has none, shape ``(n,)``.
        """
        counts = np.diff(self.offsets)
        kept = np.repeat(~left_out, counts)
        offsets = np.concatenate([[0], np.cumsum(np.where(left_out, 0, counts))]).astype(np.int64)
        return Weights(offsets, self.nodes[kept], self.S[kept], self.grad_S[kept])


def domain_weights(
    corners: NDArray[np.float64], shape_functions: Any, cell: basix.CellType, degree: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Integrate shape functions over the domains in their current shape.

    These are the integrals of Sadeghirad, Brannon & Guilkey (2013, eqs 9-14): over a
    quadrilateral, triangle, hexahedron or tetrahedron with the corners given.

    Args:
        corners: Current positions of the domains' nodes, shape ``(n, k, gdim)``.
        shape_functions: basix element of W.
        cell: Cell type of the domains.
        degree: Degree of the rule; exact for products of two shape functions.

    Returns:
        Volumes ``(n,)``; the averages ``1/V int Q dx``, shape ``(n, k)``; and
        ``1/V int grad Q dx``, shape ``(n, k, gdim)``.
    """
    points, weights = quadrature_rule(cell, degree)
    table = shape_functions.tabulate(1, points)[:, :, :, 0]
    jacobian = np.einsum("jqk,nki->nqij", table[1:], corners)
    measure = weights * np.linalg.det(jacobian)
    volume = measure.sum(axis=1)
    average = np.einsum("nq,qk->nk", measure, table[0]) / volume[:, None]
    gradient = np.einsum("nq,nqji,jqk->nki", measure, np.linalg.inv(jacobian), table[1:])
    return volume, average, gradient / volume[:, None, None]


def sum_by_particle(
    average: NDArray[np.float64],
    gradient: NDArray[np.float64],
    basis: PointBasis,
    domain_nodes: NDArray[np.int32],
) -> Weights:
    """Combine domain averages with the background basis at the domains' nodes.

    ``S_ip = sum_c w_c N_i(x_c)`` and ``grad S_ip = sum_c g_c N_i(x_c)`` (Sadeghirad, Brannon &
    Guilkey 2013, eqs 15 and 16).

    Args:
        average: Weights ``w_c``, shape ``(n, k)``.
        gradient: Gradients ``g_c``, shape ``(n, k, gdim)``.
        basis: Background basis at the local nodes of W.
        domain_nodes: Local nodes of each domain, shape ``(n, k)``.

    Returns:
        The weights, each particle's nodes sorted.
    """
    n, k = domain_nodes.shape
    nodes = basis.nodes[domain_nodes]
    values = basis.values[domain_nodes]
    kept = values != 0.0
    particle = np.broadcast_to(np.arange(n)[:, None, None], nodes.shape)[kept]
    corner = np.broadcast_to(np.arange(k)[None, :, None], nodes.shape)[kept]
    node, value = nodes[kept], values[kept]
    order = np.lexsort((node, particle))
    particle, corner, node, value = particle[order], corner[order], node[order], value[order]
    first = np.ones(len(node), dtype=bool)
    first[1:] = (np.diff(node) != 0) | (np.diff(particle) != 0)
    starts = np.flatnonzero(first)
    counts = np.bincount(particle[starts], minlength=n)
    terms = value[:, None] * np.column_stack(
        [average[particle, corner], gradient[particle, corner]]
    )
    sums = np.add.reduceat(terms, starts, axis=0) if len(starts) else terms
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return Weights(offsets, node[starts], sums[:, 0], sums[:, 1:])
