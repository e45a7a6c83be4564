# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Facets near the points of a surface, and the points that may come near to one."""

from __future__ import annotations

from typing import NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from .facets import Closest, NearFacets
from .memory import spread
from .surface import Surface

__all__ = ["Neighbourhood", "Sides"]


class Sides(NamedTuple):
    """Points and the facets that they may meet.

    Attributes:
        source: The points.
        target: The facets.
        number: A number of each facet that this rank owns, the same on any ranks, shape ``(m,)``.
        reach: How near a facet must be to be met.
        share: Share of the load that the points bear.
    """

    source: Surface
    target: Surface
    number: NDArray[np.int64]
    reach: float
    share: float

    @property
    def touch(self) -> float:
        """Gap at which points touch."""
        return max(self.source.touch, self.target.touch)


class Neighbourhood:
    """The facets near points, until bodies have gone far (collective).

    Args:
        sides: The points and the facets.
        mine: Positions of the own nodes of the points' surface.
        nodes: Those of the facets'.
        followed: Which points have met a facet, shape ``(n,)``; ``None``: not known yet.

    Attributes:
        sides: As given.
        near: The facets.
        before: Their nodes at the last converged step, shape ``(f, k, gdim)``.
        facets: Facets of the points' surface that may come near, shape ``(m,)``.
        which: Their points.
        weights: Their areas, times the share of the load.
    """

    def __init__(
        self,
        sides: Sides,
        mine: NDArray[np.float64],
        nodes: NDArray[np.float64],
        followed: NDArray[np.bool_] | None,
    ) -> None:
        source, target, reach = sides.source, sides.target, sides.reach
        self.sides, self._start = sides, (mine, nodes)
        x = source.shapes @ mine[source.layout.own]
        near = self.near = NearFacets(
            target, sides.number, x.reshape(-1, source.gdim), 3.0 * reach, nodes
        )
        corners = near.positions(nodes)
        self.before = near.positions(target.own_nodes(converged=True))
        # (until it is made anew, no point gets nearer to a facet by more than the reach)
        low = corners.min(axis=(0, 1), initial=np.inf) - 2.0 * reach
        high = corners.max(axis=(0, 1), initial=-np.inf) + 2.0 * reach
        within = ((x >= low) & (x <= high)).all(axis=2).any(axis=1)
        if followed is not None:
            within |= followed.reshape(len(within), source.nq).any(axis=1)
        self.facets = np.flatnonzero(within)
        self.which = (self.facets[:, None] * source.nq + np.arange(source.nq)).ravel()
        self.weights = sides.share * source.weights[self.facets].ravel()

    def is_left(self, mine: NDArray[np.float64], nodes: NDArray[np.float64]) -> bool:
        """Return whether bodies have gone far since it was made (collective).

        Args:
            mine: As for the class.
            nodes: As there.
        """
        sides = self.sides
        surfaces = sides.source, sides.target
        moved = [
            surface.spread * np.sqrt(((a - b) ** 2).sum(axis=1).max(initial=0.0))
            for surface, a, b in zip(surfaces, (mine, nodes), self._start, strict=True)
        ]
        comm: MPI.Comm = sides.source.particles.mesh.comm
        return bool(comm.allreduce(float(sum(moved)), MPI.MAX) > sides.reach)

    def taken_over(self, paired: Closest, before: Neighbourhood) -> Closest:
        """Return the facets that points were paired with in the neighbourhood of before."""
        facet = self.near.find(before.near.numbers(paired.facet))
        paired = paired._replace(facet=facet, near=paired.near & (facet >= 0))
        source = self.sides.source
        whole = Closest.none(len(source.layout.cells) * source.nq, source.gdim - 1)
        parts = zip(paired, whole, strict=True)
        return Closest(*(spread(part, before.which, base)[self.which] for part, base in parts))
