# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""All bodies of a problem in one picture, coloured by a field."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError, agree
from ..parallel.boundary import collective
from ..particles.particles import Particles
from .fields import Field, Lines, bodies_of, lines_of, values_of
from .looks import Look, look_of
from .outlines import (
    edges,
    grid,
    imported,
    outlines,
    require_axes,
    surface_algorithm,
)

__all__ = ["Shot", "directions", "draw", "framed", "new_figure", "scene", "take"]

#: Room around the bodies, relative to their extent; size of a background over theirs up to which it
#: is shown whole; pixels of the longer side in space.
MARGIN, NEARBY, PIXELS = 0.04, 3.0, 1500
#: Colour of obstacles.
OBSTACLE = "#b9b2a6"
#: Colour of structures without a field, and their width in points and in pixels of space. In
#: space bodies are as transparent as this where a field is that of structures within them.
STRUCTURE, WIDE, WIDE_IN_SPACE, CLEAR = "0.1", 2.0, 6.0, 0.2
#: Grey of bodies without a field.
NO_FIELD = "0.8"
#: How far obstacles are shown around bodies, over the extent of these; samples of their distance.
NEAR, SAMPLES = 0.3, 1e5


@dataclass(frozen=True)
class Shot:
    """The bodies at one moment, on rank 0.

    Attributes:
        bodies: Polygons ``(n, k, 2)`` in the plane, grids of pyvista in space, one for each body.
        values: One value for each domain of each body, ``None`` without a field.
        cells: Polygons of the backgrounds in the plane.
        marks: Points of contact ``(m, gdim)`` and their pressures ``(m,)``.
        extent: Corners of the box around all domains, shape ``(2, gdim)``.
        around: That around the backgrounds, if they are drawn.
        obstacles: What rigid obstacles tell of where they are: signed distance, bounds and facets.
        structures: Lines and surfaces of lower dimension.
    """

    bodies: list[Any]
    values: list[NDArray[np.float64]] | None
    cells: list[NDArray[np.float64]]
    marks: tuple[NDArray[np.float64], NDArray[np.float64]] | None
    extent: NDArray[np.float64]
    around: NDArray[np.float64] | None
    obstacles: list[Any]
    structures: list[Lines]

    @property
    def range(self) -> tuple[float, float]:
        """Smallest and largest value."""
        arrays = [self.marks[1]] if self.marks is not None else list(self.values or [])
        arrays += [lines.values for lines in self.structures if lines.values is not None]
        shown = np.concatenate([a[np.isfinite(a)] for a in arrays]) if arrays else np.zeros(0)
        return (float(shown.min()), float(shown.max())) if shown.size else (0.0, 1.0)


@collective("field", "ax")
def scene(
    problem: Any,
    field: Field = "displacement",
    path: str | Path | None = None,
    *,
    ax: Any = None,
    **look: Any,
) -> Any:
    """Draw all bodies of a problem as they are now, coloured by a field (collective).

    The picture is as large as the bodies, with some room for rigid obstacles beside them, which are
    drawn in grey and cut off there.

    In the plane the picture is matplotlib's, in space it is rendered by pyvista, off the screen,
    without perspective; the colour bar stands beside it.

    Args:
        problem: A problem, particles, or a list of particles.
        field: ``"displacement"`` (its length), ``"displacement_x"`` and so on, ``"volume_ratio"``;
            with a material ``"stress_xx"`` and so on, ``"mises"``, ``"pressure"``,
            ``"plastic_strain"``; with water in its pores ``"pore_pressure"``,
            ``"mean_effective_stress"`` instead of ``"pressure"``, ``"total_stress_xx"`` and so on,
            of an undrained material ``"excess_pore_pressure"``; unknowns besides by their names;
            of a moving body ``"velocity"``; ``"contact_pressure"`` at points of contact; of a
            :class:`Truss` ``"axial_force"``, of a :class:`Membrane` ``"membrane_force"`` and
            ``"membrane_force_across"``. A body that has no such field is grey, a structure black.
            Or values of your own, shape ``(n,)``, one for each particle that this rank owns, or a
            Function on the body's mesh, of which each domain shows the mean; for several bodies a
            list. ``None``: no colours.
        path: Where to save it, e.g. ``"scene.png"``.
        ax: Axes of matplotlib to draw on; only those of rank 0 count. A figure is made without.
        **look: How it looks, by attributes of :class:`Look`: ``label=``, ``cmap=``, ``limits=``,
            ``lines=``, ``camera=``, ``title=``, ``box=``, ``background=``, ``warp=``.

    Returns:
        The figure of matplotlib on rank 0, ``None`` elsewhere.

    Raises:
        MPMError: There is no such field or look, or a package for pictures is missing.
    """
    bodies = bodies_of(problem)
    comm: MPI.Comm = bodies[0].mesh.comm
    with agree(comm):
        own = look_of(look, field, bodies[0].mesh.geometry.dim)
    figures = imported("matplotlib.figure", comm)
    shot = take(problem, bodies, field, own)
    with agree(comm):
        if shot is None:
            return None
        require_axes(ax)
        figure = ax.figure if ax is not None else new_figure(figures, shot, own)
        draw(shot, own, figure.add_subplot() if ax is None else ax)
        if path is not None:
            figure.savefig(path, dpi=160, bbox_inches="tight")
        return figure


