# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Time series of particle domains for ParaView."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import basix

from ..errors import MPMError, agree
from ..meshes.order import vtk_cell
from ..particles.particles import Particles
from .files import kind_of, replace, require_ordinary

__all__ = ["Drawing", "Drawn", "Output", "TimeSeries", "drawing", "read_series"]

#: VTK's names of types.
TYPES = {"float64": "Float64", "int64": "Int64", "uint8": "UInt8"}
#: Arrays with a row for each point, and for each cell.
COUNTED = (("Points", "Points"), ("Cells", "types"))


class Entry(NamedTuple):
    """An entry of a ``.pvd`` file.

    Attributes:
        time: Time of the state.
        file: Name of its own file, relative to that of the series.
        step: Number of converged steps before it; -1 where a file of before does not say.
    """

    time: float
    file: str
    step: int = -1


type Drawing = dict[str, dict[str, NDArray[Any]]]
"""A rank's part of the arrays of VTK's unstructured grid."""


class Drawn(Protocol):
    """A structure that is written beside bodies."""

    @property
    def comm(self) -> MPI.Comm:
        """The ranks."""

    def grid(self) -> Drawing:
        """Return this rank's part of it as it is now (collective)."""


class TimeSeries:
    """A ``.pvd`` file that grows by one state at each call.

    The cells are the particles' own domains at their current positions: the displaced body mesh
    for cpdi2, domains of their own for the other methods and where they are curved. Each state
    has one file of its own, whichever the number of ranks; the index that names them is replaced
    by a whole one.

    Args:
        path: Name of the file (collective).
        thing: The body, or what else is drawn.
        past: States of the file that is there which stay in it.

    Attributes:
        path: Name of the file.
        states: What is in it.
        thing: As given.

    Raises:
        MPMError: The name does not end in ``.pvd``, or is that of something else than a file.
    """

    def __init__(self, path: Path, thing: Particles | Drawn, past: Sequence[Entry] = ()) -> None:
        if path.suffix != ".pvd":
            raise MPMError(f"A time series is written to a '.pvd' file, not to '{path}'.")
        self._comm = thing.mesh.comm if isinstance(thing, Particles) else thing.comm
        require_ordinary(self._comm, path)
        self.path = path
        self.states = list(past)
        self.thing = thing

    def write(self, time: float, step: int = -1) -> None:
        """Add the present state, or replace one of the same time (collective).

        Args:
            time: Its time, not before that of the last state.
            step: Number of converged steps before it; -1 is unknown.

        Raises:
            MPMError: The time lies before that of the last state, or a file cannot be written;
                the series is what it was.
        """
        comm, thing, states = self._comm, self.thing, self.states
        if states and time < states[-1].time:
            raise MPMError(
                f"The last state in '{self.path}' has the time {states[-1].time:g}, so none can "
                f"follow with {time:g}; give later ones as time=, or begin another series."
            )
        if states and states[-1].time == time:
            states = states[:-1]
        part = self.path.with_name(f"{self.path.stem}_{len(states):06d}.vtu")
        _write_grid(comm, part, _grid(thing) if isinstance(thing, Particles) else thing.grid())
        states = [*states, Entry(time, part.name, step)]
        index = _index(states)
        replace(comm, self.path, len(index), [(0, index)] if comm.rank == 0 else [])
        self.states = states


def drawing(
    kind: basix.CellType,
    cells: NDArray[np.int64],
    places: tuple[NDArray[np.float64], NDArray[np.float64]],
    fields: Mapping[str, NDArray[np.float64]],
) -> Drawing:
    """Return straight cells that one rank has.

    Args:
        kind: Their kind.
        cells: Their nodes, shape ``(m, k)``.
        places: Of the nodes now and at first, shape ``(N, gdim)``.
        fields: Values of each cell by name, shape ``(m,)``.
    """
    now, start = (np.pad(x, ((0, 0), (0, 3 - x.shape[1]))) for x in places)
    m, k = cells.shape
    number, order = vtk_cell(kind, 1, k)
    return {
        "Points": {"Points": now},
        "Cells": {
            "connectivity": cells[:, order].astype(np.int64).ravel(),
            "offsets": k * (1 + np.arange(m, dtype=np.int64)),
            "types": np.full(m, number, dtype=np.uint8),
        },
        "PointData": {"displacement": now - start},
        "CellData": {name: np.asarray(v, dtype=np.float64)[:, None] for name, v in fields.items()},
    }


