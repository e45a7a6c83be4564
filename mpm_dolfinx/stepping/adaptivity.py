# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Nodes freed where the background errs, until the error is as small as is asked for."""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from ..assembly.petsc import absolute
from ..errors import MPMError
from ..parallel.given import is_number
from ..particles.free import chosen_nodes
from ..particles.particles import Particles
from ..system.errors import Errors
from ..tolerances import LOCAL_ITERATIONS, SMALL
from .freeing import bad_nodes

__all__ = ["Adaptivity"]

#: What the background may err by where the rest of the error is above the tolerance already, over
#: that rest: it adds a twelfth.
BESIDE = 0.4
#: Share of what is too much of the background's error that is freed at a time (Doerfler 1996), and
#: to what part of the allowed one, so that the nodes seldom change.
MARKED, SPARE = 0.8, 0.5


class Adaptivity:
    """Frees nodes of bodies until the estimated error is as small as is asked for.

    What the background errs by is the sum of what it does at each node that it carries; the rest is
    the error of the bodies' own elements, on which no choice of nodes has an influence. Both
    together are to be at most the tolerance; or, where the rest is more than that, the background's
    part a small one. The fewest nodes are taken that have most of what is too much, with those that
    held dofs lead.

    Args:
        tolerance: Error allowed, relative to the deformation, in energy.

    Attributes:
        tolerance: As given.

    Raises:
        MPMError: The tolerance makes no sense.
    """

    def __init__(self, tolerance: float) -> None:
        if not is_number(tolerance) or not 0.0 < tolerance < 1.0:
            raise MPMError(f"adapt must be an error between 0 and 1, not {tolerance!r}.")
        self.tolerance = float(tolerance)

    @staticmethod
    def adapts(body: Particles) -> bool:
        """Return whether nodes of a body are freed."""
        return body.free_nodes is not None and not body.free_nodes.automatic

    def chosen(
        self, bodies: Sequence[Particles], errors: Errors
    ) -> list[tuple[Particles, NDArray[np.bool_]]]:
        """Return which local nodes of bodies are to be free, where those are others (collective).

        Args:
            bodies: All bodies, at their last converged step.
            errors: Their errors there.
        """
        comm: MPI.Comm = bodies[0].mesh.comm
        every = [_can_be_freed(body, bodies) if self.adapts(body) else None for body in bodies]
        nodal = [
            np.where(can[: len(error)], error, 0.0)
            for can, error in zip(every, errors.nodal, strict=True)
            if can is not None
        ]
        values = np.concatenate([*nodal, np.zeros(0)])
        parts = (*errors.nodal, *errors.own)
        ours, whole = comm.allreduce(
            np.array([values.sum(), sum(float(part.sum()) for part in parts)])
        )
        rest = whole - ours
        allowed = max(self.tolerance**2 * errors.energy - rest, BESIDE**2 * rest)
        if ours <= allowed:
            return []
        least = _threshold(values, MARKED * (ours - SPARE * allowed), comm)
        found = []
        for body, can, error in zip(bodies, every, errors.nodal, strict=True):
            if can is not None:
                wanted = can[: len(error)] & (error >= (1.0 - SMALL) * least)
                assert body.free_nodes is not None
                bound = body.free_nodes.bound & can  # (which the background lets slip)
                more = bound | chosen_nodes(body.W, np.flatnonzero(wanted))
                found.append((body, body.free | more))
        return found

    def complaint(self, found: float) -> str | None:
        """Return a warning that the last step of a run misses the tolerance, if it does.

        Args:
            found: Its error.
        """
        if found <= self.tolerance:
            return None
        return (
            f"adapt={self.tolerance:g} is not met: the error at the end is {found:.3g}, most of "
            "it of the bodies' own elements or of nodes that cannot be freed. Give a finer body "
            "mesh, a higher degree, or a larger tolerance."
        )


def _can_be_freed(body: Particles, bodies: Sequence[Particles]) -> NDArray[np.bool_]:
    """Return the local nodes that are carried, and not so for good reasons (collective).

    Domains around them may be bad, or they stick to another body by what carries both.

    Args:
        body: The body.
        bodies: All bodies.
    """
    assert body.free_nodes is not None
    kept = bad_nodes(body, body.node_positions)
    if others := [other for other in bodies if other is not body and other.V is body.V]:
        sticking = _nodes_beside(body, others)
        kept[: len(sticking)] |= sticking
    return ~(body.free | body.free_nodes.spent | chosen_nodes(body.W, np.flatnonzero(kept)))


def _nodes_beside(body: Particles, others: Sequence[Particles]) -> NDArray[np.bool_]:
    """Return this rank's own nodes that share a function of V with other bodies (collective)."""
    T = absolute(body.T)
    touched = T.createVecRight()
    touched.set(0.0)
    for other in others:
        its = absolute(other.T)
        one = its.createVecLeft()
        one.set(1.0)
        its.multTransposeAdd(one, touched, touched)
    beside = (T * touched).array_r.reshape(-1, body.W.dofmap.index_map_bs)
    return np.asarray((beside > 0.0).any(axis=1))


def _threshold(values: NDArray[np.float64], wanted: float, comm: MPI.Comm) -> float:
    """Return the largest number that values with a sum of so much are at or above (collective)."""
    low, high = 0.0, comm.allreduce(float(values.max(initial=0.0)), MPI.MAX)
    for _ in range(LOCAL_ITERATIONS):
        middle = 0.5 * (low + high)
        if comm.allreduce(float(values[values >= middle].sum())) >= wanted:
            low = middle
        else:
            high = middle
    return low
