# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The bodies of a problem, what is given for each, and what a step takes out of the background."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from . import _compat
from .errors import MPMError, ParticleOutsideError
from .history import History, Loss
from .particles import Particles

__all__ = [
    "as_bodies",
    "as_conditions",
    "dirichlet_values",
    "force_at",
    "may_stop",
    "move_bodies",
    "one_for_each",
]

type Masses = Callable[[int], NDArray[np.float64] | None]
"""Masses of the owned particles of a body, by its number; ``None`` where they are not known."""


def as_bodies(particles: Particles | Sequence[Particles]) -> list[Particles]:
    """Return the bodies of a problem as a list.

    Raises:
        MPMError: Something else than particles, or particles on different backgrounds.
    """
    bodies = [particles] if isinstance(particles, Particles) else particles
    if (
        not isinstance(bodies, list | tuple)
        or not bodies
        or not all(isinstance(body, Particles) for body in bodies)
    ):
        raise MPMError(
            f"particles must be mpm.Particles or a list of them, not {type(particles).__name__}."
        )
    if len({id(body) for body in bodies}) < len(bodies):
        raise MPMError("The same particles are given twice.")
    if any(body.V is not bodies[0].V for body in bodies):
        raise MPMError("All particles of one problem must be made with the same space V.")
    return list(bodies)


def one_for_each(forms: Any, bodies: Sequence[Particles], what: str) -> list[Any]:
    """Return forms, of which each body has one, as a list.

    Raises:
        MPMError: More or less of them than bodies.
    """
    given = list(forms) if isinstance(forms, list | tuple) else [forms]
    if len(given) != len(bodies):
        raise MPMError(f"There are {len(bodies)} bodies; give one {what} for each, as a list.")
    return given


def as_conditions(bcs: Any, V: fem.FunctionSpace) -> list[fem.DirichletBC]:
    """Return Dirichlet conditions on V as a list.

    Raises:
        MPMError: Something else than conditions, or conditions on another space.
    """
    if not isinstance(bcs, list | tuple) or not all(isinstance(bc, fem.DirichletBC) for bc in bcs):
        raise MPMError("bcs must be a list of dolfinx.fem.DirichletBC.")
    if not all(_compat.is_condition_on(bc, V) for bc in bcs):
        raise MPMError(
            "A Dirichlet condition is not on the background space V of the particles "
            "or on a component of it (V.sub(i))."
        )
    return list(bcs)


def dirichlet_values(bcs: Sequence[fem.DirichletBC], V: fem.FunctionSpace) -> NDArray[np.float64]:
    """Return the present totals of Dirichlet conditions, on the local dofs of V (collective).

    Raises:
        MPMError: Some are not finite.
    """
    values: NDArray[np.float64] = np.array(fem.Function(V).x.array)
    for bc in bcs:
        bc.set(values, None, 1.0)
    if not V.mesh.comm.allreduce(bool(np.isfinite(values).all()), MPI.LAND):
        raise MPMError("A Dirichlet condition has a value that is not finite")
    return values


def force_at(
    bc: fem.DirichletBC, forces: NDArray[np.float64] | None, V: fem.FunctionSpace
) -> NDArray[np.float64]:
    """Return the sum of forces on the dofs of a condition, ``(gdim,)`` (collective).

    Args:
        bc: The condition.
        forces: Forces on this rank's own dofs of V; ``None`` are none.
        V: The background space.
    """
    gdim = V.dofmap.index_map_bs
    force = np.zeros(gdim)
    if forces is not None:
        own = _compat.own_dofs(bc, V)
        np.add.at(force, own % gdim, forces[own])
    return np.asarray(V.mesh.comm.allreduce(force))


def may_stop(bodies: Sequence[Particles]) -> bool:
    """Return whether a run that leaves the background ends without an error."""
    policies = {body.outside for body in bodies}
    return "stop" in policies and "error" not in policies


def move_bodies(
    bodies: Sequence[Particles], history: History, masses: Masses, load: float, last: bool
) -> None:
    """Make the present displacements the converged ones, and delete what leaves (collective).

    None are changed where one body is outside that must not be.

    Args:
        bodies: The bodies of a problem.
        history: Where what is deleted is recorded.
        masses: Masses of the particles.
        load: Load, or parameter of the path, at the end of the step.
        last: Whether it is the run's last step, which may leave particles outside.

    Raises:
        ParticleOutsideError: A body is outside that must not be.
    """
    before = [body.commit() for body in bodies]
    leaving: list[NDArray[np.int64]] = []
    try:
        with history.statistics.phase("locate"):
            for body in bodies:
                if body.deletion is not None or not last:
                    leaving.append(body.leaving())
                else:
                    leaving.append(np.zeros(0, dtype=np.int64))
    except ParticleOutsideError:
        for body, converged in zip(bodies, before, strict=True):
            body.restore(converged)
        raise
    for number, (body, which) in enumerate(zip(bodies, leaving, strict=True)):
        if body.V.mesh.comm.allreduce(len(which)) > 0:
            _record(history, _loss(body, number, masses(number), which, load))
            body.delete(which)


def _loss(
    body: Particles,
    number: int,
    masses: NDArray[np.float64] | None,
    which: NDArray[np.int64],
    load: float,
) -> Loss:
    """Return what the deletion of particles of a body loses (collective)."""
    comm = body.V.mesh.comm
    mass = None if masses is None else float(comm.allreduce(masses[which].sum()))
    indices = {p for ps in comm.allgather(body.global_index[which].tolist()) for p in ps}
    volume = float(comm.allreduce(body.initial_volume[which].sum()))
    return Loss(load, number, sorted(indices), volume, mass)


def _record(history: History, loss: Loss) -> None:
    history.losses.append(loss)
    statistics = history.statistics
    statistics["lost_particles"] += len(loss.particles)
    statistics["lost_volume"] += loss.volume
    statistics["lost_mass"] += loss.mass or 0.0
