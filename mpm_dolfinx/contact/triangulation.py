# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Rigid shapes by segments in the plane and by triangles in space: polygons, terrain, files.

The distance is that of the nearest place, which lies within a facet, on an edge or at a corner.
Its sign is that of the normal of a facet, of the sum of both at an edge, and of the sum of all at a
corner, weighted by their angles (J. A. Baerentzen and H. Aanaes, "Signed distance computation using
the angle weighted pseudonormal", IEEE Trans. Vis. Comput. Graph. 11, 2005).
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, override

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError, agree, as_ours
from ..meshes.nearest import FacetTree
from ..parallel.given import as_positive
from ..plot.outlines import surface_algorithm
from ..reals import as_finite
from ..tolerances import NEGLIGIBLE, ROUND_OFF
from .orientation import edges_of, facet_normals, oriented
from .shapes import Shape, as_point, as_radius

__all__ = ["polygon", "polyline", "read_surface", "terrain", "triangulated"]

#: Least product of the normals of a facet before and after its corners were moved inwards.
KEPT = 0.5


class _Place(NamedTuple):
    """Distance of points to a surface, part by part.

    Attributes:
        arm: From the nearest corner or edge to the point; from some place of the plane, where that
            of a facet is nearest, shape ``(n, dim)``.
        size: Length of the arm, 1 where it is that of a plane, shape ``(n,)``.
        sign: -1 for a point inside, shape ``(n,)``.
        normal: That of the plane, shape ``(n, dim)``.
        along: Direction of the nearest edge, 0 where a corner is nearest, shape ``(n, dim)``.
        off: Whether an edge or a corner is nearest, and the point not on it, shape ``(n,)``.
    """

    arm: NDArray[Any]
    size: NDArray[Any]
    sign: NDArray[np.float64]
    normal: NDArray[np.float64]
    along: NDArray[np.float64]
    off: NDArray[np.bool_]


class _Faceted(Shape):
    """Solid behind segments or triangles, with rounded edges.

    Args:
        x: Corners of the surface, shape ``(n, dim)``.
        facets: Corners of each facet, shape ``(m, dim)``.
        outside: A direction that points to the free side of an open surface.
        radius: Of edges and corners.
        pivot: The point about which it turns; ``None``: the middle of the box around it.
        what: The surface, in a sentence.
        mean: Whether it turns about the mean of its points instead.

    Attributes:
        points: Corners of the facets, which lie within the surface by the radius.
        facets: Corners of each, oriented outwards.

    Raises:
        MPMError: They make no surface, or one that is too small for the radius.
    """

    costly = True

    def __init__(
        self,
        x: NDArray[np.float64],
        facets: NDArray[np.int64],
        outside: Any,
        radius: float,
        pivot: Any,
        what: str = "The surface",
        mean: bool = False,
    ) -> None:
        self._radius = as_radius(radius)
        self._outline, facets = _merged(x, facets)
        if len(facets) == 0:
            raise MPMError(f"{what} has no extent: all of its corners are at one place.")
        facets = self.facets = oriented(self._outline, facets, outside, what)
        points = self.points = _inner(self._outline, facets, self._radius, what)
        dim = x.shape[1]
        middle = (points if mean else self.bounds).mean(axis=0)
        if pivot is not None:
            middle = as_point(pivot, "pivot", dim)
        super().__init__(dim, middle)
        self._on = ROUND_OFF * float(np.abs(points).max(initial=0.0))
        corners = points[facets]
        self._normals = facet_normals(corners)
        self._tree = FacetTree(corners)
        self._at_corner, self._flat_corner = _corner_normals(points, facets, self._normals)
        self._end_corner = np.zeros(len(points), dtype=bool)
        if self.dim == 2:
            self._end_corner = np.bincount(facets.ravel(), minlength=len(points)) < 2
            return
        keys, self._of_facet, count = edges_of(facets)
        self._at_edge = np.zeros((len(keys), 3))
        for k in range(3):
            np.add.at(self._at_edge, self._of_facet[:, k], self._normals)
        # both normals of a flat edge are the same, and their sum is twice as long
        length = np.linalg.norm(self._at_edge, axis=1)
        self._flat_edge = (count == 2) & (length > 2.0 - NEGLIGIBLE**2)
        self._end_edge = count < 2
        self._end_corner[keys[self._end_edge].ravel()] = True

    @property
    @override
    def bounds(self) -> NDArray[np.float64]:
        return np.array([self._outline.min(axis=0), self._outline.max(axis=0)])

    @property
    @override
    def outline(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        return self._outline, self.facets

    def _resolved(self, y: NDArray[Any]) -> _Place:
        """Return the distance of points, part by part."""
        facet, corner, edge = self._tree(y.real)
        vertex = self.facets[facet, np.maximum(corner, 0)]
        arm = y - self.points[vertex]
        n, along = self._normals[facet], np.zeros(y.shape)
        off = (corner >= 0) & ~self._flat_corner[vertex]
        side, end = self._at_corner[vertex], self._end_corner[vertex] & off
        if self.dim == 3:
            on = edge >= 0
            which = self._of_facet[facet, np.maximum(edge, 0)]
            begin = self.points[self.facets[facet, np.maximum(edge, 0)]]
            way = self.points[self.facets[facet, (edge + 1) % 3]] - begin
            way /= np.maximum(np.linalg.norm(way, axis=1), 1e-300)[:, None]
            bent = on & ~self._flat_edge[which]
            off = off | bent
            along = np.where(bent[:, None], way, 0.0)
            beside = y - begin
            beside = beside - along * (beside * along).sum(axis=1)[:, None]
            arm = np.where(on[:, None], beside, arm)
            side = np.where(on[:, None], self._at_edge[which], side)
            end = np.where(on, self._end_edge[which], end)
        sign = np.where(((side * arm.real).sum(axis=1) < 0.0) & ~end, -1.0, 1.0)
        # what is on an edge has the normal that decides about the sign
        close = off & (np.linalg.norm(arm.real, axis=1) <= self._on)
        length = np.maximum(np.linalg.norm(side, axis=1), 1e-300)[:, None]
        n = np.where(close[:, None], side / length, n)
        off = off & ~close
        size = np.sqrt(np.where(off, (arm * arm).sum(axis=1), 1.0))
        return _Place(arm, size, sign, n, along, off)

    @override
    def distance(self, y: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        at = self._resolved(y)
        phi = np.where(at.off, at.sign * at.size, (at.arm * at.normal).sum(axis=1))
        n = np.where(at.off[:, None], at.arm * (at.sign / at.size)[:, None], at.normal)
        return phi - self._radius, n

    @override
    def curvature(self, y: NDArray[Any]) -> NDArray[Any]:
        at = self._resolved(y)
        n, t = at.arm / at.size[:, None], at.along
        across = np.eye(self.dim) - n[:, :, None] * n[:, None, :] - t[:, :, None] * t[:, None, :]
        return np.where(at.off[:, None, None], across * (at.sign / at.size)[:, None, None], 0.0)


def _corner_normals(
    points: NDArray[np.float64], facets: NDArray[np.int64], normals: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the weighted sum of normals at each corner, and whether all of them are equal."""
    m, dim = facets.shape
    corners = points[facets]
    weights = np.ones((m, dim))
    if dim == 3:
        one = np.roll(corners, -1, axis=1) - corners
        two = np.roll(corners, 1, axis=1) - corners
        across = np.linalg.norm(np.cross(one, two), axis=2)
        weights = np.arctan2(across, (one * two).sum(axis=2))
    total = np.zeros_like(points)
    for k in range(dim):
        np.add.at(total, facets[:, k], weights[:, k, None] * normals)
    unit = total / np.maximum(np.linalg.norm(total, axis=1), 1e-300)[:, None]
    flat = np.ones(len(points), dtype=bool)
    for k in range(dim):
        bent = np.linalg.norm(unit[facets[:, k]] - normals, axis=1) > NEGLIGIBLE
        flat[facets[bent, k]] = False
    if dim == 2:
        flat &= np.bincount(facets.ravel(), minlength=len(points)) == 2
    else:
        keys, _, count = edges_of(facets)
        flat[keys[count == 1].ravel()] = False
    return total, flat


def triangulated(
    points: Any, triangles: Any, *, outside: Any = None, radius: float = 0.0, pivot: Any = None
) -> Shape:
    """Return the solid behind triangles in space: a closed surface, or an open one.

    Triangles may be given in either sense of rotation, but all in the same; corners at one place
    are one. Beyond the border of an open surface there is no obstacle. Parts that go through each
    other are not looked for, and have wrong distances there.

    Args:
        points: Corners, shape ``(n, 3)``.
        triangles: Three corners each, shape ``(m, 3)``.
        outside: For an open surface, a direction that points to its free side, such as
            ``(0, 0, 1)`` for a terrain.
        radius: Of edges and corners, within the outline; see :func:`box`. The nodes are moved
            inwards by as much, which keeps planes where they are exactly where at most three meet
            in a node. A point that is pressed in by less than this slides over edges smoothly.
        pivot: The point about which it turns; the middle of the box around it by default.

    Raises:
        MPMError: What makes no surface: wrong shapes, edges of more than two triangles, triangles
            turned against each other, an open surface without ``outside``, or a radius that is
            too large.
    """
    x, facets = _as_arrays(points, triangles, 3, "triangulated")
    return _Faceted(x, facets, outside, radius, pivot)


def polygon(corners: Any, radius: float = 0.0) -> Shape:
    """Return a polygon in the plane, with corners rounded within its outline.

    It turns about the mean of its corners, less the radius.

    Args:
        corners: One after the other, in either sense, shape ``(n, 2)``; edges must not cross.
        radius: Of the outward corners; see :func:`box`.

    Raises:
        MPMError: No polygon, or one that is too small for the radius.
    """
    given = as_finite(corners, None, 2)
    if given is None or len(given) < 3:
        raise MPMError(f"A polygon needs three corners (x, y) or more, not {corners!r}.")
    count = np.arange(len(given))
    edges = np.column_stack([count, np.roll(count, -1)])
    return _Faceted(given, edges, None, radius, None, "The polygon", mean=True)


def polyline(points: Any, *, outside: Any = None, radius: float = 0.0, pivot: Any = None) -> Shape:
    """Return the solid behind a line of segments in the plane, such as the profile of a terrain.

    Beyond its ends there is no obstacle. It is closed where the last point is the first.

    Args:
        points: One after the other, shape ``(n, 2)``.
        outside: For an open line, a direction that points to its free side, such as ``(0, 1)``.
        radius: Of its corners, within the outline; see :func:`triangulated`.
        pivot: The point about which it turns; the middle of the box around it by default.

    Raises:
        MPMError: What makes no line; see :func:`triangulated`.
    """
    try:
        number = len(points)
    except (TypeError, NotImplementedError):  # one number, or UFL that is one
        number = 0
    count = np.arange(number)
    x, facets = _as_arrays(points, np.column_stack([count[:-1], count[1:]]), 2, "polyline")
    return _Faceted(x, facets, outside, radius, pivot)


def terrain(x: Any, y: Any, heights: Any, *, radius: float = 0.0, pivot: Any = None) -> Shape:
    """Return the solid below a height given on a grid, two triangles to each cell.

    Beyond the border there is no obstacle; let it reach farther than the body goes.

    Args:
        x: Places along the first axis, growing, shape ``(n,)``.
        y: Places along the second axis, growing, shape ``(m,)``.
        heights: Shape ``(n, m)``.
        radius: Of edges; see :func:`triangulated`.
        pivot: As there.

    Raises:
        MPMError: No grid of heights, or a radius that is too large.
    """
    lines = [line for v in (x, y) if (line := as_finite(v, None)) is not None and len(line) > 1]
    z = as_finite(heights, *map(len, lines))
    if z is None or len(lines) < 2 or not all((np.diff(line) > 0).all() for line in lines):
        raise MPMError(
            "A terrain needs two arrays of places that grow, (n,) and (m,), and finite heights "
            f"(n, m), not {np.shape(x)}, {np.shape(y)} and {np.shape(heights)}."
        )
    points = np.column_stack([*(v.ravel() for v in np.meshgrid(*lines, indexing="ij")), z.ravel()])
    number = np.arange(z.size).reshape(z.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    cells = [np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))]
    return _Faceted(points, np.concatenate(cells), (0.0, 0.0, 1.0), radius, pivot)


def read_surface(
    path: str | Path,
    *,
    outside: Any = None,
    radius: float = 0.0,
    scale: float = 1.0,
    pivot: Any = None,
    comm: MPI.Comm = MPI.COMM_WORLD,
) -> Shape:
    """Return the solid behind a triangulated surface of a file (collective).

    Rank 0 reads it by pyvista: STL, PLY, OBJ, VTK, VTP and more; of volumes the boundary is taken,
    and other polygons are divided.

    Args:
        path: The file.
        outside: For an open surface, a direction that points to its free side; see
            :func:`triangulated`.
        radius: Of edges and corners, after scaling; see there.
        scale: Factor on coordinates, such as 1e-3 for millimetres.
        pivot: The point about which it turns; the middle of the box around it by default.
        comm: The ranks that call it, those of the body.

    Raises:
        MPMError: No such file, no triangles in it, pyvista is missing, or see
            :func:`triangulated`.
    """
    factor = as_positive(scale, "scale")
    if not isinstance(path, str | Path):
        raise MPMError(f"read_surface needs the path of a file, not {path!r}.")
    found: tuple[NDArray[np.float64], NDArray[np.int64]] | None = None
    with agree(comm):
        if comm.rank == 0:
            found = _read(Path(path))
    found = comm.bcast(found)
    assert found is not None
    points, triangles = found
    return _Faceted(factor * points, triangles, outside, radius, pivot, f"The surface of {path}")


def _read(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return points and triangles of a file."""
    try:
        pyvista = import_module("pyvista")
    except ImportError:
        raise MPMError(
            "A surface from a file needs pyvista; install it with pip install 'mpm-dolfinx[plot]'."
        ) from None
    if not path.is_file():
        raise MPMError(f"There is no file {path}.")
    try:
        data = pyvista.read(path)
        if isinstance(data, pyvista.MultiBlock):
            data = data.combine()
        if not isinstance(data, pyvista.PolyData):
            data = data.extract_surface(**surface_algorithm(pyvista))
        surface = data.triangulate()
        points = np.asarray(surface.points, dtype=np.float64)
        triangles = np.asarray(surface.regular_faces, dtype=np.int64).reshape(-1, 3)
    except Exception as error:
        raise as_ours(error, f"Reading {path}") from error
    if len(triangles) == 0:
        raise MPMError(f"There are no triangles in {path}.")
    if triangles.min() < 0 or triangles.max() >= len(points):
        raise MPMError(f"Triangles of {path} have points that are not there.")
    if not np.isfinite(points).all():
        raise MPMError(f"The surface of {path} has points that are not finite.")
    return points, triangles


def _as_arrays(
    points: Any, facets: Any, dim: int, what: str
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    x = as_finite(points, None, dim)
    if x is None:
        raise MPMError(f"{what} needs finite points of the shape (n, {dim}), not {_told(points)}.")
    try:
        corners = np.array(facets)
    except (TypeError, ValueError):
        corners = np.zeros(0)
    if corners.ndim != 2 or corners.shape[1] != dim or not len(corners):
        names = "two points or more" if dim == 2 else "triangles of the shape (m, 3)"
        raise MPMError(f"{what} needs {names}, not {_told(points if dim == 2 else facets)}.")
    if not np.issubdtype(corners.dtype, np.integer) or corners.min() < 0 or corners.max() >= len(x):
        raise MPMError(f"triangles must be numbers of points from 0 to {len(x) - 1}.")
    return x, corners.astype(np.int64)


def _told(value: Any) -> str:
    shape = getattr(value, "shape", None)
    return f"{value!r:.80}" if shape is None else f"an array of the shape {shape}"


def _merged(
    x: NDArray[np.float64], facets: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return corners with one number for each place, and facets that have different ones."""
    used = np.unique(facets)
    step = NEGLIGIBLE * max(float(np.ptp(x[used], axis=0).max()), 1e-300)
    number = np.full(len(x), -1)
    keys = np.round((x[used] - x[used].min(axis=0)) / step).astype(np.int64)
    order = np.lexsort(keys.T)
    first = np.ones(len(used), dtype=bool)
    first[1:] = (np.abs(np.diff(keys[order], axis=0)) > 1).any(axis=1)
    group = np.cumsum(first) - 1
    number[used[order]] = group
    merged = x[used[order[first]]]
    facets = number[facets]
    good = (facets != np.roll(facets, -1, axis=1)).all(axis=1)
    return merged, facets[good]


def _inner(
    x: NDArray[np.float64], facets: NDArray[np.int64], radius: float, what: str
) -> NDArray[np.float64]:
    """Return corners moved inwards so that planes of facets move by a radius, as far as they can.

    The motion m of a corner is the shortest that comes nearest to ``n m = 1`` for the normals n of
    its facets.
    """
    dim = x.shape[1]
    if radius == 0.0:
        return x
    n = facet_normals(x[facets])
    A, b = np.zeros((len(x), dim, dim)), np.zeros((len(x), dim))
    for k in range(dim):
        np.add.at(A, facets[:, k], n[:, :, None] * n[:, None, :])
        np.add.at(b, facets[:, k], n)
    move = np.einsum("nij,nj->ni", np.linalg.pinv(A, rcond=1e-6, hermitian=True), b)
    inner = x - radius * move
    after = facet_normals(inner[facets])
    there = np.linalg.norm(n, axis=1) > 0.5
    if ((after * n).sum(axis=1)[there] < KEPT).any():
        raise MPMError(f"{what} has facets that are too small for the radius {radius:g}.")
    return np.asarray(inner)
