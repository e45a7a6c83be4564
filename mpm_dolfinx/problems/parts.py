# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Parts of a problem's system: contributions of bodies and of fields."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import ufl
from dolfinx import fem

from ..assembly.background_forms import BackgroundForms
from ..assembly.body_forms import BodyForms
from ..assembly.field_forms import FieldForms
from ..assembly.rules import data_at_points
from ..constitutive.points import MaterialPoints
from ..errors import MPMError
from ..particles.field import CarriedField, ParticleField
from ..particles.particles import Particles
from ..stabilisation.choice import joints_of, stabilisation_of
from ..system.body import ActingStress, BodyTerm, StepForce
from ..system.field import Field
from ..system.free_field import FreeField
from ..system.values import FormsTerm
from .arguments import by_space, require_background_fields, require_own_fields
from .solver import Solver

__all__ = ["Contribution", "Parts"]


class Contribution(NamedTuple):
    """Contribution of a body to the system.

    Attributes:
        residual: Form on the body mesh, or ``None``.
        tangent: Form on the body mesh; ``None`` is the residual's derivative.
        symmetric: Whether the tangent is symmetric.
        stress: Stress whose virtual work is not in the residual, or ``None``.
        points: The material at its points, of which that is.
        of_step: What among its forces may be of a whole step in time.
        static: Whether the body is in equilibrium at each step's end, in a motion of others.
    """

    residual: ufl.Form | None
    tangent: ufl.Form | None
    symmetric: bool
    stress: ActingStress | None = None
    points: MaterialPoints | None = None
    of_step: Sequence[StepForce] = ()
    static: bool = False


@dataclass(frozen=True)
class Parts:
    """Parts of a system, on the present meshes of the bodies.

    Args:
        bodies: The bodies.
        contributions: What each adds.
        fields: Unknowns besides displacements.
        residuals: Their residuals.
        background: Forms on the backgrounds, one, several or ``None``.
        solver: How the problem is solved.
        entity_maps: How body meshes are related to others that forms have Functions on.
        alternating: Fields that terms solve for in turn with these unknowns.
    """

    bodies: Sequence[Particles]
    contributions: Sequence[Contribution]
    fields: Sequence[ParticleField]
    residuals: Sequence[ufl.Form]
    background: Any
    solver: Solver
    entity_maps: Any = None
    alternating: Sequence[ParticleField] = ()

    @property
    def _known(self) -> list[ParticleField]:
        """All fields whose changes the forms of bodies feel."""
        return [*self.fields, *self.alternating]

    @property
    def _form_options(self) -> dict[str, Any]:
        """Options with which forms are compiled."""
        maps = {} if self.entity_maps is None else {"entity_maps": self.entity_maps}
        return {**self.solver.of_forms, **maps}

    def require_own_fields(self) -> None:
        """Raise an error where a form has unknowns of another body.

        Raises:
            MPMError: It has.
        """
        mapped = self.entity_maps is not None
        for number, given in enumerate(self.contributions):
            for form, what in ((given.residual, "residual R"), (given.tangent, "tangent J")):
                require_own_fields(form, number, self.bodies, what, self._known, mapped)

    def _moves(self, given: Contribution) -> bool:
        """Return whether the displacement of a body is an unknown."""
        return given.residual is not None or given.stress is not None or not self.residuals

    @property
    def moving(self) -> list[Particles]:
        """The bodies whose displacements are unknowns."""
        return [
            body
            for body, given in zip(self.bodies, self.contributions, strict=True)
            if self._moves(given)
        ]

    def body_terms(self) -> list[BodyTerm]:
        """Return the terms of bodies that move (collective)."""
        return [
            BodyTerm(
                body,
                BodyForms(
                    given.residual,
                    given.tangent,
                    body,
                    given.stress,
                    None if given.stress is None else given.stress.grouped,
                    [field for field in self._known if field.particles is body],
                    **self._form_options,
                ),
                given.stress,
                given.points,
                given.of_step,
                given.static,
            )
            for body, given in zip(self.bodies, self.contributions, strict=True)
            if self._moves(given)
        ]

    def field_terms(self) -> list[FormsTerm]:
        """Return the terms of unknowns besides displacements (collective)."""
        found: list[FormsTerm] = []
        for number, (body, given) in enumerate(zip(self.bodies, self.contributions, strict=True)):
            own = [
                (field, form)
                for field, form in zip(self.fields, self.residuals, strict=True)
                if field.particles is body
            ]
            for _, form in own:
                require_own_fields(form, number, self.bodies, "residual of a field", self.fields)
            if not own:
                continue
            fields = [field for field, _ in own]
            options = self._form_options
            forms = FieldForms(body, fields, given.residual, [form for _, form in own], **options)
            moving = body if self._moves(given) else None
            carried = [CarriedField(field) for field in fields]
            found.append(FormsTerm(moving, carried, forms, given.symmetric))
        return found

    def displacement_fields(self, bcs: Sequence[fem.DirichletBC], joints: bool) -> list[Field]:
        """Return the fields of displacement (collective).

        There is one for each background space, and after it one for the free nodes of each body.

        Args:
            bcs: Dirichlet conditions.
            joints: Whether joints between bodies may be kept shut.
        """
        groups = by_space(self.moving)
        kind = self.solver.stabilisation
        found: list[Field] = []
        for group, forms in zip(groups, self._on_backgrounds(groups), strict=True):
            host = Field(
                group,
                bcs,
                forms,
                stabilisation_of(kind, group, forms is not None),
                joints_of(kind, group) if joints else None,
            )
            free = [body.free_nodes for body in group if body.free_nodes is not None]
            found += [host, *(FreeField(nodes, host, bcs) for nodes in free)]
        return found

    def _on_backgrounds(
        self, groups: Sequence[Sequence[Particles]]
    ) -> list[BackgroundForms | None]:
        """Return the terms on each background space, by the space of their test functions.

        Args:
            groups: The bodies on each space.
        """
        own: list[list[Any]] = [[] for _ in groups]
        for form in self._background_forms:
            if not isinstance(form, ufl.Form):
                raise MPMError(f"background must be UFL forms, not {type(form).__name__}.")
            arguments = form.arguments()
            spaces = [argument.ufl_function_space() for argument in arguments]
            number = next((n for n, group in enumerate(groups) if group[0].V in spaces), 0)
            require_background_fields(form, groups[number])
            own[number].append(form)
        options = self._form_options
        return [
            BackgroundForms(sum(mine[1:], mine[0]), group[0], **options) if mine else None
            for mine, group in zip(own, groups, strict=True)
        ]

    @property
    def _background_forms(self) -> list[Any]:
        """The forms on backgrounds as a list."""
        given = self.background
        if given is None:
            return []
        return list(given) if isinstance(given, list | tuple) else [given]

    @property
    def _forms(self) -> list[ufl.Form]:
        """The forms on bodies."""
        pairs = [(given.residual, given.tangent) for given in self.contributions]
        return [*(form for pair in pairs for form in pair if form), *self.residuals]

    def constants(self) -> list[fem.Constant]:
        """Return the Constants of all forms, without loads of bodies."""
        loads = [constant for body in self.bodies for constant in (body.load, body.proportional)]
        return [
            constant
            for form in (*self._forms, *self._background_forms)
            for constant in form.constants()
            if not any(constant is load for load in loads)
        ]

    def data_at_points(self) -> set[fem.Function]:
        """Return Functions at quadrature points in the forms, without unknowns."""
        own = {function for field in self._known for function in (field, field.previous)}
        return set().union(*map(data_at_points, self._forms)) - own
