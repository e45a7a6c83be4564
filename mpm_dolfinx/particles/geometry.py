# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Geometry of one body mesh: spaces, measures, volumes, how its cells can fold."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

import basix
import ufl
from dolfinx import fem, mesh

from .. import _compat
from ..errors import DomainDistortionError, agree
from ..meshes.cells import equispaced_element, input_cell_index
from ..meshes.jacobian_bound import JacobianBound, jacobians
from ..meshes.nodes import node_positions
from ..meshes.order import vtk_cell
from ..meshes.quadrature import (
    DomainQuadrature,
    cell_volumes,
    default_degree,
    exact_degree,
    quadrature_element,
    shape_averages,
)
from .options import Coordinates

__all__ = ["RING", "Geometry"]

#: Corners of a quadrilateral one after the other.
_, RING = vtk_cell(basix.CellType.quadrilateral, 1, 4)


class Geometry:
    """A body mesh with the domains' space and rules, which never change.

    Args:
        body: The mesh.
        family: Family of the displacement's element: Lagrange where neighbours share their
            nodes, discontinuous Lagrange where they do not.
        degree: Degree of the domains' shape functions.
        quadrature_degree: Degree of the rule that carries the history, or ``None`` for the least.

    Attributes:
        mesh: The mesh.
        coordinates: Its coordinates at the beginning.
        gdim: Its dimension.
        W: Space of the domains' displacement.
        shape_functions: basix element of W.
        quadrature_degree: Degree of the rule that carries the history.
        exact_degree: Degree of the rule for body force and mass.
        num_local: Number of domains this rank owns.
        num_global: Number of domains of all ranks.
        global_index: Input index of each owned domain, shape ``(n,)``.
        domain_nodes: Local nodes of W of each owned domain, shape ``(n, k)``.
        nodes: Positions of the local nodes of W, shape ``(N, gdim)``.
    """

    def __init__(
        self, body: mesh.Mesh, family: str, degree: int, quadrature_degree: int | None
    ) -> None:
        self.mesh = body
        self.coordinates = Coordinates(body, "body")
        self.gdim = body.geometry.dim
        cell = body.basix_cell()
        self.W = fem.functionspace(body, (family, degree, (self.gdim,)))
        self.shape_functions = self.W.ufl_element().basix_element
        self.quadrature_degree = (
            default_degree(cell.name, degree) if quadrature_degree is None else quadrature_degree
        )
        self.exact_degree = exact_degree(cell.name, degree)
        cells = body.topology.index_map(body.topology.dim)
        self.num_local = int(cells.size_local)
        self.num_global = int(cells.size_global)
        self.global_index = input_cell_index(body)
        self.domain_nodes: NDArray[np.int32] = self.W.dofmap.list[: self.num_local]
        self.nodes: NDArray[np.float64] = node_positions(self.W)

    # -- Rules ----------------------------------------------------------------------------

    @cached_property
    def dx(self) -> ufl.Measure:
        """Measure with the rule that carries the history."""
        return self._measure(self.quadrature_degree)

    @cached_property
    def dx_exact(self) -> ufl.Measure:
        """Measure exact for body force and mass."""
        return self._measure(self.exact_degree)

    def _measure(self, degree: int) -> ufl.Measure:
        metadata = {"quadrature_degree": degree, "quadrature_rule": "default"}
        return ufl.Measure("dx", domain=self.mesh, metadata=metadata)

    def rule(self) -> DomainQuadrature:
        """Return the history's rule on each owned domain."""
        return DomainQuadrature(self.mesh, self.shape_functions, self.quadrature_degree)

    def exact_rule(self) -> DomainQuadrature:
        """Return the rule exact for body force and mass, many times the size of a body's rest."""
        return DomainQuadrature(self.mesh, self.shape_functions, self.exact_degree)

    def quadrature_function(self, name: str, shape: tuple[int, ...] = ()) -> fem.Function:
        """Return a Function for data at the history's points.

        Args:
            name: Its name.
            shape: Shape of a value.
        """
        element = quadrature_element(
            self.mesh.basix_cell().name, self.quadrature_degree, tuple(shape)
        )
        return fem.Function(fem.functionspace(self.mesh, element), name=name)

    # -- Undeformed cells -----------------------------------------------------------------

    @property
    def corners(self) -> NDArray[np.float64]:
        """Nodes of each domain, shape ``(n, k, gdim)``."""
        return np.asarray(self.nodes[self.domain_nodes])

    @property
    def mesh_nodes(self) -> NDArray[np.float64]:
        """Nodes of the mesh's cells, shape ``(n, k, gdim)``: a mesh of these is the same one.

        :attr:`corners` differ from them by round-off.
        """
        nodes = _compat.geometry_dofmap(self.mesh)[: self.num_local]
        return np.asarray(self.mesh.geometry.x[nodes, : self.gdim])

    @cached_property
    def volumes(self) -> NDArray[np.float64]:
        """Volume of each domain, shape ``(n,)``; an area in the plane."""
        return cell_volumes(self.mesh)

    @cached_property
    def averages(self) -> NDArray[np.float64]:
        """Averages of the shape functions over the domains, shape ``(n, k)``."""
        return shape_averages(self.mesh, self.shape_functions, self.exact_degree)

    def require_volume(self, rule: DomainQuadrature) -> None:
        """Raise an error unless all domains have a volume at the points of a rule (collective).

        Raises:
            DomainDistortionError: Some have none.
        """
        with agree(self.mesh.comm):
            flat = self.global_index[rule.flat]
            if len(flat):
                raise DomainDistortionError(
                    "The domains of {particles} have no volume; mend the body mesh.",
                    flat,
                )

    def outlined(self, domains: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the equispaced nodes of domains that are given by their own nodes.

        Args:
            domains: Nodes of domains, shape ``(n, k, gdim)``.
        """
        degree = self.shape_functions.degree
        if degree == 1:
            return domains
        cell = self.mesh.basix_cell()
        element = equispaced_element(cell, degree, self.gdim).basix_element
        table = self.shape_functions.tabulate(0, element.points)[0, :, :, 0]
        return np.asarray(np.einsum("qk,nki->nqi", table, domains))

    # -- How cells can fold -----------------------------------------------------------------

    @cached_property
    def triangular(self) -> NDArray[np.bool_]:
        """Whether each domain is a quadrilateral with two corners in one place, shape ``(n,)``."""
        if self.mesh.basix_cell() != basix.CellType.quadrilateral:
            return np.zeros(self.num_local, dtype=bool)
        ring = self.corners[:, RING]
        edges = np.linalg.norm(ring - np.roll(ring, 1, axis=1), axis=2)
        return np.asarray(edges.min(axis=1) <= 1e-12 * edges.max(axis=1))

    @cached_property
    def orientation(self) -> NDArray[np.float64]:
        """Sign of the reference map of each domain, shape ``(n,)``."""
        middle = basix.geometry(self.mesh.basix_cell()).mean(axis=0)[None]
        return np.asarray(np.sign(self.jacobians(middle, self.corners)[:, 0]))

    @cached_property
    def jacobian_bound(self) -> JacobianBound:
        """A bound from below of the Jacobian of deformed domains."""
        return JacobianBound(self.mesh.basix_cell(), self.shape_functions)

    def jacobians(
        self, points: NDArray[np.float64], domains: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return det dx/dxi of domains at reference points, shape ``(n, nq)``.

        Args:
            points: Shape ``(nq, tdim)``.
            domains: Nodes of the owned domains, shape ``(n, k, gdim)``.
        """
        return jacobians(self._slopes(points), domains)

    def _slopes(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return derivatives of the shape functions at reference points, ``(tdim, nq, k)``."""
        return np.asarray(self.shape_functions.tabulate(1, points)[1:, :, :, 0])

    @cached_property
    def _corner_slopes(self) -> NDArray[np.float64]:
        """Derivatives of the shape functions at the corners."""
        return self._slopes(basix.geometry(self.mesh.basix_cell()))

    def corner_jacobians(self, domains: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return det dx/dxi at the corners of domains, positive as in the mesh, ``(n, corners)``.

        Args:
            domains: Nodes of the owned domains, shape ``(n, k, gdim)``.
        """
        return self.orientation[:, None] * jacobians(self._corner_slopes, domains)

    def quality(self, domains: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the mean ratio of the deformation of domains at their worst corner, ``(n,)``.

        It is 1 where nothing changes shape, and 0 where a corner is flat or turned inside out
        (Knupp 2001).

        Args:
            domains: Nodes of the owned domains, shape ``(n, k, gdim)``.
        """
        before, after = (
            np.einsum("jqk,nki->nqij", self._corner_slopes, x) for x in (self.corners, domains)
        )
        F = after @ np.linalg.inv(before)
        volume = np.maximum(np.linalg.det(F), 0.0)
        ratio = self.gdim * volume ** (2.0 / self.gdim) / (F**2).sum(axis=(2, 3))
        return np.asarray(ratio.min(axis=1, initial=1.0))
