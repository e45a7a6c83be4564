# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Densities and other values of bodies that must not be negative."""

from __future__ import annotations

import numpy as np

from dolfinx import fem

from ..errors import MPMError, agree
from ..meshes.quadrature import quadrature_rule
from ..meshes.values import AtPoints, Value, as_ufl
from ..particles.particles import Particles

__all__ = ["Density", "NotNegative"]


class NotNegative:
    """Something of a body that must not be negative anywhere, whatever values it gets.

    Args:
        value: A :data:`~mpm_dolfinx.meshes.values.Value`.
        particles: The body.
        name: What it is called in a message.

    Attributes:
        value: UFL on the body mesh.

    Raises:
        MPMError: See :func:`~mpm_dolfinx.meshes.values.as_ufl`.
    """

    def __init__(self, value: Value, particles: Particles, name: str) -> None:
        self.value = as_ufl(value, particles.mesh, name, negative=False)
        self._particles, self._name = particles, name
        self._at_points: AtPoints | None = None
        if not isinstance(self.value, fem.Function):
            degree = particles.dx_exact.metadata()["quadrature_degree"]
            points, _ = quadrature_rule(particles.mesh.basix_cell(), degree)
            self._at_points = AtPoints(self.value, particles.mesh, points)

    def require(self) -> None:
        """Look at the present values at the points of integration (collective).

        Raises:
            MPMError: Some are negative, or no numbers.
        """
        particles = self._particles
        if self._at_points is not None:
            values = self._at_points.values()
        else:
            values = self.value.x.array[self.value.function_space.dofmap.list]
            values = values[: particles.num_local]
        least = values.min(axis=1, initial=np.inf)
        wrong = ~(least >= 0.0) & ~particles.deleted
        with agree(particles.mesh.comm):
            if wrong.any():
                raise MPMError(
                    f"{self._name} must not be negative, not {least[wrong][0]:g} "
                    "(at {particles}).",
                    particles.global_index[wrong],
                )


class Density(NotNegative):
    """The mass per undeformed volume of a body; see :class:`NotNegative`."""

    def __init__(self, value: Value, particles: Particles) -> None:
        super().__init__(value, particles, "density")
