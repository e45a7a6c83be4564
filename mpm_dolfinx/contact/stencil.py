# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Contact between points and facets of another body, and its derivatives.

A point is projected on the facet; the gap gives the pressure, the way from the anchor the shear.
What acts on the point acts the other way on the facet's nodes, as if the point were fixed to the
facet by a rigid arm along its normal. Compiled loops do so point by point and carry derivatives
along.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._core import loops
from .facets import Table
from .law import Begun, Friction, Points, Separation, Traction, bounds, known
from .law import remembered as remembered_by
from .pair_matrices import Places

__all__ = [
    "Acting",
    "Start",
    "Stencil",
    "acting",
    "add_tangents",
    "by_stress",
    "remembered",
]

type Array = NDArray[np.float64]


class Start(NamedTuple):
    """Where a step of a motion begins, at some points.

    Attributes:
        x: Positions of points and nodes of their facets, shape ``(n, 1 + k, gdim)``.
        table: Shape functions with derivatives where the points are projected in the middle of the
            step: see :meth:`NearFacets.tabulate`.
        gap: The gap, shape ``(n,)``.
        offset: Gap at which points begin to be pressed, shape ``(n,)``.
    """

    x: NDArray[np.float64]
    table: Table
    gap: NDArray[np.float64]
    offset: NDArray[np.float64]


class Stencil(NamedTuple):
    """Quantities that the tractions at some points depend on.

    Attributes:
        which: The points.
        place: Their projections on facets.
        table: Shape functions with derivatives there: see :meth:`NearFacets.tabulate`.
        anchored: Shape functions at their anchors.
        x: Positions of points, nodes of their facets and of those of their anchors, ``(n, k, i)``.
        points: Stiffness and memory.
        outward: As that of :class:`Surface`.
        start: Where the step begins, if it is one of a motion.
        behind: Tractions by the stress behind the points, where these press, shape ``(n, gdim)``.
    """

    which: NDArray[np.int64]
    place: NDArray[np.float64]
    table: Table
    anchored: NDArray[np.float64]
    x: NDArray[Any]
    points: Points
    outward: NDArray[np.float64]
    start: Start | None
    behind: NDArray[np.float64] | None = None


class Acting(NamedTuple):
    """Tractions at points, and forces on nodes of their facets.

    Attributes:
        pushes: Tractions by pressure on points and nodes, shape ``(n, 1 + k, gdim)``.
        rubs: The same by friction.
        acts: Those on the points.
    """

    pushes: NDArray[Any]
    rubs: NDArray[Any]
    acts: Traction


def _places(stencil: Stencil) -> tuple[Any, ...]:
    """Return the arguments of the compiled loops for places."""
    tables = (*stencil.table, stencil.anchored, stencil.outward)
    start: list[Array] = []
    if (begun := stencil.start) is not None:
        start = [begun.x, *begun.table, begun.gap, begun.offset]
    x, *parts = (np.ascontiguousarray(part) for part in (stencil.x, *tables, *start))
    return x, parts[: len(tables)], parts[len(tables) :]


def _seen(law: Friction, stencil: Stencil, touch: float) -> Separation:
    """Return where points are with respect to what they meet."""
    n, _, gdim = stencil.x.shape
    gap, normal, delta = np.zeros(n), np.zeros((n, gdim)), np.zeros((n, gdim))
    none = known(law, stencil.points, touch, None, np.zeros(0))
    loops.see(*_places(stencil), *none, gap, normal, delta)
    begun = None
    if stencil.start is not None:
        begun = Begun(stencil.start.gap, stencil.start.offset, np.zeros_like(normal))
    return Separation(gap, normal, delta, touch, stencil.behind, begun)


def _arguments(law: Friction, stencil: Stencil, touch: float) -> tuple[Any, ...]:
    """Return the arguments of the compiled loops."""
    most = np.zeros(0)
    if not law.compiled:
        most = bounds(law, stencil.points, _seen(law, stencil, touch))
    return *_places(stencil), *known(law, stencil.points, touch, stencil.behind, most)


def by_stress(law: Friction, stencil: Stencil, touch: float) -> tuple[Array, Array]:
    """Return how forces grow with the traction of the stress behind along the normal.

    Args:
        law: As for :func:`acting`.
        stencil: As there, with such tractions.
        touch: As there.

    Returns:
        The normals, shape ``(n, gdim)``, and derivatives of forces on points and nodes of their
        facets, shape ``(n, 1 + k, gdim)``.
    """
    n, _, gdim = stencil.x.shape
    found = np.zeros((n, 1 + stencil.anchored.shape[1], gdim))
    loops.act_by_pressure(*_arguments(law, stencil, touch), found)
    return _seen(law, stencil, touch).normal, found


def remembered(law: Friction, stencil: Stencil, touch: float) -> Array:
    """Return the memory of the law at points at the end of a step, shape ``(n, k)``.

    Args:
        law: Friction.
        stencil: The points.
        touch: As for :func:`acting`.
    """
    return remembered_by(law, stencil.points, _seen(law, stencil, touch))


def acting(law: Friction, stencil: Stencil, touch: float) -> Acting:
    """Return tractions and forces on nodes of the points' facets, at the stencil's positions.

    Args:
        law: Friction.
        stencil: The points.
        touch: Gap at which points touch.
    """
    n, _, gdim = stencil.x.shape
    pushes, rubs = np.zeros((2, n, 1 + stencil.anchored.shape[1], gdim))
    pressure, masks = np.zeros(n), np.zeros((2, n), dtype=bool)
    loops.act(*_arguments(law, stencil, touch), pushes, rubs, pressure, *masks.view(np.uint8))
    return Acting(pushes, rubs, Traction(pressure, pushes[:, 0], rubs[:, 0], *masks))


def add_tangents(
    law: Friction, stencil: Stencil, touch: float, weights: Array, shapes: Array, into: Places
) -> None:
    """Add the derivatives of all forces at the points' stencils to blocks.

    Args:
        law: As for :func:`acting`, as all that is not said here.
        stencil: As there.
        touch: As there.
        weights: Of the points, shape ``(n,)``.
        shapes: Shape functions by which a point is spread over the a nodes of its own facet,
            ``(n, a)``.
        into: The blocks.
    """
    if len(stencil.x) == 0:
        return
    where = [np.ascontiguousarray(part) for part in (weights, shapes, *into[:2])]
    loops.add_tangents(*_arguments(law, stencil, touch), *where, into.values)
