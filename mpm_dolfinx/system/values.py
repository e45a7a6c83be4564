# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Terms with unknowns besides displacements: pressures, temperatures and the like."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import cast, override

from petsc4py import PETSc

from ..assembly.field_forms import FieldForms
from ..particles.field import CarriedField
from ..particles.particles import Particles
from .term import Term

__all__ = ["FieldTerm", "FormsTerm"]


class FieldTerm(Term):
    """Term that couples a body's displacement and fields on it, which it commits and rolls back.

    In :attr:`bodies` the body comes first, where its displacement is an unknown, then the fields.

    Args:
        particles: The body, ``None`` where its displacement is no unknown.
        fields: Its fields.

    Attributes:
        fields: As given.
    """

    from_outside = False
    one_sided = False

    def __init__(self, particles: Particles | None, fields: Sequence[CarriedField]) -> None:
        super().__init__()
        own = () if particles is None else (particles,)
        self.bodies = cast("tuple[Particles, ...]", (*own, *fields))
        self.fields = list(fields)

    @override
    def commit(self) -> Callable[[], None]:
        before = [field.commit() for field in self.fields]

        def undo() -> None:
            for field, values in zip(self.fields, before, strict=True):
                field.restore(values)

        return undo

    @override
    def roll_back(self) -> None:
        for field in self.fields:
            field.roll_back()


class FormsTerm(FieldTerm):
    """Residuals in UFL of a body's fields, and what they and its displacement do to each other.

    The residual of the displacement itself, and its own block, are those of the body's
    :class:`~mpm_dolfinx.system.body.BodyTerm`.

    Args:
        particles: The body, ``None`` where its displacement is no unknown.
        fields: Its fields.
        forms: Their residuals and blocks.
        symmetric: Whether the whole tangent is symmetric.
    """

    def __init__(
        self,
        particles: Particles | None,
        fields: Sequence[CarriedField],
        forms: FieldForms,
        symmetric: bool,
    ) -> None:
        super().__init__(particles, fields)
        self._forms, self._symmetric = forms, symmetric
        self.follows_load = forms.follows_load
        self._first = 1 if particles is None else 0
        self._none: list[PETSc.Vec] = []
        if particles is not None:
            self._none.append(particles.T.createVecLeft())
            self._none[0].set(0.0)

    @property
    @override
    def symmetric(self) -> bool:
        return self._symmetric

    @override
    def begin(self) -> Sequence[PETSc.Vec]:
        self._forms.assemble_external()
        return [*self._none, *self._forms.external]

    @override
    def residuals(self) -> Sequence[PETSc.Vec]:
        return [*self._none, *self._forms.assemble_residuals()]

    @override
    def tangents(self) -> Mapping[tuple[int, int], PETSc.Mat]:
        first = self._first
        blocks = self._forms.assemble_tangents()
        return {(i - first, j - first): block for (i, j), block in blocks.items()}

    @override
    def absolute_contributions(self) -> Sequence[PETSc.Vec]:
        return [*self._none, *self._forms.absolute_contributions()]

    @override
    def load_derivative(self, order: int) -> tuple[Sequence[PETSc.Vec], float]:
        parts, size = self._forms.load_derivative(order)
        return [*self._none, *parts], size
