# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Stock assembly of residuals and tangents, one compiled form per quadrature rule."""

from __future__ import annotations

from functools import cached_property
from typing import Any

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem
from dolfinx.fem import petsc as fem_petsc

from . import _compat
from .errors import MPMError
from .f_bar import LowRankTangent
from .particles import Particles
from .quadrature import depends_on, follows, split_by_rule

# Their types name the first of several dispatched signatures only.
assemble_vector: Any = fem_petsc.assemble_vector
assemble_matrix: Any = fem_petsc.assemble_matrix

__all__ = ["BackgroundForms", "BodyForms"]


def _arguments(form: Any, rank: int, space: fem.FunctionSpace, what: str, where: str) -> Any:
    """Return test (and trial) function of a form, if they are from a space."""
    arguments = form.arguments() if isinstance(form, ufl.Form) else ()
    if len(arguments) != rank:
        kind = "one test function" if rank == 1 else "a test and a trial function"
        raise MPMError(f"{what} must be a UFL form with {kind} of {where}.")
    if any(argument.ufl_function_space() != space for argument in arguments):
        kind = "test function" if rank == 1 else "test and trial functions"
        raise MPMError(f"The {kind} of {what} must be from {where}.")
    return arguments


def _assemble_into(vector: PETSc.Vec, forms: list[fem.Form]) -> None:
    with vector.localForm() as local:
        local.set(0.0)
    for form in forms:
        assemble_vector(vector, form)
    vector.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)


class BodyForms:
    """A residual on the body mesh, one compiled form per quadrature rule.

    Args:
        R: Residual in the displacement and a test function of W.
        J: Its tangent, or ``None`` for ``ufl.derivative``.
        particles: The body.
        **options: Passed on to ``dolfinx.fem.form``.

    Attributes:
        K: The tangent on W that was assembled last.
        low_rank: What the tangent has besides the forms, or ``None``.

    Raises:
        MPMError: A form with other arguments, or rules that do not go together.
    """

    def __init__(
        self,
        R: ufl.Form,
        J: ufl.Form | None,
        particles: Particles,
        **options: Any,
    ) -> None:
        self._options = options
        (self._test,) = _arguments(R, 1, particles.W, "the residual R", "particles.W")
        d = particles.displacement
        parts = split_by_rule(R, d)
        if particles.deletion is not None:
            parts = [particles.deletion.present_only(part) for part in parts]
        live = [p for p in parts if follows(p, d)]
        dead = [p for p in parts if not follows(p, d)]
        if J is None:
            tangents = [ufl.derivative(p, d) for p in live if depends_on(p, d)]
        else:
            _arguments(J, 2, particles.W, "the tangent J", "particles.W")
            tangents = split_by_rule(J, d)
            if particles.deletion is not None:
                tangents = [particles.deletion.present_only(part) for part in tangents]
        if not tangents:
            raise MPMError(
                "The residual R does not depend on particles.displacement; write it in that "
                "Function, or give its tangent as J."
            )
        self._parts = parts
        self._body = particles.mesh
        self._element = particles.W.ufl_element()
        self._live = self._compile(live)
        self._dead = self._compile(dead)
        self._tangents = self._compile(tangents)
        self._sparse: PETSc.Mat = fem_petsc.create_matrix(self._pattern(tangents, particles.W))
        self.K: PETSc.Mat = self._sparse
        self.low_rank: LowRankTangent | None = None
        self.r: PETSc.Vec = _compat.create_vector(particles.W)
        self.external: PETSc.Vec = _compat.create_vector(particles.W)

    def _compile(self, forms: list[ufl.Form]) -> list[fem.Form]:
        return [fem.form(form, **self._options) for form in forms]

    def _pattern(self, tangents: list[ufl.Form], W: fem.FunctionSpace) -> fem.Form:
        """Return a form whose sparsity holds all tangents."""
        kinds = {i.integral_type() for t in tangents for i in t.integrals()}
        if "interior_facet" not in kinds:
            for form, compiled in zip(tangents, self._tangents, strict=True):
                for i in form.integrals():
                    if (i.integral_type(), i.subdomain_id()) == ("cell", "everywhere"):
                        return compiled
        u, v = ufl.TrialFunction(W), ufl.TestFunction(W)
        pattern = ufl.inner(u, v) * ufl.dx
        if "interior_facet" in kinds:
            pattern += ufl.inner(ufl.avg(u), ufl.avg(v)) * ufl.dS
        return self._compile([pattern])[0]

    def assemble_external(self) -> None:
        """Assemble the parts that do not depend on the displacement."""
        _assemble_into(self.external, self._dead)

    def assemble_residual(self) -> PETSc.Vec:
        """Assemble the residual; the external parts are those of ``assemble_external``."""
        _assemble_into(self.r, self._live)
        self.r.axpy(1.0, self.external)
        return self.r

    def assemble_tangent(self) -> PETSc.Mat:
        """Assemble the tangent, always the same object."""
        self._sparse.zeroEntries()
        for form in self._tangents:
            assemble_matrix(self._sparse, form)
        self._sparse.assemble()
        if self.low_rank is not None:
            self.K = self.low_rank.added_to(self._sparse)
        return self.K

    @cached_property
    def _elementwise(self) -> tuple[list[fem.Form], PETSc.Vec]:
        """The residual tested domain by domain: element vectors that are not summed."""
        broken = fem.functionspace(
            self._body,
            ("Discontinuous Lagrange", self._element.degree, (self._element.block_size,)),
        )
        swap = {self._test: ufl.TestFunction(broken)}
        forms = self._compile([ufl.replace(part, swap) for part in self._parts])
        return forms, _compat.create_vector(broken)

    def absolute_contributions(self, domain_nodes: NDArray[np.int32]) -> PETSc.Vec:
        """Return the sum over domains of the absolute values of what each adds to the residual.

        It measures the forces inside a body that is in equilibrium with itself.
        """
        forms, vector = self._elementwise
        _assemble_into(vector, forms)
        gdim = self._element.block_size
        n, k = domain_nodes.shape
        own = np.abs(vector.array_r[: n * k * gdim]).reshape(n, k, gdim)
        total = self.r.duplicate()
        with total.localForm() as local:
            local.set(0.0)
            np.add.at(local.array_w.reshape(-1, gdim), domain_nodes, own)
        total.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
        return total


