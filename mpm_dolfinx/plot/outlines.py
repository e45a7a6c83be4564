# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Domains of particles: as polygons of matplotlib in the plane, as a pyvista grid anywhere."""

from __future__ import annotations

from importlib import import_module
from inspect import signature
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import ArrayLike, NDArray

import basix
from dolfinx import fem, mesh

from .. import _compat
from ..errors import MPMError, agree
from ..meshes.order import vtk_cell
from ..parallel.boundary import collective
from ..parallel.given import is_number
from ..particles.particles import Particles
from ..reals import as_reals

__all__ = [
    "background",
    "domains",
    "edges",
    "grid",
    "imported",
    "outlines",
    "owned_values",
    "require_axes",
    "require_finite",
    "surface_algorithm",
]


@collective("values", "ax")
def domains(
    particles: Particles,
    values: ArrayLike | None = None,
    ax: Any = None,
    *,
    vmin: float | None = None,
    vmax: float | None = None,
    warp: float = 1.0,
    **options: Any,
) -> Any:
    """Draw the domains of particles in the plane at their current positions (collective).

    They are those of ``particles.displacement``, as the particles' values are: the last converged
    step's, or what has been written into it.

    Args:
        particles: The body.
        values: One value for each particle that this rank owns, shape ``(n,)``, shown by
            colour; ``None`` is one colour for all. Deleted particles are not drawn.
        ax: Axes to draw on, matplotlib's current ones by default; only that of rank 0 counts.
            Its aspect is made equal.
        vmin: Value of the first colour, the smallest by default.
        vmax: Value of the last colour, the largest by default.
        warp: Factor on the displacement; 0 draws the undeformed body.
        **options: Passed on to ``matplotlib.collections.PolyCollection``, such as ``cmap=``,
            ``facecolor=`` of domains without values, ``edgecolor=`` and ``linewidth=``.

    Returns:
        The ``PolyCollection`` on rank 0 (ready for ``fig.colorbar``), ``None`` elsewhere.

    Raises:
        MPMError: The body is not in the plane, ``values`` has another shape, or matplotlib is
            missing.
    """
    comm: MPI.Comm = particles.mesh.comm
    _require_plane(particles.mesh)
    with agree(comm):
        shown = None if values is None else owned_values(particles, values)
        options = {"edgecolor": "0.25", "linewidth": 0.3, **options}
        ends = {"vmin": vmin, "vmax": vmax}
        given = {name: value for name, value in ends.items() if value is not None}
        require_finite(warp=warp, linewidth=options["linewidth"], **given)
    collections = imported("matplotlib.collections", comm)
    present = ~particles.deleted
    index = comm.gather(particles.global_index[present])
    polygons = comm.gather(outlines(particles, warp)[present])
    colours = comm.gather(None if shown is None else shown[present])
    if index is None or polygons is None or colours is None:
        return None
    order = np.argsort(np.concatenate(index))
    if shown is not None:
        options = {"array": np.concatenate(colours)[order], "cmap": "viridis", **options}
    else:
        options = {"facecolor": "0.8", **options}
    artist = collections.PolyCollection(np.concatenate(polygons)[order], **options)
    if shown is not None:
        artist.set_clim(vmin, vmax)
    return _added(artist, ax)


@collective("ax")
def background(
    V: fem.FunctionSpace | mesh.Mesh,
    ax: Any = None,
    *,
    color: Any = "0.85",
    linewidth: float = 0.4,
    **options: Any,
) -> Any:
    """Draw the cells of a background grid in the plane (collective).

    Args:
        V: The background space, or its mesh.
        ax: Axes to draw on, matplotlib's current ones by default; only that of rank 0 counts.
            Its aspect is made equal.
        color: Colour of the lines.
        linewidth: Their width in points.
        **options: Passed on to ``matplotlib.collections.PolyCollection``.

    Returns:
        The ``PolyCollection`` on rank 0, ``None`` elsewhere.

    Raises:
        MPMError: The grid is not in the plane, or matplotlib is missing.
    """
    grid_mesh = V if isinstance(V, mesh.Mesh) else V.mesh
    comm: MPI.Comm = grid_mesh.comm
    _require_plane(grid_mesh)
    with agree(comm):
        require_finite(linewidth=linewidth)
    collections = imported("matplotlib.collections", comm)
    cells = edges(grid_mesh)
    if cells is None:
        return None
    options = {"facecolors": "none", "zorder": 0.5, **options}
    artist = collections.PolyCollection(cells, edgecolors=color, linewidths=linewidth, **options)
    return _added(artist, ax)


def edges(grid_mesh: mesh.Mesh) -> NDArray[np.float64] | None:
    """Return the cells of a grid in the plane as polygons ``(n, k, 2)`` on rank 0 (collective)."""
    own = grid_mesh.topology.index_map(grid_mesh.topology.dim).size_local
    _, corners = vtk_cell(grid_mesh.basix_cell(), 1, 0)
    nodes = _compat.geometry_dofmap(grid_mesh)[:own, corners]
    cells = grid_mesh.comm.gather(grid_mesh.geometry.x[nodes, :2])
    return None if cells is None else np.concatenate(cells)


