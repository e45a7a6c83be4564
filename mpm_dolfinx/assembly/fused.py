# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The fast route: ``T^T K T`` domain by domain, in one compiled loop."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any, NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from .. import _compat
from .._core import loops
from ..constitutive.averaging import LowRankTerm
from ..errors import MPMError
from ..history import Statistics
from ..parallel.exchange import swap
from ..particles.particles import Particles
from ..transfer.touched import TouchedNodes, TransferRows
from .body_forms import BodyForms, no_values

__all__ = ["ROUTES", "FusedTangent", "Masses", "Restriction", "is_fast"]

ROUTES = ("auto", "fast", "reference")


def is_fast(route: str) -> bool:
    """Return whether a route is that of the compiled loops.

    Args:
        route: ``"fast"``, ``"reference"``, or ``"auto"``: what the environment variable
            ``MPM_DOLFINX_ASSEMBLY`` says, or else fast where the loops were built.

    Raises:
        MPMError: There is no such route, or no compiled loops to be fast.
    """
    if route == "auto":
        route = os.environ.get("MPM_DOLFINX_ASSEMBLY", "fast" if loops else "reference")
    if route not in ROUTES[1:]:
        raise MPMError(f"Unknown assembly={route!r}; choose 'auto', 'fast' or 'reference'.")
    if route == "fast" and loops is None:
        raise MPMError(
            "assembly='fast' needs the compiled loops, and the package was built without a C++ "
            "compiler; install one and build the package again, or use assembly='reference'."
        )
    return route == "fast"


