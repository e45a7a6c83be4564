# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The choice of what holds badly supported dofs."""

from __future__ import annotations

from collections.abc import Sequence

from ..particles.particles import Particles, require_at_nodes
from .ghost_penalty import GhostPenalty
from .joints import Joints

__all__ = ["STABILISATIONS", "joints_of", "stabilisation_of"]

#: Background nodes with weight over nodes of the bodies, from which on a background of degree 1
#: needs a penalty.
CROWDED = 0.9
#: Values of ``stabilisation`` besides ``None``.
STABILISATIONS = ("auto", "ghost")


def stabilisation_of(
    kind: str | None, bodies: Sequence[Particles], background: bool = False
) -> GhostPenalty | None:
    """Return the penalty on badly supported dofs, if there is one.

    Args:
        kind: ``"ghost"``, ``None`` (nothing) or ``"auto"``: a ghost penalty for a background of
            degree 2 or more; for degree 1 only while the bodies have hardly more nodes than the
            background, for methods that move particles at their nodes, and where there are no
            terms on the background.
        bodies: The bodies on one background space.
        background: Whether there are terms on the background.

    Raises:
        MPMError: A method whose particles are not moved at their nodes.
    """
    # nodes with unknowns of their own are held by their own elements
    simple = bodies[0].V.ufl_element().degree == 1
    if bodies[0].is_free or (simple and kind == "auto" and background):
        kind = None
    if kind is None:
        return None
    least = CROWDED if kind == "auto" and simple else 0.0
    for body in bodies:
        if not body.mover.method.at_nodes:
            if least > 0.0:
                return None
            require_at_nodes(f"stabilisation={kind!r}", body)
    return GhostPenalty(bodies, least)


def joints_of(kind: str | None, bodies: Sequence[Particles]) -> Joints | None:
    """Return the term that keeps joints between bodies shut, by default with degree 1.

    Args:
        kind: As for :func:`stabilisation_of`.
        bodies: The bodies on one background space.
    """
    simple = bodies[0].V.ufl_element().degree == 1
    acts = kind == "auto" and simple and len(bodies) > 1
    return Joints(bodies) if acts and all(body.shares_nodes for body in bodies) else None
