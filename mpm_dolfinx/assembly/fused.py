# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""``T^T K T`` domain by domain, in one compiled loop."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple, Protocol

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from .. import _compat
from .._core import loops
from ..constitutive.averaging import LowRankTerm
from ..history import Statistics
from ..meshes.order import morton_order
from ..parallel.exchange import swap
from ..parallel.totals import over_ranks
from ..particles.field import CarriedField
from ..particles.particles import Particles
from ..transfer.touched import JointNodes, TouchedNodes, TransferRows
from .body_forms import BodyForms, integrals_of, no_values

__all__ = [
    "CoupledBlocks",
    "Coupling",
    "FusedTangent",
    "Masses",
    "Restriction",
    "no_ties",
]

#: No further blocks.
no_ties: NDArray[np.int32] = np.zeros((0, 4), dtype=np.int32)

#: Where domains go, for the compiled loops: groups, supports, pairs and a pattern's values.
type Where = tuple[Any, ...]

#: Most nodes that a group of domains sees, where it has several: what they do to each other adds up
#: in a dense matrix that a processor's second cache holds, before it goes to the sparse one. With
#: half as many, or twice, assembly in space takes 5 to 10 % longer.
GROUP = 48

#: Most room for the entries of a matrix, in what they need.
ROOM = 1.1


