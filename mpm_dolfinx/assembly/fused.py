# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""``T^T K T`` domain by domain, in one compiled loop."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from .. import _compat
from .._core import loops
from ..constitutive.averaging import LowRankTerm
from ..history import Statistics
from ..parallel.exchange import swap
from ..parallel.totals import over_ranks
from ..particles.field import CarriedField
from ..particles.particles import Particles
from ..transfer.touched import JointNodes, TouchedNodes, TransferRows
from .body_forms import BodyForms, no_values

__all__ = [
    "CoupledBlocks",
    "Coupling",
    "FusedTangent",
    "Masses",
    "Restriction",
]

#: Most room for the entries of a matrix, in what they need.
ROOM = 1.1


class Support:
    """The background nodes that each domain of a body sees, and T of its nodes.

    Args:
        dofmap: Local nodes of W of each domain, shape ``(n, k)``.

    Attributes:
        offsets: Where the nodes of each domain begin, shape ``(n + 1,)``.
        nodes: Numbers of these among the touched nodes.
        changes: How often they have become others.
    """

    def __init__(self, dofmap: NDArray[np.int32]) -> None:
        self._dofmap = dofmap
        self.changes = 0
        self.offsets: NDArray[np.int64] = np.zeros(1, dtype=np.int64)
        self.nodes: NDArray[np.int32] = np.zeros(0, dtype=np.int32)

    def find(self, rows: TransferRows) -> bool:
        """Find the nodes; return whether they are the old ones."""
        offsets, nodes = loops.supports(self._dofmap, *rows)
        same = np.array_equal(offsets, self.offsets) and np.array_equal(nodes, self.nodes)
        if not same:
            self.offsets, self.nodes = offsets, nodes
            self.changes += 1
        return same

    def transfers(self, rows: TransferRows) -> NDArray[np.float64]:
        """Return T of each domain, ``(number of nodes, k)`` one after the other."""
        found = np.empty((len(self.nodes), self._dofmap.shape[1]))
        loops.local_transfers(self._dofmap, *rows, self.offsets, self.nodes, found)
        return found


class _Loops:
    """One body's domains, their background nodes and where their tangents go."""

    def __init__(self, particles: Particles, forms: BodyForms, coupled: bool) -> None:
        self.particles = particles
        self._forms = forms
        self._domains = (particles.domain_nodes, particles.quadrature.gradients)
        internal = forms.internal
        one = particles.num_points == 1
        self._points = internal is not None and one and internal.hoop is None
        whole = bool(forms.fused) or (internal is not None and not self._points)
        self._whole = whole or coupled
        self.support = Support(particles.domain_nodes)
        self.transfers: NDArray[np.float64] = no_values

    @property
    def factor(self) -> float:
        """How often the tangent counts."""
        return self._forms.factor

    def transfer(self, rows: TransferRows) -> None:
        """Take over the values of T."""
        support = self.support
        if self._points:
            self._gradients = np.empty((len(support.nodes), self._domains[1].shape[-1]))
            given = (*self._domains, *rows, support.offsets, support.nodes)
            loops.support_gradients(*given, self._gradients)
        if self._whole:
            self.transfers = support.transfers(rows)

    @staticmethod
    def _vectors(term: LowRankTerm | None) -> NDArray[np.float64]:
        """Return left and right vectors of each domain in turn, ``(n, 2 m, k, gdim)``; or none."""
        if term is None:
            return no_values
        pairs = zip(term.left, term.right, strict=True)
        return np.stack([vector for pair in pairs for vector in pair], axis=1)

    def add_masses(
        self,
        masses: NDArray[np.float64],
        rows: TransferRows,
        positions: NDArray[np.int32],
        values: NDArray[np.float64],
    ) -> None:
        """Add the body's reduced mass, one number for each of the pattern's blocks."""
        transfers = self.transfers if self._whole else self.support.transfers(rows)
        offsets = self.support.offsets
        loops.assemble_masses(*self._domains, transfers, masses, offsets, positions, values)

    def add(self, positions: NDArray[np.int32], values: NDArray[np.float64]) -> None:
        """Add the body's reduced tangent to the values of the pattern's blocks."""
        target = (self.support.offsets, positions, values)
        internal = self._forms.internal
        if internal is not None and self._points:
            loops.assemble_points(
                *self._domains,
                internal.weights,
                self._gradients,
                internal.tangent,
                internal.symmetric,
                *target,
            )
        elif internal is not None:
            loops.assemble_domains(
                *self._domains,
                internal.weights,
                no_values if internal.hoop is None else internal.hoop,
                self.transfers,
                internal.tangent,
                self._vectors(self._forms.low_rank_of_domains()),
                *target,
            )
        body = self.particles.mesh
        geometry = (body.geometry.x, _compat.geometry_dofmap(body))
        for form in self._forms.fused:
            constants, packed = _compat.packed(form)
            for integral in _compat.compiled_integrals(form):
                loops.assemble_form(
                    integral.kernel,
                    integral.entities,
                    packed[integral.key],
                    constants,
                    *geometry,
                    *self._domains,
                    self.transfers,
                    *target,
                )


