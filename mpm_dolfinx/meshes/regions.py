# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Where something is: planes, boxes and polygons; tags and Dirichlet conditions by them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem, mesh

from ..errors import MPMError, agree, as_ours
from ..parallel.boundary import collective
from ..parallel.given import is_number, not_a_value
from ..reals import as_reals, holds_ufl
from ..tolerances import NEGLIGIBLE
from .tags import require_tag
from .values import Value, as_ufl, interpolated, is_function

__all__ = ["cell_tags", "facet_tags", "held", "in_space", "marked", "region"]

#: What a Dirichlet value may be besides numbers.
KINDS = (
    "a Constant, a Function on V or the collapsed subspace of the component, or a function of "
    "coordinates"
)

type Where = Callable[[NDArray[np.float64]], Any]


def region(
    x: float | tuple[float, float] | None = None,
    y: float | tuple[float, float] | None = None,
    z: float | tuple[float, float] | None = None,
    *,
    polygon: Sequence[Any] | None = None,
) -> Where:
    """Return a function that tells which points lie in a region.

    It can be given to DOLFINx wherever that asks for a marker, to :func:`facet_tags`,
    :func:`cell_tags` and :func:`held`, and to ``problem.remove``.

    Args:
        x: A number: on the plane with this coordinate; a pair: from the one to the other, which may
            be infinite. ``None``: anywhere.
        y: The same.
        z: The same.
        polygon: Corners in the plane, shape ``(m, 2)``, in either sense: inside it or on its
            boundary, besides.

    Returns:
        A function of coordinates, shape ``(3, n)``, that returns a bool for each.

    Raises:
        MPMError: Something else, an interval that ends before it begins, or nothing at all.
    """
    bounds = [_bounds(name, value) for name, value in (("x", x), ("y", y), ("z", z))]
    corners = None
    if polygon is not None:
        try:
            corners = as_reals(polygon)
        except (TypeError, ValueError):
            corners = np.zeros(0)
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
            raise MPMError(f"polygon= needs three corners (x, y) at least, not {polygon!r}.")
    if corners is None and not any(bounds):
        raise MPMError("A region needs x=, y=, z= or polygon=.")

    def inside(points: NDArray[np.float64]) -> NDArray[np.bool_]:
        places = np.asarray(points, dtype=np.float64)
        near = NEGLIGIBLE * np.abs(places).max(initial=0.0)
        found = np.ones(places.shape[1], dtype=bool)
        for along, bound in zip(places, bounds, strict=False):
            if bound is not None:
                found &= (along >= bound[0] - near) & (along <= bound[1] + near)
        return found if corners is None else found & _in_polygon(places, corners, near)

    return inside


