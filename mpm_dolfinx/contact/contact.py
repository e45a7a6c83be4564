# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Contact of bodies as a term of a problem."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, override

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError, not_with
from ..io.identity import same
from ..io.snapshot import Kept, Taken
from ..meshes.remesh import Column
from ..particles.particles import Particles
from ..reals import is_one_of
from ..system.term import Motion, PointMaterial, Term, Transfer
from .law import Friction
from .nitsche import require_stress
from .passes import Kept as KeptOnBody
from .passes import Maker, Passes, both
from .results import Results
from .surface import Surface

__all__ = ["Contact", "KeptContact"]

#: What the pressure is made of.
LAWS = ("penalty", "nitsche")


class Contact(Results):
    """Contact of bodies at points on their own facets, in one pass or in two.

    Args:
        surfaces: Facets of the bodies.
        friction: The law of friction.
        law: What the pressure is made of.
        modulus: Modulus of the bodies; ``None``: those of their materials.
        make: Makes passes; see :class:`Passes`.
        count: How many.

    Raises:
        MPMError: There is no such law.
    """

    movable = remeshable = True  # it goes with the facets of its bodies

    def __init__(
        self,
        surfaces: Sequence[Surface],
        friction: Friction,
        law: str,
        modulus: float | None,
        make: Maker,
        count: int = 1,
    ) -> None:
        if not is_one_of(law, LAWS):
            raise MPMError(f"law must be one of {', '.join(map(repr, LAWS))}, not {law!r}.")
        super().__init__([surface.particles for surface in surfaces])
        self._nitsche = self.takes_stress = law == "nitsche"
        self.friction = friction
        self.axisymmetric = surfaces[0].axisymmetric
        self._passes = Passes(surfaces, modulus, make, surfaces[0].what, self._nitsche)
        self._materials: Sequence[PointMaterial | None] = [None] * len(self.bodies)
        self._count, self._number = count, 0
        self._share = 1.0
        self._places: list[int] = []
        self._masses: Sequence[NDArray[np.float64]] = ()
        self._joins, self._gone = True, list[Contact]()

    # -- The problem ----------------------------------------------------------------------------

    @override
    def come_after(self, gone: Sequence[Term]) -> None:
        """Begin anew, but where points stuck to a contact that is gone.

        Points of that contact which touch this one in the same place stick to it.
        """
        every = [contact for term in gone for contact in getattr(term, "contacts", (term,))]
        self._joins = True
        self._gone = [contact for contact in every if isinstance(contact, Contact)]

    @override
    def take_part(
        self,
        number: int,
        bodies: Sequence[Particles],
        materials: Sequence[PointMaterial | None],
    ) -> None:
        self._number, self._share, self._masses = number, 1.0, ()
        self._places = [
            next(i for i, body in enumerate(bodies) if body is mine) for mine in self.bodies
        ]
        passes, mine = self._passes, [materials[place] for place in self._places]
        self._materials = mine
        if self._nitsche:
            for material in mine[: self._count]:
                require_stress(material, type(self).__name__)
        passes.settle(mine, self._joins)
        passes.take_stress(mine)
        passes.of_step(False)
        if self._joins:
            kept = [one for contact in self._gone if (one := self._held_by(contact)) is not None]
            if kept:
                every = kept[0]
                for other in kept[1:]:
                    every = [both(*pair) for pair in zip(every, other, strict=True)]
                passes.restore(every, mine)
            passes.require_apart()
            self._joins, self._gone = False, []

    def held(self) -> list[KeptOnBody] | None:
        """Return the kept columns of each body; ``None``: it belongs to no problem."""
        return self._passes.kept()

    def _held_by(self, before: Contact) -> list[KeptOnBody] | None:
        """Return the kept columns of one that is gone that this takes over; ``None``: nothing.

        Args:
            before: Any contact.
        """
        raise NotImplementedError

    @property
    @override
    def symmetric(self) -> bool:
        return self.friction.smooth and not self._of_step and not self._nitsche

    # -- A step ---------------------------------------------------------------------------------

    @override
    def begin(self) -> Sequence[PETSc.Vec]:
        self._passes.settle(self._materials)
        self._passes.begin()
        return ()

    @override
    def start(self, transfer: Transfer, prescribed: Motion) -> None:
        self._passes.start()

    @override
    def update(self) -> MPMError | None:
        self._passes.evaluate()
        return None

    @override
    def smooth(self) -> bool:
        """Return false: contact is not smooth."""
        return not self._passes.touch()

    @override
    def residuals(self) -> Sequence[PETSc.Vec]:
        return self._passes.forces(-1.0 / self._share)

    @override
    def tangents(self) -> Mapping[tuple[int, int], PETSc.Mat]:
        """Return tangents, with secants where points change their slip."""
        return self._passes.tangents(-1.0 / self._share, True)

    @override
    def derivatives(self) -> Mapping[tuple[int, int], PETSc.Mat]:
        return self._passes.tangents(-1.0 / self._share, False)

    @override
    def commit(self) -> Callable[[], None]:
        """Commit the step.

        Raises:
            ConvergenceError: A body has gone through another one, or through an obstacle.
        """
        return self._passes.commit()

    @override
    def roll_back(self) -> None:
        self._passes.roll_back()

    # -- In a motion ----------------------------------------------------------------------------

    @property
    def _of_step(self) -> bool:
        """Whether forces are those of whole steps of a motion."""
        return self._share < 1.0

    @override
    def pace(self, dt: float, share: float) -> None:
        """Begin a step of a motion, of which contact has one force, where others take means.

        Raises:
            MPMError: The forces of the scheme are no ones of a step's end, where those of the
                stress are.
        """
        if self._nitsche and share < 1.0:
            raise not_with(
                f"law='nitsche' of a {type(self).__name__}",
                "this scheme, to which forces of a step's end would add energy with each impact",
                "use scheme='euler', or law='penalty'",
            )
        self._share = share
        self._passes.of_step(self._of_step)
        if self._nitsche:
            surfaces = self._passes.surfaces
            more = [np.zeros(len(surface.thickness)) for surface in surfaces]
            if dt > 0.0 and self._masses:
                pairs = zip(surfaces, self._masses, strict=True)
                more = [_inertial(surface, masses, dt) for surface, masses in pairs]
            self._passes.add_stiffness(more)

    @override
    def weigh(self, masses: Sequence[NDArray[np.float64]]) -> None:
        self._masses = masses

    @override
    def end_forces(self) -> Sequence[PETSc.Vec]:
        return () if self._of_step else self.residuals()

    @override
    def step_work(self) -> tuple[float, float]:
        """Return the work of the step, of which that of friction counts as damping."""
        if not self._of_step:
            return 0.0, 0.0
        comm = self.bodies[0].mesh.comm
        normal, shear = comm.allreduce(np.array(self._passes.works()))
        return float(normal), float(shear)

    # -- What is kept -------------------------------------------------------------------------

    @override
    def kept(self) -> Sequence[Kept]:
        return [KeptContact(self, self.name or f"contact{self._number}")]

    def known_by(self) -> list[Any]:
        """Return the identity of the contact in a checkpoint, in types that JSON has."""
        return [type(self).__name__, self._places, LAWS[self._nitsche]]

    def numbers(self) -> dict[str, Any]:
        """Return the numbers kept besides columns; see :class:`Kept`."""
        return {}

    def columns(self, body: int | None) -> dict[str, Column]:
        """Return the columns kept on a body, by its number in the problem."""
        if body is None or body not in self._places:
            return {}
        return self._passes.columns(self._places.index(body))

    def take(self, taken: Taken) -> None:
        """Take what was kept (collective)."""
        self._passes.restore([taken.columns[place] for place in self._places], self._materials)


