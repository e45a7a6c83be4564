# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The background nodes that a body's domains see, and the loops over these."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import _compat
from .._core import loops
from ..constitutive.averaging import LowRankTerm
from ..meshes.order import morton_order
from ..particles.particles import Particles
from ..transfer.touched import TransferRows
from .body_forms import BodyForms, integrals_of, no_values

__all__ = ["BodyLoops", "Support", "Where"]

#: Where domains go, for the compiled loops: groups, supports, pairs and a pattern's values.
type Where = tuple[Any, ...]

#: Most nodes that a group of domains sees, where it has several: what they do to each other adds up
#: in a dense matrix that a processor's second cache holds, before it goes to the sparse one. With
#: half as many, or twice, assembly in space takes 5 to 10 % longer.
GROUP = 48

#: No rows of T.
no_rows = TransferRows(np.zeros(1, dtype=np.int64), np.zeros(0, dtype=np.int32), no_values)


class Support:
    """The background nodes that each domain of a body sees, and T of its nodes.

    Domains are visited neighbours after neighbours, in groups that see few nodes together.

    Args:
        dofmap: Local nodes of W of each domain, shape ``(n, k)``.
        order: In which domains are visited, shape ``(n,)``; or the support of another field on the
            same domains, whose groups are taken.

    Attributes:
        changes: How often the nodes have become others.
    """

    def __init__(self, dofmap: NDArray[np.int32], order: NDArray[np.int32] | Support) -> None:
        self._dofmap = dofmap
        self._host = order if isinstance(order, Support) else None
        self._order = order.groups[0] if isinstance(order, Support) else order
        self.changes = 0
        self._first: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        self._nodes: tuple[NDArray[Any], ...] = ()

    @property
    def groups(self) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
        """The order of domains, and where groups begin in it, shape ``(number of groups + 1,)``."""
        return self._order, self._first

    @property
    def nodes(self) -> tuple[NDArray[Any], ...]:
        """The nodes of groups, and those of them that domains see, both in compressed rows.

        Where nodes of domains begin, and their numbers among those of the group; where nodes of
        groups begin, and their numbers among the touched nodes.
        """
        return self._nodes

    def find(self, rows: TransferRows) -> bool:
        """Find the nodes; return whether they are the old ones."""
        given = self._first[:0] if self._host is None else self._host.groups[1]
        first, nodes = loops.supports(self._dofmap, *rows, self._order, given, GROUP)
        found, known = (first, *nodes), (self._first, *self._nodes)
        same = len(found) == len(known) and all(map(np.array_equal, found, known))
        if not same:
            self._first, self._nodes = first, nodes
            self.changes += 1
        return same

    def transfers(self, rows: TransferRows) -> NDArray[np.float64]:
        """Return T of each domain, ``(number of nodes, k)`` one after the other."""
        found = np.empty((len(self._nodes[1]), self._dofmap.shape[1]))
        loops.local_transfers(self._dofmap, *rows, self.groups, self.nodes, found)
        return found


class BodyLoops:
    """One body's domains, their background nodes and where their tangents go."""

    def __init__(self, particles: Particles, forms: BodyForms, coupled: bool) -> None:
        self.particles = particles
        self._forms = forms
        self._domains = (particles.domain_nodes, particles.undeformed.rule.gradients)
        internal = forms.internal
        one = particles.num_points == 1
        self._points = internal is not None and one and internal.strain.hoop is None
        whole = bool(forms.fused) or (internal is not None and not self._points)
        self._whole = whole or coupled
        body = particles.mesh
        first = _compat.geometry_dofmap(body)[: len(particles.domain_nodes), 0]
        order = morton_order(body.geometry.x[first, : body.geometry.dim])
        self.support = Support(particles.domain_nodes, order)
        self._rows, self._gradients = no_rows, no_values
        self.transfers: NDArray[np.float64] = no_values

    def transfer(self, rows: TransferRows) -> None:
        """Take over the values of T."""
        self._rows = rows
        gdim, size = self._domains[1].shape[-1], len(self.support.nodes[1])
        if self._points and gdim == 2:  # in space they would be a tenth of all that a run keeps
            self._gradients = np.empty((size, gdim))
            given = (*self._domains, *rows, self.support.groups, self.support.nodes)
            loops.support_gradients(*given, self._gradients)
        if self._whole:
            self.transfers = self.support.transfers(rows)

    def _vectors(self, term: LowRankTerm | None) -> NDArray[np.float64]:
        """Return left and right vectors of each domain in turn, ``(n, 2 m, k, gdim)``; or none."""
        if term is None:
            return no_values
        left = [self._counted(vector) for vector in term.left]
        pairs = zip(left, term.right, strict=True)
        return np.stack([vector for pair in pairs for vector in pair], axis=1)

    def add_masses(
        self,
        masses: NDArray[np.float64],
        where: Where,
        values: NDArray[np.float64],
    ) -> None:
        """Add the body's reduced mass, one number for each of the pattern's blocks."""
        transfers = self.transfers if self._whole else self.support.transfers(self._rows)
        loops.assemble_masses(*self._domains, transfers, masses, where, values)

    def _counted(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return values as often as the tangent counts."""
        factor = self._forms.factor
        return values if factor == 1.0 else factor * values

    def add(self, where: Where) -> None:
        """Add the body's reduced tangent."""
        internal = self._forms.internal
        if internal is not None and self._points:
            loops.assemble_points(
                *self._domains,
                self._counted(internal.strain.weights),
                *self._rows,
                self._gradients,
                internal.tangent,
                internal.symmetric,
                where,
            )
        elif internal is not None:
            loops.assemble_domains(
                *self._domains,
                self._counted(internal.strain.weights),
                no_values if internal.strain.hoop is None else internal.strain.hoop,
                self.transfers,
                internal.tangent,
                self._vectors(self._forms.low_rank_of_domains()),
                where,
            )
        for form in self._forms.fused:
            for compiled in integrals_of(form, self.particles.mesh):
                loops.assemble_form(
                    compiled, *self._domains, self.transfers, self._forms.factor, where
                )
