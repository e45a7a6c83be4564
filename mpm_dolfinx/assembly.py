# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Residuals and tangents on the body mesh, one compiled form per quadrature rule."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cached_property
from typing import Any, Protocol

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem
from dolfinx.fem import petsc as fem_petsc

from . import _compat
from ._core import loops
from .errors import MPMError
from .f_bar import LowRankTangent, LowRankTerm
from .particles import Particles
from .quadrature import depends_on, follows, split_by_rule
from .volume_average import average_in

# Their types name the first of several dispatched signatures only.
assemble_vector: Any = fem_petsc.assemble_vector
assemble_matrix: Any = fem_petsc.assemble_matrix

__all__ = ["ROUTES", "BackgroundForms", "BodyForms", "PointStress", "is_fast"]

ROUTES = ("auto", "fast", "reference")


class PointStress(Protocol):
    """Stress at a body's quadrature points, of which the compiled loops make forces.

    Attributes:
        first_piola: First Piola stress, shape ``(n nq, dim, dim)``.
        tangent: Its derivative by F, shape ``(n nq, dim, dim, dim, dim)``.
    """

    first_piola: NDArray[np.float64]
    tangent: NDArray[np.float64]

    @property
    def symmetric(self) -> bool:
        """Whether the tangent has major symmetry."""

    @property
    def low_rank(self) -> Sequence[LowRankTerm]:
        """What the tangent has besides, each domain for itself."""


def is_fast(route: str) -> bool:
    """Return whether a route is that of the compiled loops.

    Args:
        route: ``"fast"``, ``"reference"``, or ``"auto"``: what the environment variable
            ``MPM_DOLFINX_ASSEMBLY`` says, or else fast where the loops were built.

    Raises:
        MPMError: There is no such route, or no compiled loops to be fast.
    """
    if route == "auto":
        route = os.environ.get("MPM_DOLFINX_ASSEMBLY", "fast" if loops else "reference")
    if route not in ROUTES[1:]:
        raise MPMError(f"Unknown assembly={route!r}; choose 'auto', 'fast' or 'reference'.")
    if route == "fast" and loops is None:
        raise MPMError(
            "assembly='fast' needs the compiled loops, and the package was built without a C++ "
            "compiler; install one and build the package again, or use assembly='reference'."
        )
    return route == "fast"


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


def _assemble_into(
    vector: PETSc.Vec, forms: list[fem.Form], start: NDArray[np.float64] | None = None
) -> None:
    """Assemble forms, added to what this rank has at its own and ghost dofs."""
    with vector.localForm() as local:
        local.set(0.0)
        if start is not None:
            local.array_w[:] = start
    for form in forms:
        assemble_vector(vector, form)
    vector.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)


def _couples_cells(form: ufl.Form) -> bool:
    """Return whether a form's element tensors have dofs of more than one cell."""
    return any(i.integral_type() not in ("cell", "exterior_facet") for i in form.integrals())


