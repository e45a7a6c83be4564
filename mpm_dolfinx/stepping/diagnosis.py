# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Where and at what load a step failed, and what can be done about it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from ..constitutive.points import MaterialPoints
from ..errors import TRIAL_ERRORS, ConvergenceError, DomainDistortionError, MPMError, agreed
from ..history import Statistics
from ..parallel.magnitudes import norm
from ..parallel.totals import over_ranks
from ..particles.domains import crossed
from ..particles.particles import Particles
from ..stabilisation.joints import HARDLY
from ..system.field import Field
from ..system.free_field import FreeField
from ..system.reduced import ReducedSystem
from ..system.value_field import ValueField
from ..tolerances import NEGLIGIBLE

__all__ = ["count_folded", "improper", "placed"]

#: Share of the bodies' largest motion from which on it is that of a node of the background which is
#: held by next to nothing.
ASTRAY = 0.5


def improper(bodies: Sequence[Particles], materials: Sequence[MaterialPoints]) -> MPMError | None:
    """Return why the domains as they are now cannot be those of a converged step (collective).

    They may not cross themselves, nor reach across the axis of a body of revolution.

    Args:
        bodies: The bodies.
        materials: The materials at their points, if there are any.
    """
    found: MPMError | None = None
    for body in bodies:
        advice = ""
        if body.num_points == 1:
            advice = "take Particles(..., quadrature_degree=2), as one point lets them fold"
        found = found or DomainDistortionError.of("cross themselves", crossed(body), advice)
    for points in materials:
        found = found or DomainDistortionError.of(*points.strain.beyond())
    return agreed(bodies[0].mesh.comm, found)


def count_folded(bodies: Sequence[Particles], statistics: Statistics) -> None:
    """Count the curved domains that are folded (collective)."""
    curved = [body for body in bodies if body.W.ufl_element().degree > 1]
    if curved:
        folded = over_ranks(curved[0].mesh.comm, sum(len(body.folded()) for body in curved))
        statistics["folded_domains"] = max(statistics["folded_domains"], folded)


def placed(
    error: MPMError,
    reduced: ReducedSystem,
    load: float,
    limit: str | None = None,
    flips: Sequence[NDArray[np.int64]] = (),
    unstable: bool = False,
) -> MPMError:
    """Return an error that says at what load it happened, and what to do (collective).

    Args:
        error: It.
        reduced: The system whose residual did not vanish.
        load: Load, or parameter of the path, at the last converged step.
        limit: Beyond what no step gets, if that may be a limit, and what to do.
        flips: How often each particle began or ceased to yield, by body.
        unstable: Whether equilibrium seems to have lost its stability.
    """
    advice = {
        DomainDistortionError: "; take more steps, smaller loads or finer domains",
        ConvergenceError: "; take more steps, or look whether a limit load is reached",
    }.get(type(error), "")
    if error.advice or limit is not None:
        advice = f"; {error.advice or limit}"
    particles, text = error.particles, error.message.rstrip(".")
    dofs: list[int] = []
    lost = any([not np.isfinite(norm(field.force)) for field in reduced.fields])
    if (lost or isinstance(error, ConvergenceError)) and not particles:
        particles = _worst_particles(reduced)
        dofs, where, space = _worst_dof(reduced)
        if particles and dofs:
            text += f"; the residual is largest at dof {dofs[0]} of {space} near {where}"
            text += ", and at {particles}"
        for own in reduced.unknowns.own:
            if own.advice and own.left() > NEGLIGIBLE:
                text += f"; {own.advice.format(f'{own.left():.1e}')}"
    if isinstance(error, TRIAL_ERRORS):
        astray = max(map(_astray, reduced.fields), default=None)
        if astray is not None and astray.moves > 0.0:
            text += (
                f"; the background's node near {astray.where} is held by next to nothing (a "
                f"weight of {astray.weight:.1e})"
            )
            advice = "; move the background or the bodies a little, or use stabilisation='ghost'"
        else:
            text += _flipping(reduced, flips)
        if unstable:
            text += (
                "; equilibrium may turn unstable there, as where a body buckles, necks or wrinkles "
                "(tangents are indefinite)"
            )
    told = type(error)(f"{text}, in the step after load {load:.6g}{advice}.", particles, load)
    told.dofs, told.where = dofs, error.where
    return told


class _Astray(NamedTuple):
    """A node of the background that the bodies' largest motion hangs on, though hardly held.

    Attributes:
        moves: How far it moves the bodies, 0 where there is none.
        weight: The largest weight that a node of the bodies has for it.
        where: Its place.
    """

    moves: float
    weight: float
    where: tuple[float, ...]


