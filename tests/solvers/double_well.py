# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A problem of Newton's method without particles."""

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from mpm_dolfinx.history import Statistics
from mpm_dolfinx.solvers.newton import NewtonSolver


class DoubleWell:
    """Gradient of the sum of ``c_i (X_i^2 - 1)^2 / 4 - g X_i`` in ``x = X - start``."""

    def __init__(self, c, g, start=0.57):
        self.c, self.g, self.start = np.asarray(c, float), g, start
        n = len(self.c)
        self.K = PETSc.Mat().createAIJ((n, n), nnz=1, comm=MPI.COMM_SELF)
        self.x = np.zeros(n)

    softens = constrained = one_sided = False

    @property
    def itself(self):
        """It is so small that it is all that the solver asks for."""
        return self

    levels = resistance = terms = balance = itself
    held = False

    def residual(self, x, F):
        self.x = x.array_r + self.start
        F.array_w[:] = self.c * (self.x**3 - self.x) - self.g
        return None

    def tangent(self):
        for i, value in enumerate(self.c * (3.0 * self.x**2 - 1.0)):
            self.K.setValue(i, i, value)
        self.K.assemble()
        return self.K

    def potential(self, x):
        return float((self.c * (x * x - 1.0) ** 2 / 4.0 - self.g * x).sum())

    def smooth(self):
        return True

    def yielding(self):
        return []

    def diagonal(self, K):
        sizes = K.getDiagonal()
        sizes.abs()
        largest = sizes.max()[1]
        sizes.array_w[sizes.array_r == 0.0] = largest
        return sizes

    def rigid_motions(self):
        raise AssertionError("for multigrid only")

    def interpolations(self, coarsest):
        return []

    def prediction(self):
        return None

    def constrain(self, y, x, solve):
        return 0

    def impose(self):
        return False

    def scale(self, F=None):
        return 1.0

    def internal_scale(self):
        return 1.0

    def resultant(self):
        return 0.0

    def stiffness(self, x):
        return x.dot(self.K * x)

    def motion(self, x):
        return x.norm()

    def extent(self):
        return 1.0

    def field_of(self, x):
        return None

    def is_rigid(self, x):
        return True

    def work_tells(self):
        return True


def newton(**options):
    given = {"symmetric": True, "shift": 1e-13, "line_search": True, **options}
    return NewtonSolver(MPI.COMM_SELF, "hill_", {}, statistics=Statistics(), dim=1, **given)
