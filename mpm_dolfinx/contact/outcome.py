# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Tractions at the points of a surface, as users are told of them."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError, agree
from .surface import Surface

__all__ = ["Outcome", "require_apart", "untouched"]

#: Most penetration, over the thickness of the domain behind, of bodies as they are given.
OVERLAP = 0.1


class Outcome(NamedTuple):
    """Tractions at the points of a surface.

    Attributes:
        positions: Shape ``(m, nq, gdim)``.
        gap: Shape ``(m, nq)``; infinite where nothing is near.
        pressure: Shape ``(m, nq)``.
        traction: Pressure and shear as a vector, shape ``(m, nq, gdim)``.
        inside: Which points are in contact, shape ``(m, nq)``.
        slips: Which of these slip.
    """

    positions: NDArray[np.float64]
    gap: NDArray[np.float64]
    pressure: NDArray[np.float64]
    traction: NDArray[np.float64]
    inside: NDArray[np.bool_]
    slips: NDArray[np.bool_]

    def of(self, which: NDArray[np.int64]) -> Outcome:
        """Return that of some facets."""
        parts: list[Any] = [part[which] for part in self]
        return Outcome(*parts)


def untouched(x: NDArray[np.float64], gap: NDArray[np.float64] | None = None) -> Outcome:
    """Return the outcome without contact.

    Args:
        x: Positions of points, shape ``(m, nq, gdim)``.
        gap: Shape ``(m, nq)``; infinite by default.
    """
    shape = x.shape[:2]
    none = np.zeros(shape, dtype=bool)
    far = np.full(shape, np.inf) if gap is None else gap
    return Outcome(x, far, np.zeros(shape), np.zeros_like(x), none, none)


def require_apart(surface: Surface, outcome: Outcome, what: str) -> None:
    """Raise an error where points that do not touch yet are deep in an obstacle (collective).

    Args:
        surface: The points.
        outcome: Where they are.
        what: A sentence that says so, with places for particles, ``depth`` and ``where``.

    Raises:
        MPMError: Some are in it by more than a share of the domains behind.
    """
    deep = (-outcome.gap > OVERLAP * surface.thickness[:, None]) & (surface.weights > 0.0)
    deep &= ~outcome.inside
    with agree(surface.particles.mesh.comm):
        if deep.any():
            depth = np.where(deep, -outcome.gap, 0.0)
            place = np.unravel_index(np.argmax(depth), depth.shape)
            where = tuple(float(f"{x:.6g}") for x in outcome.positions[place])
            sentence = what.format(particles="{particles}", depth=depth[place], where=where)
            index = surface.particles.global_index[surface.layout.cells[deep.any(axis=1)]]
            raise MPMError(sentence, index)
