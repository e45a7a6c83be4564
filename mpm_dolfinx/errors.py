# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Errors, and how ranks agree on them.

Wherever ranks agree or compare something they make the same call of MPI, on one communicator for
all meshes of the same ranks. A rank on which a user's code fails, or that was given something else,
therefore meets the others where these agree next, and all end with its error.
"""

from __future__ import annotations

import os
import pickle
import re
import sys
import threading
import warnings
from collections.abc import Iterable, Iterator, Sequence
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
    "called_last",
    "forget",
    "gathered",
    "gravest",
    "met",
    "name_particles",
    "not_with",
    "warn",
    "warn_alone",
]

#: What a rank brings to a meeting besides a token.
NOTHING, FLAG, ERROR = 0, 1, 2
#: Seconds after which a rank tells of an error for which the others do not come.
PATIENCE = 20.0
#: What makes the name of an object differ between ranks.
ADDRESS = re.compile(r" at 0x[0-9a-fA-F]+")


class MPMError(RuntimeError):
    """A run or an input that cannot go on, told in one sentence.

    Args:
        message: The sentence; ``{particles}`` in it stands for their names.
        particles: Global indices of the particles concerned.
        load: Load factor of the last converged step.

    Attributes:
        message: The sentence as given, on one line and without addresses in memory.
        particles: Global indices of the particles concerned, sorted (may be empty).
        load: Load factor of the last converged step, or ``None`` before a run.
        dofs: Global dofs of V with the largest residual, where Newton's method failed.
        where: A place outside the background, where that is the trouble.
        advice: What to do, where that is known where it is raised.
    """

    def __init__(
        self, message: str, particles: Iterable[int] = (), load: float | None = None
    ) -> None:
        self.message = " ".join(ADDRESS.sub("", message).split())
        self.particles: list[int] = sorted({int(p) for p in particles})
        self.load = load
        self.dofs: list[int] = []
        self.where: tuple[float, ...] | None = None
        self.advice = ""
        names = name_particles(self.particles)
        super().__init__(self.message.replace("{particles}", names))

    def __reduce__(self) -> tuple[Any, ...]:
        """Let ranks send errors to each other."""
        return (
            type(self),
            (self.message, self.particles, self.load),
            {"dofs": self.dofs, "where": self.where, "advice": self.advice},
        )


class ParticleOutsideError(MPMError):
    """A corner of a particle domain lies outside the background mesh."""


class DomainDistortionError(MPMError):
    """A particle domain is inverted or crosses itself."""

    @classmethod
    def of(
        cls, how: str, which: Sequence[int] | NDArray[np.int64], advice: str = ""
    ) -> Self | None:
        """Return an error about particles, if there are any.

        Args:
            how: What their domains do.
            which: Their global indices.
            advice: What to do, besides smaller steps.
        """
        if not len(which):
            return None
        error = cls(f"The domains of {{particles}} {how}", which)
        error.advice = advice
        return error


class ConvergenceError(MPMError):
    """Newton's method, or a constitutive update, did not converge."""


#: What says of a trial only that it has gone too far, so that a shorter one may do. All else, such
#: as what a user's code raises, ends the step.
TRIAL_ERRORS = (ConvergenceError, DomainDistortionError)


def not_with(one: str, other: str, instead: str) -> MPMError:
    """Return the error that two features cannot be combined.

    Args:
        one: A feature.
        other: What it does not go with.
        instead: What to do.
    """
    return MPMError(f"{one} does not go with {other}; {instead}.")


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
    if comm.size == 1 or getattr(error, _AGREED, False):
        return error
    place = _place(comm)
    if error is None:
        worst, _ = _meet(place, NOTHING)
    else:
        late = threading.Timer(PATIENCE, _tell, [comm.rank, error])
        late.daemon = True
        late.start()
        worst, _ = _meet(place, ERROR)
        late.cancel()
    return _common(place, error) if worst == ERROR else None


def met(comm: MPI.Comm, token: int = 0, flag: bool = False) -> tuple[bool, bool]:
    """Meet the other ranks (collective).

    Args:
        comm: The ranks, more than one.
        token: A whole number of 63 bits.
        flag: Something that may be so on this rank.

    Returns:
        Whether all have the same token, and whether the flag is set on any.

    Raises:
        BaseException: What another rank has raised before it came here.
    """
    place = _place(comm)
    worst, same = _meet(place, FLAG if flag else NOTHING, token)
    if worst == ERROR:
        error = _common(place, None)
        assert error is not None
        raise error from error.__cause__
    return same, worst == FLAG


