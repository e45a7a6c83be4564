# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Common part of all contacts: stiffness, memory, output."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, override

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError, agree
from ..io.identity import same
from ..io.snapshot import Kept, Taken
from ..meshes.remesh import Column
from ..particles.particles import Particles
from ..reals import as_finite, is_one_of
from ..system.term import PointMaterial, Term
from .law import Friction
from .surface import Surface

__all__ = ["Contact", "Outcome", "require_apart", "stiffness"]

#: What the pressure is made of.
LAWS = ("penalty", "nitsche")
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


class Contact(Term):
    """Contact of bodies at points on their own facets.

    Args:
        bodies: The bodies.
        friction: The law of friction.
        axisymmetric: Whether ``x[0]`` is a radius.
        law: What the pressure is made of.

    Raises:
        MPMError: There is no such law.
    """

    movable = remeshable = True  # it goes with the facets of its bodies

    def __init__(
        self, bodies: Sequence[Particles], friction: Friction, axisymmetric: bool, law: str
    ) -> None:
        if not is_one_of(law, LAWS):
            raise MPMError(f"law must be one of {', '.join(map(repr, LAWS))}, not {law!r}.")
        super().__init__(bodies)
        self._nitsche = self.takes_stress = law == "nitsche"
        self.friction = friction
        self.axisymmetric = axisymmetric
        self._materials: Sequence[PointMaterial | None] = [None] * len(self.bodies)
        self._number = 0
        self._share = 1.0
        self._places: list[int] = []
        self._masses: Sequence[NDArray[np.float64]] = ()
        self._joins, self._gone = True, list[Contact]()

    @property
    def contacts(self) -> Sequence[Contact]:
        """The contacts that it consists of: itself."""
        return (self,)

    @override
    def come_after(self, gone: Sequence[Term]) -> None:
        """Begin anew, but where points stuck to a contact that is gone.

        Points of that contact which touch this one in the same place stick to it.
        """
        self._joins = True
        self._gone = [contact for term in gone for contact in getattr(term, "contacts", ())]

    def _has_joined(self) -> None:
        """Note that it has begun: there is nothing of other contacts to take over any more."""
        self._joins, self._gone = False, []

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
        self._materials = [materials[place] for place in self._places]

    @property
    @override
    def symmetric(self) -> bool:
        return self.friction.smooth and not self._of_step and not self._nitsche

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
            raise MPMError(
                f"law='nitsche' of a {type(self).__name__} has forces of a step's end, and would "
                "add energy with each impact in this scheme; use scheme='euler', or law='penalty'."
            )
        self._share = share

    @override
    def weigh(self, masses: Sequence[NDArray[np.float64]]) -> None:
        self._masses = masses

    def _inertial(self, body: int, surface: Surface, dt: float) -> NDArray[np.float64]:
        """Return the stiffness in a step from the mass behind facets, shape ``(m,)``.

        That is the density times the height over the square of the step, as the modulus is over the
        height. The stress behind a facet is not on it by as much as that mass is accelerated: held
        by the modulus alone, a gap would be left there, and closed under another pressure.
        """
        if not (self._nitsche and self._masses and dt > 0.0):
            return np.zeros(len(surface.layout.cells))
        area = surface.weights.sum(axis=1)
        mass = surface.layout.narrowing * self._masses[body][surface.layout.cells]
        degree = surface.particles.W.ufl_element().degree
        behind = np.where(area > 0.0, mass / np.where(area > 0.0, area, 1.0), 0.0)
        return np.asarray(behind / (degree * dt) ** 2)

    @override
    def end_forces(self) -> Sequence[PETSc.Vec]:
        return () if self._of_step else self.residuals()

    @override
    def step_work(self) -> tuple[float, float]:
        """Return the work of the step, of which that of friction counts as damping."""
        if not self._of_step:
            return 0.0, 0.0
        normal, shear = self._comm.allreduce(np.array(self._works()))
        return float(normal), float(shear)

    def _works(self) -> tuple[float, float]:
        """Return this rank's work against pressure and against friction in the last step."""
        raise NotImplementedError

    @property
    def _comm(self) -> MPI.Comm:
        comm: MPI.Comm = self.bodies[0].mesh.comm
        return comm

    # -- What is kept -------------------------------------------------------------------------

    @override
    def kept(self) -> Sequence[Kept]:
        return [self.remembered(self.name or f"contact{self._number}")]

    def remembered(self, key: str) -> Kept:
        """Return the memory of the contact, under the given key."""
        return _Anchors(self, key)

    def known_by(self) -> list[Any]:
        """Return the identity of the contact in a checkpoint, in types that JSON has."""
        raise NotImplementedError

    def numbers(self) -> dict[str, Any]:
        """Return the numbers kept besides columns; see :class:`Kept`."""
        return {}

    def columns(self, body: int | None) -> dict[str, Column]:
        """Return the columns kept on a body, by its number in the problem."""
        raise NotImplementedError

    def take(self, taken: Taken) -> None:
        """Take what was kept (collective)."""
        raise NotImplementedError

    # -- What it tells, at the last converged step ---------------------------------------------

    def _outcome(self) -> tuple[Surface, Outcome]:
        """Return the outcome of the last converged step."""
        raise NotImplementedError

    @property
    def points(self) -> NDArray[np.float64]:
        """Positions of this rank's points, shape ``(n, gdim)``."""
        surface, outcome = self._outcome()
        return outcome.positions.reshape(-1, surface.gdim)

    @property
    def gap(self) -> NDArray[np.float64]:
        """Gap at this rank's points, negative where they penetrate, shape ``(n,)``."""
        return self._outcome()[1].gap.ravel()

    @property
    def pressure(self) -> NDArray[np.float64]:
        """Pressure per undeformed area at this rank's points, shape ``(n,)``."""
        return self._outcome()[1].pressure.ravel()

    @property
    def traction(self) -> NDArray[np.float64]:
        """Traction on the body per undeformed area at this rank's points, shape ``(n, gdim)``."""
        surface, outcome = self._outcome()
        return outcome.traction.reshape(-1, surface.gdim)

    @property
    def area(self) -> NDArray[np.float64]:
        """Undeformed area of this rank's points, shape ``(n,)``."""
        return np.array(self._outcome()[0].weights.ravel())

    @property
    def touches(self) -> NDArray[np.bool_]:
        """Whether each of this rank's points is in contact, shape ``(n,)``."""
        return self._outcome()[1].inside.ravel()

    @property
    def sticks(self) -> NDArray[np.bool_]:
        """Whether each of this rank's points is in contact and does not slip, shape ``(n,)``."""
        outcome = self._outcome()[1]
        return (outcome.inside & ~outcome.slips).ravel()

    @property
    def friction_memory(self) -> NDArray[np.float64]:
        """Memory of the law of friction at this rank's points, shape ``(n, k)``."""
        raise NotImplementedError

    @property
    def reaction(self) -> NDArray[np.float64]:
        """Force on the (first) body, shape ``(gdim,)``, on all ranks (collective)."""
        mine = self.area @ self.traction
        return np.asarray(self._comm.allreduce(mine))

    def moment(self, about: Any) -> NDArray[np.float64]:
        """Return the moment of the tractions about a point (collective).

        Args:
            about: Shape ``(gdim,)``.

        Returns:
            Shape ``(1,)`` in the plane, or ``(3,)``, on all ranks.
        """
        return self._moment([self.points], [self.area[:, None] * self.traction], about)

    def _moment(
        self,
        points: Sequence[NDArray[np.float64]],
        forces: Sequence[NDArray[np.float64]],
        about: Any,
    ) -> NDArray[np.float64]:
        """Return the moment of forces at points of this rank, summed over ranks (collective)."""
        gdim = self.bodies[0].mesh.geometry.dim
        centre = as_finite(about, gdim)
        if centre is None:
            raise MPMError(f"A moment is about {gdim} coordinates, not {about!r}.")
        parts = [cross(x - centre, f).sum(axis=0) for x, f in zip(points, forces, strict=True)]
        return np.asarray(self._comm.allreduce(np.atleast_1d(np.sum(parts, axis=0))))


