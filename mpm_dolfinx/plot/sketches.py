# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A problem in one picture: its materials, conditions, loads, obstacles and water."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import basix

from .. import _compat
from ..errors import MPMError, agree
from ..parallel.boundary import collective
from ..particles.particles import Particles
from .fields import bodies_of
from .looks import Look, corners
from .outlines import imported, require_axes
from .scenes import OBSTACLE, STRUCTURE, Shot, directions, draw, framed, new_figure, take

__all__ = ["sketch"]

type Array = NDArray[np.float64]

#: Tints of materials, and colours of what acts on bodies.
TINTS = ("#e3cfa4", "#b8cbb0", "#a9c3dc", "#d9b8a8", "#cfc3dd", "#d6d39a", "#bcbcbc", "#9fcac4")
COLOURS = {
    "held": "#222222",
    "held, not reached": "#a8a8a8",
    "moved": "#c03028",
    "support": "#3a7d34",
    "traction": "#c03028",
    "pressure": "#d97a00",
    "drained": "#1f6fb4",
}
#: Most marks of one kind, and the length of arrows, over the size of the bodies.
MOST, ARROW = 60, 0.07


@dataclass(frozen=True)
class _Marks:
    """Places where something acts on a body.

    Attributes:
        kind: One of ``COLOURS``.
        parts: The places, shape ``(m, k, gdim)``: points, or corners of facets.
        directions: In which it acts there, shape ``(m, gdim)``; of held points 1 in each
            component that is.
    """

    kind: str
    parts: Array
    directions: Array

    def gathered(self, comm: MPI.Comm) -> _Marks:
        """Return those of all ranks on rank 0 (collective)."""
        parts, directions = comm.gather(self.parts), comm.gather(self.directions)
        if parts is None or directions is None:
            return self
        return _Marks(self.kind, np.concatenate(parts), np.concatenate(directions))

    @property
    def points(self) -> Array:
        """One point of each place, shape ``(m, gdim)``."""
        return np.asarray(self.parts.mean(axis=1))

    def within(self, box: Array) -> _Marks:
        """Return those in a box."""
        there = ((self.points >= box[0]) & (self.points <= box[1])).all(axis=1)
        return _Marks(self.kind, self.parts[there], self.directions[there])

    def some(self) -> _Marks:
        """Return a part of them that can be told from each other in a picture."""
        order = np.lexsort(self.points.round(9).T)[:: -(-len(self.parts) // MOST) or 1]
        return _Marks(self.kind, self.parts[order], self.directions[order])


@collective("ax")
def sketch(problem: Any, path: str | Path | None = None, *, ax: Any = None, box: Any = None) -> Any:
    """Draw what a problem is made of, to be looked at before it runs (collective).

    The bodies as they are now, each material in a colour of its own; where the background or a body
    is held (a triangle points along the component, a square holds all), supports and loads on
    facets, boundaries that are drained, rigid obstacles and a water table. Arrows show what
    displacements and loads have a value now; of UFL there are the facets alone. In space all but
    bodies and obstacles are points, and the legend has the extent of the bodies.

    Args:
        problem: A problem.
        path: Where to save it, e.g. ``"sketch.png"``.
        ax: Axes of matplotlib to draw on; only those of rank 0 count. A figure is made without.
        box: What is shown instead of all bodies: as in :func:`scene`.

    Returns:
        The figure of matplotlib on rank 0, ``None`` elsewhere.

    Raises:
        MPMError: It is no problem, ``box`` is none, or a package for pictures is missing.
    """
    bodies = bodies_of(problem)
    comm: MPI.Comm = bodies[0].mesh.comm
    gdim = bodies[0].mesh.geometry.dim
    with agree(comm):
        if not hasattr(problem, "bcs"):
            raise MPMError("A sketch is of a problem; draw particles by mpm.plot.scene.")
        shown = corners(box, gdim)
    figures = imported("matplotlib.figure", comm)
    setup = getattr(problem, "setup", None)
    given = setup.bodies if setup is not None else [None] * len(bodies)
    values, names = _materials(bodies, given)
    marks = [one.gathered(comm) for one in _conditions(problem, bodies)]
    if setup is not None:
        marks += [one.gathered(comm) for one in _on_facets(setup)]
    marks = [one for one in marks if comm.allreduce(len(one.parts)) > 0]
    shot = take(problem, bodies, values if len(values) > 1 else values[0], Look())
    with agree(comm):
        if shot is None:
            return None
        require_axes(ax)
        colours = [*(TINTS[k % len(TINTS)] for k in range(len(names))), *COLOURS.values()]
        cmap = import_module("matplotlib.colors").ListedColormap(colours)
        limits = (-0.5, len(colours) - 0.5)
        if gdim == 2:
            shown = framed(shot.extent, shot.around, whole=True) if shown is None else shown
            marks = [part for part in (one.within(shown) for one in marks) if len(part.parts)]
        look = Look("", cmap, limits, box=shown)
        if gdim == 3:
            shot = _with_points(shot, marks, len(names))
        figure = ax.figure if ax is not None else new_figure(figures, shot, look)
        where = figure.add_subplot() if ax is None else ax
        draw(shot, look, where, bar=False)
        if gdim == 2:
            assert shown is not None
            size = float((shot.extent[1] - shot.extent[0]).max())
            for one in marks:
                _draw(one.some(), where, shot.extent.mean(axis=0), ARROW * size)
            for water in _tables(given):
                x = np.linspace(shown[0, 0], shown[1, 0], 200)
                level = np.broadcast_to(water.level_at(np.array([x, 0.0 * x])), x.shape)
                where.plot(x, level, "--", color=COLOURS["drained"], linewidth=1.2)
            where.set(xlabel="x", ylabel="y")
        else:
            _point(where, directions(look))
        _explain(where, names, marks, shot, given)
        if path is not None:
            figure.savefig(path, dpi=160, bbox_inches="tight")
        return figure


def _materials(bodies: Sequence[Particles], given: Sequence[Any]) -> tuple[list[Array], list[str]]:
    """Return the number of the material in each owned domain, and what materials are called."""
    values: list[Array] = []
    names: list[str] = []
    for number, (particles, body) in enumerate(zip(bodies, given, strict=True)):
        of = f" of body {number + 1}" if len(bodies) > 1 else ""
        own = np.full(particles.num_local, float(len(names)))
        if body is None or not isinstance(body.material, Mapping):
            names.append(
                f"body {number + 1}" if body is None else type(body.material).__name__ + of
            )
        else:
            tags = np.full(len(own), np.nan)
            cells = body.cell_tags.indices < len(own)
            tags[body.cell_tags.indices[cells]] = body.cell_tags.values[cells]
            for tag, law in body.material.items():
                own[tags == tag] = len(names)
                names.append(f"{type(law).__name__}, tag {tag}{of}")
        values.append(own)
    return values, names


def _conditions(problem: Any, bodies: Sequence[Particles]) -> list[_Marks]:
    """Return where Dirichlet conditions hold and move what carries the bodies."""
    found: list[_Marks] = []
    spaces: dict[int, tuple[Any, Any, list[Any]]] = {}
    gdim = bodies[0].mesh.geometry.dim
    for body in bodies:
        own = body.W.dofmap.index_map.size_local
        if not body.is_free:
            still = np.zeros(())
            spaces.setdefault(id(body.V), (body.V, still, []))[2].append(_carrying(body))
        if body.is_free or body.free_nodes is not None:
            moves = body.displacement.x.array.reshape(-1, gdim)[:own]
            spaces[id(body.W)] = (body.W, moves, [np.flatnonzero(body.free[:own])])
    for V, moves, nodes in spaces.values():
        held = np.zeros((V.dofmap.index_map.size_local, gdim), dtype=bool)
        moved = np.zeros(V.tabulate_dof_coordinates()[:, :gdim].size)
        for bc in problem.bcs:
            if _compat.is_condition_on(bc, V):
                held.reshape(-1)[_compat.own_dofs(bc, V)] = True
                bc.set(moved, None, 1.0)
        x = V.tabulate_dof_coordinates()[: len(held), :gdim] + moves
        u = moved.reshape(-1, gdim)[: len(held)]
        active, there = np.zeros(len(held), dtype=bool), held.any(axis=1)
        active[np.concatenate(nodes)] = True
        groups = {
            "held": there & active,
            "held, not reached": there & ~active,
            "moved": (u != 0.0).any(axis=1) & active,
        }
        for kind, which in groups.items():
            what = u if kind == "moved" else held.astype(float)
            found.append(_Marks(kind, x[which, None], what[which]))
    return found


def _carrying(body: Particles) -> NDArray[np.int64]:
    """Return this rank's nodes of V that carry a body, or lie around free nodes (collective)."""
    active = np.asarray(body.active_nodes, dtype=np.int64)
    if body.free_nodes is None:
        return active
    beneath = body.free_nodes.beneath
    first, last = body.V.dofmap.index_map.local_range
    around = np.unique(beneath.nodes[beneath.values != 0.0])
    every = np.unique(np.concatenate(body.mesh.comm.allgather(around))).astype(np.int64)
    mine = every[(every >= first) & (every < last)] - first
    return np.union1d(active, mine)


def _on_facets(setup: Any) -> list[_Marks]:
    """Return where there are loads, supports and drained boundaries on the bodies."""
    found = []
    for body in setup.bodies:
        for kind, pairs in (("traction", body.tractions), ("pressure", body.pressures)):
            found += [
                _of_facets(kind, body.particles, body.facet_tags.find(tag), value)
                for value, tag in pairs
            ]
        for _, tag in () if body.pore_fluid is None else body.pore_fluid.drained:
            found.append(_of_facets("drained", body.particles, body.facet_tags.find(tag)))
    for support in setup.supports:
        found.append(_of_facets("support", support.particles, support.facets()))
    return found


def _of_facets(kind: str, body: Particles, facets: NDArray[np.int32], value: Any = None) -> _Marks:
    """Return the marks on facets, local numbers, of which the owned ones count."""
    domain = body.mesh
    gdim, dim = domain.geometry.dim, domain.topology.dim - 1
    own = facets[facets < domain.topology.index_map(dim).size_local]
    domain.topology.create_connectivity(dim, dim + 1)
    domain.topology.create_connectivity(dim + 1, dim)
    around, within = (
        domain.topology.connectivity(*pair) for pair in ((dim, dim + 1), (dim + 1, dim))
    )
    layout = body.W.dofmap.dof_layout
    cells = np.array([around.links(f)[0] for f in own], dtype=np.int64)
    there = ~np.append(body.deleted, np.zeros(1, dtype=bool))[np.minimum(cells, body.num_local)]
    own, cells = own[there], cells[there]
    places = [int(np.flatnonzero(within.links(c) == f)[0]) for c, f in zip(cells, own, strict=True)]
    count = len(basix.topology(domain.basix_cell())[dim][0])
    ends = [layout.entity_closure_dofs(dim, place)[:count] for place in places]
    of_cells = body.W.dofmap.list[cells]
    nodes = np.take_along_axis(of_cells, np.array(ends, dtype=int).reshape(len(own), count), axis=1)
    now = body.geometry.nodes + body.displacement.x.array.reshape(-1, gdim)
    parts = now[nodes]
    inwards = now[of_cells].mean(axis=1) - parts.mean(axis=1)
    if kind == "pressure" and gdim == 2:
        along = parts[:, 1] - parts[:, 0]
        normal = np.column_stack([along[:, 1], -along[:, 0]])
        inwards = normal * np.sign(np.einsum("ni,ni->n", normal, inwards))[:, None]
    known = _known(value, () if kind == "pressure" else (gdim,))
    directions = known * inwards if kind == "pressure" else np.zeros_like(inwards) + known
    return _Marks(kind, parts, directions)


def _known(value: Any, shape: tuple[int, ...]) -> Array:
    """Return a value of numbers or a Constant, 0 of anything else."""
    try:
        return np.broadcast_to(np.asarray(getattr(value, "value", value), dtype=float), shape)
    except (TypeError, ValueError):
        return np.zeros(shape)


def _tables(given: Sequence[Any]) -> list[Any]:
    """Return the water tables in bodies."""
    waters = [body.pore_pressure for body in given if body is not None]
    return [water for water in waters if hasattr(water, "level_at")]


def _with_points(shot: Shot, marks: Sequence[_Marks], first: int) -> Shot:
    """Return a shot in space with points where something acts, numbered after the materials."""
    kinds = list(COLOURS)
    points = [one.points for one in marks]
    values = [np.full(len(one.parts), float(first + kinds.index(one.kind))) for one in marks]
    if not points:
        return shot
    return replace(shot, marks=(np.concatenate(points), np.concatenate(values)))


def _draw(marks: _Marks, ax: Any, middle: Array, size: float) -> None:
    """Draw what acts on the bodies in the plane."""
    colour, points = COLOURS[marks.kind], marks.points
    if marks.kind.startswith("held"):
        carets = {(0, True): 5, (0, False): 4, (1, True): 6, (1, False): 7}  # their tips are there
        for point, held in zip(points, marks.directions, strict=True):
            axis = int(np.flatnonzero(held)[0])
            shape = "s" if held.all() else carets[axis, bool(point[axis] < middle[axis])]
            ax.plot(*point, marker=shape, color=colour, markersize=3 if shape == "s" else 5)
        return
    if marks.parts.shape[1] > 1:
        lines = import_module("matplotlib.collections").LineCollection(
            marks.parts, colors=colour, linewidths=2.2, zorder=3
        )
        ax.add_collection(lines)
    length = np.linalg.norm(marks.directions, axis=1)
    there = length > 0.0
    if marks.kind in ("support", "drained") or not there.any():
        return
    arrows = size * marks.directions[there] / length[there].max()
    style = {"color": colour, "width": 0.003, "zorder": 5}
    pivot = "tail" if marks.kind == "moved" else "tip"
    ax.quiver(
        *points[there].T, *arrows.T, angles="xy", scale_units="xy", scale=1, pivot=pivot, **style
    )


def _point(ax: Any, towards: tuple[Array, Array, Array]) -> None:
    """Draw where x, y and z go in a picture in space."""
    right, up, _ = towards
    corner = ax.inset_axes((1.02, 0.0, 0.2, 0.3))
    corner.set(xlim=(-1.3, 1.3), ylim=(-1.3, 1.3), aspect="equal")
    corner.set_axis_off()
    for name, x, y in zip("xyz", right, up, strict=True):
        corner.annotate("", (x, y), (0.0, 0.0), arrowprops={"arrowstyle": "->"})
        corner.text(1.25 * x, 1.25 * y, name, ha="center", va="center")


def _explain(
    ax: Any, names: Sequence[str], marks: Sequence[_Marks], shot: Shot, given: Sequence[Any]
) -> None:
    """Add a legend."""
    patch, line = (
        import_module("matplotlib.patches").Patch,
        import_module("matplotlib.lines").Line2D,
    )
    handles = [
        patch(facecolor=TINTS[k % len(TINTS)], edgecolor="0.2", label=name)
        for k, name in enumerate(names)
    ]
    for kind in dict.fromkeys(one.kind for one in marks):
        point = kind.startswith(("held", "moved")) or shot.extent.shape[1] == 3
        style = {"marker": "s", "linestyle": "", "markersize": 4} if point else {"linewidth": 2.2}
        handles.append(line([], [], color=COLOURS[kind], label=kind, **style))
    if shot.structures:
        handles.append(line([], [], color=STRUCTURE, linewidth=2.2, label="structure"))
    if shot.obstacles:
        handles.append(patch(facecolor=OBSTACLE, edgecolor="0.25", label="obstacle"))
    if _tables(given):
        handles.append(line([], [], linestyle="--", color=COLOURS["drained"], label="water table"))
    for force in (body.body_force for body in given if body is not None):
        known = _known(force, (shot.extent.shape[1],)) if force is not None else np.zeros(1)
        if known.any():
            words = ", ".join(f"{value:g}" for value in known)
            handles.append(line([], [], linestyle="", label=f"body force ({words})"))
            break
    if shot.extent.shape[1] == 3:
        points = np.concatenate([body.points for body in shot.bodies])
        size = np.ptp(points, axis=0).max() or 1.0
        ends = np.round([points.min(axis=0) / size, points.max(axis=0) / size], 6) * size + 0.0
        for name, (low, high) in zip("xyz", ends.T, strict=True):
            handles.append(line([], [], linestyle="", label=f"{name} from {low:.3g} to {high:.3g}"))
    ax.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False)
