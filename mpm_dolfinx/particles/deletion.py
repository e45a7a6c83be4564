# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Domains that are deleted when they leave the background."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem, la, mesh

__all__ = ["Deletion"]


class Deletion:
    """Which domains of a body are deleted, and where each was then.

    A deleted domain stays a cell of the body mesh, but no form integrates over it, no row of T
    counts it, and its arrays keep the values of its last converged step.

    Args:
        body: The body mesh.
        W: Space of the domains' displacement.

    Attributes:
        mask: Whether each owned domain is deleted, shape ``(n,)``.
        present: DG0 Function, 1 where a domain is present and 0 where it is deleted.
    """

    def __init__(self, body: mesh.Mesh, W: fem.FunctionSpace) -> None:
        count = body.topology.index_map(body.topology.dim).size_local
        self.mask = np.zeros(count, dtype=bool)
        self.present = fem.Function(
            fem.functionspace(body, ("Discontinuous Lagrange", 0)), name="present"
        )
        self.present.x.array[:] = 1.0
        self._cells = self.present.function_space.dofmap.list[:count, 0]
        self._domains = W.dofmap.list[:count]
        self._nodes = la.vector(W.dofmap.index_map, 1)
        gdim = body.geometry.dim
        self._nodal: NDArray[np.float64] = np.zeros((count, self._domains.shape[1], gdim))
        self.dead = np.zeros(len(self._nodes.array), dtype=bool)

    def add(self, domains: NDArray[np.int64], nodal: NDArray[np.float64]) -> None:
        """Delete domains (collective).

        Args:
            domains: Local indices of this rank's domains to be deleted.
            nodal: Displacement of the nodes of all domains now, shape ``(n, k, gdim)``.
        """
        self.restore(np.isin(np.arange(len(self.mask)), domains) | self.mask, nodal)

    def restore(self, mask: NDArray[np.bool_], nodal: NDArray[np.float64]) -> None:
        """Set which domains are deleted (collective); those that are already stay as they are.

        Args:
            mask: Whether each owned domain is deleted, shape ``(n,)``.
            nodal: Displacement of the nodes of all domains now, shape ``(n, k, gdim)``.
        """
        new = mask & ~self.mask
        self._nodal[new] = nodal[new]
        self.mask = mask.copy()
        self.present.x.array[self._cells] = np.where(self.mask, 0.0, 1.0)
        self.present.x.scatter_forward()
        self._nodes.array[:] = 0.0
        self._nodes.array[self._domains[~self.mask]] = 1.0
        self._nodes.scatter_reverse(la.InsertMode.add)
        self._nodes.scatter_forward()
        self.dead = self._nodes.array == 0.0

    def kept(self, nodal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return displacements ``(n, k, gdim)``, for deleted domains those of their end."""
        return np.where(self.mask[:, None, None], self._nodal, nodal) if self.mask.any() else nodal

    def present_only(self, form: ufl.Form) -> ufl.Form:
        """Return a form on the body mesh that is integrated over present domains only.

        What an integrand is on a deleted domain, whose nodes may have moved on with those of its
        neighbours, does not matter: it may be no number.
        """
        integrals = []
        for integral in form.integrals():
            count = self.present
            if integral.integral_type().startswith("interior_facet"):
                count = self.present("+") * self.present("-")
            integrand = ufl.conditional(ufl.gt(count, 0.5), integral.integrand(), 0.0)
            integrals.append(integral.reconstruct(integrand=integrand))
        return ufl.Form(integrals)
