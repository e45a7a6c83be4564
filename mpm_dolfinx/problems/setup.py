# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Setup of a problem with materials: bodies, and options that hold for all of them.

A problem is built from its setup and the present meshes of its bodies, at first and again whenever
these are other ones.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from ..boundary.supports import Support
from ..errors import MPMError, not_with
from ..parallel.given import require_truth
from ..particles.options import not_divisible
from ..particles.particles import Particles
from ..reals import is_one_of
from ..system.term import Term
from .body import Body, stays

__all__ = ["MIXED", "Setup"]

#: What may be an unknown beside displacements.
MIXED = ("pressure", "stabilised pressure")


@dataclass(frozen=True)
class Setup:
    """The bodies of a problem with materials, and what holds for all of them.

    Attributes:
        given: The bodies, as the user has given them.
        supports: Supports on the bodies' own boundaries.
        terms: What else acts on the bodies.
        axisymmetric: Whether ``x[0]`` is the radius of a body of revolution.
        mixed: What else is an unknown: ``None``, or one of ``MIXED``.
        bodies: The same bodies on the present meshes of their particles.

    Raises:
        MPMError: Something that there is not, or a term that takes the bodies for others.
    """

    given: tuple[Body, ...]
    supports: tuple[Support, ...] = ()
    terms: tuple[Term, ...] = ()
    axisymmetric: bool = False
    mixed: str | None = None
    bodies: tuple[Body, ...] = ()

    def __post_init__(self) -> None:
        """Say so where something is unknown."""
        if not self.bodies:
            object.__setattr__(self, "bodies", self.given)
        require_truth("axisymmetric", self.axisymmetric)
        if self.mixed is not None:
            self._require_mixed()
        for term in self.terms:
            if term.axisymmetric not in (None, self.axisymmetric):
                raise MPMError(
                    f"A {type(term).__name__} was made with axisymmetric={term.axisymmetric}, but "
                    f"the problem has axisymmetric={self.axisymmetric}; give both the same."
                )

    def _require_mixed(self) -> None:
        """Raise an error unless a pressure can be an unknown of all bodies."""
        if not is_one_of(self.mixed, MIXED):
            known = ", ".join(map(repr, MIXED))
            raise MPMError(f"Unknown mixed={self.mixed!r}; choose {known} or None.")
        for given in self.bodies:
            if given.f_bar != "none":
                raise not_with(
                    f"mixed={self.mixed!r}", "f_bar=", "it takes the place of f_bar; omit that"
                )
            body = given.particles
            degrees = [space.ufl_element().degree for space in (body.V, body.W)]
            if self.mixed == "stabilised pressure":
                if degrees != [1, 1]:
                    raise not_with(
                        "mixed='stabilised pressure'",
                        f"a background of degree {degrees[0]} and particles of degree {degrees[1]}",
                        "it is for degree 1; use mixed='pressure'",
                    )
                if body.V.mesh.topology.cell_name() not in ("quadrilateral", "hexahedron"):
                    raise MPMError(
                        "mixed='stabilised pressure' needs a background of quadrilaterals or "
                        "hexahedra: on triangles or tetrahedra it would oscillate, or nearly so; "
                        "use degree 2 with mixed='pressure' there."
                    )
            elif min(degrees) < 2:
                raise MPMError(
                    "mixed='pressure' needs a background and particles of degree 2 or 3 "
                    f"(degree=2), not {degrees[0]} and {degrees[1]}: with displacements of degree "
                    "1 the pressure would oscillate; use mixed='stabilised pressure' or "
                    "f_bar='patch' there."
                )

    def supports_of(self, particles: Particles) -> tuple[Support, ...]:
        """Return the supports of a body."""
        return tuple(s for s in self.supports if s.particles is particles)

    def with_bodies(self, *changed: Body) -> Setup:
        """Return the same with bodies in the place of those of the same particles.

        What a user has left as it was is as it is now on the present mesh.
        """
        given, bodies = list(self.given), list(self.bodies)
        for new in changed:
            place = next(i for i, old in enumerate(given) if old.particles is new.particles)
            bodies[place] = replace(bodies[place], **new.changed_from(given[place]))
            given[place] = new
        return replace(self, given=tuple(given), bodies=tuple(bodies))

    def carried(self) -> Setup:
        """Return the same on the present meshes of the particles (collective)."""
        return replace(self, bodies=tuple(body.carried() for body in self.bodies))

    def require_movable(self, consequence: str = "the particles cannot move") -> None:
        """Raise an error unless all bodies can be taken to other meshes.

        Args:
            consequence: What else cannot be.

        Raises:
            MPMError: Something lives on a present mesh.
        """
        for body in self.bodies:
            body.require_movable(consequence)
        self.require_no(self.supports, consequence)
        self.require_no((term for term in self.terms if not term.movable), consequence)

    def require_remeshable(self, consequence: str) -> None:
        """Raise an error unless all terms follow bodies that are split or rebased; see above."""
        self.require_no((term for term in self.terms if not term.remeshable), consequence)

    def require_no(self, staying: Iterable[Support | Term], consequence: str) -> None:
        """Raise an error where there is one that does not follow its body."""
        for one in staying:
            raise stays(f"A {type(one).__name__}", consequence)

    def require_divisible(self) -> None:
        """Raise an error unless domains may be split.

        Raises:
            MPMError: They may not.
        """
        self.require_movable("domains cannot be split")
        self.require_remeshable("domains cannot be split")
        averaged = any(body.f_bar != "none" or body.length is not None for body in self.bodies)
        if averaged or self.axisymmetric:
            raise not_divisible()
