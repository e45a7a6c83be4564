# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Points in compact parts of equal size: recursive coordinate bisection."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

__all__ = ["bisect"]

#: Places at which a cut is tried at once.
BINS = 64


def bisect(comm: MPI.Comm, points: NDArray[np.float64], parts: int) -> NDArray[np.int64]:
    """Return the part of each point, by recursive coordinate bisection (collective).

    All points are cut in two across the longest edge of their box, in the ratio of the numbers of
    parts on either side, and so on (Berger & Bokhari 1987). Where the points are decides alone,
    not the rank that has them. No rank sees more points than its own.

    Args:
        comm: The ranks.
        points: This rank's points, shape ``(n, gdim)``.
        parts: Number of parts.

    Returns:
        Parts, shape ``(n,)``.
    """
    # Parts that are not cut yet are known by the first of the numbers that they will have.
    part = np.zeros(len(points), dtype=np.int64)
    sizes = np.zeros(parts, dtype=np.int64)
    sizes[0] = parts
    while sizes.max() > 1:
        whole = np.flatnonzero(sizes > 1)
        before = sizes[whole] // 2
        cut = np.flatnonzero(sizes[part] > 1)
        group = np.searchsorted(whole, part[cut])
        beyond = _beyond_cut(comm, points[cut], group, before / sizes[whole])
        part[cut[beyond]] += before[group[beyond]]
        sizes[whole + before] = sizes[whole] - before
        sizes[whole] = before
    return part


def _beyond_cut(
    comm: MPI.Comm,
    points: NDArray[np.float64],
    group: NDArray[np.int64],
    share: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Return which points are beyond the cut that has a share of their group before it.

    Args:
        comm: The ranks (collective).
        points: This rank's points, shape ``(n, gdim)``.
        group: Group of each point, shape ``(n,)``.
        share: Share of each group, shape ``(m,)``.

    Returns:
        Flags, shape ``(n,)``.
    """
    m, gdim = len(share), points.shape[1]
    low, high = np.full((m, gdim), np.inf), np.full((m, gdim), -np.inf)
    np.minimum.at(low, group, points)
    np.maximum.at(high, group, points)
    comm.Allreduce(MPI.IN_PLACE, low, MPI.MIN)
    comm.Allreduce(MPI.IN_PLACE, high, MPI.MAX)
    edges = np.maximum(high - low, 0.0)
    # inclined, so that points in line on a grid lie on either side of a cut
    normal = np.tile(1e-3 * 0.7 ** np.arange(gdim), (m, 1))
    every = np.arange(m)
    normal[every, edges.argmax(axis=1)] = 1.0
    place = np.einsum("ni,ni->n", points - low[group], normal[group])
    span = np.einsum("mi,mi->m", edges, normal)
    wanted = np.rint(share * _counts(comm, group, m))
    # The cut is between start and start + length; so many points are before start.
    start, length, count = np.zeros(m), (1.0 + 1e-6) * span, np.zeros(m)
    while np.any(length > 1e-14 * span):
        width = length / BINS
        inner = length[group] > 0.0
        bins = np.floor((place[inner] - start[group[inner]]) / width[group[inner]])
        within = (bins >= 0) & (bins < BINS)
        index = group[inner][within] * BINS + bins[within].astype(np.int64)
        found = _counts(comm, index, m * BINS).reshape(m, BINS)
        sums = count[:, None] + found.cumsum(axis=1)
        last = np.argmax(sums >= wanted[:, None], axis=1)
        done = sums[every, last] == wanted
        start += np.where(done, last + 1, last) * width
        count = sums[every, last] - np.where(done, 0, found[every, last])
        length = np.where(done, 0.0, width)
    return np.asarray(place >= start[group])


def _counts(comm: MPI.Comm, index: NDArray[np.int64], size: int) -> NDArray[np.int64]:
    counts = np.bincount(index, minlength=size)
    comm.Allreduce(MPI.IN_PLACE, counts)
    return counts