class Support:
    """The background nodes that each domain of a body sees, and T of its nodes.

    Domains are visited neighbours after neighbours, in groups that see few nodes together.

    Args:
        dofmap: Local nodes of W of each domain, shape ``(n, k)``.
        order: In which domains are visited, shape ``(n,)``; or the support of another field on the
            same domains, whose groups are taken.

    Attributes:
        changes: How often the nodes have become others.
    """

    def __init__(self, dofmap: NDArray[np.int32], order: NDArray[np.int32] | Support) -> None:
        self._dofmap = dofmap
        self._host = order if isinstance(order, Support) else None
        self._order = order.groups[0] if isinstance(order, Support) else order
        self.changes = 0
        self._first: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        self._nodes: tuple[NDArray[Any], ...] = ()

    @property
    def groups(self) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
        """The order of domains, and where groups begin in it, shape ``(number of groups + 1,)``."""
        return self._order, self._first

    @property
    def nodes(self) -> tuple[NDArray[Any], ...]:
        """The nodes of groups, and those of them that domains see, both in compressed rows.

        Where nodes of domains begin, and their numbers among those of the group; where nodes of
        groups begin, and their numbers among the touched nodes.
        """
        return self._nodes

    @property
    def size(self) -> int:
        """How many nodes domains see, all added up."""
        return len(self._nodes[1])

    def find(self, rows: TransferRows) -> bool:
        """Find the nodes; return whether they are the old ones."""
        given = self._first[:0] if self._host is None else self._host.groups[1]
        first, nodes = loops.supports(self._dofmap, *rows, self._order, given, GROUP)
        found, known = (first, *nodes), (self._first, *self._nodes)
        same = len(found) == len(known) and all(map(np.array_equal, found, known))
        if not same:
            self._first, self._nodes = first, nodes
            self.changes += 1
        return same

    def transfers(self, rows: TransferRows) -> NDArray[np.float64]:
        """Return T of each domain, ``(number of nodes, k)`` one after the other."""
        found = np.empty((self.size, self._dofmap.shape[1]))
        loops.local_transfers(self._dofmap, *rows, self.groups, self.nodes, found)
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
        body = particles.mesh
        first = _compat.geometry_dofmap(body)[: len(particles.domain_nodes), 0]
        order = morton_order(body.geometry.x[first, : body.geometry.dim])
        self.support = Support(particles.domain_nodes, order)
        self.transfers: NDArray[np.float64] = no_values

    def transfer(self, rows: TransferRows) -> None:
        """Take over the values of T."""
        support = self.support
        if self._points:
            self._gradients = np.empty((support.size, self._domains[1].shape[-1]))
            given = (*self._domains, *rows, support.groups, support.nodes)
            loops.support_gradients(*given, self._gradients)
        if self._whole:
            self.transfers = support.transfers(rows)

    def _vectors(self, term: LowRankTerm | None) -> NDArray[np.float64]:
        """Return left and right vectors of each domain in turn, ``(n, 2 m, k, gdim)``; or none."""
        if term is None:
            return no_values
        left = [self._counted(vector) for vector in term.left]
        pairs = zip(left, term.right, strict=True)
        return np.stack([vector for pair in pairs for vector in pair], axis=1)

    def add_masses(
        self,
        masses: NDArray[np.float64],
        rows: TransferRows,
        where: Where,
        values: NDArray[np.float64],
    ) -> None:
        """Add the body's reduced mass, one number for each of the pattern's blocks."""
        transfers = self.transfers if self._whole else self.support.transfers(rows)
        loops.assemble_masses(*self._domains, transfers, masses, where, values)

    def _counted(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return values as often as the tangent counts."""
        factor = self._forms.factor
        return values if factor == 1.0 else factor * values

    def add(self, where: Where) -> None:
        """Add the body's reduced tangent."""
        internal = self._forms.internal
        if internal is not None and self._points:
            loops.assemble_points(
                *self._domains,
                self._counted(internal.weights),
                self._gradients,
                internal.tangent,
                internal.symmetric,
                where,
            )
        elif internal is not None:
            loops.assemble_domains(
                *self._domains,
                self._counted(internal.weights),
                no_values if internal.hoop is None else internal.hoop,
                self.transfers,
                internal.tangent,
                self._vectors(self._forms.low_rank_of_domains()),
                where,
            )
        for form in self._forms.fused:
            for compiled in integrals_of(form, self.particles.mesh):
                loops.assemble_form(
                    compiled, *self._domains, self.transfers, self._forms.factor, where
                )


class Coupling(Protocol):
    """Coupling of a body's displacement and a field on it, for the compiled loops."""

    @property
    def places(self) -> tuple[Particles, CarriedField]:
        """The body and the field."""

    def add(self, blocks: CoupledBlocks) -> None:
        """Add the reduced tangent but for the block of the displacement itself."""

    def sizes(
        self, moved: NDArray[np.float64], carried: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the sizes of changes of the field's residual at own values (collective).

        Args:
            moved: Sizes of changes of displacement, on own dofs of W.
            carried: Those of changes of the field, at own values.
        """


class CoupledBlocks(NamedTuple):
    """Where a coupling goes: T of each domain, and places of three blocks.

    Attributes:
        displacement: T of the body's nodes, of each domain one after the other.
        field: T of the field's values, the same way.
        of_field: Where the block with rows of the field goes.
        of_displacement: Where that with rows of the displacement goes.
        alone: Where the field's own block goes.
    """

    displacement: NDArray[np.float64]
    field: NDArray[np.float64]
    of_field: Where
    of_displacement: Where
    alone: Where


class Restriction(NamedTuple):
    """The present transfer and unknowns of a field.

    Attributes:
        touched: The nodes that its bodies touch.
        rows: Their rows of T, of each part of the tangent.
        numbers: For each own dof of V, and of the spaces of free nodes, its number among all
            unknowns, or -1.
        part: Where the field's unknowns are among this rank's.
        ties: Further blocks of the field, in rows of any rank, that the matrix is to have places
            for: first row, height, first column and width of each, shape ``(n, 4)``.
        factor: Value on V of an unknown of size 1.
    """

    touched: TouchedNodes | JointNodes
    rows: Sequence[TransferRows]
    numbers: NDArray[np.int32]
    part: slice
    ties: NDArray[np.int32] = no_ties
    factor: float = 1.0


type Masses = Sequence[tuple[Particles, NDArray[np.float64]]]
"""Bodies, and for each of their domains a matrix between its nodes, ``(n, k, k)``."""


class FusedTangent:
    """``T^T K T`` of all bodies of some fields at the unknowns, without ever forming K.

    Each rank adds its own domains' ``T_p^T K_p T_p`` to the entries of the matrix, and what belongs
    to rows of other ranks to values that it sends these, once for each assembly. The pattern, and
    with it the matrix, lasts until a node of a body enters another cell. The fields are blocks on
    the diagonal of one matrix, into which each writes; what couples a body and a field on it has
    blocks beside these.

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
        self._rows: tuple[Any, Any] = (), ()  # of the matrix, in columns of this rank and in others
        self._room = [no_values, no_values]  # for entries in columns of this rank, and in others

    def restrict(self, fields: Sequence[Restriction], sizes: tuple[int, int]) -> None:
        """Take over the present transfer and unknowns (collective).

        Args:
            fields: Those of each field.
            sizes: Number of unknowns of this rank and of all ranks.
        """
        same = self._A is not None and self._A.getSizes()[0] == sizes
        pairs = list(zip(self._blocks, fields, strict=True))
        for block, field in sorted(pairs, key=lambda pair: pair[0].is_carried):  # (hosts first)
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
        csr = [_stacked(parts, [rows[side] for rows in found], sizes[0]) for side in range(2)]
        values = [self._entries(side, len(columns)) for side, (_, columns) in enumerate(csr)]
        ends = [np.cumsum([len(rows[side][1]) for rows in found])[:-1] for side in range(2)]
        split = zip(*(np.split(*each) for each in zip(values, ends, strict=True)), strict=True)
        for block, (inside, outside) in zip(self._blocks, split, strict=True):
            block.inside, block.outside = inside, outside
        matrices = [(*one, data) for one, data in zip(csr, values, strict=True)]
        offsets, columns, entries = matrices[1]
        self._rows = matrices[0], (offsets, columns.copy(), entries)  # (PETSc numbers them anew)
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

    def assemble(self, factor: float = 0.0) -> PETSc.Mat:
        """Return ``T^T K T``; the same object as long as the pattern lasts (collective).

        Args:
            factor: How often the masses of :meth:`weigh` are added, if there are any.
        """
        assert self._A is not None
        for block in self._blocks:
            block.begin()
        for coupled in self._couplings:
            coupled.add()
        for block in self._blocks:
            block.assemble(factor)
        self._A.assemble()
        return self._A

    def add(self, part: PETSc.Mat) -> bool:
        """Add to the last tangent, if it has a place for each entry (collective).

        Args:
            part: A matrix in all unknowns.

        Returns:
            Whether it has; nothing is added otherwise.
        """
        assert self._A is not None
        given = part.getValuesCSR(), *self._rows, self._A.getOwnershipRange()
        if not over_ranks(self._comm, loops.add_entries(*given, False), MPI.LAND):
            return False
        loops.add_entries(*given, True)
        self._A.assemble()
        return True


def _stacked(
    parts: Sequence[slice],
    entries: Sequence[tuple[NDArray[np.int32], NDArray[np.int32]]],
    count: int,
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return offsets and columns of rows below each other, of which each part has some."""
    counts = np.zeros(count + 1, dtype=PETSc.IntType)
    for part, (starts, _) in zip(parts, entries, strict=True):
        counts[part.start + 1 : part.stop + 1] = np.diff(starts)
    whole = [columns for _, columns in entries if len(columns) > 0]
    columns = whole[0] if len(whole) == 1 else np.concatenate([entries[0][1][:0], *whole])
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
        self._positions: list[NDArray[np.uint8]] = []  # (the old ones need room no more)
        rows, columns = (_joined([pair[side] for pair in self._pairs]) for side in range(2))
        has = [loops.seen_pairs(row.groups, row.nodes, column.nodes) for row, column in self._pairs]
        counts = self._rows.num_touched, self.columns.num_touched
        found = loops.pattern(*rows, counts[0], *columns, counts[1], np.concatenate(has))
        self._offsets, self.nodes, pairs, positions, size = found
        ends = np.cumsum([0, *(len(row.groups[1]) - 1 for row, _ in self._pairs)])
        self._first = [pairs[a : b + 1] - pairs[a] for a, b in pairwise(ends)]
        self._positions = np.split(positions, size * pairs[ends[1:-1]])

    def part(self) -> tuple[Any, ...]:
        """Return the arrays by which compiled loops find places of blocks; they are forgotten."""
        self._places = np.zeros(len(self.nodes), dtype=np.int32)
        columns = self.columns
        return self._offsets, self.nodes, columns.bs, columns.numbers, self._places

    def where(self, number: int) -> Where:
        """Return where domains go that were taken over with this number."""
        rows, columns = self._pairs[number]
        return (
            rows.groups,
            rows.nodes,
            columns.nodes,
            self._first[number],
            self._positions[number],
            self._offsets,
            self._places,
            self._rows.starts,
            self.columns.masks,
            *self._rows.values,
        )


def _joined(supports: Sequence[Support]) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Return where nodes of groups begin, and these, of supports one after the other."""
    ends, nodes = zip(*(support.nodes[2:] for support in supports), strict=True)
    starts = np.cumsum([0, *(own[-1] for own in ends)])
    shifted = [own[1:] + start for own, start in zip(ends, starts, strict=False)]
    return np.concatenate([starts[:1], *shifted]), np.concatenate(nodes)


class _Coupled:
    """Coupling of a displacement and another field, and its places in the rows of both."""

    def __init__(self, moving: _Block, other: _Block, coupling: Coupling) -> None:
        self._coupling = coupling
        particles, carried = coupling.places
        self._body = moving.loops_of(particles)
        self._number = other.take(carried, self._body.support)
        self._other = other
        mine, its = self._body.support, other.supports[self._number]
        self._of_field = other.beside(moving), other.beside(moving).take(its, mine)
        self._of_displacement = moving.beside(other), moving.beside(other).take(mine, its)
        self._alone = other.beside(other), other.beside(other).take(its, its)

    def add(self) -> None:
        """Add the blocks to the values of the patterns."""
        places = [
            pattern.where(number)
            for pattern, number in (self._of_field, self._of_displacement, self._alone)
        ]
        self._coupling.add(
            CoupledBlocks(self._body.transfers, self._other.transfers[self._number], *places)
        )


class _Block:
    """The rows of one field.

    Args:
        comm: The ranks.
        bodies: Bodies with their forms, all on one V; there may be none.

    Attributes:
        inside: Values of the field's rows in columns of this rank.
        outside: Those in other columns.
        starts: Where rows of the touched dofs begin in one of these, or among values to be sent.
        masks: Which dofs of each touched node are unknowns, as bits.
        bs: Number of dofs at a node.
        numbers: Number of the unknown of each touched dof, or -1.
        num_touched: Number of touched nodes.
        supports: Those of its bodies, or of the values that it carries.
        transfers: T of these values.
    """

    inside: NDArray[np.float64]
    outside: NDArray[np.float64]

    def __init__(self, comm: MPI.Comm, bodies: Sequence[_Loops]) -> None:
        self._comm = comm
        self._loops = list(bodies)
        self._ties = no_ties
        self._sent = no_values  # values of rows of other ranks, by these
        self.starts: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        self.masks: NDArray[np.uint8] = np.zeros(0, dtype=np.uint8)
        self._masses: NDArray[np.float64] | None = None
        self.bs = 1
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

    @property
    def is_carried(self) -> bool:
        """Whether the field is carried by bodies of others."""
        return not self._loops

    def take(self, carried: CarriedField, host: Support) -> int:
        """Take over values on a body; return their number among those of the field.

        Args:
            carried: The values.
            host: The support of the body's own nodes.
        """
        self.supports.append(Support(carried.domain_nodes, host))
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
        if not self.supports:
            return True
        self.bs = field.touched.block_size
        numbers = field.touched.spread(field.numbers.reshape(-1, self.bs)).ravel()
        same = bool(
            np.array_equal(numbers, self.numbers) and np.array_equal(field.ties, self._ties)
        )
        self._ties = field.ties
        self.numbers, self.num_touched = numbers, field.touched.count
        bits = np.uint8(1) << np.arange(self.bs, dtype=np.uint8)
        self.masks = ((numbers.reshape(-1, self.bs) >= 0) * bits).sum(axis=1, dtype=np.uint8)
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
                        body.add_masses(mass, rows, own.where(number), self._masses)
            self._add_masses(1.0)
        self._exchange()

    def _add_masses(self, factor: float) -> None:
        """Add the masses, if any, to the values."""
        if self._masses is not None:
            own = self.beside(self)
            loops.add_diagonals(self.bs, own.nodes, self._masses, factor, own.where(0))

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
        self.starts = np.empty(2 * len(self.numbers), dtype=np.int64)
        rows = self.numbers, self.bs, self.starts
        parts = [pattern.part() for pattern in self._patterns]
        flat, count = loops.foreign_rows(rows, parts, own)
        self._sent = np.empty(count)
        told, runs = self._exchange_blocks(flat.reshape(-1, 4), lasts)
        owner = np.searchsorted(lasts, self._ties[:, 0], side="right")
        ties = swap(self._comm, [self._ties[owner == r] for r in range(self._comm.size)])
        rank = start, int(lasts[self._comm.rank])
        further = np.concatenate([told, *ties])
        inside, outside, places = loops.reduce(rows, parts, own, rank, further, runs)
        shift = len(inside[1])
        self._within = places < shift
        self._further = places[self._within], places[~self._within] - shift
        return inside, outside

    def _exchange_blocks(
        self, blocks: NDArray[np.int32], lasts: NDArray[np.int64]
    ) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
        """Tell other ranks the blocks in their rows; return what they tell, and where rows begin.

        Args:
            blocks: First row, height, first column, width of each, by rows, shape ``(n, 4)``.
            lasts: End of the range of all unknowns of each rank.
        """
        ends = np.searchsorted(blocks[:, 0], lasts[:-1])
        sizes = np.concatenate([[0], np.cumsum(blocks[:, 1].astype(np.int64) * blocks[:, 3])])
        self._sent_ends = sizes[ends]
        received = swap(self._comm, np.split(blocks, ends))
        whole = np.concatenate(received)
        new = np.ones(len(whole) + 1, dtype=bool)
        new[1:-1] = whole[1:, 0] != whole[:-1, 0]
        new[np.cumsum([len(part) for part in received])] = True
        return whole, np.flatnonzero(new)

    @property
    def values(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Values inside, outside, and those that are sent."""
        return self.inside, self.outside, self._sent

    def begin(self) -> None:
        """Begin an assembly: no domain has added anything."""
        if self.supports:
            for values in self.values:
                values[:] = 0.0

    def assemble(self, factor: float) -> None:
        """Make the field's rows (collective).

        Args:
            factor: Of the masses.
        """
        if not self.supports:
            return
        for number, body in enumerate(self._loops):
            body.add(self.beside(self).where(number))
        if factor != 0.0:
            self._add_masses(factor)
        self._exchange()

    def _exchange(self) -> None:
        """Add to the field's rows what other ranks have there (collective)."""
        if self._comm.size > 1:
            sent = np.split(self._sent, self._sent_ends)
            received = np.concatenate(swap(self._comm, sent))
            np.add.at(self.inside, self._further[0], received[self._within])
            np.add.at(self.outside, self._further[1], received[~self._within])
