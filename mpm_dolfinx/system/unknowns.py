# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The unknowns of a step, of all fields and of terms' own, and how they move bodies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..particles.field import CarriedField
from ..particles.particles import Particles
from .field import Field, Motion
from .free_field import Subspace
from .numbering import Numbering
from .own import OwnUnknowns
from .value_field import ValueField

__all__ = ["Unknowns"]

type Body = Particles | CarriedField


class Unknowns:
    """The unknowns of all fields and of terms of their own. All calls are collective.

    Args:
        bodies: All bodies, in the problem's order, then their other fields.
        fields: The background spaces that move them, those of values last.
        own: The unknowns that terms have of their own.

    Attributes:
        bodies: As given.
        fields: As given.
        own: As given.
        comm: The ranks.
        values: The fields that are no displacements.
        blocks: Fields and terms' own unknowns, in the order of their numbers.
        places: The field that moves each of the bodies first, and how.
        subspaces: The fields, each background with the free nodes of its bodies.
        numbering: Their present numbers; ``None`` until they are found.
    """

    def __init__(
        self, bodies: Sequence[Body], fields: Sequence[Field], own: Sequence[OwnUnknowns]
    ) -> None:
        self.bodies, self.fields, self.own = list(bodies), list(fields), list(own)
        self.comm: MPI.Comm = self.fields[0].V.mesh.comm
        self.values = [field for field in self.fields if isinstance(field, ValueField)]
        moving = len(self.fields) - len(self.values)
        self.blocks: list[Field | OwnUnknowns] = [
            *self.fields[:moving],
            *self.own,
            *self.fields[moving:],
        ]
        motions = [(field, motion) for field in fields for motion in field.motions]
        self._ways = [[way for way in motions if way[1].particles is body] for body in bodies]
        self.places = [ways[0] for ways in self._ways]
        self.subspaces = Subspace.all_of(fields)
        self.numbering: Numbering | None = None
        self._last: Numbering | None = None
        self._transfers: dict[int, PETSc.Mat] = {}
        self._found_by: list[Any] = []

    # -- Bodies -----------------------------------------------------------------------------------

    def place(self, body: Body) -> tuple[Field, Motion]:
        """Return the field of the background that moves a body, and how."""
        return next(place for place in self.places if place[1].particles is body)

    def ways(self, body: Body) -> list[tuple[Field, Motion]]:
        """Return all fields that move a body, and how: each other nodes; none where it stays."""
        found = (ways for ways in self._ways if ways[0][1].particles is body)
        return next(found, [])

    def moved(self, body: Body, increments: Sequence[PETSc.Vec]) -> PETSc.Vec:
        """Return how increments of the fields move a body, on its W.

        Args:
            body: The body.
            increments: On all dofs of each V.
        """
        moved = [
            motion.of(increments[self.fields.index(field)]) for field, motion in self.ways(body)
        ]
        if not moved:
            moved.append(body.T.createVecLeft())
            moved[0].set(0.0)
        for other in moved[1:]:
            moved[0].axpy(1.0, other)
        return moved[0]

    def prescribed(self, body: Particles) -> PETSc.Vec | None:
        """Return how the step's Dirichlet values move a body, ``None``: not at all."""
        if not any(field.prescribed.changes for field, _ in self.ways(body)):
            return None
        return self.moved(body, [field.lift() for field in self.fields]).copy()

    def driven(self, body: Particles, values: Sequence[NDArray[np.float64]]) -> PETSc.Vec:
        """Return how values at the fixed dofs of each V move a body."""
        driven = [field.driven(own) for field, own in zip(self.fields, values, strict=True)]
        return self.moved(body, driven).copy()

    def increments(self) -> list[NDArray[np.float64]]:
        """Return the last change of displacement of each body, on this rank's own dofs of W."""
        return [motion.increment() for _, motion in self.places]

    @property
    def moduli(self) -> list[float | None] | None:
        """Shear modulus of each body at the first step with a ghost penalty; ``None`` before."""
        found: list[float | None] = []
        for field, motion in self.places:
            number = field.motions.index(motion)
            found.append(None if field.acting.moduli is None else field.acting.moduli[number])
        return None if all(modulus is None for modulus in found) else found

    @moduli.setter
    def moduli(self, values: Sequence[float | None] | None) -> None:
        every = [None] * len(self.places) if values is None else values
        for field in self.fields:
            own = [
                value
                for value, (its, _) in zip(every, self.places, strict=True)
                if its is field and value is not None
            ]
            field.acting.moduli = own or None

    # -- Numbers ----------------------------------------------------------------------------------

    def find(self) -> Numbering:
        """Find and number the unknowns with the present transfers.

        Returns:
            The numbers; the same object where all unknowns are those of before.
        """
        free = [block.find() for block in self.blocks]
        self._found_by = self._by
        if self._last is not None and self._last.is_of(free):
            self.numbering = self._last
            return self._last
        numbering = self.numbering = self._last = Numbering(self.comm, free)
        parts = zip(self.blocks, numbering.parts, numbering.numbers, strict=True)
        for block, part, numbers in parts:
            block.number(part, numbers, numbering.sizes)
        self._transfers = {}
        return numbering

    @property
    def _by(self) -> list[Any]:
        return [motion.particles.node_basis for _, motion in self.places]

    def follow(self) -> None:
        """Forget the unknowns where they were found by other rows of T than the present ones."""
        pairs = zip(self._found_by, self._by, strict=False)
        if self.numbering is not None and any(one is not other for one, other in pairs):
            self.forget()

    def forget(self) -> None:
        """Forget the unknowns."""
        self.numbering = None
        self._found_by = []
        for field in self.fields:
            field.forget()

    def vector(self) -> PETSc.Vec:
        """Return a vector of all unknowns, zero."""
        assert self.numbering is not None
        return self.numbering.vector()

    @property
    def sizes(self) -> tuple[int, int]:
        """Number of unknowns of this rank and of all ranks."""
        assert self.numbering is not None
        return self.numbering.sizes

    @property
    def parts(self) -> list[slice]:
        """Where each of :attr:`blocks` is among this rank's unknowns."""
        return [block.part for block in self.blocks]

    @property
    def displacements(self) -> slice:
        """Where displacements are among this rank's unknowns, with terms' own; they come first."""
        moving = [block.part.stop for block in self.blocks if not isinstance(block, ValueField)]
        return slice(0, max(moving, default=0))

    def transfer(self, body: Body) -> PETSc.Mat:
        """Return T of a body in all unknowns, the same object through a step."""
        first, *others = [motion.free_T(field.prolongation) for field, motion in self.ways(body)]
        if not others:
            return first
        if id(body) not in self._transfers:
            for other in others:
                first = first + other
            self._transfers[id(body)] = first
        return self._transfers[id(body)]

    # -- Forces -----------------------------------------------------------------------------------

    @property
    def forces(self) -> list[PETSc.Vec]:
        """The residual on all dofs of each V that was evaluated last: at supports, their force."""
        return [field.force for field in self.fields]

    def zeros(self) -> list[PETSc.Vec]:
        """Return a vector on all dofs of each V, zero."""
        vectors = [force.duplicate() for force in self.forces]
        for vector in vectors:
            vector.set(0.0)
        return vectors

    def add(
        self, bodies: Sequence[Body], vectors: Sequence[PETSc.Vec], to: Sequence[PETSc.Vec]
    ) -> None:
        """Add ``T^T`` times vectors on bodies to vectors on all dofs of each V.

        Args:
            bodies: Some bodies.
            vectors: On W of each, or nothing.
            to: What is added to.
        """
        if not vectors:
            return
        for body, vector in zip(bodies, vectors, strict=True):
            for field, motion in self.ways(body):
                target = to[self.fields.index(field)]
                motion.action.multTransposeAdd(vector, target, target)

    def at_nodes(self, bodies: Sequence[Body], vectors: Sequence[PETSc.Vec]) -> PETSc.Vec:
        """Return unknowns that have the values of vectors on bodies where they are these' nodes.

        Args:
            bodies: Some bodies.
            vectors: On W of each.

        Returns:
            Zero at all other unknowns.
        """
        found = self.vector()
        for body, vector in zip(bodies, vectors, strict=True):
            for field, _ in self.ways(body):
                if field.V is body.W:
                    field.collect(vector, found)
        return found

    def restricted(self, forces: Sequence[PETSc.Vec]) -> PETSc.Vec:
        """Return vectors on all dofs of each V at the unknowns."""
        reduced = self.vector()
        for field, force in zip(self.fields, forces, strict=True):
            field.collect(force, reduced)
        return reduced

    def functional(self, body: Particles, row: PETSc.Vec) -> PETSc.Vec:
        """Return the coefficients on the unknowns of a functional on a body's W."""
        totals = self.zeros()
        self.add([body], [row], totals)
        return self.restricted(totals)