def _grid(particles: Particles) -> Drawing:
    """Return this rank's part of the arrays of VTK's unstructured grid (collective).

    Neighbours share points where they share nodes, and where none of them has stayed behind.
    """
    comm, gdim = particles.mesh.comm, particles.mesh.geometry.dim
    with agree(comm):
        known = particles.fields()
    degree = particles.W.ufl_element().degree
    start, now = (
        particles.geometry.outlined(x) for x in (particles.initial_domains, particles.domains)
    )
    n, k = now.shape[:2]
    before = sum(comm.allgather(n)[: comm.rank])
    deleted = comm.allreduce(bool(particles.deleted.any()), MPI.LOR)
    if particles.shares_nodes and degree == 1 and not deleted:
        numbering = particles.W.dofmap.index_map
        nodes, owned = particles.domain_nodes, numbering.size_local
        numbers = numbering.local_to_global(nodes.ravel().astype(np.int32)).reshape(n, k)
        points = np.zeros((len(particles.node_positions), 2, gdim))
        points[nodes] = np.stack([now, start], axis=2)
        points = points[:owned]
    else:
        first = k * before
        numbers = first + np.arange(n * k).reshape(n, k)
        points = np.stack([now, start], axis=2).reshape(n * k, 2, gdim)
    points = np.pad(points, ((0, 0), (0, 0), (0, 3 - gdim)))
    kind, order = vtk_cell(particles.mesh.basix_cell(), degree, k)
    return {
        "Points": {"Points": points[:, 0]},
        "Cells": {
            "connectivity": numbers[:, order].astype(np.int64).ravel(),
            "offsets": k * (1 + before + np.arange(n, dtype=np.int64)),
            "types": np.full(n, kind, dtype=np.uint8),
        },
        "PointData": {"displacement": points[:, 0] - points[:, 1]},
        "CellData": {
            name: np.asarray(values, dtype=np.float64).reshape(n, math.prod(values.shape[1:]))
            for name, values in known.items()
        },
    }


def _write_grid(comm: MPI.Comm, path: Path, grid: Drawing) -> None:
    """Write a grid as one ``.vtu`` file, to which all ranks add their rows (collective)."""
    from xml.etree import ElementTree as ET

    root = ET.Element(
        "VTKFile",
        type="UnstructuredGrid",
        version="1.0",
        byte_order="LittleEndian",
        header_type="UInt64",
    )
    piece = ET.SubElement(ET.SubElement(root, "UnstructuredGrid"), "Piece")
    places: list[tuple[int, int, int, NDArray[Any]]] = []
    offset = 0
    for group, arrays in grid.items():
        parent = ET.SubElement(piece, group)
        for name, values in arrays.items():
            sizes = comm.allgather(values.nbytes)
            entry = ET.SubElement(
                parent,
                "DataArray",
                type=TYPES[values.dtype.name],
                Name=name,
                format="appended",
                offset=str(offset),
            )
            if values.ndim > 1:
                entry.set("NumberOfComponents", str(values.shape[1]))
            places.append((offset, sum(sizes), sum(sizes[: comm.rank]), values))
            offset += 8 + sum(sizes)
    rows = [comm.allreduce(len(grid[group][name])) for group, name in COUNTED]
    piece.set("NumberOfPoints", str(rows[0]))
    piece.set("NumberOfCells", str(rows[1]))
    text = ET.tostring(root, encoding="unicode").removesuffix("</VTKFile>")
    head = f'<?xml version="1.0"?>\n{text}<AppendedData encoding="raw">_'.encode()
    tail = b"</AppendedData></VTKFile>\n"

    def pieces() -> Iterator[tuple[int, bytes]]:
        if comm.rank == 0:
            yield 0, head
            yield len(head) + offset, tail
        for place, size, first, values in places:
            if comm.rank == 0:
                yield len(head) + place, size.to_bytes(8, "little")
            content = values.astype(values.dtype.newbyteorder("<"), copy=False).tobytes()
            yield len(head) + place + 8 + first, content

    replace(comm, path, len(head) + offset + len(tail), pieces())