def gathered[T](comm: MPI.Comm, value: T) -> list[T]:
    """Return the values of all ranks, which meet as in :func:`met` (collective)."""
    return _place(comm).allgather(value)


#: The mark of an error that all ranks know of.
_AGREED = "_known_to_all_ranks"
_PLACE = MPI.Comm.Create_keyval()
_PLACES: dict[tuple[int, ...], MPI.Comm] = {}
_LAST: list[MPI.Comm] = []


def called_last() -> MPI.Comm | None:
    """Return the ranks that have met last, if any have."""
    return _LAST[0] if _LAST else None


def forget(error: BaseException) -> None:
    """Let an error that leaves this package be one that ranks do not know of, if it comes again."""
    vars(error).pop(_AGREED, None)


def _place(comm: MPI.Comm) -> MPI.Comm:
    """Return where ranks meet, whichever of their communicators they know (collective at first)."""
    known = cast(MPI.Comm | None, comm.Get_attr(_PLACE))
    if known is None:
        ranks, all_ranks = comm.Get_group(), MPI.COMM_WORLD.Get_group()
        key = tuple(ranks.Translate_ranks(None, all_ranks))
        ranks.Free()
        all_ranks.Free()
        if key not in _PLACES:
            _PLACES[key] = comm.Dup()
            _PLACES[key].Set_attr(_PLACE, _PLACES[key])
        known = _PLACES[key]
        comm.Set_attr(_PLACE, known)
    _LAST[:] = [known]
    return known


def _meet(place: MPI.Comm, brought: int, token: int = 0) -> tuple[int, bool]:
    """Return the worst of what ranks have brought, and whether their tokens are the same."""
    values = np.array([brought, token, -token], dtype=np.int64)
    place.Allreduce(MPI.IN_PLACE, values, MPI.MAX)
    worst, largest, smallest = values.tolist()
    return worst, largest == -smallest


def _tell(rank: int, error: BaseException) -> None:
    """Say what this rank ends with, where the others are in something that it has left."""
    print(
        f"Rank {rank} waits for the others to end with {type(error).__name__}: {error}",
        file=sys.stderr,
        flush=True,
    )


def _common[E: BaseException](place: MPI.Comm, error: E | None) -> E | None:
    """Return the gravest error of all ranks, of which one has one at least (collective)."""
    errors = place.allgather(None if error is None else _sendable(error))
    first = gravest(errors)
    rank = next(r for r, e in enumerate(errors) if e is first)
    common: Any = error if rank == place.rank else first
    if isinstance(first, MPMError):
        particles = {p for e in errors if type(e) is type(first) for p in e.particles}
        common = type(first)(first.message, particles, first.load)
        common.dofs, common.where, common.advice = first.dofs, first.where, first.advice
        common.__cause__ = None if error is None else error.__cause__
    setattr(common, _AGREED, True)
    return cast(E, common)


@contextmanager
def agree(comm: MPI.Comm, what: str | None = None) -> Iterator[None]:
    """Raise an error of any rank on all ranks, with one sentence and all particles.

    It is for what may fail on one rank alone, such as a user's code. An error on one rank must
    not skip a collective call there, unless the first one that it skips is such a block too.

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
            raise common
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


def warn(comm: MPI.Comm, sentence: str) -> None:
    """Warn the user on rank 0; where that is an error (``-W error``), it is on all (collective).

    Args:
        comm: The ranks.
        sentence: The warning.
    """
    with agree(comm):
        if comm.rank == 0:
            warn_alone(sentence)


def warn_alone(sentence: str) -> None:
    """Warn the user, by the line that called this package, on the rank that calls this.

    Args:
        sentence: The warning.
    """
    here = os.path.join(os.path.dirname(__file__), "")
    warnings.warn(sentence, skip_file_prefixes=(here,))


def _sendable(error: BaseException) -> BaseException:
    """Return an error that can be sent to other ranks, this one if it can be."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error
