# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Segments in the plane and triangles in space: normals, edges, and which side is outside."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError
from ..tolerances import NEGLIGIBLE
from .shapes import as_direction

__all__ = ["edges_of", "facet_normals", "oriented"]


def facet_normals(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit normals of segments, to the right of their way, or of triangles, ``(m, dim)``.

    Those without a size have zero.
    """
    n = area_vectors(corners)
    size = np.linalg.norm(n, axis=1)[:, None]
    return np.asarray(n / np.where(size > 0.0, size, 1.0))


def edges_of(
    facets: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the edges of triangles: their corners, numbers for each triangle, and how many share.

    Args:
        facets: Shape ``(m, 3)``.

    Returns:
        Corners, the lower first ``(e, 2)``, numbers of the edge from each corner to the next
        ``(m, 3)``, and how many triangles have it, ``(e,)``.
    """
    pairs = np.stack([facets, np.roll(facets, -1, axis=1)], axis=2).reshape(-1, 2)
    size = int(facets.max(initial=0)) + 1
    keys, number, count = np.unique(
        pairs.min(axis=1) * size + pairs.max(axis=1), return_inverse=True, return_counts=True
    )
    return np.column_stack(np.divmod(keys, size)), number.reshape(-1, 3), count


def oriented(
    x: NDArray[np.float64], facets: NDArray[np.int64], outside: Any, what: str
) -> NDArray[np.int64]:
    """Return facets whose normals point outwards.

    Raises:
        MPMError: They are no surface, or nothing tells its sides.
    """
    borders = _borders(x, facets, what)
    outwards = (
        _open_outwards(x, facets, outside, borders, what)
        if borders
        else _closed_outwards(x, facets, outside, what)
    )
    return facets if outwards else facets[:, ::-1].copy()


def _borders(x: NDArray[np.float64], facets: NDArray[np.int64], what: str) -> int:
    """Return how many points or edges belong to one facet only.

    Raises:
        MPMError: Some belong to more than two, or facets are turned against each other.
    """
    dim = facets.shape[1]
    turned = 0
    if dim == 2:
        count = np.bincount(facets.ravel(), minlength=len(x))
    else:
        keys, number, count = edges_of(facets)
        ahead = np.where(facets == keys[number][:, :, 0], 1, -1)
        sense = np.bincount(number.ravel(), weights=ahead.ravel())
        turned = int(np.count_nonzero((count == 2) & (sense != 0.0)))
    most = int(count.max())
    if most > 2:
        raise MPMError(
            f"{what} is none: {'a point' if dim == 2 else 'an edge'} of it belongs to {most} "
            f"{'segments' if dim == 2 else 'triangles'}; a surface has two on each."
        )
    if turned:
        raise MPMError(
            f"{what} has triangles that are turned against each other at {turned} edges; make "
            "their normals consistent, e.g. by pyvista's compute_normals(consistent_normals=True)."
        )
    return int(np.count_nonzero(count == 1))


def _open_outwards(
    x: NDArray[np.float64], facets: NDArray[np.int64], outside: Any, borders: int, what: str
) -> bool:
    """Return whether the normals of an open surface point to where it is free.

    Raises:
        MPMError: Nothing tells where that is.
    """
    dim = facets.shape[1]
    if outside is None:
        raise MPMError(
            f"{what} is open: {borders} {'ends' if dim == 2 else 'edges'} belong to one "
            f"{'segment' if dim == 2 else 'triangle'} only; say on which side it is free by "
            "outside=, or close it."
        )
    whole = area_vectors(x[facets]) @ as_direction(outside, "outside", dim)
    if abs(whole.sum()) <= NEGLIGIBLE * np.abs(whole).sum():
        raise MPMError(f"outside={outside!r} does not tell the sides of the surface apart.")
    return bool(whole.sum() > 0.0)


def _closed_outwards(
    x: NDArray[np.float64], facets: NDArray[np.int64], outside: Any, what: str
) -> bool:
    """Return whether the normals of a closed surface point out of it.

    Raises:
        MPMError: It encloses nothing, parts are inside out, or it was told where its outside is.
    """
    if outside is not None:
        raise MPMError(
            f"{what} is closed, and has its outside; leave outside= away (contact.cavity turns it "
            "inside out)."
        )
    dim, corners = facets.shape[1], x[facets]
    middle = x.mean(axis=0)
    volumes = (area_vectors(corners) * (corners[:, 0] - middle)).sum(axis=1)
    volume = volumes.sum()
    if abs(volume) <= NEGLIGIBLE * np.ptp(x, axis=0).max() ** dim:
        raise MPMError(f"{what} encloses nothing.")
    turned = _inside_out(x, facets, np.sign(volume) * volumes)
    if turned:
        raise MPMError(
            f"{what} has {turned} closed parts that are turned inside out beside others; turn "
            "their facets round, or make them shapes of their own (a part within another one is "
            "its hole)."
        )
    return bool(volume > 0.0)


def _inside_out(
    x: NDArray[np.float64], facets: NDArray[np.int64], volumes: NDArray[np.float64]
) -> int:
    """Return how many closed parts of a surface are turned inside out, and no holes of others.

    Args:
        x: Corners, shape ``(n, dim)``.
        facets: Shape ``(m, dim)``.
        volumes: What each facet has in the volume, shape ``(m,)``.
    """
    label = np.arange(len(x))
    while True:  # the lowest number goes from corner to corner
        before = label.copy()
        least = label[facets].min(axis=1)
        for corner in facets.T:
            np.minimum.at(label, before[corner], least)
            np.minimum.at(label, corner, least)
        label = label[label]
        if np.array_equal(label, before):
            break
    _, part = np.unique(label[facets[:, 0]], return_inverse=True)
    volume = np.bincount(part, weights=volumes)
    low, high = np.full((2, len(volume), x.shape[1]), np.inf)
    for corner in facets.T:
        np.minimum.at(low, part, x[corner])
        np.minimum.at(high, part, -x[corner])
    solid, turned = np.flatnonzero(volume > 0.0), np.flatnonzero(volume < 0.0)
    return sum(
        not bool(((low[solid] <= low[k]) & (high[solid] <= high[k])).all(axis=1).any())
        for k in turned
    )


def area_vectors(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return normals with the size of each facet."""
    if corners.shape[-1] == 2:
        way = corners[:, 1] - corners[:, 0]
        return np.column_stack([way[:, 1], -way[:, 0]])
    return np.asarray(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2.0)
