# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The problem of a step, as solvers ask for it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError
from .saddle import Fields

__all__ = ["Levels", "ReducedProblem", "Resisting"]


class Levels(Fields, Protocol):
    """Unknowns, as a linear solver must know them. All calls are collective."""

    @property
    def constrained(self) -> bool:
        """Whether there are unknowns besides displacements."""

    @property
    def nested(self) -> bool:
        """Whether multigrid's boxes follow the tangent."""

    @property
    def held(self) -> bool:
        """Whether the tangent resists each unknown by itself, so that it needs no shift."""

    def rigid_motions(self) -> PETSc.NullSpace:
        """Return the rigid motions in the unknowns."""


class Resisting(Protocol):
    """Resistance to motions, as the search for mechanisms must know it; calls are collective."""

    @property
    def one_sided(self) -> bool:
        """Whether something may let bodies go and hold them again, as contact does."""

    def stiffness(self, x: PETSc.Vec) -> float:
        """Return ``x . K x`` for the last tangent, without cancellation in rigid motions."""

    def is_rigid(self, x: PETSc.Vec) -> bool:
        """Return whether x moves each body as a rigid one."""

    def field_of(self, x: PETSc.Vec) -> str | None:
        """Return the name of the field that x changes alone, if it is one of no displacement."""

    def motion(self, x: PETSc.Vec) -> float:
        """Return the size of the displacement that x causes on the bodies."""

    def extent(self) -> float:
        """Return the size of the positions of the bodies, in the same norm."""


class Histories(Protocol):
    """Histories of what acts on bodies."""

    def smooth(self) -> bool:
        """Return whether no history changes in the last residual, nor contact (collective)."""

    def yielding(self) -> list[NDArray[np.bool_]]:
        """Return whether each particle yields in the last residual, for each body."""


class Sizes(Protocol):
    """Sizes of forces of the last residual. All calls are collective."""

    def internal_scale(self) -> float:
        """Return the size of the absolute internal contributions."""

    def resultant(self) -> float:
        """Return the size of the sum of the residual over the unknowns."""


class ReducedProblem(Protocol):
    """Problem, as the solver asks for it. All calls are collective."""

    @property
    def softens(self) -> bool:
        """Whether tangents may be indefinite where ``constrain`` permits no such direction."""

    @property
    def levels(self) -> Levels:
        """The unknowns, as a linear solver must know them."""

    @property
    def resistance(self) -> Resisting:
        """How unknowns move bodies, and what resists."""

    @property
    def terms(self) -> Histories:
        """All that acts on the bodies."""

    @property
    def balance(self) -> Sizes:
        """The sizes of its forces."""

    @property
    def tangent(self) -> Callable[[], PETSc.Mat]:
        """Returns the tangent at the x of the last residual, always the same object."""

    def residual(self, x: PETSc.Vec, F: PETSc.Vec) -> MPMError | None:
        """Evaluate the residual at x, or say why that cannot be."""

    def constrain(
        self, y: PETSc.Vec, x: PETSc.Vec | None, solve: Callable[[PETSc.Vec, PETSc.Vec], None]
    ) -> int:
        """Amend a Newton step y from x (``None``: zero) so that ``x - y`` is permitted.

        ``solve`` solves with the factor that gave y. Returns how many negative eigenvalues the
        tangent has where it is positive definite in all directions that are permitted.
        """

    def prediction(self) -> PETSc.Vec | None:
        """Return unknowns to expect at the step's end, if the past says any."""

    def impose(self) -> bool:
        """Impose the step's Dirichlet values from now on; return whether there are any."""

    def lift(self) -> PETSc.Vec:
        """Return the linearised forces of the step's Dirichlet values."""

    def scale(self, F: PETSc.Vec | None = None) -> float:
        """Return the size of external forces and reactions, by which a residual F is judged."""

    def work_tells(self) -> bool:
        """Return whether a residual's work on a Newton step tells if that is stable.

        Where K is symmetric too, equilibrium makes a potential least.
        """
