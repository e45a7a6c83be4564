# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Particles that leave the background: deleted and recorded, or an error."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..errors import ParticleOutsideError
from ..history import History, Loss
from ..parallel.totals import over_ranks
from ..particles.particles import Particles

__all__ = ["Masses", "left_outside", "may_stop", "move_bodies"]

type Masses = Callable[[int], NDArray[np.float64] | None]
"""Masses of the owned particles of a body, by its number; ``None`` where they are not known."""


def may_stop(bodies: Sequence[Particles]) -> bool:
    """Return whether a run that leaves the background ends without an error."""
    policies = {body.outside for body in bodies}
    return "stop" in policies and "error" not in policies


def left_outside(bodies: Sequence[Particles], history: History) -> str | None:
    """Return a warning where the last, converged step took particles off (collective)."""
    try:
        with history.statistics.phase("locate"):
            for body in bodies:
                body.locate()
    except ParticleOutsideError as error:
        told = str(error)
        return f"The run is complete, but {told[0].lower()}{told[1:]}"
    return None


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
                if body.outside == "delete" or not last:
                    leaving.append(body.placement.leaving(body.outside == "delete"))
                else:
                    leaving.append(np.zeros(0, dtype=np.int64))
    except ParticleOutsideError:
        for body, converged in zip(bodies, before, strict=True):
            body.restore(converged)
        raise
    for number, (body, which) in enumerate(zip(bodies, leaving, strict=True)):
        if over_ranks(body.V.mesh.comm, len(which)) > 0:
            _record(history, _loss(body, number, masses(number), which, load))
            body.placement.delete(which)


def _loss(
    body: Particles,
    number: int,
    masses: NDArray[np.float64] | None,
    which: NDArray[np.int64],
    load: float,
) -> Loss:
    """Return the loss by the deletion of particles of a body (collective)."""
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
