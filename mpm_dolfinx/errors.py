# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Errors, and how ranks agree on them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mpi4py import MPI

__all__ = [
    "ConvergenceError",
    "DomainDistortionError",
    "MPMError",
    "ParticleOutsideError",
    "agree",
    "name_particles",
]


class MPMError(RuntimeError):
    """A run or an input that cannot go on, told in one sentence.

    Attributes:
        particles: Global indices of the particles concerned (may be empty).
        load: Load factor of the last converged step, or ``None`` before a run.
    """

    def __init__(
        self, message: str, particles: Iterable[int] = (), load: float | None = None
    ) -> None:
        super().__init__(message)
        self.particles: list[int] = sorted(int(p) for p in particles)
        self.load = load


class ParticleOutsideError(MPMError):
    """A corner of a particle domain lies outside the background mesh."""


class DomainDistortionError(MPMError):
    """A particle domain is inverted or crosses itself."""


class ConvergenceError(MPMError):
    """Newton's method, or a constitutive update, did not converge."""


def name_particles(particles: Sequence[int], most: int = 8) -> str:
    """Return a short list of particle indices for a message, e.g. ``particles 3, 4``."""
    shown = ", ".join(str(int(p)) for p in list(particles)[:most])
    rest = len(particles) - most
    word = "particle" if len(particles) == 1 else "particles"
    return f"{word} {shown}" + (f" and {rest} more" if rest > 0 else "")


@contextmanager
def agree(comm: MPI.Comm) -> Iterator[None]:
    """Raise an error of any rank on all ranks, with one sentence and all particles.

    The body must hold no collective call that an error on one rank would skip on that
    rank alone. The first failing rank's class and sentence are raised everywhere, with the
    particles of all ranks that raised the same class.

    Args:
        comm: The ranks that reach this block together (collective).

    Raises:
        MPMError: What any rank raised inside the block.
    """
    mine: tuple[type[MPMError], str, list[int], float | None] | None = None
    cause: MPMError | None = None
    try:
        yield
    except MPMError as error:
        cause = error
        mine = (type(error), str(error), error.particles, error.load)
    if comm.size == 1:
        if cause is not None:
            raise cause
        return
    raised = [r for r in comm.allgather(mine) if r is not None]
    if not raised:
        return
    kind, message, _, load = raised[0]
    particles = {p for k, _, ps, _ in raised if k is kind for p in ps}
    raise kind(message, particles, load) from cause
