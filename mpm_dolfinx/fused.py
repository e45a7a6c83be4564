# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The fast route: ``T^T K T`` domain by domain, in one compiled loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from . import _compat
from ._core import loops
from .assembly import BodyForms
from .exchange import swap
from .f_bar import LowRankTerm
from .history import Statistics
from .layout import Rows, TouchedNodes
from .particles import Particles

__all__ = ["FusedTangent"]


class _Share:
    """One body's domains, their background nodes and where their tangents go."""

    def __init__(self, particles: Particles, forms: BodyForms) -> None:
        self._particles = particles
        self._forms = forms
        self._domains = (particles.domain_nodes, particles.quadrature.gradients)
        internal = forms.internal
        self._points = internal is not None and particles.num_points == 1
        self._whole = bool(forms.fused) or (internal is not None and not self._points)
        self.offsets: NDArray[np.int64] = np.zeros(1, dtype=np.int64)
        self.nodes: NDArray[np.int32] = np.zeros(0, dtype=np.int32)
        self.positions: NDArray[np.int32] = np.zeros(0, dtype=np.int32)

    def support(self, rows: Rows) -> bool:
        """Find the background nodes of each domain; return whether they are the old ones."""
        offsets, nodes = loops.supports(*self._domains, *rows)
        same = np.array_equal(offsets, self.offsets) and np.array_equal(nodes, self.nodes)
        self.offsets, self.nodes = offsets, nodes
        return same

    def transfer(self, rows: Rows) -> None:
        """Take over the values of T."""
        given = (*self._domains, *rows, self.offsets, self.nodes)
        if self._points:
            self._gradients = np.empty((len(self.nodes), self._domains[1].shape[-1]))
            loops.support_gradients(*given, self._gradients)
        if self._whole:
            self._transfers = np.empty((len(self.nodes), self._particles.domain_nodes.shape[1]))
            loops.local_transfers(*given, self._transfers)

    @staticmethod
    def _low_rank(terms: Sequence[LowRankTerm]) -> NDArray[np.float64]:
        """Return h/2 g + left, h/2 g + right and g of each domain, ``(n, 3, k, gdim)``; or none."""
        if not terms:
            return np.zeros((0, 3, 1, 1))
        (term,) = terms
        half = 0.5 * term.h[:, None, None] * term.g
        return np.stack([half + term.left, half + term.right, term.g], axis=1)

    def add(self, values: NDArray[np.float64]) -> None:
        """Add the body's reduced tangent to the values of the pattern's blocks."""
        target = (self.offsets, self.positions, values)
        internal = self._forms.internal
        weights = self._particles.present_weights
        if internal is not None and self._points:
            loops.assemble_points(
                *self._domains,
                weights,
                self._gradients,
                internal.tangent,
                internal.symmetric,
                *target,
            )
        elif internal is not None:
            loops.assemble_domains(
                *self._domains,
                weights,
                self._transfers,
                internal.tangent,
                self._low_rank(internal.low_rank),
                *target,
            )
        body = self._particles.mesh
        geometry = (body.geometry.x, _compat.geometry_dofmap(body))
        for form in self._forms.fused:
            constants, packed = _compat.packed(form)
            for integral in _compat.compiled_integrals(form):
                loops.assemble_form(
                    integral.kernel,
                    integral.entities,
                    packed[integral.key],
                    constants,
                    *geometry,
                    *self._domains,
                    self._transfers,
                    *target,
                )


