# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Material point methods: corners of the domains, and how they are moved.

Each method is a class in a file of its own, registered in :mod:`~mpm_dolfinx.transfer.methods`. All
give rows of T, one for each corner of a domain; they differ in nothing else.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem, mesh

from ..background.basis import BackgroundBasis, PointBasis
from ..tolerances import ROUND_OFF

__all__ = ["CornerBasis", "DomainState", "Method", "ParticleState", "affine"]


class ParticleState(NamedTuple):
    """Where the particles are, and their mean deformation.

    Attributes:
        initial_centroid: Shape ``(n, gdim)``.
        centroid: Particle positions, shape ``(n, gdim)``.
        deformation_gradient: Shape ``(n, gdim, gdim)``.
    """

    initial_centroid: NDArray[np.float64]
    centroid: NDArray[np.float64]
    deformation_gradient: NDArray[np.float64]


class DomainState:
    """Where the domains are.

    Args:
        nodes: Undeformed nodes of W, shape ``(N, gdim)``.
        displacement: Their displacement, shape ``(N, gdim)``.
        domains: Nodes of each domain this rank owns, shape ``(n, k)``.
        of_domains: Takes values at nodes ``(N, gdim)`` to the domains, ``(n, k, gdim)``; deleted
            domains keep theirs.
        particles: Returns what is to be known of the particles, where a method needs it.

    Attributes:
        nodes: As given.
        displacement: As given.
        domains: As given.
    """

    def __init__(
        self,
        nodes: NDArray[np.float64],
        displacement: NDArray[np.float64],
        domains: NDArray[np.int32],
        of_domains: Callable[[NDArray[np.float64]], NDArray[np.float64]],
        particles: Callable[[], ParticleState],
    ) -> None:
        self.nodes, self.displacement, self.domains = nodes, displacement, domains
        self._of_domains, self._ask = of_domains, particles

    @cached_property
    def particles(self) -> ParticleState:
        """Centroids and deformation gradients."""
        return self._ask()

    @property
    def positions(self) -> NDArray[np.float64]:
        """Where the nodes are, shape ``(N, gdim)``."""
        return np.asarray(self.nodes + self.displacement)

    @property
    def corners(self) -> NDArray[np.float64]:
        """Where the domains' own nodes are, shape ``(n, k, gdim)``."""
        return np.asarray(self.nodes[self.domains] + self._of_domains(self.displacement))

    def arms(self) -> NDArray[np.float64]:
        """Return ``F_p (X_c - X_p)`` for each corner, shape ``(n, k, gdim)``."""
        centroid, _, F = self.particles
        return np.asarray(
            np.einsum("nij,nkj->nki", F, self.nodes[self.domains] - centroid[:, None])
        )

    def parallelograms(self) -> NDArray[np.float64]:
        """Return the corners ``x_p + F_p (X_c - X_p)``, shape ``(n, k, gdim)``."""
        return np.asarray(self.particles.centroid[:, None] + self.arms())


class CornerBasis(NamedTuple):
    """Background basis at the domains' corners: the rows of T.

    Attributes:
        corners: Where the rows move the corners from, shape ``(n, k, gdim)``; ``None`` where
            these are the positions of the nodes of W.
        basis: The background basis at the local nodes of W.
    """

    corners: NDArray[np.float64] | None
    basis: PointBasis


class Method(ABC):
    """A material point method: how the background moves the corners of particle domains.

    Args:
        V: Background space (collective).

    Attributes:
        name: What users call it.
        shares_nodes: Whether neighbours share their nodes, so that the body hangs together.
        at_nodes: Whether the rows of T are values of the background at the domains' corners.
        one_point: Whether a domain has one quadrature point and degree 1.
        free: Whether corners have unknowns of their own, so that there is no background.
    """

    name: ClassVar[str]
    shares_nodes: ClassVar[bool] = False
    at_nodes: ClassVar[bool] = False
    one_point: ClassVar[bool] = True
    free: ClassVar[bool] = False

    def __init__(self, V: fem.FunctionSpace) -> None:
        del V  # most methods do not need it

    def require(
        self, body: mesh.Mesh, corners: NDArray[np.float64], index: NDArray[np.int64]
    ) -> None:
        """Raise an error unless this method can move the domains of a body (collective).

        Args:
            body: The body mesh.
            corners: Undeformed corners of this rank's domains, shape ``(n, k, gdim)``.
            index: Their global indices, shape ``(n,)``.

        Raises:
            MPMError: It cannot; names the particles.
        """

    @abstractmethod
    def rows(self, state: DomainState, background: BackgroundBasis) -> CornerBasis:
        """Return the rows of T (collective).

        Args:
            state: Where the domains are.
            background: Evaluates the background's basis.
        """

    def domains(self, state: DomainState) -> NDArray[np.float64]:
        """Return the corners of the domains as the method sees them, ``(n, k, gdim)``."""
        return state.parallelograms()


def affine(state: DomainState, arms: NDArray[np.float64], particle: PointBasis) -> PointBasis:
    """Return the basis at the corners of domains that each move affinely with their particle.

    The rows are ``S_ip + grad S_ip . F_p (X_c - X_p)``. What round-off leaves of weights that
    cancel is dropped: a column of it would be noise.
    """
    assert particle.gradients is not None
    rows = np.einsum("nji,nki->nkj", particle.gradients, arms) + particle.values[:, None]
    rows = np.where(np.abs(rows) < ROUND_OFF, 0.0, rows)
    k = arms.shape[1]
    nodes = np.broadcast_to(particle.nodes[:, None], rows.shape)
    size = state.domains.size
    result = PointBasis(
        np.zeros((size, rows.shape[2]), dtype=np.int64),
        np.zeros((size, rows.shape[2])),
        np.ones(size, dtype=bool),
    )
    result.nodes[state.domains] = nodes
    result.values[state.domains] = rows
    result.found[state.domains] = np.repeat(particle.found[:, None], k, axis=1)
    return result
