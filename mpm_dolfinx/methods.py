# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The rows of T: one small function for each material point method.

A method says where the corners of the domains are and what the background does to them. The
first two evaluate the background at the corners; the other two give each domain an affine
motion of its own, from an average of the background over the particle.
"""

from __future__ import annotations

from typing import NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import basix
from dolfinx import mesh

from . import _compat
from .errors import MPMError, agree
from .location import DROP, TOLERANCE, BackgroundBasis, PointBasis

__all__ = [
    "BOX_CELLS",
    "METHODS",
    "BoxGrid",
    "DomainState",
    "Rows",
    "boxes",
    "cpdi",
    "cpdi2",
    "gimp",
    "mpm",
    "require_boxes",
]

BOX_CELLS = (basix.CellType.quadrilateral, basix.CellType.hexahedron)
METHODS = ("cpdi2", "cpdi", "gimp", "mpm")


class DomainState(NamedTuple):
    """Where the domains are.

    Attributes:
        nodes: Undeformed nodes of W, shape ``(N, gdim)``.
        displacement: Their displacement, shape ``(N, gdim)``.
        domains: Nodes of each domain this rank owns, shape ``(n, k)``.
        initial_centroid: Shape ``(n, gdim)``.
        centroid: Particle positions, shape ``(n, gdim)``.
        deformation_gradient: Shape ``(n, gdim, gdim)``.
    """

    nodes: NDArray[np.float64]
    displacement: NDArray[np.float64]
    domains: NDArray[np.int32]
    initial_centroid: NDArray[np.float64]
    centroid: NDArray[np.float64]
    deformation_gradient: NDArray[np.float64]

    def arms(self) -> NDArray[np.float64]:
        """Return ``F_p (X_c - X_p)`` for each corner, shape ``(n, k, gdim)``."""
        offsets = self.nodes[self.domains] - self.initial_centroid[:, None]
        return np.asarray(np.einsum("nij,nkj->nki", self.deformation_gradient, offsets))


class Rows(NamedTuple):
    """What the background does to the domains' nodes.

    Attributes:
        corners: Where the rows move the domains' nodes from, shape ``(n, k, gdim)``; ``None``
            where these are the nodes' own positions.
        basis: The background basis at the local nodes of W.
    """

    corners: NDArray[np.float64] | None
    basis: PointBasis


def cpdi2(positions: NDArray[np.float64], background: BackgroundBasis) -> Rows:
    """Corners ride on the background (Sadeghirad, Brannon & Guilkey 2013).

    Args:
        positions: Where the nodes of W are, shape ``(N, gdim)``.
        background: The background's basis.
    """
    return Rows(None, background.at(positions))


def cpdi(state: DomainState, background: BackgroundBasis) -> Rows:
    """Corners of a parallelogram that F_p deforms (Sadeghirad, Brannon & Burghardt 2011)."""
    corners = state.centroid[:, None] + state.arms()
    positions = state.nodes.copy()
    positions[state.domains] = corners
    own = state.domains.size
    return Rows(corners, background.at(positions[:own]))


def mpm(state: DomainState, background: BackgroundBasis) -> Rows:
    """The background at the particle alone (Sulsky, Chen & Schreyer 1994)."""
    arms = state.arms()
    corners = state.centroid[:, None] + arms
    basis = _affine(state, arms, background.at(state.centroid, gradients=True))
    return Rows(corners, basis)


def gimp(state: DomainState, background: BackgroundBasis, grid: BoxGrid, stretch: bool) -> Rows:
    """The background's average over a box (Bardenhagen & Kober 2004).

    The average is over the true box, however many cells it overlaps: it is cut at the grid
    lines, and over each piece, which lies in one cell, the average of a multilinear function
    is its value at the middle. Where a box protrudes from the background, whose particle is
    inside, the functions of the outermost cells are continued linearly.

    Args:
        state: The domains.
        background: The basis.
        grid: The grid lines.
        stretch: Whether half-lengths follow the diagonal of the right stretch U (Charlton,
            Coombs & Augarde 2017), or stay.
    """
    half = 0.5 * np.ptp(boxes(state, stretch), axis=1)
    middles, shares = grid.cut(state.centroid, half)
    n, pieces, gdim = middles.shape
    inside = np.clip(middles, grid.lower, grid.upper)
    at = background.at(inside.reshape(-1, gdim), gradients=True)
    assert at.gradients is not None
    k = at.values.shape[1]
    gradients = at.gradients.reshape(n, pieces, k, gdim)
    values = at.values.reshape(n, pieces, k)
    values = values + np.einsum("npki,npi->npk", gradients, middles - inside)
    centre_inside = np.all(
        (state.centroid >= grid.lower - grid.reach) & (state.centroid <= grid.upper + grid.reach),
        axis=1,
    )
    average = _merged(
        at.nodes.reshape(n, pieces * k),
        (shares[:, :, None] * values).reshape(n, pieces * k),
        (at.found.reshape(n, pieces) | (shares == 0.0)).all(axis=1) & centre_inside,
        (shares[:, :, None, None] * gradients).reshape(n, pieces * k, gdim),
    )
    arms = state.arms()
    return Rows(state.centroid[:, None] + arms, _affine(state, arms, average))


def boxes(state: DomainState, stretch: bool) -> NDArray[np.float64]:
    """Return the corners of GIMP's boxes, shape ``(n, k, gdim)``.

    Args:
        state: The domains.
        stretch: Whether half-lengths follow the diagonal of the right stretch U, or stay.
    """
    original = state.nodes[state.domains]
    half = 0.5 * np.ptp(original, axis=1)
    if stretch:
        half = half * _right_stretch(state.deformation_gradient)
    side = np.sign(original - state.initial_centroid[:, None])
    return np.asarray(state.centroid[:, None] + side * half[:, None])


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


def _affine(state: DomainState, arms: NDArray[np.float64], particle: PointBasis) -> PointBasis:
    """Return rows ``S_ip + grad S_ip . F_p (X_c - X_p)`` for the corners of each domain.

    What round-off leaves of weights that cancel is dropped: a column of it would be noise.
    """
    assert particle.gradients is not None
    rows = np.einsum("nji,nki->nkj", particle.gradients, arms) + particle.values[:, None]
    rows = np.where(np.abs(rows) < DROP, 0.0, rows)
    k = arms.shape[1]
    nodes = np.broadcast_to(particle.nodes[:, None], rows.shape)
    size = state.domains.size
    result = PointBasis(
        np.zeros((size, rows.shape[2]), dtype=np.int64),
        np.zeros((size, rows.shape[2])),
        np.ones(size, dtype=bool),
    )
    result.nodes[state.domains] = nodes
    result.values[state.domains] = rows
    result.found[state.domains] = np.repeat(particle.found[:, None], k, axis=1)
    return result


def _right_stretch(F: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the diagonal of ``U = (F^T F)^(1/2)``, shape ``(n, gdim)``."""
    squares, axes = np.linalg.eigh(F.swapaxes(1, 2) @ F)
    return np.asarray(np.einsum("nia,na->ni", axes**2, np.sqrt(squares)))


