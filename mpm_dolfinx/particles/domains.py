# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Domains of particles: a body mesh, the displacement of its cells, and their measures."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import basix
import ufl
from dolfinx import fem, mesh

from ..errors import MPMError, agree
from ..meshes.quadrature import (
    DomainQuadrature,
    means_around_axis,
    quadrature_rule,
    volume_ratio,
    with_hoop,
)
from .deletion import Deletion
from .geometry import Geometry
from .means import MeansInUFL
from .reference import Reference

__all__ = ["Domains", "separate_nodes"]

#: How far a node may be behind the axis of a body of revolution, over its domain's width: what
#: soft supports there, and round-off, may leave.
AXIS = 1e-6


class Domains:
    """The cells of a body mesh as domains that a displacement deforms.

    Here are the rule that carries the history and the displacement; what moves the domains is not
    known here. What follows from the mesh alone is a :class:`Geometry`.

    Attributes:
        displacement: Total displacement d in W.
        quadrature: The rule that carries the history, on each owned domain.
        deletion: Which domains are deleted, or ``None`` where none may be.
        mass_share: Factor of the density that keeps the mass at each node where domains were
            split or the body rebased, otherwise ``None``.
        means: Where the rule's one point stands for means around an axis, how they follow in UFL
            from what is there (see :class:`MeansInUFL`), otherwise ``None``.
        origin: Undeformed positions of the nodes of W where the body was rebased, otherwise
            ``None``.
    """

    def _live_on(self, geometry: Geometry, deletable: bool) -> None:
        """Take the cells of a mesh, undeformed, for the domains (collective).

        Args:
            geometry: The mesh and what follows from it.
            deletable: Whether domains may be deleted.
        """
        self._geometry = geometry
        self.displacement = fem.Function(geometry.W, name="displacement")
        self.quadrature = geometry.rule()
        self.means: MeansInUFL | None = None
        self.deletion = Deletion(geometry.mesh, geometry.W) if deletable else None
        self._gradient: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self._reference: Reference | None = None
        self.mass_share: fem.Function | None = None
        self.origin: fem.Function | None = None

    def allow_deletion(self, allowed: bool) -> None:
        """Let domains be deleted, or no longer, where none of them is (collective)."""
        if not allowed:
            self.deletion = None
        elif self.deletion is None:
            self.deletion = Deletion(self._geometry.mesh, self._geometry.W)

    # -- The mesh -------------------------------------------------------------------------

    @property
    def mesh(self) -> mesh.Mesh:
        """The body mesh, undeformed."""
        return self._geometry.mesh

    @property
    def W(self) -> fem.FunctionSpace:
        """Space of the domains' displacement."""
        return self._geometry.W

    @property
    def dx(self) -> ufl.Measure:
        """Measure with the rule that carries the history."""
        return self._geometry.dx

    @property
    def dx_exact(self) -> ufl.Measure:
        """Measure exact for body force and mass."""
        return self._geometry.dx_exact

    @property
    def num_local(self) -> int:
        """Number of domains this rank owns."""
        return self._geometry.num_local

    @property
    def num_global(self) -> int:
        """Number of domains of all ranks."""
        return self._geometry.num_global

    @property
    def global_index(self) -> NDArray[np.int64]:
        """Input index of each owned domain, shape ``(n,)``."""
        return self._geometry.global_index

    @property
    def domain_nodes(self) -> NDArray[np.int32]:
        """Local nodes of W of each owned domain, shape ``(n, k)``."""
        return self._geometry.domain_nodes

    @property
    def quadrature_degree(self) -> int:
        """Degree of the rule that carries the history."""
        return self._geometry.quadrature_degree

    @property
    def triangular(self) -> NDArray[np.bool_]:
        """Whether each domain is a quadrilateral with two corners in one place, shape ``(n,)``."""
        return self._geometry.triangular

    @property
    def mesh_averages(self) -> NDArray[np.float64]:
        """Averages of the shape functions over the domains of the mesh, shape ``(n, k)``."""
        return self._geometry.averages

    # -- The undeformed body, where the mesh does not show it -------------------------------

    def expect_reference(self, moved: bool) -> None:
        """Prepare for a mesh that is not the undeformed body (collective).

        Args:
            moved: Whether its nodes are elsewhere.
        """
        self.mass_share = fem.Function(separate_nodes(self.W), name="mass_share")
        self.mass_share.x.array[:] = 1.0
        if moved:
            self.origin = fem.Function(self.W, name="origin")

    def refer(self, reference: Reference) -> None:
        """Say what the undeformed body is where the mesh does not show it (collective).

        The history's rule then has the volumes and gradients of the undeformed body. Its arrays
        stay the same ones.
        """
        self._reference = reference
        self._set_rule()
        if self.origin is not None:
            self.origin.x.array.reshape(-1, self._geometry.gdim)[self.domain_nodes] = (
                reference.domains
            )
            self.origin.x.scatter_forward()

    def revolve(self, around: bool) -> None:
        """Take the body for one of revolution about ``x[0] = 0``, or no longer.

        The gradients at the one point of a quadrilateral are means over its volume all around
        then, and so are the hoop strains: at the axis, values at the middle would not be near
        them however small domains are. The rule's arrays stay the same ones.
        """
        quadrilateral = self.mesh.basix_cell() == basix.CellType.quadrilateral
        before = self.means
        self.means = None
        if around and quadrilateral and self.num_points == 1:
            self.means = before or MeansInUFL(self._geometry)
        if self.means is not before:
            self._set_rule()

    def _set_rule(self) -> None:
        """Set the volumes and gradients of the history's rule in the undeformed body."""
        rule, self._gradient = self.quadrature, None
        plain = self.mesh_rule()
        if self.means is not None:
            exact = self._geometry.exact_rule()
            rule.gradients[:, 0] = means_around_axis(exact, self.initial_domains)
            rule.weights[:, 0] = self.initial_volume
            share = self.point_volumes(axisymmetric=True) / plain.weights
            self.means.set(rule.gradients[:, 0], self.hoop[:, 0], share[:, 0])
            return
        before = np.eye(self._geometry.gdim) + self.reference.gradient
        np.matmul(plain.gradients, before, out=rule.gradients)
        np.divide(plain.weights, np.linalg.det(before), out=rule.weights)

    def mass_shares(self) -> NDArray[np.float64]:
        """Return the factors of the density at the nodes of the owned domains, ``(n, k)``."""
        assert self.mass_share is not None
        dofs = self.mass_share.function_space.dofmap.list[: self.num_local]
        return np.array(self.mass_share.x.array[dofs], dtype=np.float64)

    @property
    def volume_ratio(self) -> Any:
        """UFL: undeformed volume of the body mesh over its own."""
        return 1.0 if self.origin is None else ufl.det(ufl.grad(self.origin))

    @property
    def mass_ratio(self) -> Any:
        """UFL: mass per volume of the body mesh over the density that was given for it.

        Of a body that was rebased it is the ratio of volumes, so that masses of domains stay what
        they are; shares are beside that of what was cut.
        """
        return 1.0 if self.mass_share is None else self.mass_share * self.volume_ratio

    @property
    def area_ratio(self) -> Any:
        """UFL: undeformed area of the body mesh's facets over their own, by Nanson's formula."""
        if self.origin is None:
            return 1.0
        F = ufl.grad(self.origin)
        area = ufl.det(F) * ufl.inv(F).T * ufl.FacetNormal(self.mesh)
        return ufl.sqrt(ufl.inner(area, area))

    def set_mass_shares(self, shares: NDArray[np.float64]) -> None:
        """Set the factors of the density at the nodes of the owned domains, shape ``(n, k)``."""
        assert self.mass_share is not None
        dofs = self.mass_share.function_space.dofmap.list[: self.num_local]
        self.mass_share.x.array[dofs] = shares
        self.mass_share.x.scatter_forward()

    def refer_mass_shares(self) -> None:
        """Take the mass shares for such per volume of the mesh, which older files have.

        They become those per undeformed volume with the same masses at the nodes.
        """
        assert self.origin is not None
        exact = self._geometry.exact_rule()
        N, own = exact.shapes, exact.weights
        moved = self.origin.x.array.reshape(-1, self._geometry.gdim) - self._geometry.nodes
        before = own * volume_ratio(exact.displacement_gradient(moved[self.domain_nodes]))
        masses = np.einsum("nq,qc,qd,nd->nc", own, N, N, self.mass_shares(), optimize=True)
        matrices = np.einsum("nq,qc,qd->ncd", before, N, N, optimize=True)
        self.set_mass_shares(np.linalg.solve(matrices, masses[:, :, None])[:, :, 0])

    @property
    def rebased(self) -> bool:
        """Whether the mesh is not the undeformed body."""
        return self._reference is not None

    @property
    def reference(self) -> Reference:
        """The undeformed body."""
        if self._reference is not None:
            return self._reference
        gradient = np.zeros(
            (*self.quadrature.weights.shape, self._geometry.gdim, self._geometry.gdim)
        )
        domains = self._geometry.corners
        return Reference(gradient, self._geometry.volumes, self.mesh_averages, domains)

    def mesh_rule(self) -> DomainQuadrature:
        """Return the history's rule with the volumes and gradients of the mesh."""
        return self._geometry.rule()

    def mesh_gradient(self) -> NDArray[np.float64]:
        """Return ``grad d`` on the mesh at the history's points, shape ``(n, nq, gdim, gdim)``."""
        return self.mesh_rule().displacement_gradient(self._nodal())

    def _whole_gradient(self, gradient: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradient since the undeformed body."""
        return gradient if self._reference is None else gradient + self._reference.gradient

    def quadrature_function(self, name: str, shape: tuple[int, ...] = ()) -> fem.Function:
        """Return a Function for data at the history's points, to be injected into a form.

        Args:
            name: Its name.
            shape: Shape of a value.

        Returns:
            Function on a quadrature element, integrated with ``particles.dx``. Its values
            cell by cell are ``f.x.array.reshape(-1, nq, *shape)``.
        """
        return self._geometry.quadrature_function(name, shape)

    @property
    def num_points(self) -> int:
        """Number of quadrature points of each domain."""
        return int(self.quadrature.weights.shape[1])

    def _of_domains(self, nodal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return displacements of nodes ``(N, gdim)`` for each domain, shape ``(n, k, gdim)``."""
        values: NDArray[np.float64] = nodal[self.domain_nodes]
        return values if self.deletion is None else self.deletion.kept(values)

    def _nodal(self) -> NDArray[np.float64]:
        """Displacement of the domains' nodes now, shape ``(n, k, gdim)``."""
        nodal = self.displacement.x.array.reshape(-1, self._geometry.gdim)
        return self._of_domains(np.asarray(nodal, dtype=np.float64))

    def _corners(self) -> NDArray[np.float64]:
        """Positions of the domains' nodes now, shape ``(n, k, gdim)``."""
        return np.asarray(self._geometry.corners + self._nodal())

    def displacement_gradient(self, axisymmetric: bool = False) -> NDArray[np.float64]:
        """Return ``grad d`` at the history's points.

        Args:
            axisymmetric: Whether to add the hoop stretch ``d_r / R``.

        Returns:
            Shape ``(n, nq, gdim, gdim)``, or ``(n, nq, 3, 3)`` where axisymmetric.
        """
        gradient = self._present_gradient()
        if not axisymmetric:
            return gradient
        moved = self._nodal()
        if self._reference is not None:
            moved = self._corners() - self._reference.domains
        return with_hoop(gradient, self.hoop, moved)

    def _present_gradient(self) -> NDArray[np.float64]:
        """Return ``grad d`` at the history's points, of the same displacement only once."""
        d = self.displacement.x.array
        if self.deletion is not None:
            return self._whole_gradient(self.quadrature.displacement_gradient(self._nodal()))
        if self._gradient is not None and np.array_equal(self._gradient[0], d):
            return self._gradient[1]
        self._gradient = None  # one at a time in memory
        gradient = self.quadrature.gradient_of(np.asarray(d), self.domain_nodes)
        gradient = self._whole_gradient(gradient)
        self._gradient = np.array(d, dtype=np.float64), gradient
        return gradient

    @property
    def _radial_shapes(self) -> NDArray[np.float64]:
        """Shape functions at the history's points, or their averages, ``(n, nq, k)``."""
        shapes = self.quadrature.shapes
        if self.means is not None:
            return self._averages[:, None]
        return np.broadcast_to(shapes, (self.num_local, *shapes.shape))

    @property
    def radii(self) -> NDArray[np.float64]:
        """Undeformed radius of the history's points, shape ``(n, nq)``."""
        radii = self.initial_domains[:, :, 0]
        return np.asarray(np.einsum("nqk,nk->nq", self._radial_shapes, radii))

    @property
    def hoop(self) -> NDArray[np.float64]:
        """Hoop strain that a radial displacement of each node causes, shape ``(n, nq, k)``."""
        return np.asarray(self._radial_shapes / self.radii[:, :, None])

    def point_volumes(self, axisymmetric: bool = False) -> NDArray[np.float64]:
        """Return the reference volume of the history's points, shape ``(n, nq)``.

        Args:
            axisymmetric: Whether it is that of a body of revolution, all around.
        """
        weights = self.quadrature.weights
        return weights * (2.0 * np.pi * self.radii) if axisymmetric else weights

    def require_radius(self) -> None:
        """Raise an error unless ``x[0]`` can be a radius (collective)."""
        with agree(self.mesh.comm):
            if self._geometry.gdim != 2:
                raise MPMError("An axisymmetric body is a mesh in the (r, z) plane.")
            left = _reach_behind(self.initial_domains[:, :, 0])
            if left.any():
                raise MPMError(
                    "The domains of {particles} have a negative radius; an axisymmetric body "
                    "lies at x[0] >= 0.",
                    self.global_index[left],
                )

    @property
    def deleted(self) -> NDArray[np.bool_]:
        """Whether each particle this rank owns is deleted, shape ``(n,)``."""
        if self.deletion is None:
            return np.zeros(self.num_local, dtype=bool)
        return self.deletion.mask

    @property
    def initial_domains(self) -> NDArray[np.float64]:
        """Corners of the undeformed domains, shape ``(n, k, gdim)``."""
        if self._reference is None:
            return np.asarray(self._geometry.corners)
        return self._reference.domains.copy()

    @property
    def _averages(self) -> NDArray[np.float64]:
        """Averages of the shape functions over the undeformed domains, shape ``(n, k)``."""
        return self.mesh_averages if self._reference is None else self._reference.averages

    @property
    def initial_volume(self) -> NDArray[np.float64]:
        """Volume of the undeformed domains, shape ``(n,)``; an area in the plane."""
        volume = self._geometry.volumes if self._reference is None else self._reference.volume
        return volume.copy()

    @property
    def volume(self) -> NDArray[np.float64]:
        """Volume of the domains now, shape ``(n,)``; an area in the plane."""
        exact = self._geometry.exact_rule()
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
        return self._at_points(self.initial_domains)

    @property
    def points(self) -> NDArray[np.float64]:
        """Positions of the quadrature points, shape ``(n, nq, gdim)``."""
        return self._at_points(self._corners())

    def mean(self, nodal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return averages over the undeformed domains of values at nodes ``(n, k, gdim)``."""
        return np.asarray(np.einsum("nk,nki->ni", self._averages, nodal))

    def _at_points(self, nodal: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.einsum("qk,nki->nqi", self.quadrature.shapes, nodal))

    def outlined(self, domains: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the equispaced nodes of domains that are given by their own nodes.

        Args:
            domains: Nodes of domains, shape ``(n, k, gdim)``.
        """
        return self._geometry.outlined(domains)

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
        shapes = self._geometry.shape_functions
        quadrilateral = self.mesh.basix_cell() == basix.CellType.quadrilateral
        if not quadrilateral or shapes.discontinuous or shapes.degree > 1:
            return self.global_index[:0]
        turned = self.corner_jacobians() <= 0.0
        if not turned.any():
            return self.global_index[:0]
        inwards = turned.sum(axis=1)
        return np.asarray(self.global_index[(inwards >= 2) & ~self.triangular])

    def behind_axis(self) -> NDArray[np.int64]:
        """Return global indices of domains that reach from a positive radius to a negative one.

        Nodes that are shared stay at ``x[0] >= 0``, but for :data:`AXIS` of the domain's width.
        """
        if self._geometry.shape_functions.discontinuous:
            return self.global_index[:0]
        behind = _reach_behind(self._corners()[:, :, 0])
        return np.asarray(self.global_index[behind & ~self.deleted])

    def folded(self) -> NDArray[np.int64]:
        """Return global indices of domains whose map is not one to one everywhere.

        Decided by a bound (Bernstein coefficients of the Jacobian), not by sampling, at the
        present displacement. Such a domain covers a part of itself twice; it goes on as long as
        ``det F > 0`` at its quadrature points.
        """
        now = self._corners()
        sign = self._geometry.orientation
        folded = self._geometry.jacobian_bound.vanishes(now, sign) & ~self.triangular
        return np.asarray(self.global_index[folded])

    def domain_distortion(self) -> NDArray[np.float64]:
        """Return the smallest det J of each domain over its mean, shape ``(n,)``.

        One for an undistorted domain and for a triangle, also one that is half a quadrilateral;
        zero or less where a quadrilateral is concave. For curved domains and hexahedra it is a
        bound from below.
        """
        mean = self.volume / quadrature_rule(self.mesh.basix_cell(), 0)[1].sum()
        now = self._corners()
        least = self._geometry.jacobian_bound.lower_bound(now, self._geometry.orientation)
        return np.where(self.triangular, 1.0, least / np.abs(mean))

    def corner_jacobians(self) -> NDArray[np.float64]:
        """Return det J at the corners of the present domains, positive as in the undeformed.

        Returns:
            Shape ``(n, corners)``.
        """
        return self._geometry.corner_jacobians(self._corners())


def _reach_behind(radii: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether domains reach behind the axis, by the radii of their nodes ``(n, k)``."""
    lowest = radii.min(axis=1, initial=np.inf)
    return np.asarray(lowest < -AXIS * (radii.max(axis=1, initial=-np.inf) - lowest))


def separate_nodes(W: fem.FunctionSpace) -> fem.FunctionSpace:
    """Return numbers at the nodes of W, those of each cell by themselves (collective)."""
    return fem.functionspace(W.mesh, ("Discontinuous Lagrange", W.ufl_element().degree))