class Output:
    """The time series that a problem writes."""

    def __init__(self) -> None:
        self._series: dict[Path, dict[Path, TimeSeries]] = {}
        self._past: dict[str, list[Entry]] = {}

    def write(
        self,
        path: Path,
        bodies: Sequence[Particles],
        others: Mapping[str, Drawn],
        time: float,
        step: int,
    ) -> None:
        """Add the present state, each body's to its file (collective).

        Args:
            path: Name of the series; with several bodies their number is added to it.
            bodies: The bodies.
            others: What else is drawn, by what is added to the name.
            time: Time of the state.
            step: Number of converged steps before it.

        Raises:
            MPMError: As :class:`TimeSeries` and :meth:`TimeSeries.write`.
        """
        files: dict[Path, Particles | Drawn] = {path: bodies[0]}
        if len(bodies) > 1:
            files = {path.with_stem(f"{path.stem}_{i}"): body for i, body in enumerate(bodies)}
        files |= {path.with_stem(f"{path.stem}_{name}"): one for name, one in others.items()}
        known = self._series.setdefault(path, {})
        for file, thing in files.items():
            past = known[file].states if file in known else self._past.get(str(file), ())
            if file not in known or known[file].thing is not thing:
                known[file] = TimeSeries(file, thing, past)
            known[file].write(time, step)

    def _every(self) -> list[TimeSeries]:
        return [series for files in self._series.values() for series in files.values()]

    def written(self) -> dict[str, int]:
        """Return the number of states in each file."""
        past = {name: len(states) for name, states in self._past.items()}
        return past | {str(series.path): len(series.states) for series in self._every()}

    def go_back(
        self, series: dict[str, list[Entry]], written: dict[str, int], time: float, step: int
    ) -> None:
        """Go on with series from a state that was saved.

        Args:
            series: What :func:`read_series` found.
            written: Number of states in each file when the state was saved.
            time: Time of the state, which may have been written after it was saved.
            step: Number of converged steps before it.
        """

        def is_it(state: Entry) -> bool:
            return state.step == step if state.step >= 0 else state.time == time

        self._series.clear()
        self._past = {
            name: [*states[:n], *takewhile(is_it, states[n:])]
            for (name, states), n in zip(series.items(), written.values(), strict=True)
        }


def read_series(comm: MPI.Comm, names: Iterable[str]) -> dict[str, list[Entry]]:
    """Return the entries of time series (collective).

    Args:
        comm: The ranks.
        names: Names of ``.pvd`` files; one that is missing is empty.

    Raises:
        MPMError: A file cannot be read.
    """
    series: dict[str, list[Entry]] = {}
    with agree(comm):
        if comm.rank == 0:
            series = {name: _read(Path(name)) for name in names}
    series = comm.bcast(series)
    return series


def _read(path: Path) -> list[Entry]:
    """Return the entries of a ``.pvd`` file, none where it is missing."""
    from xml.etree import ElementTree as ET

    damaged = MPMError(f"'{path}' should be the time series so far but cannot be read; remove it.")
    if (kind := kind_of(path)) != "a file":
        if kind is None:
            return []
        raise damaged
    try:
        entries = ET.parse(path).iter("DataSet")
        return [
            Entry(float(e.attrib["timestep"]), e.attrib["file"], int(e.get("step", -1)))
            for e in entries
        ]
    except (OSError, ET.ParseError, KeyError, ValueError):
        raise damaged from None


def _index(states: Sequence[Entry]) -> bytes:
    """Return the content of a ``.pvd`` file."""
    from xml.etree import ElementTree as ET

    root = ET.Element("VTKFile", type="Collection", version="1.0")
    collection = ET.SubElement(root, "Collection")
    for time, file, step in states:
        ET.SubElement(
            collection, "DataSet", timestep=repr(time), part="0", file=file, step=str(step)
        )
    ET.indent(root)
    whole: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return whole
