# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Time series of particle domains for ParaView."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem, io

from . import _compat
from .errors import MPMError
from .particles import Particles

__all__ = ["TimeSeries"]


class TimeSeries:
    """A ``.pvd`` file that grows by one state at each call.

    Args:
        path: Name of the file.
        particles: The body.

    Raises:
        MPMError: The name does not end in ``.pvd``.
    """

    def __init__(self, path: Path, particles: Particles) -> None:
        if path.suffix != ".pvd":
            raise MPMError(f"A time series is written to a '.pvd' file, not to '{path}'.")
        if particles.mesh.comm.rank == 0:
            path.parent.mkdir(parents=True, exist_ok=True)
        particles.mesh.comm.barrier()
        self._particles = particles
        self._file = io.VTKFile(particles.mesh.comm, str(path), "w")
        self._fields: dict[str, fem.Function] = {}

    def write(self, time: float) -> None:
        """Add the present state (collective)."""
        particles = self._particles
        body = particles.mesh
        jacobian = particles.volume / particles.initial_volume
        values = {"volume_ratio": jacobian}
        if particles.has_material:
            stress = particles.stress
            values["stress"] = stress
            values["pressure"] = -np.trace(stress, axis1=1, axis2=2) / 3.0
            values["plastic_strain"] = particles.plastic_strain
        fields = [self._field(name, value) for name, value in values.items()]
        reference = body.geometry.x.copy()
        try:
            nodes = _compat.geometry_dofmap(body).ravel()
            d = particles.displacement.x.array.reshape(-1, body.geometry.dim)
            body.geometry.x[nodes, : body.geometry.dim] = (
                reference[nodes, : body.geometry.dim] + d[particles.W.dofmap.list.ravel()]
            )
            self._file.write_function([particles.displacement, *fields], time)
        finally:
            body.geometry.x[:] = reference

    def _field(self, name: str, values: NDArray[np.float64]) -> fem.Function:
        if name not in self._fields:
            space = fem.functionspace(
                self._particles.mesh, ("Discontinuous Lagrange", 0, values.shape[1:])
            )
            self._fields[name] = fem.Function(space, name=name)
        field = self._fields[name]
        field.x.array[: values.size] = values.ravel()
        field.x.scatter_forward()
        return field
