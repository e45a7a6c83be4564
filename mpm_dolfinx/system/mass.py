# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The consistent mass of bodies at their nodes, and what velocities have by it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..assembly.petsc import blocked
from ..errors import MPMError
from ..parallel.totals import over_ranks
from ..particles.particles import Particles

__all__ = ["NodalMass", "deleted", "dot", "nodal_mass"]


@dataclass(frozen=True)
class NodalMass:
    """The mass of all bodies, on the present meshes with the present domains.

    Attributes:
        bodies: The bodies.
        domains: Mass of each owned domain, ``(n, k, k)`` for each body; 0 without inertia.
        matrices: The same on W.
        deleted: Which of this rank's particles of each body were gone.
    """

    bodies: Sequence[Particles]
    domains: Sequence[NDArray[np.float64]]
    matrices: Sequence[PETSc.Mat]
    deleted: Sequence[NDArray[np.bool_]]

    def is_of_present(self) -> bool:
        """Return whether the same particles are gone now (collective)."""
        pairs = zip(self.bodies, self.deleted, strict=True)
        same = all(np.array_equal(body.deleted, gone) for body, gone in pairs)
        return over_ranks(self.bodies[0].V.mesh.comm, same, MPI.LAND)

    def vectors(self, functions: Sequence[fem.Function]) -> list[PETSc.Vec]:
        """Return the values of Functions on W of each body."""
        return self.around([function.x.array for function in functions])

    def around(self, values: Sequence[NDArray[np.float64]]) -> list[PETSc.Vec]:
        """Return vectors on W of each body with values, those of ghosts after this rank's own."""
        vectors = [M.createVecLeft() for M in self.matrices]
        for vector, own in zip(vectors, values, strict=True):
            vector.array_w[:] = own[: vector.getLocalSize()]
        return vectors

    def times(self, vectors: Sequence[PETSc.Vec]) -> list[PETSc.Vec]:
        """Return M times vectors on W of each body (collective)."""
        products = [vector.duplicate() for vector in vectors]
        for M, vector, product in zip(self.matrices, vectors, products, strict=True):
            M.mult(vector, product)
        return products

    def product(self, some: Sequence[PETSc.Vec], others: Sequence[PETSc.Vec]) -> float:
        """Return the scalar product of vectors in M (collective)."""
        return dot(some, self.times(others))

    def kinetic(self, velocities: Sequence[fem.Function]) -> float:
        """Return the kinetic energy (collective)."""
        v = self.vectors(velocities)
        return 0.5 * self.product(v, v)

    def momentum(self, velocities: Sequence[fem.Function]) -> NDArray[np.float64]:
        """Return the momentum, shape ``(gdim,)`` (collective)."""
        gdim = self.bodies[0].mesh.geometry.dim
        parts = self.times(self.vectors(velocities))
        own = sum(part.array_r.reshape(-1, gdim).sum(axis=0) for part in parts)
        return np.asarray(self.bodies[0].V.mesh.comm.allreduce(own))

    def angular_momentum(self, velocities: Sequence[fem.Function]) -> NDArray[np.float64]:
        """Return the angular momentum about the origin (collective).

        Returns:
            Shape ``(1,)`` in the plane, about the axis normal to it, or ``(3,)``.
        """
        gdim = self.bodies[0].mesh.geometry.dim
        total: NDArray[np.float64] = np.zeros(1 if gdim == 2 else 3)
        for body, p in zip(self.bodies, self.times(self.vectors(velocities)), strict=True):
            part = p.array_r.reshape(-1, gdim)
            x = body.node_positions[: len(part)]
            if gdim == 2:
                total += np.sum(x[:, 0] * part[:, 1] - x[:, 1] * part[:, 0])
            else:
                total += np.cross(x, part).sum(axis=0)
        return np.asarray(self.bodies[0].V.mesh.comm.allreduce(total))


def nodal_mass(
    bodies: Sequence[Particles],
    domains: Sequence[NDArray[np.float64] | None],
    present: Sequence[NDArray[np.bool_]],
) -> NodalMass:
    """Return the mass of bodies (collective).

    Args:
        bodies: The bodies.
        domains: Mass of each owned domain, ``(n, k, k)``; ``None`` for a body without inertia.
        present: See :func:`deleted`.

    Raises:
        MPMError: There are nodes without mass on a body that moves.
    """
    masses = [
        np.zeros((body.num_local, *2 * body.domain_nodes.shape[1:])) if own is None else own
        for body, own in zip(bodies, domains, strict=True)
    ]
    matrices = [_on_nodes(body, own) for body, own in zip(bodies, masses, strict=True)]
    for body, own, M in zip(bodies, domains, matrices, strict=True):
        if own is not None:
            _require_mass(body, M)
    return NodalMass(bodies, masses, matrices, present)


def deleted(bodies: Sequence[Particles]) -> list[NDArray[np.bool_]]:
    """Return which of this rank's particles of each body are deleted."""
    return [body.deleted.copy() for body in bodies]


def dot(some: Sequence[PETSc.Vec], others: Sequence[PETSc.Vec]) -> float:
    """Return the scalar product of vectors on W of all bodies (collective)."""
    return float(sum(a.dot(b) for a, b in zip(some, others, strict=True)))


def _on_nodes(body: Particles, masses: NDArray[np.float64]) -> PETSc.Mat:
    """Return masses of domains summed up on W (collective)."""
    nodes = body.W.dofmap.index_map.local_to_global(body.domain_nodes.ravel())
    nodes = nodes.reshape(body.domain_nodes.shape)
    rows = np.broadcast_to(nodes[:, :, None], masses.shape).ravel()
    columns = np.broadcast_to(nodes[:, None, :], masses.shape).ravel()
    return blocked(body.W, rows, columns, masses.ravel(), body.W.dofmap.index_map_bs)


def _require_mass(body: Particles, M: PETSc.Mat) -> None:
    """Raise an error unless all nodes of domains that are present have mass (collective)."""
    gdim = body.mesh.geometry.dim
    light = M.getDiagonal().array_r.reshape(-1, gdim).min(axis=1) <= 0.0
    if body.deletion is not None:
        light &= ~body.deletion.dead[: len(light)]
    if body.mesh.comm.allreduce(bool(light.any())):
        raise MPMError(
            "A DynamicProblem needs a positive density at all nodes of bodies that move; one that "
            "shall have no inertia belongs into quasi_static=."
        )
