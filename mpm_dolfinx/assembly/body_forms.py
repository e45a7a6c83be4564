# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Residuals and tangents on the body mesh, one compiled form per quadrature rule."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any, Protocol

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem, la, mesh
from dolfinx.fem import petsc as fem_petsc

from .. import _compat
from .._core import loops
from ..constitutive.averaging import Linearised, LowRankTerm
from ..constitutive.strain import Strain
from ..errors import MPMError
from ..meshes.quadrature import nodal_forces, with_hoop
from ..parallel.compilation import compiled_form
from ..particles.particles import Particles
from ..tolerances import BLOCK
from .low_rank import LowRankTangent
from .petsc import assemble_into, assemble_matrix, create_vector, load_quotient
from .rules import couples_cells, depends_on, follows, parts_with
from .volume_ratio import average_in

__all__ = ["BodyForms", "PointStress", "integrals_of", "no_values"]

no_values: NDArray[np.float64] = np.zeros(0)


def integrals_of(form: fem.Form, body: mesh.Mesh) -> Iterator[tuple[Any, ...]]:
    """Yield the integrals of a form on a body over cells and exterior facets, for compiled loops.

    Coefficients are those of now.
    """
    geometry = (body.geometry.x, _compat.geometry_dofmap(body))
    constants, packed = _compat.packed(form)
    for integral in _compat.compiled_integrals(form):
        values = packed[integral.key], constants
        yield integral.kernel, integral.entities, *values, *geometry


def _by_cell(integral: tuple[Any, ...]) -> tuple[NDArray[np.int32], tuple[Any, ...]]:
    """Return the cells of an integral of :func:`integrals_of`, sorted, and it in their order."""
    kernel, entities, values, *rest = integral
    cells = entities if entities.ndim == 1 else entities[:, 0]
    order = np.argsort(cells, kind="stable")
    values = values[order] if len(values) > 0 else values  # (without coefficients: no rows)
    return cells[order], (kernel, entities[order], values, *rest)


class PointStress(Protocol):
    """Stress at a body's quadrature points, of which the compiled loops make forces."""

    @property
    def first_piola(self) -> NDArray[np.float64]:
        """First Piola stress, shape ``(n nq, dim, dim)``."""

    @property
    def tangent(self) -> NDArray[np.float64]:
        """Pointwise derivative of the stress by F, shape ``(n nq, dim, dim, dim, dim)``."""

    @property
    def symmetric(self) -> bool:
        """Whether the tangent has major symmetry."""

    @property
    def strain(self) -> Strain:
        """Strain of the points."""