def require_boxes(body: mesh.Mesh, corners: NDArray[np.float64], index: NDArray[np.int64]) -> None:
    """Raise an error unless all domains are axis-aligned boxes (collective).

    Args:
        body: The body mesh.
        corners: Corners of this rank's domains, shape ``(n, k, gdim)``.
        index: Their global indices.

    Raises:
        MPMError: Some are not; it names them.
    """
    low, high = corners.min(axis=1, keepdims=True), corners.max(axis=1, keepdims=True)
    off = np.minimum(corners - low, high - corners).max(axis=(1, 2), initial=0.0)
    skew = index[off > 1e-9 * (high - low).max(axis=(1, 2), initial=0.0)]
    with agree(body.comm):
        if len(skew) or body.basix_cell() not in BOX_CELLS:
            raise MPMError(
                "Method 'gimp' needs particle domains that are axis-aligned rectangles or "
                "boxes; use 'cpdi2' or 'cpdi' for this body.",
                skew,
            )


class BoxGrid:
    """The grid lines of a structured background of rectangles or boxes.

    Args:
        background: The background mesh.

    Attributes:
        lower: Lower corner of the background, shape ``(gdim,)``.
        upper: Upper corner, shape ``(gdim,)``.
        reach: How far outside a particle counts as on the boundary, shape ``(gdim,)``.

    Raises:
        MPMError: The background is not such a grid.
    """

    def __init__(self, background: mesh.Mesh) -> None:
        gdim = background.geometry.dim
        count = background.topology.index_map(background.topology.dim).size_local
        x = background.geometry.x[_compat.geometry_dofmap(background)[:count], :gdim]
        self._lines = [_merge(background.comm, x[:, :, i].ravel()) for i in range(gdim)]
        with agree(background.comm):
            if background.basix_cell() not in BOX_CELLS or not all(
                _spans_one(x[:, :, i], self._lines[i]) for i in range(gdim)
            ):
                raise MPMError(
                    "Method 'gimp' needs a structured background of axis-aligned rectangles or "
                    "boxes; use 'cpdi2' or 'cpdi' on this one."
                )
        self.lower = np.array([line[0] for line in self._lines])
        self.upper = np.array([line[-1] for line in self._lines])
        self.reach = np.array([TOLERANCE * np.diff(line).min() for line in self._lines])

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


def _merge(comm: MPI.Comm, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distinct coordinates of all ranks, sorted."""
    together = np.unique(np.concatenate(comm.allgather(np.unique(values))))
    tolerance = 1e-9 * (together[-1] - together[0])
    return np.asarray(together[np.diff(together, prepend=-np.inf) > tolerance])


def _spans_one(x: NDArray[np.float64], line: NDArray[np.float64]) -> bool:
    """Return whether the corners of each cell lie on two neighbouring lines."""
    if len(x) == 0:
        return True
    nearest = np.searchsorted(0.5 * (line[1:] + line[:-1]), x)
    low, high = nearest.min(axis=1), nearest.max(axis=1)
    on_line = np.abs(line[nearest] - x).max() <= 1e-9 * (line[-1] - line[0])
    each = np.all((nearest == low[:, None]) | (nearest == high[:, None]))
    return bool(on_line and each and np.all(high - low == 1))
