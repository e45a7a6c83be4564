# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Fields of particles by name, one value for each domain."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dolfinx import fem

from ..errors import MPMError, agree
from ..particles.particles import Particles
from .outlines import owned_values

__all__ = ["LABELS", "Lines", "bodies_of", "lines_of", "values_of"]

#: What colour bars say.
LABELS = {
    "contact_pressure": "contact pressure",
    "mises": "von Mises stress",
    "plastic_strain": "plastic strain",
    "volume_ratio": "volume ratio",
}
AXES = "xyz"

type Field = str | ArrayLike | fem.Function | Sequence[ArrayLike | fem.Function] | None


def bodies_of(problem: Any) -> list[Particles]:
    """Return the bodies of a problem, of particles or of a list of them."""
    if isinstance(problem, Particles):
        return [problem]
    bodies = getattr(problem, "bodies", problem)
    known = isinstance(bodies, list | tuple) and all(isinstance(b, Particles) for b in bodies)
    if not known or not bodies:
        raise MPMError(
            f"Pictures are of a problem, of particles or of a list of them, not of {problem!r}."
        )
    return list(bodies)


class Lines(NamedTuple):
    """A structure of lower dimension as it is drawn.

    Attributes:
        points: Where its nodes are, shape ``(N, gdim)``.
        cells: Nodes of its cells, in VTK's order, shape ``(m, k)``.
        values: Of each cell, ``None`` where it has no such field.
    """

    points: NDArray[np.float64]
    cells: NDArray[np.int64]
    values: NDArray[np.float64] | None


def lines_of(problem: Any, field: Field, warp: float) -> list[Lines]:
    """Return the structures of a problem (collective)."""
    found = []
    for term in _structures(problem):
        points = term.nodes + warp * (term.positions - term.nodes)
        cells = term.cells[:, [0, 1, 3, 2]] if term.cells.shape[1] == 4 else term.cells
        found.append(
            Lines(points, cells, term.fields().get(field if isinstance(field, str) else ""))
        )
    return found


def _structures(problem: Any) -> list[Any]:
    """Return the terms of a problem that are drawn as cells of lower dimension."""
    return [term for term in getattr(problem, "terms", ()) if hasattr(type(term), "positions")]


def values_of(
    problem: Any, bodies: Sequence[Particles], field: Field
) -> list[NDArray[np.float64]] | None:
    """Return the values of a field in the owned domains of each body (collective).

    Args:
        problem: As given to the picture.
        bodies: Its bodies.
        field: See :func:`mpm_dolfinx.plot.scene`.

    Returns:
        An array ``(n,)`` for each body, or ``None`` for pictures without a field.

    Raises:
        MPMError: There is no such field.
    """
    if field is None or (isinstance(field, str) and field == "contact_pressure"):
        return None
    comm: MPI.Comm = bodies[0].mesh.comm
    with agree(comm):
        if isinstance(field, str):
            known = [_known(problem, bodies, n) for n in range(len(bodies))]
            besides = [name for term in _structures(problem) for name in term.fields()]
            return _named(known, bodies, field, besides)
        several = isinstance(field, list | tuple) and len(bodies) > 1
        each: Sequence[Any] = field if several else [field]  # type: ignore[assignment]
        if len(each) != len(bodies):
            raise MPMError(f"field must have one entry for each of the {len(bodies)} bodies.")
        return [_given(body, values) for body, values in zip(bodies, each, strict=True)]


def _given(body: Particles, values: Any) -> NDArray[np.float64]:
    """Return values that the user has given, one for each domain."""
    if isinstance(values, fem.Function):
        if values.function_space.mesh is not body.mesh:
            raise MPMError(f"The Function {values.name!r} is not on the mesh of its body.")
        return _of_function(body, values)
    return owned_values(body, values)


def _of_function(body: Particles, function: fem.Function) -> NDArray[np.float64]:
    """Return the mean of a Function's values in each domain, of vectors their length."""
    dofmap = function.function_space.dofmap
    values = function.x.array.reshape(-1, dofmap.bs)[dofmap.list[: body.num_local]].mean(axis=1)
    return np.asarray(values[:, 0] if dofmap.bs == 1 else np.linalg.norm(values, axis=1))


def _named(
    known: Sequence[dict[str, NDArray[np.float64]]],
    bodies: Sequence[Particles],
    name: str,
    besides: Sequence[str],
) -> list[NDArray[np.float64]]:
    """Return the values of a field by its name, no numbers in bodies that have no such field."""
    names: set[str] = set(besides).union(*known)
    if name not in names:
        raise MPMError(f"There is no field {name!r}; there are {', '.join(sorted(names))}.")
    none = (np.full(body.num_local, np.nan) for body in bodies)
    return [own.get(name, empty) for own, empty in zip(known, none, strict=True)]


def _known(
    problem: Any, bodies: Sequence[Particles], number: int
) -> dict[str, NDArray[np.float64]]:
    """Return the fields of a body by their names."""
    body = bodies[number]
    gdim = body.mesh.geometry.dim
    vectors = {"displacement": body.centroid - body.initial_centroid}
    if hasattr(problem, "velocity"):
        velocity = problem.velocity
        function = velocity[number] if isinstance(velocity, list) else velocity
        dofmap = function.function_space.dofmap
        nodal = function.x.array.reshape(-1, dofmap.bs)
        vectors["velocity"] = nodal[dofmap.list[: body.num_local]].mean(axis=1)
    known: dict[str, NDArray[np.float64]] = {}
    for key, values in vectors.items():
        known[key] = np.linalg.norm(values, axis=1)
        known |= {f"{key}_{AXES[i]}": values[:, i] for i in range(gdim)}
    fields = body.fields()
    for key, values in fields.items():
        if values.ndim == 1:
            known[key] = values
    for key in {"stress", "total_stress"} & fields.keys():
        for i, j in zip(*np.triu_indices(3), strict=True):
            known[f"{key}_{AXES[i]}{AXES[j]}"] = fields[key][:, i, j]
    if body.has_material:
        stress = fields["stress"]
        deviator = stress - np.trace(stress, axis1=1, axis2=2)[:, None, None] / 3.0 * np.eye(3)
        known["mises"] = np.sqrt(1.5) * np.linalg.norm(deviator, axis=(1, 2))
    return {key: np.asarray(values, dtype=np.float64) for key, values in known.items()}
