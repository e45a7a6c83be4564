# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Forces of contact over a whole step of a motion, which neither add energy nor take any.

A gap g stores the energy ``W(g) = k/2 <-g>^2`` per area. Over a step in which positions z go from
z_0 to z_1 and the gap from g_0 to g_1, contact acts with

    p G,   p = -(W(g_1) - W(g_0)) / (g_1 - g_0),
    G = grad g(z_m) + (g_1 - g_0 - grad g(z_m) . dz) v / (v . v),   dz = z_1 - z_0,

z_m being the middle and v the change dz less its rigid part at z_m. Then ``p G . dz`` is the loss
of energy, whatever facets the gaps are measured from; and as the gradient and v have neither sum
nor moment about any point at z_m, momentum and angular momentum stay what they are (the discrete
gradient that knows symmetries of Gonzalez 1996, J. Nonlinear Sci. 6, section 4). Friction acts
with its traction at the step's end, within the cone of the step's pressure: it never gives energy.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..tolerances import HALF_DIGITS

__all__ = ["corrected", "corrected_slope", "deformation", "mean_pressure", "pressure_slope"]


def mean_pressure(
    stiffness: NDArray[np.float64], before: NDArray[Any], gap: NDArray[Any], touch: float
) -> NDArray[Any]:
    """Return the pressure of a step between two gaps.

    Args:
        stiffness: k, shape ``(n,)``.
        before: Gap at the step's beginning, shape ``(n,)``.
        gap: At its end.
        touch: Gap at which points touch.
    """
    first, last, share = _ends(before, gap, touch)
    return np.asarray(-0.5 * stiffness * (first + last) * share)


def pressure_slope(
    stiffness: NDArray[np.float64],
    before: NDArray[np.float64],
    gap: NDArray[np.float64],
    touch: float,
) -> NDArray[np.float64]:
    """Return the derivative of :func:`mean_pressure` by the gap at the step's end, ``(n,)``."""
    _, _, share = _ends(before, gap, touch)
    was, touches = before <= touch, gap <= touch
    factor = np.where(was, np.where(touches, 1.0, share**2), share * (2.0 - share))
    return np.asarray(-0.5 * stiffness * np.where(was | touches, factor, 0.0))


def _ends(
    before: NDArray[Any], gap: NDArray[Any], touch: float
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return penetrations at both ends, and over which share of the way there was one."""
    first, last = (np.where(g.real <= touch, g, 0.0) for g in (before, gap))
    change = gap - before
    once = ((before.real <= touch) != (gap.real <= touch)) & (np.abs(change.real) > touch)
    share = np.where(once, (last - first) / np.where(once, change, 1.0), 1.0)
    return first, last, share


def corrected(
    gradient: NDArray[Any],
    change: NDArray[Any],
    along: NDArray[Any],
    difference: NDArray[Any],
    extent: float,
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return a gradient whose product with a change is a difference, and the factor of v in it.

    Args:
        gradient: Shape ``(n, ...)``.
        change: dz, of the same shape.
        along: v, of the same shape.
        difference: ``g_1 - g_0``, shape ``(n,)``.
        extent: Largest coordinate of the body.
    """
    axes = tuple(range(1, gradient.ndim))
    size = (along * along).sum(axis=axes)
    moved = size.real > (HALF_DIGITS * extent) ** 2
    lacks = difference - (gradient * change).sum(axis=axes)
    factor = np.where(moved, lacks / np.where(moved, size, 1.0), 0.0)
    return gradient + factor.reshape(-1, *(1 for _ in axes)) * along, factor


def corrected_slope(
    gradient: NDArray[np.float64],
    bend: NDArray[np.float64],
    change: NDArray[np.float64],
    factor: NDArray[np.float64],
    slope: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the derivative of :func:`corrected` by a change along which it corrects.

    Args:
        gradient: What was corrected, shape ``(n, gdim)``.
        bend: Its derivative by the change, shape ``(n, gdim, gdim)``.
        change: dz, and v, shape ``(n, gdim)``.
        factor: That of v, shape ``(n,)``.
        slope: Derivative of the difference by the change, shape ``(n, gdim)``.

    Returns:
        Shape ``(n, gdim, gdim)``.
    """
    size = (change**2).sum(axis=1)
    moved = factor != 0.0
    dfactor = slope - gradient - np.einsum("nij,nj->ni", bend, change)
    dfactor -= 2.0 * factor[:, None] * change
    dfactor = np.where(moved[:, None], dfactor / np.where(moved, size, 1.0)[:, None], 0.0)
    turn = bend + factor[:, None, None] * np.eye(change.shape[1])
    return np.asarray(turn + change[:, :, None] * dfactor[:, None, :])


def deformation(middle: NDArray[Any], change: NDArray[Any]) -> NDArray[Any]:
    """Return the part of changes of some points that is no rigid motion.

    Args:
        middle: Where the points are, shape ``(n, k, gdim)``.
        change: Their changes, of the same shape.
    """
    arm = middle - middle.mean(axis=1, keepdims=True)
    left = change - change.mean(axis=1, keepdims=True)
    if middle.shape[2] == 2:
        across = np.stack([-arm[:, :, 1], arm[:, :, 0]], axis=2)
        turn = (across * left).sum(axis=(1, 2)) / (arm * arm).sum(axis=(1, 2))
        return np.asarray(left - turn[:, None, None] * across)
    moment = np.cross(arm, left).sum(axis=1)
    inertia = np.einsum("nki,nki->n", arm, arm)[:, None, None] * np.eye(3)
    inertia = inertia - np.einsum("nki,nkj->nij", arm, arm)
    turn = np.linalg.solve(inertia, moment[:, :, None])[:, :, 0]
    return np.asarray(left - np.cross(turn[:, None, :], arm))
