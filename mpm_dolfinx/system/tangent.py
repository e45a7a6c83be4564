# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The reduced tangent: compiled loops reduce what is of domains, products of matrices the rest."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from petsc4py import PETSc

import numpy as np

from ..assembly.blocks import Coupling, Masses
from ..assembly.body_forms import BodyForms
from ..assembly.fused import FusedTangent
from ..assembly.petsc import MatrixSum, absolute
from ..history import Statistics
from ..parallel.magnitudes import norm
from ..particles.field import CarriedField
from ..particles.particles import Particles
from .field import Field
from .numbering import Numbering
from .own import OwnUnknowns
from .term import Term
from .terms import Terms
from .unknowns import Unknowns

__all__ = ["Tangent"]

type Pair = tuple[int, int]
type Products = tuple[PETSc.Mat | None, PETSc.Mat | None, PETSc.Mat | None]


@dataclass
class _Made:
    """Matrices for the present unknowns, which numbers are put into again.

    Attributes:
        products: A matrix of a term, ``K T`` and ``T^T K T``, by the term's number and places.
        matrices: All matrices of terms, by the same; they are those of the last tangent.
        whole: Whether a term has more in the last tangent than these.
        sizes: Their absolute values, as far as asked for.
        zeros: Zeros on the diagonal, where a shift has its place though a block may be empty.
        total: Their sum.
    """

    products: dict[tuple[int, Pair], Products] = dataclasses.field(default_factory=dict)
    matrices: list[Mapping[Pair, PETSc.Mat]] = dataclasses.field(default_factory=list)
    whole: list[bool] = dataclasses.field(default_factory=list)
    sizes: dict[tuple[int, Pair], PETSc.Mat] = dataclasses.field(default_factory=dict)
    zeros: PETSc.Mat | None = None
    total: MatrixSum = dataclasses.field(default_factory=MatrixSum)


