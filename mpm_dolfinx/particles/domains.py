# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Domains of particles: a body mesh, the displacement of its cells, and their measures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import basix
import ufl
from dolfinx import fem, mesh

from ..meshes.quadrature import quadrature_rule, volume_ratio, with_hoop
from ..parallel.boundary import Owned
from ..tolerances import BLOCK
from .deletion import Deletion
from .undeformed import Undeformed, reach_behind_axis

__all__ = ["Domains", "behind_axis", "crossed"]


class Domains(Owned):
    """The cells of a body mesh as domains that a displacement deforms.

    What moves the domains is not known here.

    Attributes:
        geometry: The mesh and what follows from it alone.
        undeformed: The undeformed body, and the rule that carries the history in it.
        displacement: Total displacement d in W.
        deletion: Which domains are deleted, or ``None`` where none may be.
    """

    def _live_on(self, undeformed: Undeformed, deletion: Deletion | None) -> None:
        """Take the cells of a mesh, where nothing is displaced, for the domains (collective).

        Args:
            undeformed: What the domains are counted from, and the mesh.
            deletion: Which of them are deleted, if any may be.
        """
        self.geometry, self.undeformed = undeformed.geometry, undeformed
        self.displacement = fem.Function(self.geometry.W, name="displacement")
        self.deletion = deletion

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
        return int(self.undeformed.rule.weights.shape[1])

    def of_domains(self, motion: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """Return displacements of nodes for each domain, shape ``(n, k, gdim)``.

        Args:
            motion: On the local dofs of W; ``None``: the present displacement.
        """
        nodal = self.displacement.x.array if motion is None else motion
        nodal = np.asarray(nodal, dtype=np.float64).reshape(-1, self.geometry.gdim)
        values: NDArray[np.float64] = nodal[self.domain_nodes]
        return values if self.deletion is None else self.deletion.kept(values)

    def corners(self) -> NDArray[np.float64]:
        """Return positions of the domains' nodes now, shape ``(n, k, gdim)``."""
        return np.asarray(self.geometry.corners + self.of_domains())

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
            gradient = self.undeformed.gradient_of(self.of_domains())
        if not axisymmetric:
            return gradient
        moved = self.of_domains()
        if self.undeformed.differs:
            moved = self.corners() - self.undeformed.domains
        return with_hoop(gradient, self.undeformed.hoop, moved)

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
        ratio = volume_ratio(exact.displacement_gradient(self.of_domains()))
        return np.asarray((exact.weights * ratio).sum(axis=1))

    @property
    def initial_centroid(self) -> NDArray[np.float64]:
        """Centroid of the undeformed domains, shape ``(n, gdim)``."""
        return self.undeformed.mean(self.initial_domains)

    @property
    def centroid(self) -> NDArray[np.float64]:
        """Particle positions: mean of ``X + d`` over the domains, shape ``(n, gdim)``."""
        return self.undeformed.mean(self.corners())

    @property
    def initial_points(self) -> NDArray[np.float64]:
        """Undeformed positions of the quadrature points, shape ``(n, nq, gdim)``."""
        return self.undeformed.at_points(self.initial_domains)

    @property
    def points(self) -> NDArray[np.float64]:
        """Positions of the quadrature points, shape ``(n, nq, gdim)``."""
        return self.undeformed.at_points(self.corners())

    def inverted(self) -> NDArray[np.int64]:
        """Return global indices of domains with ``det F <= 0`` or not finite at a point."""
        gradient = self.displacement_gradient()
        positive = np.empty(gradient.shape[:2], dtype=bool)
        for start in range(0, len(gradient), BLOCK):
            part = slice(start, start + BLOCK)
            positive[part] = volume_ratio(gradient[part]) > 0.0
        if positive.all():
            return self.global_index[:0]
        return np.asarray(self.global_index[~positive.all(axis=1)])

    def folded(self) -> NDArray[np.int64]:
        """Return global indices of domains whose map is not one to one everywhere.

        Decided by a bound (Bernstein coefficients of the Jacobian), not by sampling, at the
        present displacement. Such a domain covers a part of itself twice; it goes on as long as
        ``det F > 0`` at its quadrature points.
        """
        now = self.corners()
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
        now = self.corners()
        least = self.geometry.jacobian_bound.lower_bound(now, self.geometry.orientation)
        return np.where(self.geometry.triangular, 1.0, least / np.abs(mean))


def behind_axis(domains: Domains) -> NDArray[np.int64]:
    """Return global indices of domains that reach from a positive radius to a negative one.

    Nodes that are shared stay at ``x[0] >= 0``, but for little of the domain's width.
    """
    if domains.geometry.shape_functions.discontinuous:
        return domains.global_index[:0]
    behind = reach_behind_axis(domains.corners())
    return np.asarray(domains.global_index[behind & ~domains.deleted])


def crossed(domains: Domains) -> NDArray[np.int64]:
    """Return global indices of quadrilaterals whose edges cross.

    A quadrilateral with one corner turned inwards is concave, with two it crosses itself
    and part of it is inverted. Other domains cannot cross without ``det F <= 0``.
    """
    geometry = domains.geometry
    shapes = geometry.shape_functions
    quadrilateral = geometry.mesh.basix_cell() == basix.CellType.quadrilateral
    if not quadrilateral or shapes.discontinuous or shapes.degree > 1:
        return domains.global_index[:0]
    inwards = (geometry.corner_jacobians(domains.corners()) <= 0.0).sum(axis=1)
    return np.asarray(domains.global_index[(inwards >= 2) & ~geometry.triangular])
