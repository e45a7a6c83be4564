# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Averages of values at the points of a body over a length, in the undeformed body.

The average k of values v solves ``k - length^2 div grad k = v`` with ``dk/dn = 0`` on the boundary
(Peerlings, de Borst, Brekelmans & de Vree 1996, Int. J. Numer. Meth. Engng 39), by finite elements
on the body's mesh: nothing spreads from a body to another or over a crack.
"""

from __future__ import annotations

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..errors import ConvergenceError
from ..meshes.quadrature import DomainQuadrature, exact_degree
from ..parallel.conjugate_gradients import conjugate_gradients
from ..parallel.totals import over_ranks
from ..particles.particles import require_shared_nodes
from .strain import Strain

__all__ = ["GradientAverage"]

type Array = NDArray[np.float64]


class GradientAverage:
    """An average over a length, of some of a body's domains (collective).

    Args:
        strain: What the points of the body are strained in.
        length: The length.
        counts: Whether a domain takes part, shape ``(n,)``; others neither give nor take.

    Attributes:
        length: As given.

    Raises:
        MPMError: Domains do not share their nodes.
    """

    def __init__(self, strain: Strain, length: float, counts: NDArray[np.bool_]) -> None:
        body = strain.particles
        require_shared_nodes("length=", body)
        self._strain, self._body, self.length, self._counts = strain, body, length, counts
        self._comm: MPI.Comm = body.mesh.comm
        index_map = body.W.dofmap.index_map
        self._sizes = index_map.size_local, index_map.size_global
        self._ghosts = index_map.ghosts.astype(PETSc.IntType)
        numbers = index_map.local_to_global(body.domain_nodes.ravel())
        self._numbers = numbers.reshape(body.domain_nodes.shape).astype(PETSc.IntType)
        self._present: NDArray[np.bool_] | None = None
        self._ksp = conjugate_gradients(self._comm)

    def _vector(self) -> PETSc.Vec:
        vector = PETSc.Vec().createGhost(self._ghosts, self._sizes, comm=self._comm)
        vector.set(0.0)
        with vector.localForm() as local:
            local.set(0.0)
        return vector

    def _prepare(self) -> None:
        """Make the matrix, at first and where domains have been deleted (collective)."""
        present = self._counts & ~self._body.deleted
        same = self._present is not None and np.array_equal(present, self._present)
        if over_ranks(self._comm, same, MPI.LAND):
            return
        self._present = present
        mesh, element = self._body.mesh, self._body.W.sub(0).element.basix_element
        exact = exact_degree(mesh.topology.cell_name(), element.degree)
        around = self._strain.hoop is not None
        rule = DomainQuadrature(mesh, element, exact + around)
        weights = np.where(present[:, None], rule.weights, 0.0)
        if around:
            radius = self._body.W.tabulate_dof_coordinates()[self._body.domain_nodes, 0]
            weights = weights * (2.0 * np.pi * radius @ rule.shapes.T)
        blocks = np.einsum("nq,qk,ql->nkl", weights, rule.shapes, rule.shapes)
        slopes = rule.gradients * np.sqrt(np.abs(weights) * self.length**2)[:, :, None, None]
        blocks += np.einsum("nqki,nqli->nkl", slopes, slopes)
        n, k = self._numbers.shape
        rows = np.broadcast_to(self._numbers[:, :, None], (n, k, k))
        columns = np.broadcast_to(self._numbers[:, None, :], (n, k, k))
        matrix = PETSc.Mat().create(self._comm)
        matrix.setSizes((self._sizes, self._sizes))
        matrix.setType("aij")
        begin = self._body.W.dofmap.index_map.local_range[0]
        own = np.arange(begin, begin + self._sizes[0], dtype=PETSc.IntType)
        matrix.setPreallocationCOO(
            np.concatenate([rows.ravel(), own]), np.concatenate([columns.ravel(), own])
        )
        matrix.setValuesCOO(
            np.concatenate([blocks.ravel(), np.zeros(len(own))]), PETSc.InsertMode.ADD_VALUES
        )
        diagonal = matrix.getDiagonal()
        diagonal.array_w[diagonal.array_r == 0.0] = 1.0
        matrix.setDiagonal(diagonal)
        self._ksp.setOperators(matrix)

    def of(self, values: Array) -> Array:
        """Return the average of values at the points, ``(n, nq)``, at the same (collective).

        Raises:
            ConvergenceError: It is not found, as values are not finite.
        """
        self._prepare()
        assert self._present is not None
        shapes, nodes = self._body.undeformed.rule.shapes, self._body.domain_nodes
        volumes = np.where(self._present[:, None], self._strain.volumes(), 0.0)
        loads = np.einsum("nq,nq,qk->nk", volumes, np.where(volumes > 0.0, values, 0.0), shapes)
        b, x = self._vector(), self._vector()
        with b.localForm() as local:
            np.add.at(local.array_w, nodes, loads)
        b.ghostUpdate(PETSc.InsertMode.ADD_VALUES, PETSc.ScatterMode.REVERSE)
        self._ksp.solve(b, x)
        if self._ksp.getConvergedReason() < 0:
            raise ConvergenceError(
                f"The average of the plastic strain over the length {self.length:g} was not found"
            )
        x.ghostUpdate(PETSc.InsertMode.INSERT_VALUES, PETSc.ScatterMode.FORWARD)
        with x.localForm() as local:
            found = local.array_r[nodes] @ shapes.T
        return np.asarray(np.where(self._present[:, None], found, 0.0))
