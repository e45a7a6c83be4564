# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Points on facets of a body: where they are, what they weigh, forces and tangents on its nodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

import basix
from dolfinx import fem, la, mesh

from .. import _compat
from ..assembly.petsc import create_vector, with_entries_at
from ..errors import MPMError
from ..meshes.remesh import Column
from ..meshes.tags import require_on_boundary
from ..parallel.given import require_truth
from ..particles.particles import Particles
from ..tolerances import LAST_PLACES, ROUND_OFF

__all__ = [
    "NEAR",
    "Blocks",
    "Facets",
    "Layout",
    "PointMatrix",
    "Surface",
    "global_dofs",
    "global_nodes",
    "nodal_vector",
    "normals",
    "sizes_of",
]


#: How near what points may touch is looked for in a step, over the size of facets or the height of
#: the domains behind: farther than any goes in a step that converges; where one does, all is looked
#: at again.
NEAR = 2.0
#: Cells that narrow to a point over each of their facets.
SIMPLICES = (basix.CellType.triangle, basix.CellType.tetrahedron)


class Facets:
    """The facets of a body that may be in contact, on whatever mesh the body has.

    Args:
        particles: The body.
        facets: Tags of its facets, and the tag of those that may be in contact; ``None``: the whole
            boundary.
        what: What they are for, in a sentence.

    Raises:
        MPMError: Tags that are none.
    """

    def __init__(self, particles: Particles, facets: Any, what: str) -> None:
        body = particles.mesh
        dim = body.topology.dim - 1
        outer = _marked(body, particles.boundary())
        if facets is not None:
            a_what = f"{what[0].lower()}{what[1:]}"
            if not isinstance(facets, list | tuple) or len(facets) != 2:
                raise MPMError(
                    f"facets= of {a_what} must be tags and one of them, "
                    f"(tags, 1), not {facets!r:.80}."
                )
            facet_tags, tag = facets
            require_on_boundary(body, facet_tags, [tag], a_what)
            # (on any rank that knows the facet)
            outer = np.intersect1d(outer, _marked(body, facet_tags.find(tag)))
        # Tags are carried along where particles move; what a cut lays bare is none of them.
        self.tags = mesh.meshtags(body, dim, outer, np.ones(len(outer), dtype=np.int32))
        self._particles = particles

    def settle(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return owned cells and their local facets, in the order of both (collective)."""
        self.tags = self._particles.carry(self.tags)
        body = self._particles.mesh
        dim = body.topology.dim - 1
        body.topology.create_connectivity(dim + 1, dim)
        marked = np.zeros(_count(body, dim), dtype=bool)
        marked[_marked(body, self.tags.indices)] = True
        n = self._particles.num_local
        of_cells = body.topology.connectivity(dim + 1, dim).array
        of_cells = of_cells[: n * (len(of_cells) // max(_count(body, dim + 1), 1))]
        cells, facets = (
            np.nonzero(marked[of_cells.reshape(n, -1)]) if n else (np.zeros(0, int),) * 2
        )
        return cells.astype(np.int64), facets.astype(np.int64)


def _count(domain: mesh.Mesh, dim: int) -> int:
    index = domain.topology.index_map(dim)
    return int(index.size_local + index.num_ghosts)


def _marked(domain: mesh.Mesh, facets: NDArray[Any]) -> NDArray[np.int32]:
    """Return facets that are marked on any rank, all that this one knows (collective)."""
    dim = domain.topology.dim - 1
    marks = la.vector(domain.topology.index_map(dim), 1)
    marks.array[:] = 0.0
    marks.array[facets] = 1.0
    marks.scatter_reverse(la.InsertMode.add)
    marks.scatter_forward()
    return np.flatnonzero(marks.array > 0.0).astype(np.int32)


@dataclass(frozen=True, slots=True)
class Layout:
    """Facets of a body on one mesh.

    Attributes:
        cells: Owned cell of each facet, shape ``(m,)``.
        facets: Its local number in the cell, shape ``(m,)``.
        nodes: Local nodes of W of each facet, shape ``(m, k)``.
        own: Their places among :meth:`Surface.own_nodes`.
        outward: Whether the normal that the facet's order of nodes gives points outwards, as
            1 or -1, shape ``(m,)``.
        narrowing: The dimension where the domain behind narrows to a point, as triangles, halves of
            quadrilaterals and tetrahedra do, elsewhere 1, shape ``(m,)``.
        extent: Largest coordinate of the undeformed body.
        span: Its largest length along an axis.
        distinct: The nodes of all facets, each once, shape ``(n,)``.
        positions: Where they are in the mesh, shape ``(n, gdim)``.
        around: Length of the way around the axis of a body of revolution, elsewhere 1.
    """

    cells: NDArray[np.int64]
    facets: NDArray[np.int64]
    nodes: NDArray[np.int64]
    own: NDArray[np.int64]
    outward: NDArray[np.float64]
    narrowing: NDArray[np.int64]
    extent: float
    span: float
    distinct: NDArray[np.int64]
    positions: NDArray[np.float64]
    around: NDArray[np.float64]


class Surface:
    """Quadrature points on facets of a body, in its undeformed shape and as it is displaced.

    A body mesh never changes under it: :meth:`settle` is called where the body has another one.

    Args:
        particles: The body.
        facets: As for :class:`Facets`.
        degree: Degree of the rule on each facet; ``None`` is one more than twice the degree of
            the shape functions.
        axisymmetric: Whether ``x[0]`` is a radius.
        what: As for :class:`Facets`.

    Attributes:
        particles: As given.
        axisymmetric: As given.
        what: As given.
        nq: Number of points on each facet.
        reference_points: The points on each facet of the reference cell, ``(nq, tdim)`` each.
        element: The basix element of a facet.
        shapes: Its shape functions at the points, shape ``(nq, k)``.
        slopes: Their derivatives, shape ``(gdim - 1, nq, k)``.
        weights: Undeformed area of each point, all around the axis of a body of revolution,
            shape ``(m, nq)``; 0 where deleted.
        thickness: Undeformed height of the domain behind each facet, shape ``(m,)``: volume over
            area, times :attr:`Layout.narrowing`.
        stretch: Area of each point over the undeformed one at the beginning of the step that is
            tried, or else of the last one, shape ``(m, nq)``.
        last_stretch: The same of the last converged step.
    """

    def __init__(
        self,
        particles: Particles,
        facets: Any,
        degree: int | None,
        axisymmetric: bool,
        what: str,
    ) -> None:
        if degree is None:
            degree = 2 * int(particles.W.ufl_element().degree) + 1
        require_truth(f"axisymmetric of {what}", axisymmetric)
        self.particles = particles
        self.axisymmetric = axisymmetric
        self.what = what
        self._where = Facets(particles, facets, what)
        self._space: fem.FunctionSpace | None = None
        body, whole = particles.mesh, particles.W.ufl_element().basix_element
        cell, dim = body.basix_cell(), body.topology.dim - 1
        self.gdim: int = body.geometry.dim
        kind = basix.cell.subentity_types(cell)[dim][0]
        points, weights = map(np.asarray, basix.make_quadrature(kind, int(degree)))
        self.nq, self._rule = len(weights), weights
        self.element: Any = basix.create_element(
            basix.ElementFamily.P, kind, whole.degree, whole.lagrange_variant
        )
        table = np.asarray(self.element.tabulate(1, points), dtype=np.float64)[:, :, :, 0]
        self.shapes: NDArray[np.float64] = table[0]
        self.slopes: NDArray[np.float64] = table[1:]
        corners = [basix.geometry(cell)[side] for side in basix.topology(cell)[dim]]
        self.reference_points = [at[0] + points @ (at[1 : dim + 1] - at[0]) for at in corners]
        # (places of a facet's nodes among those of a cell, by its number there)
        self._nodes = [
            np.linalg.norm(
                (at[0] + self.element.points @ (at[1 : dim + 1] - at[0]))[:, None] - whole.points,
                axis=2,
            ).argmin(axis=1)
            for at in corners
        ]
        self._layout: Layout | None = None
        self._areas = self.weights = np.zeros((0, self.nq))
        self.stretch = self.last_stretch = self.weights
        self.thickness = np.zeros(0)

    @property
    def layout(self) -> Layout:
        """The facets on the present mesh."""
        assert self._layout is not None
        return self._layout

    def settle(self) -> bool:
        """Take the present mesh of the body; return whether it is another one (collective)."""
        body, W = self.particles.mesh, self.particles.W
        if self._space is W:
            return False
        self._space = W
        cells, facets = self._where.settle()
        x = self.particles.geometry.nodes
        nodes = np.zeros((len(cells), self.element.dim), dtype=np.int64)
        for side, own in enumerate(self._nodes):
            here = facets == side
            nodes[here] = W.dofmap.list[cells[here]][:, own]
        distinct, places = np.unique(nodes, return_inverse=True)
        origin = self.particles.undeformed.origin
        X = x if origin is None else origin.x.array.reshape(-1, self.gdim)
        self._areas = self._areas_of(X[nodes])
        middle = x[W.dofmap.list[cells]].mean(axis=1)
        centre = (self.shapes @ x[nodes]).mean(axis=1)
        n = normals(self._edges(x[nodes])).mean(axis=1)
        own = self.particles
        halves = own.trail.halves(own.global_index, own.num_global)
        narrows = (body.basix_cell() in SIMPLICES) | halves[cells]
        corners = self.particles.initial_domains.reshape(-1, self.gdim)
        ends = np.array([f.max(axis=0, initial=-np.inf) for f in (corners, -corners)])
        body.comm.Allreduce(MPI.IN_PLACE, ends, MPI.MAX)
        around = np.ones_like(self._areas)
        if self.axisymmetric:
            around = 2.0 * np.pi * (self.shapes @ X[nodes])[:, :, 0]
        layout = self._layout = Layout(
            cells,
            facets,
            nodes,
            places.reshape(nodes.shape),
            np.where(((centre - middle) * n).sum(axis=1) < 0.0, -1.0, 1.0),
            np.where(narrows, self.gdim, 1),
            float(ends.max()),
            float(ends.sum(axis=0).max()),
            distinct,
            x[distinct],
            around,
        )
        volume = self.particles.initial_volume[cells]
        self.thickness = layout.narrowing * volume / self._areas.sum(axis=1)
        self.look_at_deleted()
        self.begin_step()
        self.end_step()
        return True

    def look_at_deleted(self) -> None:
        """Take the weight from facets of domains that are deleted."""
        there = ~self.particles.deleted[self.layout.cells]
        self.weights = self._areas * self.layout.around * there[:, None]

    @property
    def spread(self) -> float:
        """How far a point moves at most where none of the nodes of its facet moves more than 1."""
        return float(np.abs(self.shapes).sum(axis=1).max())

    @property
    def touch(self) -> float:
        """Gap at which points touch: round-off of displacements and of coordinates."""
        return ROUND_OFF * self.layout.span + LAST_PLACES * self.layout.extent

    @property
    def mesh_area_ratio(self) -> NDArray[np.float64]:
        """Area in the present mesh over that of the undeformed body, shape ``(m, nq)``."""
        x = self.layout.positions[self.layout.own]
        return np.asarray(self._areas_of(x) / self._areas)

    # -- How wide facets have become ------------------------------------------------------------

    def begin_step(self) -> None:
        """Note the stretch of facets at the last converged step, where a step begins."""
        x = self.own_nodes(converged=True)[self.layout.own]
        self.stretch = self._areas_of(x) / self._areas
        if self.axisymmetric:
            around, now = self.layout.around, 2.0 * np.pi * np.abs((self.shapes @ x)[:, :, 0])
            # (a facet along the axis has no area)
            self.stretch *= np.divide(now, around, out=np.ones_like(now), where=around > 0.0)

    def end_step(self) -> Callable[[], None]:
        """Keep the stretch by which a step was made; return what takes that back."""
        before, self.last_stretch = self.last_stretch, self.stretch

        def undo() -> None:
            self.last_stretch = before

        return undo

    def roll_back(self) -> None:
        """Return to the stretch by which the last converged step was made."""
        self.stretch = self.last_stretch

    def take_stretch(self, kept: NDArray[np.float64]) -> None:
        """Take the stretch by which the last converged step was made, where it is known."""
        self.stretch = np.where(kept > 0.0, kept, self.stretch)
        self.end_step()

    def mesh_normals(self) -> NDArray[np.float64]:
        """Return outward unit normals in the present mesh, shape ``(m, nq, gdim)``."""
        return self._outward(self.layout.positions[self.layout.own])

    def undeformed_normals(self) -> NDArray[np.float64]:
        """Return outward unit normals of the undeformed body, as those in the present mesh."""
        origin = self.particles.undeformed.origin
        if origin is None:
            return self.mesh_normals()
        return self._outward(origin.x.array.reshape(-1, self.gdim)[self.layout.nodes])

    def _edges(self, x: NDArray[Any]) -> NDArray[np.float64]:
        """Return derivatives at points of facets with nodes x, ``(m, nq, gdim, gdim - 1)``."""
        return np.moveaxis(self.slopes[:, None] @ x, 0, -1)

    def _areas_of(self, x: NDArray[Any]) -> NDArray[np.float64]:
        """Return areas of points of facets with nodes x, shape ``(m, nq)``."""
        return np.asarray(np.linalg.norm(normals(self._edges(x)), axis=2) * self._rule)

    def _outward(self, x: NDArray[Any], which: Any = slice(None)) -> NDArray[np.float64]:
        """Return outward unit normals at points of facets with nodes x."""
        n = self.layout.outward[which, None, None] * normals(self._edges(x))
        return np.asarray(n / np.linalg.norm(n, axis=2)[:, :, None])

    def positions(
        self, converged: bool = False, which: NDArray[np.int64] | None = None
    ) -> NDArray[np.float64]:
        """Return the points as the body is displaced, shape ``(m, nq, gdim)``.

        Args:
            converged: Whether those at the last converged step are meant.
            which: Numbers of facets; ``None``: all.
        """
        places = self.layout.own if which is None else self.layout.own[which]
        return np.asarray(self.shapes @ self.own_nodes(converged)[places])

    def own_nodes(self, converged: bool = False) -> NDArray[np.float64]:
        """Return positions of the nodes of all facets, each once, shape ``(n, gdim)``."""
        body = self.particles
        d = body.converged_displacement if converged else body.displacement.x.array
        return np.asarray(self.layout.positions + d.reshape(-1, self.gdim)[self.layout.distinct])

    @property
    def size(self) -> float:
        """Median of the sizes of undeformed facets (collective)."""
        sizes = self._areas.sum(axis=1) ** (1.0 / (self.gdim - 1))
        return median(self.particles.mesh.comm, sizes)

    def normals(
        self, converged: bool = False, which: NDArray[np.int64] | None = None
    ) -> NDArray[np.float64]:
        """Return outward unit normals at the points, as the body is displaced, as positions."""
        chosen: Any = slice(None) if which is None else which
        return self._outward(self.own_nodes(converged)[self.layout.own[chosen]], chosen)

    def force(
        self,
        tractions: NDArray[np.float64],
        sign: float = 1.0,
        which: NDArray[np.int64] | None = None,
    ) -> PETSc.Vec:
        """Return the forces of tractions at the points on the nodes of W (collective).

        Args:
            tractions: Per undeformed area, shape ``(m, nq, gdim)``.
            sign: What they are multiplied by.
            which: Numbers of their facets; ``None``: all.
        """
        here = np.flatnonzero(tractions.any(axis=(1, 2)))
        acting = here if which is None else which[here]
        forces = self.shapes.T @ (sign * self.weights[acting, :, None] * tractions[here])
        return nodal_vector(self.particles.W, self.layout.nodes[acting], forces)

    # -- What is kept ---------------------------------------------------------------------------

    def column(self, values: NDArray[Any]) -> Column:
        """Return values at points ``(m, nq, ...)`` as a column on the facets of owned cells."""
        body = self.particles.mesh
        count = len(basix.topology(body.basix_cell())[body.topology.dim - 1])
        shape = (self.particles.num_local, count, *values.shape[1:])
        whole = np.zeros(shape, dtype=values.dtype)
        whole[self.layout.cells, self.layout.facets] = values
        return Column(whole, "facets")

    def of_column(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the values at points that :meth:`column` was given."""
        return np.asarray(values[self.layout.cells, self.layout.facets])

    def columns(self) -> dict[str, Column]:
        """Return undeformed areas and thicknesses, which another mesh does not show."""
        thickness = np.repeat(self.thickness[:, None], self.nq, axis=1)
        return {"area": self.column(self._areas), "thickness": self.column(thickness)}

    def restore(self, columns: dict[str, NDArray[Any]]) -> None:
        """Take the undeformed areas and thicknesses of before, where there are any."""
        area = self.of_column(columns["area"])
        known = area > 0.0
        self._areas = np.where(known, area, self._areas)
        thickness = self.of_column(columns["thickness"])[:, 0]
        self.thickness = np.where(known.all(axis=1), thickness, self.thickness)
        self.look_at_deleted()


def median(comm: MPI.Comm, values: NDArray[np.float64]) -> float:
    """Return the median of the values of all ranks (collective)."""
    return float(np.median(np.concatenate(comm.allgather(values))))


def normals(edges: NDArray[Any]) -> NDArray[Any]:
    """Return vectors normal to surfaces, of the size of their area element.

    Args:
        edges: Derivatives of positions, columns of ``(..., gdim, gdim - 1)``.
    """
    if edges.shape[-1] == 1:
        return np.stack([edges[..., 1, 0], -edges[..., 0, 0]], axis=-1)
    return np.cross(edges[..., 0], edges[..., 1])


def nodal_vector(
    W: fem.FunctionSpace, nodes: NDArray[np.int64], forces: NDArray[np.float64]
) -> PETSc.Vec:
    """Return the sum of forces on local nodes as a vector on W (collective).

    Args:
        W: Space of a body.
        nodes: Local nodes, shape ``(...)``.
        forces: Shape ``(..., gdim)``.
    """
    vector = create_vector(W)
    gdim = forces.shape[-1]
    with vector.localForm() as whole:
        whole.set(0.0)
        dofs = nodes[..., None] * gdim + np.arange(gdim)
        np.add.at(whole.array_w, dofs.ravel(), forces.ravel())
    vector.ghostUpdate(PETSc.InsertMode.ADD_VALUES, PETSc.ScatterMode.REVERSE)
    return vector


class Blocks(NamedTuple):
    """Dense blocks of a matrix.

    Attributes:
        keys: What each block is known by, shape ``(n,)``, each another: those of one key have the
            same rows and columns.
        rows: Global dofs of their rows, shape ``(n, r)``.
        columns: Global dofs of their columns, shape ``(n, c)``.
        values: Shape ``(n, r, c)``.
    """

    keys: NDArray[np.int64]
    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    values: NDArray[np.float64]


class PointMatrix:
    """A matrix on W of bodies by dense blocks, whose pattern grows as blocks come up.

    Args:
        rows: Space of its rows, or the number of those of this rank and of all.
        columns: Space of its columns, or their numbers.
            One of both is a space.
    """

    def __init__(
        self,
        rows: fem.FunctionSpace | tuple[int, int],
        columns: fem.FunctionSpace | tuple[int, int],
    ) -> None:
        spaces = [space for space in (rows, columns) if not isinstance(space, tuple)]
        self._comm: MPI.Comm = spaces[0].mesh.comm
        self._sizes = tuple(s if isinstance(s, tuple) else sizes_of(s) for s in (rows, columns))
        self._matrix: PETSc.Mat | None = None
        self._keys = np.zeros(0, dtype=np.int64)
        self._i = [self._keys]
        self._j = [self._keys]

    def of(self, part: Blocks) -> PETSc.Mat | None:
        """Return the matrix of some blocks, the same object where no new ones come (collective).

        Args:
            part: The blocks, all of one size.

        Returns:
            ``None`` where no rank has had any.
        """
        new = np.flatnonzero(~np.isin(part.keys, self._keys))
        if self._comm.allreduce(len(new) > 0, MPI.LOR):
            rows, columns = part.rows[new], part.columns[new]
            self._i.append(np.repeat(rows, columns.shape[1], axis=1).ravel())
            self._j.append(np.tile(columns, (1, rows.shape[1])).ravel())
            self._keys = np.concatenate([self._keys, part.keys[new]])
            i, j = map(np.concatenate, (self._i, self._j))
            self._matrix = with_entries_at(self._comm, self._sizes, i, j)
        if self._matrix is None:
            return None
        order = np.argsort(self._keys)
        places = order[np.searchsorted(self._keys, part.keys, sorter=order)]
        size = part.rows.shape[1] * part.columns.shape[1]
        values = np.zeros((len(self._keys), size))
        values[places] = part.values.reshape(len(places), size)
        _compat.set_entries(self._matrix, values.ravel())
        return self._matrix


def sizes_of(W: fem.FunctionSpace) -> tuple[int, int]:
    """Return the number of dofs of this rank and of all ranks."""
    index, bs = W.dofmap.index_map, W.dofmap.index_map_bs
    return index.size_local * bs, index.size_global * bs


def global_dofs(W: fem.FunctionSpace, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the global dofs of local nodes ``(n, k)`` of W, shape ``(n, k gdim)``."""
    bs = W.dofmap.index_map_bs
    dofs = global_nodes(W, nodes)[:, :, None] * bs + np.arange(bs)
    return np.asarray(dofs.reshape(len(nodes), nodes.shape[1] * bs))


def global_nodes(W: fem.FunctionSpace, nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the global numbers of local nodes of W, of any shape."""
    whole = W.dofmap.index_map.local_to_global(nodes.ravel().astype(np.int32))
    return np.asarray(whole, dtype=np.int64).reshape(nodes.shape)
