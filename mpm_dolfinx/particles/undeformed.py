# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The undeformed body, and the rule that carries the history in it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

import basix

from ..errors import MPMError, agree
from ..meshes.quadrature import means_around_axis
from ..tolerances import SMALL
from .geometry import Geometry
from .means import MeansInUFL

__all__ = ["Undeformed", "reach_behind_axis"]

type Array = NDArray[np.float64]


class Undeformed:
    """The undeformed body, and the rule that carries the history in it.

    Args:
        geometry: The mesh and what follows from it.

    Attributes:
        geometry: As given.
        rule: The rule that carries the history, on each owned domain; its arrays stay the same.
        means: Where the rule's one point stands for means around an axis, how they follow in UFL
            from what is there (see :class:`MeansInUFL`), otherwise ``None``.
    """

    def __init__(self, geometry: Geometry) -> None:
        self.geometry = geometry
        self.rule = geometry.rule()
        self.means: MeansInUFL | None = None
        self._gradient: tuple[Array, Array] | None = None

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
            rule.gradients[:, 0] = means_around_axis(exact, self.geometry.corners)
            rule.weights[:, 0] = self.geometry.volumes
            share = self.point_volumes(axisymmetric=True) / plain.weights
            self.means.set(rule.gradients[:, 0], self.hoop[:, 0], share[:, 0])
            return
        rule.gradients[:], rule.weights[:] = plain.gradients, plain.weights

    def mean(self, nodal: Array) -> Array:
        """Return averages over the domains of values at their nodes ``(n, k, gdim)``."""
        return np.asarray(np.einsum("nk,nki->ni", self.geometry.averages, nodal))

    def at_points(self, nodal: Array) -> Array:
        """Return values at the domains' nodes, ``(n, k, gdim)``, at the history's points."""
        return np.asarray(np.einsum("qk,nki->nqi", self.rule.shapes, nodal))

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
        self._gradient = np.array(displacement, dtype=np.float64), gradient
        return gradient

    def gradient_of(self, nodal: Array) -> Array:
        """Return ``F - I`` at the history's points, shape ``(n, nq, gdim, gdim)``.

        Args:
            nodal: Displacement of the domains' nodes, shape ``(n, k, gdim)``.
        """
        return self.rule.displacement_gradient(nodal)

    # -- Around an axis ------------------------------------------------------------------------

    def require_radius(self) -> None:
        """Raise an error unless ``x[0]`` can be a radius (collective)."""
        with agree(self.geometry.mesh.comm):
            if self.geometry.gdim != 2:
                raise MPMError("An axisymmetric body is a mesh in the (r, z) plane.")
            left = reach_behind_axis(self.geometry.corners)
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
            return self.geometry.averages[:, None]
        shapes = self.rule.shapes
        return np.broadcast_to(shapes, (self.geometry.num_local, *shapes.shape))

    @property
    def radii(self) -> Array:
        """Radius of the history's points, shape ``(n, nq)``."""
        radii = self.geometry.corners[:, :, 0]
        return np.asarray(np.einsum("nqk,nk->nq", self._radial_shapes, radii))

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


def reach_behind_axis(domains: Array) -> NDArray[np.bool_]:
    """Return which domains reach from a positive radius to a negative one, shape ``(n,)``.

    Args:
        domains: Their nodes, shape ``(n, k, 2)``.
    """
    radii = domains[:, :, 0]
    lowest = radii.min(axis=1, initial=np.inf)
    # (soft supports at the axis leave little, and so does round-off)
    return np.asarray(lowest < -SMALL * (radii.max(axis=1, initial=-np.inf) - lowest))
