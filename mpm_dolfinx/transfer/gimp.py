# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""GIMP: the background is averaged over a box that each particle has."""

from __future__ import annotations

from typing import ClassVar, override

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem, mesh

from .. import _compat
from ..background.basis import BackgroundBasis, PointBasis
from ..background.grids import grid_lines
from ..errors import MPMError, agree
from ..meshes.boxes import BOX_CELLS
from ..tolerances import LAST_PLACES, NEGLIGIBLE
from .method import CornerBasis, DomainState, Method, affine

__all__ = ["GIMP", "UGIMP", "BoxGrid"]


class GIMP(Method):
    """The background's average over a box (Bardenhagen & Kober 2004).

    The average is over the true box, however many cells it overlaps: it is cut at the grid
    lines, and over each piece, which lies in one cell, the average of a multilinear function
    is its value at the middle. Where a box protrudes from the background, whose particle is
    inside, the functions of the outermost cells are continued linearly.

    Args:
        V: Space on a structured background (collective).

    Attributes:
        stretches: Whether half-lengths follow the diagonal of the right stretch U (Charlton,
            Coombs & Augarde 2017).

    Raises:
        MPMError: The background is no grid of rectangles or boxes.
    """

    name = "gimp"

    stretches: ClassVar[bool] = True

    def __init__(self, V: fem.FunctionSpace) -> None:
        self._grid = BoxGrid(V)

    @override
    def require(
        self, body: mesh.Mesh, corners: NDArray[np.float64], index: NDArray[np.int64]
    ) -> None:
        """Raise an error unless all domains are axis-aligned boxes."""
        low, high = corners.min(axis=1, keepdims=True), corners.max(axis=1, keepdims=True)
        off = np.minimum(corners - low, high - corners).max(axis=(1, 2), initial=0.0)
        skew = index[off > 1e-9 * (high - low).max(axis=(1, 2), initial=0.0)]
        with agree(body.comm):
            if len(skew) or body.basix_cell() not in BOX_CELLS:
                raise MPMError(
                    f"Method {self.name!r} needs particle domains that are axis-aligned rectangles "
                    "or boxes; use 'cpdi2' or 'cpdi' for this body.",
                    skew,
                )

    @override
    def rows(self, state: DomainState, background: BackgroundBasis) -> CornerBasis:
        centroid = state.particles.centroid
        half = 0.5 * np.ptp(self.domains(state), axis=1)
        middles, shares = self._grid.cut(centroid, half)
        n, pieces, gdim = middles.shape
        inside = np.clip(middles, self._grid.lower, self._grid.upper)
        at = background.at(inside.reshape(-1, gdim), gradients=True)
        assert at.gradients is not None
        k = at.values.shape[1]
        gradients = at.gradients.reshape(n, pieces, k, gdim)
        values = at.values.reshape(n, pieces, k)
        values = values + np.einsum("npki,npi->npk", gradients, middles - inside)
        found = (at.found.reshape(n, pieces) | (shares == 0.0)).all(axis=1)
        average = _merged(
            at.nodes.reshape(n, pieces * k),
            (shares[:, :, None] * values).reshape(n, pieces * k),
            found & self._grid.contains(centroid),
            (shares[:, :, None, None] * gradients).reshape(n, pieces * k, gdim),
        )
        return CornerBasis(state.parallelograms(), affine(state, state.arms(), average))

    @override
    def domains(self, state: DomainState) -> NDArray[np.float64]:
        """Corners of the boxes."""
        original = state.nodes[state.domains]
        centre, centroid, F = state.particles
        half = 0.5 * np.ptp(original, axis=1)
        if self.stretches:
            half = half * _right_stretch(F)
        side = np.sign(original - centre[:, None])
        return np.asarray(centroid[:, None] + side * half[:, None])


class UGIMP(GIMP):
    """GIMP with boxes that keep their size, and move with their particle alone."""

    name = "ugimp"
    stretches = False


