# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Parts of a problem's system: contributions of bodies and of fields."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem

from ..assembly.background_forms import BackgroundForms
from ..assembly.body_forms import BodyForms
from ..assembly.field_forms import FieldForms
from ..assembly.rules import data_at_points
from ..boundary.supports import Support
from ..constitutive.points import MaterialPoints
from ..errors import MPMError
from ..parallel.compilation import compiled_form
from ..particles.field import CarriedField, ParticleField
from ..particles.particles import Particles
from ..particles.undeformed import separate_nodes
from ..stabilisation.choice import joints_of, stabilisation_of
from ..system.body import ActingStress, BodyTerm, StepForce
from ..system.field import Field
from ..system.free_field import FreeField
from ..system.values import FieldTerm, FormsTerm
from .arguments import by_space, require_background_fields, require_own_fields
from .solver import Solver

__all__ = ["Built", "Contribution", "Parts"]


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
        supports: The supports among its forces.
        loads: Constants and Functions of its loads, which a user may change.
        mass: The integral of its density times a product of functions, if it has a density.
        couplings: Terms that have unknowns besides its displacement.
        words: Describes its material and its loads.
    """

    residual: ufl.Form | None
    tangent: ufl.Form | None
    symmetric: bool
    stress: ActingStress | None = None
    points: MaterialPoints | None = None
    of_step: Sequence[StepForce] = ()
    static: bool = False
    supports: Sequence[Support] = ()
    loads: Sequence[fem.Constant | fem.Function] = ()
    mass: Callable[[Any], ufl.Form] | None = None
    couplings: Sequence[FieldTerm] = ()
    words: Callable[[], str] = lambda: "residual in UFL"


@dataclass(frozen=True)
class Built:
    """A problem on the present meshes of its bodies.

    Attributes:
        bodies: The bodies.
        contributions: What each adds to the system.
        body_terms: What each is made of and loaded by, where it moves.
        field_terms: Terms that have unknowns besides displacements.
        constants: Constants of all forms, without loads of bodies.
        data: Functions at quadrature points in the forms, without unknowns.
        form_options: Options with which forms are compiled.
    """

    bodies: Sequence[Particles]
    contributions: Sequence[Contribution]
    body_terms: list[BodyTerm]
    field_terms: Sequence[FieldTerm]
    constants: list[fem.Constant]
    data: set[fem.Function]
    form_options: dict[str, Any]

    @property
    def carried(self) -> list[CarriedField]:
        """The unknowns besides displacements, as the system moves them."""
        return [one for term in self.field_terms for one in term.fields]

    @property
    def points(self) -> list[MaterialPoints]:
        """The materials at the points of each body."""
        return [given.points for given in self.contributions if given.points is not None]

    @property
    def supports(self) -> list[Support]:
        """The supports that hold, but for those that a residual in UFL has."""
        return [support for given in self.contributions for support in given.supports]

    @property
    def loads(self) -> list[fem.Constant | fem.Function]:
        """The loads that the load factor multiplies and the user may change, if known."""
        return [load for given in self.contributions for load in given.loads]

    @property
    def words(self) -> list[str]:
        """A description of each body: its material and its loads."""
        return [given.words() for given in self.contributions]

    def mass_matrices(self, number: int, ratio: Any = None) -> NDArray[np.float64]:
        """Return ``int density ratio Q_c Q_d dX`` of each owned domain, ``(n, k, k)`` (collective).

        Args:
            number: Number of the body.
            ratio: UFL; ``None``: that of the mass per volume of its mesh to the density.
        """
        form = self._mass_forms[number] if ratio is None else self._mass_form(number, ratio)
        assert form is not None
        matrix = fem.assemble_matrix(form)
        body = self.bodies[number]
        n, k = body.num_local, body.W.dofmap.list.shape[1]
        return np.array(matrix.data[: n * k * k].reshape(n, k, k))

    @cached_property
    def _mass_forms(self) -> list[fem.Form | None]:
        """Forms of the masses of bodies, where these are known (collective)."""
        return [
            None if given.mass is None else self._mass_form(number, body.undeformed.mass_ratio)
            for number, (given, body) in enumerate(
                zip(self.contributions, self.bodies, strict=True)
            )
        ]

    def _mass_form(self, number: int, ratio: Any) -> fem.Form:
        """Compile the form of the mass of a body (collective)."""
        mass = self.contributions[number].mass
        assert mass is not None
        space = separate_nodes(self.bodies[number].W)
        product = ufl.TrialFunction(space) * ufl.TestFunction(space)
        return compiled_form(mass(ratio * product), **self.form_options)

    def masses(self, number: int) -> NDArray[np.float64] | None:
        """Return the mass of each particle of a body that this rank owns, if it is known."""
        known = self.contributions[number].mass is not None
        return self.mass_matrices(number).sum(axis=(1, 2)) if known else None


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

    def field_terms(self) -> list[FieldTerm]:
        """Return the terms of unknowns besides displacements (collective)."""
        found = [term for given in self.contributions for term in given.couplings]
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

    def built(self) -> Built:
        """Return the terms of the problem, and what else is known of its forms (collective)."""
        self.require_own_fields()
        for form in self._background_forms:
            if not isinstance(form, ufl.Form):
                raise MPMError(f"background must be UFL forms, not {type(form).__name__}.")
        loads = [constant for body in self.bodies for constant in (body.load, body.proportional)]
        constants = [
            constant
            for form in (*self._forms, *self._background_forms)
            for constant in form.constants()
            if not any(constant is load for load in loads)
        ]
        own = {function for field in self._known for function in (field, field.previous)}
        data = set().union(*map(data_at_points, self._forms)) - own
        return Built(
            self.bodies,
            self.contributions,
            self.body_terms(),
            self.field_terms(),
            constants,
            data,
            self.solver.of_forms,
        )
