# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Errors, and how ranks agree on them."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Self, cast

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "TRIAL_ERRORS",
    "ConvergenceError",
    "DomainDistortionError",
    "MPMError",
    "ParticleOutsideError",
    "agree",
    "agreed",
    "as_ours",
    "gravest",
    "name_particles",
    "on_all_ranks",
    "warn",
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

    @classmethod
    def of(cls, how: str, which: Sequence[int] | NDArray[np.int64]) -> Self | None:
        """Return an error about particles, if there are any.

        Args:
            how: What their domains do.
            which: Their global indices.
        """
        return cls(f"The domains of {{particles}} {how}", which) if len(which) else None


class ConvergenceError(MPMError):
    """Newton's method, or a constitutive update, did not converge."""


#: What says of a trial only that it has gone too far, so that a shorter one may do. All else, such
#: as what a user's code raises, ends the step.
TRIAL_ERRORS = (ConvergenceError, DomainDistortionError)


def name_particles(particles: Sequence[int], most: int = 8) -> str:
    """Return a short list of particles for a message, e.g. ``particles 3, 4 and 9 more``."""
    shown = ", ".join(str(p) for p in particles[:most])
    rest = len(particles) - most
    word = "particle" if len(particles) == 1 else "particles"
    return f"{word} {shown}" + (f" and {rest} more" if rest > 0 else "")


def gravest[E: BaseException](errors: Iterable[E | None]) -> E | None:
    """Return the first error that is more than one of a trial, or else the first one, if any."""
    found = [error for error in errors if error is not None]
    grave = (error for error in found if not isinstance(error, TRIAL_ERRORS))
    return next(grave, found[0] if found else None)


def agreed[E: BaseException](comm: MPI.Comm, error: E | None) -> E | None:
    """Return one error for all ranks where any rank has one (collective).

    Args:
        comm: The ranks.
        error: This rank's error.

    Returns:
        The gravest error, of several the lowest rank's, or ``None``; one of this package has the
        particles of all ranks that have one of its class.
    """
    if comm.size == 1 or not comm.allreduce(error is not None, MPI.LOR):
        return error
    errors = comm.allgather(None if error is None else _sendable(error))
    first = gravest(errors)
    rank = next(r for r, e in enumerate(errors) if e is first)
    if isinstance(first, MPMError):
        particles = {p for e in errors if type(e) is type(first) for p in e.particles}
        common = type(first)(first.message, particles, first.load)
        if rank == comm.rank and error is not None:
            common.__cause__ = error.__cause__
        return cast(E, common)
    return error if rank == comm.rank else first


@contextmanager
def agree(comm: MPI.Comm, what: str | None = None) -> Iterator[None]:
    """Raise an error of any rank on all ranks, with one sentence and all particles.

    It is for what may fail on one rank alone, such as a user's code. The block must hold no
    collective call that an error on one rank would skip on that rank alone.

    Args:
        comm: The ranks that reach this block together (collective).
        what: What the block does, for a sentence about errors that are not of this package;
            ``None`` leaves them as they are.

    Raises:
        MPMError: What any rank raised inside the block.
        BaseException: Other errors, as raised; a ``RuntimeError`` instead on ranks to which one
            cannot be sent.
    """
    mine: BaseException | None = None
    try:
        yield
    except BaseException as error:
        mine = error
        if what is not None and isinstance(error, Exception):
            mine = as_ours(error, what)
    common = agreed(comm, mine)
    try:
        if common is not None:
            raise common from common.__cause__
    finally:
        del mine, common  # an error that its own frame holds would keep problems alive


def as_ours(error: Exception, what: str) -> MPMError:
    """Return an error of this package: itself, or a sentence on what failed.

    Args:
        error: The error.
        what: What failed.
    """
    if isinstance(error, MPMError):
        return error
    ours = MPMError(f"{what} failed with {type(error).__name__}: {error}")
    ours.__cause__ = error
    return ours


def on_all_ranks(comm: MPI.Comm, function: Callable[[float], None]) -> Callable[[float], None]:
    """Return a user's function that fails on all ranks, with one error, where it fails on any.

    Args:
        comm: The ranks, which call the function together (collective).
        function: The function.
    """

    def call(value: float) -> None:
        with agree(comm):
            function(value)

    return call


def warn(comm: MPI.Comm, sentence: str, stacklevel: int = 2) -> None:
    """Warn the user on rank 0; where that is an error (``-W error``), it is on all (collective).

    Args:
        comm: The ranks.
        sentence: The warning.
        stacklevel: As for ``warnings.warn``, where this function is called.
    """
    with agree(comm):
        if comm.rank == 0:
            warnings.warn(sentence, stacklevel=stacklevel + 1)


def _sendable(error: BaseException) -> BaseException:
    """Return an error that can be sent to other ranks, this one if it can be."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error