def in_space(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points ``(n, gdim)`` as functions of coordinates are given them, shape ``(3, n)``."""
    x = np.zeros((3, len(points)))
    x[: points.shape[1]] = points.T
    return x


def marked(where: Where, points: NDArray[np.float64], what: str) -> NDArray[np.bool_]:
    """Return at which points a function of coordinates holds.

    Args:
        where: The function, a user's.
        points: Shape ``(3, n)``.
        what: What to call it in an error.

    Raises:
        MPMError: It fails, or returns something else than a bool for each of the points.
    """
    try:
        inside = np.asarray(where(points))
    except MPMError:
        raise
    except Exception as error:
        raise as_ours(error, what) from error
    told = inside.dtype == np.bool_ or inside.size == 0  # of no points a list has no type
    if inside.shape != points.shape[1:] or not told:
        raise MPMError(
            f"{what} must return one bool for each of the coordinates (3, n), such as x[0] < 1.0, "
            f"not an array of shape {inside.shape} and type {inside.dtype}."
        )
    return inside.astype(np.bool_)


def _bounds(name: str, value: Any) -> tuple[float, float] | None:
    """Return from where to where a coordinate goes."""
    if value is None:
        return None
    try:
        ends = np.atleast_1d(as_reals(value))
    except (TypeError, ValueError):
        ends = np.zeros(0)
    if ends.shape not in ((1,), (2,)) or np.isnan(ends).any() or ends[0] > ends[-1]:
        raise MPMError(
            f"{name}= must be a number, or a pair of which the second is not below the first, not "
            f"{value!r}."
        )
    return float(ends[0]), float(ends[-1])


def _in_polygon(
    points: NDArray[np.float64], corners: NDArray[np.float64], near: float
) -> NDArray[np.bool_]:
    """Return which points are in a polygon, by crossings of a ray, or on its boundary."""
    x, y = points[0], points[1]
    inside = np.zeros(len(x), dtype=bool)
    on = np.zeros(len(x), dtype=bool)
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        crosses = (a[1] > y) != (b[1] > y)
        with np.errstate(divide="ignore", invalid="ignore"):
            at = a[0] + (y - a[1]) * (b[0] - a[0]) / (b[1] - a[1])
        inside ^= crosses & (x < at)
        along = b - a
        t = np.clip(
            ((x - a[0]) * along[0] + (y - a[1]) * along[1]) / max(along @ along, 1e-300), 0.0, 1.0
        )
        on |= np.hypot(x - a[0] - t * along[0], y - a[1] - t * along[1]) <= near
    return inside | on


@collective()
def facet_tags(domain: mesh.Mesh, where: Mapping[int, Where], interior: bool = False) -> Any:
    """Return tags of a mesh's facets (collective).

    Args:
        domain: The mesh, such as that of a body.
        where: For each tag where its facets are: all of their vertices lie there. Where two tags
            meet on a facet it has the latter.
        interior: Whether facets inside the mesh are meant as well as those on its boundary.

    Returns:
        The tags, for ``facet_tags=``.

    Raises:
        MPMError: No tags, or one that no facet has, or that a later one takes all of.
    """
    dim = domain.topology.dim - 1
    domain.topology.create_connectivity(dim, dim + 1)
    locate = mesh.locate_entities if interior else mesh.locate_entities_boundary
    return _tags(domain, dim, where, lambda inside: locate(domain, dim, inside), "facet")


@collective()
def cell_tags(domain: mesh.Mesh, where: Mapping[int, Where]) -> Any:
    """Return tags of a mesh's cells (collective).

    Args:
        domain: The mesh, such as that of a body.
        where: For each tag where the midpoints of its cells are; the latter of two is taken.

    Returns:
        The tags, for ``cell_tags=``.

    Raises:
        MPMError: No tags, or one that no cell has, or that a later one takes all of.
    """
    dim = domain.topology.dim
    index = domain.topology.index_map(dim)
    every = np.arange(index.size_local + index.num_ghosts, dtype=np.int32)
    middle = mesh.compute_midpoints(domain, dim, every).T

    def found(inside: Where) -> NDArray[np.int32]:
        return np.flatnonzero(inside(middle)).astype(np.int32)

    return _tags(domain, dim, where, found, "cell")


def _tags(
    domain: mesh.Mesh,
    dim: int,
    where: Any,
    found: Callable[[Where], NDArray[np.int32]],
    noun: str,
) -> Any:
    """Return tags of entities that are found by markers (collective)."""
    comm = domain.comm
    with agree(comm):
        if not isinstance(where, Mapping) or not where:
            raise MPMError(f"{noun}_tags needs {{tag: where, ...}}, not {where!r}.")
        for tag, inside in where.items():
            require_tag(tag, f"{noun}_tags")
            if not callable(inside):
                raise MPMError(
                    f"Where the {noun}s of tag {tag} are is a function of coordinates, such as "
                    f"mpm.region(x=0.0), not {inside!r}."
                )
    values: dict[int, int] = {}
    for tag, inside in where.items():
        with agree(comm):
            chosen = found(partial(marked, inside, what=f"The function of tag {tag}"))
        if not comm.allreduce(len(chosen)):
            raise MPMError(f"No {noun} of the mesh is where tag {tag} is asked for.")
        values.update(dict.fromkeys(chosen.tolist(), int(tag)))
    for tag in where:
        if not comm.allreduce(int(tag) in values.values()):
            raise MPMError(
                f"Nothing is left of tag {tag}: later tags are asked for where it is, and each "
                f"{noun} has one; let the smaller part come last."
            )
    places = np.array(sorted(values), dtype=np.int32)
    tags = np.array([values[place] for place in places.tolist()], dtype=np.int32)
    return mesh.meshtags(domain, dim, places, tags)


@collective()
def held(
    V: fem.FunctionSpace,
    component: int | None = None,
    where: Where | None = None,
    *,
    value: Value = 0.0,
    **planes: Any,
) -> fem.DirichletBC:
    """Return a Dirichlet condition on the facets of the background in a region (collective).

    ``mpm.held(V, 0, x=0.0)`` is a roller on the plane x = 0, ``mpm.held(V, y=0.0)`` a rough base.
    Facets inside the mesh count as well as those on its boundary, as bodies end anywhere.

    Args:
        V: The background space.
        component: The component that is held; ``None``: all of them, or the one of a scalar space.
        where: Where the facets are: all of their vertices lie there.
        value: A :data:`~mpm_dolfinx.meshes.values.Value`, with all components where all are held;
            of UFL Constants and Functions alone, on V or the collapsed subspace of the component.
        **planes: ``x=``, ``y=``, ``z=``, ``polygon=``, as in :func:`region`, in place of ``where``.

    Raises:
        MPMError: No facet is there, a component that there is not, or both kinds of regions.
    """
    domain = V.mesh
    comm, count = domain.comm, V.num_sub_spaces
    with agree(comm):
        if (where is None) == (not planes):
            raise MPMError("held() needs x=, y=, z= or polygon=, or a function where=.")
        unknown = set(planes) - {"x", "y", "z", "polygon"}
        if unknown:
            raise MPMError(f"held() has no {unknown.pop()}=; give x=, y=, z= or polygon=.")
        if component is not None and (isinstance(component, bool) or component not in range(count)):
            raise MPMError(f"There is no component {component!r} of a space with {count}.")
        inside = region(**planes) if where is None else where
        if not callable(inside):
            raise MPMError(f"where= must be a function of coordinates, not {inside!r}.")
    dim = domain.topology.dim - 1
    domain.topology.create_connectivity(dim, dim + 1)
    with agree(comm):
        facets = mesh.locate_entities(
            domain, dim, partial(marked, inside, what="The function where=")
        )
    if not comm.allreduce(len(facets), MPI.SUM):
        raise MPMError(
            "No facet of the background has all its vertices where it is to be held"
            f"{_of_planes(planes, domain)}; hold a point by a range with a facet in it, such as "
            "x=(-0.1, 0.1)."
        )
    space = V if component is None else V.sub(component)
    return _condition(V, space, component, facets, dim, value)


def _condition(
    V: fem.FunctionSpace,
    space: Any,
    component: int | None,
    facets: NDArray[np.int32],
    dim: int,
    value: Any,
) -> fem.DirichletBC:
    """Return the condition with a value on the dofs of facets (collective)."""
    domain, size = V.mesh, V.num_sub_spaces
    shape = (size,) if component is None and size else ()
    given = value
    if isinstance(value, fem.Constant):
        given = as_ufl(value, domain, "value=", shape)
    elif is_function(value):
        own = V if component is None else space.collapse()[0]
        given = interpolated(value, own, "value=")
    elif not isinstance(value, fem.Function):
        if holds_ufl(value):
            raise not_a_value("value=", value, shape, KINDS)
        numbers = [value] * size if shape and is_number(value) else value
        given = as_ufl(numbers, domain, "value=", shape).value
    if not isinstance(given, fem.Function):
        return fem.dirichletbc(given, fem.locate_dofs_topological(space, dim, facets), space)
    own = given.function_space
    same = own.mesh is domain and own.ufl_element() == space.ufl_element()
    if not same or (component is None and own is not V):
        raise not_a_value("value=", given, shape, KINDS)
    if component is None:
        return fem.dirichletbc(given, fem.locate_dofs_topological(V, dim, facets))
    pairs: Any = fem.locate_dofs_topological((space, own), dim, facets)
    return fem.dirichletbc(given, pairs, space)


def _of_planes(planes: Mapping[str, Any], domain: mesh.Mesh) -> str:
    """Return the place that was asked for, and the nearest grid line, in words (collective)."""
    words = []
    for axis, name in enumerate("xyz"):
        if isinstance(planes.get(name), float | int):
            coordinates = domain.geometry.x[:, axis]
            away = coordinates[np.argsort(np.abs(coordinates - planes[name]))[:1]]
            every = np.concatenate(domain.comm.allgather(away))
            nearest = every[np.argmin(np.abs(every - planes[name]))]
            words.append(f"{name} = {planes[name]:g}, the nearest vertex at {nearest:.9g}")
    return f" ({'; '.join(words)})" if words else ""