class Coupling(Protocol):
    """Coupling of a body's displacement and a field on it, for the compiled loops."""

    @property
    def places(self) -> tuple[Particles, CarriedField]:
        """The body and the field."""

    def add(self, blocks: CoupledBlocks) -> None:
        """Add the reduced tangent but for the block of the displacement itself."""


class CoupledBlocks(NamedTuple):
    """Where a coupling goes: T of each domain, and places and values of three blocks.

    Attributes:
        displacement: T of the body's nodes, and where that of each domain begins.
        field: T of the field's values, the same way.
        of_field: Positions and values of the block with rows of the field.
        of_displacement: Those of the block with rows of the displacement.
        alone: Those of the field's own block.
    """

    displacement: tuple[NDArray[np.int64], NDArray[np.float64]]
    field: tuple[NDArray[np.int64], NDArray[np.float64]]
    of_field: tuple[NDArray[np.int32], NDArray[np.float64]]
    of_displacement: tuple[NDArray[np.int32], NDArray[np.float64]]
    alone: tuple[NDArray[np.int32], NDArray[np.float64]]


class Restriction(NamedTuple):
    """The present transfer and unknowns of a field.

    Attributes:
        touched: The nodes that its bodies touch.
        rows: Their rows of T, of each part of the tangent.
        numbers: For each own dof of V, and of the spaces of free nodes, its number among all
            unknowns, or -1.
        part: Where the field's unknowns are among this rank's.
        factor: Value on V of an unknown of size 1.
    """

    touched: TouchedNodes | JointNodes
    rows: Sequence[TransferRows]
    numbers: NDArray[np.int32]
    part: slice
    factor: float = 1.0


type Masses = Sequence[tuple[Particles, NDArray[np.float64]]]
"""Bodies, and for each of their domains a matrix between its nodes, ``(n, k, k)``."""


