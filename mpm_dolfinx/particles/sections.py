# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Axial force, shear force and bending moment of what is thin and solid."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx import mesh

from ..errors import MPMError, agree
from ..meshes.quadrature import nodal_forces, vector_product
from ..meshes.regions import in_space, marked
from ..meshes.tags import cells_with, is_pair_with_tags
from ..parallel.boundary import collective
from ..parallel.totals import over_ranks
from ..reals import as_reals
from ..tolerances import NEGLIGIBLE, SLIGHT
from .particles import Particles

__all__ = ["SectionForces", "section_forces"]

type Array = NDArray[np.float64]


@dataclass(frozen=True)
class SectionForces:
    """Forces across the sections of a wall, beam, pile or lining, the same on all ranks.

    In the plane they are per thickness, and shear force and moment are numbers: the moment is
    positive where the side to the right of the axis is in tension (the lower one of a beam drawn
    from left to right), and the shear force is its derivative along the axis, but for couples by
    shear on the faces. In space both are vectors: what the part beyond a section does to the part
    before it. The moment along the axis is the torque.

    Attributes:
        position: Centroids of the sections now, shape ``(m, gdim)``.
        direction: Unit vectors along the structure now, shape ``(m, gdim)``.
        axial: Axial force, tension positive, shape ``(m,)``.
        shear: Shear force, shape ``(m,)``, in space ``(m, 3)``.
        moment: Moment about the centroid, shape ``(m,)``, in space ``(m, 3)``.
    """

    position: Array
    direction: Array
    axial: Array
    shear: Array
    moment: Array


@collective()
def section_forces(
    particles: Particles,
    axis: Any,
    where: Callable[..., Any] | tuple[mesh.MeshTags, Any] | None = None,
) -> SectionForces:
    r"""Return the forces across the sections of a thin solid (collective).

    There is one section between each two points of the axis. A function :math:`\varphi` of the
    nodes is 0 before the first, 1 beyond the second and linear along the axis in between. With the
    first Piola-Kirchhoff stress P of the structure's cells, the positions x of their nodes and the
    centroid c of the section,

    .. math::
        f = \sum_I \varphi_I R_I, \qquad m = \sum_I \varphi_I \, (x_I - c) \times R_I, \qquad
        R_I = \int P\, \nabla N_I \,\mathrm{d}X .

    This is the work in a motion that is rigid beyond the section, and rests before it: free nodes
    have exactly the forces that are in equilibrium with what acts beyond, on any mesh and at any
    rotation; with ``f_bar=`` but for a share that falls with the square of cells' size. The stress
    is the total one where there is water. Laws of small strains are in equilibrium in the
    undeformed body, where their sections stay.

    Args:
        particles: The body that has the structure, or is it.
        axis: Points along the middle of the undeformed structure, shape ``(m + 1, gdim)``, such as
            ``np.linspace(foot, head, 21)``; the last is the first of a ring.
        where: Which cells are the structure: a function of undeformed centroids, such as
            ``mpm.region(...)``, or a pair of cell tags and a tag; ``None``: all of the body.

    Raises:
        MPMError: A body without a material or one of revolution, an axis that makes no sense,
            parts of it where the structure is not, or tags of another mesh than the present one.
    """
    comm, gdim = particles.mesh.comm, particles.mesh.geometry.dim
    chosen = _chosen(particles, where)
    with agree(comm):
        if particles.revolves:
            raise MPMError(
                "section_forces() is for structures in the plane and in space; a body of "
                "revolution bears around the axis too, which particles.stress tells."
            )
        points = _points(axis, gdim)
        cells = np.flatnonzero(chosen & ~particles.deleted)
        sections = _Sections(particles, points, cells)
    area, moments, directions = (over_ranks(comm, part) for part in sections.measures())
    missed = sections.missed(comm)
    with agree(comm):
        if (area <= NEGLIGIBLE * area.max()).any():
            i = int(np.argmin(area))
            raise MPMError(
                f"The structure is not between points {i} and {i + 1} of axis=; give points along "
                "its middle, and say by where= which cells it has."
            )
        if missed.max() > SLIGHT:
            i = int(np.argmax(missed))
            raise MPMError(
                f"The structure does not reach from point {i} to {i + 1} of axis=; give points "
                "along its middle that end where it does, or before."
            )
    centre = moments / area[:, None]
    along = directions / np.linalg.norm(directions, axis=1)[:, None]
    force, couple = (over_ranks(comm, part) for part in sections.forces(centre))
    axial = np.einsum("ni,ni->n", force, along)
    if gdim == 2:
        shear = along[:, 1] * force[:, 0] - along[:, 0] * force[:, 1]
        return SectionForces(centre, along, axial, shear, couple)
    return SectionForces(centre, along, axial, force - axial[:, None] * along, couple)


