# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Motions that nothing holds: which they are, and what is said of them."""

from __future__ import annotations

from petsc4py import PETSc

import numpy as np

from ..errors import ConvergenceError, MPMError
from ..parallel.magnitudes import norm
from ..tolerances import LAST_PLACES, LOCAL_ITERATIONS, SLIGHT, SMALL
from .linear import ShiftedFactor
from .problem import Levels, Resisting

__all__ = ["mechanism", "not_held"]


def mechanism(
    system: Resisting, levels: Levels, factor: ShiftedFactor, y: PETSc.Vec
) -> PETSc.Vec | None:
    """Return a motion that the proximal term holds in y and nothing else does, if there is one.

    Solving for the forces of that term, again and again, leaves what gives way to them most;
    the stiffness along it tells a soft body, or a stiff one on a soft one, from a motion
    without any. That of values that are no displacements is the sum of terms that cancel, and
    known to the last places of the tangent only. Where stiffnesses differ by many digits that
    motion is found to a few only, and a rigid one is looked at by itself.

    Args:
        system: What resists.
        levels: The unknowns.
        factor: The factor of its tangent, with the proximal term's diagonal D.
        y: A step of the unknowns.
    """
    assert factor.D is not None
    mode, force = y.copy(), y.duplicate()
    before, last_places = np.inf, LAST_PLACES / factor.shift
    for _ in range(LOCAL_ITERATIONS):
        force.pointwiseMult(mode, factor.D)
        force.scale(1.0 / norm(force))
        factor.solve(force, mode)
        mode.scale(1.0 / norm(mode))
        force.pointwiseMult(mode, factor.D)
        if factor.num_negative:
            force.array_w[:] = np.copysign(force.array_r, mode.array_r)
            ratio = abs(system.stiffness(mode)) / mode.dot(force)
        else:
            ratio = system.stiffness(mode) / mode.dot(force)
        if ratio <= SMALL or (ratio <= last_places and system.field_of(mode) is not None):
            return mode
        if ratio > 0.95 * before:
            loose = ratio <= SLIGHT and _all_move_rigidly(system, levels, factor)
            return mode if loose else None
        before = ratio
    return None


def not_held(
    system: Resisting, levels: Levels, factor: ShiftedFactor, mode: PETSc.Vec, share: float
) -> MPMError:
    """Return the error that says that forces act on a motion without stiffness.

    A rigid motion has none whatever the step, unless something one-sided comes to hold it.
    Other motions may get it from their own size, or have lost it to plastic flow: a smaller
    step may do.

    Args:
        system: What resists.
        levels: The unknowns.
        factor: The factor of its tangent.
        mode: The motion.
        share: Share of the forces that act on it.
    """
    field = system.field_of(mode)
    if field is not None:
        return _unheld(field, share)
    if not (system.is_rigid(mode) or _all_move_rigidly(system, levels, factor)):
        return _not_resisted(share)
    return _let_go(share) if system.one_sided else _unsupported(share)


def _all_move_rigidly(system: Resisting, levels: Levels, factor: ShiftedFactor) -> bool:
    """Whether all bodies of a background can move as one rigid body."""
    assert factor.K is not None and factor.D is not None
    motions = levels.rigid_motions().getVecs()
    forces = [factor.K * motion for motion in motions]
    held = [motion * factor.D for motion in motions]
    K = np.array([[motion.dot(force) for force in forces] for motion in motions])
    D = np.array([[motion.dot(force) for force in held] for motion in motions])
    size = np.linalg.inv(np.linalg.cholesky(D / D.trace()))
    softest = size.T @ np.linalg.eigh(size @ ((K + K.T) / D.trace()) @ size.T)[1][:, 0]
    softest = motions[0].comm.tompi4py().bcast(softest)
    motion = motions[0].duplicate()
    motion.set(0.0)
    motion.maxpy(softest, motions)
    resistance = motion.dot(motion * factor.D)
    return bool(system.stiffness(motion) <= SMALL * resistance)


def _unsupported(share: float) -> MPMError:
    return MPMError(
        f"Forces ({share:.1e} of all) act where nothing holds the bodies; support each of them "
        "against all rigid motions, with conditions and supports that reach it where it is"
    )


def _unheld(field: str, share: float) -> MPMError:
    return MPMError(
        f"What acts on the field '{field}' ({share:.1e} of all) does not balance, and nothing "
        "holds its values: prescribe some of them by a condition on its background space, or let "
        "it store or exchange what flows"
    )


def _let_go(share: float) -> ConvergenceError:
    return ConvergenceError(
        f"Forces ({share:.1e} of all) act where nothing holds the bodies once what only pushes has "
        "let them go; support each of them against all rigid motions, or bring them into contact "
        "by displacements before"
    )


def _not_resisted(share: float) -> ConvergenceError:
    return ConvergenceError(
        f"Forces ({share:.1e} of all) act on motions that are not rigid and that nothing resists: "
        "hourglass motions of domains with one quadrature point, parts that the background moves "
        "apart, or parts that nothing holds; use quadrature_degree=2, larger cells of the "
        "background or smaller domains"
    )
