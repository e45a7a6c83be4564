# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Where a body is at the last converged step, and what moves it on from there."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..background.basis import BackgroundBasis, PointBasis
from ..errors import ParticleOutsideError, agree
from ..transfer.method import CornerBasis, DomainState, Method, ParticleState
from ..transfer.methods import METHODS
from ..transfer.owned import OwnedRows
from ..transfer.transfer import Transfer
from .deletion import Deletion
from .free import FreeNodes
from .options import Coordinates
from .undeformed import Undeformed

__all__ = ["Mover", "Placement"]

type Array = NDArray[np.float64]


class Mover:
    """The space that moves the nodes of a body, by a method (collective).

    Args:
        V: The background space, or that of finite elements.
        method: Name of the method.

    Attributes:
        V: As given.
        increment: The displacement u in V of the step being solved.
        basis: Evaluator of the basis of V at points.
        coordinates: Those of its mesh at the beginning.
        method: The method.
    """

    def __init__(self, V: fem.FunctionSpace, method: str) -> None:
        self.V = V
        self.increment = fem.Function(V, name="increment")
        self.basis = BackgroundBasis(V)
        self.coordinates = Coordinates(V.mesh, "background")
        self.method: Method = METHODS[method](V)


class Placement:
    """Positions of a body at the last converged step, and its transfer T there.

    Args:
        undeformed: The undeformed body.
        mover: What moves its nodes.
        deletion: Which domains are deleted, if any may be.
        free_nodes: The free nodes as the system moves them, if any may be.

    Attributes:
        displacement: Of this rank's nodes of W, shape ``(N, gdim)``.
        deletion: As given.
        free_nodes: As given.
    """

    def __init__(
        self,
        undeformed: Undeformed,
        mover: Mover,
        deletion: Deletion | None,
        free_nodes: FreeNodes | None,
    ) -> None:
        self._undeformed, self._geometry, self._mover = undeformed, undeformed.geometry, mover
        self.deletion, self.free_nodes = deletion, free_nodes
        self.displacement = np.zeros_like(self._geometry.nodes)
        self._transfer: Transfer | None = None
        self._owned: OwnedRows | None = None

    # -- Places ---------------------------------------------------------------------------

    @property
    def nodes(self) -> Array:
        """Positions of this rank's nodes of W, shape ``(N, gdim)``."""
        return np.asarray(self._geometry.nodes + self.displacement)

    @property
    def domains(self) -> Array:
        """Corners of the particles' own domains, shape ``(n, k, gdim)``."""
        return self._mover.method.domains(self._state())

    def gradient(self) -> Array:
        """Return ``F - I`` at the history's points, shape ``(n, nq, gdim, gdim)``."""
        return self._undeformed.gradient_of(self._of_domains(self.displacement))

    def points(self) -> Array:
        """Return positions of the history's points, shape ``(n, nq, gdim)``."""
        corners = self._geometry.corners + self._of_domains(self.displacement)
        return self._undeformed.at_points(corners)

    def moved(self, displacement: Array, gradient: Callable[[], Array]) -> DomainState:
        """Return where another displacement puts the domains.

        Args:
            displacement: Of the nodes, shape ``(N, gdim)``.
            gradient: Returns ``F - I`` at the points with it.
        """
        geometry, undeformed = self._geometry, self._undeformed

        def centred() -> ParticleState:
            return ParticleState(
                undeformed.mean(undeformed.domains),
                undeformed.mean(geometry.corners + self._of_domains(displacement)),
                # methods that ask for it have one point
                np.eye(geometry.gdim) + gradient()[:, 0],
            )

        return DomainState(
            geometry.nodes, displacement, geometry.domain_nodes, self._of_domains, centred
        )

    def _state(self) -> DomainState:
        return self.moved(self.displacement, self.gradient)

    def _of_domains(self, nodal: Array) -> Array:
        values: Array = nodal[self._geometry.domain_nodes]
        return values if self.deletion is None else self.deletion.kept(values)

    # -- The transfer ---------------------------------------------------------------------

    @property
    def transfer(self) -> Transfer:
        """T and what follows from it (collective)."""
        self.locate()
        assert self._transfer is not None
        return self._transfer

    def forget_transfer(self) -> None:
        """Drop T, which is made anew when it is needed."""
        self._transfer = None

    def locate(self) -> None:
        """Find the background cells of all domain nodes, unless that is done (collective).

        Raises:
            ParticleOutsideError: A domain is not wholly inside the background.
        """
        if self._transfer is not None:
            return
        rows = self._rows()
        what = "The domains of {particles} are"
        self._require_inside(rows, what, "make the background larger or the load smaller")
        self._take(rows)

    def _rows(self) -> CornerBasis:
        """Return the rows of T, zero for free nodes (collective)."""
        rows = self._mover.method.rows(self._state(), self._mover.basis)
        self._share(rows.basis)
        if self.free_nodes is not None:
            self.free_nodes.take(rows.basis)
        return rows

    def _share(self, rows: PointBasis) -> None:
        """Give nodes that several ranks know the rows of their owners, in place (collective)."""
        method, W = self._mover.method, self._geometry.W
        if W.mesh.comm.size == 1 or not method.shares_nodes or method.free:
            return
        if self._owned is None:
            self._owned = OwnedRows(W, rows.nodes.shape[1])
        self._owned.share(rows)

    def _lost(self, rows: CornerBasis) -> NDArray[np.int64]:
        """Return the local domains that are not wholly in the background."""
        lost = (~rows.basis.found)[self._geometry.domain_nodes].any(axis=1)
        if self.deletion is not None:
            lost &= ~self.deletion.mask
        return np.flatnonzero(lost)

    def _take(self, rows: CornerBasis) -> None:
        """Transfer by rows, without the weight of deleted domains' own nodes."""
        if self.deletion is not None:
            values = rows.basis.values.copy()
            values[self.deletion.dead[: len(values)]] = 0.0
            rows = rows._replace(basis=rows.basis._replace(values=values))
            if rows.corners is not None:
                gone = self.deletion.mask
                rows.corners[gone] = self.domains[gone]
            if self.free_nodes is not None:
                self.free_nodes.leave(self.deletion.dead)
        self._transfer = Transfer(rows, self._geometry.W, self._mover.V)

    def _require_inside(self, rows: CornerBasis, what: str, advice: str) -> None:
        geometry, lost = self._geometry, self._lost(rows)
        with agree(geometry.mesh.comm):
            if len(lost):
                corners = self.domains if rows.corners is None else rows.corners
                out = ~rows.basis.found[geometry.domain_nodes[lost[0]]]
                where = corners[lost[0]][out][0]
                where = np.where(np.abs(where) < 1e-12 * np.abs(where).max(), 0.0, where)
                place = tuple(float(f"{c:.6g}") for c in where)
                error = ParticleOutsideError(
                    f"{what} outside the background mesh, e.g. at {place}; {advice}",
                    geometry.global_index[lost],
                )
                error.where = place
                raise error

    def beside(self, nodes: NDArray[np.int64]) -> tuple[PointBasis, Array]:
        """Return the basis at nodes of W of the cells beside theirs, continued (collective).

        Args:
            nodes: Local nodes of W.

        Returns:
            See :meth:`BackgroundBasis.beside`.
        """
        return self._mover.basis.beside(self.nodes[nodes])

    def carry_by(self, nodes: NDArray[np.int64], rows: PointBasis) -> None:
        """Let nodes of W have other rows of T, until the body has moved (collective).

        Args:
            nodes: Local nodes of W.
            rows: Their rows.
        """
        whole = self.transfer.rows
        for known, other in zip(whole.basis, rows, strict=True):
            if known is not None and other is not None:
                known[nodes] = other
        self._share(whole.basis)
        self._take(whole)

    def basis_with_gradients(self) -> PointBasis:
        """Return the rows of T at the local nodes of W, with gradients (collective)."""
        rows = self.transfer.rows.basis
        if self._mover.method.free:
            return rows._replace(gradients=np.zeros((*rows.nodes.shape, self._geometry.gdim)))
        basis = self._mover.basis.at(self.nodes[: len(rows.nodes)], gradients=True)
        assert basis.gradients is not None
        other = np.flatnonzero((basis.nodes != rows.nodes).any(axis=1))
        if self._geometry.mesh.comm.allreduce(len(other)) > 0:  # rows by carry_by
            beside, _ = self.beside(other)
            assert beside.gradients is not None
            same = (beside.nodes == rows.nodes[other, None]).all(axis=2).argmax(axis=1)
            basis.gradients[other] = beside.gradients[np.arange(len(other)), same]
        return rows._replace(gradients=basis.gradients)

    # -- Changes --------------------------------------------------------------------------

    def go(self, displacement: Array) -> Array:
        """Take a displacement for the converged one; return what that was before.

        Args:
            displacement: Of this rank's nodes of W, shape ``(N, gdim)``.
        """
        before, self.displacement = self.displacement, displacement
        if not self._mover.method.free:  # T of finite elements stays as it is
            self._transfer = None
        return before

    def choose_free(
        self, chosen: NDArray[np.bool_], spent: NDArray[np.bool_] | None = None
    ) -> None:
        """Let others of this rank's nodes of W, ghosts too, be free from the next step on.

        Args:
            chosen: The free ones.
            spent: Those that stay carried, as the domains around them were bad; ``None``: none.
        """
        assert self.free_nodes is not None
        self.free_nodes.choose(chosen, np.zeros_like(chosen) if spent is None else spent)
        self._transfer = None

    def leaving(self, deletes: bool) -> NDArray[np.int64]:
        """Return which of this rank's particles the last step took out (collective).

        Args:
            deletes: Whether these may be deleted.

        Returns:
            Their local indices.

        Raises:
            ParticleOutsideError: Some are outside and shall not be deleted, or all would be.
        """
        if not deletes or self.deletion is None:
            self.locate()
            return np.zeros(0, dtype=np.int64)
        rows = self._rows()
        lost = self._lost(rows)
        left = self._geometry.num_local - int(self.deletion.mask.sum()) - len(lost)
        if self._geometry.mesh.comm.allreduce(left) == 0:
            what = "The domains of {particles}, the last that were not deleted, are"
            self._require_inside(rows, what, "make the background larger or the load smaller")
        self._take(rows)
        return lost

    def delete(self, domains: NDArray[np.int64]) -> None:
        """Delete domains, at their places now (collective).

        Args:
            domains: Local indices of this rank's particles.
        """
        assert self.deletion is not None
        self.deletion.add(domains, self._of_domains(self.displacement))
        self._take(self.transfer.rows)

    def restore_deleted(self, deleted: NDArray[np.bool_], kept: Array) -> None:
        """Set which domains are deleted, and where each was then (collective)."""
        assert self.deletion is not None
        for mask in (np.zeros_like(self.deletion.mask), deleted):
            self.deletion.restore(mask, kept)
        self._transfer = None