class _Sections:
    """The sections of a structure, as far as it is on this rank.

    Args:
        particles: The body.
        points: Of the axis, shape ``(m + 1, gdim)``.
        cells: The structure's domains.
    """

    def __init__(self, particles: Particles, points: Array, cells: NDArray[np.intp]) -> None:
        rule, gdim = particles.undeformed.rule, particles.geometry.gdim
        cauchy = particles.point_total_stress[cells, :, :gdim, :gdim]
        small = particles.has_small_strain[cells, None, None]
        nodes = particles.initial_domains[cells]
        self._nodes = np.where(small, nodes, particles.corners()[cells])
        self._points = np.where(small, particles.initial_points[cells], particles.points[cells])
        F = np.where(small[..., None], np.eye(3), particles.point_deformation_gradient[cells])
        self._F = F[:, :, :gdim, :gdim]
        self._weights, self._gradients = rule.weights[cells], rule.gradients[cells]
        ratio = np.linalg.det(F)[..., None, None]
        piola = ratio * np.linalg.solve(self._F, cauchy).swapaxes(2, 3)
        self._forces = nodal_forces(piola, self._weights, self._gradients, None)
        self._along = np.diff(points, axis=0) / _lengths(points)[:, None]
        self._cuts = []
        self._ends = []
        for step in _steps(points, nodes):
            cut = np.flatnonzero(np.ptp(step, axis=1) > 0.0)
            self._cuts.append((cut, step[cut]))
            self._ends.append((step.min(initial=1.0), 1.0 - step.max(initial=0.0)))

    def missed(self, comm: MPI.Comm) -> Array:
        """Return which share of each section's length is before or beyond all (collective)."""
        ends = np.array(self._ends)
        comm.Allreduce(MPI.IN_PLACE, ends, MPI.MIN)
        return np.asarray(ends.max(axis=1))

    def measures(self) -> tuple[Array, Array, Array]:
        """Return areas, and their integrals of position and of the direction along the axis."""
        area, position, direction = [], [], []
        for (cut, step), along in zip(self._cuts, self._along, strict=True):
            slope = np.einsum("nk,nqki->nqi", step, self._gradients[cut]) @ along
            parts = self._weights[cut] * slope
            area.append(parts.sum())
            position.append(np.einsum("nq,nqi->i", parts, self._points[cut]))
            direction.append(np.einsum("nq,nqij,j->i", parts, self._F[cut], along))
        return np.array(area), np.array(position), np.array(direction)

    def forces(self, centres: Array) -> tuple[Array, Array]:
        """Return forces, and moments about the centres of the sections."""
        force, moment = [], []
        for (cut, step), centre in zip(self._cuts, centres, strict=True):
            shares = step[:, :, None] * self._forces[cut]
            arms = self._nodes[cut] - centre
            force.append(shares.sum(axis=(0, 1)))
            moment.append(vector_product(arms, shares).sum(axis=(0, 1)))
        return np.array(force), np.array(moment)


def _points(axis: Any, gdim: int) -> Array:
    """Return the points of an axis."""
    try:
        points = as_reals(axis)
    except (TypeError, ValueError):
        points = np.zeros(0)
    fits = points.ndim == 2 and points.shape[1] == gdim and len(points) > 1
    if not (fits and np.isfinite(points).all() and np.diff(points, axis=0).any(axis=1).all()):
        raise MPMError(
            f"axis= must be two points or more, shape (m, {gdim}), no two of which in a row are "
            f"the same, not {axis!r}."
        )
    return points


def _chosen(particles: Particles, where: Any) -> NDArray[np.bool_]:
    """Return which of this rank's domains are the structure (collective)."""
    chosen = np.ones(particles.num_local, dtype=bool)
    if is_pair_with_tags(where):
        cells = cells_with(particles.mesh, where[0], where[1], "where=")
        chosen[:] = False
        chosen[cells[cells < particles.num_local]] = True
        return chosen
    with agree(particles.mesh.comm):
        if callable(where):
            chosen = marked(where, in_space(particles.initial_centroid), "The function where=")
        elif where is not None:
            raise MPMError(
                "where= is a function of coordinates such as mpm.region(...), or (cell tags, tag), "
                f"not {where!r}."
            )
    return chosen


def _lengths(points: Array) -> Array:
    """Return the lengths of a polyline's segments."""
    return np.asarray(np.linalg.norm(np.diff(points, axis=0), axis=1))


def _steps(points: Array, nodes: Array) -> Iterator[Array]:
    """Yield, segment by segment, how far nodes ``(n, k, gdim)`` are along it, from 0 to 1.

    A polyline that ends where it begins goes on there; beyond the ends of others all is straight.
    """
    lengths = _lengths(points)
    ends = np.append(0.0, np.cumsum(lengths))
    closed = bool((points[0] == points[-1]).all())
    least, most = (0.0, ends[-1]) if closed else (-np.inf, np.inf)
    low, high = np.append(least, ends[1:-1]), np.append(ends[1:-1], most)
    way, nearest = np.zeros(nodes.shape[:2]), np.full(nodes.shape[:2], np.inf)
    for i, unit in enumerate(np.diff(points, axis=0) / lengths[:, None]):
        foot = np.clip(ends[i] + (nodes - points[i]) @ unit, low[i], high[i])
        place = points[i] + (foot - ends[i])[..., None] * unit
        distance = np.linalg.norm(nodes - place, axis=2)
        nearer = distance < nearest
        way[nearer], nearest[nearer] = foot[nearer], distance[nearer]

    def shortest(ways: Array) -> Array:
        return ways - ends[-1] * np.round(ways / ends[-1]) if closed else ways

    first = way[:, :1]
    within = shortest(way - first)
    size = np.linalg.norm(np.ptp(nodes, axis=1), axis=1)
    if (np.ptp(within, axis=1) > 4.0 * size).any():  # a bend stretches it by less
        raise MPMError(
            "The structure goes from one part of axis= to another, or from its end back to its "
            "beginning; give an axis along all of it, which ends at its first point in a ring, or "
            "say by where= which cells to take."
        )
    for middle, length in zip(0.5 * (ends[1:] + ends[:-1]), lengths, strict=True):
        yield np.clip((shortest(first - middle) + within) / length + 0.5, 0.0, 1.0)
