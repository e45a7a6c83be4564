# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Matrices between the nodes of bodies whose facets are touched, each pair of nodes once.

Points of a facet meet a shape, or facets of another body, and remember anchors on others. Their
derivatives are added to blocks between nodes; where a block is, depends on these facets alone, so
that points have it in groups.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from .. import _compat
from .._core import loops
from ..assembly.petsc import with_entries_at
from .surface import sizes_of

__all__ = ["Met", "PairMatrices", "Places"]


class Met(NamedTuple):
    """Facets that meet at the points of a pass.

    Attributes:
        facets: Numbers of the point's facet, of the one of another body that it meets, and where
            there is friction of that of its anchor, shape ``(n, 1)``, ``(n, 2)`` or ``(n, 3)``.
        nodes: Global nodes of each of these, shapes ``(n, k)``.
    """

    facets: NDArray[np.int64]
    nodes: tuple[NDArray[np.int64], ...]

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape of blocks: of each point by nodes that forces act on, and all nodes."""
        widths = [nodes.shape[1] for nodes in self.nodes]
        return len(self.facets), sum(widths[:2]), sum(widths)


class Places(NamedTuple):
    """Where derivatives at the points of a pass add up: in blocks between nodes.

    Attributes:
        group: Group of each point, shape ``(n,)``.
        positions: Blocks of each group, by forces on nodes of a point's facet and of the one that
            it meets, and places of these nodes and of those of the anchor's, ``(g, r, c)``.
        values: The blocks, shape ``(b, gdim, gdim)``.
    """

    group: NDArray[np.int64]
    positions: NDArray[np.int32]
    values: NDArray[np.float64]


class PairMatrices:
    """Matrices on W of one body or two, whose patterns grow as facets come to be touched.

    Args:
        spaces: W of the bodies.

    """

    def __init__(self, spaces: Sequence[fem.FunctionSpace]) -> None:
        self._comm: MPI.Comm = spaces[0].mesh.comm
        self._sizes = [sizes_of(space) for space in spaces]
        self._gdim: int = spaces[0].mesh.geometry.dim
        self._known: list[Met] = []
        self._matrices: dict[tuple[int, int], PETSc.Mat] = {}
        sides = range(len(spaces))
        self._counts = dict.fromkeys([(i, j) for i in sides for j in sides], 0)
        self._positions: list[NDArray[np.int32]] = []
        self._values = np.zeros((0, self._gdim, self._gdim))

    def begin(self, met: Sequence[Met]) -> list[Places]:
        """Set all blocks to zero; return where points of each pass add to them (collective).

        Args:
            met: What points of the first body meet, and, in a second pass, those of the other.
        """
        if not self._known:
            self._known = [Met(one.facets[:0], tuple(x[:0] for x in one.nodes)) for one in met]
        found, grown = [], False
        for number, (one, known) in enumerate(zip(met, self._known, strict=True)):
            count = len(known.facets)
            whole = np.concatenate([known.facets, one.facets])
            _, first, group = np.unique(_keys(whole), return_index=True, return_inverse=True)
            if (first >= count).any():
                grown = True
                # those that are known stay what they are, as they come first
                self._known[number] = Met(
                    whole[first],
                    tuple(
                        np.concatenate(parts)[first]
                        for parts in zip(known.nodes, one.nodes, strict=True)
                    ),
                )
            found.append(group.ravel()[count:])
        if self._comm.allreduce(grown or not self._positions, MPI.LOR):
            self._make()
        self._values[:] = 0.0
        pairs = zip(found, self._positions, strict=True)
        return [Places(group, positions, self._values) for group, positions in pairs]

    def _make(self) -> None:
        """Find the blocks between all nodes of facets that have met (collective)."""
        seen: list[list[NDArray[np.int64]]] = [[] for _ in self._sizes]
        for number, known in enumerate(self._known):
            for side, nodes in enumerate(known.nodes):
                seen[number if side == 0 else 1 - number].append(nodes.ravel())
        names = [np.unique(np.concatenate(parts)) for parts in seen]
        sides = [_sides(number, known, names) for number, known in enumerate(self._known)]
        self._positions = [np.zeros(known.shape, dtype=np.int32) for known in self._known]
        begin, new = 0, dict[tuple[int, int], tuple[NDArray[Any], NDArray[Any]]]()
        for i, j in self._counts:
            rows, columns = [one[0][i] for one in sides], [one[1][j] for one in sides]
            ends, nodes, places = _pattern(rows, columns, (len(names[i]), len(names[j])))
            for whole, place, (row, _), (column, _) in zip(
                self._positions, places, rows, columns, strict=True
            ):
                whole[:, row, column] = begin + place
            new[i, j] = np.repeat(names[i], np.diff(ends)), names[j][nodes]
            begin += len(nodes)
        self._values = np.zeros((begin, self._gdim, self._gdim))
        grown = {pair for pair, count in self._counts.items() if len(new[pair][0]) > count}
        anywhere = set().union(*self._comm.allgather(grown))
        for pair in self._counts:
            self._counts[pair] = len(new[pair][0])
            if pair in anywhere:
                self._matrices[pair] = self._matrix(pair, *new[pair])

    def _matrix(
        self, pair: tuple[int, int], rows: NDArray[np.int64], columns: NDArray[np.int64]
    ) -> PETSc.Mat:
        """Return a matrix with blocks between global nodes (collective)."""
        part = np.arange(self._gdim)
        i, j = (nodes[:, None] * self._gdim + part for nodes in (rows, columns))
        sizes = [self._sizes[side] for side in pair]
        return with_entries_at(
            self._comm, sizes, *np.broadcast_arrays(i[:, :, None], j[:, None, :])
        )

    def assembled(self) -> dict[tuple[int, int], PETSc.Mat]:
        """Return the matrices, the same objects as before where no blocks have come (collective).

        Without those that have never had any on any rank.
        """
        begin, found = 0, dict[tuple[int, int], PETSc.Mat]()
        for pair, count in self._counts.items():
            if pair in self._matrices:
                values = self._values[begin : begin + count]
                _compat.set_entries(self._matrices[pair], values.ravel())
                found[pair] = self._matrices[pair]
            begin += count
        return found


def _keys(facets: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return a number for each row of numbers, the same for the same ones."""
    keys = facets[:, 0]
    for column in facets.T[1:]:
        _, places = np.unique(column, return_inverse=True)
        keys = keys * (places.max(initial=0) + 1) + places.ravel()
    return np.asarray(keys)


