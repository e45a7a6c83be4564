# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Errors, and how ranks agree on them."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from mpi4py import MPI

__all__ = [
    "ConvergenceError",
    "DomainDistortionError",
    "MPMError",
    "ParticleOutsideError",
    "agree",
    "agreed",
    "name_particles",
    "on_all_ranks",
]


class MPMError(RuntimeError):
    """A run or an input that cannot go on, told in one sentence.

    Args:
        message: The sentence; ``{particles}`` in it stands for their names.
        particles: Global indices of the particles concerned.
        load: Load factor of the last converged step.

    Attributes:
        message: The sentence as given.
        particles: Global indices of the particles concerned, sorted (may be empty).
        load: Load factor of the last converged step, or ``None`` before a run.
        dofs: Global dofs of V with the largest residual, where Newton's method failed.
    """

    def __init__(
        self, message: str, particles: Iterable[int] = (), load: float | None = None
    ) -> None:
        self.message = message
        self.particles: list[int] = sorted({int(p) for p in particles})
        self.load = load
        self.dofs: list[int] = []
        super().__init__(message.replace("{particles}", name_particles(self.particles)))

    def __reduce__(self) -> tuple[Any, ...]:
        """Let ranks send errors to each other."""
        return type(self), (self.message, self.particles, self.load)


class ParticleOutsideError(MPMError):
    """A corner of a particle domain lies outside the background mesh."""


class DomainDistortionError(MPMError):
    """A particle domain is inverted or crosses itself."""


class ConvergenceError(MPMError):
    """Newton's method, or a constitutive update, did not converge."""


def name_particles(particles: Sequence[int], most: int = 8) -> str:
    """Return a short list of particles for a message, e.g. ``particles 3, 4 and 9 more``."""
    shown = ", ".join(str(p) for p in particles[:most])
    rest = len(particles) - most
    word = "particle" if len(particles) == 1 else "particles"
    return f"{word} {shown}" + (f" and {rest} more" if rest > 0 else "")


def agreed(comm: MPI.Comm, error: MPMError | None) -> MPMError | None:
    """Return one error for all ranks where any rank has one (collective).

    Args:
        comm: The ranks.
        error: This rank's error.

    Returns:
        The lowest failing rank's error with the particles of all ranks that have one of its
        class, or ``None``.
    """
    if comm.size == 1 or not comm.allreduce(error is not None, MPI.LOR):
        return error
    errors = [e for e in comm.allgather(error) if e is not None]
    first: MPMError = errors[0]
    particles = {p for e in errors if type(e) is type(first) for p in e.particles}
    return type(first)(first.message, particles, first.load)


@contextmanager
def agree(comm: MPI.Comm) -> Iterator[None]:
    """Raise an error of any rank on all ranks, with one sentence and all particles.

    The block must hold no collective call that an error on one rank would skip on that rank
    alone.

    Args:
        comm: The ranks that reach this block together (collective).

    Raises:
        MPMError: What any rank raised inside the block.
    """
    mine: MPMError | None = None
    try:
        yield
    except MPMError as error:
        mine = error
    common = agreed(comm, mine)
    try:
        if common is not None:
            raise common from None
    finally:
        del mine, common  # an error that its own frame holds would keep problems alive


def on_all_ranks(comm: MPI.Comm, function: Callable[[float], None]) -> Callable[[float], None]:
    """Return a user's function that fails on all ranks, with one error, where it fails on any.

    Args:
        comm: The ranks, which call the function together (collective).
        function: The function.
    """

    def call(value: float) -> None:
        mine: Exception | None = None
        try:
            function(value)
        except Exception as error:
            mine = error
        try:
            if comm.size > 1 and comm.allreduce(mine is not None, MPI.LOR):
                failures = comm.allgather(None if mine is None else _sendable(mine))
                rank = next(r for r, failure in enumerate(failures) if failure is not None)
                if rank != comm.rank:
                    mine = failures[rank]
            if mine is not None:
                raise mine
        finally:
            del mine  # an error that its own frame holds would keep problems alive

    return call


def _sendable(error: Exception) -> Exception:
    """Return an error that can be sent to other ranks, this one if it can be."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error
