# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Residuals of several unknowns on one body, and the blocks of their tangent."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from petsc4py import PETSc

import numpy as np

import ufl
from dolfinx import fem
from dolfinx.fem import petsc as fem_petsc

from ..errors import MPMError
from ..parallel.compilation import compiled_form
from ..particles.field import ParticleField
from ..particles.particles import Particles
from .expansion import expanded
from .petsc import assemble_into, assemble_matrix, create_vector, load_quotient
from .rules import couples_cells, follows, parts_with, split_by_rule

__all__ = ["FieldForms"]


class FieldForms:
    """The residuals of a body's fields, and all blocks of the tangent but that of its displacement.

    The unknowns are numbered: 0 is the displacement, then the fields follow. Blocks are derivatives
    of the residuals; those that vanish are left out.

    Args:
        particles: The body.
        fields: Its fields.
        R: Residual of the displacement, ``None`` where that is no unknown.
        residuals: Residual of each field, with a test function of its ``W``.
        **options: Passed on to ``dolfinx.fem.form``.

    Attributes:
        external: The parts of each field's residual that stay through a step.
        follows_load: Whether what the load factor does depends on the unknowns.

    Raises:
        MPMError: A form with other arguments, over interior facets, or without its unknowns.
    """

    def __init__(
        self,
        particles: Particles,
        fields: Sequence[ParticleField],
        R: ufl.Form | None,
        residuals: Sequence[ufl.Form],
        **options: Any,
    ) -> None:
        self._options, self._particles, self._fields = options, particles, list(fields)
        unknowns = [particles.displacement, *fields]
        parts = [[] if R is None else self._present(split_by_rule(R, *unknowns))]
        for field, residual in zip(fields, residuals, strict=True):
            named, where = f"the residual of '{field.name}'", "the field's W"
            own_parts = parts_with(field.W, residual, 1, named, where, *unknowns)
            parts.append(self._present(own_parts))
        if any(couples_cells(part) for own in parts[1:] for part in own):
            raise MPMError("The residual of a field cannot be integrated over interior facets.")
        self._parts = parts[1:]
        self._live, self._dead = [], []
        self._loaded: list[list[fem.Form]] = []
        self.follows_load = False
        for own in self._parts:
            compiled = [(part, compiled_form(part, **options)) for part in own]
            self._live.append([form for part, form in compiled if follows(part, *unknowns)])
            self._dead.append([form for part, form in compiled if not follows(part, *unknowns)])
            loaded = [(part, form) for part, form in compiled if self._has_load(part)]
            self._loaded.append([form for _, form in loaded])
            self.follows_load |= any(follows(part, *unknowns) for part, _ in loaded)
        self._vectors = [create_vector(field.W) for field in fields]
        self.external = [create_vector(field.W) for field in fields]
        self._blocks = self._tangents(parts, unknowns, R is not None)
        for number, field in enumerate(fields, start=1):
            if not any(number in pair for pair in self._blocks):
                raise MPMError(f"No residual depends on the field '{field.name}'.")
        self._matrices: dict[tuple[int, int], PETSc.Mat] = {}
        self._broken: list[tuple[list[fem.Form], PETSc.Vec] | None] = [None] * len(self._fields)

    def _present(self, parts: list[ufl.Form]) -> list[ufl.Form]:
        deletion = self._particles.deletion
        return parts if deletion is None else [deletion.present_only(part) for part in parts]

    def _has_load(self, part: ufl.Form) -> bool:
        return any(constant is self._particles.load for constant in part.constants())

    def _tangents(
        self, parts: list[list[ufl.Form]], unknowns: list[fem.Function], moves: bool
    ) -> dict[tuple[int, int], list[fem.Form]]:
        """Return the compiled blocks that do not vanish."""
        found: dict[tuple[int, int], list[fem.Form]] = {}
        for i, own in enumerate(parts):
            for j, unknown in enumerate(unknowns):
                if (i == 0 and j == 0) or (j == 0 and not moves):
                    continue
                trial = ufl.TrialFunction(unknown.function_space)
                forms = [expanded(ufl.derivative(part, unknown, trial)) for part in own]
                forms = [form for form in forms if not form.empty()]
                if forms:
                    found[i, j] = [compiled_form(form, **self._options) for form in forms]
        return found

    def _space(self, number: int) -> fem.FunctionSpace:
        return self._particles.W if number == 0 else self._fields[number - 1].W

    def _matrix(self, pair: tuple[int, int]) -> PETSc.Mat:
        """Return the matrix of a block, with all entries that two dofs of a cell may have."""
        if pair not in self._matrices:
            test = ufl.TestFunction(self._space(pair[0]))
            trial = ufl.TrialFunction(self._space(pair[1]))
            product = _component(test) * _component(trial) * self._particles.dx
            form = compiled_form(product, **self._options)
            self._matrices[pair] = fem_petsc.create_matrix(form)
        return self._matrices[pair]

    def assemble_external(self) -> None:
        """Assemble what does not depend on the unknowns (collective)."""
        for vector, forms in zip(self.external, self._dead, strict=True):
            assemble_into(vector, forms)

    def assemble_residuals(self) -> list[PETSc.Vec]:
        """Assemble each field's residual; external parts are those of ``assemble_external``."""
        for vector, forms, external in zip(self._vectors, self._live, self.external, strict=True):
            assemble_into(vector, forms)
            vector.axpy(1.0, external)
        return self._vectors

    def assemble_tangents(self) -> dict[tuple[int, int], PETSc.Mat]:
        """Assemble the blocks; each is always the same object (collective)."""
        for pair, forms in self._blocks.items():
            matrix = self._matrix(pair)
            matrix.zeroEntries()
            for form in forms:
                assemble_matrix(matrix, form)
            matrix.assemble()
        return {pair: self._matrix(pair) for pair in self._blocks}

    def absolute_contributions(self) -> list[PETSc.Vec]:
        """Return sums of absolute values of what the domains add to each field's residual."""
        return [self._sizes(number) for number in range(len(self._fields))]

    def _sizes(self, number: int) -> PETSc.Vec:
        field, total = self._fields[number], self._vectors[number].duplicate()
        if field.at == "points":
            assemble_into(total, self._live[number])
            total.axpy(1.0, self.external[number])
            total.abs()
            return total
        if self._broken[number] is None:
            element = field.W.ufl_element()
            shape = tuple(element.reference_value_shape)
            space = fem.functionspace(
                self._particles.mesh, ("Discontinuous Lagrange", element.degree, shape)
            )
            forms = []
            for part in self._parts[number]:
                swap = {part.arguments()[0]: ufl.TestFunction(space)}
                forms.append(compiled_form(ufl.replace(part, swap), **self._options))
            self._broken[number] = forms, create_vector(space)
        broken = self._broken[number]
        assert broken is not None
        assemble_into(broken[1], broken[0])
        cells, bs = self._particles.num_local, field.W.dofmap.index_map_bs
        dofs = field.W.dofmap.list[:cells]
        own = np.abs(broken[1].array_r[: dofs.size * bs]).reshape(*dofs.shape, bs)
        with total.localForm() as local:
            local.set(0.0)
            np.add.at(local.array_w.reshape(-1, bs), dofs, own)
        total.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
        return total

    def load_derivative(self, order: int) -> tuple[list[PETSc.Vec], float]:
        """Return difference quotients of the residuals by the load factor, and their size.

        See :meth:`BodyForms.load_derivative` (collective).
        """
        pairs = zip(self._vectors, self._loaded, strict=True)
        found = [load_quotient(self._particles.load, *pair, order) for pair in pairs]
        return [quotient for quotient, _ in found], sum(size for _, size in found)


def _component(argument: ufl.Argument) -> ufl.core.expr.Expr:
    """Return one component of an argument, with which the pattern of all is made."""
    return argument[(0,) * len(argument.ufl_shape)] if argument.ufl_shape else argument
