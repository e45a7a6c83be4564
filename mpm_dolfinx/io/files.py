# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Files that all ranks write together: whole, or as they were before."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, cast

from mpi4py import MPI

import numpy as np

from ..errors import MPMError, agree

__all__ = ["as_path", "complaint", "kind_of", "replace", "require_ordinary"]

#: Most bytes that one call of MPI writes, which counts in this type.
PIECE = int(np.iinfo(np.int32).max)


def as_path(path: Any) -> Path:
    """Return a name of a file that a user gives.

    Raises:
        MPMError: It is none.
    """
    if not isinstance(path, str | os.PathLike):
        raise MPMError(f"path must be the name of a file, such as 'run.pvd', not {path!r}.")
    return Path(path)


def replace(comm: MPI.Comm, path: Path, size: int, pieces: Iterable[tuple[int, bytes]]) -> None:
    """Write a file in place of the one before, which stays until this one is whole (collective).

    Args:
        comm: The ranks, which all write their pieces.
        path: Name of the file; its directory is made where it is missing.
        size: Number of bytes of the whole file.
        pieces: This rank's pieces, each with its place in the file.

    Raises:
        MPMError: The file cannot be written, or not all of it; what was there before is left as
            it was.
    """
    require_ordinary(comm, path)
    draft = path.with_name(f".{path.name}.part")
    require_ordinary(comm, draft)
    try:
        with complaint(comm, path):
            if comm.rank == 0:
                draft.parent.mkdir(parents=True, exist_ok=True)
                draft.unlink(missing_ok=True)
                draft.touch()
        _write_draft(comm, draft, path, pieces)
        with complaint(comm, path):
            if comm.rank == 0:
                _flush(draft)
                written = draft.stat().st_size
                if written != size:
                    raise OSError(errno.EIO, f"{written} of {size} bytes are on the disk")
                draft.replace(path)
                with suppress(OSError):  # some file systems have no such thing
                    _flush(path.parent)
    except MPMError:
        if comm.rank == 0:
            with suppress(OSError):
                draft.unlink()
        raise


def _write_draft(
    comm: MPI.Comm, draft: Path, path: Path, pieces: Iterable[tuple[int, bytes]]
) -> None:
    with complaint(comm, path):
        file = MPI.File.Open(cast(MPI.Intracomm, comm), str(draft), MPI.MODE_WRONLY)
    try:
        with complaint(comm, path):
            for offset, content in pieces:
                _put(file, offset, content)
        with complaint(comm, path):
            file.Sync()
    finally:
        file.Close()


def require_ordinary(comm: MPI.Comm, path: Path) -> None:
    """Raise an error where a name is taken by something that is no ordinary file (collective).

    Raises:
        MPMError: It is a directory, a pipe, a socket or a device, which stays as it is.
    """
    with agree(comm):
        if comm.rank == 0 and (kind := kind_of(path)) not in (None, "a file"):
            raise MPMError(f"'{path}' is {kind} and stays as it is; give the name of a file.")


def kind_of(path: Path) -> str | None:
    """Return the kind of a path: ``"a file"``, something else, or ``None`` if it is free."""
    try:
        mode = path.stat().st_mode
    except OSError:
        return None
    kinds = {stat.S_IFREG: "a file", stat.S_IFDIR: "a directory", stat.S_IFIFO: "a pipe"}
    return {**kinds, stat.S_IFSOCK: "a socket"}.get(stat.S_IFMT(mode), "a device")


@contextmanager
def complaint(comm: MPI.Comm, path: Path) -> Iterator[None]:
    """Turn a failure of any rank to write into one error of all."""
    with agree(comm):
        try:
            yield
        except (OSError, MPI.Exception) as error:
            if isinstance(error, OSError):
                reason = error.strerror
            else:  # the last line of MPI's stack of errors is the cause
                reason = str(error).splitlines()[-1].rpartition(": ")[2]
            raise MPMError(f"'{path}' cannot be written ({reason}).") from error


def _put(file: MPI.File, offset: int, content: bytes) -> None:
    for first in range(0, len(content), PIECE):
        file.Write_at(offset + first, content[first : first + PIECE])


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
