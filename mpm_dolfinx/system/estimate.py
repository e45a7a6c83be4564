# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""An estimate of the error by the forces that the background cannot see."""

from __future__ import annotations

from collections.abc import Iterable

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import la

from ..assembly.blocks import Restriction
from ..assembly.fused import FusedTangent
from ..background.basis import PointBasis
from ..history import Statistics
from ..particles.particles import Particles
from ..tolerances import SMALL
from ..transfer.matrix import transfer_matrix
from ..transfer.touched import TouchedNodes
from .term import Term

__all__ = ["nodal_errors", "shares_of_domains"]


def nodal_errors(
    particles: Particles,
    terms: Iterable[Term],
    force: NDArray[np.float64],
    free: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return ``R_I . K_II^-1 R_I`` of a body's nodes (collective).

    In equilibrium ``T^T R = 0``: R is orthogonal to all that the background can do, and is what is
    left of it in the body's own finite elements. The estimate is the energy of one Jacobi step
    with blocks of nodes towards their equilibrium (Babuska & Rheinboldt 1978 take a patch for each
    node, and this its inner node alone).

    Args:
        particles: The body.
        terms: All that acts, as evaluated last.
        force: R on this rank's own dofs of W.
        free: Share of the motion of each of these that is not prescribed; the rest of R is a
            reaction.

    Returns:
        Squares of energies, at this rank's own nodes, shape ``(N,)``.
    """
    bs = particles.W.dofmap.index_map_bs
    residual = (force * free).reshape(-1, bs)
    moves = free.reshape(-1, bs) > 0.0
    blocks = np.zeros((*moves.shape, bs))
    for matrix in _tangents(particles, terms):
        _add_blocks(matrix, blocks)
    blocks = 0.5 * (blocks + blocks.swapaxes(1, 2)) * (moves[:, :, None] & moves[:, None, :])
    sizes, axes = np.linalg.eigh(blocks)
    largest = np.abs(sizes).max(axis=1, initial=0.0, keepdims=True)
    along = np.einsum("nij,ni->nj", axes, residual)
    moves = largest > 0.0
    # (what yields is soft, not without any stiffness)
    stiffness = np.maximum(np.abs(sizes), SMALL * largest)
    return np.asarray(
        (np.where(moves, along**2, 0.0) / np.where(moves, stiffness, 1.0)).sum(axis=1)
    )


def _tangents(particles: Particles, terms: Iterable[Term]) -> list[PETSc.Mat]:
    """Return the parts of the derivative of a body's forces by its own displacement, on W."""
    W = particles.W
    layout, bs = W.dofmap.index_map, W.dofmap.index_map_bs
    local = np.arange(layout.size_local + layout.num_ghosts, dtype=np.int32)
    nodes = layout.local_to_global(local)[:, None]
    itself = PointBasis(nodes, np.ones(nodes.shape), np.ones(len(nodes), dtype=bool))
    identity = transfer_matrix(itself, W, W)
    found = []
    for term in terms:
        if particles not in term.bodies:
            continue
        number = term.bodies.index(particles)
        found += [K for pair, K in term.tangents().items() if pair == (number, number)]
        if term.bodies == (particles,):
            found += term.reduced_tangents(lambda _: identity)
    fused = [pair for term in terms for pair in term.fused if pair[0] is particles]
    if fused:
        touched = TouchedNodes(W, [itself], [layout.size_local])
        own, first = layout.size_local * bs, layout.local_range[0] * bs
        numbers = np.arange(first, first + own, dtype=np.int32)
        every = Restriction(touched, touched.rows * len(fused), numbers, slice(0, own))
        loops = FusedTangent(W.mesh.comm, [fused], [], Statistics())
        loops.restrict([every], (own, layout.size_global * bs))
        found.append(loops.assemble())
    return found


def _add_blocks(matrix: PETSc.Mat, blocks: NDArray[np.float64]) -> None:
    """Add the diagonal blocks of a matrix to those of the nodes that this rank owns."""
    offsets, columns, values = matrix.getValuesCSR()
    bs = blocks.shape[1]
    rows = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    first = matrix.getOwnershipRange()[0] // bs
    near = columns // bs == rows // bs + first
    rows, columns = rows[near], columns[near]
    np.add.at(blocks, (rows // bs, rows % bs, columns % bs), values[near])


def shares_of_domains(particles: Particles, nodal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return values of nodes in equal shares on the domains around them (collective).

    Args:
        particles: The body.
        nodal: At this rank's own nodes of W, shape ``(N,)``.

    Returns:
        At this rank's own domains, shape ``(n,)``.
    """
    layout, domains = particles.W.dofmap.index_map, particles.domain_nodes
    count, value = la.vector(layout), la.vector(layout)
    count.array[:] = 0.0
    np.add.at(count.array, domains[~particles.deleted], 1.0)
    count.scatter_reverse(la.InsertMode.add)
    own = slice(0, len(nodal))
    value.array[own] = nodal / np.maximum(count.array[own], 1.0)
    value.scatter_forward()
    return np.where(particles.deleted, 0.0, value.array[domains].sum(axis=1))
