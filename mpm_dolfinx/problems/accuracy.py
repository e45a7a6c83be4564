# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Errors of a problem's last step, and nodes that are freed where they are large."""

from __future__ import annotations

from collections.abc import Sequence

from dolfinx import fem

from .. import _compat
from ..errors import MPMError
from ..stepping.adaptivity import Adaptivity
from ..stepping.trial import Trial
from ..system.errors import Errors, estimated

__all__ = ["adaptivity_of", "errors_of"]


def errors_of(trial: Trial) -> Errors:
    """Return the errors of the last converged step of a problem (collective).

    Raises:
        MPMError: There are none that can be told.
    """
    _require(trial)
    terms = trial.solver.system.body_terms
    return estimated(trial.owner.bodies, terms, trial.reduced, trial.converged.force)


def adaptivity_of(trial: Trial, bcs: Sequence[fem.DirichletBC], tolerance: float) -> Adaptivity:
    """Return the rule by which nodes are freed.

    Raises:
        MPMError: No error can be told, or no node be freed.
    """
    adaptivity = Adaptivity(tolerance)
    _require(trial)
    adapted = [body for body in trial.owner.bodies if adaptivity.adapts(body)]
    if not adapted:
        raise MPMError(
            "adapt= frees nodes of bodies whose particles may have free ones; make them with "
            "free=[]."
        )
    if any(_compat.is_condition_on(bc, body.W) for bc in bcs for body in adapted):
        raise MPMError(
            "A Dirichlet condition on particles.W holds nodes that adapt= may let the "
            "background carry; hold them by conditions on V or a support."
        )
    return adaptivity


def _require(trial: Trial) -> None:
    """Raise an error unless an error can be told."""
    problem = trial.owner
    if not problem.at_rest:
        raise MPMError(
            f"A {type(problem).__name__} is in no equilibrium of which an error could be told; "
            "error() is for problems at rest."
        )
    alone = [body for body in problem.bodies if not body.shares_nodes]
    if alone:
        raise MPMError(
            f"Particles of method {alone[0].method!r} do not hang together, so that nothing tells "
            "what their background cannot do; error() is for 'cpdi2' and finite elements."
        )