def framed(
    extent: NDArray[np.float64], around: NDArray[np.float64] | None, whole: bool = False
) -> NDArray[np.float64]:
    """Return a box with some room around the bodies, and around a background near them.

    Args:
        extent: Box around the bodies.
        around: That around the background, if it is drawn.
        whole: Whether it is shown in the plane too, if it is not much larger.
    """
    shown = whole or extent.shape[1] == 3
    near = (
        around is not None and np.ptp(around, axis=0).max() <= NEARBY * np.ptp(extent, axis=0).max()
    )
    if around is not None and shown and near:
        extent = np.array([np.minimum(extent[0], around[0]), np.maximum(extent[1], around[1])])
    room = MARGIN * float((extent[1] - extent[0]).max())
    return np.array([extent[0] - room, extent[1] + room])


def take(problem: Any, bodies: Sequence[Particles], field: Field, look: Look) -> Shot | None:
    """Return the bodies at this moment on rank 0 (collective)."""
    comm: MPI.Comm = bodies[0].mesh.comm
    gdim = bodies[0].mesh.geometry.dim
    planar = gdim == 2
    values = values_of(problem, bodies, field)
    shapes: list[Any] = []
    shown: list[NDArray[np.float64]] = []
    low, high = np.full(gdim, np.inf), np.full(gdim, -np.inf)
    for number, body in enumerate(bodies):
        kept = ~body.deleted
        index = comm.gather(body.global_index)
        mine = comm.gather(None if values is None else values[number])
        there = comm.gather(kept)
        polygons = comm.gather(outlines(body, look.warp)) if planar else None
        whole = None if planar else grid(body)
        if index is None or mine is None or there is None:
            continue
        order = np.argsort(np.concatenate(index))
        order = order[np.concatenate(there)[order]]
        if values is not None:
            shown.append(np.concatenate(mine)[order])
        if polygons is not None:
            shape = np.concatenate(polygons)[order]
            points = shape.reshape(-1, 2)
        else:
            shape = _kept(
                whole, np.concatenate(there)[np.argsort(np.concatenate(index))], look.warp
            )
            points = shape.points
        shapes.append(shape)
        if len(points):
            low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
    backgrounds = {id(body.V.mesh): body.V.mesh for body in bodies if not body.is_free}
    background = look.background and len(backgrounds) > 0
    boxes = [_box(one, comm) for one in backgrounds.values()]
    cells = [edges(one) for one in backgrounds.values()] if planar and background else []
    marks = (
        _marks(problem, comm) if isinstance(field, str) and field == "contact_pressure" else None
    )
    structures = lines_of(problem, field, look.warp)
    if comm.rank > 0:
        return None
    terms = getattr(problem, "terms", ())
    obstacles = [t.placed() for t in terms if hasattr(type(t), "placed")]
    for lines in structures:
        low = np.minimum(low, lines.points.min(axis=0))
        high = np.maximum(high, lines.points.max(axis=0))
    extent = _with_obstacles(np.array([low, high]), obstacles)
    return Shot(
        shapes,
        None if values is None else shown,
        [cell for cell in cells if cell is not None],
        marks,
        extent,
        np.array([np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)])
        if background
        else None,
        obstacles,
        structures,
    )


