# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Domains of particles: a body mesh, the displacement of its cells, and their measures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import basix
import ufl
from dolfinx import fem, mesh

from ..meshes.quadrature import DomainQuadrature, quadrature_rule, volume_ratio, with_hoop
from .deletion import Deletion
from .geometry import Geometry
from .undeformed import Undeformed, reach_behind_axis

__all__ = ["Domains"]


class Domains:
    """The cells of a body mesh as domains that a displacement deforms.

    What moves the domains is not known here.

    Attributes:
        geometry: The mesh and what follows from it alone.
        undeformed: The undeformed body, and the rule that carries the history in it.
        displacement: Total displacement d in W.
        deletion: Which domains are deleted, or ``None`` where none may be.
    """

    def _live_on(self, geometry: Geometry, undeformed: Undeformed, deletable: bool) -> None:
        """Take the cells of a mesh, where nothing is displaced, for the domains (collective).

        Args:
            geometry: The mesh and what follows from it.
            undeformed: What the domains are counted from.
            deletable: Whether domains may be deleted.
        """
        self.geometry, self.undeformed = geometry, undeformed
        self.displacement = fem.Function(geometry.W, name="displacement")
        self.deletion = Deletion(geometry.mesh, geometry.W) if deletable else None

    def allow_deletion(self, allowed: bool) -> None:
        """Let domains be deleted, or no longer, where none of them is (collective)."""
        if not allowed:
            self.deletion = None
        elif self.deletion is None:
            self.deletion = Deletion(self.geometry.mesh, self.geometry.W)

    # -- The mesh -------------------------------------------------------------------------

    @property
    def mesh(self) -> mesh.Mesh:
        """The body mesh, undeformed."""
        return self.geometry.mesh

    @property
    def W(self) -> fem.FunctionSpace:
        """Space of the domains' displacement."""
        return self.geometry.W

    @property
    def dx(self) -> ufl.Measure:
        """Measure with the rule that carries the history."""
        return self.geometry.dx

    @property
    def dx_exact(self) -> ufl.Measure:
        """Measure exact for body force and mass."""
        return self.geometry.dx_exact

    @property
    def num_local(self) -> int:
        """Number of domains this rank owns."""
        return self.geometry.num_local

    @property
    def num_global(self) -> int:
        """Number of domains of all ranks."""
        return self.geometry.num_global

    @property
    def global_index(self) -> NDArray[np.int64]:
        """Input index of each owned domain, shape ``(n,)``."""
        return self.geometry.global_index

    @property
    def domain_nodes(self) -> NDArray[np.int32]:
        """Local nodes of W of each owned domain, shape ``(n, k)``."""
        return self.geometry.domain_nodes

    @property
    def quadrature_degree(self) -> int:
        """Degree of the rule that carries the history."""
        return self.geometry.quadrature_degree

    @property
    def quadrature(self) -> DomainQuadrature:
        """The rule that carries the history, on each owned domain."""
        return self.undeformed.rule

    def quadrature_function(self, name: str, shape: tuple[int, ...] = ()) -> fem.Function:
        """Return a Function for data at the history's points, to be injected into a form.

        Args:
            name: Its name.
            shape: Shape of a value.

        Returns:
            Function on a quadrature element, integrated with ``particles.dx``. Its values
            cell by cell are ``f.x.array.reshape(-1, nq, *shape)``.
        """
        return self.geometry.quadrature_function(name, shape)

    @property
    def num_points(self) -> int:
        """Number of quadrature points of each domain."""
        return int(self.quadrature.weights.shape[1])

    def of_domains(self, nodal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return displacements of nodes ``(N, gdim)`` for each domain, shape ``(n, k, gdim)``."""
        values: NDArray[np.float64] = nodal[self.domain_nodes]
        return values if self.deletion is None else self.deletion.kept(values)

    def _nodal(self) -> NDArray[np.float64]:
        """Displacement of the domains' nodes now, shape ``(n, k, gdim)``."""
        nodal = self.displacement.x.array.reshape(-1, self.geometry.gdim)
        return self.of_domains(np.asarray(nodal, dtype=np.float64))

    def _corners(self) -> NDArray[np.float64]:
        """Positions of the domains' nodes now, shape ``(n, k, gdim)``."""
        return np.asarray(self.geometry.corners + self._nodal())

    def displacement_gradient(self, axisymmetric: bool = False) -> NDArray[np.float64]:
        """Return ``grad d`` at the history's points.

        Args:
            axisymmetric: Whether to add the hoop stretch ``d_r / R``.

        Returns:
            Shape ``(n, nq, gdim, gdim)``, or ``(n, nq, 3, 3)`` where axisymmetric.
        """
        if self.deletion is None:
            gradient = self.undeformed.gradient(np.asarray(self.displacement.x.array))
        else:
            gradient = self.undeformed.gradient_of(self._nodal())
        if not axisymmetric:
            return gradient
        moved = self._nodal()
        if self.undeformed.differs:
            moved = self._corners() - self.undeformed.domains
        return with_hoop(gradient, self.undeformed.hoop, moved)

    def point_volumes(self, axisymmetric: bool = False) -> NDArray[np.float64]:
        """Return the reference volume of the history's points, shape ``(n, nq)``.

        Args:
            axisymmetric: Whether it is that of a body of revolution, all around.
        """
        return self.undeformed.point_volumes(axisymmetric)

    @property
    def deleted(self) -> NDArray[np.bool_]:
        """Whether each particle this rank owns is deleted, shape ``(n,)``."""
        if self.deletion is None:
            return np.zeros(self.num_local, dtype=bool)
        return self.deletion.mask

    @property
    def initial_domains(self) -> NDArray[np.float64]:
        """Corners of the undeformed domains, shape ``(n, k, gdim)``."""
        return self.undeformed.domains.copy()

    @property
    def initial_volume(self) -> NDArray[np.float64]:
        """Volume of the undeformed domains, shape ``(n,)``; an area in the plane."""
        return self.undeformed.volume.copy()

    @property
    def volume(self) -> NDArray[np.float64]:
        """Volume of the domains now, shape ``(n,)``; an area in the plane."""
        exact = self.geometry.exact_rule()
        ratio = volume_ratio(exact.displacement_gradient(self._nodal()))
        return np.asarray((exact.weights * ratio).sum(axis=1))

    @property
    def initial_centroid(self) -> NDArray[np.float64]:
        """Centroid of the undeformed domains, shape ``(n, gdim)``."""
        return self.mean(self.initial_domains)

    @property
    def centroid(self) -> NDArray[np.float64]:
        """Particle positions: mean of ``X + d`` over the domains, shape ``(n, gdim)``."""
        return self.mean(self._corners())

    @property
    def initial_points(self) -> NDArray[np.float64]:
        """Undeformed positions of the quadrature points, shape ``(n, nq, gdim)``."""
        return self.at_points(self.initial_domains)

    @property
    def points(self) -> NDArray[np.float64]:
        """Positions of the quadrature points, shape ``(n, nq, gdim)``."""
        return self.at_points(self._corners())

    def mean(self, nodal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return averages over the undeformed domains of values at nodes ``(n, k, gdim)``."""
        return np.asarray(np.einsum("nk,nki->ni", self.undeformed.averages, nodal))

    def at_points(self, nodal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return values at the domains' nodes, ``(n, k, gdim)``, at the history's points.

        The point of a triangle that was cut from a quadrilateral is its centroid.
        """
        points = np.asarray(np.einsum("qk,nki->nqi", self.quadrature.shapes, nodal))
        cut = self.geometry.triangular
        if cut.any():
            averages = self.geometry.averages[cut]
            points[cut] = np.einsum("nk,nki->ni", averages, nodal[cut])[:, None]
        return points

    def inverted(self) -> NDArray[np.int64]:
        """Return global indices of domains with ``det F <= 0`` or not finite at a point."""
        positive = volume_ratio(self.displacement_gradient()) > 0.0
        if positive.all():
            return self.global_index[:0]
        return np.asarray(self.global_index[~positive.all(axis=1)])

    def crossed(self) -> NDArray[np.int64]:
        """Return global indices of quadrilaterals whose edges cross.

        A quadrilateral with one corner turned inwards is concave, with two it crosses itself
        and part of it is inverted. Other domains cannot cross without ``det F <= 0``.
        """
        shapes = self.geometry.shape_functions
        quadrilateral = self.mesh.basix_cell() == basix.CellType.quadrilateral
        if not quadrilateral or shapes.discontinuous or shapes.degree > 1:
            return self.global_index[:0]
        turned = self.corner_jacobians() <= 0.0
        if not turned.any():
            return self.global_index[:0]
        inwards = turned.sum(axis=1)
        return np.asarray(self.global_index[(inwards >= 2) & ~self.geometry.triangular])

    def behind_axis(self) -> NDArray[np.int64]:
        """Return global indices of domains that reach from a positive radius to a negative one.

        Nodes that are shared stay at ``x[0] >= 0``, but for little of the domain's width.
        """
        if self.geometry.shape_functions.discontinuous:
            return self.global_index[:0]
        behind = reach_behind_axis(self._corners())
        return np.asarray(self.global_index[behind & ~self.deleted])

    def folded(self) -> NDArray[np.int64]:
        """Return global indices of domains whose map is not one to one everywhere.

        Decided by a bound (Bernstein coefficients of the Jacobian), not by sampling, at the
        present displacement. Such a domain covers a part of itself twice; it goes on as long as
        ``det F > 0`` at its quadrature points.
        """
        now = self._corners()
        sign = self.geometry.orientation
        folded = self.geometry.jacobian_bound.vanishes(now, sign) & ~self.geometry.triangular
        return np.asarray(self.global_index[folded])

    def domain_distortion(self) -> NDArray[np.float64]:
        """Return the smallest det J of each domain over its mean, shape ``(n,)``.

        One for an undistorted domain and for a triangle, also one that is half a quadrilateral;
        zero or less where a quadrilateral is concave. For curved domains and hexahedra it is a
        bound from below.
        """
        mean = self.volume / quadrature_rule(self.mesh.basix_cell(), 0)[1].sum()
        now = self._corners()
        least = self.geometry.jacobian_bound.lower_bound(now, self.geometry.orientation)
        return np.where(self.geometry.triangular, 1.0, least / np.abs(mean))

    def corner_jacobians(self) -> NDArray[np.float64]:
        """Return det J at the corners of the present domains, positive as in the undeformed.

        Returns:
            Shape ``(n, corners)``.
        """
        return self.geometry.corner_jacobians(self._corners())
