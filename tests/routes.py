# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The reference: stress as data in UFL forms, DOLFINx's assembly, and PETSc's products with T."""

from contextlib import contextmanager
from unittest.mock import patch

from petsc4py import PETSc

import numpy as np
import returns

import ufl

from mpm_dolfinx.assembly.body_forms import BodyForms
from mpm_dolfinx.assembly.petsc import MatrixSum
from mpm_dolfinx.constitutive.strain import strain_of
from mpm_dolfinx.materials.base import StrainMaterial
from mpm_dolfinx.materials.compiled import CompiledMaterial
from mpm_dolfinx.problems import parts, physics
from mpm_dolfinx.system.pressure import PressureTerm
from mpm_dolfinx.system.term import Term

#: Where tangents come from: compiled loops, domain by domain, or the reference.
ROUTES = ["loops", "reference"]


@contextmanager
def on_route(route):
    """Let problems that are made, and run, in this context take a route.

    On the reference, laws are updated in Python too.
    """
    if route == "loops":
        yield
        return
    with (
        patch.object(parts, "BodyForms", ReferenceForms),
        patch.object(physics, "PressureTerm", ReferencePressure),
        patch.object(CompiledMaterial, "update", StrainMaterial.update),
        patch.object(CompiledMaterial, "at_pressure", StrainMaterial.at_pressure),
        patch.object(CompiledMaterial, "integrate", returns.integrate),
    ):
        yield


class ReferenceForms(BodyForms):
    """A residual of which DOLFINx assembles all, with stress and tangent as data at points."""

    def __init__(self, R, J, particles, internal=None, low_rank=None, others=(), **options):
        self._stress = internal
        if internal is not None:
            strain = self._strain = strain_of(particles, internal.strain.hoop is not None)
            dim = strain.dim
            P = particles.quadrature_function("first_piola", (dim, dim))
            A = particles.quadrature_function("tangent", (dim,) * 4)
            self._data = P, A
            i, j, k, m = ufl.indices(4)
            v = ufl.TestFunction(particles.W)
            test = strain.ufl_gradient(v)
            trial = strain.ufl_gradient(ufl.TrialFunction(particles.W))
            work = strain.integral(ufl.inner(P, test))
            slope = strain.integral(A[i, j, k, m] * trial[k, m] * test[i, j])
            R = work if R is None else R + work
            J = slope if J is None else J + slope
        super().__init__(R, J, particles, None, low_rank, others, **options)
        self._identity, self._parts_on_W, self._whole = None, None, MatrixSum()

    low_rank = None

    def low_rank_of_domains(self):
        return None

    def takes(self, form):
        return False

    def _inject(self):
        """Take stress and tangent to the body mesh as it is: ``P G^T / det G``, G behind it."""
        if self._stress is None:
            return
        stress, tangent = self._stress.first_piola, self._stress.tangent
        before = self._strain.before_mesh()
        if before is not None:
            gdim = before.shape[-1]
            G = np.tile(np.eye(stress.shape[-1]), (len(stress), 1, 1))
            G[:, :gdim, :gdim] = before.reshape(-1, gdim, gdim)
            volume = np.linalg.det(G)[:, None, None]
            stress = np.einsum("niJ,nMJ->niM", stress, G) / volume
            tangent = np.einsum("niJkL,nMJ,nNL->niMkN", tangent, G, G, optimize=True)
            tangent = tangent / volume[:, :, :, None, None]
        for function, values in zip(self._data, (stress, tangent), strict=True):
            function.x.array[: values.size] = values.ravel()

    def assemble_residual(self):
        self._inject()
        return super().assemble_residual()

    def absolute_contributions(self, domain_nodes):
        self._inject()
        return super().absolute_contributions(domain_nodes)

    def assemble_tangent(self):
        self._inject()
        super().assemble_tangent()
        if self._low_rank is not None:
            if self._identity is None:
                layout = self.r.getSizes()
                ones = self.r.duplicate()
                ones.set(1.0)
                self._identity = PETSc.Mat().createAIJ((layout, layout), nnz=1, comm=self.r.comm)
                self._identity.setDiagonal(ones)
                self._identity.assemble()
            last = self._low_rank.reduced(self._identity, self._parts_on_W)
            self._parts_on_W = last
            self.K = self._whole.of([self._sparse, *last.parts])
        return self.K

    def stiffness_force(self, w):
        return self.K * w


class ReferencePressure(PressureTerm):
    """A constraint on volume whose blocks are matrices on points and nodes, reduced by products."""

    def __init__(self, particles, pressure, material):
        super().__init__(particles, pressure, material)
        self.coupling = None
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
        self._mats = None

    def _rows(self, slope):
        return np.take_along_axis(
            self.by_nodes(slope), self._order[:, None, :, None], axis=2
        ).ravel()

    def tangents(self):
        found = self._material.volume_strain
        diagonal = self._force.duplicate()
        diagonal.array_w[:] = -self._material.strain.weights.ravel() * found.compliance
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

    def stiffness_force(self, motions):
        return Term.stiffness_force(self, motions)

    def _matrices(self):
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
