# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What acts between a point and a facet of another body, and its derivative.

A point is projected on the facet; the gap gives the pressure, the way from the anchor the shear.
What acts on the point acts the other way on the facet's nodes, as if the point were fixed to the
facet by a rigid arm along its normal. Compiled loops do so point by point and carry derivatives
along; what they are, and whole steps of a motion, are told here by complex steps.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._core import is_as_inherited, loops
from .facets import Table, solved
from .law import Coulomb, Points, Traction, nitsche, push_derivative, traction
from .surface import normals
from .whole_step import corrected, deformation, mean_pressure

__all__ = [
    "Acting",
    "Foot",
    "Start",
    "Stencil",
    "Sums",
    "acting",
    "acting_now",
    "add_tangents",
    "by_complex_step",
    "by_stress",
    "projected",
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
    """What the tractions at some points depend on.

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
    """What acts on points and on nodes of their facets.

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


def acting(law: Coulomb, stencil: Stencil, z: NDArray[Any], touch: float, extent: float) -> Acting:
    """Return what acts on the points and on nodes of their facets.

    Args:
        law: Friction.
        stencil: The points.
        z: Their stencils' positions, real or with a small imaginary part.
        touch: Gap at which points touch.
        extent: Largest coordinate of the body of the facets.
    """
    start, count = stencil.start, stencil.anchored.shape[1]
    both = z[:, : 1 + count]
    x, X = both[:, 0], both[:, 1:]
    foot = projected(stencil.table, x, X, stencil.outward)
    delta = np.zeros_like(x)
    if not law.smooth:
        delta = x - np.einsum("nk,nki->ni", stencil.anchored, z[:, 1 + count :])
    if start is None:
        pressure = None
        if stencil.behind is not None:
            pressure = nitsche(stencil.points, stencil.behind, foot.gap, foot.n, touch).pressure
        acts = traction(law, stencil.points, delta, foot.gap, foot.n, touch, pressure)
        gradient = _gradient(foot)
    else:
        gap, middle, change = foot.gap, 0.5 * (start.x + both), both - start.x
        foot = projected(start.table, middle[:, 0], middle[:, 1:], stencil.outward)
        gradient = _gradient(foot)
        v = deformation(middle, change)
        gradient, _ = corrected(gradient, change, v, gap - start.gap, extent)
        gap, before = gap - start.offset, start.gap - start.offset
        p = mean_pressure(stencil.points.stiffness, before, gap, touch)
        acts = traction(law, stencil.points, delta, gap, foot.n, touch, p)
    pushes = acts.pressure[:, None, None] * gradient
    return Acting(pushes, _rubs(foot, acts.shear), acts)


def _rubs(foot: Foot, shear: NDArray[Any]) -> NDArray[Any]:
    """Return what shear does to points and to nodes of their facets, ``(n, 1 + k, i)``."""
    # the arm g n turns with the facet
    A = foot.along
    along = solved(A @ A.swapaxes(1, 2), np.einsum("nei,ni->ne", A, shear))
    turn = -foot.gap[:, None] * np.einsum("nek,ne->nk", foot.dN, along)
    on_nodes = -(foot.N[:, :, None] * shear[:, None, :] + turn[:, :, None] * foot.n[:, None])
    return np.concatenate([shear[:, None], on_nodes], axis=1)


def by_stress(law: Coulomb, stencil: Stencil, touch: float) -> tuple[Array, Array]:
    """Return how forces grow with the traction of the stress behind along the normal.

    Args:
        law: As for :func:`acting`.
        stencil: As there, with such tractions.
        touch: As there.

    Returns:
        The normals, shape ``(n, gdim)``, and derivatives of forces on points and nodes of their
        facets, shape ``(n, 1 + k, gdim)``.
    """
    assert stencil.behind is not None
    x, X = stencil.x[:, 0], stencil.x[:, 1 : 1 + stencil.anchored.shape[1]]
    foot = projected(stencil.table, x, X, stencil.outward)
    push = nitsche(stencil.points, stencil.behind, foot.gap, foot.n, touch)
    by = _gradient(foot)
    if not law.smooth:
        delta = x - np.einsum(
            "nk,nki->ni", stencil.anchored, stencil.x[:, 1 + stencil.anchored.shape[1] :]
        )
        along = push_derivative(law, stencil.points, delta, foot.gap, foot.n, touch, push) - foot.n
        by = by + _rubs(foot, along)
    return foot.n, by * push.acts[:, None, None]


def _is_compiled(law: Coulomb, stencil: Stencil) -> bool:
    """Return whether there are compiled loops for a law and points."""
    return stencil.start is None and is_as_inherited(law, "_loop")


def _compiled_arguments(law: Coulomb, stencil: Stencil, touch: float) -> tuple[Any, ...]:
    """Return what the compiled loops take."""
    points = stencil.points
    arrays = [points.stiffness, points.tangential, points.gap, points.stretch]
    behind = np.zeros(0) if stencil.behind is None else stencil.behind
    return (
        np.ascontiguousarray(stencil.x),
        [np.ascontiguousarray(part) for part in (*stencil.table, stencil.anchored)],
        [np.ascontiguousarray(part) for part in (stencil.outward, *arrays, behind)],
        points.touched.view(np.uint8),
        [law.friction, law.cohesion, law.limit, touch],
        law.smooth,
    )


def acting_now(law: Coulomb, stencil: Stencil, touch: float, extent: float) -> Acting:
    """Return what acts at the stencil's own positions: :func:`acting`, compiled where it can be.

    Args:
        law: As for :func:`acting`, as all that is not said here.
        stencil: As there.
        touch: As there.
        extent: As there.
    """
    if not _is_compiled(law, stencil):
        return acting(law, stencil, stencil.x, touch, extent)
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


def add_tangents(law: Coulomb, stencil: Stencil, touch: float, extent: float, sums: Sums) -> None:
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
    if _is_compiled(law, stencil):
        arguments = _compiled_arguments(law, stencil, touch)
        loops.add_tangents(*arguments, *where, sums.values)
        return
    D = by_complex_step(law, stencil, touch, extent)
    loops.add_derivatives(D, *where, sums.values)


def by_complex_step(
    law: Coulomb, stencil: Stencil, touch: float, extent: float
) -> NDArray[np.float64]:
    """Return the derivatives of all forces at the points' stencils, by complex steps.

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
        pushes, rubs, _ = acting(law, whole, copies.reshape(-1, count, gdim), touch, extent)
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
