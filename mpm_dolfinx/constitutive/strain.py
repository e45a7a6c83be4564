# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Strain of the points of a body: in the plane, in space, or around an axis."""

from __future__ import annotations

from typing import Any, override

import numpy as np
from numpy.typing import NDArray

import ufl

from ..meshes.quadrature import nodal_forces
from ..particles.domains import behind_axis
from ..particles.particles import Particles, require_at_nodes

__all__ = ["Revolution", "Strain", "strain_of"]

type Array = NDArray[np.float64]


class Strain:
    """Plane strain of a body in the plane, three-dimensional strain of one in space.

    Args:
        particles: The body.

    Attributes:
        dim: Dimension of the deformation gradient.
        particles: As given.
    """

    def __init__(self, particles: Particles) -> None:
        self.particles = particles
        self.dim: int = particles.mesh.geometry.dim

    # -- At the history's points ----------------------------------------------------------

    @property
    def hoop(self) -> Array | None:
        """Hoop strain by a radial displacement of each node, ``(n, nq, k)``; ``None`` for none."""
        return None

    def gradient(self) -> Array:
        """Return ``F - I`` at the present displacement, shape ``(n, nq, dim, dim)``."""
        return self.particles.displacement_gradient()

    def volumes(self) -> Array:
        """Return the undeformed volume of each point, shape ``(n, nq)``."""
        return self.particles.undeformed.point_volumes()

    @property
    def weights(self) -> Array:
        """Undeformed volume of each point, shape ``(n, nq)``; 0 where deleted."""
        volumes = self.volumes()
        if self.particles.deletion is None:
            return volumes
        return np.where(self.particles.deleted[:, None], 0.0, volumes)

    def average(self, values: Array) -> Array:
        """Return volume averages of values ``(n, nq, ...)`` over the undeformed domains."""
        volumes = self.volumes()
        parts = volumes / volumes.sum(axis=1, keepdims=True)
        return np.asarray(np.einsum("nq,nq...->n...", parts, values))

    def nodal(self, stress: Array, volumes: Array) -> Array:
        """Return the integrals of ``stress : grad N`` over each domain, shape ``(n, k, gdim)``.

        Args:
            stress: Shape ``(n, nq, dim, dim)``.
            volumes: Of the points, shape ``(n, nq)``.
        """
        gradients = self.particles.undeformed.rule.gradients
        return nodal_forces(stress, volumes, gradients, self.hoop)

    def beyond(self) -> tuple[str, NDArray[np.int64]]:
        """Return a bound on converged steps besides folding, and the domains that break it.

        Returns:
            The words for an error, and global indices.
        """
        return "", self.particles.global_index[:0]

    # -- In UFL ---------------------------------------------------------------------------

    def before_mesh(self) -> Array | None:
        """Return the deformation gradient of the mesh that :meth:`ufl_gradient` does not see.

        Returns:
            Shape ``(n, nq, gdim, gdim)``, or ``None`` where it sees all.
        """
        undeformed = self.particles.undeformed
        if not undeformed.differs:
            return None
        gradient = undeformed.reference.gradient
        return np.asarray(np.eye(gradient.shape[-1]) + gradient)

    def integral(self, work: Any) -> ufl.Form:
        """Return the integral of a stress times a gradient of :meth:`ufl_gradient`."""
        form: ufl.Form = self.turn * work * self.particles.dx
        return form

    @property
    def turn(self) -> Any:
        """Length of the way around the axis in the undeformed body, or 1."""
        return 1.0

    @property
    def present_turn(self) -> Any:
        """Length of the way around the axis at the present displacement, or 1."""
        return 1.0

    def ufl_gradient(self, w: Any) -> Any:
        """Return the gradient of a displacement, shape ``(dim, dim)``."""
        return self.with_turn(ufl.grad(w), w)

    def with_turn(self, gradient: Any, w: Any) -> Any:
        """Return a gradient of a displacement w in the body's dimensions in those of the strain."""
        return gradient


class Revolution(Strain):
    """A body of revolution about ``x[0] = 0``, with the strain ``d_r / R`` around it.

    Raises:
        MPMError: ``x[0]`` cannot be a radius, or weights are means in the plane.
    """

    def __init__(self, particles: Particles) -> None:
        super().__init__(particles)
        undeformed = particles.undeformed
        undeformed.require_radius()
        require_at_nodes("A body of revolution", particles)
        undeformed.revolve(True)
        self.dim = 3
        self._mesh_radius = ufl.SpatialCoordinate(particles.mesh)[0]
        self._radius = self._mesh_radius if undeformed.origin is None else undeformed.origin[0]

    @property
    @override
    def hoop(self) -> Array | None:
        return self.particles.undeformed.hoop

    @override
    def gradient(self) -> Array:
        return self.particles.displacement_gradient(axisymmetric=True)

    @override
    def volumes(self) -> Array:
        """Volumes all around the axis."""
        return self.particles.undeformed.point_volumes(axisymmetric=True)

    @override
    def beyond(self) -> tuple[str, NDArray[np.int64]]:
        """Displacements beyond the mesh; the axis stays where it is."""
        words = "reach across the axis x[0] = 0 (nodes on it must be held against the radius)"
        return words, behind_axis(self.particles)

    @override
    def before_mesh(self) -> Array | None:
        return super().before_mesh() if self.particles.undeformed.means is None else None

    @override
    def integral(self, work: Any) -> ufl.Form:
        means = self.particles.undeformed.means
        if means is None:
            return super().integral(work)
        form: ufl.Form = means.share * work * self.particles.dx
        return form

    @override
    def ufl_gradient(self, w: Any) -> Any:
        means = self.particles.undeformed.means
        if means is None:
            return super().ufl_gradient(w)
        return _in_space(means.gradient(w), means.hoop(w))

    @property
    @override
    def turn(self) -> Any:
        return 2.0 * np.pi * self._radius

    @property
    @override
    def present_turn(self) -> Any:
        return 2.0 * np.pi * (self._mesh_radius + self.particles.displacement[0])

    @override
    def with_turn(self, gradient: Any, w: Any) -> Any:
        return _in_space(gradient, w[0] / self._radius)


def _in_space(g: Any, hoop: Any) -> Any:
    """Return a gradient in the plane with a hoop strain."""
    return ufl.as_tensor([[g[0, 0], g[0, 1], 0], [g[1, 0], g[1, 1], 0], [0, 0, hoop]])


def strain_of(particles: Particles, axisymmetric: bool) -> Strain:
    """Return the kind of strain of a body (collective).

    Args:
        particles: The body.
        axisymmetric: Whether it is one of revolution.
    """
    if axisymmetric:
        return Revolution(particles)
    particles.undeformed.revolve(False)
    return Strain(particles)
