# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A form on the background itself."""

from __future__ import annotations

from typing import Any

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx.fem import petsc as fem_petsc

from ..errors import MPMError
from ..parallel.compilation import compiled_form
from ..particles.particles import Particles
from .petsc import MatrixSum, assemble_into, assemble_matrix, create_vector
from .rules import depends_on, parts_with

__all__ = ["BackgroundForms"]


class BackgroundForms:
    """Terms on the background mesh, in the step's increment.

    Args:
        F: Form in ``particles.increment`` and a test function of V.
        particles: The body.
        **options: Passed on to ``dolfinx.fem.form``.
    """

    def __init__(self, F: ufl.Form, particles: Particles, **options: Any) -> None:
        u, where = particles.increment, "the background space V"
        parts = parts_with(particles.V, F, 1, "the background form", where, u)
        tangents = [ufl.derivative(p, u) for p in parts if depends_on(p, u)]
        if not tangents:
            raise MPMError("The background form does not depend on particles.increment.")
        self._residuals = [compiled_form(p, **options) for p in parts]
        self._tangents = [compiled_form(t, **options) for t in tangents]
        self._matrices = [fem_petsc.create_matrix(t) for t in self._tangents]
        self._sum = MatrixSum()
        self.r: PETSc.Vec = create_vector(particles.V)

    def assemble_residual(self) -> PETSc.Vec:
        """Assemble the residual on V."""
        assemble_into(self.r, self._residuals)
        return self.r

    def assemble_tangent(self) -> PETSc.Mat:
        """Assemble the tangent on V, always the same object."""
        for matrix, form in zip(self._matrices, self._tangents, strict=True):
            matrix.zeroEntries()
            assemble_matrix(matrix, form)
            matrix.assemble()
        return self._sum.of(self._matrices)

    def support(self) -> NDArray[np.int32]:
        """Return this rank's own dofs of V that the form acts on."""
        return np.flatnonzero(self.assemble_tangent().getDiagonal().array_r).astype(np.int32)