class BoxGrid:
    """The grid lines of a structured background of rectangles or boxes.

    Args:
        V: Background space (collective).

    Attributes:
        lower: Lower corner of the background, shape ``(gdim,)``.
        upper: Upper corner, shape ``(gdim,)``.
        reach: How far outside a particle counts as on the boundary, shape ``(gdim,)``.

    Raises:
        MPMError: The background is not such a grid.
    """

    def __init__(self, V: fem.FunctionSpace) -> None:
        background, lines = V.mesh, grid_lines(V)
        gdim = background.geometry.dim
        count = background.topology.index_map(background.topology.dim).size_local
        x = background.geometry.x[_compat.geometry_dofmap(background)[:count], :gdim]
        with agree(background.comm):
            boxes = background.basix_cell() in BOX_CELLS and lines is not None
            if lines is None or not boxes or not all(map(_spans_one, np.moveaxis(x, 2, 0), lines)):
                raise MPMError(
                    "Method 'gimp' needs a structured background of axis-aligned rectangles or "
                    "boxes; use 'cpdi2' or 'cpdi' on this one."
                )
        self._lines = lines
        self.lower = np.array([line[0] for line in self._lines])
        self.upper = np.array([line[-1] for line in self._lines])
        self.reach = np.array(
            [
                max(NEGLIGIBLE * np.diff(line).min(), LAST_PLACES * np.abs(line).max())
                for line in self._lines
            ]
        )

    def contains(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which points ``(n, gdim)`` are inside the background, or on its boundary."""
        above, below = points >= self.lower - self.reach, points <= self.upper + self.reach
        return np.asarray((above & below).all(axis=1))

    def cut(
        self, centre: NDArray[np.float64], half: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Cut boxes at the grid lines inside the background.

        Args:
            centre: Centres, shape ``(n, gdim)``.
            half: Half-lengths, shape ``(n, gdim)``.

        Returns:
            Middles of the pieces ``(n, m, gdim)``, and their shares of the box ``(n, m)``; zero
            for those that only fill up.
        """
        middles, shares = [], []
        for line, x, h in zip(self._lines, centre.T, half.T, strict=True):
            inner = line[1:-1]
            first, last = np.searchsorted(inner, x - h, "right"), np.searchsorted(inner, x + h)
            most = int((last - first).max(initial=0))
            index = first[:, None] + np.arange(most)
            cuts = np.where(
                index < last[:, None],
                np.append(inner, 0.0)[np.minimum(index, len(inner))],
                (x + h)[:, None],
            )
            edges = np.column_stack([x - h, cuts, x + h])
            middles.append(0.5 * (edges[:, 1:] + edges[:, :-1]))
            shares.append(np.diff(edges, axis=1) / (2.0 * h)[:, None])
        n = len(centre)
        grids = np.meshgrid(*(np.arange(m.shape[1]) for m in middles), indexing="ij")
        picks = [g.ravel() for g in grids]
        points = np.stack([m[:, p] for m, p in zip(middles, picks, strict=True)], axis=2)
        share = np.ones((n, len(picks[0])))
        for s, p in zip(shares, picks, strict=True):
            share *= s[:, p]
        return points, share


def _merged(
    nodes: NDArray[np.int64],
    values: NDArray[np.float64],
    found: NDArray[np.bool_],
    gradients: NDArray[np.float64],
) -> PointBasis:
    """Return a basis in which each node of a row stands once, its values added up."""
    order = np.argsort(nodes, axis=1, kind="stable")
    nodes = np.take_along_axis(nodes, order, axis=1)
    first = np.diff(nodes, axis=1, prepend=-1) != 0
    place = np.cumsum(first, axis=1) - 1
    row = np.arange(len(nodes))[:, None]
    width = int(place.max(initial=-1)) + 1
    merged = PointBasis(
        np.zeros((len(nodes), width), dtype=np.int64),
        np.zeros((len(nodes), width)),
        found,
        np.zeros((len(nodes), width, gradients.shape[2])),
    )
    assert merged.gradients is not None
    merged.nodes[row, place] = nodes
    np.add.at(merged.values, (row, place), np.take_along_axis(values, order, axis=1))
    sorted_gradients = np.take_along_axis(gradients, order[:, :, None], axis=1)
    np.add.at(merged.gradients, (row, place), sorted_gradients)
    return merged


def _right_stretch(F: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the diagonal of ``U = (F^T F)^(1/2)``, shape ``(n, gdim)``."""
    squares, axes = np.linalg.eigh(F.swapaxes(1, 2) @ F)
    return np.asarray(np.einsum("nia,na->ni", axes**2, np.sqrt(squares)))


def _spans_one(x: NDArray[np.float64], line: NDArray[np.float64]) -> bool:
    """Return whether the corners of each cell lie on two neighbouring lines."""
    if len(x) == 0:
        return True
    nearest = np.searchsorted(0.5 * (line[1:] + line[:-1]), x)
    low, high = nearest.min(axis=1), nearest.max(axis=1)
    on_line = np.abs(line[nearest] - x).max() <= 1e-9 * (line[-1] - line[0])
    each = np.all((nearest == low[:, None]) | (nearest == high[:, None]))
    return bool(on_line and each and np.all(high - low == 1))
