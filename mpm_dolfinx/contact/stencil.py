# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Contact between a point and a facet of another body, and its derivative.

A point is projected on the facet; the gap gives the pressure, the way from the anchor the shear.
What acts on the point acts the other way on the facet's nodes, as if the point were fixed to the
facet by a rigid arm along its normal. Compiled loops do so point by point and carry derivatives
along; whole steps of a motion are told here by complex steps.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._core import loops
from .facets import Table, solved
from .law import Friction, Points, Separation, Traction, bounds, known, slopes, traction
from .law import remembered as remembered_by
from .surface import normals
from .whole_step import corrected, deformation, mean_pressure

__all__ = [
    "Acting",
    "Foot",
    "Start",
    "Stencil",
    "Sums",
    "acting",
    "add_tangents",
    "by_complex_step",
    "by_stress",
    "over_step",
    "projected",
    "remembered",
]

#: Step of the complex derivative, and most points of which it is taken at once.
STEP, AT_ONCE = 1e-40, 4096


type Array = NDArray[np.float64]


class Start(NamedTuple):
    """Where a step of a motion begins, at some points.

    Attributes:
        x: Positions of points and nodes of their facets, shape ``(n, 1 + k, gdim)``.
        table: Shape functions with derivatives where the points are projected in the middle of the
            step: see :meth:`NearFacets.tabulate`.
        gap: The gap, shape ``(n,)``.
        offset: As that of :class:`_Memory`.
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


class Sums(NamedTuple):
    """Where derivatives at points add up: in blocks between nodes.

    Attributes:
        weights: Of the points, shape ``(n,)``.
        shapes: Shape functions by which a point is spread over the a nodes of its own facet,
            ``(n, a)``.
        group: Group of each point, shape ``(n,)``.
        positions: Blocks of each group, by forces on nodes of a point's facet and of the one that
            it meets, and places of these nodes and of those of the anchor's, ``(g, r, c)``.
        values: The blocks, shape ``(b, gdim, gdim)``.
    """

    weights: NDArray[np.float64]
    shapes: NDArray[np.float64]
    group: NDArray[np.int64]
    positions: NDArray[np.int32]
    values: NDArray[np.float64]


class Foot(NamedTuple):
    """Projections of points on facets, which may have a small imaginary part.

    Attributes:
        N: Shape functions there, shape ``(n, k)``.
        dN: Their derivatives, shape ``(n, e, k)``.
        along: Tangents, shape ``(n, e, gdim)``.
        n: Normals, shape ``(n, gdim)``.
        gap: Shape ``(n,)``.
    """

    N: NDArray[Any]
    dN: NDArray[Any]
    along: NDArray[Any]
    n: NDArray[Any]
    gap: NDArray[Any]


class Acting(NamedTuple):
    """Tractions at points, and forces on nodes of their facets.

    Attributes:
        pushes: Tractions by pressure on points and nodes, shape ``(n, 1 + k, gdim)``.
        rubs: The same by friction.
        acts: Pressure and shear.
    """

    pushes: NDArray[Any]
    rubs: NDArray[Any]
    acts: Traction


def projected(table: Table, x: NDArray[Any], X: NDArray[Any], outward: NDArray[np.float64]) -> Foot:
    """Return projections of points ``(n, i)`` on facets with nodes ``(n, k, i)``.

    Args:
        table: Shape functions with derivatives there.
        x: The points, real or with a small imaginary part.
        X: The nodes.
        outward: As that of :class:`Surface`.
    """
    N, dN, ddN = table
    # One step of Newton's method has the derivative of the projection exactly.
    r = x - np.einsum("nk,nki->ni", N, X)
    A = np.einsum("nek,nki->nei", dN, X)
    B = np.einsum("nefk,nki->nefi", ddN, X)
    G = (A @ A.swapaxes(1, 2) - np.einsum("nefi,ni->nef", B, r)).real
    ds = solved(G, np.einsum("nei,ni->ne", A, r))
    N = N + np.einsum("nek,ne->nk", dN, ds)
    dN = dN + np.einsum("nefk,nf->nek", ddN, ds)
    r = x - np.einsum("nk,nki->ni", N, X)
    A = np.einsum("nek,nki->nei", dN, X)
    n = outward[:, None] * normals(A.swapaxes(1, 2))
    n = n / np.sqrt((n * n).sum(axis=1))[:, None]
    return Foot(N, dN, A, n, (r * n).sum(axis=1))


def _gradient(foot: Foot) -> NDArray[Any]:
    """Return the gradient of the gap by the point and the nodes of its facet, ``(n, 1 + k, i)``."""
    n = foot.n[:, None, :]
    return np.concatenate([n, -foot.N[:, :, None] * n], axis=1)


def over_step(
    law: Friction, stencil: Stencil, z: NDArray[Any], touch: float, extent: float
) -> Acting:
    """Return tractions at points and forces on nodes of their facets in a step of a motion.

    Args:
        law: Friction.
        stencil: The points.
        z: Their stencils' positions, real or with a small imaginary part.
        touch: Gap at which points touch.
        extent: Largest coordinate of the body of the facets.
    """
    foot, gradient, at = _whole_step(law, stencil, z, touch, extent)
    acts = traction(law, stencil.points, at)
    pushes = acts.pressure[:, None, None] * gradient
    return Acting(pushes, _rubs(foot, acts.shear), acts)


def _whole_step(
    law: Friction, stencil: Stencil, z: NDArray[Any], touch: float, extent: float
) -> tuple[Foot, NDArray[Any], Separation]:
    """Return projections in the middle of a step, what acts along with its pressure, and points."""
    start = stencil.start
    assert start is not None
    end, at = _seen(law, stencil, z, touch)
    both = z[:, : 1 + stencil.anchored.shape[1]]
    middle, change = 0.5 * (start.x + both), both - start.x
    foot = projected(start.table, middle[:, 0], middle[:, 1:], stencil.outward)
    v = deformation(middle, change)
    gradient, _ = corrected(_gradient(foot), change, v, end.gap - start.gap, extent)
    gap, before = end.gap - start.offset, start.gap - start.offset
    p = mean_pressure(stencil.points.stiffness, before, gap, touch)
    return foot, gradient, at._replace(gap=gap, normal=foot.n, pressure=p)


def _seen(
    law: Friction, stencil: Stencil, z: NDArray[Any], touch: float
) -> tuple[Foot, Separation]:
    """Return projections of points, and where they are with respect to what they meet."""
    count = stencil.anchored.shape[1]
    x = z[:, 0]
    foot = projected(stencil.table, x, z[:, 1 : 1 + count], stencil.outward)
    delta = np.zeros_like(x)
    if not law.smooth:
        delta = x - np.einsum("nk,nki->ni", stencil.anchored, z[:, 1 + count :])
    return foot, Separation(foot.gap, foot.n, delta, touch, stencil.behind)


def _rubs(foot: Foot, shear: NDArray[Any]) -> NDArray[Any]:
    """Return the effect of shear on points and nodes of their facets, ``(n, 1 + k, i)``."""
    # the arm g n turns with the facet
    A = foot.along
    along = solved(A @ A.swapaxes(1, 2), np.einsum("nei,ni->ne", A, shear))
    turn = -foot.gap[:, None] * np.einsum("nek,ne->nk", foot.dN, along)
    on_nodes = -(foot.N[:, :, None] * shear[:, None, :] + turn[:, :, None] * foot.n[:, None])
    return np.concatenate([shear[:, None], on_nodes], axis=1)


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
    foot, at = _seen(law, stencil, stencil.x, touch)
    found = slopes(law, stencil.points, at)
    by = found.pressure[:, :1, None] * _gradient(foot) + _rubs(foot, found.shear[:, :, 0])
    return foot.n, by


def remembered(law: Friction, stencil: Stencil, touch: float, extent: float) -> Array:
    """Return the memory of the law at points at the end of a step, shape ``(n, k)``.

    Args:
        law: Friction.
        stencil: The points.
        touch: As for :func:`over_step`.
        extent: As there.
    """
    if stencil.start is None:
        _, at = _seen(law, stencil, stencil.x, touch)
    else:
        _, _, at = _whole_step(law, stencil, stencil.x, touch, extent)
    return remembered_by(law, stencil.points, at)


def _compiled_arguments(law: Friction, stencil: Stencil, touch: float) -> tuple[Any, ...]:
    """Return the arguments of the compiled loops."""
    most = np.zeros(0)
    if not law.compiled:
        most = bounds(law, stencil.points, _seen(law, stencil, stencil.x, touch)[1])
    parts = (*stencil.table, stencil.anchored, stencil.outward)
    return (
        np.ascontiguousarray(stencil.x),
        [np.ascontiguousarray(part) for part in parts],
        *known(law, stencil.points, touch, stencil.behind, most),
    )


def acting(law: Friction, stencil: Stencil, touch: float, extent: float) -> Acting:
    """Return tractions and forces on nodes of the points' facets, at the stencil's positions.

    Args:
        law: Friction.
        stencil: The points.
        touch: Gap at which points touch.
        extent: Largest coordinate of the body of the facets.
    """
    if stencil.start is not None:
        return over_step(law, stencil, stencil.x, touch, extent)
    n, _, gdim = stencil.x.shape
    pushes, rubs = (np.zeros((n, 1 + stencil.anchored.shape[1], gdim)) for _ in range(2))
    acts = Traction(np.zeros(n), np.zeros((n, gdim)), np.zeros(n, bool), np.zeros(n, bool))
    loops.act(
        *_compiled_arguments(law, stencil, touch),
        pushes,
        rubs,
        acts.pressure,
        acts.shear,
        acts.inside.view(np.uint8),
        acts.slips.view(np.uint8),
    )
    return Acting(pushes, rubs, acts)


def add_tangents(law: Friction, stencil: Stencil, touch: float, extent: float, sums: Sums) -> None:
    """Add the derivatives of all forces at the points' stencils to blocks.

    Args:
        law: As for :func:`acting`, as all that is not said here.
        stencil: As there.
        touch: As there.
        extent: As there.
        sums: Where they add up.
    """
    if len(stencil.x) == 0:
        return
    where = [np.ascontiguousarray(part) for part in sums[:4]]
    if stencil.start is None:
        arguments = _compiled_arguments(law, stencil, touch)
        loops.add_tangents(*arguments, *where, sums.values)
        return
    D = by_complex_step(law, stencil, touch, extent)
    loops.add_derivatives(D, *where, sums.values)


def by_complex_step(
    law: Friction, stencil: Stencil, touch: float, extent: float
) -> NDArray[np.float64]:
    """Return the derivatives of all forces of a step of a motion, by complex steps.

    Args:
        law: As for :func:`acting`.
        stencil: As there.
        touch: As there.
        extent: As there.

    Returns:
        Shape ``(n, 1 + k, i, z, j)``.
    """
    z = stencil.x.astype(np.complex128)
    n, count, gdim = z.shape
    D = np.zeros((n, 1 + stencil.anchored.shape[1], gdim, count, gdim))
    # (nothing acts where all are shifted, so that the points' derivatives follow)
    ways = [(node, j) for node in range(1, count) for j in range(gdim)]
    many = max(1, AT_ONCE // max(n, 1))
    for first in range(0, len(ways), many):
        some = ways[first : first + many]
        copies = np.repeat(z[None], len(some), axis=0)
        for copy, (node, j) in zip(copies, some, strict=True):
            copy[:, node, j] += 1j * STEP
        whole = _repeated(stencil, len(some))
        pushes, rubs, _ = over_step(law, whole, copies.reshape(-1, count, gdim), touch, extent)
        slopes = ((pushes + rubs).imag / STEP).reshape(len(some), n, -1, gdim)
        for slope, (node, j) in zip(slopes, some, strict=True):
            D[:, :, :, node, j] = slope
    D[:, :, :, 0] = -D[:, :, :, 1:].sum(axis=3)
    return D


def _repeated(values: Any, times: int) -> Any:
    """Return arrays, or tuples of such, in which all points come several times in turn."""
    if isinstance(values, np.ndarray):
        return np.tile(values, (times, *(1 for _ in values.shape[1:])))
    if values is None:
        return None
    parts = [_repeated(part, times) for part in values]
    return type(values)(*parts) if hasattr(values, "_fields") else tuple(parts)
