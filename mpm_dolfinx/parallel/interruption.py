# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Ctrl-C in the middle of a step: noted at once, obeyed where all ranks come by together.

A KeyboardInterrupt that Python raises where it likes would leave a step half done, run into PETSc,
which makes an error number of it, or take one rank out of a collective call for which the others
wait. Meanwhile SIGINT is therefore only noted. Each evaluation of the residual asks all ranks, and
fails on all of them where one has noted it; the step is taken back then.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from mpi4py import MPI

from ..errors import MPMError, met

__all__ = ["Hold", "Interrupted", "held", "interrupted", "note", "noted", "settle"]

#: Seconds from which another signal is another Ctrl-C, and for which a rank waits for its signal
#: of the same one.
SAME = 1.0


class Interrupted(MPMError):
    """Ctrl-C on some rank, on its way out of a step that is to be taken back."""

    def __init__(self, *args: Any) -> None:
        super().__init__("The step was interrupted")


class _Signal:
    """SIGINT of this process, while somebody holds it."""

    def __init__(self) -> None:
        self._holders = 0
        self._since: float | None = None

    @property
    def noted(self) -> bool:
        return self._since is not None

    def hold(self) -> bool:
        """Note signals from now on; return whether that can be."""
        if threading.current_thread() is not threading.main_thread():
            return False
        if self._holders == 0:
            # A handler of the user's own is left alone.
            if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
                return False
            self._since = None
            signal.signal(signal.SIGINT, self._note)
        self._holders += 1
        return True

    def release(self) -> bool:
        """Let signals do again what they did before, where nobody else holds them.

        Returns:
            Whether one was noted that nobody is left to obey.
        """
        self._holders -= 1
        if self._holders > 0:
            return False
        if signal.getsignal(signal.SIGINT) == self._note:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        left, self._since = self.noted, None
        return left

    def _note(self, number: int, frame: Any) -> None:
        now = time.monotonic()
        if self._since is None:
            self._since = now
        elif now - self._since > SAME:
            signal.default_int_handler(number, frame)

    def note(self) -> None:
        """Take note of Ctrl-C that has been raised."""
        self._since = time.monotonic()

    def forget(self, late: float) -> None:
        """Forget the signal, also where it is still to come within some seconds."""
        end = time.monotonic() + late
        while self._holders and self._since is None and time.monotonic() < end:
            time.sleep(0.01)
        self._since = None


_SIGINT = _Signal()


class Hold:
    """State of a block that holds SIGINT.

    Attributes:
        left: After the block: whether a signal was noted in it that nobody is left to obey.
    """

    left = False


@contextmanager
def held() -> Iterator[Hold]:
    """Only note SIGINT inside the block, in the main thread; a second Ctrl-C acts as ever."""
    mine, hold = _SIGINT.hold(), Hold()
    try:
        yield hold
    finally:
        if mine:
            hold.left = _SIGINT.release()


def noted() -> bool:
    """Return whether SIGINT has been noted on this rank."""
    return _SIGINT.noted


def note() -> None:
    """Take note of a KeyboardInterrupt that a user's code has raised on this rank."""
    _SIGINT.note()


def interrupted(comm: MPI.Comm, pending: bool = False) -> bool:
    """Return whether SIGINT has been noted on any rank (collective).

    Args:
        comm: The ranks.
        pending: Whether this rank has had one before.
    """
    mine = pending or _SIGINT.noted
    return met(comm, flag=mine)[1] if comm.size > 1 else mine


def settle(comm: MPI.Comm) -> None:
    """Forget the signal that is obeyed now, also where it is still on its way to this rank."""
    _SIGINT.forget(SAME if comm.size > 1 else 0.0)
