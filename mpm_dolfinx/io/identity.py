# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Identity of a problem, which it shares with the one that made a checkpoint."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx import mesh

from .. import _compat
from ..errors import MPMError, agree
from ..meshes.cells import input_cell_index
from ..particles.field import CarriedField
from ..particles.particles import Particles
from ..tolerances import EQUAL
from .checkpoint import Snapshot
from .snapshot import spaces_of

__all__ = ["identity", "require_same", "same"]


def require_same(present: dict[str, Any], snapshot: Snapshot, source: str, comm: MPI.Comm) -> None:
    """Raise an error unless a state is one of the problem with this identity (collective)."""
    known = snapshot.numbers["identity"]
    with agree(comm):
        for name, value in present.items():
            if not same(known.get(name), value):
                raise MPMError(f"{source} is of another problem: {name} is not the same.")


def identity(
    bodies: Sequence[Particles],
    carried: Sequence[CarriedField],
    laws: Sequence[Sequence[tuple[str, dict[str, Any]]]],
) -> dict[str, Any]:
    """Return the properties that two problems must share to exchange states (collective).

    It is that of a problem as it is now: see :class:`ProblemState` for what it was made as.

    Args:
        bodies: Its bodies.
        carried: Its unknowns besides displacements.
        laws: Name and parameters of each body's materials.
    """
    found: dict[str, Any] = {"the number of bodies": len(bodies)}
    spaces = [V for V in spaces_of(bodies) if any(V is b.V for b in bodies)]
    for i, V in enumerate(spaces):
        of = f" of field {i}" if i else ""
        element = V.ufl_element()
        found[f"the background mesh{of}"] = _mesh(V.mesh)
        found[f"the background space{of}"] = [element.family_name, element.degree]
    if len(spaces) > 1:
        found["the field of each body"] = [
            next(i for i, V in enumerate(spaces) if V is body.V) for body in bodies
        ]
    for i, (body, law) in enumerate(zip(bodies, laws, strict=True)):
        of = f" of body {i}" if len(bodies) > 1 else ""
        found[f"the body mesh{of}"] = _mesh(body.mesh)
        found[f"the particles' method{of}"] = _options(body)
        found[f"the material{of}"] = [
            [name, {key: _parameter(body, value) for key, value in parameters.items()}]
            for name, parameters in law
        ]
    for one in carried:
        field, element = one.field, one.V.ufl_element()
        number = next(i for i, body in enumerate(bodies) if body.mesh is one.mesh)
        found[f"the field {field.name} of body {number}"] = [
            field.at,
            field.kind,
            element.family_name,
            element.degree,
            list(element.reference_value_shape),
            _mesh(one.V.mesh),
        ]
    return found


def _options(body: Particles) -> dict[str, Any]:
    """Return method and degrees of particles, and what may become of them."""
    return {
        "method": body.method,
        "degree": body.W.ufl_element().degree,
        "quadrature_degree": body.geometry.quadrature_degree,
        "delete": body.deletion is not None,
        **({} if body.free_nodes is None else {"free": True}),
    }


def _mesh(domain: mesh.Mesh) -> list[Any]:
    """Return kind, number of cells, size and a weighted mean of the positions of all cells."""
    cells = domain.topology.index_map(domain.topology.dim)
    index = input_cell_index(domain)
    corners = domain.geometry.x[_compat.geometry_dofmap(domain)[: len(index)]]
    size = domain.comm.allreduce(float(np.abs(corners).max(initial=0.0)), MPI.MAX)
    places = 1.0 + corners.reshape(len(index), 3 * corners.shape[1]) / (size or 1.0)
    mean = _weighted(domain.comm, index, places)
    return [domain.basix_cell().name, cells.size_global, size, *mean.tolist()]


def _weighted(
    comm: MPI.Comm, index: NDArray[np.int64], values: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return a mean of rows with weights that depend on their index, the same on all ranks."""
    weights = 2.0 + np.cos(index.astype(np.float64))
    total = comm.allreduce(np.einsum("n,ni->i", weights, values))
    return np.asarray(total / max(comm.allreduce(len(index)), 1))


def _parameter(body: Particles, value: Any) -> Any:
    """Return a parameter of a material; of values at points their size and mean."""
    if not isinstance(value, tuple):
        return float(value) if isinstance(value, float | int | np.number) else str(value)
    index, values = value
    size = body.mesh.comm.allreduce(float(np.abs(values).max(initial=0.0)), MPI.MAX)
    places = 1.0 + values[:, None] / (size or 1.0)
    return [size, *_weighted(body.mesh.comm, index, places).tolist()]


def same(one: Any, two: Any) -> bool:
    """Return whether what two problems are known by is the same, but for round-off."""
    if isinstance(one, dict) and isinstance(two, dict):
        return one.keys() == two.keys() and all(same(one[k], two[k]) for k in one)
    if isinstance(one, list | tuple) and isinstance(two, list | tuple):
        return len(one) == len(two) and all(map(same, one, two))
    if isinstance(one, float) and isinstance(two, float):
        return math.isclose(one, two, rel_tol=EQUAL) or (math.isnan(one) and math.isnan(two))
    return bool(one == two)
