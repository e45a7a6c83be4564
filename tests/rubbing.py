# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Contact by NumPy, for real and complex positions: what compiled loops are compared with."""

import numpy as np

from mpm_dolfinx.contact.surface import normals
from mpm_dolfinx.tolerances import HALF_DIGITS, ROUND_OFF

STEP = 1e-40


def traction(law, points, at):
    """Return pressure, traction by it, shear, which points touch, and which slip."""
    gap, n, delta, touch, behind, begun = at
    k, push = points.stiffness, n
    if begun is None:
        p = -k * gap
        acts = gap.real <= touch
        if behind is not None:
            p = p + (n * behind).sum(axis=1)
            acts = p.real >= -k * touch
        p = np.where(acts, p, 0.0)
    else:
        p = mean_pressure(k, begun.gap - begun.offset, gap - begun.offset, touch)
        push = corrected(n, begun.change, begun.change, gap - begun.gap, touch)
    inside = (gap.real <= touch) | (p.real != 0.0)
    came = ~points.touched & (points.gap > 10.0 * touch)
    pressed = came & (gap.real < 0.0)
    share = -gap / np.where(pressed, points.gap - gap, 1.0)
    share = np.where(pressed, share, np.where(came, 0.0, 1.0))
    along = delta - n * (n * delta).sum(axis=1)[:, None]
    tried = -(points.tangential * share * inside)[:, None] * along
    size = np.sqrt((tried * tried).sum(axis=1))
    bound = law.friction * np.where(p.real > 0.0, p, 0.0) + law.cohesion * points.stretch
    limit = law.limit * points.stretch
    bound = np.where(bound.real < limit, bound, limit)
    slips = inside & (size.real > bound.real + points.tangential * touch) & (not law.smooth)
    factor = np.where(slips, bound / np.where(slips, size, 1.0), 0.0 if law.smooth else 1.0)
    return p, p[:, None] * push, factor[:, None] * tried, inside, slips


def mean_pressure(stiffness, before, gap, touch):
    """Return the pressure of a step between two gaps."""
    first, last = (np.where(g.real <= touch, g, 0.0) for g in (before, gap))
    change = gap - before
    once = ((before <= touch) != (gap.real <= touch)) & (np.abs(change.real) > touch)
    share = np.where(once, (last - first) / np.where(once, change, 1.0), 1.0)
    return -0.5 * stiffness * (first + last) * share


def corrected(gradient, change, along, difference, touch):
    """Return a gradient whose product with a change is a difference, corrected along v."""
    axes = tuple(range(1, gradient.ndim))
    size = (along * along).sum(axis=axes)
    moved = size.real > (HALF_DIGITS / ROUND_OFF * touch) ** 2
    lacks = difference - (gradient * change).sum(axis=axes)
    factor = np.where(moved, lacks / np.where(moved, size, 1.0), 0.0)
    return gradient + factor.reshape(-1, *(1 for _ in axes)) * along


def deformation(middle, change):
    """Return the part of changes of some points that is no rigid motion."""
    arm = middle - middle.mean(axis=1, keepdims=True)
    left = change - change.mean(axis=1, keepdims=True)
    if middle.shape[2] == 2:
        across = np.stack([-arm[:, :, 1], arm[:, :, 0]], axis=2)
        turn = (across * left).sum(axis=(1, 2)) / (arm * arm).sum(axis=(1, 2))
        return left - turn[:, None, None] * across
    moment = np.cross(arm, left).sum(axis=1)
    inertia = np.einsum("nki,nki->n", arm, arm)[:, None, None] * np.eye(3)
    inertia = inertia - np.einsum("nki,nkj->nij", arm, arm)
    turn = np.linalg.solve(inertia, moment[:, :, None])[:, :, 0]
    return left - np.cross(turn[:, None, :], arm)


def solved(G, b):
    """Return the solutions of systems ``(n, e, e)`` for ``b``, ``(n, e)``."""
    return np.linalg.solve(G, b[:, :, None])[:, :, 0]


def projected(table, x, X, outward):
    """Return what there is at the feet of points: N, dN, slopes, normals and gaps."""
    N, dN, ddN = table
    # one step of Newton's method has the derivative of the projection exactly
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
    return N, dN, A, n, (r * n).sum(axis=1)