#: Nodes of one body that groups see, among others of theirs: where, and which, shape ``(g, k)``.
type Side = tuple[slice, NDArray[np.int32]]


def _sides(
    number: int, known: Met, names: Sequence[NDArray[np.int64]]
) -> tuple[dict[int, Side], dict[int, Side]]:
    """Return rows and columns of a pass, for each body.

    Args:
        number: Of the pass, which is that of the body of its points.
        known: Facets that meet.
        names: Global nodes of each body, sorted.
    """
    own, *other = known.nodes
    size = own.shape[1]

    def numbered(body: int, nodes: NDArray[np.int64]) -> NDArray[np.int32]:
        return np.searchsorted(names[body], nodes).astype(np.int32)

    mine = slice(0, size), numbered(number, own)
    if not other:
        return {number: mine}, {number: mine}
    rows = slice(size, None), numbered(1 - number, other[0])
    columns = slice(size, None), numbered(1 - number, np.concatenate(other, axis=1))
    return {number: mine, 1 - number: rows}, {number: mine, 1 - number: columns}


def _pattern(
    rows: Sequence[Side], columns: Sequence[Side], counts: tuple[int, int]
) -> tuple[NDArray[Any], NDArray[Any], list[NDArray[Any]]]:
    """Return the pattern of blocks between nodes that groups of each pass see.

    Args:
        rows: Those of rows.
        columns: Those of columns.
        counts: Number of nodes of both.

    Returns:
        Where rows end, the nodes of columns, and the place of each pair, ``(g, rows, columns)``.
    """
    shapes = [(*a.shape, b.shape[1]) for (_, a), (_, b) in zip(rows, columns, strict=True)]
    seen: list[Any] = []
    for side, count in zip((rows, columns), counts, strict=True):
        widths = np.concatenate([np.full(len(nodes), nodes.shape[1]) for _, nodes in side])
        ends = np.concatenate([[0], np.cumsum(widths)]).astype(np.int64)
        seen += [ends, np.concatenate([nodes.ravel() for _, nodes in side]), count]
    every = np.zeros(0, dtype=np.uint8)  # all pairs of a group have a block
    ends, nodes, _, positions, size = loops.pattern(*seen, every)
    places = positions.view(np.uint8 if size == 1 else np.uint16)
    splits = np.split(places, np.cumsum([int(np.prod(shape)) for shape in shapes])[:-1])
    parts = [
        ends[own][:, :, None] + part.reshape(shape)
        for (_, own), part, shape in zip(rows, splits, shapes, strict=True)
    ]
    return ends, nodes, parts
