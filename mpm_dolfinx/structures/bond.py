# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The bond of a bar with the soil around it, along which it slips."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import basix

from ..errors import MPMError
from ..parallel.given import as_positive
from ..system.own import OwnUnknowns
from ..tolerances import SMALL
from .layout import Layout, chosen

__all__ = ["Bond", "Grip", "Skin"]


@dataclass(frozen=True)
class Bond:
    """A bond that gives way along a bar, and holds it across.

    Per length of the bar it bears ``stiffness`` times the slip, up to ``limit``: beyond that it
    slips on, and what it has slipped stays. It is the skin of a nail, of the grout of an anchor, or
    of both sides of a geogrid. The bar stays bonded to the soil that it began in, so slips should
    be small beside the distance of its nodes.

    Args:
        stiffness: Force per length of the bar and slip; best some times the soil's modulus.
        limit: Largest force per length.
        where: A function of undeformed coordinates, shape ``(3, n)``, such as
            ``mpm.region(...)``: cells of the bar with all nodes there have it. Other nodes follow
            the body; ``None``: all cells have it.

    Raises:
        MPMError: Numbers that are not positive.
    """

    stiffness: float
    limit: float = np.inf
    where: Any = None

    def __post_init__(self) -> None:
        """Say so where something makes no sense."""
        as_positive(self.stiffness, "stiffness of a Bond")
        if self.limit != np.inf:
            as_positive(self.limit, "limit of a Bond")


class Skin(NamedTuple):
    """Forces of a bond in a step.

    Attributes:
        bears: Per length, shape ``(b,)``.
        forces: At nodes, shape ``(b,)``.
        tangent: Their derivatives by the slip, shape ``(b,)``.
        slips: Which give way.
    """

    bears: NDArray[np.float64]
    forces: NDArray[np.float64]
    tangent: NDArray[np.float64]
    slips: NDArray[np.bool_]


class Grip:
    """A bond as the system knows it: its unknowns are the slips of nodes in a step.

    Args:
        bond: The bond.
        layout: The bar.
        axisymmetric: Whether ``x[0]`` is a radius.
        comm: The ranks.

    Attributes:
        nodes: Numbers of the nodes that have it, shape ``(b,)``.
        own: The unknowns.
    """

    def __init__(self, bond: Bond, layout: Layout, axisymmetric: bool, comm: MPI.Comm) -> None:
        here = np.ones(len(layout.nodes), dtype=bool)
        if bond.where is not None:
            here = chosen(bond.where, layout, "where= of a Bond")
        cells = layout.cells[here[layout.cells].all(axis=1)]
        if len(cells) == 0:
            raise MPMError("where= of a Bond holds at all nodes of no cell of the bar.")
        self._bond, self._cells = bond, layout.cells
        self._senses = _senses(layout.cells)
        ends = layout.nodes[cells[:, :2]]
        lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        sizes = np.zeros(len(layout.nodes))
        np.add.at(sizes, cells, lengths[:, None] * _shares(layout))
        if axisymmetric:
            sizes *= 2.0 * np.pi * layout.nodes[:, 0]
        self.nodes = np.flatnonzero(sizes)
        self._sizes = sizes[self.nodes]
        self.own = OwnUnknowns(comm, len(self.nodes))
        self.own.advice = "a bar slips along its bond, where {} of the forces are not balanced"

    def directions(self, places: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the direction of the bar at the nodes that have it, shape ``(b, gdim)``.

        Args:
            places: Of all nodes, shape ``(N, gdim)``.
        """
        along = places[self._cells[:, 1]] - places[self._cells[:, 0]]
        total = np.zeros_like(places)
        np.add.at(total, self._cells, along[:, None] * self._senses[:, :, None])
        mine = total[self.nodes]
        return np.asarray(mine / np.linalg.norm(mine, axis=1)[:, None])

    def skin(
        self,
        before: NDArray[np.float64],
        slip: NDArray[np.float64],
        resists: NDArray[np.bool_],
    ) -> Skin:
        """Return the forces of the bond per length after slips of a step.

        Where a piece of the bar slips as a whole, between what is slack or yields, the bond alone
        holds it. Beyond the limit it has a secant there, at the node that slips least: with no
        more than the tangent of the other nodes a slip would be without bound.

        Args:
            before: Its forces per length at the last converged step, shape ``(b,)``.
            slip: Shape ``(b,)``.
            resists: Which cells of the bar resist a slip of their nodes, shape ``(m,)``.
        """
        bond = self._bond
        trial = before + bond.stiffness * slip
        bears = np.clip(trial, -bond.limit, bond.limit)
        slips = bears != trial
        secant = bears / np.where(slips, trial, 1.0)
        loose = self._loose(slips, secant, resists)
        # (where a whole bar slips, no change of force, but a tangent that can be solved with)
        share = np.where(slips, SMALL, 1.0)
        share[loose] = secant[loose]
        tangent = self._sizes * share * bond.stiffness
        return Skin(bears, self._sizes * bears, tangent, slips)

    def _loose(
        self, slips: NDArray[np.bool_], secant: NDArray[np.float64], resists: NDArray[np.bool_]
    ) -> NDArray[np.int64]:
        """Return the node that slips least on each piece of the bar of which no node sticks."""
        piece, cells = np.arange(self._cells.max() + 1), self._cells[resists]
        stays = np.ones(len(piece), dtype=bool)
        stays[self.nodes] = ~slips
        if stays.all():
            return np.zeros(0, dtype=np.int64)
        while True:
            lowest = piece.copy()
            np.minimum.at(lowest, cells, piece[cells].min(axis=1, initial=len(piece))[:, None])
            if np.array_equal(lowest, piece):
                break
            piece = lowest
        held = np.zeros(len(piece), dtype=bool)
        held[piece[stays]] = True
        loose = np.flatnonzero(~held[piece[self.nodes]])
        loose = loose[np.argsort(-secant[loose], kind="stable")]
        _, first = np.unique(piece[self.nodes[loose]], return_index=True)
        return np.asarray(loose[first])


def _shares(layout: Layout) -> NDArray[np.float64]:
    """Return the share of a cell's length that each of its nodes has, shape ``(k,)``."""
    points, weights = map(np.asarray, basix.make_quadrature(layout.kind, layout.degree))
    shapes = np.asarray(layout.element.tabulate(0, points))[0, :, :, 0]
    return np.asarray(weights @ shapes)


def _senses(cells: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return signs that give the cells at each node the sense of the first, shape ``(m, k)``.

    Another cell goes on in that sense where it begins and the first ends, or the other way round.
    """
    ends = cells[:, :2]
    _, first = np.unique(ends, return_index=True)  # its place in ends.ravel(), by node
    places = np.arange(ends.size).reshape(ends.shape)
    again = (places != first[ends]) & (places % 2 == first[ends] % 2)
    signs = np.ones(cells.shape)
    signs[:, :2][again] = -1.0
    return signs
