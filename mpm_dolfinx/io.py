# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Time series of particle domains for ParaView."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree as ET

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem, io

from . import _compat
from .checkpoint import complaint
from .errors import MPMError, agree
from .particles import Particles

__all__ = ["Output", "TimeSeries", "read_series"]


class State(NamedTuple):
    """An entry of a ``.pvd`` file."""

    time: float
    file: str


class TimeSeries:
    """A ``.pvd`` file that grows by one state at each call.

    The cells are the particles' own domains at their current positions: the displaced body mesh
    for cpdi2, domains of their own for the other methods and where they are curved. Each state
    has files of its own; the index that names them is replaced by a whole one.

    Args:
        path: Name of the file (collective).
        particles: The body.
        past: States of the file that is there which stay in it.

    Attributes:
        path: Name of the file.
        states: What is in it.

    Raises:
        MPMError: The name does not end in ``.pvd``, or its directory cannot be made.
    """

    def __init__(self, path: Path, particles: Particles, past: Sequence[State] = ()) -> None:
        if path.suffix != ".pvd":
            raise MPMError(f"A time series is written to a '.pvd' file, not to '{path}'.")
        comm = particles.mesh.comm
        with complaint(comm, path):
            if comm.rank == 0:
                path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self.states = list(past)
        self._particles = particles
        self.follow()

    def follow(self) -> None:
        """Take the particles as they are spread over the ranks now (collective)."""
        particles = self._particles
        self._undeformed = particles.outlined(particles.initial_domains)
        self._mesh = particles.mesh
        degree, gdim = particles.W.ufl_element().degree, self._mesh.geometry.dim
        cell = particles.mesh.basix_cell()
        if particles.method != "cpdi2" or degree > 1:
            self._mesh = _compat.disconnected_mesh(
                self._mesh.comm, self._undeformed, cell, degree=degree
            )
        nodal = fem.functionspace(self._mesh, _compat.equispaced_element(cell, degree, gdim))
        self._displacement = fem.Function(nodal, name="displacement")
        self._fields: dict[str, fem.Function] = {}

    def write(self, time: float) -> None:
        """Add the last converged state (collective)."""
        particles = self._particles
        fields = [self._field(name, value) for name, value in particles.fields().items()]
        n, gdim = particles.num_local, self._mesh.geometry.dim
        domains = particles.outlined(particles.domains)
        moved = self._displacement.x.array.reshape(-1, gdim)
        moved[self._displacement.function_space.dofmap.list[:n]] = domains - self._undeformed
        self._displacement.x.scatter_forward()
        x = self._mesh.geometry.x
        original = x.copy()
        try:
            x[_compat.geometry_dofmap(self._mesh)[:n], :gdim] = domains
            self._add([self._displacement, *fields], time)
        finally:
            x[:] = original

    def _add(self, functions: list[fem.Function], time: float) -> None:
        comm = self._mesh.comm
        part = self.path.with_stem(f"{self.path.stem}_{len(self.states):06d}")
        with io.VTKFile(comm, str(part), "w") as file:
            file.write_function(functions, time)
        states = self.states
        with complaint(comm, self.path):
            if comm.rank == 0:
                states = [*states, *_read(part)]
                part.unlink()
                _write(self.path, states)
        self.states = comm.bcast(states)

    def _field(self, name: str, values: NDArray[np.float64]) -> fem.Function:
        if name not in self._fields:
            space = fem.functionspace(self._mesh, ("Discontinuous Lagrange", 0, values.shape[1:]))
            self._fields[name] = fem.Function(space, name=name)
        field = self._fields[name]
        cells = field.function_space.dofmap.list[: len(values), 0]
        field.x.array.reshape(-1, *values.shape[1:])[cells] = values
        field.x.scatter_forward()
        return field


class Output:
    """The time series that a problem writes."""

    def __init__(self) -> None:
        self._series: dict[Path, list[TimeSeries]] = {}
        self._past: dict[str, list[State]] = {}

    def write(self, path: Path, bodies: Sequence[Particles], time: float) -> None:
        """Add the last converged state, each body's to its file (collective).

        Args:
            path: Name of the series; with several bodies their number is added to it.
            bodies: The bodies.
            time: Time of the state.
        """
        if path not in self._series:
            files = [path]
            if len(bodies) > 1:
                files = [path.with_stem(f"{path.stem}_{i}") for i in range(len(bodies))]
            self._series[path] = [
                TimeSeries(file, body, self._past.get(str(file), ()))
                for file, body in zip(files, bodies, strict=True)
            ]
        for series in self._series[path]:
            series.write(time)

    def follow(self) -> None:
        """Take the particles as they are spread over the ranks now (collective)."""
        for series in self._every():
            series.follow()

    def _every(self) -> list[TimeSeries]:
        return [series for files in self._series.values() for series in files]

    def written(self) -> dict[str, int]:
        """Return the number of states in each file."""
        past = {name: len(states) for name, states in self._past.items()}
        return past | {str(series.path): len(series.states) for series in self._every()}

    def go_back(self, series: dict[str, list[State]], written: dict[str, int], time: float) -> None:
        """Go on with series from a state that was saved.

        Args:
            series: What :func:`read_series` found.
            written: Number of states in each file when the state was saved.
            time: Time of the state, which may have been written after it was saved.
        """
        self._series.clear()
        self._past = {
            name: [*states[:n], *takewhile(lambda state: state.time == time, states[n:])]
            for (name, states), n in zip(series.items(), written.values(), strict=True)
        }


def read_series(comm: MPI.Comm, names: Iterable[str]) -> dict[str, list[State]]:
    """Return what is in time series (collective).

    Args:
        comm: The ranks.
        names: Names of ``.pvd`` files; one that is missing is empty.

    Raises:
        MPMError: A file cannot be read.
    """
    series: dict[str, list[State]] = {}
    with agree(comm):
        if comm.rank == 0:
            series = {name: _read(Path(name)) for name in names}
    series = comm.bcast(series)
    return series


def _read(path: Path) -> list[State]:
    """Return the entries of a ``.pvd`` file, none where it is missing."""
    try:
        entries = ET.parse(path).iter("DataSet")
        return [State(float(e.attrib["timestep"]), e.attrib["file"]) for e in entries]
    except FileNotFoundError:
        return []
    except (OSError, ET.ParseError, KeyError, ValueError):
        raise MPMError(
            f"'{path}' should be the time series so far but cannot be read; remove it."
        ) from None


def _write(path: Path, states: list[State]) -> None:
    """Replace a ``.pvd`` file."""
    root = ET.Element("VTKFile", type="Collection", version="1.0")
    collection = ET.SubElement(root, "Collection")
    for time, file in states:
        ET.SubElement(collection, "DataSet", timestep=repr(time), part="0", file=file)
    ET.indent(root)
    draft = path.with_name(f".{path.name}.part")
    ET.ElementTree(root).write(draft, encoding="utf-8", xml_declaration=True)
    draft.replace(path)
