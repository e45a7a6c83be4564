# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Results at material points, wherever the body has taken them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dolfinx import geometry

from ..errors import MPMError, agree
from ..parallel.boundary import collective
from ..parallel.totals import over_ranks
from ..reals import as_reals
from ..tolerances import NEGLIGIBLE
from .particles import Particles

__all__ = ["probe"]


@collective()
def probe(particles: Particles, points: Any, field: str = "displacement") -> NDArray[np.float64]:
    """Return a result at points of a body, the same on all ranks (collective).

    Points are where they were in the undeformed body, and move with it: asked after each step, a
    probe tells the history of a point.

    Args:
        particles: The body.
        points: Undeformed coordinates, shape ``(m, gdim)`` or ``(gdim,)``.
        field: ``"displacement"``, ``"position"``, or an unknown at nodes such as the
            ``"pore_pressure"`` of a :class:`PorousProblem`, all interpolated within the domain of
            a point; or a name in ``particles.fields()``, as ``"stress"``, ``"plastic_strain"``:
            the mean over the domain of the particle that has the point, the first of them
            between several that are not deleted.

    Returns:
        Values, shape ``(m, ...)``; of a single point without the first index. NaN where the domain
        of a point was deleted.

    Raises:
        MPMError: Points outside the body, a name that there is not, or a body that was rebased,
            whose mesh does not show the undeformed body.
    """
    comm, gdim = particles.mesh.comm, particles.mesh.geometry.dim
    with agree(comm):
        try:
            given = as_reals(points)
        except (TypeError, ValueError):
            given = np.zeros(0)
        if given.shape[-1:] != (gdim,) or given.ndim > 2 or not np.isfinite(given).all():
            raise MPMError(f"points must be numbers of shape (m, {gdim}), or one point ({gdim},).")
        if particles.undeformed.origin is not None:
            raise MPMError(
                "The body was rebased, so that its mesh does not show where points were in the "
                "undeformed body; probe() before that, or look at particles.centroid."
            )
    at = np.zeros((given.size // gdim, 3))
    at[:, :gdim] = given
    cells = _cells(particles, at)
    with agree(comm):
        values = _values(particles, field, at, cells)
    found = over_ranks(comm, values)
    return np.asarray(found[0] if given.ndim == 1 else found)


def _cells(particles: Particles, points: NDArray[np.float64]) -> NDArray[np.int32]:
    """Return this rank's particle at points in space, -1 where it is another's (collective).

    Of several it is the first, of those that are deleted only where there is no other.
    """
    mesh, comm = particles.mesh, particles.mesh.comm
    own = np.arange(particles.num_local, dtype=np.int32)
    order = particles.global_index + particles.num_global * particles.deleted
    x = mesh.geometry.x
    ends = (x.min(axis=0, initial=np.inf), x.max(axis=0, initial=-np.inf))
    low, high = np.swapaxes(comm.allgather(ends), 0, 1)
    slack = NEGLIGIBLE * float(np.linalg.norm(high.max(axis=0) - low.min(axis=0)))
    none = np.iinfo(np.int64).max
    names = np.full(len(points), none)
    cells = np.full(len(points), -1, dtype=np.int32)
    if len(own):
        tree = geometry.bb_tree(mesh, mesh.topology.dim, padding=slack, entities=own)
        found = geometry.compute_collisions_points(tree, points)
        offsets, near = found.offsets, found.array
        of = np.repeat(np.arange(len(points)), np.diff(offsets))
        squares = geometry.squared_distance(mesh, mesh.topology.dim, near, points[of])
        for point, cell in zip(of[squares <= slack**2], near[squares <= slack**2], strict=True):
            if order[cell] < names[point]:
                names[point], cells[point] = order[cell], cell
    first = np.min(comm.allgather(names), axis=0)
    with agree(comm):
        if (first == none).any():
            where = tuple(float(f"{c:.6g}") for c in points[first == none][0][: mesh.geometry.dim])
            raise MPMError(
                f"The point {where} is not in the undeformed body; give coordinates there, not "
                "those of the background or of a later time."
            )
    return np.where(names == first, cells, -1).astype(np.int32)


def _values(
    particles: Particles, field: str, points: NDArray[np.float64], cells: NDArray[np.int32]
) -> NDArray[np.float64]:
    """Return this rank's values at points in space, zeros at those of others."""
    mine, functions = cells >= 0, particles.functions()
    gone = np.flatnonzero(mine)[particles.deleted[cells[mine]]]
    of = "displacement" if field == "position" else field
    if of in functions:
        shape = functions[of].ufl_shape
        values = np.zeros((len(points), *shape))
        if mine.any():
            values[mine] = functions[of].eval(points[mine], cells[mine]).reshape(-1, *shape)
        if field == "position":
            values[mine] += points[mine, : particles.mesh.geometry.dim]
        values[gone] = np.nan
        return values
    fields = particles.fields()
    if field not in fields:
        names = ", ".join(["displacement", "position", *fields])
        raise MPMError(f"There is no field {field!r} of these particles; they have {names}.")
    values = np.zeros((len(points), *fields[field].shape[1:]))
    values[mine] = fields[field][cells[mine]]
    values[gone] = np.nan
    return values
