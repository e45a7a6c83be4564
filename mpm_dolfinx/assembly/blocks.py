# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The rows of fields in the matrix of all unknowns, and what couples fields in them."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple, Protocol

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from .._core import loops
from ..parallel.exchange import swap
from ..particles.field import CarriedField
from ..particles.particles import Particles
from ..transfer.touched import JointNodes, TouchedNodes, TransferRows
from .body_forms import no_values
from .supports import BodyLoops, Support, Where

__all__ = ["Block", "Coupled", "CoupledBlocks", "Coupling", "Masses", "Restriction", "no_ties"]

#: No further blocks.
no_ties: NDArray[np.int32] = np.zeros((0, 4), dtype=np.int32)


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

#: No nodes.
no_nodes: NDArray[np.int32] = np.zeros(0, dtype=np.int32)


class _Places(NamedTuple):
    """Blocks between nodes, and where pairs of nodes of domains are among them.

    Attributes:
        offsets: Where rows of blocks begin.
        nodes: The node of the columns of each block.
        first: For each pair of supports where its groups begin among the positions.
        positions: For each the places of its blocks in their rows.
    """

    offsets: NDArray[np.int32]
    nodes: NDArray[np.int32]
    first: list[NDArray[np.int64]]
    positions: list[NDArray[np.uint8]]


class _Pattern:
    """Blocks between the nodes of one field and those of another, or of the same.

    Fields have their patterns, and are not kept alive by them: what a problem lets go of must be
    gone before PETSc's garbage is collected.

    Args:
        rows: The field of the rows.
        columns: The field of the columns.
    """

    def __init__(self, rows: Block, columns: Block) -> None:
        self._references = weakref.ref(rows), weakref.ref(columns)
        self._pairs: list[tuple[Support, Support]] = []
        self._made_of: tuple[Any, ...] = ()
        self._made = _Places(no_nodes, no_nodes, [], [])
        self._places = no_nodes

    @property
    def _rows(self) -> Block:
        block = self._references[0]()
        assert block is not None
        return block

    @property
    def columns(self) -> Block:
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
        self._made = self._made._replace(positions=[])  # (the old ones need room no more)
        rows, columns = (_joined([pair[side] for pair in self._pairs]) for side in range(2))
        has = [loops.seen_pairs(row.groups, row.nodes, column.nodes) for row, column in self._pairs]
        counts = self._rows.num_touched, self.columns.num_touched
        found = loops.pattern(*rows, counts[0], *columns, counts[1], np.concatenate(has))
        offsets, nodes, pairs, positions, size = found
        ends = np.cumsum([0, *(len(row.groups[1]) - 1 for row, _ in self._pairs)])
        first = [pairs[a : b + 1] - pairs[a] for a, b in pairwise(ends)]
        self._made = _Places(offsets, nodes, first, np.split(positions, size * pairs[ends[1:-1]]))

    @property
    def nodes(self) -> NDArray[np.int32]:
        """The node of the columns of each block, rows after rows."""
        return self._made.nodes

    def part(self) -> tuple[Any, ...]:
        """Return the arrays by which compiled loops find places of blocks; they are forgotten."""
        self._places = np.zeros(len(self.nodes), dtype=np.int32)
        columns = self.columns
        return self._made.offsets, self.nodes, columns.bs, columns.numbers, self._places

    def where(self, number: int) -> Where:
        """Return where domains go that were taken over with this number."""
        rows, columns = self._pairs[number]
        return (
            rows.groups,
            rows.nodes,
            columns.nodes,
            self._made.first[number],
            self._made.positions[number],
            self._made.offsets,
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


class Coupled:
    """Coupling of a displacement and another field, and its places in the rows of both."""

    def __init__(self, moving: Block, other: Block, coupling: Coupling) -> None:
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


class Block:
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

    def __init__(self, comm: MPI.Comm, bodies: Sequence[BodyLoops]) -> None:
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

    def loops_of(self, particles: Particles) -> BodyLoops:
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

    def beside(self, other: Block) -> _Pattern:
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
        self._masses = None
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
            for number, body in enumerate(self._loops):
                for particles, mass in masses:
                    if particles is body.particles:
                        body.add_masses(mass, own.where(number), self._masses)
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
