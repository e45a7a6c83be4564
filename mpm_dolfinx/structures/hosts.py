# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Nodes of a structure in the bodies that move them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..errors import MPMError, agree
from ..particles.particles import Particles
from ..system.coupling import at_present, interpolation

__all__ = ["Hosts", "find_hosts"]


class Hosts(NamedTuple):
    """The bodies that move the nodes of a structure.

    A rank has the rows of an even share of the nodes.

    Attributes:
        bodies: The bodies.
        spaces: W of each, as it was when the nodes were found.
        rows: Of each: the matrix from dofs of W to displacements of the nodes.
        share: The nodes of this rank.
        total: Number of all nodes.
    """

    bodies: Sequence[Particles]
    spaces: Sequence[fem.FunctionSpace]
    rows: Sequence[PETSc.Mat]
    share: slice
    total: int

    @property
    def known(self) -> bool:
        """Whether the bodies have their meshes yet."""
        return all(b.W is W for b, W in zip(self.bodies, self.spaces, strict=True))

    @property
    def sizes(self) -> tuple[int, int]:
        """Number of dofs of this rank's nodes, and of all."""
        return (self.share.stop - self.share.start) * self.gdim, self.total * self.gdim

    @property
    def gdim(self) -> int:
        """Dimension of space."""
        return int(self.bodies[0].mesh.geometry.dim)

    def displacement(self) -> NDArray[np.float64]:
        """Return where bodies displace all nodes now, shape ``(N, gdim)`` (collective)."""
        total = self.rows[0].createVecLeft()
        total.set(0.0)
        for body, rows in zip(self.bodies, self.rows, strict=True):
            d = rows.createVecRight()
            d.array_w[:] = body.displacement.x.array[: d.getLocalSize()]
            rows.multAdd(d, total, total)
        return self._of_all(total.array_r.reshape(-1, self.gdim))

    def present(self) -> NDArray[np.bool_]:
        """Return at which nodes the bodies are still there, shape ``(N,)`` (collective)."""
        held = np.ones(self.rows[0].getLocalSize()[0], dtype=bool)
        for body, rows in zip(self.bodies, self.rows, strict=True):
            held &= at_present(body, rows)
        return self._of_all(held.reshape(-1, self.gdim).all(axis=1))

    def _of_all[T: np.generic](self, own: NDArray[T]) -> NDArray[T]:
        """Return the rows of all nodes (collective)."""
        comm = self.bodies[0].mesh.comm
        return np.concatenate(comm.allgather(own)) if comm.size > 1 else own.copy()

    def forces(self, nodal: NDArray[np.float64]) -> list[PETSc.Vec]:
        """Return forces on all nodes, shape ``(N, gdim)``, as forces on W of each body."""
        found = []
        for rows in self.rows:
            force, own = rows.createVecs()
            own.array_w[:] = nodal[self.share].ravel()
            rows.multTranspose(own, force)
            found.append(force)
        return found


def find_hosts(
    bodies: Sequence[Particles],
    nodes: NDArray[np.float64],
    alone: NDArray[np.bool_],
    what: str,
) -> Hosts:
    """Return the bodies in which nodes lie, each in the first that has it (collective).

    Args:
        bodies: The bodies.
        nodes: Undeformed places, shape ``(N, gdim)``, the same on all ranks.
        alone: Which are in no body, and move by themselves.
        what: What the structure is called.

    Raises:
        MPMError: Another node is in no body.
    """
    comm, count = bodies[0].mesh.comm, len(nodes)
    ends = [count * rank // comm.size for rank in (comm.rank, comm.rank + 1)]
    share = slice(*ends)
    own, left = nodes[share], ~alone[share]
    spaces, every = [body.W for body in bodies], []
    for W in spaces:
        rows, found = interpolation(W, own, comm)
        use = rows.createVecLeft()
        use.array_w[:] = np.repeat(found & left, nodes.shape[1])
        rows.diagonalScale(L=use)
        left &= ~found
        every.append(rows)
    with agree(comm):
        if left.any():
            where = tuple(float(f"{x:.6g}") for x in own[left][0])
            raise MPMError(
                f"The node {where} of a {what} is in none of its bodies, undeformed; name all "
                "bodies that it goes through, or hold the node (held=)."
            )
    return Hosts(bodies, spaces, every, share, count)