def _with_obstacles(extent: NDArray[np.float64], obstacles: Sequence[Any]) -> NDArray[np.float64]:
    """Return the box around the bodies, and around obstacles as far as they are near."""
    room = NEAR * float((extent[1] - extent[0]).max())
    low, high = extent[0] - room, extent[1] + room
    for obstacle in obstacles:
        bounds = obstacle.bounds
        if bounds is None and len(low) == 3:
            axes, phi = _sampled(obstacle, low, high)
            there = np.argwhere(np.abs(phi) <= axes[0][1] - axes[0][0])
            if len(there):
                bounds = [
                    [axis[i] for axis, i in zip(axes, end, strict=True)]
                    for end in (there.min(axis=0), there.max(axis=0))
                ]
        if bounds is not None:
            first, last = np.clip(bounds, low, high)
            if (first < last).all():
                extent = np.array([np.minimum(extent[0], first), np.maximum(extent[1], last)])
    return extent


def _kept(whole: Any, there: NDArray[np.bool_], warp: float) -> Any:
    """Return the grid of the domains that are there, displaced by more or less."""
    if warp != 1.0:
        whole.points = whole.points + (warp - 1.0) * whole.point_data["displacement"]
    return whole if there.all() else whole.extract_cells(np.flatnonzero(there))


def _box(domain: Any, comm: MPI.Comm) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the corners of the box around a mesh (collective)."""
    gdim = domain.geometry.dim
    x = domain.geometry.x[:, :gdim]
    corners = np.array([x.min(axis=0), x.max(axis=0)]) if len(x) else np.zeros((0, gdim))
    every = np.concatenate(comm.allgather(corners))
    return every.min(axis=0), every.max(axis=0)


def _marks(problem: Any, comm: MPI.Comm) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return points of contact and the pressures there on all ranks (collective)."""
    terms = [
        t
        for t in getattr(problem, "terms", ())
        if hasattr(type(t), "points") and hasattr(type(t), "pressure")
    ]
    with agree(comm):
        if not terms:
            raise MPMError("There is no contact pressure: the problem has no term of contact.")
    points = [part for t in terms for part in comm.allgather(t.points)]
    pressures = [part for t in terms for part in comm.allgather(t.pressure)]
    where, what = np.concatenate(points), np.concatenate(pressures)
    touching = what > 0.0
    return where[touching], what[touching]


def new_figure(figures: Any, shot: Shot, look: Look) -> Any:
    """Return an empty figure whose shape suits what is shown."""
    box = framed(shot.extent, shot.around) if look.box is None else look.box
    if len(box[0]) == 3:
        right, up, _ = directions(look)
        wide, high = np.abs(right) @ (box[1] - box[0]), np.abs(up) @ (box[1] - box[0])
    else:
        wide, high = np.maximum(box[1] - box[0], 1e-12)
    height = np.clip(8.0 * high / wide + (1.6 if high < wide else 0.4), 2.4, 8.6)
    return figures.Figure(figsize=(8.0, float(height)), layout="compressed")