@collective()
def grid(particles: Particles) -> Any:
    """Return the particles' own domains at their current positions for pyvista (collective).

    Cell data are ``particle`` (the global index), ``volume_ratio`` and, where there is a
    material, ``stress`` (Cauchy, nine components), ``pressure`` and ``plastic_strain``, and with
    ``outside="delete"`` ``deleted`` (0 or 1); point data ``displacement``. Domains share no
    points; curved ones are VTK's Lagrange cells.

    Args:
        particles: The body, in the plane or in space.

    Returns:
        A ``pyvista.UnstructuredGrid`` on rank 0, particles in the order of their global
        indices; ``None`` elsewhere.

    Raises:
        MPMError: pyvista is missing.
    """
    comm: MPI.Comm = particles.mesh.comm
    pyvista = imported("pyvista", comm)
    cell_type, nodes = vtk_cell(
        particles.mesh.basix_cell(),
        particles.W.ufl_element().degree,
        particles.domain_nodes.shape[1],
    )
    gdim = particles.mesh.geometry.dim
    data: dict[str, NDArray[Any]] = {
        "particle": particles.global_index,
        "start": particles.geometry.outlined(particles.initial_domains)[:, nodes],
        "now": particles.geometry.outlined(particles.domains)[:, nodes],
        **particles.fields(),
    }
    gathered = comm.gather(data)
    if gathered is None:
        return None
    order = np.argsort(np.concatenate([part["particle"] for part in gathered]))
    whole = {name: np.concatenate([part[name] for part in gathered])[order] for name in data}
    start, now = (
        np.pad(whole.pop(name).reshape(-1, gdim), ((0, 0), (0, 3 - gdim)))
        for name in ("start", "now")
    )
    cells = np.arange(len(now)).reshape(len(order), -1)
    sizes = np.full((len(order), 1), cells.shape[1])
    types = np.full(len(order), cell_type, dtype=np.uint8)
    result = pyvista.UnstructuredGrid(np.hstack([sizes, cells]).ravel(), types, now)
    result.point_data["displacement"] = now - start
    for name, values in whole.items():
        result.cell_data[name] = values.reshape(len(order), -1) if values.ndim > 1 else values
    return result


def outlines(particles: Particles, warp: float) -> NDArray[np.float64]:
    """Return the boundaries of the owned domains as polygons, shape ``(n, m, 2)``."""
    cell = particles.mesh.basix_cell()
    corners = basix.geometry(cell)[vtk_cell(cell, 1, 0)[1]]
    shape_functions = particles.W.ufl_element().basix_element
    pieces = 1 if shape_functions.degree == 1 else 8  # straight ones of a curved edge
    share = np.arange(pieces)[:, None] / pieces
    points = np.concatenate(
        [
            (1.0 - share) * a + share * b
            for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)
        ]
    )
    values = shape_functions.tabulate(0, points)[0, :, :, 0]
    start = particles.initial_domains
    now = start + warp * (particles.domains - start)
    return np.asarray(np.einsum("mk,nki->nmi", values, now))


def _require_plane(domain: mesh.Mesh) -> None:
    if (domain.geometry.dim, domain.topology.dim) != (2, 2):
        raise MPMError("Only bodies in the plane are drawn by matplotlib; use plot.grid in space.")


def imported(module: str, comm: MPI.Comm) -> Any:
    """Import an optional module on rank 0; ranks agree where it is missing."""
    with agree(comm):
        try:
            found = import_module(module) if comm.rank == 0 else None
        except ImportError:
            name = module.partition(".")[0]
            raise MPMError(
                f"Pictures need {name}; install it with pip install 'mpm-dolfinx[plot]'."
            ) from None
    return found


def surface_algorithm(pyvista: Any) -> dict[str, Any]:
    """Return how surfaces are found: pyvista warns of its new default unless it is named."""
    known = signature(pyvista.UnstructuredGrid.extract_surface).parameters
    return {"algorithm": "dataset_surface"} if "algorithm" in known else {}


def owned_values(particles: Particles, values: Any) -> NDArray[np.float64]:
    """Return values that a user has given, one for each particle that this rank owns.

    Raises:
        MPMError: They are something else.
    """
    try:
        array = as_reals(values)
    except (TypeError, ValueError):
        raise MPMError(
            f"values must be numbers, one for each particle of the rank, not {values!r}."
        ) from None
    if array.shape != (particles.num_local,):
        raise MPMError(
            f"values must have the shape ({particles.num_local},), one value for each particle "
            f"of the rank, not {array.shape}."
        )
    return array


def require_finite(**numbers: Any) -> None:
    """Raise an error unless values, by their names, are finite numbers."""
    for name, value in numbers.items():
        if not is_number(value) or not abs(value) < np.inf:
            raise MPMError(f"{name} must be a finite number, not {value!r}.")


def require_axes(ax: Any) -> None:
    """Raise an error unless something is axes of matplotlib, or ``None``."""
    if ax is not None and not isinstance(ax, import_module("matplotlib.axes").Axes):
        raise MPMError(f"ax must be axes of matplotlib, such as plt.gca(), not {ax!r}.")


def _added(artist: Any, ax: Any) -> Any:
    require_axes(ax)
    if ax is None:
        ax = import_module("matplotlib.pyplot").gca()
    ax.add_collection(artist)
    ax.set_aspect("equal")
    ax.autoscale_view()
    return artist