class FusedTangent:
    """``T^T K T`` of all bodies at the free dofs of V, without ever forming K.

    Each rank adds its own domains' ``T_p^T K_p T_p`` to blocks between the background nodes
    that they touch, of whatever rank. The pattern, and with it the matrix, lasts until a node
    of a body enters another cell. Off-rank rows travel once for each assembly.

    Args:
        bodies: Bodies with their forms, all on one V.
        statistics: Where to count.
    """

    def __init__(
        self, bodies: Sequence[tuple[Particles, BodyForms]], statistics: Statistics
    ) -> None:
        self._shares = [_Share(*body) for body in bodies]
        self._V = bodies[0][0].V
        self._comm: MPI.Comm = self._V.mesh.comm
        self._bs = self._V.dofmap.index_map_bs
        self._statistics = statistics
        self._touched: TouchedNodes | None = None
        self._numbers: NDArray[np.int32] = np.zeros(0, dtype=np.int32)
        self._A: PETSc.Mat | None = None

    def restrict(
        self,
        touched: TouchedNodes,
        rows: Sequence[Rows],
        numbers: NDArray[np.int32],
        sizes: tuple[int, int],
    ) -> None:
        """Take over the present transfer and free dofs (collective).

        Args:
            touched: The nodes that the bodies touch.
            rows: Their rows of T, of each body.
            numbers: For each own dof of V its number among the free dofs, or -1.
            sizes: Number of free dofs of this rank and of all ranks.
        """
        self._touched = touched
        numbers = touched.spread(numbers.reshape(-1, self._bs)).ravel()
        same = self._A is not None and self._A.getSizes()[0] == sizes
        same &= np.array_equal(numbers, self._numbers)
        self._numbers = numbers
        for share, own in zip(self._shares, rows, strict=True):
            same &= share.support(own)
        if not self._comm.allreduce(same, MPI.LAND):
            self._make_pattern(sizes)
            self._statistics.count("patterns")
        for share, own in zip(self._shares, rows, strict=True):
            share.transfer(own)

    def _make_pattern(self, sizes: tuple[int, int]) -> None:
        assert self._touched is not None
        ends = np.cumsum([0, *(share.offsets[-1] for share in self._shares)])
        offsets = np.concatenate(
            [[0], *(s.offsets[1:] + end for s, end in zip(self._shares, ends, strict=False))]
        )
        nodes = np.concatenate([share.nodes for share in self._shares])
        self._pattern, self._blocks, positions = loops.pattern(
            offsets.astype(np.int64), nodes, len(self._touched.nodes)
        )
        pairs = [int((np.diff(share.offsets) ** 2).sum()) for share in self._shares]
        split = np.split(positions, np.cumsum(pairs)[:-1])
        for share, part in zip(self._shares, split, strict=True):
            share.positions = part
        self._values: NDArray[np.float64] | None = None
        blocks = (self._pattern, self._blocks, self._bs, self._numbers)
        lasts = np.cumsum(self._comm.allgather(sizes[0]))
        own = (int(lasts[self._comm.rank]) - sizes[0], int(lasts[self._comm.rank]))
        starts, columns = self._exchange_rows(blocks, own, lasts)
        inside, outside, self._places = loops.reduce(*blocks, own, starts, columns)
        self._sources = np.concatenate([inside[2], outside[2]])
        self._entries = np.zeros(len(self._sources))
        values = np.split(self._entries, [len(inside[2])])
        csr = [
            (start.astype(PETSc.IntType), column.astype(PETSc.IntType), value)
            for (start, column, _), value in zip((inside, outside), values, strict=True)
        ]
        self._A = PETSc.Mat().createAIJWithArrays(
            (sizes, sizes), csr[0] if self._comm.size == 1 else tuple(csr), comm=self._comm
        )

    def _exchange_rows(
        self, blocks: tuple[Any, ...], own: tuple[int, int], lasts: NDArray[np.int64]
    ) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Tell other ranks the places of their entries; return what they tell, by own row."""
        rows, (starts, columns, sources) = loops.foreign_rows(*blocks, own)
        row = np.repeat(rows, np.diff(starts))
        owner = np.searchsorted(lasts, row, side="right")
        order = np.argsort(owner, kind="stable")
        self._sent = np.split(
            sources[order], np.searchsorted(owner[order], np.arange(1, self._comm.size))
        )
        ends = np.cumsum([len(part) for part in self._sent])[:-1]
        pairs = np.column_stack([row, columns])[order]
        received = np.concatenate(swap(self._comm, np.split(pairs, ends)))
        self._order = np.argsort(received[:, 0], kind="stable")
        counts = np.bincount(received[:, 0] - own[0], minlength=own[1] - own[0])
        offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        return offsets, np.ascontiguousarray(received[self._order, 1])

    def assemble(self, keep: bool) -> PETSc.Mat:
        """Return ``T^T K T``; the same object as long as the pattern lasts (collective).

        Args:
            keep: Whether :meth:`multiply_add` will be called.
        """
        assert self._A is not None
        values = np.zeros(len(self._blocks) * self._bs**2 + 1)
        for share in self._shares:
            share.add(values)
        loops.gather(values, self._sources, self._entries)
        if self._comm.size > 1:
            received = np.concatenate(swap(self._comm, [values[part] for part in self._sent]))
            np.add.at(self._entries, self._places, received[self._order])
        self._A.assemble()
        self._values = values[:-1] if keep else None
        return self._A

    def multiply_add(self, u: PETSc.Vec, force: PETSc.Vec) -> None:
        """Add the last ``T^T K T u`` on all active dofs of V, fixed ones too (collective)."""
        assert self._values is not None and self._touched is not None
        local = self._touched.spread(u.array_r.reshape(-1, self._bs))
        result = np.empty_like(local)
        loops.multiply(self._pattern, self._blocks, self._bs, self._values, local, result)
        force.array_w[:] += self._touched.collect(result).ravel()