class FusedTangent:
    """``T^T K T`` of all bodies of some fields at the unknowns, without ever forming K.

    Each rank adds its own domains' ``T_p^T K_p T_p`` to blocks between the background nodes
    that they touch, of whatever rank. The pattern, and with it the matrix, lasts until a node
    of a body enters another cell. Off-rank rows travel once for each assembly. The fields are
    blocks on the diagonal of one matrix, into which each writes; what couples a body and a field on
    it has blocks beside these.

    Args:
        comm: The ranks.
        fields: Bodies with their forms, those of each field; of fields that are no displacements
            those of ``couplings`` are known.
        couplings: What couples a displacement and another field, with the numbers of both.
        statistics: Where to count.
    """

    def __init__(
        self,
        comm: MPI.Comm,
        fields: Sequence[Sequence[tuple[Particles, BodyForms]]],
        couplings: Sequence[tuple[int, int, Coupling]],
        statistics: Statistics,
    ) -> None:
        self._comm = comm
        coupled = [coupling.places[0] for _, _, coupling in couplings]
        self._blocks = [
            _Block(comm, [_Loops(*body, any(body[0] is one for one in coupled)) for body in bodies])
            for bodies in fields
        ]
        self._couplings = [
            _Coupled(self._blocks[i], self._blocks[j], coupling) for i, j, coupling in couplings
        ]
        self._statistics = statistics
        self._A: PETSc.Mat | None = None
        self._room = [no_values, no_values]  # for entries in columns of this rank, and in others

    def restrict(self, fields: Sequence[Restriction], sizes: tuple[int, int]) -> None:
        """Take over the present transfer and unknowns (collective).

        Args:
            fields: Those of each field.
            sizes: Number of unknowns of this rank and of all ranks.
        """
        same = self._A is not None and self._A.getSizes()[0] == sizes
        for block, field in zip(self._blocks, fields, strict=True):
            same &= block.restrict(field)
        if not over_ranks(self._comm, same, MPI.LAND):
            self._make_matrix(fields, sizes)
            self._statistics.count("patterns")
        for block, field in zip(self._blocks, fields, strict=True):
            block.transfer(field)

    def forget(self) -> None:
        """Make the pattern anew in the next step."""
        self._A = None

    def _make_matrix(self, fields: Sequence[Restriction], sizes: tuple[int, int]) -> None:
        lasts = np.cumsum(self._comm.allgather(sizes[0]))
        start = int(lasts[self._comm.rank]) - sizes[0]
        for block in self._blocks:
            block.make_patterns()
        found = [
            block.make_rows((start + field.part.start, start + field.part.stop), start, lasts)
            for block, field in zip(self._blocks, fields, strict=True)
        ]
        parts = [field.part for field in fields]
        inside = [own for own, _ in found]
        outside = [others for _, others in found]
        csr = [_stacked(parts, entries, sizes[0]) for entries in (inside, outside)]
        values = [self._entries(side, len(columns)) for side, (_, columns) in enumerate(csr)]
        ends = [0, 0]
        for block, entries in zip(self._blocks, zip(inside, outside, strict=True), strict=True):
            mine = []
            for side, (_, columns) in enumerate(entries):
                mine.append(values[side][ends[side] : ends[side] + len(columns)])
                ends[side] += len(columns)
            block.entries = mine[0], mine[1]
        matrices = [(*one, data) for one, data in zip(csr, values, strict=True)]
        self._A = PETSc.Mat().createAIJWithArrays(
            (sizes, sizes),
            matrices[0] if self._comm.size == 1 else tuple(matrices),
            comm=self._comm,
        )

    def _entries(self, side: int, count: int) -> NDArray[np.float64]:
        """Return room for entries, that of the matrix before where it is large enough.

        Memory that is new has to be cleared by the system, page by page.
        """
        if not count <= len(self._room[side]) <= ROOM * count:
            self._room[side] = np.empty(int((0.5 + 0.5 * ROOM) * count))
        room = self._room[side][:count]
        room[:] = 0.0
        return room

    def weigh(self, masses: Masses) -> PETSc.Mat:
        """Return ``T^T M T``, and keep it for :meth:`assemble` in this step (collective).

        What :meth:`assemble` has returned is overwritten.

        Args:
            masses: M of domains.
        """
        assert self._A is not None
        for block in self._blocks:
            block.weigh(masses)
        self._A.assemble()
        # Of all components of two nodes, masses join equal ones.
        offsets, columns, values = self._A.getValuesCSR()
        kept = values != 0.0
        ends = np.concatenate([[0], np.cumsum(kept)])[offsets]
        csr = (ends.astype(PETSc.IntType), columns[kept], values[kept])
        return PETSc.Mat().createAIJ(self._A.getSizes(), csr=csr, comm=self._comm)

    def assemble(self, keep: Sequence[bool], factor: float = 0.0) -> PETSc.Mat:
        """Return ``T^T K T``; the same object as long as the pattern lasts (collective).

        Args:
            keep: Whether :meth:`multiply` will be called, for each field.
            factor: How often the masses of :meth:`weigh` are added, if there are any.
        """
        assert self._A is not None
        for block in self._blocks:
            block.begin()
        for coupled in self._couplings:
            coupled.add()
        for block, kept in zip(self._blocks, keep, strict=True):
            block.assemble(kept, factor)
        self._A.assemble()
        return self._A

    def multiply(self, field: int, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a field's last ``T^T K T u`` on all active dofs, fixed ones too (collective).

        What couples it with other fields has no part in it.

        Args:
            field: Its number.
            u: An increment on this rank's own dofs of its spaces.
        """
        return self._blocks[field].multiply(u)


def _stacked(
    parts: Sequence[slice],
    entries: Sequence[tuple[NDArray[np.int32], NDArray[np.int32]]],
    count: int,
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return offsets and columns of rows below each other, of which each part has some."""
    counts = np.zeros(count + 1, dtype=PETSc.IntType)
    for part, (starts, _) in zip(parts, entries, strict=True):
        counts[part.start + 1 : part.stop + 1] = np.diff(starts)
    columns = np.concatenate([columns for _, columns in entries])
    return np.cumsum(counts, dtype=PETSc.IntType), columns.astype(PETSc.IntType, copy=False)


class _Pattern:
    """Blocks between the nodes of one field and those of another, or of the same.

    Fields have their patterns, and are not kept alive by them: what a problem lets go of must be
    gone before PETSc's garbage is collected.

    Args:
        rows: The field of the rows.
        columns: The field of the columns.
    """

    def __init__(self, rows: _Block, columns: _Block) -> None:
        self._references = weakref.ref(rows), weakref.ref(columns)
        self._pairs: list[tuple[Support, Support]] = []
        self._made_of: tuple[Any, ...] = ()
        self.values: NDArray[np.float64] = no_values

    @property
    def _rows(self) -> _Block:
        block = self._references[0]()
        assert block is not None
        return block

    @property
    def columns(self) -> _Block:
        """The field of the columns."""
        block = self._references[1]()
        assert block is not None
        return block

    def take(self, rows: Support, columns: Support) -> int:
        """Take over domains that see nodes of both fields; return their number."""
        self._pairs.append((rows, columns))
        return len(self._pairs) - 1

    def make(self) -> None:
        """Find the blocks, and the place of each pair of nodes of a domain among them.

        They are those of before where domains see the same nodes as then.
        """
        seen = [(one.changes, other.changes) for one, other in self._pairs]
        made_of = self._rows.num_touched, self.columns.num_touched, *seen
        if made_of == self._made_of:
            return
        self._made_of = made_of
        rows, columns = (_joined([pair[side] for pair in self._pairs]) for side in range(2))
        found = loops.pattern(*rows, self._rows.num_touched, *columns, self.columns.num_touched)
        self.offsets, self.nodes, positions = found
        counts = [
            int((np.diff(one.offsets) * np.diff(other.offsets)).sum()) for one, other in self._pairs
        ]
        self.positions = np.split(positions, np.cumsum(counts)[:-1])

    @property
    def size(self) -> int:
        """Number of values."""
        return len(self.nodes) * self._rows.bs * self.columns.bs

    def of(self, number: int) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
        """Return positions of the domains that were taken over with this number, and the values."""
        return self.positions[number], self.values

    @property
    def part(self) -> tuple[Any, ...]:
        """Arguments of the compiled loops."""
        return self.offsets, self.nodes, self.columns.bs, self.columns.numbers


def _joined(supports: Sequence[Support]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Return offsets and nodes of supports one after the other."""
    ends = np.cumsum([0, *(one.offsets[-1] for one in supports)])
    offsets = [one.offsets[1:] + end for one, end in zip(supports, ends, strict=False)]
    nodes = np.concatenate([one.nodes for one in supports])
    return np.concatenate([[0], *offsets]).astype(np.int64), nodes


class _Coupled:
    """Coupling of a displacement and another field, and its places in the rows of both."""

    def __init__(self, moving: _Block, other: _Block, coupling: Coupling) -> None:
        self._coupling = coupling
        particles, carried = coupling.places
        self._body = moving.loops_of(particles)
        self._number = other.take(carried)
        self._other = other
        mine, its = self._body.support, other.supports[self._number]
        self._of_field = other.beside(moving), other.beside(moving).take(its, mine)
        self._of_displacement = moving.beside(other), moving.beside(other).take(mine, its)
        self._alone = other.beside(other), other.beside(other).take(its, its)

    def add(self) -> None:
        """Add the blocks to the values of the patterns."""
        its = self._other.supports[self._number]
        places = [
            pattern.of(number)
            for pattern, number in (self._of_field, self._of_displacement, self._alone)
        ]
        self._coupling.add(
            CoupledBlocks(
                (self._body.support.offsets, self._body.transfers),
                (its.offsets, self._other.transfers[self._number]),
                *places,
            )
        )


class _Block:
    """The rows of one field.

    Args:
        comm: The ranks.
        bodies: Bodies with their forms, all on one V; there may be none.

    Attributes:
        entries: Values of the field's rows in the matrix: in columns of this rank, and in others.
        bs: Number of dofs at a node.
        numbers: Number of the unknown of each touched dof, or -1.
        num_touched: Number of touched nodes.
        supports: Those of its bodies, or of the values that it carries.
        transfers: T of these values.
    """

    entries: tuple[NDArray[np.float64], NDArray[np.float64]]

    def __init__(self, comm: MPI.Comm, bodies: Sequence[_Loops]) -> None:
        self._comm = comm
        self._loops = list(bodies)
        self._masses: NDArray[np.float64] | None = None
        self.bs = 1
        self._touched: TouchedNodes | JointNodes | None = None
        self.numbers: NDArray[np.int32] = np.zeros(0, dtype=np.int32)
        self.num_touched = 0
        self.supports = [body.support for body in self._loops]
        self.transfers: list[NDArray[np.float64]] = []
        self._patterns: list[_Pattern] = []
        for support in self.supports:
            self.beside(self).take(support, support)

    def loops_of(self, particles: Particles) -> _Loops:
        """Return the loops of a body."""
        return next(body for body in self._loops if body.particles is particles)

    def take(self, carried: CarriedField) -> int:
        """Take over values on a body; return their number among those of the field."""
        self.supports.append(Support(carried.domain_nodes))
        return len(self.supports) - 1

    def beside(self, other: _Block) -> _Pattern:
        """Return the pattern of the blocks with the columns of a field."""
        for pattern in self._patterns:
            if pattern.columns is other:
                return pattern
        self._patterns.append(_Pattern(self, other))
        return self._patterns[-1]

    def restrict(self, field: Restriction) -> bool:
        """Take over the present unknowns; return whether their pattern is the old one."""
        self._touched = field.touched
        if not self.supports:
            return True
        self.bs = field.touched.block_size
        numbers = field.touched.spread(field.numbers.reshape(-1, self.bs)).ravel()
        same = bool(np.array_equal(numbers, self.numbers))
        self.numbers, self.num_touched = numbers, field.touched.count
        for support, rows in zip(self.supports, field.rows, strict=True):
            same &= support.find(rows)
        return same

    def transfer(self, field: Restriction) -> None:
        """Take over the values of T."""
        self._rows, self._masses = field.rows, None
        if self._loops:
            for body, rows in zip(self._loops, field.rows, strict=True):
                body.transfer(rows)
            return
        self.transfers = [
            support.transfers(rows._replace(values=field.factor * rows.values))
            for support, rows in zip(self.supports, field.rows, strict=True)
        ]

    def weigh(self, masses: Masses) -> None:
        """Write the masses into the field's rows, and keep them (collective)."""
        if not self.supports:
            return
        self.begin()
        if self._loops:
            own = self.beside(self)
            self._masses = np.zeros(len(own.nodes))
            for number, (body, rows) in enumerate(zip(self._loops, self._rows, strict=True)):
                for particles, mass in masses:
                    if particles is body.particles:
                        body.add_masses(mass, rows, own.positions[number], self._masses)
            self._add_masses(1.0)
        self._write()

    def _add_masses(self, factor: float) -> None:
        """Add the masses, if any, to the values of the pattern's blocks."""
        if self._masses is None:
            return
        blocks = self.beside(self).values.reshape(-1, self.bs, self.bs)
        for i in range(self.bs):
            blocks[:, i, i] += factor * self._masses

    def make_patterns(self) -> None:
        """Find the blocks of the field's rows."""
        for pattern in self._patterns:
            pattern.make()

    def make_rows(
        self, own: tuple[int, int], start: int, lasts: NDArray[np.int64]
    ) -> tuple[
        tuple[NDArray[np.int32], NDArray[np.int32]], tuple[NDArray[np.int32], NDArray[np.int32]]
    ]:
        """Return the field's rows of the matrix, as offsets and columns (collective).

        Args:
            own: Range of the numbers of this rank's unknowns of the field.
            start: First number of this rank's unknowns of all fields.
            lasts: End of the range of all unknowns of each rank.

        Returns:
            Entries in columns of this rank, counted from the first of them, and in all others.
        """
        if not self.supports:
            none = np.zeros(own[1] - own[0] + 1, dtype=np.int32), np.zeros(0, dtype=np.int32)
            return none, none
        self._kept: NDArray[np.float64] | None = None
        blocks = ([pattern.part for pattern in self._patterns], self.bs, self.numbers)
        starts, columns = self._exchange_rows(blocks, own, lasts)
        rank = start, int(lasts[self._comm.rank])
        inside, outside, places = loops.reduce(*blocks, own, rank, starts, columns)
        self._sources = inside[2], outside[2]
        shift = len(inside[2])
        self._within = places < shift
        self._places = places[self._within], places[~self._within] - shift
        return inside[:2], outside[:2]

    def _exchange_rows(
        self, blocks: tuple[Any, ...], own: tuple[int, int], lasts: NDArray[np.int64]
    ) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Tell other ranks the places of their entries; return what they tell, by own row."""
        rows, (starts, columns, sources) = loops.foreign_rows(*blocks, own)
        row = np.repeat(rows, np.diff(starts))
        owner = np.searchsorted(lasts, row, side="right")
        order = np.argsort(owner, kind="stable")
        self._sent = np.split(
            sources[order], np.searchsorted(owner[order], np.arange(1, self._comm.size))
        )
        ends = np.cumsum([len(part) for part in self._sent])[:-1]
        pairs = np.column_stack([row, columns])[order]
        received = np.concatenate(swap(self._comm, np.split(pairs, ends)))
        self._order = np.argsort(received[:, 0], kind="stable")
        counts = np.bincount(received[:, 0] - own[0], minlength=own[1] - own[0])
        offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        return offsets, np.ascontiguousarray(received[self._order, 1])

    def begin(self) -> None:
        """Begin an assembly: no domain has added anything."""
        if not self.supports:
            return
        ends = np.cumsum([pattern.size for pattern in self._patterns])
        self._all: NDArray[np.float64] = np.zeros(ends[-1] + 1)
        values = np.split(self._all[:-1], ends[:-1])
        for pattern, part in zip(self._patterns, values, strict=True):
            pattern.values = part

    def assemble(self, keep: bool, factor: float) -> None:
        """Write the field's rows (collective).

        Args:
            keep: Whether :meth:`multiply` will be called.
            factor: Of the masses.
        """
        if not self.supports:
            return
        for number, body in enumerate(self._loops):
            positions, values = self.beside(self).of(number)
            if body.factor == 1.0:
                body.add(positions, values)
            else:
                own = np.zeros_like(values)
                body.add(positions, own)
                values += body.factor * own
        if factor != 0.0:
            self._add_masses(factor)
        self._kept = self.beside(self).values if keep and self._loops else None
        self._write()

    def _write(self) -> None:
        """Write the values of the patterns, summed over ranks, into the field's rows."""
        for sources, entries in zip(self._sources, self.entries, strict=True):
            loops.gather(self._all, sources, entries)
        if self._comm.size > 1:
            received = np.concatenate(swap(self._comm, [self._all[part] for part in self._sent]))
            received = received[self._order]
            np.add.at(self.entries[0], self._places[0], received[self._within])
            np.add.at(self.entries[1], self._places[1], received[~self._within])
        self._all = no_values
        for pattern in self._patterns:
            pattern.values = no_values

    def multiply(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the last ``T^T K T u`` on all active dofs, fixed ones too (collective)."""
        if not self._loops:
            return np.zeros_like(u)
        assert self._kept is not None and self._touched is not None
        local = self._touched.spread(u.reshape(-1, self.bs))
        result = np.empty_like(local)
        own = self.beside(self)
        loops.multiply(own.offsets, own.nodes, self.bs, self._kept, local, result)
        return np.asarray(self._touched.collect(result).ravel())
