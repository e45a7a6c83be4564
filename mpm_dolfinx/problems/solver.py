# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""How a problem is solved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import MPMError
from ..parallel.given import require_truth
from ..parallel.kinds import explaining
from ..reals import is_one_of
from ..solvers.strategies import LINEAR_SOLVERS
from ..stabilisation.choice import STABILISATIONS

__all__ = ["Solver", "as_solver"]

#: PETSc's tolerances, and its number of iterations.
TOLERANCES = ("rtol", "atol", "stol", "max_it")


@explaining
@dataclass(frozen=True)
class Solver:
    """How a problem is solved: ``QuasiStaticProblem(..., solver=mpm.Solver(linear="direct"))``.

    Args:
        linear: ``"direct"``: a factorisation by MUMPS; ``"multigrid"``: conjugate gradients
            (generalised minimal residuals where the tangent is not symmetric or there are
            ``fields``) with multigrid on boxes of the background; ``"auto"``: multigrid from as
            many unknowns on as it takes less time, unless there are ``fields``, or
            ``petsc_options`` has a ``ksp_type`` or ``pc_type``.
        line_search: Whether Newton steps are halved where they invert domains or do not
            reduce the residual, and where nothing yields taken on trust.
        predictor: Whether Newton's method starts from the last increments extrapolated, where
            the residual there is not above twice that of a start from zero. Steps of a motion or
            of a consolidation start from the velocities or from rest.
        stabilisation: What is done about background dofs that the body supports badly:
            ``"ghost"`` penalty, ``None``, or ``"auto"``, a ghost penalty where a
            cut is small, on backgrounds of degree 2 or more and, on those of degree 1, while
            the bodies have hardly more nodes than the background (not beside ``background=``);
            with degree 1 ``"auto"`` also keeps joints between bodies shut
            (:class:`~mpm_dolfinx.stabilisation.joints.Joints`).
        shift: Diagonal shift in the factorisation, relative to the diagonal. Combinations of
            background dofs that move no node of the body make the reduced tangent singular;
            without a shift the factor of such a matrix is noise.
        petsc_options: PETSc options for SNES, KSP and PC, without prefix.
        petsc_options_prefix: Prefix of the PETSc options.
        form_compiler_options: Options of FFCx.
        jit_options: Options of the compilation at run time.

    Raises:
        MPMError: Something that there is not.
    """

    linear: str = "auto"
    line_search: bool = True
    predictor: bool = True
    stabilisation: str | None = "auto"
    shift: float = 1e-13
    petsc_options: dict[str, Any] | None = None
    petsc_options_prefix: str = "mpm_"
    form_compiler_options: dict[str, Any] | None = None
    jit_options: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        """Say so where something is unknown."""
        for name in ("line_search", "predictor"):
            require_truth(name, getattr(self, name))
        if not isinstance(self.petsc_options_prefix, str):
            raise MPMError(
                f"petsc_options_prefix must be a string, not {self.petsc_options_prefix!r}."
            )
        for name in ("petsc_options", "form_compiler_options", "jit_options"):
            given = getattr(self, name)
            if given is None or (
                isinstance(given, dict) and all(isinstance(k, str) for k in given)
            ):
                continue
            raise MPMError(f"{name} must be a dictionary of options by their names, not {given!r}.")
        for name, value in (self.petsc_options or {}).items():
            _require_tolerance(name, value)
        if not is_one_of(self.linear, LINEAR_SOLVERS):
            raise MPMError(
                f"Unknown linear={self.linear!r}; choose one of "
                f"{', '.join(map(repr, LINEAR_SOLVERS))}."
            )
        if self.stabilisation is not None and not is_one_of(self.stabilisation, STABILISATIONS):
            raise MPMError(
                f"Unknown stabilisation={self.stabilisation!r}; choose "
                f"{', '.join(map(repr, STABILISATIONS))} or None."
            )
        if not isinstance(self.shift, float | int | np.floating) or not 0.0 <= self.shift < 1.0:
            raise MPMError(f"shift must be at least 0 and below 1, not {self.shift!r}.")
        # a number of NumPy's would make arrays of PETSc's vectors
        object.__setattr__(self, "shift", float(self.shift))

    def in_words(self) -> dict[str, str]:
        """Return how the problem is solved, for a reader."""
        words = {
            "shift": f"{self.shift:g}",
            "line search": "on" if self.line_search else "off",
            "predictor": "on" if self.predictor else "off",
            "stabilisation": str(self.stabilisation),
        }
        options = self.petsc_options or {}
        kept = {name: value for name, value in options.items() if value is not None}
        if kept:
            words["PETSc"] = " ".join(f"{name}={value}" for name, value in kept.items())
        return words

    @property
    def of_forms(self) -> dict[str, Any]:
        """Options with which forms are compiled."""
        return {
            "form_compiler_options": self.form_compiler_options,
            "jit_options": self.jit_options,
        }


def as_solver(solver: Any) -> Solver:
    """Return how a problem is solved; ``None`` is by defaults.

    Raises:
        MPMError: Something else.
    """
    if solver is None:
        return Solver()
    if not isinstance(solver, Solver):
        raise MPMError(f"solver must be an mpm.Solver, not a {type(solver).__name__}.")
    return solver


def _require_tolerance(name: str, value: Any) -> None:
    """Raise an error where PETSc would take a tolerance, or a number of iterations, for another.

    It takes some negative values for "as it was", and reads none where nothing iterates.
    """
    solver, _, what = name.rpartition("snes_" if "snes_" in name else "ksp_")
    if not name.startswith(("snes_", "ksp_")) or solver or what not in TOLERANCES or value is None:
        return
    least, below = float(what == "max_it"), 1.0 if what == "rtol" else np.inf
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = np.nan
    if not least <= number < below:
        most = f" and below {below:g}" if np.isfinite(below) else ""
        raise MPMError(
            f"{name} of petsc_options= must be a number of at least {least:g}{most}, not {value!r}."
        )
