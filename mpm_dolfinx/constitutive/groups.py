# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Fixed groups of domains: patches of about one background cell.

Groups are found once, on the undeformed body, and are the same on any number of ranks: all ranks
look at the whole body. A group may lie on several ranks, whose sums travel.
"""

from __future__ import annotations

import heapq
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import basix
from dolfinx import fem

from ..background.basis import BackgroundBasis
from ..background.grids import cell_lines, coarser
from ..meshes.quadrature import cell_volumes
from ..particles.particles import Particles
from ..tolerances import HALF_DIGITS

__all__ = ["Groups", "background_cells", "patches", "singles"]

#: Share of a background cell below which a patch joins a neighbour.
LEAST_FILL = 0.4
#: Singular values, relative to the largest, that a fitted plane needs to have a slope.
SLENDER = 0.1


class Groups:
    """A partition of the domains of all ranks.

    Args:
        comm: Communicator.
        number: Group of each owned domain, numbered from 0 over all ranks, shape ``(n,)``.
        count: Number of groups of all ranks.
        owned: How many of them are this rank's own; a rank's are numbered consecutively.
        shared: Groups with domains on several ranks, sorted.
        neighbours: Pairs of groups that touch, each both ways, shape ``(m, 2)``.

    Attributes:
        number: As given.
        count: As given.
        owned: As given.
        single: Whether each domain of all ranks is a group of its own (collective).
    """

    def __init__(
        self,
        comm: MPI.Comm,
        number: NDArray[np.int64],
        count: int,
        owned: int,
        shared: NDArray[np.int64],
        neighbours: NDArray[np.int64],
    ) -> None:
        self._comm = comm
        self.number = number
        self.count = count
        self.owned = owned
        self._neighbours = neighbours
        local, self._local = np.unique(number, return_inverse=True)
        self._size = len(local)
        self._trivial = len(local) == len(number) and len(shared) == 0
        self.single = bool(comm.allreduce(self._trivial, MPI.LAND))
        self._num_shared = len(shared)
        place = np.searchsorted(shared, local)
        place[place == len(shared)] = 0
        here = shared[place] == local if len(shared) else np.zeros(len(local), dtype=bool)
        self._cut = np.flatnonzero(here)
        self._place = place[here]

    def sum(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return for each owned domain the sum over its group (collective).

        Args:
            values: One or more for each owned domain, shape ``(n, ...)``.
        """
        if self._trivial:
            return values
        sums = np.zeros((self._size, *values.shape[1:]))
        np.add.at(sums, self._local, values)
        if self._num_shared:
            travel = np.zeros((self._num_shared, *values.shape[1:]))
            travel[self._place] = sums[self._cut]
            self._comm.Allreduce(MPI.IN_PLACE, travel)
            sums[self._cut] = travel[self._place]
        return np.asarray(sums[self._local])

    def same(self, other: Groups) -> NDArray[np.bool_]:
        """Return which owned domains have the same group in both, shape ``(n,)`` (collective).

        Args:
            other: Another partition of the same domains.
        """
        one, number = np.ones(len(self.number)), other.number.astype(np.float64)
        size = self.sum(one)
        other_size = other.sum(one)
        strange = (size != other_size) | (self.sum(number) != number * size)
        return np.asarray(self.sum(strange.astype(np.float64)) == 0.0)

    def totals(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the sums over all groups of all ranks, shape ``(count, ...)`` (collective)."""
        sums = np.zeros((self.count, *values.shape[1:]))
        np.add.at(sums, self.number, values)
        self._comm.Allreduce(MPI.IN_PLACE, sums)
        return sums

    def slopes(self, x: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return slopes of the planes through groups' values, fitted to those of neighbours.

        Args:
            x: Centroids of all groups, shape ``(count, gdim)``.
            values: Their values, shape ``(count, m)``.

        Returns:
            Shape ``(count, m, gdim)``; zero across a row of groups.
        """
        a, b = self._neighbours.T
        order = np.argsort(a, kind="stable")
        a, b = a[order], b[order]
        counts = np.bincount(a, minlength=self.count)
        position = np.arange(len(a)) - np.repeat(np.cumsum(counts) - counts, counts)
        most = max(1, int(counts.max(initial=0)))
        gaps = np.zeros((self.count, most, x.shape[1]))
        steps = np.zeros((self.count, most, values.shape[1]))
        gaps[a, position] = x[b] - x[a]
        steps[a, position] = values[b] - values[a]
        return np.asarray(np.einsum("nij,njm->nmi", np.linalg.pinv(gaps, rcond=SLENDER), steps))


class _WholeBody(NamedTuple):
    """Domains of all ranks in the order of the input, the same on all ranks.

    Attributes:
        vertices: Numbers of their vertices, shape ``(n, k)``.
        corners: Positions of their corners, shape ``(n, k, gdim)``.
        volume: Shape ``(n,)``.
        material: Shape ``(n,)``.
        key: Background cell in which the centroid starts, shape ``(n,)``.
        cell_volume: Volume of that cell, shape ``(n,)``.
        rank: Shape ``(n,)``.
        mine: Where this rank's domains are in these arrays.
        facets: Pairs of domains that share a facet, first below second, shape ``(m, 2)``.
    """

    vertices: NDArray[np.int64]
    corners: NDArray[np.float64]
    volume: NDArray[np.float64]
    material: NDArray[np.int64]
    key: NDArray[np.int64]
    cell_volume: NDArray[np.float64]
    rank: NDArray[np.int64]
    mine: NDArray[np.int64]
    facets: NDArray[np.int64]


def _whole_body(particles: Particles, material: NDArray[np.int64]) -> _WholeBody:
    """Gather what grouping needs (collective)."""
    body = particles.mesh
    comm = body.comm
    tdim = body.topology.dim
    n = particles.num_local
    key, size = background_cells(particles)
    vertices = body.topology.connectivity(tdim, 0).array.reshape(-1, len(_corners(body)))[:n]
    numbers = body.topology.index_map(0).local_to_global(vertices.ravel())
    own = {
        "index": particles.global_index,
        "vertices": numbers.reshape(vertices.shape),
        "corners": particles.initial_domains[:, : vertices.shape[1]],
        "volume": particles.initial_volume,
        "material": material,
        "key": key,
        "cell_volume": size,
        "rank": np.full(n, comm.rank),
    }
    parts = comm.allgather(own)
    whole = {name: np.concatenate([part[name] for part in parts]) for name in own}
    order = np.argsort(whole.pop("index"), kind="stable")
    start = sum(len(part["index"]) for part in parts[: comm.rank])
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    arrays: dict[str, Any] = {name: values[order] for name, values in whole.items()}
    return _WholeBody(
        **arrays, mine=place[start : start + n], facets=_facets(body, arrays["vertices"])
    )


def _corners(body: Any) -> NDArray[np.float64]:
    return np.asarray(basix.geometry(body.basix_cell()))


def _facets(body: Any, vertices: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return pairs of cells with a common facet, first below second, in order."""
    facets = basix.topology(body.basix_cell())[body.topology.dim - 1]
    rows = np.concatenate([np.sort(vertices[:, list(facet)], axis=1) for facet in facets])
    cells = np.tile(np.arange(len(vertices)), len(facets))
    order = np.lexsort((cells, *rows.T))
    rows, cells = rows[order], cells[order]
    same = (rows[1:] == rows[:-1]).all(axis=1)
    found = np.stack([cells[:-1][same], cells[1:][same]], axis=1)
    return np.asarray(found[np.lexsort(found.T[::-1])], dtype=np.int64)


def background_cells(particles: Particles) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return in which background cells the domains' centroids start (collective).

    Of finite elements, which have no background: in which boxes of about two elements each way.

    Returns:
        Global cell numbers, -1 where there is none, and the cells' volumes, each ``(n,)``.
    """
    background = particles.V.mesh
    if particles.is_free:
        return _boxes(coarser(cell_lines(particles.V)), particles.initial_centroid)
    cells = BackgroundBasis(fem.functionspace(background, ("Discontinuous Lagrange", 0)))
    found = cells.at(particles.initial_centroid)
    volumes = np.concatenate(background.comm.allgather(cell_volumes(background)))
    return np.where(found.found, found.nodes[:, 0], -1), volumes[found.nodes[:, 0]]


def _boxes(
    lines: list[NDArray[np.float64]], points: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return numbers and volumes of the boxes between grid lines that points lie in."""
    number, volume = np.zeros(len(points), dtype=np.int64), np.ones(len(points))
    for axis, line in enumerate(lines):
        place = np.clip(np.searchsorted(line, points[:, axis]) - 1, 0, len(line) - 2)
        number = number * (len(line) - 1) + place
        volume *= np.diff(line)[place]
    return number, volume


def _connected(n: int, links: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the smallest number in the connected part of each of n things."""
    label = np.arange(n)
    while True:
        least = np.minimum(label[links[:, 0]], label[links[:, 1]])
        before = label.copy()
        np.minimum.at(label, links[:, 0], least)
        np.minimum.at(label, links[:, 1], least)
        label = label[label]
        if np.array_equal(label, before):
            return label


def _joined(
    label: NDArray[np.int64],
    fill: NDArray[np.float64],
    links: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Join groups that fill too little of a background cell to a neighbour, least first.

    The neighbour is that with the most common facets, of several the one that is filled least.

    Args:
        label: Group of each domain, the smallest number of a domain in it.
        fill: What share of a background cell each domain fills.
        links: Pairs of domains with a common facet.
    """
    filled = np.bincount(label, fill, minlength=len(label))
    ends = label[links]
    ends = ends[ends[:, 0] != ends[:, 1]]
    neighbours: dict[int, dict[int, int]] = {}
    for a, b in np.concatenate([ends, ends[:, ::-1]]).tolist():
        counts = neighbours.setdefault(a, {})
        counts[b] = counts.get(b, 0) + 1
    parent = np.arange(len(label))
    least = LEAST_FILL
    queue = [(float(filled[g]), int(g)) for g in np.unique(label) if filled[g] < least]
    heapq.heapify(queue)
    while queue:
        size, group = heapq.heappop(queue)
        if parent[group] != group or filled[group] != size or not neighbours.get(group):
            continue
        counts = neighbours.pop(group)
        into = min(counts, key=lambda g: (-counts[g], filled[g], g))
        parent[group] = into
        filled[into] += size
        for other, count in counts.items():
            theirs = neighbours[other]
            del theirs[group]
            if other != into:
                theirs[into] = theirs.get(into, 0) + count
                neighbours[into][other] = neighbours[into].get(other, 0) + count
        if filled[into] < least:
            heapq.heappush(queue, (float(filled[into]), into))
    while not np.array_equal(parent, parent[parent]):
        parent = parent[parent]
    return np.asarray(parent[label])


def _numbered(particles: Particles, whole: _WholeBody, label: NDArray[np.int64]) -> Groups:
    """Number groups so that those of the lowest rank with a domain in them come first."""
    _, label = np.unique(label, return_inverse=True)
    count = int(label.max(initial=-1)) + 1
    first, last = np.full(count, np.iinfo(np.int64).max), np.full(count, -1)
    np.minimum.at(first, label, whole.rank)
    np.maximum.at(last, label, whole.rank)
    order = np.argsort(first, kind="stable")
    number = np.empty(count, dtype=np.int64)
    number[order] = np.arange(count)
    shared = np.sort(number[first != last])
    label = number[label]
    touching = np.unique(
        np.stack([whole.vertices.ravel(), np.repeat(label, whole.vertices.shape[1])], axis=1),
        axis=0,
    )
    links = [np.zeros((0, 2), dtype=np.int64)]
    for shift in range(1, len(touching)):
        same = touching[shift:, 0] == touching[:-shift, 0]
        if not same.any():
            break
        both = np.stack([touching[:-shift, 1][same], touching[shift:, 1][same]], axis=1)
        links += [both, both[:, ::-1]]
    comm = particles.mesh.comm
    return Groups(
        comm,
        label[whole.mine],
        count,
        int(np.count_nonzero(first == comm.rank)),
        shared,
        np.unique(np.concatenate(links), axis=0),
    )


def singles(particles: Particles) -> Groups:
    """Return groups of one domain each."""
    body = particles.mesh
    cells = body.topology.index_map(body.topology.dim)
    none = np.zeros(0, dtype=np.int64)
    return Groups(
        body.comm,
        np.arange(*cells.local_range, dtype=np.int64),
        cells.size_global,
        cells.size_local,
        none,
        none.reshape(0, 2),
    )


def patches(particles: Particles, material: NDArray[np.int64]) -> Groups:
    """Make patches of the domains whose centroids start in one background cell (collective).

    A patch is connected, of one material, and fills at least ``LEAST_FILL`` of a background
    cell, unless it has no neighbour to join.

    Args:
        particles: The body.
        material: Number of each owned domain's material.
    """
    whole = _whole_body(particles, material)
    n = len(whole.volume)
    links = whole.facets[_same(whole.material, whole.facets)]
    if particles.shares_nodes:
        label = _connected(n, links[_same(whole.key, links) & (whole.key[links[:, 0]] >= 0)])
    else:  # domains that part: what is in one cell
        _, first, label = np.unique(
            np.stack([whole.key, whole.material]), axis=1, return_index=True, return_inverse=True
        )
        label = first[label.ravel()]
    # (rounded, so that which of several are the least is no matter of round-off)
    fill = np.round(whole.volume / whole.cell_volume / HALF_DIGITS) * HALF_DIGITS
    return _numbered(particles, whole, _joined(label, fill, links))


def _same(values: NDArray[Any], links: NDArray[np.int64]) -> NDArray[np.bool_]:
    return np.asarray(values[links[:, 0]] == values[links[:, 1]])