def _inertial(surface: Surface, masses: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
    """Return the stiffness in a step from the mass behind facets, shape ``(m,)``.

    That is the density times the height over the square of the step, as the modulus is over the
    height. The stress behind a facet is not on it by as much as that mass is accelerated: held
    by the modulus alone, a gap would be left there, and closed under another pressure.
    """
    area = surface.weights.sum(axis=1)
    mass = surface.layout.narrowing * masses[surface.layout.cells]
    degree = surface.particles.W.ufl_element().degree
    behind = np.where(area > 0.0, mass / np.where(area > 0.0, area, 1.0), 0.0)
    return np.asarray(behind / (degree * dt) ** 2)


class KeptContact(Kept):
    """Memory of a contact.

    Args:
        contact: The contact.
        key: See :class:`Kept`.
    """

    def __init__(self, contact: Contact, key: str) -> None:
        self._contact, self.key = contact, key

    @override
    def numbers(self) -> dict[str, Any]:
        return self._contact.numbers() | {"known by": self._contact.known_by()}

    @override
    def require(self, source: str, taken: Taken) -> None:
        there, here = taken.numbers.get("known by"), self._contact.known_by()
        if there is not None and not same(there, here):
            raise MPMError(
                f"{source} knows the contact {self.key!r} as {there}, and here it is {here}; give "
                "terms in the order in which they came, or with the same names (contact.name)."
            )
        super().require(source, taken)

    @override
    def columns(self, body: int | None) -> dict[str, Column]:
        return self._contact.columns(body)

    @override
    def restore(self, taken: Taken) -> None:
        self._contact.take(taken)
