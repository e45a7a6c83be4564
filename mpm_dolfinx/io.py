# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Time series of particle domains for ParaView."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem, io

from . import _compat
from .errors import MPMError
from .particles import Particles

__all__ = ["TimeSeries", "time_series"]


class TimeSeries:
    """A ``.pvd`` file that grows by one state at each call.

    The cells are the particles' own domains at their current positions: the displaced body mesh
    for cpdi2, domains of their own for the other methods and where they are curved.

    Args:
        path: Name of the file.
        particles: The body.

    Raises:
        MPMError: The name does not end in ``.pvd``.
    """

    def __init__(self, path: Path, particles: Particles) -> None:
        if path.suffix != ".pvd":
            raise MPMError(f"A time series is written to a '.pvd' file, not to '{path}'.")
        comm = particles.mesh.comm
        if comm.rank == 0:
            path.parent.mkdir(parents=True, exist_ok=True)
        comm.barrier()
        self._particles = particles
        self.follow()
        self._file = io.VTKFile(comm, str(path), "w")

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
            self._file.write_function([self._displacement, *fields], time)
            self._file.close()  # writes the index so far; the series goes on
        finally:
            x[:] = original

    def _field(self, name: str, values: NDArray[np.float64]) -> fem.Function:
        if name not in self._fields:
            space = fem.functionspace(self._mesh, ("Discontinuous Lagrange", 0, values.shape[1:]))
            self._fields[name] = fem.Function(space, name=name)
        field = self._fields[name]
        cells = field.function_space.dofmap.list[: len(values), 0]
        field.x.array.reshape(-1, *values.shape[1:])[cells] = values
        field.x.scatter_forward()
        return field


def time_series(path: Path, bodies: Sequence[Particles]) -> list[TimeSeries]:
    """Return a time series for each body; those of several have their number in the name."""
    several = len(bodies) > 1
    return [
        TimeSeries(path.with_stem(f"{path.stem}_{i}") if several else path, body)
        for i, body in enumerate(bodies)
    ]
