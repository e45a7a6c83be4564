# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The choice among cures of badly supported dofs."""

from __future__ import annotations

from collections.abc import Sequence

from ..errors import MPMError
from ..particles.particles import Particles
from ..reals import is_one_of
from .aggregation import Aggregation
from .cure import Cure
from .dependent_dofs import DependentDofs
from .ghost_penalty import GhostPenalty
from .joints import Joints

__all__ = ["joints_of", "stabilisation_of"]

#: Background nodes with weight over nodes of the bodies, from which on a background of degree 1
#: needs a penalty.
CROWDED = 0.9
KINDS = ("auto", "ghost", "aggregate")


def stabilisation_of(
    kind: str | None,
    bodies: Sequence[Particles],
    remove_dependent: bool = False,
    background: bool = False,
) -> Cure:
    """Return what is done about badly supported dofs.

    Args:
        kind: ``"ghost"``, ``"aggregate"``, ``None`` (nothing) or ``"auto"``: a ghost penalty
            for a background of degree 2 or more; for degree 1 only while the bodies have hardly
            more nodes than the background, for methods that move particles at their nodes, and
            unless one of the following is asked for.
        bodies: The bodies on one background space.
        remove_dependent: Whether dofs that others can stand in for are to be no unknowns.
        background: Whether there are terms on the background.

    Raises:
        MPMError: Something else, a method whose particles are not moved at their nodes, or two
            cures.
    """
    if kind is not None and not is_one_of(kind, KINDS):
        raise MPMError(
            f"Unknown stabilisation={kind!r}; choose {', '.join(map(repr, KINDS))} or None."
        )
    simple = bodies[0].V.ufl_element().degree == 1
    if simple and kind == "auto" and (remove_dependent or background):
        kind = None
    cure = _stabilisation(kind, bodies)
    if not remove_dependent:
        return Cure() if cure is None else cure
    if cure is not None or not simple:
        raise MPMError(
            "dependent_dofs='remove' is for a background of degree 1 without stabilisation; "
            "use dependent_dofs='shift'."
        )
    return DependentDofs(bodies)


def joints_of(kind: str | None, bodies: Sequence[Particles]) -> Joints | None:
    """Return what keeps the joints between bodies shut, by default with degree 1.

    Args:
        kind: As for :func:`stabilisation_of`.
        bodies: The bodies on one background space.
    """
    simple = bodies[0].V.ufl_element().degree == 1
    acts = kind == "auto" and simple and len(bodies) > 1
    return Joints(bodies) if acts and all(body.shares_nodes for body in bodies) else None


def _stabilisation(kind: str | None, bodies: Sequence[Particles]) -> Cure | None:
    if kind is None:
        return None
    least = CROWDED if kind == "auto" and bodies[0].V.ufl_element().degree == 1 else 0.0
    for body in bodies:
        if not body.moves_at_nodes:
            if least > 0.0:
                return None
            raise MPMError(
                f"stabilisation={kind!r} is for the methods 'cpdi2' and 'cpdi', not for "
                f"{body.method!r}; use stabilisation=None."
            )
    return Aggregation(bodies) if kind == "aggregate" else GhostPenalty(bodies, least)