class _Anchors(Kept):
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


def cross(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    """Return the vector product of rows; in the plane its one component."""
    if a.shape[-1] == 3:
        return np.cross(a, b)
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def stiffness(
    surface: Surface, modulus: float | None, material: PointMaterial | None, what: str
) -> NDArray[np.float64]:
    """Return modulus over height of the domain behind each facet, shape ``(m,)`` (collective).

    The height is over the square of the degree of the shape functions: so much stiffer is a
    domain against what acts on its surface.

    Args:
        surface: The facets.
        modulus: The modulus, if it is given.
        material: The material otherwise.
        what: What needs it.

    Raises:
        MPMError: It is not known, or not positive.
    """
    if modulus is None and material is None:
        raise MPMError(
            f"{what} needs modulus=, since no material says how stiff the body is; give the "
            "confined modulus (lambda + 2 mu) or its like."
        )
    if modulus is not None:
        moduli = np.full(len(surface.layout.cells), modulus)
    else:
        assert material is not None
        moduli = material.initial_modulus()[surface.layout.cells]
    with agree(surface.particles.mesh.comm):
        if not (np.isfinite(moduli).all() and (moduli > 0.0).all()):
            raise MPMError(f"{what} needs a positive modulus of the material at all its facets.")
    degree = surface.particles.W.ufl_element().degree
    return np.asarray(degree**2 * moduli / surface.thickness)
