# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Contact of two deformable bodies: points of one against facets of the other.

With two passes each body's points meet the other's facets, at half the stiffness each where facets
are alike in size, at more of it for the points of much finer ones. The reaction
acts on the facet as if the point were fixed to it by a rigid arm along its normal, so that forces
and moments of both bodies balance, also where friction acts at a gap.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, override

import numpy as np
from numpy.typing import NDArray

from dolfinx import mesh

from ..errors import MPMError
from ..parallel.boundary import collective
from ..parallel.given import as_positive
from ..particles.particles import Particles
from .contact import Contact
from .facet_pass import FacetPass
from .law import Friction, as_friction
from .passes import Kept
from .surface import Surface

__all__ = ["Pair"]

#: Ratio of the sizes of facets up to which two passes bear the same, and the least that one bears.
ALIKE, LEAST = 1.5, 0.2
#: Degree of the rule on a facet, by the dimension of space: the other body's facets have kinks.
DEGREES = {2: 9, 3: 5}


class Pair(Contact):
    """Contact of two bodies, each on a background of its own, with friction.

    Bodies on the same V stick where they touch; give them different ones, which may be made on the
    same mesh. Then they feel each other by contact alone, where their facets meet::

        touch = mpm.contact.Pair(a, b, friction=0.2)
        problem = mpm.QuasiStaticProblem(
            [mpm.Body(a, law), mpm.Body(b, law)], bcs, terms=[touch]
        )

    Points on the facets of each body meet the facets of the other, with the pressure of
    :class:`Rigid` for the stiffness of both bodies one behind the other.

    Args:
        a: A body; what the contact tells is told at its points first.
        b: The other body.
        friction: As for :class:`Rigid`.
        facets: For each body tags of its facets and the tag of those that may touch, ``(tags, 1)``,
            or ``None``: its whole boundary.
        passes: 2, or 1: points of a (best the body with the finer facets) against facets of b.
        penalty: As for :class:`Rigid`.
        axisymmetric: As there.
        law: As there: with ``"nitsche"`` each pass takes the stress of its own points' body.

    Raises:
        MPMError: What makes no sense.
    """

    @collective()
    def __init__(
        self,
        a: Particles,
        b: Particles,
        friction: float | Friction = 0.0,
        *,
        facets: Sequence[tuple[mesh.MeshTags, int] | None] = (None, None),
        passes: int = 2,
        penalty: float = 1.0,
        axisymmetric: bool = False,
        law: str = "penalty",
    ) -> None:
        for body in (a, b):
            if not isinstance(body, Particles):
                raise MPMError(f"A contact needs mpm.Particles, not {type(body).__name__}.")
        if a is b:
            raise MPMError(
                "A Pair needs two bodies, not the same one twice: places of one body that are in "
                "one cell of its V move together and never meet. Cut the body in two where it is "
                "to touch itself, with a V for each part, and tie them where they hang together."
            )
        if a.V is b.V:
            raise MPMError(
                "The bodies of a Pair are on the same V, which makes them stick; give each its "
                "own, such as a second function space on the same mesh."
            )
        if isinstance(passes, bool) or passes not in (1, 2):
            raise MPMError(f"A Pair has 1 or 2 passes, not {passes!r}.")
        if not isinstance(facets, list | tuple) or len(facets) != 2:
            raise MPMError(f"facets= of a Pair must be two, one for each body, not {facets!r:.80}.")
        self._penalty = as_positive(penalty, "penalty")
        degree = DEGREES[a.mesh.geometry.dim]
        surfaces = [
            Surface(body, some, degree, axisymmetric, "A Pair")
            for body, some in zip((a, b), facets, strict=True)
        ]
        super().__init__(surfaces, as_friction(friction), law, None, self._made, passes)

    def _made(self, stiffnesses: Sequence[NDArray[np.float64]]) -> list[FacetPass]:
        """Return its passes."""
        surfaces, k = self._passes.surfaces, stiffnesses
        shares = _shares(surfaces, self._count)
        return [
            FacetPass(
                surfaces[i],
                surfaces[1 - i],
                self.friction,
                self._penalty,
                (k[i], k[1 - i]),
                share,
            )
            for i, share in enumerate(shares)
        ]

    @override
    def _held_by(self, before: Contact) -> list[Kept] | None:
        if not isinstance(before, Pair) or set(before.bodies) != set(self.bodies):
            return None
        kept = before.held()
        if kept is not None and before.bodies != self.bodies:
            kept = kept[::-1]
        return kept if kept is not None and self._passes.fits(kept) else None

    @override
    def known_by(self) -> list[Any]:
        return [*super().known_by(), self._count]


def _shares(surfaces: Sequence[Surface], count: int) -> list[float]:
    """Return the share of the load that each pass bears (collective).

    Points on facets of a size h see kinks of the other body's shape functions with an error of the
    order of h^2, so that the points of facets that are much finer bear more.
    """
    if count == 1:
        return [1.0]
    squares = [surface.size**2 for surface in surfaces]
    if max(squares) < ALIKE**2 * min(squares):
        return [0.5, 0.5]
    first = float(np.clip(squares[1] / sum(squares), LEAST, 1.0 - LEAST))
    return [first, 1.0 - first]