class Tangent:
    """The tangent of all terms in the unknowns. All calls are collective.

    Args:
        unknowns: The unknowns.
        terms: The terms.
        statistics: Where to count.

    Attributes:
        mass_factor: How often tangents have the masses that :meth:`masses` has reduced.
    """

    def __init__(self, unknowns: Unknowns, terms: Terms, statistics: Statistics) -> None:
        self._unknowns, self._terms, self._statistics = unknowns, terms, statistics
        self.mass_factor = 0.0
        self._numbering: Numbering | None = None
        pairs = [self._fused_on(one.host) for one in unknowns.subspaces]
        self.loops = FusedTangent(unknowns.comm, pairs, self._numbered_couplings(), statistics)
        self._made = _Made()

    # -- What the compiled loops reduce -----------------------------------------------------------

    def _fused_on(self, field: Field) -> list[tuple[Particles, BodyForms]]:
        """Return the forms on bodies of a field that the compiled loops reduce."""
        every = [pair for term in self._terms for pair in term.fused]
        return [pair for pair in every if any(pair[0] is body for body in field.bodies)]

    @property
    def _couplings(self) -> list[Coupling]:
        """Couplings of a body and a field on it, which the compiled loops reduce."""
        return [term.coupling for term in self._terms if term.coupling is not None]

    def _numbered_couplings(self) -> list[tuple[int, int, Coupling]]:
        """Return :attr:`_couplings` with the numbers of their subspaces."""
        hosts = [one.host for one in self._unknowns.subspaces]
        found = []
        for coupling in self._couplings:
            i, j = (hosts.index(self._unknowns.place(place)[0]) for place in coupling.places)
            found.append((i, j, coupling))
        return found

    def _reduced_on(self, field: Field) -> list[Particles | CarriedField]:
        """Return the bodies of a field with rows of T that the compiled loops take."""
        carried = [coupling.places[1] for coupling in self._couplings]
        bodies: list[Particles | CarriedField] = [body for body, _ in self._fused_on(field)]
        return bodies + [body for body in carried if self._unknowns.place(body)[0] is field]

    def renew(self, numbering: Numbering, release: Callable[[], None] | None = None) -> None:
        """Take over the present unknowns; matrices last as long as these are numbered alike.

        Args:
            numbering: The present unknowns.
            release: As in :meth:`.FusedTangent.restrict`.
        """
        if self._numbering is numbering:
            return
        self._numbering = numbering
        self._made = _Made()
        subspaces = self._unknowns.subspaces
        reduced = [one.restriction(self._reduced_on(one.host)) for one in subspaces]
        its = [restriction for restriction, _ in reduced]
        self.loops.restrict(its, reduced[0][1], release)

    def masses(self, masses: Masses) -> tuple[PETSc.Mat | None, list[Particles]]:
        """Reduce the mass of bodies by the compiled loops, as far as these know them.

        From now on, in this step, tangents have it :attr:`mass_factor` times.

        Args:
            masses: Of domains.

        Returns:
            The reduced mass, ``None`` without any, and the bodies of which it is.
        """
        subspaces = self._unknowns.subspaces
        fused = [body for one in subspaces for body, _ in self._fused_on(one.host)]
        its = [(body, own) for body, own in masses if any(body is one for one in fused)]
        if not its:
            return None, []
        return self.loops.weigh(its), [body for body, _ in its]

    # -- The tangent ------------------------------------------------------------------------------

    def __call__(self) -> PETSc.Mat:
        """Return the tangent at the last residual, one object within a step."""
        unknowns, made = self._unknowns, self._made
        with self._statistics.phase("assemble"):
            reduced = [term.reduced_tangents(unknowns.transfer) for term in self._terms]
            whole = self.loops.assemble(self.mass_factor)
            parts: list[PETSc.Mat] = []
            made.matrices = [
                {} if term.coupling is not None else term.tangents() for term in self._terms
            ]
            made.whole = [
                term.coupling is not None or bool(own) or bool(term.fused)
                for term, own in zip(self._terms, reduced, strict=True)
            ]
            made.sizes = {}
            parts += [
                self._product(term, number, pair, K)
                for number, (term, matrices) in enumerate(
                    zip(self._terms, made.matrices, strict=True)
                )
                for pair, K in matrices.items()
            ]
            parts += [K for own in reduced for K in own]
            for field in unknowns.fields:
                parts += field.acting.tangents(field.prolongation)
            if not self._has_diagonal:
                made.zeros = made.zeros or self._zeros_on_diagonal()
                parts.append(made.zeros)
            parts = [part for part in parts if not self.loops.add(part)]
            return made.total.of([whole, *parts])

    @property
    def _has_diagonal(self) -> bool:
        """Whether the compiled loops have places on the diagonal for all unknowns of values."""
        own = [carried for field in self._unknowns.values for carried in field.carried]
        return all(
            any(body is one for body in self._reduced_on(self._unknowns.place(one)[0]))
            for one in own
        )

    def _zeros_on_diagonal(self) -> PETSc.Mat:
        count, whole = self._unknowns.sizes
        start = self._unknowns.vector().getOwnershipRange()[0]
        csr = (
            np.arange(count + 1, dtype=PETSc.IntType),
            np.arange(start, start + count, dtype=PETSc.IntType),
            np.zeros(count),
        )
        sizes = ((count, whole), (count, whole))
        return PETSc.Mat().createAIJ(sizes, csr=csr, comm=self._unknowns.comm)

    def _product(self, term: Term, number: int, pair: Pair, K: PETSc.Mat) -> PETSc.Mat:
        """Return ``T_a^T K T_b`` in the unknowns, the same object for the same K."""
        T_a, T_b = (self._transfer_to(term, i) for i in pair)
        known, half, result = self._made.products.get((number, pair), (None, None, None))
        if known is not K:
            half = result = None
        if pair[0] == pair[1]:
            result = K.ptap(T_a, result=result)
        else:
            half = K.matMult(T_b, result=half)
            result = T_a.transposeMatMult(half, result=result)
        self._made.products[number, pair] = K, half, result
        return result

    def _transfer_to(self, term: Term, place: int) -> PETSc.Mat:
        """Return T of a body of a term in all unknowns, or that of the term's own."""
        if place < len(term.bodies):
            return self._unknowns.transfer(term.bodies[place])
        assert term.own is not None
        return term.own.selection

    # -- Its products -----------------------------------------------------------------------------

    def lift(self) -> PETSc.Vec:
        """Return the linearised forces of the step's Dirichlet values, by the last tangent."""
        unknowns = self._unknowns
        fields, forces = unknowns.fields, unknowns.zeros()
        for field, force in zip(fields, forces, strict=True):
            field.acting.add_product(field.lift(), force)
        lifts = [field.u for field in fields]
        on_own: list[tuple[OwnUnknowns, PETSc.Vec]] = []
        made = self._made
        for term, matrices, whole in zip(self._terms, made.matrices, made.whole, strict=True):
            if whole or not matrices:
                motions = [unknowns.moved(body, lifts) for body in term.bodies]
                unknowns.add(term.bodies, term.stiffness_force(motions), forces)
                continue
            count = len(term.bodies)
            for (a, b), K in matrices.items():
                if b == count:
                    continue
                force = K.createVecLeft()
                K.mult(unknowns.moved(term.bodies[b], lifts), force)
                if a < count:
                    unknowns.add([term.bodies[a]], [force], forces)
                elif term.own is not None:
                    on_own.append((term.own, force))
        reduced = unknowns.restricted(forces)
        for own, force in on_own:
            own.selection.multTransposeAdd(force, reduced, reduced)
        return reduced

    def size_of_changes(self, field: Field) -> float:
        """Return the size of what the last changes of all unknowns do to a field's residual.

        The sum is one of absolute values.
        """
        place, made = self._unknowns.place, self._made
        total = field.force.duplicate()
        total.set(0.0)
        for number, (term, matrices) in enumerate(zip(self._terms, made.matrices, strict=False)):
            if term.coupling is not None:
                moved, carried = term.coupling.places
                if place(carried)[0] is field:
                    size = carried.T.createVecLeft()
                    changes = [place(body)[1].change() for body in (moved, carried)]
                    size.array_w[:] = term.coupling.sizes(*changes)
                    carried.T.multTransposeAdd(size, total, total)
            if term.own is not None:
                continue  # (it acts on displacements alone)
            for (a, b), K in matrices.items():
                its, motion = place(term.bodies[a])
                if its is not field:
                    continue
                if (number, (a, b)) not in made.sizes:
                    made.sizes[number, (a, b)] = absolute(K)
                force, change = K.createVecLeft(), K.createVecRight()
                change.array_w[:] = place(term.bodies[b])[1].change()
                made.sizes[number, (a, b)].mult(change, force)
                motion.particles.T.multTransposeAdd(force, total, total)
        return norm(total)