def _astray(field: Field) -> _Astray:
    """Return the node of a field that is hardly held and moves the bodies most (collective)."""
    comm: MPI.Comm = field.V.mesh.comm
    found = _Astray(0.0, 0.0, ())
    if isinstance(field, ValueField) or over_ranks(comm, field.free is None, MPI.LOR):
        return found
    bs, gdim = field.V.dofmap.index_map_bs, field.V.mesh.geometry.dim
    u = np.linalg.norm(np.nan_to_num(field.u.array_r).reshape(-1, bs), axis=1)
    bodies = [np.nan_to_num(motion.of(field.u).array_r) for motion in field.motions]
    least = ASTRAY * over_ranks(
        comm, max(float(np.abs(moved).max(initial=0.0)) for moved in bodies), MPI.MAX
    )
    hold = field.touched.hold()
    moves = np.where(hold <= HARDLY, hold * u, 0.0)
    node = int(moves.argmax()) if len(moves) else -1
    if node >= 0 and moves[node] > least:
        x = field.V.tabulate_dof_coordinates()[node, :gdim]
        where = tuple(float(round(c, 6)) for c in x)
        found = _Astray(float(moves[node]), float(hold[node]), where)
    every: list[_Astray] = comm.allgather(found)
    return max(every)


def _flipping(reduced: ReducedSystem, flips: Sequence[NDArray[np.int64]]) -> str:
    """Say how many particles begin and cease to yield by turns, and where (collective)."""
    comm: MPI.Comm = reduced.bodies[0].V.mesh.comm
    which = comm.allgather([np.flatnonzero(each > 1) for each in flips])
    count = sum(len(each) for rank in which for each in rank)
    if count == 0:
        return ""
    bodies = [body for body in reduced.bodies if isinstance(body, Particles)]
    places = [body.centroid[each > 1] for body, each in zip(bodies, flips, strict=False)]
    x = np.concatenate([p for rank in comm.allgather(places) for p in rank])
    where = tuple(float(f"{c:.4g}") for c in np.median(x, axis=0))
    return f"; {count} particles around {where} flip between elastic and plastic"


def _worst_dof(reduced: ReducedSystem) -> tuple[list[int], tuple[float, ...], str]:
    """Return the global dof with the largest residual, if any, where it is, and its space."""
    best: tuple[float, int, tuple[float, ...], int] = (-1.0, -1, (), 0)
    for number, field in enumerate(reduced.fields):
        best = max(best, (*_worst_of(field), number))
    _, dof, where, number = max(reduced.fields[0].V.mesh.comm.allgather(best))
    field = reduced.fields[number]
    if isinstance(field, FreeField):
        space = "W, where nodes are free,"
    elif len([one for one in reduced.fields if not isinstance(one, FreeField)]) == 1:
        space = "V"
    else:
        space = f"the V of background {number}"
    return ([dof] if dof >= 0 else []), where, space


def _worst_of(field: Field) -> tuple[float, int, tuple[float, ...]]:
    """Return this rank's largest residual of a field, its global dof, and where that is."""
    if field.free is None or len(field.dofs) == 0:
        return -1.0, -1, ()
    V, gdim = field.V, field.V.mesh.geometry.dim
    size = np.nan_to_num(np.abs(field.force.array_r[field.dofs]), nan=np.inf)
    dof = int(field.dofs[size.argmax()])
    x = V.tabulate_dof_coordinates()[dof // V.dofmap.index_map_bs, :gdim]
    start = V.dofmap.index_map.local_range[0] * V.dofmap.index_map_bs
    return float(size.max()), start + dof, tuple(float(round(c, 6)) for c in x)


def _worst_particles(reduced: ReducedSystem) -> list[int]:
    """Return the particles at the node with the largest residual."""
    best: tuple[float, list[int]] = (0.0, [])
    for field in reduced.fields:
        if field.free is None:
            continue
        residual = field.force.duplicate()
        residual.set(0.0)
        residual.array_w[field.dofs] = field.force.array_r[field.dofs]
        comm: MPI.Comm = field.V.mesh.comm
        for motion in field.motions:
            body = motion.particles
            size = np.nan_to_num(motion.nodal_size(residual), nan=np.inf)
            largest = comm.allreduce(float(size.max(initial=0.0)), MPI.MAX)
            if largest <= best[0]:
                continue
            nodes = np.flatnonzero(size >= largest)
            touches = np.isin(body.domain_nodes, nodes).any(axis=1)
            mine = [int(p) for p in body.global_index[touches]]
            best = largest, sorted({p for ps in comm.allgather(mine) for p in ps})
    return best[1]
