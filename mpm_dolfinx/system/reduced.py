# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The reduced system of a step: residual and tangent in the free dofs of the backgrounds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..assembly.body_forms import BodyForms
from ..assembly.fused import Coupling, FusedTangent, Masses
from ..assembly.petsc import MatrixSum, absolute
from ..errors import (
    TRIAL_ERRORS,
    ConvergenceError,
    DomainDistortionError,
    MPMError,
    agree,
    agreed,
    as_ours,
    gravest,
)
from ..history import Statistics
from ..parallel.balance import imbalance
from ..parallel.interruption import Interrupted, note, noted
from ..parallel.magnitudes import joint_norm, norm
from ..parallel.totals import over_ranks
from ..particles.field import CarriedField
from ..particles.particles import Particles
from ..solvers.linear import Coarsening
from .field import Field, Motion, ValueField
from .free_field import FreeField, Subspace
from .hierarchy import interpolations
from .numbering import Numbering
from .own import OwnUnknowns
from .predictor import Predictor
from .term import Term

__all__ = ["ReducedSystem"]


type Tangents = Mapping[tuple[int, int], PETSc.Mat]


class ReducedSystem:
    """``sum_b T_b^T r_b(d_n + T u) = 0`` in the unknowns of all fields, as the solver sees it.

    Args:
        bodies: All bodies, in the problem's order, then their other fields.
        fields: The background spaces that move them, each before those of free nodes of its bodies.
        terms: What acts on them.
        statistics: Where to count.
        predictor: Says what increment to expect.

    Attributes:
        bodies: As given.
        fields: As given.
        fused: The tangents that the compiled loops reduce: one of all fields together, and one of
            each field in which dofs follow others.
        predictor: As given.
        own: The unknowns that terms have of their own.
        mass_factor: How often tangents have the masses that :meth:`masses` has reduced.
    """

    mass_factor = 0.0

    def __init__(
        self,
        bodies: Sequence[Particles | CarriedField],
        fields: Sequence[Field],
        terms: Sequence[Term],
        statistics: Statistics,
        predictor: Predictor,
    ) -> None:
        self.bodies = list(bodies)
        self.fields = list(fields)
        self.predictor = predictor
        self._terms = list(terms)
        self.own = [term.own for term in terms if term.own is not None]
        moving = len(self.fields) - len(self._value_fields)
        # In the order of the numbers of their unknowns.
        self._blocks: list[Field | OwnUnknowns] = [
            *self.fields[:moving],
            *self.own,
            *self.fields[moving:],
        ]
        self._statistics = statistics
        self._comm: MPI.Comm = self.fields[0].V.mesh.comm
        motions = [(field, motion) for field in fields for motion in field.motions]
        self._places = [
            next(place for place in motions if place[1].particles is body) for body in bodies
        ]
        self._ways = [[way for way in motions if way[1].particles is body] for body in bodies]
        self._subspaces = Subspace.all_of(fields)
        self._free_Ts: dict[int, PETSc.Mat] = {}
        self._numbering: Numbering | None = None
        self._start: PETSc.Vec | None = None
        groups = [[one for one in self._subspaces if not one.extends]]
        groups += [[one] for one in self._subspaces if one.extends]
        self._coupled = [self._is_fused(term.coupling) for term in terms]
        self._groups = [
            (group, pairs)
            for group in groups
            if any(pairs := [self._fused_on(one.host) for one in group])
        ]
        self.fused = [
            FusedTangent(self._comm, pairs, self._couplings_in(group), statistics)
            for group, pairs in self._groups
        ]

    def _fused_on(self, field: Field) -> list[tuple[Particles, BodyForms]]:
        """Return the forms on bodies of a field that the compiled loops reduce."""
        every = [pair for term in self._terms for pair in term.fused]
        return [pair for pair in every if any(pair[0] is body for body in field.bodies)]

    def _is_fused(self, coupling: Coupling | None) -> bool:
        """Return whether the compiled loops reduce what couples a body and a field on it.

        Not where dofs follow others: then the tangent of a displacement is made by itself.
        """
        if coupling is None:
            return False
        moving, other = (self._place(place)[0] for place in coupling.places)
        reduced = any(body is coupling.places[0] for body, _ in self._fused_on(moving))
        return reduced and not moving.extends and not other.extends

    def _couplings_in(self, group: Sequence[Subspace]) -> list[tuple[int, int, Coupling]]:
        """Return the couplings of fields in a group that compiled loops reduce, with numbers."""
        found, hosts = [], [one.host for one in group]
        for term, coupled in zip(self._terms, self._coupled, strict=True):
            if coupled and term.coupling is not None:
                i, j = (self._place(place)[0] for place in term.coupling.places)
                if i in hosts:
                    found.append((hosts.index(i), hosts.index(j), term.coupling))
        return found

    def _reduced_on(self, field: Field) -> list[Particles | CarriedField]:
        """Return the bodies of a field with rows of T that the compiled loops take."""
        carried = [
            term.coupling.places[1]
            for term, coupled in zip(self._terms, self._coupled, strict=True)
            if coupled and term.coupling is not None
        ]
        bodies: list[Particles | CarriedField] = [body for body, _ in self._fused_on(field)]
        return bodies + [body for body in carried if self._place(body)[0] is field]

    def _place(self, particles: Particles | CarriedField) -> tuple[Field, Motion]:
        """Return the field of the background that moves a body, and how."""
        return next(place for place in self._places if place[1].particles is particles)

    def _ways_of(self, particles: Particles | CarriedField) -> list[tuple[Field, Motion]]:
        """Return all fields that move a body, and how: each other nodes; none where it stays."""
        found = (ways for ways in self._ways if ways[0][1].particles is particles)
        return next(found, [])

    def _moved(
        self, particles: Particles | CarriedField, increments: Sequence[PETSc.Vec]
    ) -> PETSc.Vec:
        """Return how increments of the fields move a body, on its W.

        Args:
            particles: The body.
            increments: On all dofs of each V.
        """
        moved = [
            motion.of(increments[self.fields.index(field)])
            for field, motion in self._ways_of(particles)
        ]
        if not moved:
            moved.append(particles.T.createVecLeft())
            moved[0].set(0.0)
        for other in moved[1:]:
            moved[0].axpy(1.0, other)
        return moved[0]

    @property
    def softens(self) -> bool:
        """Whether tangents may be indefinite in a direction that :meth:`constrain` forbids."""
        return False

    @property
    def constrained(self) -> bool:
        """Whether there are unknowns besides displacements."""
        return bool(self._value_fields)

    @property
    def coarsening(self) -> Coarsening:
        """How well multigrid's boxes follow the tangent (collective)."""
        found = [one.host.coarsening for one in self._subspaces]
        joint = len(self._subspaces) < len(self.fields)
        if joint or any(self._couples(term) for term in self._terms):
            found.append(Coarsening.FAIR)  # each field has boxes of its own
        return max(found)

    def _couples(self, term: Term) -> bool:
        """Return whether a term acts on bodies of several fields."""
        return len({id(self._place(body)[0]) for body in term.bodies}) > 1

    @property
    def sizes(self) -> tuple[int, int]:
        """Number of unknowns of this rank and of all ranks."""
        assert self._numbering is not None
        return self._numbering.sizes

    @property
    def unknowns(self) -> list[slice]:
        """Where each field's unknowns are among this rank's, and those of terms' own."""
        return [block.part for block in self._blocks]

    @property
    def forces(self) -> list[PETSc.Vec]:
        """The residual on all dofs of each V that was evaluated last: at supports, their force."""
        return [field.force for field in self.fields]

    @property
    def follows_load(self) -> bool:
        """Whether what the load factor does depends on the displacement."""
        return any(term.follows_load for term in self._terms)

    @property
    def prescribes(self) -> bool:
        """Whether Dirichlet values change in the step that has begun."""
        return any(field.prescribes for field in self.fields)

    @property
    def moduli(self) -> list[float | None] | None:
        """Shear modulus of each body at the first step with a ghost penalty; ``None`` before."""
        found: list[float | None] = []
        for field, motion in self._places:
            number = field.motions.index(motion)
            found.append(None if field.moduli is None else field.moduli[number])
        return None if all(modulus is None for modulus in found) else found

    @moduli.setter
    def moduli(self, values: Sequence[float | None] | None) -> None:
        every = [None] * len(self._places) if values is None else values
        for field in self.fields:
            own = [
                value
                for value, (its, _) in zip(every, self._places, strict=True)
                if its is field and value is not None
            ]
            field.moduli = own or None

    # -- A step ---------------------------------------------------------------------------

    def begin(
        self,
        changes: Sequence[NDArray[np.float64]],
        size: float,
        before: Sequence[NDArray[np.float64] | None] | None = None,
    ) -> None:
        """Prepare a step, or another try of the same.

        Args:
            changes: Change of the Dirichlet values, on the local dofs of V, for each field.
            size: Size of the step, in load factor or parameter of the path.
            before: Totals of the Dirichlet values at its beginning, for each field; ``None``: zero.

        Raises:
            ParticleOutsideError: Where the last step left a domain outside the background.
        """
        totals = [None] * len(self.fields) if before is None else before
        for field, change, total in zip(self.fields, changes, totals, strict=True):
            field.begin(change, total)
        self._size = size
        with self._statistics.phase("locate"):
            for _, motion in self._places:
                motion.particles.locate()
        if self._numbering is None:
            with self._statistics.phase("transfer"):
                self._find_unknowns()
        with self._statistics.phase("assemble"):
            self._set_forces()
            for term in self._terms:
                self._add(term, term.begin())
            self._external = [norm(field.force) for field in self.fields]
            if any(field.unit is None for field in self._value_fields):
                self._find_units()
            starts = [term.start(self._free_T, self._prescribed) for term in self._terms]
            self._start = next((x for x in starts if x is not None), None)

    @property
    def _value_fields(self) -> list[ValueField]:
        """The fields that are no displacements; they come last."""
        return [field for field in self.fields if isinstance(field, ValueField)]

    @property
    def units(self) -> list[float | None]:
        """Values of unknowns of size 1 of the fields that are no displacements."""
        return [field.unit for field in self._value_fields]

    @units.setter
    def units(self, values: Sequence[float | None]) -> None:
        for field, value in zip(self._value_fields, values, strict=True):
            field.unit = value

    def _find_units(self) -> None:
        """Choose units of unknowns, powers of two, in which all have tangents of the same size."""
        assert self._numbering is not None
        x = self._numbering.vector()
        if self.residual(x, x.duplicate()) is not None:
            return
        diagonal = self.diagonal(self.tangent()).array_r
        sizes = [
            self._comm.allreduce(float(np.abs(diagonal[part]).max(initial=0.0)), MPI.MAX)
            for part in (field.part for field in self.fields)
        ]
        given = [
            s for s, f in zip(sizes, self.fields, strict=True) if not isinstance(f, ValueField)
        ]
        whole = max(given, default=sizes[0])
        for field, size in zip(self.fields, sizes, strict=True):
            if isinstance(field, ValueField) and size > 0.0 and whole > 0.0:
                field.unit = float(2.0 ** np.round(0.5 * np.log2(whole / size)))
        self._find_unknowns()

    def _prescribed(self, particles: Particles) -> PETSc.Vec | None:
        """Return how the step's Dirichlet values move a body, ``None``: not at all."""
        ways = self._ways_of(particles)
        if not any(field.prescribes for field, _ in ways):
            return None
        return self._moved(particles, [field.lift() for field in self.fields]).copy()

    def end(self) -> None:
        """Take note of the increments; forget the unknowns, since the bodies have moved."""
        self.forget()
        self.predictor.record(self._size, self.increments())
        for own in self.own:
            own.record(self._size)

    def increments(self) -> list[NDArray[np.float64]]:
        """Return the last change of displacement of each body, on this rank's own dofs of W."""
        return [motion.increment() for _, motion in self._places]

    def forget(self) -> None:
        """Forget the unknowns."""
        self._numbering = None
        for field in self.fields:
            field.forget()

    def commit(self) -> None:
        """Make the last evaluation the converged one: of all terms, or where one fails of none."""
        done: list[Callable[[], None]] = []
        try:
            for term in self._terms:
                undo = None
                with agree(self._comm, "commit()"):
                    undo = term.commit()
                if undo is not None:
                    done.append(undo)
        except BaseException:
            for undo in reversed(done):
                undo()
            raise

    def roll_back(self) -> None:
        """Return to the last converged evaluation."""
        for term in self._terms:
            term.roll_back()

    def _find_unknowns(self) -> None:
        free = [block.find() for block in self._blocks]
        numbering = self._numbering = Numbering(self._comm, free)
        for block, part, numbers in zip(
            self._blocks, numbering.parts, numbering.numbers, strict=True
        ):
            block.number(part, numbers, numbering.sizes)
        self._sum = MatrixSum()
        self._free_Ts = {}
        self._zeros_on_diagonal: PETSc.Mat | None = None
        self._products: dict[tuple[int, int, int], tuple[PETSc.Mat | None, ...]] = {}
        self._extended: list[PETSc.Mat | None] = [None] * len(self.fused)
        self._tangents: list[Tangents] = []
        self._sizes_of: dict[tuple[int, int, int], PETSc.Mat] = {}
        for fused, (group, _) in zip(self.fused, self._groups, strict=True):
            reduced = [one.restriction(self._reduced_on(one.host)) for one in group]
            fused.restrict([restriction for restriction, _ in reduced], reduced[0][1])
        self._count(numbering)

    def _count(self, numbering: Numbering) -> None:
        statistics = self._statistics
        counts: dict[str, int] = {}
        for field in self.fields:
            for name, count in field.counts.items():
                counts[name] = counts.get(name, 0) + count
        for name, count in counts.items():
            statistics[name] = count
        statistics.count("transfers")
        statistics["free_dofs"] = self.sizes[1]
        rows, off, columns = (int(count) for count in numbering.off_rank)
        statistics["off_rank_rows"] = off / max(rows, 1)
        statistics["off_rank_columns"] = columns
        statistics["dof_imbalance"] = imbalance(self._comm, self.sizes[0])
        particles = sum(motion.particles.num_local for _, motion in self._places)
        statistics["particle_imbalance"] = imbalance(self._comm, particles)

    # -- Forces ---------------------------------------------------------------------------

    def _set_forces(self) -> None:
        for field in self.fields:
            field.force.set(0.0)

    def _add(
        self, term: Term, vectors: Sequence[PETSc.Vec], to: Sequence[PETSc.Vec] | None = None
    ) -> None:
        """Add ``T^T`` times a term's vectors on its bodies to the forces, or to other vectors."""
        if not vectors:
            return
        targets = self.forces if to is None else to
        for body, vector in zip(term.bodies, vectors, strict=True):
            for field, motion in self._ways_of(body):
                target = targets[self.fields.index(field)]
                motion.T.multTransposeAdd(vector, target, target)

    def residual(self, x: PETSc.Vec, F: PETSc.Vec) -> MPMError | None:
        """Evaluate the residual at x, or say by which of the ``TRIAL_ERRORS`` that cannot be.

        Raises:
            MPMError: What any rank has met that no other x mends, as an error of a user's code.
            BaseException: What a user's code has raised on any rank to end the program.
        """
        for block in self._blocks:
            block.spread(x)
        failure = self.evaluate_forces()
        if failure is None:
            for field in self.fields:
                field.collect(field.force, F)
            for own in self.own:
                own.collect(F)
        return failure

    def evaluate_forces(self) -> MPMError | None:
        """Evaluate the forces at the present displacements: as :meth:`residual` otherwise."""
        with self._statistics.phase("constitutive"):
            failure: BaseException | None = Interrupted() if noted() else None
            for _, motion in self._places:
                inverted = motion.particles.inverted()
                failure = failure or DomainDistortionError.of("turn inside out", inverted)
            failure = agreed(self._comm, failure) or agreed(self._comm, self._updated())
        if isinstance(failure, TRIAL_ERRORS):
            return failure
        if failure is not None:
            raise failure
        with self._statistics.phase("assemble"):
            self._set_forces()
            self._outer = [0.0] * len(self.fields)
            for term in self._terms:
                if term.from_outside:
                    self._add_outer(term)
                else:
                    self._add(term, term.residuals())
            for number, field in enumerate(self.fields):
                self._outer[number] += self._add_on_background(field)
            for field in self.fields:
                field.add_residual(partial(self.shear_moduli, field))
                field.gather_extended(field.force)
        return None

    def followed(self) -> list[NDArray[np.float64] | None]:
        """Return the forces on free nodes that follow held dofs, as forces on these (collective).

        The last :attr:`forces` leave them out.

        Returns:
            For each field on own dofs of V; ``None`` where nothing follows its held dofs.
        """
        found: list[NDArray[np.float64] | None] = []
        for field in self.fields:
            total = field.force.duplicate()
            total.set(0.0)
            free = [one for one in self.fields if isinstance(one, FreeField) and one.host is field]
            follows = [one.add_followed(total) for one in free]
            found.append(total.array_r.copy() if any(follows) else None)
        return found

    def _add_outer(self, term: Term) -> None:
        """Add a term's forces, and take note of their size."""
        parts = self._zeros()
        self._add(term, term.residuals(), parts)
        for number, (field, part) in enumerate(zip(self.fields, parts, strict=True)):
            self._outer[number] += norm(part)
            field.force.axpy(1.0, part)

    def _add_on_background(self, field: Field) -> float:
        """Add forces of terms on dofs of a background, and return their size."""
        size = 0.0
        for term in self._terms:
            forces = term.background_forces(field.V)
            if forces is not None:
                field.force.array_w[:] += forces
                size += joint_norm(forces, self._comm)
        return size

    @property
    def terms(self) -> Sequence[Term]:
        """Everything that acts on the bodies."""
        return self._terms

    def nodal_forces(self) -> list[NDArray[np.float64]]:
        """Return the forces of all terms in the last converged state (collective).

        Returns:
            For each body, on this rank's own dofs of W.
        """

        def force(term: Term) -> Sequence[PETSc.Vec]:
            term.roll_back()
            term.begin()
            return term.residuals()

        return self._on_nodes(force)

    def last_nodal_forces(self) -> list[NDArray[np.float64]]:
        """Return the forces of all terms in the last evaluation, as :meth:`nodal_forces`."""
        return self._on_nodes(lambda term: term.residuals())

    def _on_nodes(
        self, force_of: Callable[[Term], Sequence[PETSc.Vec]]
    ) -> list[NDArray[np.float64]]:
        """Return sums of forces of all terms on this rank's own dofs of W of each body."""
        bodies = [motion.particles for _, motion in self._places]
        maps = [body.W.dofmap for body in bodies]
        totals = [np.zeros(m.index_map.size_local * m.index_map_bs) for m in maps]
        for term in self._terms:
            forces = force_of(term)
            for body, force in zip(term.bodies if forces else (), forces, strict=True):
                number = next(i for i, known in enumerate(bodies) if known is body)
                totals[number] += force.array_r
        return totals

    def renew_external(self) -> None:
        """Let terms take over what their forces depend on besides displacements (collective)."""
        for term in self._terms:
            term.begin()

    def _zeros(self) -> list[PETSc.Vec]:
        vectors = [force.duplicate() for force in self.forces]
        for vector in vectors:
            vector.set(0.0)
        return vectors

    def evaluate(self) -> None:
        """Evaluate all terms, with their tangents, at the displacement that there is (collective).

        Raises:
            MPMError: A term cannot be evaluated.
        """
        failure = agreed(self._comm, self._updated())
        if failure is not None:
            raise failure

    def _updated(self) -> BaseException | None:
        """Update the terms; return the gravest failure."""
        return gravest([_updated(term) for term in self._terms])

    def shear_moduli(self, field: Field) -> list[float]:
        """Return the shear modulus of each body of a field (collective)."""
        return [
            sum(term.shear_modulus() for term in self._terms if term.bodies == (body,))
            for body in field.bodies
        ]

    def smooth(self) -> bool:
        """Return whether no history changes in the last residual, nor contact."""
        smooth = [term.smooth() for term in self._terms]
        return over_ranks(self._comm, all(smooth), MPI.LAND)

    def yielding(self) -> list[NDArray[np.bool_]]:
        """Return whether each particle yields in the last residual, for each body (not collective).

        In the order of those among :attr:`bodies` that are displaced.
        """
        displaced = [body for body in self.bodies if isinstance(body, Particles)]
        found = {id(body): np.zeros(body.num_local, dtype=bool) for body in displaced}
        for term in self._terms:
            yields = term.yielding()
            if yields is not None:
                found[id(term.bodies[0])] |= yields
        return list(found.values())

    def is_driven(self) -> bool:
        """Return whether something moves on its own path against bodies whose history changes."""
        drives = [term.drives() for term in self._terms]
        if not over_ranks(self._comm, any(drives), MPI.LOR):
            return False
        smooth = [term.smooth() for term in self._terms if not term.one_sided]
        return not over_ranks(self._comm, all(smooth), MPI.LAND)

    def load_derivative(self, order: int = 1) -> tuple[list[PETSc.Vec], float]:
        """Return :meth:`BodyForms.load_derivative` on all dofs of each V (collective)."""
        with self._statistics.phase("assemble"):
            totals, whole = self._zeros(), 0.0
            for term in self._terms:
                parts, size = term.load_derivative(order)
                self._add(term, parts, totals)
                whole += size
            for field, total in zip(self.fields, totals, strict=True):
                field.gather_extended(total)
            return totals, whole

    def functional(self, particles: Particles, row: PETSc.Vec) -> PETSc.Vec:
        """Return the coefficients on the unknowns of a functional on a body's W (collective)."""
        totals = self._zeros()
        for field, motion in self._ways_of(particles):
            total = totals[self.fields.index(field)]
            motion.T.multTranspose(row, total)
            field.gather_extended(total)
        return self.restricted(totals)

    def restricted(self, forces: Sequence[PETSc.Vec]) -> PETSc.Vec:
        """Return vectors on all dofs of each V at the unknowns (collective)."""
        assert self._numbering is not None
        reduced = self._numbering.vector()
        for field, force in zip(self.fields, forces, strict=True):
            field.collect(force, reduced)
        return reduced

    # -- Tangent --------------------------------------------------------------------------

    def constrain(
        self, y: PETSc.Vec, x: PETSc.Vec | None, solve: Callable[[PETSc.Vec, PETSc.Vec], None]
    ) -> int:
        """Leave a Newton step as it is: all steps are permitted."""
        return 0

    def tangent(self) -> PETSc.Mat:
        """Return the tangent at the x of the last residual, one object within a step."""
        with self._statistics.phase("assemble"):
            reduced = [K for term in self._terms for K in term.reduced_tangents(self._free_T)]
            parts = [self._fused_tangent(number) for number in range(len(self.fused))]
            self._tangents = [
                {} if coupled else term.tangents()
                for term, coupled in zip(self._terms, self._coupled, strict=True)
            ]
            self._sizes_of = {}
            parts += [
                self._product(term, number, pair, K)
                for number, (term, tangents) in enumerate(
                    zip(self._terms, self._tangents, strict=True)
                )
                for pair, K in tangents.items()
            ]
            parts += reduced
            for field in self.fields:
                parts += field.tangents(partial(self.shear_moduli, field))
            if not self._has_diagonal:
                parts.append(self._entries_on_diagonal)
            return self._sum.of(parts)

    @property
    def _has_diagonal(self) -> bool:
        """Whether the compiled loops have places on the diagonal for all unknowns of values."""
        own = [carried for field in self._value_fields for carried in field.carried]
        return all(self._reduced_by_loops(carried) for carried in own)

    def _reduced_by_loops(self, carried: CarriedField) -> bool:
        """Return whether the compiled loops reduce what couples a field on a body with it."""
        return any(body is carried for body in self._reduced_on(self._place(carried)[0]))

    @property
    def _entries_on_diagonal(self) -> PETSc.Mat:
        """Zeros on the diagonal, where a shift has its place though a block may be empty."""
        if self._zeros_on_diagonal is None:
            assert self._numbering is not None
            count, whole = self.sizes
            start = self._numbering.vector().getOwnershipRange()[0]
            csr = (
                np.arange(count + 1, dtype=PETSc.IntType),
                np.arange(start, start + count, dtype=PETSc.IntType),
                np.zeros(count),
            )
            sizes = ((count, whole), (count, whole))
            self._zeros_on_diagonal = PETSc.Mat().createAIJ(sizes, csr=csr, comm=self._comm)
        return self._zeros_on_diagonal

    def diagonal(self, K: PETSc.Mat) -> PETSc.Vec:
        """Return sizes of the diagonal of a tangent, with signs that make a shift regularise it.

        It is ``|diag K|`` for displacements. For other fields, one after the other, it is the
        diagonal of ``K_ii - sum_j K_ij D_j^-1 K_ji`` with the sizes D_j of those before: that of
        the Schur complement if these were diagonal. A pressure that enforces a constraint has it
        negative, whether or not K_ii is empty. Zeros are replaced by the largest of their field.
        """
        assert self._numbering is not None
        found = K.getDiagonal()
        values = found.array_w
        for block in self._blocks:
            part = block.part
            if isinstance(block, ValueField):
                values[part] -= self._schur(K, found, part)
            else:
                values[part] = np.abs(values[part])
            own = np.abs(values[part])
            largest = over_ranks(self._comm, float(own.max(initial=0.0)), MPI.MAX)
            sums = over_ranks(self._comm, float(np.sign(values[part]).sum()))
            values[part] = np.where(own == 0.0, np.copysign(largest, sums), values[part])
        return found

    def _schur(self, K: PETSc.Mat, sizes: PETSc.Vec, part: slice) -> NDArray[np.float64]:
        """Return the part of a diagonal that earlier fields' unknowns take away (collective)."""
        first = K.getOwnershipRange()[0]
        stop = part.start
        before, own = (
            PETSc.IS().createStride(b - a, first=first + a, step=1, comm=self._comm)
            for a, b in ((0, stop), (part.start, part.stop))
        )
        if self._comm.allreduce(stop) == 0:
            return np.zeros(part.stop - part.start)
        left, right = K.createSubMatrix(own, before), K.createSubMatrix(before, own)
        inverse = right.createVecLeft()
        inverse.array_w[:] = sizes.array_r[:stop]
        inverse.reciprocal()
        right.diagonalScale(L=inverse)
        return np.asarray(left.matMult(right).getDiagonal().array_r)

    def _fused_tangent(self, number: int) -> PETSc.Mat:
        fused, (group, _) = self.fused[number], self._groups[number]
        whole = fused.assemble([one.prescribes for one in group], self.mass_factor)
        if not group[0].extends:
            return whole
        result = whole.ptap(group[0].host.prolongation, result=self._extended[number])
        self._extended[number] = result
        return result

    def masses(self, masses: Masses) -> tuple[list[PETSc.Mat], list[Particles]]:
        """Reduce the mass of bodies by the compiled loops, as far as these know them (collective).

        From now on, in this step, tangents have it :attr:`mass_factor` times.

        Args:
            masses: Of domains.

        Returns:
            Matrices of all unknowns, of which the sum is the reduced mass, and the bodies of which.
        """
        parts, known = [], []
        for fused, (group, pairs) in zip(self.fused, self._groups, strict=True):
            bodies = [body for own in pairs for body, _ in own]
            its = [(body, own) for body, own in masses if any(body is one for one in bodies)]
            if not its:
                continue
            whole = fused.weigh(its)
            host = group[0].host
            parts.append(whole.ptap(host.prolongation) if host.extends else whole)
            known += [body for body, _ in its]
        return parts, known

    def _product(self, term: Term, number: int, pair: tuple[int, int], K: PETSc.Mat) -> PETSc.Mat:
        """Return ``T_a^T K T_b`` in the unknowns, the same object for the same K."""
        key = (number, *pair)
        T_a, T_b = (self._transfer_to(term, i) for i in pair)
        known, half, result = self._products.get(key, (None, None, None))
        if known is not K:
            half = result = None
        if pair[0] == pair[1]:
            result = K.ptap(T_a, result=result)
        else:
            half = K.matMult(T_b, result=half)
            result = T_a.transposeMatMult(half, result=result)
        self._products[key] = K, half, result
        return result

    def _transfer_to(self, term: Term, place: int) -> PETSc.Mat:
        """Return T of a body of a term in all unknowns, or that of the term's own."""
        if place < len(term.bodies):
            return self._free_T(term.bodies[place])
        assert term.own is not None
        return term.own.selection

    def _free_T(self, particles: Particles | CarriedField) -> PETSc.Mat:
        first, *others = [
            motion.free_T(field.prolongation) for field, motion in self._ways_of(particles)
        ]
        if not others:
            return first
        if id(particles) not in self._free_Ts:
            for other in others:
                first = first + other
            self._free_Ts[id(particles)] = first
        return self._free_Ts[id(particles)]

    def prediction(self) -> PETSc.Vec | None:
        """Return the unknowns to expect at the step's end, if a term or the past says any."""
        if self._start is not None:
            x = self._start.copy()
        else:
            increments = self.predictor.increments(self._size)
            if increments is None:
                return None
            assert self._numbering is not None
            x = self._numbering.vector()
            bodies = [motion.particles for _, motion in self._places]
            for field in self.fields:
                its = [
                    increment
                    for motion in field.motions
                    for increment, body in zip(increments, bodies, strict=True)
                    if body is motion.particles
                ]
                field.predict(its, x, fit=not self.one_sided())
        for own in self.own:
            own.predict(x, self._size)
        return x

    def rigid_motions(self) -> PETSc.NullSpace:
        """Return the rigid motions of each background in the unknowns (collective)."""
        assert self._numbering is not None
        moving = [one for one in self._subspaces if not isinstance(one.host, ValueField)]
        others = len(self._blocks) - sum(len(one.fields) for one in moving)
        return self._numbering.rigid_motions([*(len(one.fields) for one in moving), *[1] * others])

    def splits(self) -> Sequence[tuple[str, slice]]:
        """Return names of the fields, and where their unknowns are among this rank's.

        All displacements are one, with terms' own unknowns; they come first.
        """
        moving = len(self.fields) > len(self._value_fields)
        found = [("displacement", slice(*self._kinds[0]))] if moving else []
        for field in self._value_fields:
            name = field.carried[0].field.name
            taken = sum(known.split("_of_")[0] == name for known, _ in found)
            found.append((f"{name}_of_{taken}" if taken else name, field.part))
        return found

    def interpolations(self, coarsest: int, values: bool = False) -> Sequence[PETSc.Mat]:
        """Return the interpolations to the unknowns of each level from the next coarser one.

        See :func:`.hierarchy.interpolations` (collective).

        Args:
            coarsest: Number of unknowns below which no coarser level is made.
            values: Whether of those that are no displacements; either kind is numbered alone.
        """
        first, last = self._kinds[values]
        dofs = [
            one.level() for one in self._subspaces if isinstance(one.host, ValueField) == values
        ]
        if not values:
            dofs += [own.level() for own in self.own]
        alone = [one._replace(numbers=one.numbers - first) for one in dofs]
        return interpolations(self._comm, last - first, alone, coarsest)

    @property
    def _kinds(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Where displacements begin and end among this rank's unknowns, and where the rest does."""
        moving = [block for block in self._blocks if not isinstance(block, ValueField)]
        first = max((block.part.stop for block in moving), default=0)
        return (0, first), (first, self.sizes[0])

    def mass(self) -> PETSc.Mat:
        """Return the mass matrix of the unknowns that are no displacements (collective)."""
        found: PETSc.Mat | None = None
        for field in self._value_fields:
            for carried in field.carried:
                T = self._free_T(carried)
                root = T.createVecLeft()
                root.array_w[:] = np.sqrt(np.repeat(carried.weights, carried.W.dofmap.index_map_bs))
                scaled = T.copy()
                scaled.diagonalScale(L=root)
                mass = scaled.transposeMatMult(scaled)
                found = mass if found is None else found + mass
        assert found is not None
        start, stop = found.getOwnershipRange()
        first, _ = self._kinds[True]
        own = PETSc.IS().createStride(stop - start - first, first=start + first, comm=self._comm)
        return found.createSubMatrix(own, own)

    def impose(self) -> bool:
        """Impose the step's Dirichlet values from now on; return whether there are any."""
        return any([field.impose() for field in self.fields])

    def lift(self) -> PETSc.Vec:
        """Return the linearised forces of the step's Dirichlet values on the unknowns.

        It is that of the last tangent.
        """
        forces = self._zeros()
        for field, force in zip(self.fields, forces, strict=True):
            field.add_product(field.lift(), force, partial(self.shear_moduli, field))
        for fused, (group, _) in zip(self.fused, self._groups, strict=True):
            for number, one in enumerate(group):
                if one.prescribes:
                    product = one.split(fused.multiply(number, one.increment()))
                    for field, part in zip(one.fields, product, strict=True):
                        forces[self.fields.index(field)].array_w[:] += part
        lifts = [field.u for field in self.fields]
        on_own: list[tuple[OwnUnknowns, PETSc.Vec]] = []
        for term, tangents in zip(self._terms, self._tangents, strict=True):
            count = len(term.bodies)
            for (a, b), K in tangents.items():
                if b == count:
                    continue
                force = K.createVecLeft()
                K.mult(self._moved(term.bodies[b], lifts), force)
                for field, motion in self._ways_of(term.bodies[a]) if a < count else ():
                    target = forces[self.fields.index(field)]
                    motion.T.multTransposeAdd(force, target, target)
                if a == count and term.own is not None:
                    on_own.append((term.own, force))
        for term, coupled in zip(self._terms, self._coupled, strict=True):
            motions = [self._moved(body, lifts) for body in term.bodies]
            self._add(term, term.reduced_product(motions), forces)
            if coupled:
                self._add(term, term.stiffness_force(motions), forces)
        for field, force in zip(self.fields, forces, strict=True):
            field.gather_extended(force)
        reduced = self.restricted(forces)
        for own, force in on_own:
            own.selection.multTransposeAdd(force, reduced, reduced)
        return reduced

    # -- Sizes ----------------------------------------------------------------------------

    def scale(self, F: PETSc.Vec | None = None) -> float:
        """Return the size of external forces and reactions, by which a residual is judged.

        Args:
            F: The residual. Where there are several fields, its norm over what is returned is the
                largest of the fields' own ratios, so that each has to converge by itself.
        """
        sizes_of = zip(self.fields, self._external, self._outer, strict=True)
        scales = self._by_subspace(
            [
                field.factor * np.array([external, field.reactions(), outer, self._changed(field)])
                for field, external, outer in sizes_of
            ]
        )
        scales += [own.size for own in self.own]
        if len(scales) == 1:
            return scales[0]
        if F is None:
            return joint_norm(scales)
        sizes = self._by_subspace([joint_norm(F.array_r[f.part], self._comm) for f in self.fields])
        sizes += [joint_norm(F.array_r[own.part], self._comm) for own in self.own]
        if any(scale == 0.0 < size for size, scale in zip(sizes, scales, strict=True)):
            inner = self._internal_scales()
            scales = [scale or other for scale, other in zip(scales, inner, strict=True)]
        ratios = [
            size / scale for size, scale in zip(sizes, scales, strict=True) if size > 0.0 < scale
        ]
        return norm(F) / max(ratios) if ratios else joint_norm(scales)

    def _by_subspace(self, sizes: Sequence[NDArray[np.float64] | float]) -> list[float]:
        """Return the largest joint size of each subspace.

        Args:
            sizes: Sizes of each field, a number or one of each kind.
        """
        ends = np.cumsum([len(one.fields) for one in self._subspaces])[:-1]
        parts = np.split(np.array(sizes).reshape(len(self.fields), -1), ends)
        return [float(np.linalg.norm(part, axis=0).max()) for part in parts]

    def _changed(self, field: Field) -> float:
        """Return the sizes of changes of a field's residual by those of all unknowns (collective).

        The residual of a constraint has no forces to be compared with: what is to vanish, as the
        change of volume at each point, is a sum of terms that do not.
        """
        if not isinstance(field, ValueField):
            return 0.0
        total = field.force.duplicate()
        total.set(0.0)
        for number, (term, tangents) in enumerate(zip(self._terms, self._tangents, strict=False)):
            if self._coupled[number]:
                changes = [self._place(body)[1].change() for body in term.bodies]
                for body, force in zip(term.bodies, term.absolute_product(changes), strict=True):
                    if self._place(body)[0] is field:
                        body.T.multTransposeAdd(force, total, total)
            if term.own is not None:
                continue  # (it acts on displacements alone)
            for (a, b), K in tangents.items():
                its, motion = self._place(term.bodies[a])
                if its is not field:
                    continue
                key = number, a, b
                if key not in self._sizes_of:
                    self._sizes_of[key] = absolute(K)
                force, change = K.createVecLeft(), K.createVecRight()
                change.array_w[:] = self._place(term.bodies[b])[1].change()
                self._sizes_of[key].mult(change, force)
                motion.particles.T.multTransposeAdd(force, total, total)
        return norm(total)

    def internal_scale(self) -> float:
        """Return the size of what all domains add to the residual, in absolute values."""
        return joint_norm(self._internal_scales())

    def _internal_scales(self) -> list[float]:
        with self._statistics.phase("assemble"):
            totals = self._zeros()
            for term in self._terms:
                self._add(term, term.absolute_contributions(), totals)
            sizes = [f.factor * norm(total) for f, total in zip(self.fields, totals, strict=True)]
            return self._by_subspace(sizes) + [own.size for own in self.own]

    def changes(self) -> list[NDArray[np.float64]]:
        """Return :meth:`Field.changes` of each field."""
        return [field.changes() for field in self.fields]

    def driven(self, particles: Particles, values: Sequence[NDArray[np.float64]]) -> PETSc.Vec:
        """Return how values at the fixed dofs of each V move a body (collective)."""
        driven = [field.driven(own) for field, own in zip(self.fields, values, strict=True)]
        return self._moved(particles, driven).copy()

    def works(self) -> NDArray[np.float64]:
        """Return :meth:`Field.works` of all displacements."""
        found = [
            field.works(partial(self.shear_moduli, field))
            for field in self.fields
            if not isinstance(field, ValueField)
        ]
        return np.asarray(np.sum(found, axis=0))

    def resultant(self) -> float:
        """Return the size of the sum of the last residual over the unknowns.

        It is what loads and supports, as computed, differ by: the stress of a domain adds
        nothing to it, nor does round-off of the stress.
        """
        return joint_norm([one.resultant() for one in self._subspaces])

    def stiffness(self, x: PETSc.Vec) -> float:
        """Return ``x . K x``, summed domain by domain: nothing, for a rigid motion.

        The reduced tangent has each entry to round-off of the stiffest domain around; the
        gradient of a rigid motion is round-off in every domain.
        """
        total = 0.0
        increments = [field.on_background(x) for field in self.fields]
        for field, u in zip(self.fields, increments, strict=True):
            force = u.duplicate()
            force.set(0.0)
            field.add_product(u, force, partial(self.shear_moduli, field))
            total += force.dot(u)
        for term in self._terms:
            motions = [self._moved(body, increments) for body in term.bodies]
            if term.own is not None:
                motions.append(term.own.of(x))
            forces = term.stiffness_force(motions)
            for force, moved in zip(forces, motions, strict=False):
                total += force.dot(moved)
        return float(total)

    def motion(self, x: PETSc.Vec) -> float:
        """Return the size of the displacement that x causes on the bodies."""
        sizes = [size for field in self.fields for size in field.on_bodies(x)]
        return joint_norm([*sizes, *(norm(own.of(x)) for own in self.own)])

    def extent(self) -> float:
        """Return the size of the positions of all nodes."""
        return joint_norm([motion.extent() / field.factor for field, motion in self._places])

    def is_rigid(self, x: PETSc.Vec) -> bool:
        """Return whether x moves each body as a rigid one (collective)."""
        increments = [field.on_background(x) for field in self.fields]
        return all(
            [
                motion.is_rigid(self._moved(motion.particles, increments))
                for _, motion in self._places
            ]
        )

    def has_potential(self) -> bool:
        """Return whether the residual is the gradient of a potential that equilibrium makes least.

        That is if the tangent is symmetric; with fields besides displacements it is a saddle.
        """
        return all(isinstance(body, Particles) for body in self.bodies)

    def one_sided(self) -> bool:
        """Return whether a term may let bodies go and hold them again."""
        return any(term.one_sided for term in self._terms)


def _updated(term: Term) -> BaseException | None:
    """Update a term; return why that cannot be, also where a user's code fails or wants to end."""
    try:
        return term.update()
    except MPMError as error:
        return error
    except KeyboardInterrupt:
        note()
        return Interrupted()
    except np.linalg.LinAlgError as error:  # as of numbers that an x far off has made too large
        return ConvergenceError(f"{term.evaluation} broke down ({error})")
    except Exception as error:
        return as_ours(error, term.evaluation)
    except BaseException as error:
        return error
