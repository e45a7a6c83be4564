# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The undeformed body that the domains of a mesh are counted from."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import basix
import ufl
from dolfinx import fem

from ..errors import MPMError, agree
from ..meshes.quadrature import determinant, means_around_axis
from ..tolerances import SMALL
from .geometry import Geometry
from .means import MeansInUFL
from .reference import Reference

__all__ = ["Undeformed", "reach_behind_axis", "separate_nodes"]

type Array = NDArray[np.float64]


class Undeformed:
    """The undeformed body, and the rule that carries the history in it.

    The mesh is that body, unless domains were cut or the body rebased: then there is a
    :class:`Reference` which tells what the mesh does not show.

    Args:
        geometry: The mesh and what follows from it.
        cut: Whether domains were cut, so that the density has a factor at each node.
        moved: Whether the mesh's nodes are elsewhere.

    Attributes:
        geometry: As given.
        rule: The rule that carries the history, on each owned domain; its arrays stay the same.
        mass_share: Factor of the density that keeps the mass at each node where domains were
            split or the body rebased, otherwise ``None``.
        origin: Undeformed positions of the nodes of W where the body was rebased, otherwise
            ``None``.
        means: Where the rule's one point stands for means around an axis, how they follow in UFL
            from what is there (see :class:`MeansInUFL`), otherwise ``None``.
    """

    def __init__(self, geometry: Geometry, cut: bool = False, moved: bool = False) -> None:
        self.geometry = geometry
        self.rule = geometry.rule()
        self.mass_share: fem.Function | None = None
        if cut or moved:
            self.mass_share = fem.Function(separate_nodes(geometry.W), name="mass_share")
            self.mass_share.x.array[:] = 1.0
        self.origin = fem.Function(geometry.W, name="origin") if moved else None
        self.means: MeansInUFL | None = None
        self._reference: Reference | None = None
        self._gradient: tuple[Array, Array] | None = None

    # -- What the mesh does not show ------------------------------------------------------------

    @property
    def differs(self) -> bool:
        """Whether the mesh is not the undeformed body."""
        return self._reference is not None

    @property
    def reference(self) -> Reference:
        """The undeformed body."""
        if self._reference is not None:
            return self._reference
        gdim = self.geometry.gdim
        gradient = np.zeros((*self.rule.weights.shape, gdim, gdim))
        geometry = self.geometry
        return Reference(gradient, geometry.volumes, geometry.averages, geometry.corners)

    def refer(self, reference: Reference) -> None:
        """Say what the undeformed body is where the mesh does not show it (collective).

        The history's rule then has the volumes and gradients of the undeformed body.
        """
        self._reference = reference
        self._set_rule()
        if self.origin is not None:
            nodes = self.geometry.domain_nodes
            self.origin.x.array.reshape(-1, self.geometry.gdim)[nodes] = reference.domains
            self.origin.x.scatter_forward()

    def revolve(self, around: bool) -> None:
        """Take the body for one of revolution about ``x[0] = 0``, or no longer.

        The gradients at the one point of a quadrilateral are means over its volume all around
        then, and so are the hoop strains: at the axis, values at the middle would not be near
        them however small domains are.
        """
        quadrilateral = self.geometry.mesh.basix_cell() == basix.CellType.quadrilateral
        before = self.means
        self.means = None
        if around and quadrilateral and self.rule.weights.shape[1] == 1:
            self.means = before or MeansInUFL(self.geometry)
        if self.means is not before:
            self._set_rule()

    def _set_rule(self) -> None:
        """Set the volumes and gradients of the history's rule."""
        rule, self._gradient = self.rule, None
        plain = self.geometry.rule()
        if self.means is not None:
            exact = self.geometry.exact_rule()
            rule.gradients[:, 0] = means_around_axis(exact, self.domains)
            rule.weights[:, 0] = self.volume
            share = self.point_volumes(axisymmetric=True) / plain.weights
            self.means.set(rule.gradients[:, 0], self.hoop[:, 0], share[:, 0])
            return
        before = np.eye(self.geometry.gdim) + self.reference.gradient
        np.matmul(plain.gradients, before, out=rule.gradients)
        np.divide(plain.weights, determinant(before), out=rule.weights)

    @property
    def domains(self) -> Array:
        """Nodes of the domains, shape ``(n, k, gdim)``."""
        return self.geometry.corners if self._reference is None else self._reference.domains

    @property
    def volume(self) -> Array:
        """Volume of the domains, shape ``(n,)``; an area in the plane."""
        return self.geometry.volumes if self._reference is None else self._reference.volume

    @property
    def averages(self) -> Array:
        """Averages of the shape functions over the domains, shape ``(n, k)``."""
        return self.geometry.averages if self._reference is None else self._reference.averages

    def mean(self, nodal: Array) -> Array:
        """Return averages over the domains of values at their nodes ``(n, k, gdim)``."""
        return np.asarray(np.einsum("nk,nki->ni", self.averages, nodal))

    def at_points(self, nodal: Array) -> Array:
        """Return values at the domains' nodes, ``(n, k, gdim)``, at the history's points.

        The point of a triangle that was cut from a quadrilateral is its centroid.
        """
        points = np.asarray(np.einsum("qk,nki->nqi", self.rule.shapes, nodal))
        cut = self.geometry.triangular
        if cut.any():
            averages = self.geometry.averages[cut]
            points[cut] = np.einsum("nk,nki->ni", averages, nodal[cut])[:, None]
        return points

    # -- Gradients ---------------------------------------------------------------------------

    def gradient(self, displacement: Array) -> Array:
        """Return ``F - I`` at the history's points, of the same displacement only once.

        Args:
            displacement: On the local dofs of W.

        Returns:
            Shape ``(n, nq, gdim, gdim)``.
        """
        if self._gradient is not None and np.array_equal(self._gradient[0], displacement):
            return self._gradient[1]
        self._gradient = None  # one at a time in memory
        gradient = self.rule.gradient_of(displacement, self.geometry.domain_nodes)
        if self._reference is not None:
            gradient = gradient + self._reference.gradient
        self._gradient = np.array(displacement, dtype=np.float64), gradient
        return gradient

    def gradient_of(self, nodal: Array) -> Array:
        """Return ``F - I`` at the history's points, shape ``(n, nq, gdim, gdim)``.

        Args:
            nodal: Displacement of the domains' nodes, shape ``(n, k, gdim)``.
        """
        gradient = self.rule.displacement_gradient(nodal)
        return gradient if self._reference is None else gradient + self._reference.gradient

    # -- Around an axis ------------------------------------------------------------------------

    def require_radius(self) -> None:
        """Raise an error unless ``x[0]`` can be a radius (collective)."""
        with agree(self.geometry.mesh.comm):
            if self.geometry.gdim != 2:
                raise MPMError("An axisymmetric body is a mesh in the (r, z) plane.")
            left = reach_behind_axis(self.domains)
            if left.any():
                raise MPMError(
                    "The domains of {particles} have a negative radius; an axisymmetric body "
                    "lies at x[0] >= 0.",
                    self.geometry.global_index[left],
                )

    @property
    def _radial_shapes(self) -> Array:
        """Shape functions at the history's points, or their averages, ``(n, nq, k)``."""
        if self.means is not None:
            return self.averages[:, None]
        shapes = self.rule.shapes
        return np.broadcast_to(shapes, (self.geometry.num_local, *shapes.shape))

    @property
    def radii(self) -> Array:
        """Radius of the history's points, shape ``(n, nq)``."""
        return np.asarray(np.einsum("nqk,nk->nq", self._radial_shapes, self.domains[:, :, 0]))

    @property
    def hoop(self) -> Array:
        """Hoop strain that a radial displacement of each node causes, shape ``(n, nq, k)``."""
        return np.asarray(self._radial_shapes / self.radii[:, :, None])

    def point_volumes(self, axisymmetric: bool = False) -> Array:
        """Return the volume of the history's points, shape ``(n, nq)``.

        Args:
            axisymmetric: Whether it is that of a body of revolution, all around.
        """
        weights = self.rule.weights
        return weights * (2.0 * np.pi * self.radii) if axisymmetric else weights

    # -- Mass ----------------------------------------------------------------------------------

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
        area = ufl.det(F) * ufl.inv(F).T * ufl.FacetNormal(self.geometry.mesh)
        return ufl.sqrt(ufl.inner(area, area))

    def mass_shares(self) -> Array:
        """Return the factors of the density at the nodes of the owned domains, ``(n, k)``."""
        assert self.mass_share is not None
        dofs = self.mass_share.function_space.dofmap.list[: self.geometry.num_local]
        return np.array(self.mass_share.x.array[dofs], dtype=np.float64)

    def set_mass_shares(self, shares: Array) -> None:
        """Set the factors of the density at the nodes of the owned domains, shape ``(n, k)``."""
        assert self.mass_share is not None
        dofs = self.mass_share.function_space.dofmap.list[: self.geometry.num_local]
        self.mass_share.x.array[dofs] = shares
        self.mass_share.x.scatter_forward()


def reach_behind_axis(domains: Array) -> NDArray[np.bool_]:
    """Return which domains reach from a positive radius to a negative one, shape ``(n,)``.

    Args:
        domains: Their nodes, shape ``(n, k, 2)``.
    """
    radii = domains[:, :, 0]
    lowest = radii.min(axis=1, initial=np.inf)
    # (soft supports at the axis leave little, and so does round-off)
    return np.asarray(lowest < -SMALL * (radii.max(axis=1, initial=-np.inf) - lowest))


def separate_nodes(W: fem.FunctionSpace) -> fem.FunctionSpace:
    """Return numbers at the nodes of W, those of each cell by themselves (collective)."""
    return fem.functionspace(W.mesh, ("Discontinuous Lagrange", W.ufl_element().degree))
