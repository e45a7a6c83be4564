# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Equations of fields on a body's own mesh, solved in turn with the displacements."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, override

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem

from ..assembly.field_forms import FieldForms
from ..errors import ConvergenceError, MPMError, agree
from ..io.snapshot import Kept, Taken, fill, of_cells
from ..meshes.remesh import Column
from ..parallel.boundary import collective
from ..parallel.conjugate_gradients import conjugate_gradients
from ..parallel.given import is_number
from ..parallel.totals import over_ranks
from ..particles.field import ParticleField
from ..particles.particles import Particles
from ..tolerances import ARMIJO, LOCAL_ITERATIONS, SOLVED
from .term import PointMaterial, Term

__all__ = ["FieldEquation"]

type Bound = float | fem.Function | str | None
"""A number, a Function on the field's W, ``"previous"``, or none."""


class FieldEquation(Term):
    """Equation of a field on a body's own mesh, which steps solve in turn with the displacements.

    Give it to a problem among its ``terms``. The residual may depend on the displacement, on
    ``field.previous`` and on any data; its derivative by the field must be symmetric and
    positive, as that of an energy that has a minimum. Within each step the displacements are found
    with the field as it is and the field with the displacements as they are, in turn, until both
    hold together.

    With bounds the energy is made least between them: the residual vanishes where the field is
    between its bounds, and points into the bound where it is at one (Newton's method, projected,
    with a line search: Bertsekas 1982, SIAM J. Control Optim. 20).

    Args:
        field: The field, ``mpm.ParticleField(particles, Q, at="nodes", kind="body")``.
        residual: Its residual, with a test function of ``field.W``.
        lower: Least value: a number, a Function on ``field.W``, or ``"previous"``: the field never
            falls below its values at the last converged step.
        upper: Largest value, likewise.

    Attributes:
        field: As given.
        lower: As given.
        upper: As given.

    Raises:
        MPMError: A field of another kind, or bounds that make no sense.
    """

    from_outside = False
    one_sided = False
    symmetric = True  # it adds nothing to the tangent of the displacements
    evaluation = "alternate()"

    @collective()
    def __init__(
        self,
        field: ParticleField,
        residual: ufl.Form,
        *,
        lower: Bound = None,
        upper: Bound = None,
    ) -> None:
        if not isinstance(field, ParticleField):
            raise MPMError(f"A field equation is that of a field, not of {field!r}.")
        body = field.particles
        if not isinstance(body, Particles) or field.kind != "body" or field.at != "nodes":
            raise MPMError(
                f"The field '{field.name}' cannot be solved for in turn with the displacements; "
                "make it by mpm.ParticleField(particles, Q, at='nodes', kind='body')."
            )
        super().__init__([body])
        self.field, self.lower, self.upper = field, lower, upper
        for bound in (lower, upper):
            self._require_bound(bound)
        numbers: list[Any] = [bound for bound in (lower, upper) if is_number(bound)]
        if numbers != sorted(numbers):
            raise MPMError(
                f"The field '{field.name}' has nothing between its bounds {lower} and {upper}."
            )
        self._forms = FieldForms(body, [field], None, [residual])
        self._own = field.W.dofmap.index_map.size_local * field.W.dofmap.index_map_bs
        self._comm: MPI.Comm = body.mesh.comm
        self._number = self._body_number = 0
        self._ksp = conjugate_gradients(self._comm)

    def _require_bound(self, bound: Any) -> None:
        known = bound is None or bound == "previous" or (is_number(bound) and np.isfinite(bound))
        if isinstance(bound, fem.Function):
            known = bound.function_space is self.field.W
        if not known:
            raise MPMError(
                f"A bound of the field '{self.field.name}' must be a finite number, a Function on "
                f"its W or 'previous', not {bound!r}; omit one that there is not."
            )

    # -- What a problem asks ---------------------------------------------------------------------

    @property
    @override
    def equation(self) -> FieldEquation:
        return self

    @override
    def take_part(
        self,
        number: int,
        bodies: Sequence[Particles],
        materials: Sequence[PointMaterial | None],
    ) -> None:
        self._number = number
        self._body_number = next(i for i, one in enumerate(bodies) if one is self.bodies[0])
        with agree(self._comm):
            if self.field.W.mesh is not self.bodies[0].mesh:
                raise MPMError(
                    f"The field '{self.field.name}' lives on a mesh that its body has left."
                )

    def alternate(self) -> int:
        """See :class:`~mpm_dolfinx.system.term.Alternating`."""
        self._forms.assemble_external()
        p, own = self.field.x, self._own
        lower, upper = self._bounds()
        p.array[:own] = np.clip(p.array[:own], lower, upper)
        p.scatter_forward()
        for solves in range(LOCAL_ITERATIONS):
            (residual,) = self._forms.assemble_residuals()
            matrix = self._forms.assemble_tangents()[1, 1]
            diagonal = matrix.getDiagonal().array_r
            if over_ranks(self._comm, bool(np.any(diagonal <= 0.0)), MPI.LOR):
                raise self._indefinite()
            values, slope = p.array[:own].copy(), residual.array_r
            missed = np.abs(np.clip(values - slope / diagonal, lower, upper) - values)
            size, missing = (float(np.abs(one).max(initial=0.0)) for one in (values, missed))
            # (what MPI makes of the larger one of a number and NaN depends on their order)
            if over_ranks(self._comm, not np.isfinite(missing), MPI.LOR):
                break
            missing, size = (over_ranks(self._comm, one, MPI.MAX) for one in (missing, size))
            if missing <= SOLVED * size:
                return solves
            held = ((values <= lower) & (slope >= 0.0)) | ((values >= upper) & (slope <= 0.0))
            step = self._solved(matrix, residual, held | (lower == upper))
            p.array[:own] = self._projected(matrix, slope, values, step, (lower, upper))
            p.scatter_forward()
        raise ConvergenceError(
            f"The equation of the field '{self.field.name}' was not solved in "
            f"{LOCAL_ITERATIONS} solves"
        )

    def _projected(
        self,
        matrix: PETSc.Mat,
        slope: NDArray[np.float64],
        values: NDArray[np.float64],
        step: NDArray[np.float64],
        bounds: tuple[NDArray[np.float64], NDArray[np.float64]],
    ) -> NDArray[np.float64]:
        """Return values a part of a step on, put back between bounds, at which energy is less.

        Args:
            matrix: The second derivative of the energy.
            slope: The first one, on this rank's own dofs; so are the others.
            values: Where it is.
            step: Newton's step from there, 0 at dofs that are held.
            bounds: Least and largest values.
        """
        change, force = matrix.createVecs()
        part = 1.0
        for _ in range(LOCAL_ITERATIONS):
            new = np.clip(values + part * step, *bounds)
            change.array_w[:] = new - values
            matrix.mult(change, force)
            falls = float(slope @ change.array_r)
            rest = 0.5 * float(change.array_r @ force.array_r)
            falls, rest = (over_ranks(self._comm, one) for one in (falls, rest))
            if falls + rest <= ARMIJO * falls:
                break
            part *= 0.5
        return np.asarray(new)

    def _bounds(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the least and the largest values of this rank's own dofs."""

        def values(bound: Bound, none: float) -> NDArray[np.float64]:
            if bound is None:
                return np.full(self._own, none)
            if isinstance(bound, str):
                return np.array(self.field.previous.x.array[: self._own])
            if isinstance(bound, fem.Function):
                return np.array(bound.x.array[: self._own])
            return np.full(self._own, float(bound))

        lower, upper = values(self.lower, -np.inf), values(self.upper, np.inf)
        return lower, np.maximum(lower, upper)

    def _solved(
        self,
        matrix: PETSc.Mat,
        residual: PETSc.Vec,
        held: NDArray[np.bool_],
    ) -> NDArray[np.float64]:
        """Return Newton's step without dofs that are held, on this rank's own dofs."""
        x, b = matrix.createVecs()
        x.set(0.0)
        b.array_w[:] = -residual.array_r
        first = matrix.getOwnershipRange()[0]
        rows = (first + np.flatnonzero(held)).astype(PETSc.IntType)
        matrix.zeroRowsColumns(rows, 1.0, x, b)
        self._ksp.setOperators(matrix)
        self._ksp.solve(b, x)
        if self._ksp.getConvergedReason() < 0:
            raise self._indefinite()
        return np.where(held, 0.0, x.array_r)

    def _indefinite(self) -> ConvergenceError:
        return ConvergenceError(
            f"The tangent of the field '{self.field.name}' is not positive definite, as that of an "
            "energy with a minimum is"
        )

    # -- History ---------------------------------------------------------------------------------

    @override
    def commit(self) -> Callable[[], None]:
        before = self.field.previous.x.array.copy()
        self.field.previous.x.array[:] = self.field.x.array

        def undo() -> None:
            self.field.previous.x.array[:] = before

        return undo

    @override
    def roll_back(self) -> None:
        self.field.x.array[:] = self.field.previous.x.array

    @override
    def kept(self) -> Sequence[Kept]:
        return [_Values(self, self.name or f"equation{self._number}")]

    def columns(self, body: int | None) -> dict[str, Column]:
        """Return the arrays that are kept on a body, by its number in the problem."""
        if body != self._body_number:
            return {}
        return {self.field.name: Column(of_cells(self.field.previous), "nodes")}

    def take(self, taken: Taken) -> None:
        """Take what was kept (collective)."""
        fill(self.field.previous, taken.columns[self._body_number][self.field.name])
        self.roll_back()


class _Values(Kept):
    """The converged values of a field.

    Args:
        equation: Its equation.
        key: See :class:`Kept`.
    """

    def __init__(self, equation: FieldEquation, key: str) -> None:
        self._equation, self.key = equation, key

    @override
    def columns(self, body: int | None) -> dict[str, Column]:
        return self._equation.columns(body)

    @override
    def restore(self, taken: Taken) -> None:
        self._equation.take(taken)