class _Loops:
    """One body's domains, their background nodes and where their tangents go."""

    def __init__(self, particles: Particles, forms: BodyForms) -> None:
        self._particles = particles
        self._forms = forms
        self._domains = (particles.domain_nodes, particles.quadrature.gradients)
        internal = forms.internal
        one = particles.num_points == 1
        self._points = internal is not None and one and internal.hoop is None
        self._whole = bool(forms.fused) or (internal is not None and not self._points)
        self.offsets: NDArray[np.int64] = np.zeros(1, dtype=np.int64)
        self.nodes: NDArray[np.int32] = np.zeros(0, dtype=np.int32)
        self.positions: NDArray[np.int32] = np.zeros(0, dtype=np.int32)

    def support(self, rows: TransferRows) -> bool:
        """Find the background nodes of each domain; return whether they are the old ones."""
        offsets, nodes = loops.supports(*self._domains, *rows)
        same = np.array_equal(offsets, self.offsets) and np.array_equal(nodes, self.nodes)
        self.offsets, self.nodes = offsets, nodes
        return same

    def transfer(self, rows: TransferRows) -> None:
        """Take over the values of T."""
        given = (*self._domains, *rows, self.offsets, self.nodes)
        if self._points:
            self._gradients = np.empty((len(self.nodes), self._domains[1].shape[-1]))
            loops.support_gradients(*given, self._gradients)
        if self._whole:
            self._transfers = np.empty((len(self.nodes), self._particles.domain_nodes.shape[1]))
            loops.local_transfers(*given, self._transfers)

    @staticmethod
    def _vectors(term: LowRankTerm | None) -> NDArray[np.float64]:
        """Return left and right vectors of each domain in turn, ``(n, 2 m, k, gdim)``; or none."""
        if term is None:
            return no_values
        pairs = zip(term.left, term.right, strict=True)
        return np.stack([vector for pair in pairs for vector in pair], axis=1)

    def add_masses(
        self, masses: NDArray[np.float64], rows: TransferRows, values: NDArray[np.float64]
    ) -> None:
        """Add the body's reduced mass, one number for each of the pattern's blocks."""
        if self._whole:
            transfers = self._transfers
        else:
            transfers = np.empty((len(self.nodes), self._particles.domain_nodes.shape[1]))
            loops.local_transfers(*self._domains, *rows, self.offsets, self.nodes, transfers)
        loops.assemble_masses(
            *self._domains, transfers, masses, self.offsets, self.positions, values
        )

    def add(self, values: NDArray[np.float64]) -> None:
        """Add the body's reduced tangent to the values of the pattern's blocks."""
        target = (self.offsets, self.positions, values)
        internal = self._forms.internal
        if internal is not None and self._points:
            loops.assemble_points(
                *self._domains,
                internal.weights,
                self._gradients,
                internal.tangent,
                internal.symmetric,
                *target,
            )
        elif internal is not None:
            loops.assemble_domains(
                *self._domains,
                internal.weights,
                no_values if internal.hoop is None else internal.hoop,
                self._transfers,
                internal.tangent,
                self._vectors(self._forms.low_rank_of_domains()),
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


class Restriction(NamedTuple):
    """The present transfer and unknowns of a field.

    Attributes:
        touched: The nodes that its bodies touch.
        rows: Their rows of T, of each part of the tangent.
        numbers: For each own dof of V its number among all unknowns, or -1.
        part: Where the field's unknowns are among this rank's.
    """

    touched: TouchedNodes
    rows: Sequence[TransferRows]
    numbers: NDArray[np.int32]
    part: slice


type Masses = Sequence[tuple[Particles, NDArray[np.float64]]]
"""Bodies, and for each of their domains a matrix between its nodes, ``(n, k, k)``."""


class FusedTangent:
    """``T^T K T`` of all bodies of some fields at the unknowns, without ever forming K.

    Each rank adds its own domains' ``T_p^T K_p T_p`` to blocks between the background nodes
    that they touch, of whatever rank. The pattern, and with it the matrix, lasts until a node
    of a body enters another cell. Off-rank rows travel once for each assembly. The fields are
    blocks on the diagonal of one matrix, into which each writes.

    Args:
        comm: The ranks.
        fields: Bodies with their forms, those of each field.
        statistics: Where to count.
    """

    def __init__(
        self,
        comm: MPI.Comm,
        fields: Sequence[Sequence[tuple[Particles, BodyForms]]],
        statistics: Statistics,
    ) -> None:
        self._comm = comm
        self._blocks = [_Block(comm, bodies) for bodies in fields]
        self._statistics = statistics
        self._A: PETSc.Mat | None = None

    def restrict(self, fields: Sequence[Restriction], sizes: tuple[int, int]) -> None:
        """Take over the present transfer and unknowns (collective).

        Args:
            fields: Those of each field.
            sizes: Number of unknowns of this rank and of all ranks.
        """
        same = self._A is not None and self._A.getSizes()[0] == sizes
        for block, field in zip(self._blocks, fields, strict=True):
            same &= block.restrict(field)
        if not self._comm.allreduce(same, MPI.LAND):
            self._make_matrix(fields, sizes)
            self._statistics.count("patterns")
        for block, field in zip(self._blocks, fields, strict=True):
            block.transfer(field.rows)

    def forget(self) -> None:
        """Make the pattern anew in the next step."""
        self._A = None

    def _make_matrix(self, fields: Sequence[Restriction], sizes: tuple[int, int]) -> None:
        lasts = np.cumsum(self._comm.allgather(sizes[0]))
        start = int(lasts[self._comm.rank]) - sizes[0]
        found = [
            block.make_pattern((start + field.part.start, start + field.part.stop), lasts)
            for block, field in zip(self._blocks, fields, strict=True)
        ]
        parts = [field.part for field in fields]
        inside = [
            (starts, part.start + columns)
            for part, ((starts, columns), _) in zip(parts, found, strict=True)
        ]
        outside = [others for _, others in found]
        csr = [_stacked(parts, entries, sizes[0]) for entries in (inside, outside)]
        values = [np.zeros(len(columns)) for _, columns in csr]
        ends = [0, 0]
        for block, entries in zip(self._blocks, zip(inside, outside, strict=True), strict=True):
            mine = []
            for side, (_, columns) in enumerate(entries):
                mine.append(values[side][ends[side] : ends[side] + len(columns)])
                ends[side] += len(columns)
            block.entries = mine[0], mine[1]
        matrices = [(*one, data) for one, data in zip(csr, values, strict=True)]
        self._A = PETSc.Mat().createAIJWithArrays(
            (sizes, sizes),
            matrices[0] if self._comm.size == 1 else tuple(matrices),
            comm=self._comm,
        )

    def weigh(self, masses: Masses) -> PETSc.Mat:
        """Return ``T^T M T``, and keep it for :meth:`assemble` in this step (collective).

        What :meth:`assemble` has returned is overwritten.

        Args:
            masses: M of domains.
        """
        assert self._A is not None
        for block in self._blocks:
            block.weigh(masses)
        self._A.assemble()
        # Of all components of two nodes, masses join equal ones.
        offsets, columns, values = self._A.getValuesCSR()
        kept = values != 0.0
        ends = np.concatenate([[0], np.cumsum(kept)])[offsets]
        csr = (ends.astype(PETSc.IntType), columns[kept], values[kept])
        return PETSc.Mat().createAIJ(self._A.getSizes(), csr=csr, comm=self._comm)

    def assemble(self, keep: Sequence[bool], factor: float = 0.0) -> PETSc.Mat:
        """Return ``T^T K T``; the same object as long as the pattern lasts (collective).

        Args:
            keep: Whether :meth:`multiply_add` will be called, for each field.
            factor: How often the masses of :meth:`weigh` are added, if there are any.
        """
        assert self._A is not None
        for block, kept in zip(self._blocks, keep, strict=True):
            block.assemble(kept, factor)
        self._A.assemble()
        return self._A

    def multiply_add(self, field: int, u: PETSc.Vec, force: PETSc.Vec) -> None:
        """Add a field's last ``T^T K T u`` on all active dofs, fixed ones too (collective).

        Args:
            field: Its number.
            u: An increment of its V.
            force: What it is added to.
        """
        self._blocks[field].multiply_add(u, force)


def _stacked(
    parts: Sequence[slice],
    entries: Sequence[tuple[NDArray[np.int32], NDArray[np.int32]]],
    count: int,
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return offsets and columns of rows below each other, of which each part has some."""
    counts = np.zeros(count + 1, dtype=PETSc.IntType)
    for part, (starts, _) in zip(parts, entries, strict=True):
        counts[part.start + 1 : part.stop + 1] = np.diff(starts)
    columns = np.concatenate([columns for _, columns in entries])
    return np.cumsum(counts, dtype=PETSc.IntType), columns.astype(PETSc.IntType)


class _Block:
    """The tangent of one field.

    Args:
        comm: The ranks.
        bodies: Bodies with their forms, all on one V; there may be none.

    Attributes:
        entries: Values of the field's rows in the matrix: in columns of this rank, and in others.
    """

    def __init__(self, comm: MPI.Comm, bodies: Sequence[tuple[Particles, BodyForms]]) -> None:
        self._comm = comm
        self._bodies = [particles for particles, _ in bodies]
        self._loops = [_Loops(*body) for body in bodies]
        self._masses: NDArray[np.float64] | None = None
        self._bs = bodies[0][0].V.dofmap.index_map_bs if bodies else 1
        self._touched: TouchedNodes | None = None
        self._numbers: NDArray[np.int32] = np.zeros(0, dtype=np.int32)
        self.entries: tuple[NDArray[np.float64], NDArray[np.float64]]

    def restrict(self, field: Restriction) -> bool:
        """Take over the present unknowns; return whether their pattern is the old one."""
        self._touched = field.touched
        if not self._loops:
            return True
        numbers = field.touched.spread(field.numbers.reshape(-1, self._bs)).ravel()
        same = bool(np.array_equal(numbers, self._numbers))
        self._numbers = numbers
        for body, own in zip(self._loops, field.rows, strict=True):
            same &= body.support(own)
        return same

    def transfer(self, rows: Sequence[TransferRows]) -> None:
        """Take over the values of T."""
        self._rows, self._masses = rows, None
        for body, own in zip(self._loops, rows, strict=True):
            body.transfer(own)

    def weigh(self, masses: Masses) -> None:
        """Write the masses into the field's rows, and keep them (collective)."""
        if not self._loops:
            return
        self._masses = np.zeros(len(self._blocks))
        for body, loop, rows in zip(self._bodies, self._loops, self._rows, strict=True):
            for particles, own in masses:
                if particles is body:
                    loop.add_masses(own, rows, self._masses)
        values = np.zeros(len(self._blocks) * self._bs**2 + 1)
        self._add_masses(1.0, values)
        self._write(values)

    def _add_masses(self, factor: float, values: NDArray[np.float64]) -> None:
        """Add the masses, if any, to the values of the pattern's blocks."""
        if self._masses is None:
            return
        blocks = values[:-1].reshape(-1, self._bs, self._bs)
        for i in range(self._bs):
            blocks[:, i, i] += factor * self._masses

    def make_pattern(
        self, own: tuple[int, int], lasts: NDArray[np.int64]
    ) -> tuple[
        tuple[NDArray[np.int32], NDArray[np.int32]], tuple[NDArray[np.int32], NDArray[np.int32]]
    ]:
        """Return the field's rows of the matrix, as offsets and columns (collective).

        Args:
            own: Range of the numbers of this rank's unknowns of the field.
            lasts: End of the range of all unknowns of each rank.

        Returns:
            Entries in these columns, counted from the first of them, and in all others.
        """
        assert self._touched is not None
        if not self._loops:
            none = np.zeros(own[1] - own[0] + 1, dtype=np.int32), np.zeros(0, dtype=np.int32)
            return none, none
        ends = np.cumsum([0, *(body.offsets[-1] for body in self._loops)])
        offsets = np.concatenate(
            [[0], *(s.offsets[1:] + end for s, end in zip(self._loops, ends, strict=False))]
        )
        nodes = np.concatenate([body.nodes for body in self._loops])
        self._pattern, self._blocks, positions = loops.pattern(
            offsets.astype(np.int64), nodes, len(self._touched.nodes)
        )
        pairs = [int((np.diff(body.offsets) ** 2).sum()) for body in self._loops]
        split = np.split(positions, np.cumsum(pairs)[:-1])
        for body, part in zip(self._loops, split, strict=True):
            body.positions = part
        self._values: NDArray[np.float64] | None = None
        blocks = (self._pattern, self._blocks, self._bs, self._numbers)
        starts, columns = self._exchange_rows(blocks, own, lasts)
        inside, outside, places = loops.reduce(*blocks, own, starts, columns)
        self._sources = inside[2], outside[2]
        shift = len(inside[2])
        self._within = places < shift
        self._places = places[self._within], places[~self._within] - shift
        return inside[:2], outside[:2]

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

    def assemble(self, keep: bool, factor: float) -> None:
        """Write the field's rows (collective).

        Args:
            keep: Whether :meth:`multiply_add` will be called.
            factor: Of the masses.
        """
        if not self._loops:
            return
        values = np.zeros(len(self._blocks) * self._bs**2 + 1)
        for body in self._loops:
            body.add(values)
        if factor != 0.0:
            self._add_masses(factor, values)
        self._write(values)
        self._values = values[:-1] if keep else None

    def _write(self, values: NDArray[np.float64]) -> None:
        """Write the values of the pattern's blocks, summed over ranks, into the field's rows."""
        for sources, entries in zip(self._sources, self.entries, strict=True):
            loops.gather(values, sources, entries)
        if self._comm.size > 1:
            received = np.concatenate(swap(self._comm, [values[part] for part in self._sent]))
            received = received[self._order]
            np.add.at(self.entries[0], self._places[0], received[self._within])
            np.add.at(self.entries[1], self._places[1], received[~self._within])

    def multiply_add(self, u: PETSc.Vec, force: PETSc.Vec) -> None:
        """Add the last ``T^T K T u`` on all active dofs of V, fixed ones too (collective)."""
        if not self._loops:
            return
        assert self._values is not None and self._touched is not None
        local = self._touched.spread(u.array_r.reshape(-1, self._bs))
        result = np.empty_like(local)
        loops.multiply(self._pattern, self._blocks, self._bs, self._values, local, result)
        force.array_w[:] += self._touched.collect(result).ravel()