class BackgroundForms:
    """Terms on the background mesh, in the step's increment.

    Args:
        F: Form in ``particles.increment`` and a test function of V.
        particles: The body.
        **options: Passed on to ``dolfinx.fem.form``.
    """

    def __init__(self, F: ufl.Form, particles: Particles, **options: Any) -> None:
        _arguments(F, 1, particles.V, "the background form", "the background space V")
        u = particles.increment
        parts = split_by_rule(F, u)
        tangents = [ufl.derivative(p, u) for p in parts if depends_on(p, u)]
        if not tangents:
            raise MPMError("The background form does not depend on particles.increment.")
        self._residuals = [fem.form(p, **options) for p in parts]
        self._tangents = [fem.form(t, **options) for t in tangents]
        self._matrices = [fem_petsc.create_matrix(t) for t in self._tangents]
        self.r: PETSc.Vec = _compat.create_vector(particles.V)

    def assemble_residual(self) -> PETSc.Vec:
        """Assemble the residual on V."""
        _assemble_into(self.r, self._residuals)
        return self.r

    def assemble_tangent(self) -> PETSc.Mat:
        """Assemble the tangent on V."""
        for matrix, form in zip(self._matrices, self._tangents, strict=True):
            matrix.zeroEntries()
            assemble_matrix(matrix, form)
            matrix.assemble()
        total = self._matrices[0]
        if len(self._matrices) > 1:
            total = total.copy()
            for matrix in self._matrices[1:]:
                total.axpy(1.0, matrix)
        return total

    def support(self) -> NDArray[np.int32]:
        """Return this rank's own dofs of V that the form acts on."""
        return np.flatnonzero(self.assemble_tangent().getDiagonal().array_r).astype(np.int32)
