# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bodies that stick to each other where next to nothing holds the background between them."""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from ..background.basis import PointBasis
from ..parallel.totals import over_ranks
from ..particles.particles import Particles
from ..tolerances import ROUND_OFF
from ..transfer.touched import TouchedNodes

__all__ = ["HARDLY", "Joints"]

#: Largest weight of a background node below which next to nothing holds it.
HARDLY = 1e-2


class Joints:
    """Finds the background nodes that bodies touch, and keeps the joints between bodies shut.

    Bodies on one background space stick to each other by the nodes that both touch. A node of a
    body that has just crossed a line of the grid has a small weight at nodes beyond it. Where no
    other weight of theirs is as large as 0.01 these move it at will: where it bears on another
    body, it is let loose. Such a node of a body follows the cell beside its own that it lies next
    to, continued to it, of which all nodes are held better: rigid motions and uniform strains
    stay exact, and the background nodes that next to nothing held are no unknowns.

    Nodes of a body that bear on no other one are left alone: their own body holds them.

    Args:
        bodies: The bodies on one background space of degree 1.

    Attributes:
        count: How many nodes follow the cell beside theirs, on all ranks.
    """

    def __init__(self, bodies: Sequence[Particles]) -> None:
        self._bodies = list(bodies)
        self._V = bodies[0].V
        self.count = 0

    def touched(self) -> TouchedNodes:
        """Return the nodes of V that the bodies touch, after a look at their joints (collective).

        A node of a body changes its cell once: what it leaves may be held worse than before.
        """
        owned = [body.W.dofmap.index_map.size_local for body in self._bodies]
        moved = [np.zeros(len(body.node_basis.found), dtype=bool) for body in self._bodies]
        while True:
            bases = [body.node_basis for body in self._bodies]
            touched = TouchedNodes(self._V, bases, owned)
            if not self._shut(touched, moved):
                break
        own = sum(int(mine[:count].sum()) for mine, count in zip(moved, owned, strict=True))
        self.count = over_ranks(self._V.mesh.comm, own)
        return touched

    def _shut(self, touched: TouchedNodes, moved: list[NDArray[np.bool_]]) -> bool:
        """Move nodes at joints that are loose to other cells; return whether any was (collective).

        Args:
            touched: The nodes of V that the bodies touch.
            moved: Whether each node of each body has been moved; changed.
        """
        comm = self._V.mesh.comm
        hold = touched.hold()
        loose = (hold > 0.0) & (hold < HARDLY)
        if over_ranks(comm, int(loose.sum())) == 0:
            return False
        at_loose, at_joint = touched.rows_on(loose), touched.rows_on(touched.shared())
        changed = False
        for body, done, *on in zip(self._bodies, moved, at_loose, at_joint, strict=True):
            nodes = np.flatnonzero(on[0] & on[1] & ~done)
            if over_ranks(comm, len(nodes)) == 0:
                continue
            basis, outside = body.placement.beside(nodes)
            firm = (touched.at_nodes(hold, basis.nodes) >= HARDLY).all(axis=2)
            far = np.round(np.where(firm, outside, np.inf), 9)
            best = far.argmin(axis=1)
            row = np.arange(len(nodes))
            found = np.isfinite(far[row, best])
            rows = PointBasis._make(
                None if part is None else part[row, best][found] for part in basis
            )
            rows.values[np.abs(rows.values) < ROUND_OFF] = 0.0
            body.placement.carry_by(nodes[found], rows)
            done[nodes[found]] = True
            changed |= bool(found.any())
        return over_ranks(comm, changed, MPI.LOR)