class BodyForms:
    """A residual on the body mesh, one compiled form per quadrature rule.

    Args:
        R: Residual in the displacement and a test function of W; ``None`` where the internal
            stress is all there is.
        J: Its tangent, or ``None`` for ``ufl.derivative``.
        particles: The body.
        internal: Stress whose virtual work ``P : grad v`` is added by the compiled loops.
        low_rank: What the tangent has besides the forms and the pointwise one of ``internal``;
            that of an averaged volume ratio in R is known.
        others: Unknowns of the body besides the displacement.
        **options: Passed on to ``dolfinx.fem.form``.

    Attributes:
        internal: As given.
        fused: Parts of the tangent that the compiled loops assemble.
        stock: The other forms of the tangent, which DOLFINx assembles.
        follows_load: Whether what the load factor does depends on the displacement.
        K: The stock parts of the tangent, on W, as assembled last.
        factor: How often the reduced tangent has the fused and internal parts.

    Raises:
        MPMError: A form with other arguments, or rules that do not go together.
    """

    def __init__(
        self,
        R: ufl.Form | None,
        J: ufl.Form | None,
        particles: Particles,
        internal: PointStress | None = None,
        low_rank: Linearised | None = None,
        others: Sequence[fem.Function] = (),
        **options: Any,
    ) -> None:
        self._options = options
        self._particles = particles
        self.internal = internal
        self.factor = 1.0
        d = particles.displacement
        W, where, zero = particles.W, "particles.W", internal is not None
        self._average = average_in(R)
        parts: list[ufl.Form] = []
        if R is not None:
            parts = parts_with(W, R, 1, "the residual R", where, d, *others, zero=zero)
        if particles.deletion is not None:
            parts = [particles.deletion.present_only(part) for part in parts]
        live = [p for p in parts if follows(p, d, *others)]
        dead = [p for p in parts if not follows(p, d, *others)]
        tangents = [] if J is None else parts_with(W, J, 2, "the tangent J", where, d, zero=zero)
        if not tangents:
            tangents = [ufl.derivative(p, d) for p in live if depends_on(p, d)]
        elif particles.deletion is not None:
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
        every = list(zip([*live, *dead], [*self._live, *self._dead], strict=True))
        self._loaded = [form for part, form in every if any(c is load for c in part.constants())]
        self._alone = [form for part, form in every if self.takes(part)]
        self.follows_load = any(any(c is load for c in part.constants()) for part in live)
        together = [self.takes(form) for form in tangents]
        compiled = self._compile(tangents)
        self.fused = [form for form, fuse in zip(compiled, together, strict=True) if fuse]
        self.stock = [form for form, fuse in zip(compiled, together, strict=True) if not fuse]
        self._stock_ufl = [form for form, fuse in zip(tangents, together, strict=True) if not fuse]
        self._tangents = tangents
        self._works: dict[int, tuple[fem.Function, list[fem.Form], fem.Function]] = {}
        source = low_rank if self._average is None else self._average
        self._source = source
        self._low_rank = None if source is None else LowRankTangent(particles, source)
        whole = internal is not None and particles.num_points > 1
        self._by_domains = whole and source is not None and source.groups.single
        self.r: PETSc.Vec = create_vector(particles.W)
        self.external: PETSc.Vec = create_vector(particles.W)

    def takes(self, form: ufl.Form) -> bool:
        """Return whether the compiled loops can assemble a form of the tangent.

        It must not couple cells, and what it holds is packed by the cells of the body mesh.
        """
        mesh = self._particles.mesh
        return not couples_cells(form) and all(
            each.function_space.mesh is mesh for each in form.coefficients()
        )

    def _compile(self, forms: list[ufl.Form]) -> list[fem.Form]:
        return [compiled_form(form, **self._options) for form in forms]

    @property
    def low_rank(self) -> LowRankTangent | None:
        """Low-rank part of the tangent, besides its stock, fused and internal parts, if any."""
        return None if self._by_domains else self._low_rank

    def low_rank_of_domains(self) -> LowRankTerm | None:
        """Return the low-rank part of the internal tangent, domain by domain, if any."""
        if not self._by_domains or self._source is None:
            return None
        return self._source.linearise()

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
        assemble_into(self.external, self._dead)

    def load_derivative(self, order: int = 1) -> tuple[PETSc.Vec, float]:
        """Return a difference quotient of the residual by the load factor (collective).

        Args:
            order: 1, which is the derivative where the residual is affine in the load factor,
                or 2, which is zero there.

        Returns:
            The quotient, and the size of what it is the difference of.
        """
        return load_quotient(self._particles.load, self.r, self._loaded, order)

    def assemble_residual(self) -> PETSc.Vec:
        """Assemble the residual; the external parts are those of ``assemble_external``."""
        self.update_average()
        internal = self.internal
        start = None if internal is None else self._force_of(internal, internal.first_piola)
        assemble_into(self.r, self._live, start)
        self.r.axpy(1.0, self.external)
        return self.r

    def _force_of(
        self, internal: PointStress, first_piola: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the virtual work of a stress at this rank's own and ghost dofs."""
        particles = self._particles
        force: NDArray[np.float64] = np.zeros(len(particles.displacement.x.array))
        loops.internal_force(
            np.ascontiguousarray(first_piola),
            *self._domains,
            internal.strain.weights,
            no_values if internal.strain.hoop is None else internal.strain.hoop,
            force,
        )
        return force

    def force_of(self, stress: NDArray[np.float64]) -> PETSc.Vec:
        """Return the virtual work of a first Piola stress at the points (collective)."""
        assert self.internal is not None
        total = self.r.duplicate()
        assemble_into(total, [], self._force_of(self.internal, stress))
        return total

    def work_by(self, function: fem.Function, motion: fem.Function) -> NDArray[np.float64]:
        """Return the derivative of the forms' work on a motion by a Function (collective).

        Args:
            function: What forms may hold; not the displacement.
            motion: On W.

        Returns:
            On the local dofs of the Function.
        """
        key = id(function)
        if key not in self._works:
            virtual, forms = fem.Function(self._particles.W), []
            for part in self._parts:
                if any(each is function for each in part.coefficients()):
                    work = ufl.replace(part, {part.arguments()[0]: virtual})
                    forms.append(ufl.derivative(work, function))
            self._works[key] = virtual, self._compile(forms), function
        virtual, compiled, _ = self._works[key]
        virtual.x.array[:] = motion.x.array
        total = fem.Function(function.function_space)
        for form in compiled:
            vector = fem.assemble_vector(form)
            vector.scatter_reverse(la.InsertMode.add)
            total.x.array[:] += vector.array
        total.x.scatter_forward()
        return np.asarray(total.x.array)

    def stiffness_force(self, w: PETSc.Vec) -> PETSc.Vec:
        """Return the whole tangent times a vector on W (collective)."""
        total = self.r.duplicate()
        total.set(0.0)
        if self.stock:
            self.K.multAdd(w, total, total)
        nodal, force = self._local(w), np.zeros(len(self._particles.displacement.x.array))
        for form in self.fused:
            for compiled in integrals_of(form, self._body):
                loops.multiply_form(compiled, *self._domains, nodal, force)
        if self.internal is not None:
            force += self._internal_stiffness_force(self.internal, nodal)
        part = self.r.duplicate()
        assemble_into(part, [], force)
        total.axpy(1.0, part)
        if self._low_rank is not None:
            total.axpy(1.0, self.low_rank_force(w))
        return total

    @cached_property
    def _energy_inside(self) -> tuple[fem.Function, list[fem.Form]]:
        """The energies of the tangents' integrals over cells, and the motion that has them."""
        motion = fem.Function(self._particles.W)
        inside = []
        for form in self._tangents:
            cells = [each for each in form.integrals() if each.integral_type() == "cell"]
            swap = dict.fromkeys(form.arguments(), motion)
            if cells:
                inside.append(ufl.replace(ufl.Form(cells), swap))
        return motion, self._compile(inside)

    def energies_of_gradients(self) -> NDArray[np.float64]:
        """Return this rank's energies ``g : C : g`` of uniform gradients with one entry 1.

        They are those of what integrals over cells have of the forms' tangent (collective).

        Returns:
            For each entry the energy, shape ``(gdim, gdim)``.
        """
        motion, forms = self._energy_inside
        W = self._particles.W
        gdim = self._element.block_size
        x = W.tabulate_dof_coordinates()[:, :gdim]
        own = x[: W.dofmap.index_map.size_local].sum(axis=0)
        middle = self._body.comm.allreduce(own) / W.dofmap.index_map.size_global
        energies = np.zeros((gdim, gdim))
        for i, j in np.ndindex(gdim, gdim):
            motion.x.array[:] = 0.0
            motion.x.array.reshape(-1, gdim)[:, i] = x[:, j] - middle[j]
            energies[i, j] = sum(float(np.real(fem.assemble_scalar(form))) for form in forms)
        return energies

    @property
    def _domains(self) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
        """Nodes and gradients of the domains, for the compiled loops."""
        return self._particles.domain_nodes, self._particles.undeformed.rule.gradients

    def _local(self, w: PETSc.Vec) -> NDArray[np.float64]:
        """Return a vector on W at this rank's own and ghost dofs (collective)."""
        values = fem.Function(self._particles.W)
        values.x.array[: w.getLocalSize()] = w.array_r
        values.x.scatter_forward()
        return np.asarray(values.x.array)

    def _at_domains(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return local values on W at the domains' nodes, shape ``(n, k, gdim)``."""
        nodal = values.reshape(-1, self._element.block_size)
        return np.asarray(nodal[self._particles.domain_nodes])

    def low_rank_force(self, w: PETSc.Vec) -> PETSc.Vec:
        """Return the low-rank part of the tangent times a vector on W (collective)."""
        assert self._low_rank is not None
        force = np.zeros(len(self._particles.displacement.x.array))
        contributions = self._low_rank.times(self._at_domains(self._local(w)))
        nodes = self._particles.domain_nodes
        np.add.at(force.reshape(-1, self._element.block_size), nodes, contributions)
        total = self.r.duplicate()
        assemble_into(total, [], force)
        return total

    def _internal_stiffness_force(
        self, internal: PointStress, values: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the internal pointwise tangent times local values on W, at own and ghost dofs."""
        nodal = self._at_domains(values)
        gradient = self._particles.undeformed.rule.displacement_gradient(nodal)
        if internal.strain.hoop is not None:
            gradient = with_hoop(gradient, internal.strain.hoop, nodal)
        gradient = gradient.reshape(internal.first_piola.shape)
        stress = np.einsum("niJkL,nkL->niJ", internal.tangent, gradient)
        return self._force_of(internal, stress)

    def assemble_tangent(self) -> PETSc.Mat:
        """Assemble the stock parts of the tangent, always the same object."""
        self._sparse.zeroEntries()
        for form in self.stock:
            assemble_matrix(self._sparse, form)
        self._sparse.assemble()
        return self.K

    @cached_property
    def _elementwise(self) -> tuple[list[fem.Form], fem.FunctionSpace]:
        """Parts that couple cells, tested domain by domain, and the space of these functions."""
        broken = fem.functionspace(
            self._body,
            ("Discontinuous Lagrange", self._element.degree, (self._element.block_size,)),
        )
        test = ufl.TestFunction(broken)
        coupling = [part for part in self._parts if not self.takes(part)]
        tested = [ufl.replace(part, {part.arguments()[0]: test}) for part in coupling]
        return self._compile(tested), broken

    def absolute_contributions(self, domain_nodes: NDArray[np.int32]) -> PETSc.Vec:
        """Return the sum over domains of the absolute values of what each adds to the residual.

        It measures the forces inside a body that is in equilibrium with itself.
        """
        gdim = self._element.block_size
        n, k = domain_nodes.shape
        external: NDArray[np.float64] = np.broadcast_to(0.0, (n, k, gdim))
        if not all(map(self.takes, self._parts)):
            forms, broken = self._elementwise
            vector = create_vector(broken)
            assemble_into(vector, forms)
            external = vector.array_r[: n * k * gdim].reshape(n, k, gdim)
        integrals = [
            _by_cell(integral)
            for form in self._alone
            for integral in integrals_of(form, self._body)
        ]
        total = self.r.duplicate()
        with total.localForm() as local:
            local.set(0.0)
            count = local.getLocalSize() // gdim
            for first in range(0, n, BLOCK):
                part = slice(first, min(first + BLOCK, n))
                own = external[part] + self._internal_forces(part)
                for cells, (kernel, entities, values, *rest) in integrals:
                    its = slice(*np.searchsorted(cells, [part.start, part.stop]))
                    loops.domain_forces((kernel, entities[its], values[its], *rest), first, own)
                size, nodes = np.abs(own), domain_nodes[part].ravel()
                for i in range(gdim):
                    local.array_w[i::gdim] += np.bincount(nodes, size[:, :, i].ravel(), count)
        total.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
        return total

    def _internal_forces(self, part: slice) -> NDArray[np.float64] | float:
        """Return the forces of the stress in some domains on their nodes, ``(n, k, gdim)``."""
        if self.internal is None:
            return 0.0
        weights, hoop = self.internal.strain.weights[part], self.internal.strain.hoop
        P = self.internal.first_piola.reshape(
            *self.internal.strain.weights.shape, *self.internal.first_piola.shape[1:]
        )
        gradients = self._particles.undeformed.rule.gradients[part]
        return nodal_forces(P[part], weights, gradients, None if hoop is None else hoop[part])
