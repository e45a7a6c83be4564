# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Parameters of many values, and sums of derivatives by these."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem, la

from .. import _compat
from ..errors import MPMError
from ..materials.base import Material
from ..parallel.compilation import compiled_form
from ..particles.particles import Particles
from ..problems.quasistatic import QuasiStaticProblem
from .parameters import Parameter, as_parameter, largest

__all__ = ["Many", "assembled"]

type Array = NDArray[np.float64]


class Many:
    """A parameter, all values of which change by themselves.

    Args:
        given: As the user names it.
        problem: The problem.

    Attributes:
        function: The Function whose values these are; ``None`` for one number.
        parameter: All of them, as one.
        total: The sum of derivatives.

    Raises:
        MPMError: It is nothing by which an :class:`Adjoint` differentiates.
    """

    def __init__(self, given: Any, problem: QuasiStaticProblem) -> None:
        self._thing, whole = given, True
        if isinstance(given, tuple) and len(given) == 2:
            whole = isinstance(given[0], Material)
            self._thing = given[0].parameters.get(str(given[1])) if whole else given[0]
        function = whole and isinstance(self._thing, fem.Function)
        self.function: fem.Function | None = self._thing if function else None
        self._sizes: Array = np.ones(1)
        if self.function is not None:
            values = np.abs(self.function.x.array)
            size = largest(values, problem)
            if size == 0.0:
                raise MPMError(f"'{self.function.name}' is zero, which says nothing of its size.")
            if not np.isfinite(size):
                raise MPMError(f"'{self.function.name}' must be finite to differentiate by it.")
            self._sizes = np.where(values > 1e-3 * size, values, size)
            given = (self.function, self._sizes)
        self.parameter: Parameter = as_parameter(given, problem, None)
        if isinstance(self._thing, fem.Constant | fem.Function) and any(
            _compat.holds(bc, self._thing) for bc in problem.bcs
        ):
            raise MPMError("An Adjoint does not differentiate by Dirichlet values yet.")
        self.total: Array = np.zeros(self._sizes.shape if self.function is not None else ())
        self._problem = problem

    def zero(self) -> None:
        """Forget what was added."""
        self.total = np.zeros(self.total.shape)

    def add_of_points(self, body: Particles, values: Array) -> None:
        """Add derivatives at the points of a body, by the amount, shape ``(n nq,)``."""
        self.add_of_cells(body, values.reshape(body.num_local, -1).sum(axis=1))

    def add_of_cells(self, body: Particles, values: Array) -> None:
        """Add derivatives in the owned cells of a body, by the amount."""
        if self.function is None:
            self.total = self.total + values.sum()
        elif self.function.function_space.mesh is body.mesh:
            dofs = self.function.function_space.dofmap.list[: body.num_local, 0]
            self.total[dofs] += values / self._sizes[dofs]

    def is_in(self, form: ufl.Form) -> bool:
        """Return whether a form has it in itself."""
        return any(one is self._thing for one in (*form.coefficients(), *form.constants()))

    def add_of_form(self, form: ufl.Form) -> None:
        """Add derivatives of a form by what it has of this in itself (collective)."""
        if self.function is not None:
            self.total += assembled(ufl.derivative(form, self.function))
            return
        compiled, sides = compiled_form(form), []
        for sign in (1.0, -1.0):
            self.parameter.shift(sign * self.parameter.change)
            sides.append(np.asarray(fem.assemble_scalar(compiled)))
        self.parameter.shift(0.0)
        self.total = self.total + self.parameter.slope(*sides)

    def result(self) -> Array:
        """Return the sum, over all ranks (collective)."""
        if self.function is None:
            comm: MPI.Comm = self._problem.bodies[0].mesh.comm
            return np.asarray(comm.allreduce(float(self.total)))
        whole = fem.Function(self.function.function_space)
        whole.x.array[:] = self.total
        whole.x.scatter_forward()
        return np.asarray(whole.x.array)


def assembled(form: ufl.Form) -> Array:
    """Return a linear form, assembled on the local dofs with those of other ranks (collective)."""
    vector = fem.assemble_vector(compiled_form(form))
    vector.scatter_reverse(la.InsertMode.add)
    vector.scatter_forward()
    return np.asarray(vector.array)
