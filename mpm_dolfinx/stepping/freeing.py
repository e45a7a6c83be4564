# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Nodes that are free as long as the domains around them are good."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError
from ..particles.free import chosen_nodes
from ..particles.particles import Particles
from ..transfer.matrix import transfer_matrix

__all__ = ["Carried", "TriedNodes", "bad_nodes", "carried_after", "relieve"]

#: Mean ratio of the deformation (1 undeformed, 0 flat) below which a domain is distorted: that of a
#: simple shear by 2.4 in the plane, where finite elements begin to stiffen.
LEAST_QUALITY = 0.25


class Carried(NamedTuple):
    """Nodes that the background carries from now on.

    Attributes:
        free: Bodies, and which of this rank's nodes of each stay free.
        too_late: Whether a free node has left the background, which should have carried it.
    """

    free: Sequence[tuple[Particles, NDArray[np.bool_]]]
    too_late: bool

    def apply(self) -> bool:
        """Carry them, for good; return whether there are any."""
        for body, free in self.free:
            assert body.free_nodes is not None
            body.placement.choose_free(free, body.free_nodes.spent | (body.free & ~free))
        return bool(self.free)


class TriedNodes:
    """Free nodes with which steps are tried, and those of the last converged step.

    Args:
        bodies: The bodies of a problem.
    """

    def __init__(self, bodies: Sequence[Particles]) -> None:
        self._bodies = [body for body in bodies if body.free_nodes is not None]
        self._before: list[tuple[NDArray[np.bool_], NDArray[np.bool_]]] | None = None

    def looked_after(self, adapts: bool) -> list[Particles]:
        """Return bodies with nodes that are free as long as the domains around them are good.

        Args:
            adapts: Whether nodes are freed where the background errs.
        """
        return [
            body
            for body in self._bodies
            if adapts or (body.free_nodes is not None and body.free_nodes.automatic)
        ]

    def keep(self) -> None:
        """Note which nodes are free, unless that is done since the last converged step."""
        if self._before is None:
            self._before = [
                (body.free_nodes.chosen, body.free_nodes.spent)
                for body in self._bodies
                if body.free_nodes is not None
            ]

    def put_back(self) -> None:
        """Let the nodes be free that were so at the last converged step."""
        for body, nodes in zip(self._bodies, self._before or (), strict=False):
            body.placement.choose_free(*nodes)
        self._before = None

    def settle(self) -> None:
        """Take the nodes that are free for those of a converged step."""
        self._before = None

    def carry(self, carried: Carried) -> bool:
        """Carry nodes before a step is tried again; return whether there are any."""
        if carried.free:
            self.keep()
        return carried.apply()

    def free(self, chosen: Sequence[tuple[Particles, NDArray[np.bool_]]]) -> int:
        """Free more nodes; return how many (collective).

        Args:
            chosen: Bodies, and which of this rank's nodes are to be free.
        """
        self.keep()
        before = self._count()
        for body, free in chosen:
            assert body.free_nodes is not None
            body.placement.choose_free(free, body.free_nodes.spent)
        return self._count() - before

    def _count(self) -> int:
        """Return the number of free nodes (collective)."""
        own = [int(body.free[: body.W.dofmap.index_map.size_local].sum()) for body in self._bodies]
        return int(self._bodies[0].mesh.comm.allreduce(sum(own)))


def carried_after(bodies: Sequence[Particles]) -> Carried:
    """Return the nodes that are to be carried after a solved step (collective).

    They are those of domains that are distorted, or will be if the next step is like this one, and
    those that are about to leave the background, with all that the background moves together with
    them: a node that it carries alone is as free as before. What is carried stays so. Nodes that
    held dofs lead stay free: the background does not go along, and would let go of them.

    Args:
        bodies: Those with nodes that are free as long as domains are good, not yet committed.
    """
    found, too_late = [], False
    for body in bodies:
        free = _loose(body)
        if not _any(body, free):
            continue
        moved = body.displacement.x.array.reshape(len(body.free), -1)
        before = body.node_positions
        after = before + moved - body.converged_displacement.reshape(moved.shape)
        ahead = 2.0 * after - before
        nodes = np.flatnonzero(free)
        points = np.concatenate([x[nodes] for x in (before, after, ahead)])
        was, stays, remains = body.mover.basis.within(points).found.reshape(3, -1)
        left = _any(body, was & ~stays)
        too_late = too_late or left
        here = before if left else after
        seeds = np.zeros(len(free), dtype=bool)
        seeds[nodes] = was & ~stays if left else stays & ~remains
        seeds |= bad_nodes(body, after) | bad_nodes(body, ahead)
        if (rest := _without(body, seeds & free, here)) is not None:
            found.append((body, rest))
    return Carried(found, too_late)


def relieve(bodies: Sequence[Particles], error: MPMError) -> Carried:
    """Return the free nodes of domains that an error names, which are to be carried (collective).

    Args:
        bodies: Those with nodes that are free as long as domains are good, at their last converged
            step.
        error: Why a step has failed.
    """
    found = []
    for body in bodies:
        named = np.isin(body.global_index, error.particles)
        seeds = np.zeros(len(body.free), dtype=bool)
        seeds[body.domain_nodes[named]] = True
        if (rest := _without(body, seeds & _loose(body), body.node_positions)) is not None:
            found.append((body, rest))
    return Carried(found, False)


def bad_nodes(body: Particles, positions: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the local nodes of a body's own domains that are distorted.

    Args:
        body: The body.
        positions: Where its nodes are.
    """
    bad = np.zeros(len(positions), dtype=bool)
    quality = body.geometry.quality(positions[body.domain_nodes])
    bad[body.domain_nodes[(quality < LEAST_QUALITY) & ~body.deleted]] = True
    return bad


def _loose(body: Particles) -> NDArray[np.bool_]:
    """Return the local free nodes but for those that go with held dofs of the background."""
    assert body.free_nodes is not None
    return body.free & ~body.free_nodes.bound


def _any(body: Particles, mask: NDArray[np.bool_]) -> bool:
    """Return whether a mask is true anywhere on any rank (collective)."""
    return bool(body.mesh.comm.allreduce(int(mask.any())))


def _without(
    body: Particles, seeds: NDArray[np.bool_], positions: NDArray[np.float64]
) -> NDArray[np.bool_] | None:
    """Return the nodes that stay free as some and all that follow are carried (collective).

    Args:
        body: The body.
        seeds: This rank's nodes that are to be carried.
        positions: Where the nodes are.

    Returns:
        ``None`` where nothing changes.
    """
    if not _any(body, seeds):
        return None
    rows = body.mover.basis.within(positions)
    T = transfer_matrix(rows._replace(values=np.abs(rows.values)), body.W, body.V)
    one, together = T.createVecLeft(), T.createVecRight()
    bs = body.W.dofmap.index_map_bs
    own = body.W.dofmap.index_map.size_local
    # of seeds that another rank alone knows, too
    one.array_w[:] = np.repeat(chosen_nodes(body.W, np.flatnonzero(seeds))[:own], bs)
    T.multTranspose(one, together)
    T.mult(together, one)
    moved = (one.array_r > 0.0).reshape(-1, bs).any(axis=1)
    carried = chosen_nodes(body.W, np.flatnonzero(moved)) & _loose(body)
    for thing in (T, one, together):
        thing.destroy()
    return body.free & ~carried if _any(body, carried) else None