def directions(look: Look) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return unit vectors to the right and upwards in a picture in space, and into it."""
    pyvista = import_module("pyvista")
    with _quiet():
        plotter = pyvista.Plotter(off_screen=True)
        if look.camera is None:
            plotter.view_vector((1.0, -1.6, 0.8), viewup=(0.0, 0.0, 1.0))
        else:
            plotter.camera_position = look.camera
        into, up = np.array(plotter.camera.direction), np.array(plotter.camera.up)
        plotter.close()
    right = np.cross(into, up)
    right /= np.linalg.norm(right)
    return right, np.cross(right, into), into


def draw(shot: Shot, look: Look, ax: Any, bar: bool = True) -> Any:
    """Draw a shot on axes of matplotlib, with a colour bar; return what has its colours."""
    first, last = shot.range if look.limits is None else _filled(look.limits, shot.range)
    coloured = shot.values is not None or shot.marks is not None
    if shot.extent.shape[1] == 2:
        artist = _draw_plane(shot, look, (first, last), ax)
    else:
        artist = _draw_space(shot, look, (first, last), ax)
    if look.title is not None:
        ax.set_title(look.title)
    if coloured and bar:
        flat = np.ptp(ax.get_ylim()) < np.ptp(ax.get_xlim())
        place = {"orientation": "horizontal", "shrink": 0.6} if flat else {"shrink": 0.8}
        colorbar = ax.figure.colorbar(artist, ax=ax, label=look.label, aspect=28, **place)
        colorbar.outline.set_linewidth(0.4)
    return artist


def _filled(
    limits: tuple[float | None, float | None], found: tuple[float, float]
) -> tuple[float, float]:
    first, last = (b if a is None else float(a) for a, b in zip(limits, found, strict=True))
    return first, last


def _colours(look: Look, limits: tuple[float, float]) -> Any:
    """Return the colour map of values."""
    normalise = import_module("matplotlib.colors").Normalize(*limits)
    colours = import_module("matplotlib.cm").ScalarMappable(normalise, look.cmap)
    colours.set_cmap(colours.cmap.with_extremes(bad=NO_FIELD))
    return colours


def _draw_plane(shot: Shot, look: Look, limits: tuple[float, float], ax: Any) -> Any:
    collections = import_module("matplotlib.collections")
    for cells in shot.cells:
        ax.add_collection(
            collections.PolyCollection(
                cells, facecolors="none", edgecolors="0.88", linewidths=0.4, zorder=0.5
            )
        )
    colours = _colours(look, limits)
    count = sum(len(polygons) for polygons in shot.bodies)
    lines = count < 20000 if look.lines is None else look.lines
    for number, polygons in enumerate(shot.bodies):
        filled = NO_FIELD if shot.values is None else colours.to_rgba(shot.values[number])
        width = float(np.clip(12.0 / np.sqrt(max(count, 1)), 0.1, 0.5))
        style = {"edgecolors": "0.2" if lines else "face", "linewidths": width}
        ax.add_collection(collections.PolyCollection(polygons, facecolors=filled, **style))
    for one in shot.structures:
        style = (
            {"color": STRUCTURE} if one.values is None else {"colors": colours.to_rgba(one.values)}
        )
        pieces = collections.LineCollection(
            one.points[one.cells], linewidths=WIDE, capstyle="round", zorder=2.5, **style
        )
        ax.add_collection(pieces)
    if shot.marks is not None:
        points, pressures = shot.marks
        ax.scatter(*points.T, s=9.0, c=colours.to_rgba(pressures), zorder=3)
    low, high = framed(shot.extent, shot.around) if look.box is None else look.box
    for obstacle in shot.obstacles:
        (x, y), phi = _sampled(obstacle, low, high)
        if phi.min() < 0.0 < phi.max():
            ax.contourf(x, y, phi.T, [phi.min(), 0.0], colors=[OBSTACLE], zorder=0.8)
            ax.contour(x, y, phi.T, [0.0], colors="0.25", linewidths=0.8, zorder=0.8)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    ax.set_aspect("equal")
    return colours


def _sampled(
    obstacle: Any, low: NDArray[np.float64], high: NDArray[np.float64]
) -> tuple[list[NDArray[np.float64]], NDArray[np.float64]]:
    """Return places along each axis and the distances at all, shape ``(n, m)`` or ``(n, m, k)``."""
    step = float((high - low).max()) / SAMPLES ** (1.0 / len(low))
    counts = np.ceil((high - low) / step).astype(int) + 1
    axes = [np.linspace(a, b, n) for a, b, n in zip(low, high, counts, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return axes, obstacle.distance(points.reshape(-1, len(low))).reshape(counts)


def _thin(pyvista: Any, one: Lines) -> Any:
    """Return a structure in space."""
    count = one.cells.shape[1]
    cells = np.column_stack([np.full(len(one.cells), count), one.cells]).ravel()
    whole = {"lines": cells} if count == 2 else {"faces": cells}
    return pyvista.PolyData(one.points, **whole)


def _paint(one: Lines, look: Look, limits: tuple[float, float]) -> dict[str, Any]:
    """Return how a structure in space is drawn."""
    tubes = {"line_width": WIDE_IN_SPACE, "render_lines_as_tubes": True, "show_scalar_bar": False}
    if one.values is None:
        return {"color": "#1a1a1a", **tubes}
    return {"scalars": one.values, "cmap": look.cmap, "clim": limits, "ambient": 0.45, **tubes}


def _solid(pyvista: Any, obstacle: Any, box: NDArray[np.float64]) -> Any:
    """Return the surface of an obstacle in space within a box, or nothing."""
    if obstacle.facets is not None:
        points, facets = obstacle.facets
        surface = pyvista.PolyData(points, np.column_stack([np.full(len(facets), 3), facets]))
        return surface.clip_box(box.T.ravel(), invert=False).extract_surface(
            **surface_algorithm(pyvista)
        )
    axes, phi = _sampled(obstacle, box[0], box[1])
    if not phi.min() < 0.0 < phi.max():
        return None
    grid = pyvista.RectilinearGrid(*axes)
    grid["distance"] = phi.ravel(order="F")
    return grid.contour([0.0], scalars="distance")


def _draw_space(shot: Shot, look: Look, limits: tuple[float, float], ax: Any) -> Any:
    colours = _colours(look, limits)
    ax.imshow(_rendered(shot, look, limits))
    ax.set_axis_off()
    return colours


def _rendered(shot: Shot, look: Look, limits: tuple[float, float]) -> NDArray[np.uint8]:
    """Return the picture of bodies in space, pixels ``(height, width, 3)``, cut out."""
    pyvista = import_module("pyvista")
    count = sum(grid.n_cells for grid in shot.bodies)
    lines = count < 60000 if look.lines is None else look.lines
    box = framed(shot.extent, shot.around) if look.box is None else look.box
    right, up, into = directions(look)
    size, middle = box[1] - box[0], box.mean(axis=0)
    wide, high = np.abs(right) @ size, np.abs(up) @ size
    pixels = [max(1, round(PIXELS * side / max(wide, high))) for side in (wide, high)]
    with _quiet():
        plotter = pyvista.Plotter(off_screen=True, window_size=pixels, lighting="three lights")
        within = any(one.values is not None for one in shot.structures)
        for number, body in enumerate(shot.bodies):
            body = body.copy()
            colour: dict[str, Any] = {"color": "lightgrey", "nan_color": "lightgrey"}
            if shot.values is not None:
                body.cell_data["shown"] = shot.values[number]
                colour = {"scalars": "shown", "cmap": look.cmap, "clim": limits}
            for data in (body.point_data, body.cell_data):
                for name in [n for n in data.keys() if n != "shown"]:
                    del data[name]
            linear = int(body.celltypes.max(initial=0)) < 68  # VTK's first type of any degree
            surface = body.clean(tolerance=1e-9) if linear else body
            surface = surface.extract_surface(
                nonlinear_subdivision=0 if linear else 3, **surface_algorithm(pyvista)
            )
            plotter.add_mesh(
                surface,
                show_edges=lines and linear,
                edge_color="#333333",
                line_width=0.6,
                show_scalar_bar=False,
                ambient=0.45,
                diffuse=0.6,
                specular=0.0,
                opacity=CLEAR if within else 1.0,
                **colour,
            )
        for one in shot.structures:
            plotter.add_mesh(_thin(pyvista, one), **_paint(one, look, limits))
        if shot.marks is not None and len(shot.marks[0]):
            cloud = pyvista.PolyData(shot.marks[0])
            cloud["shown"] = shot.marks[1]
            plotter.add_mesh(
                cloud,
                scalars="shown",
                cmap=look.cmap,
                clim=limits,
                point_size=8.0,
                render_points_as_spheres=True,
                show_scalar_bar=False,
            )
        for obstacle in shot.obstacles:
            solid = _solid(pyvista, obstacle, box)
            if solid is not None and solid.n_cells:
                look_of = {"smooth_shading": True, "split_sharp_edges": True}
                plotter.add_mesh(solid, color=OBSTACLE, ambient=0.35, diffuse=0.65, **look_of)
        if (
            shot.around is not None
            and (box[0] <= shot.around[0]).all()
            and (shot.around[1] <= box[1]).all()
        ):
            cells = pyvista.Box(shot.around.T.ravel())
            plotter.add_mesh(cells, style="wireframe", color="#999999", line_width=1.0)
        plotter.enable_parallel_projection()
        away = 2.0 * float(np.linalg.norm(size))
        plotter.camera_position = [middle - away * into, middle, up]
        plotter.camera.parallel_scale = high / 2.0
        plotter.reset_camera_clipping_range()
        plotter.enable_anti_aliasing("msaa")
        image = np.asarray(plotter.screenshot(return_img=True))
        plotter.close()
    if look.box is not None:  # shown as it is, so that frames of a movie have one size
        return image
    drawn = np.argwhere((image < 250).any(axis=2))
    if not len(drawn):
        return image
    (top, left), (bottom, right) = drawn.min(axis=0), drawn.max(axis=0) + 1
    return image[top:bottom, left:right]


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep VTK from saying that there is no screen, which is not asked for."""
    try:
        logger = import_module("vtkmodules.vtkCommonCore").vtkLogger
        before = logger.GetCurrentVerbosityCutoff()
        logger.SetStderrVerbosity(logger.VERBOSITY_OFF)
    except (ImportError, AttributeError):
        yield
        return
    try:
        yield
    finally:
        logger.SetStderrVerbosity(before)
