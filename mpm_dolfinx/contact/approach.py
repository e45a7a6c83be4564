# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Points of one body and the facets of another near them, as both are: which meet which."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import basix

from .facets import Closest, separated
from .memory import FacetMemory, spread
from .neighbourhood import Neighbourhood

__all__ = ["LINGER", "Approach", "OverStep"]

#: How far a point may slide off a facet's edge within a step, over the facet's size.
LINGER = 0.1
#: Cosine of the angle of two facets' normals below which there is a corner between them.
CORNER = 0.7


class OverStep(NamedTuple):
    """How points meet facets in a whole step of a motion.

    Attributes:
        found: The facets.
        inside: Which points touch at the end of the step.
        pressed: Which do in any part of it.
        gap: Gaps at its beginning.
        begins: Gaps at which points began to be pressed then.
        offset: Those at which they begin to from now on.
    """

    found: Closest
    inside: NDArray[np.bool_]
    pressed: NDArray[np.bool_]
    gap: NDArray[np.float64]
    begins: NDArray[np.float64]
    offset: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Approach:
    """Points and the facets near them.

    Attributes:
        around: The facets, and which points.
        last: Memory of the points.
        x: Where these are, shape ``(n, gdim)``.
        nodes: Where the nodes of the facets are, shape ``(f, k, gdim)``.
    """

    around: Neighbourhood
    last: FacetMemory
    x: NDArray[np.float64]
    nodes: NDArray[np.float64]

    def normals(self, converged: bool = False) -> NDArray[np.float64]:
        """Return normals of the points' surface there, shape ``(n, gdim)``."""
        found = self.around.sides.source.normals(converged, self.around.facets)
        return found.reshape(self.x.shape)

    def met(self, before: Closest | None, frozen: bool) -> Closest:
        """Return the facets that points meet.

        Args:
            before: Those of the last evaluation in the same step.
            frozen: Whether points stay with these.
        """
        sides, near, last = self.around.sides, self.around.near, self.last
        found = near.closest(self.x, self.normals(), self.nodes, sides.reach)
        if before is not None:
            # A point that slides off an edge goes on to touch until the step's end, or the force
            # would come and go from one iterate to the next.
            stays = before.near & (found.facet >= 0) & (found.beside < LINGER)
            found = found._replace(near=found.near | stays)
        # One that was behind the end of a facet and touched nothing goes on to, until it is behind
        # the facet itself.
        out = ~last.within & (last.gap < -sides.touch)
        found = found._replace(near=found.near & ~(out & (found.beside >= LINGER)))
        return found if before is None or not frozen else self._frozen(found, before)

    def _frozen(self, found: Closest, before: Closest) -> Closest:
        """Return the pairing of before, with projections as they are now.

        A point beside the end of its facet is not held there: it would be pressed by the plane of
        the facet, which goes on where there is none.
        """
        around, x, nodes = self.around.near, self.x, self.nodes
        keep = np.flatnonzero(before.near)
        s = around.project(x[keep], nodes[before.facet[keep]], before.place[keep])
        beside = np.abs(s - around.clamped(s)).max(axis=1, initial=0.0)
        keep, s = keep[beside < LINGER], s[beside < LINGER]
        facet = before.facet[keep]
        gap, _ = self._gaps(s, x[keep], nodes[facet], facet)
        return found.with_some(keep, facet=facet, place=s, gap=gap, near=True)

    def over_step(self, found: Closest, within: NDArray[np.bool_]) -> OverStep:
        """Return which points touch at the end of a step and in the whole of it.

        Points that leave through their facets give back their energy.

        Args:
            found: The facets that they meet at the end.
            within: Which are behind them.
        """
        near, last, x, nodes = self.around.near, self.last, self.x, self.nodes
        touch = self.around.sides.touch
        lost = np.flatnonzero(last.within & (found.facet < 0))
        at = near.find(last.closest[lost])
        lost, at = lost[at >= 0], at[at >= 0]
        if len(lost):
            place = self._place(x[lost], nodes[at])
            gap, _ = self._gaps(place, x[lost], nodes[at], at)
            found = found.with_some(lost, facet=at, place=place, gap=gap)
        before, begins = self._before_step(found)
        sideways = within & ~last.within & (before < -touch)
        offset = np.where(last.within, np.clip(found.gap, begins, 0.0), 0.0)
        offset = np.where(within, np.where(sideways, found.gap, offset), 0.0)
        inside = within & ~sideways & (found.gap - begins <= touch)
        out = (found.facet >= 0) & (found.near | (found.gap > touch))
        return OverStep(found, inside, inside | (last.within & out), before, begins, offset)

    def _before_step(self, found: Closest) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return gaps at the beginning of a step, and those at which points begin to be pressed.

        What a point has gone through is told by the facet that it comes to: measured from one on
        the other side of a corner, its gap would jump, and the force with it. A point that was
        pressed there, and is deeper behind this facet, begins to be pressed from there on, so that
        it keeps its energy. On a surface without corners the gap is that of its facet of then.
        """
        near, memory = self.around.near, self.last
        gap, offset = memory.gap.copy(), memory.offset.copy()
        last = near.find(memory.closest)
        new = np.flatnonzero((found.facet >= 0) & (found.facet != last))
        if len(new) == 0:
            return gap, offset
        now, n = self._gaps_before(new, found.facet[new], found.place[new])
        pressed = memory.within[new] & (last[new] >= 0)
        _, was = self._gaps_before(new, np.where(pressed, last[new], found.facet[new]), None)
        bent = (n * was).sum(axis=1) < CORNER
        other = ~pressed | bent
        depth = (gap - offset)[new]
        gap[new[other]] = now[other]
        turned = pressed & bent
        offset[new[turned]] = np.minimum(now - depth, 0.0)[turned]
        return gap, offset

    def _gaps_before(
        self, which: NDArray[np.int64], facet: NDArray[np.int64], place: NDArray[np.float64] | None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return gaps and normals of some points at facets at the beginning of the step."""
        near = self.around.near
        x, X = self.last.points[which], self.around.before[facet]
        s = self._place(x, X) if place is None else near.project(x, X, place)
        return self._gaps(s, x, X, facet)

    def _gaps(
        self,
        place: NDArray[np.float64],
        x: NDArray[np.float64],
        X: NDArray[np.float64],
        facet: NDArray[np.int64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return gaps and normals of points x at places on facets with the nodes X."""
        near = self.around.near
        r, n = separated(near.tabulate(place), x, X, near.outward[facet])
        return (r * n).sum(axis=1), n

    def returned(
        self,
        found: Closest,
        within: NDArray[np.bool_],
        offset: NDArray[np.float64],
        frozen: bool,
    ) -> tuple[Closest, NDArray[np.float64]]:
        """Return the pairing at a step's end and where points begin to be pressed from then on.

        A point that has stayed with its facet beyond the facet's end goes to the one that it is on:
        if it did in the next step, its gap would change by as much however short that is, and the
        force without bound. It keeps its energy.

        Args:
            found: The pairing in the step.
            within: Which points are behind their facets.
            offset: Where they begin to be pressed.
            frozen: Whether points have stayed with facets of earlier evaluations.
        """
        near = self.around.near
        which = np.flatnonzero(within)
        off = np.abs(found.place[which] - near.clamped(found.place[which])).max(axis=1, initial=0.0)
        which = which[(off > 0.0) | frozen]
        reach = self.around.sides.reach
        there = near.closest(self.x[which], self.normals()[which], self.nodes, reach)
        moves = there.near & (there.facet >= 0) & (there.facet != found.facet[which])
        which = which[moves]
        facet, place, gap = (part[moves] for part in (there.facet, there.place, there.gap))
        depth = found.gap[which] - offset[which]
        offset = spread(np.minimum(gap - depth, 0.0), which, offset)
        return found.with_some(which, facet=facet, place=place, gap=gap), offset

    def located(
        self, points: NDArray[np.float64], otherwise: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the facets that points on the surface are on, or else, and their places there."""
        near = self.around.near
        found = near.closest(points, None, self.nodes, self.around.sides.reach)
        at = np.where(found.facet >= 0, found.facet, otherwise)
        start = np.where((found.facet >= 0)[:, None], found.place, 0.5)
        return at, near.project(points, self.nodes[at], start)

    def leaks(self, found: Closest) -> bool:
        """Return whether a point has gone through the other body since the last step.

        Args:
            found: The facets that they meet now.
        """
        near, x, reach, memory = self.around.near, self.x, self.around.sides.reach, self.last
        at = near.find(memory.facet)
        # (one beside a thin body may have been behind its far side already)
        before = np.isfinite(memory.gap) & (memory.gap > -0.25 * reach)
        was = np.flatnonzero((at >= 0) & before & ~found.near & (self.around.weights > 0.0))
        if len(was) == 0:
            return False
        X = self.nodes[at[was]]
        s = self._place(x[was], X)
        inner = near.clamped(s)
        gap, _ = self._gaps(inner, x[was], X, at[was])
        deep = gap < -0.75 * reach
        beside = np.linalg.norm(s - inner, axis=1) > 0.5
        return bool(np.any(deep & ~beside))

    def _place(self, x: NDArray[np.float64], X: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return places of points on the facets with nodes X, or beside them."""
        near = self.around.near
        middle = basix.geometry(near.element.cell_type).mean(axis=0)
        return near.project(x, X, np.tile(middle, (len(x), 1)))
