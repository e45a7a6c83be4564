# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The pressure of a nearly incompressible body as an unknown, beside its displacement."""

from __future__ import annotations

from collections.abc import Sequence
from typing import override

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem, la

from ..assembly.pressure_blocks import PressureBlocks, PressurePoints
from ..particles.field import CarriedField
from ..particles.particles import Particles
from .values import FieldTerm

__all__ = ["PressureTerm"]


class PressureTerm(FieldTerm):
    """The constraint ``int q (theta - p / K) dX = 0`` on the volume strain theta of a body.

    The work of p on theta is in the stress of the material; what is added here is the constraint,
    and the blocks of the tangent besides that of the displacement, by the compiled loops.

    Args:
        particles: The body.
        pressure: p, at its points.
        material: The material at its points.
    """

    def __init__(
        self,
        particles: Particles,
        pressure: CarriedField,
        material: PressurePoints,
    ) -> None:
        super().__init__(particles, [pressure])
        self.coupling = PressureBlocks(particles, pressure, material)
        self._particles, self._pressure, self._material = particles, pressure, material
        self._none, self._force = particles.T.createVecLeft(), pressure.T.createVecLeft()
        self._none.set(0.0)
        self._nodal = fem.Function(particles.W)

    @property
    @override
    def symmetric(self) -> bool:
        return self._material.symmetric

    @override
    def residuals(self) -> Sequence[PETSc.Vec]:
        found = self._material.volume_strain
        p = self._pressure.displacement.x.array[: len(found.volume)]
        weights = self._material.strain.weights.ravel()
        gap = np.where(weights > 0.0, found.volume - found.compliance * p, 0.0)
        self._force.array_w[:] = weights * gap
        return [self._none, self._force]

    @override
    def absolute_contributions(self) -> Sequence[PETSc.Vec]:
        size = self.residuals()[1].copy()
        size.abs()
        return [self._none, size]

    def by_nodes(self, slope: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return volumes times strains of the nodes by a slope, ``(n, nq, k, gdim)``."""
        weights = self._material.strain.weights
        n, nq = weights.shape
        gradients = self._particles.undeformed.rule.gradients
        gdim = gradients.shape[-1]
        slope = slope.reshape(n, nq, *slope.shape[1:])
        strains = gradients @ slope[:, :, :gdim, :gdim].swapaxes(2, 3)
        hoop = self._material.strain.hoop
        if hoop is not None:
            strains[:, :, :, 0] += slope[:, :, 2, 2, None] * hoop
        strains *= np.where(weights > 0.0, weights, 0.0)[:, :, None, None]
        if self._particles.deletion is not None:
            strains[weights == 0.0] = 0.0
        return np.asarray(strains)

    @override
    def stiffness_force(self, motions: Sequence[PETSc.Vec]) -> Sequence[PETSc.Vec]:
        moved, pressed = motions
        found, weights = self._material.volume_strain, self._material.strain.weights
        nodes, x = self._particles.domain_nodes, self._nodal.x
        values = x.array.reshape(-1, self._particles.mesh.geometry.dim)
        x.array[: moved.getLocalSize()] = moved.array_r
        x.scatter_forward()
        volume = np.einsum("nqki,nki->nq", self.by_nodes(found.slope), values[nodes])
        pressure = pressed.array_r.reshape(weights.shape)
        own = volume - weights * found.compliance.reshape(weights.shape) * pressure
        slope = found.slope if self._material.symmetric else self._material.by_pressure
        values[:] = 0.0
        np.add.at(values, nodes, np.einsum("nqki,nq->nki", self.by_nodes(slope), pressure))
        x.scatter_reverse(la.InsertMode.add)
        forces = [moved.duplicate(), pressed.duplicate()]
        forces[0].array_w[:] = x.array[: moved.getLocalSize()]
        forces[1].array_w[:] = own.ravel()
        return forces
