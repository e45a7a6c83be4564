# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Grid lines that draw together towards a footing's edge or a toe, and meshes of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx import mesh

from ..errors import MPMError, agree
from ..parallel.boundary import collective
from ..parallel.given import require_whole
from ..reals import as_reals
from ..tolerances import EQUAL

__all__ = ["grid", "grid_lines"]

type Array = NDArray[np.float64]

#: Ratio of a cell's length to that of the one before, where they grow.
GROWTH = 1.2
#: Most cells along an axis: more is a mistake in units.
MOST = 1_000_000
#: Cells in the plane and in space, the first by default.
CELLS = (
    (mesh.CellType.quadrilateral, mesh.CellType.triangle),
    (mesh.CellType.hexahedron, mesh.CellType.tetrahedron),
)


def grid_lines(
    start: float,
    stop: float,
    size: float,
    *,
    equal: tuple[float, float] | None = None,
    finer_at: float | Sequence[float] = (),
    halvings: int = 5,
) -> Array:
    """Return the grid lines along one axis: equal cells, larger ones beyond, halved ones at places.

    Where a limit load is looked for the cells at the edge of the footing decide: its plastic flow
    turns about that point. ``grid_lines(0.0, 4.0, 0.25, equal=(0.0, 2.0), finer_at=1.0)`` has cells
    of 0.25 up to 2, from there on each a fifth longer than the one before, and those on both sides
    of 1 are halved five times towards it.

    Args:
        start: The first line.
        stop: The last one.
        size: Length of equal cells, of which a whole number is taken.
        equal: From where to where they are equal; ``None``: everywhere. Beyond it each cell is a
            fifth longer than the one before.
        finer_at: A place or several, taken to the nearest line.
        halvings: How often the cells on both sides of each are halved towards it.

    Returns:
        Coordinates in ascending order, for :func:`grid`.

    Raises:
        MPMError: Numbers that make no sense.
    """
    try:
        ends = (start, stop) if equal is None else tuple(equal)
        numbers = as_reals([start, stop, size, *ends])
        places = np.atleast_1d(as_reals(finer_at)) if np.size(finer_at) else np.zeros(0)
    except (TypeError, ValueError):
        raise MPMError("grid_lines() needs numbers: start, stop, size, equal= a pair.") from None
    if len(ends) != 2 or not np.isfinite(numbers).all() or not np.isfinite(places).all():
        raise MPMError("grid_lines() needs finite numbers, and equal= a pair of them.")
    if not (start <= ends[0] < ends[1] <= stop and size > 0.0):
        raise MPMError(
            f"grid_lines() needs a positive size, and equal= from start to stop, not {size:g} and "
            f"{ends} between {start:g} and {stop:g}."
        )
    if (stop - start) / size > MOST:
        raise MPMError(f"size={size:g} makes more than {MOST} cells of {stop - start:g}.")
    require_whole("halvings", halvings, MOST)
    if ((places < start) | (places > stop)).any():
        raise MPMError(f"finer_at={finer_at} is not between {start:g} and {stop:g}.")
    count = max(1, round((ends[1] - ends[0]) / size))
    middle = np.linspace(*ends, count + 1)
    h = (ends[1] - ends[0]) / count
    before, beyond = _longer(h, ends[0] - start), _longer(h, stop - ends[1])
    along = np.concatenate([(ends[0] - before)[::-1], middle, ends[1] + beyond])
    along[0], along[-1] = start, stop
    return _halved(along, places, halvings)


def _longer(h: float, reach: float) -> Array:
    """Return lines after one at 0, of which each is a fifth further, up to a reach."""
    if reach <= 0.0:
        return np.zeros(0)
    count = 1 + int(np.log1p(reach / h * (GROWTH - 1.0) / GROWTH) / np.log(GROWTH))
    places = np.cumsum(GROWTH ** np.arange(count + 1))
    enough = 1 + int(np.argmax(GROWTH * h * places >= reach))
    return np.asarray(reach * places[:enough] / places[enough - 1])


def _halved(along: Array, places: Array, times: int) -> Array:
    """Return lines with those added that halve the cells on both sides of places."""
    shares = 0.5 ** np.arange(1, times + 1)
    more = [along]
    for place in places:
        middle = int(np.argmin(np.abs(along - place)))
        for beside in (middle - 1, middle + 1):
            if 0 <= beside < len(along):
                more.append(along[middle] + (along[beside] - along[middle]) * shares)
    every = np.sort(np.concatenate(more))
    new = np.diff(every) > EQUAL * (along[-1] - along[0])
    return np.asarray(every[np.append(True, new)])


@collective()
def grid(
    comm: MPI.Comm, places: Sequence[Any], cell_type: mesh.CellType | None = None
) -> mesh.Mesh:
    """Return a mesh with given grid lines along each axis (collective).

    Its vertices may be moved afterwards, ``domain.geometry.x``, to make a slope of a rectangle.

    Args:
        comm: The communicator.
        places: The lines along x and y, or x, y and z, ascending, such as :func:`grid_lines` gives.
        cell_type: Quadrilaterals or hexahedra by default, or triangles or tetrahedra.

    Raises:
        MPMError: Not two or three axes, or lines that do not ascend.
    """
    with agree(comm):
        try:
            axes = [as_reals(along) for along in places]
        except (TypeError, ValueError):
            axes = []
        if len(axes) not in (2, 3):
            raise MPMError("grid() needs the lines along two or three axes, each a list.")
        for along in axes:
            if along.ndim != 1 or len(along) < 2 or not (np.diff(along) > 0.0).all():
                raise MPMError("The lines along an axis of grid() are two or more, ascending.")
            if not np.isfinite(along).all():
                raise MPMError("The lines along an axis of grid() must be finite.")
        kinds = CELLS[len(axes) - 2]
        if cell_type is not None and cell_type not in kinds:
            named = " or ".join(kind.name for kind in kinds)
            raise MPMError(
                f"cell_type of grid() with {len(axes)} axes is {named}, not {cell_type.name}."
            )
    counts = [len(along) - 1 for along in axes]
    box: list[Any] = [np.zeros(len(axes)), np.array(counts, dtype=np.float64)]
    if len(axes) == 2:
        domain = mesh.create_rectangle(
            comm,
            box,
            counts,
            cell_type or kinds[0],
            diagonal=mesh.DiagonalType.left_right,
        )
    else:
        domain = mesh.create_box(comm, box, counts, cell_type or kinds[0])
    for axis, along in enumerate(axes):
        place = domain.geometry.x[:, axis]
        place[:] = np.interp(place, np.arange(len(along)), along)
    return domain