class BodyForms:
    """A residual on the body mesh, one compiled form per quadrature rule.

    Args:
        R: Residual in the displacement and a test function of W; ``None`` where the internal
            stress is all there is.
        J: Its tangent, or ``None`` for ``ufl.derivative``.
        particles: The body.
        internal: Stress whose virtual work ``P : grad v`` is added by the compiled loops.
        fast: Whether :attr:`fused` forms are left to the compiled loops.
        **options: Passed on to ``dolfinx.fem.form``.

    Attributes:
        internal: As given.
        fused: Parts of the tangent that the compiled loops assemble.
        stock: Parts of the tangent in :attr:`K`.
        follows_load: Whether what the load factor does depends on the displacement.
        K: The stock parts of the tangent, on W, as assembled last.
        low_rank: What the tangent has besides the forms, or ``None``.

    Raises:
        MPMError: A form with other arguments, or rules that do not go together.
    """

    def __init__(
        self,
        R: ufl.Form | None,
        J: ufl.Form | None,
        particles: Particles,
        internal: PointStress | None = None,
        fast: bool = False,
        **options: Any,
    ) -> None:
        self._options = options
        self._particles = particles
        self.internal = internal
        d = particles.displacement
        parts: list[ufl.Form] = []
        self._average = average_in(R)
        fast = fast and self._average is None
        if R is not None:
            (self._test,) = _arguments(R, 1, particles.W, "the residual R", "particles.W")
            parts = split_by_rule(R, d)
        if particles.deletion is not None:
            parts = [particles.deletion.present_only(part) for part in parts]
        live = [p for p in parts if follows(p, d)]
        dead = [p for p in parts if not follows(p, d)]
        tangents: list[ufl.Form]
        if J is None:
            tangents = [ufl.derivative(p, d) for p in live if depends_on(p, d)]
        else:
            _arguments(J, 2, particles.W, "the tangent J", "particles.W")
            tangents = split_by_rule(J, d)
            if particles.deletion is not None:
                tangents = [particles.deletion.present_only(part) for part in tangents]
        if not tangents and internal is None:
            raise MPMError(
                "The residual R does not depend on particles.displacement; write it in that "
                "Function, or give its tangent as J."
            )
        self._parts = parts
        self._body = particles.mesh
        self._element = particles.W.ufl_element()
        self._live = self._compile(live)
        self._dead = self._compile(dead)
        load = particles.load
        self._loaded = [
            form
            for part, form in zip([*live, *dead], [*self._live, *self._dead], strict=True)
            if any(constant is load for constant in part.constants())
        ]
        self.follows_load = any(any(c is load for c in part.constants()) for part in live)
        together = [fast and not _couples_cells(form) for form in tangents]
        compiled = self._compile(tangents)
        self.fused = [form for form, fuse in zip(compiled, together, strict=True) if fuse]
        self.stock = [form for form, fuse in zip(compiled, together, strict=True) if not fuse]
        self._stock_ufl = [form for form, fuse in zip(tangents, together, strict=True) if not fuse]
        self.low_rank: LowRankTangent | None = None
        if self._average is not None:
            self.low_rank = self._average.tangent()
        self.r: PETSc.Vec = _compat.create_vector(particles.W)
        self.external: PETSc.Vec = _compat.create_vector(particles.W)

    def _compile(self, forms: list[ufl.Form]) -> list[fem.Form]:
        return [fem.form(form, **self._options) for form in forms]

    @cached_property
    def _sparse(self) -> PETSc.Mat:
        matrix = fem_petsc.create_matrix(self._pattern(self._stock_ufl, self._particles.W))
        self.K: PETSc.Mat = matrix
        return matrix

    def _pattern(self, tangents: list[ufl.Form], W: fem.FunctionSpace) -> fem.Form:
        """Return a form whose sparsity holds all tangents."""
        kinds = {i.integral_type() for t in tangents for i in t.integrals()}
        if "interior_facet" not in kinds:
            for form, compiled in zip(tangents, self.stock, strict=True):
                for i in form.integrals():
                    if (i.integral_type(), i.subdomain_id()) == ("cell", "everywhere"):
                        return compiled
        u, v = ufl.TrialFunction(W), ufl.TestFunction(W)
        pattern = ufl.inner(u, v) * ufl.dx
        if "interior_facet" in kinds:
            pattern += ufl.inner(ufl.avg(u), ufl.avg(v)) * ufl.dS
        return self._compile([pattern])[0]

    def update_average(self) -> None:
        """Set the averaged volume ratio that the residual may hold (collective)."""
        if self._average is not None:
            self._average.update()

    def assemble_external(self) -> None:
        """Assemble the parts that do not depend on the displacement."""
        _assemble_into(self.external, self._dead)

    def load_derivative(self, order: int = 1) -> tuple[PETSc.Vec, float]:
        """Return a difference quotient of the residual by the load factor (collective).

        Args:
            order: 1, which is the derivative where the residual is affine in the load factor,
                or 2, which is zero there.

        Returns:
            The quotient, and the size of what it is the difference of.
        """
        load, coefficients = self._particles.load, {1: (-1.0, 1.0), 2: (1.0, -2.0, 1.0)}[order]
        present, size = load.value.copy(), 0.0
        total, at = self.r.duplicate(), self.r.duplicate()
        total.set(0.0)
        for factor, coefficient in enumerate(coefficients):
            load.value[...] = factor
            _assemble_into(at, self._loaded)
            total.axpy(coefficient, at)
            size += float(at.norm())
        load.value[...] = present
        return total, size

    def assemble_residual(self) -> PETSc.Vec:
        """Assemble the residual; the external parts are those of ``assemble_external``."""
        self.update_average()
        start = None if self.internal is None else self._force_of(self.internal.first_piola)
        _assemble_into(self.r, self._live, start)
        self.r.axpy(1.0, self.external)
        return self.r

    def _force_of(self, first_piola: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the virtual work of a stress at this rank's own and ghost dofs."""
        particles = self._particles
        force: NDArray[np.float64] = np.zeros(len(particles.displacement.x.array))
        loops.internal_force(
            np.ascontiguousarray(first_piola),
            particles.domain_nodes,
            particles.quadrature.gradients,
            particles.present_weights,
            force,
        )
        return force

    def stiffness_force(self, w: PETSc.Vec) -> PETSc.Vec:
        """Return the whole tangent times a vector on W (collective)."""
        total = self.r.duplicate()
        total.set(0.0)
        if self.stock:
            self.K.multAdd(w, total, total)
        for form in self.fused:
            matrix = fem_petsc.create_matrix(form)
            assemble_matrix(matrix, form)
            matrix.assemble()
            matrix.multAdd(w, total, total)
            matrix.destroy()
        if self.internal is not None:
            part = self.r.duplicate()
            _assemble_into(part, [], self._internal_stiffness_force(self.internal, w))
            total.axpy(1.0, part)
        return total

    def _internal_stiffness_force(self, internal: PointStress, w: PETSc.Vec) -> NDArray[np.float64]:
        """Return the internal tangent times a vector on W, at own and ghost dofs."""
        particles = self._particles
        nodes = particles.domain_nodes
        gdim = self._element.block_size
        values = fem.Function(particles.W)
        values.x.array[: w.getLocalSize()] = w.array_r
        values.x.scatter_forward()
        nodal = values.x.array.reshape(-1, gdim)[nodes]
        gradient = particles.quadrature.displacement_gradient(nodal).reshape(-1, gdim, gdim)
        force = self._force_of(np.einsum("niJkL,nkL->niJ", internal.tangent, gradient))
        for term in internal.low_rank:
            size = np.einsum("nki,nki->n", term.g, nodal)
            shares = (term.h * size)[:, None, None] * term.g + size[:, None, None] * term.left
            shares += np.einsum("nki,nki->n", term.right, nodal)[:, None, None] * term.g
            np.add.at(force.reshape(-1, gdim), nodes, shares)
        return force

    def assemble_tangent(self) -> PETSc.Mat:
        """Assemble the stock parts of the tangent, always the same object."""
        self._sparse.zeroEntries()
        for form in self.stock:
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
        gdim = self._element.block_size
        n, k = domain_nodes.shape
        own: NDArray[np.float64] = np.zeros((n, k, gdim))
        if self._parts:
            forms, vector = self._elementwise
            _assemble_into(vector, forms)
            own += vector.array_r[: n * k * gdim].reshape(n, k, gdim)
        if self.internal is not None:
            quadrature = self._particles.quadrature
            P = self.internal.first_piola.reshape(n, -1, gdim, gdim)
            weights = self._particles.present_weights
            own += np.einsum("nq,nqij,nqkj->nki", weights, P, quadrature.gradients)
        own = np.abs(own)
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
