# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Stabilisation of a pressure of the displacement's own degree."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import override

from petsc4py import PETSc

import numpy as np

from ..background.basis import PointBasis
from ..constitutive.moduli import undeformed_tangent
from ..constitutive.points import MaterialPoints
from ..particles.field import CarriedField
from .values import FieldTerm

__all__ = ["PressureSmoothing"]


class PressureSmoothing(FieldTerm):
    """The stabilisation ``-int (p - p_c) (q - q_c) / (2 G) dX`` of a constraint on volume.

    p_c is the mean of p over a body's points in one cell of the background (Bochev, Dohrmann &
    Gunzburger 2006), at the last converged positions. It vanishes where the pressure is constant
    in each cell.

    Args:
        pressure: The pressure, at a body's points.
        material: The material at the points.
        share: What of a body's forces at a step's end is force (see :meth:`Term.pace`); it counts
            ``1 / share`` times, as the constraint does.
    """

    symmetric = True

    def __init__(
        self, pressure: CarriedField, material: MaterialPoints, share: float = 1.0
    ) -> None:
        super().__init__(None, [pressure])
        self.fields = []  # committed by the constraint's own term
        self._pressure, self._material = pressure, material
        self._weight = 1.0 / share  # of the compliance in shear, 1 / (2 G)
        self._matrix: PETSc.Mat | None = None
        self._force = pressure.T.createVecLeft()

    @override
    def begin(self) -> Sequence[PETSc.Vec]:
        """Begin a step, with points in other cells, or of other volumes."""
        self._matrix = None
        return ()

    @override
    def residuals(self) -> Sequence[PETSc.Vec]:
        values = self._force.duplicate()
        count = values.getLocalSize()
        values.array_w[:] = self._pressure.displacement.x.array[:count]
        self._present().mult(values, self._force)
        return [self._force]

    @override
    def tangents(self) -> Mapping[tuple[int, int], PETSc.Mat]:
        return {(0, 0): self._present()}

    def _present(self) -> PETSc.Mat:
        """Return the tangent, which is the same through a step (collective)."""
        if self._matrix is None:
            self._matrix = self._made(self._pressure.node_basis)
        return self._matrix

    def _made(self, basis: PointBasis) -> PETSc.Mat:
        """Return the tangent at points in background cells (collective)."""
        comm, volumes = self._pressure.mesh.comm, self._material.strain.weights.ravel()
        shear = undeformed_tangent(self._material.laws)[:, 0, 1, 0, 1]
        topology = self._pressure.V.mesh.topology
        cells = topology.index_map(topology.dim)
        assert basis.cell is not None and basis.rank is not None
        firsts = np.array(comm.allgather(cells.local_range[0]), dtype=np.int64)
        columns = (firsts[basis.rank] + basis.cell).astype(PETSc.IntType)
        points = self._force.getSizes()
        sizes = points, (cells.size_local, cells.size_global)
        rows = np.arange(len(volumes) + 1, dtype=PETSc.IntType)
        sums = PETSc.Mat().createAIJ(sizes, csr=(rows, columns, volumes), comm=comm)
        ones, volume = sums.createVecLeft(), sums.createVecRight()
        ones.set(1.0)
        # rows of cells: the product by columns would add in the order in which ranks answer
        of_cells = sums.transpose(PETSc.Mat())
        of_cells.mult(ones, volume)
        weight, stiffness = volume.duplicate(), ones.duplicate()
        stiffness.array_w[:] = shear
        of_cells.mult(stiffness, weight)
        # volume / weight is one over the mean shear modulus of a cell
        filled = weight.array_r > 0.0
        share = np.zeros(len(filled))
        share[filled] = self._weight / 2.0 / weight.array_r[filled]
        weight.array_w[:] = np.sqrt(share)
        volume.array_w[:] = share * volume.array_r
        factors = ones.duplicate()
        picked = sums.copy()
        picked.setValuesCSR(rows, columns, np.ones(len(volumes)))
        picked.assemble()
        picked.mult(volume, factors)
        sums.diagonalScale(R=weight)
        matrix = sums.matMult(sums.transpose(PETSc.Mat()))
        diagonal = matrix.getDiagonal()
        diagonal.array_w[:] -= factors.array_r * volumes
        matrix.setDiagonal(diagonal)
        return matrix
