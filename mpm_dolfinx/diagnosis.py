# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Where and at what load a step failed, and what can be done about it."""

from __future__ import annotations

from .errors import ConvergenceError, DomainDistortionError, MPMError
from .reduced import ReducedSystem

__all__ = ["placed"]


def placed(
    error: MPMError, reduced: ReducedSystem, load: float, limit: str | None = None
) -> MPMError:
    """Return an error that says at what load it happened, and what to do (collective).

    Args:
        error: It.
        reduced: The system whose residual did not vanish.
        load: Load, or parameter of the path, at the last converged step.
        limit: Up to what no equilibrium was found, if that may be a limit, and what to do.
    """
    advice = {
        DomainDistortionError: "; take more steps, smaller loads or finer domains",
        ConvergenceError: "; take more steps, or look whether a limit load is reached",
    }.get(type(error), "")
    if limit is not None:
        advice = f"; {limit}"
    particles, text = error.particles, error.message.rstrip(".")
    dofs: list[int] = []
    if isinstance(error, ConvergenceError) and not particles:
        particles = reduced.worst_particles()
        dofs, where = reduced.worst_dof()
        if particles and dofs:
            text += f"; the residual is largest at dof {dofs[0]} of V near {where}"
            text += ", and at {particles}"
    told = type(error)(f"{text}, in the step after load {load:.6g}{advice}.", particles, load)
    told.dofs = dofs
    return told
