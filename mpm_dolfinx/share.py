# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""One body's share of the reduced system of a step."""

from __future__ import annotations

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from .assembly import BodyForms
from .particles import Particles

__all__ = ["Body"]


class Body:
    """One body's share of the reduced system.

    Args:
        particles: The body.
        forms: Its residual and tangent.
    """

    def __init__(self, particles: Particles, forms: BodyForms) -> None:
        self.particles = particles
        self.forms = forms
        self._free_T: PETSc.Mat | None = None
        self._product: PETSc.Mat | None = None

    def restrict(self, columns: PETSc.IS, extension: PETSc.Mat | None = None) -> None:
        """Take over the present transfer ``T`` and free dofs, or ``T E`` with an extension."""
        T = self.particles.T
        self._work = T.createVecLeft()
        self._product = None
        if self.forms.stock:
            if extension is not None:
                T = T.matMult(extension)
            first, last = T.getOwnershipRange()
            rows = PETSc.IS().createStride(last - first, first, step=1, comm=T.comm)
            self._free_T = T.createSubMatrix(rows, columns)

    def move(self, u: PETSc.Vec) -> None:
        """Set ``d = d_n + T u``."""
        self.particles.T.mult(u, self._work)
        d = self.particles.displacement.x
        rows = self._work.getLocalSize()
        self._before = self.particles.converged_displacement[:rows]
        d.array[:rows] = self._before + self._work.array_r
        d.scatter_forward()

    def increment(self) -> NDArray[np.float64]:
        """Return the last change of displacement on this rank's own dofs of W."""
        rows = self._work.getLocalSize()
        d = self.particles.displacement.x.array[:rows]
        return np.asarray(d - self._before)

    def tangent(self) -> PETSc.Mat:
        """Return ``T^T K T`` of the stock forms, always the same object within a step."""
        self._product = self.forms.assemble_tangent().ptap(self._free_T, result=self._product)
        return self._product

    def stiffness_force(self, u: PETSc.Vec) -> PETSc.Vec:
        """Return ``K T u`` on the body."""
        self.particles.T.mult(u, self._work)
        return self.forms.stiffness_force(self._work)

    def stock_force(self, u: PETSc.Vec) -> PETSc.Vec:
        """Return ``K T u`` on the body, of the stock forms."""
        self.particles.T.mult(u, self._work)
        force = self.forms.K.createVecLeft()
        self.forms.K.mult(self._work, force)
        return force

    def motion(self, u: PETSc.Vec) -> float:
        """Return the norm of the displacement that u in V causes."""
        self.particles.T.mult(u, self._work)
        return float(self._work.norm())

    def extent(self) -> float:
        """Return the norm of the positions of the body's nodes."""
        rows = self._work.getLocalSize()
        self._work.array_w[:] = self.particles.node_positions.ravel()[:rows]
        return float(self._work.norm())

    def shear_modulus(self) -> float:
        """Return the stiffness of the body to simple shear: its mean at the present state.

        It is the smallest positive energy ``g : C : g`` over uniform gradients g with one entry,
        for an isotropic elastic body its shear modulus, or the mean of it.
        """
        particles, u = self.particles, self.particles.T.createVecRight()
        gdim = particles.mesh.geometry.dim
        x = particles.V.tabulate_dof_coordinates()[: u.getLocalSize() // gdim, :gdim]
        volume = particles.mesh.comm.allreduce(float(particles.initial_volume.sum()))
        energies = []
        for i, j in np.ndindex(gdim, gdim):
            u.set(0.0)
            u.array_w.reshape(-1, gdim)[:, i] = x[:, j]
            force = self.stiffness_force(u)
            energies.append(force.dot(self._work) / volume)
        return min((energy for energy in energies if energy > 0.0), default=0.0)

    def nodal_size(self, force: PETSc.Vec) -> NDArray[np.float64]:
        """Return the size of ``T f`` at this rank's nodes."""
        self.particles.T.mult(force, self._work)
        return np.asarray(
            np.linalg.norm(self._work.array_r.reshape(-1, self.particles.mesh.geometry.dim), axis=1)
        )
