# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The file of a checkpoint: tables of rows by global index, written and read by all ranks.

A line that names the format; its version, the length of the header and the header's CRC-32
(little endian: 4, 8 and 4 bytes); the header, JSON; and the tables, each column by itself, in the
order in which ranks wrote them. A column is divided into chunks of rows with a CRC-32 each, so
that any number of ranks can read and check the file in parts.
"""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError, agree
from ..meshes.remesh import Place
from ..tolerances import BLOCK
from .files import kind_of, replace

__all__ = ["VERSION", "Snapshot", "Table", "read", "write"]

MAGIC = b"mpm_dolfinx checkpoint\n"
VERSION = 2
START = struct.Struct("<IQI")


class Table(NamedTuple):
    """Some rows of a table that is spread over the ranks.

    Attributes:
        rows: Global index of each of this rank's rows, shape ``(n,)``.
        columns: Arrays ``(n, ...)`` by name; names, shapes and types are the same on all ranks.
        places: Where the values of each live, which a file does not say.
    """

    rows: NDArray[np.int64]
    columns: dict[str, NDArray[Any]]
    places: Mapping[str, Place] = MappingProxyType({})


class Snapshot(NamedTuple):
    """A state, apart from the objects it is the state of.

    Attributes:
        numbers: What is the same on all ranks, in types that JSON has.
        tables: What is spread over the ranks.
    """

    numbers: dict[str, Any]
    tables: list[Table]


class _Column(NamedTuple):
    """Where a column is in the file, and what it holds."""

    name: str
    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    offset: int
    row: int

    def part(self, first: int) -> int:
        return self.offset + first * self.row


def _columns(table: Table) -> dict[str, NDArray[Any]]:
    return {"": table.rows.astype(np.int64), **table.columns}


def _layout(tables: list[dict[str, Any]], start: int) -> tuple[list[list[_Column]], int]:
    """Return where the columns of each table are, and where the file ends."""
    layout, offset = [], start
    for table in tables:
        columns = []
        for name, kind, shape in table["columns"]:
            dtype = np.dtype(kind)
            row = dtype.itemsize * int(np.prod(shape, dtype=np.int64))
            columns.append(_Column(name, dtype, tuple(shape), offset, row))
            offset += row * table["rows"]
        layout.append(columns)
    return layout, offset


def _chunks(rows: int) -> list[int]:
    """Return the rows of each chunk."""
    return [min(BLOCK, rows - first) for first in range(0, rows, BLOCK)]


def _bytes(values: NDArray[Any]) -> bytes:
    return values.astype(values.dtype.newbyteorder("<"), copy=False).tobytes()


def write(comm: MPI.Comm, path: Path, snapshot: Snapshot) -> None:
    """Write a checkpoint in place of the one before, which stays until this one is whole.

    Args:
        comm: The ranks, which all write their rows (collective).
        path: Name of the file; its directory is made where it is missing.
        snapshot: What to write.

    Raises:
        MPMError: The file cannot be written; what was there before is left as it was.
    """
    data = [_columns(table) for table in snapshot.tables]
    tables: list[dict[str, Any]] = []
    for columns in data:
        kinds = [
            (name, values.dtype.newbyteorder("<").str, values.shape[1:])
            for name, values in columns.items()
        ]
        own = []
        first = 0
        for rows in _chunks(len(columns[""])):
            part = slice(first, first + rows)
            own.append([rows, *(zlib.crc32(_bytes(v[part])) for v in columns.values())])
            first += rows
        chunks = [chunk for rank in comm.allgather(own) for chunk in rank]
        tables.append({"rows": sum(c[0] for c in chunks), "columns": kinds, "chunks": chunks})
    header = json.dumps({"numbers": snapshot.numbers, "tables": tables}).encode()
    start = MAGIC + START.pack(VERSION, len(header), zlib.crc32(header)) + header
    layout, end = _layout(tables, len(start))
    firsts = []
    for columns in data:
        counts = comm.allgather(len(columns[""]))
        firsts.append(sum(counts[: comm.rank]))

    def pieces() -> Iterator[tuple[int, bytes]]:
        if comm.rank == 0:
            yield 0, start
        for columns, places, first in zip(data, layout, firsts, strict=True):
            for place, values in zip(places, columns.values(), strict=True):
                yield place.part(first), _bytes(values)

    replace(comm, path, end, pieces())


def read(comm: MPI.Comm, path: Path) -> Snapshot:
    """Read a checkpoint; each rank reads a part of the rows, whichever they are.

    Args:
        comm: The ranks, as many as one likes (collective).
        path: Name of the file.

    Raises:
        MPMError: The file is missing, no checkpoint, newer than this package, truncated or
            damaged.
    """
    header: dict[str, Any] = {}
    start = 0
    with agree(comm):
        if comm.rank == 0:
            header, start = _read_header(path)
    header, start = comm.bcast((header, start))
    layout, _ = _layout(header["tables"], start)
    tables = []
    with agree(comm):
        try:
            with path.open("rb") as file:
                for table, columns in zip(header["tables"], layout, strict=True):
                    tables.append(_read_table(comm, path, file, table["chunks"], columns))
        except OSError as error:
            raise MPMError(f"The checkpoint '{path}' cannot be read ({error.strerror}).") from error
    return Snapshot(header["numbers"], tables)


def _read_header(path: Path) -> tuple[dict[str, Any], int]:
    cut = MPMError(f"The checkpoint '{path}' is truncated; use an older one.")
    if (kind := kind_of(path)) not in (None, "a file"):
        raise MPMError(f"The checkpoint '{path}' cannot be read, since it is {kind}.")
    try:
        with path.open("rb") as file:
            magic = file.read(len(MAGIC))
            if magic != MAGIC:
                if magic and MAGIC.startswith(magic):
                    raise cut
                raise MPMError(f"'{path}' is not a checkpoint of mpm_dolfinx.")
            fixed = file.read(START.size)
            if len(fixed) < START.size:
                raise cut
            version, length, check = START.unpack(fixed)
            if version > VERSION:
                raise MPMError(
                    f"The checkpoint '{path}' was written by a newer mpm_dolfinx (format "
                    f"{version}, this one reads {VERSION}); update the package."
                )
            if version < VERSION:
                raise MPMError(
                    f"The checkpoint '{path}' was written by an older mpm_dolfinx (format "
                    f"{version}, this one reads {VERSION}); restore it by that, or begin anew."
                )
            size = os.fstat(file.fileno()).st_size
            if size < len(MAGIC) + START.size + length:
                raise cut
            text = file.read(length)
    except OSError as error:
        raise MPMError(f"The checkpoint '{path}' cannot be read ({error.strerror}).") from error
    if zlib.crc32(text) != check:
        raise _damaged(path)
    header: dict[str, Any] = json.loads(text)
    start = len(MAGIC) + START.size + length
    end = _layout(header["tables"], start)[1]
    if size < end:
        raise cut
    if size > end:
        raise _damaged(path)
    return header, start


def _damaged(path: Path) -> MPMError:
    return MPMError(
        f"The checkpoint '{path}' is damaged: its checksum does not fit; use an older one."
    )


def _read_table(
    comm: MPI.Comm, path: Path, file: Any, chunks: list[list[int]], columns: list[_Column]
) -> Table:
    """Read this rank's part of a table's chunks."""
    bounds = [len(chunks) * r // comm.size for r in (comm.rank, comm.rank + 1)]
    first = sum(chunk[0] for chunk in chunks[: bounds[0]])
    mine = chunks[slice(*bounds)]
    values: dict[str, NDArray[Any]] = {}
    for number, column in enumerate(columns):
        file.seek(column.part(first))
        parts = []
        for chunk in mine:
            content = file.read(chunk[0] * column.row)
            if zlib.crc32(content) != chunk[number + 1]:
                raise _damaged(path)
            parts.append(np.frombuffer(content, column.dtype).reshape(chunk[0], *column.shape))
        whole = np.concatenate(parts) if parts else np.zeros((0, *column.shape), column.dtype)
        values[column.name] = whole.astype(column.dtype.newbyteorder("="), copy=False)
    return Table(values.pop(""), values)
