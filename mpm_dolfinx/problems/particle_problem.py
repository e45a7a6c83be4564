# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A UFL residual on particles, solved in load steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, override

import ufl
from dolfinx import fem

from ..errors import MPMError
from ..parallel.boundary import collective
from ..particles.field import ParticleField
from ..particles.particles import Particles
from ..system.term import Term
from .arguments import as_bodies, as_fields, one_for_each, require_entity_maps, residuals_of
from .parts import Contribution
from .problem import Problem
from .solver import Solver, as_solver

__all__ = ["ParticleProblem"]


class ParticleProblem(Problem):
    """Find the displacement of particles at which a UFL residual vanishes.

    The residual is written on the body mesh as for finite elements. Each step's increment
    lives in the background space: ``d = d_n + T u``, residual ``T^T R`` and tangent
    ``T^T J T``.

    With ``fields`` there are more unknowns than the displacement, each with a residual and a
    background space of its own: ``ParticleProblem([R_u, R_p], particles, fields=[p])``. All are
    solved for together; the blocks of the tangent are derivatives of the residuals.

    Args:
        R: Residual in ``particles.displacement`` and a test function of ``particles.W``; for
            several bodies one for each; then one for each of the fields, with a test function of
            the field's ``W``. ``None`` for a body with fields alone, which does not move by itself.
        particles: The body, or a list of bodies. Those on the same V do not slip where they touch;
            those on a V of their own meet by ``terms`` alone.
        J: Tangent; ``None`` is ``ufl.derivative(R, particles.displacement)``.
        bcs: Dirichlet conditions on V (any of them, also those of fields); their values are
            totals at full load.
        background: Form in ``particles.increment`` (of the first body on V) and a test function
            of V, added to R; a list where there are several V.
        symmetric: Whether J is symmetric (an LDL^T factorisation instead of LU).
        terms: What else acts on the bodies: a list of :class:`mpm_dolfinx.Term`.
        fields: Unknowns besides displacements, made by :meth:`Particles.field`. Those on the same
            background space are one there, where bodies touch.
        entity_maps: Passed on to ``dolfinx.fem.form``: how the body mesh is related to others that
            R and J have Functions on, such as a submesh of facets.
        solver: How it is solved.

    Raises:
        MPMError: Forms, spaces or conditions that do not go together.
    """

    @collective()
    def __init__(
        self,
        R: ufl.Form | Sequence[ufl.Form | None],
        particles: Particles | Sequence[Particles],
        J: ufl.Form | Sequence[ufl.Form | None] | None = None,
        bcs: Sequence[fem.DirichletBC] = (),
        background: ufl.Form | Sequence[ufl.Form] | None = None,
        *,
        symmetric: bool = False,
        terms: Sequence[Term] = (),
        fields: Sequence[ParticleField] = (),
        entity_maps: Any = None,
        solver: Solver | None = None,
    ) -> None:
        bodies = as_bodies(particles)
        fields = as_fields(fields, bodies)
        require_entity_maps(entity_maps)
        residuals, self._of_fields = residuals_of(R, bodies, fields)
        if fields and J is not None:
            raise MPMError("With fields= the tangent is the derivative of R; omit J.")
        tangents = [None] * len(bodies) if J is None else one_for_each(J, bodies, "J")
        if any(body.on_distortion == "split" for body in bodies):
            raise MPMError(
                "The residual is written on the present body mesh, so domains cannot be split; "
                "on_distortion='split' is for mpm.QuasiStaticProblem."
            )
        self._given = [
            Contribution(r, j, symmetric) for r, j in zip(residuals, tangents, strict=True)
        ]
        self._entity_maps = entity_maps
        spaces = list({id(field.background): field.background for field in fields}.values())
        super().__init__(
            particles, bcs, background, as_solver(solver), terms, fields, spaces=spaces
        )

    @override
    def _contributions(self) -> list[Contribution]:
        return self._given

    @override
    @collective()
    def repartition(self, threshold: float = 0.1) -> bool:
        raise MPMError(
            "The residual is written on the present body mesh, so its particles cannot move; "
            "call particles.repartition() before the residual is written."
        )
