# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The pressure of a nearly incompressible body as an unknown, beside its displacement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import override

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..assembly.pressure_blocks import PressureBlocks, PressurePoints
from ..particles.field import CarriedField
from ..particles.particles import Particles
from .values import FieldTerm

__all__ = ["PressureTerm"]


class PressureTerm(FieldTerm):
    """The constraint ``int q (theta - p / K) dX = 0`` on the volume strain theta of a body.

    The work of p on theta is in the stress of the material; what is added here is the constraint,
    and the blocks of the tangent besides that of the displacement.

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
        nodes = particles.domain_nodes
        gdim = particles.mesh.geometry.dim
        n, nq = particles.num_local, particles.num_points
        numbers = particles.W.dofmap.index_map.local_to_global(nodes.ravel()).reshape(nodes.shape)
        self._order = np.argsort(numbers, axis=1)
        columns = np.take_along_axis(numbers, self._order, axis=1)[:, :, None] * gdim
        columns = (columns + np.arange(gdim)).reshape(n, 1, nodes.shape[1] * gdim)
        self._columns = np.repeat(columns, nq, axis=1).ravel().astype(PETSc.IntType)
        width = nodes.shape[1] * gdim
        self._offsets = (width * np.arange(n * nq + 1)).astype(PETSc.IntType)
        none, force = particles.T.createVecLeft(), pressure.T.createVecLeft()
        none.set(0.0)
        self._none, self._force = none, force
        self._mats: tuple[PETSc.Mat, PETSc.Mat, PETSc.Mat, PETSc.Mat] | None = None

    @property
    @override
    def symmetric(self) -> bool:
        return self._material.symmetric

    @override
    def residuals(self) -> Sequence[PETSc.Vec]:
        found = self._material.volume_strain
        p = self._pressure.displacement.x.array[: len(found.volume)]
        weights = self._material.weights.ravel()
        gap = np.where(weights > 0.0, found.volume - found.compliance * p, 0.0)
        self._force.array_w[:] = weights * gap
        return [self._none, self._force]

    @override
    def absolute_contributions(self) -> Sequence[PETSc.Vec]:
        size = self.residuals()[1].copy()
        size.abs()
        return [self._none, size]

    def _rows(self, slope: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return volumes times strains of the nodes by a slope, row by row of the points."""
        weights = self._material.weights
        n, nq = weights.shape
        gradients = self._particles.quadrature.gradients
        gdim = gradients.shape[-1]
        slope = slope.reshape(n, nq, *slope.shape[1:])
        strains = gradients @ slope[:, :, :gdim, :gdim].swapaxes(2, 3)
        hoop = self._material.hoop
        if hoop is not None:
            strains[:, :, :, 0] += slope[:, :, 2, 2, None] * hoop
        strains *= np.where(weights > 0.0, weights, 0.0)[:, :, None, None]
        if self._particles.deletion is not None:
            strains[weights == 0.0] = 0.0
        return np.take_along_axis(strains, self._order[:, None, :, None], axis=2).ravel()

    @override
    def tangents(self) -> Mapping[tuple[int, int], PETSc.Mat]:
        found = self._material.volume_strain
        diagonal = self._force.duplicate()
        diagonal.array_w[:] = -self._material.weights.ravel() * found.compliance
        if self._mats is None:
            self._mats = self._matrices()
        of_strain, of_stress, by_points, alone = self._mats
        of_strain.setValuesCSR(self._offsets, self._columns, self._rows(found.slope))
        of_strain.assemble()
        if of_stress is not of_strain:
            values = self._rows(self._material.by_pressure)
            of_stress.setValuesCSR(self._offsets, self._columns, values)
            of_stress.assemble()
        of_stress.transpose(by_points)
        alone.setDiagonal(diagonal)
        return {(0, 1): by_points, (1, 0): of_strain, (1, 1): alone}

    def _matrices(self) -> tuple[PETSc.Mat, PETSc.Mat, PETSc.Mat, PETSc.Mat]:
        """Return matrices of strain and of stress, points by nodes, and the other two blocks."""
        points, nodes = self._force.getSizes(), self._none.getSizes()
        comm = self._particles.mesh.comm
        csr = self._offsets, self._columns, np.zeros(len(self._columns))
        of_strain = of_stress = PETSc.Mat().createAIJ((points, nodes), csr=csr, comm=comm)
        if not self._material.symmetric:
            of_stress = of_strain.duplicate()
            of_stress.assemble()
        first = of_strain.getOwnershipRange()[0]
        own = np.arange(first, first + points[0], dtype=PETSc.IntType)
        ones = np.arange(points[0] + 1, dtype=PETSc.IntType), own, np.zeros(points[0])
        alone = PETSc.Mat().createAIJ((points, points), csr=ones, comm=comm)
        return of_strain, of_stress, of_stress.transpose(PETSc.Mat()), alone
