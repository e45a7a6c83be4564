# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""PETSc objects that are out of use, freed where all ranks come by together.

On several ranks petsc4py leaves objects that Python drops to a collective call. A problem's end
is no place for it: Python's garbage collection, which may be what ends it, runs at moments of its
own on each rank, in the middle of other collective calls too.
"""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI
from petsc4py import PETSc

from dolfinx import mesh

__all__ = ["Cleaner"]


class Cleaner:
    """Frees what one problem, and those that ended before, have left.

    Args:
        comm: The ranks of the problem (collective).
        meshes: The meshes on whose communicators its PETSc objects live.
    """

    _made = 0
    _ended: dict[int, Cleaner] = {}

    def __init__(self, comm: MPI.Comm, meshes: Sequence[mesh.Mesh]) -> None:
        self.comm = comm
        self.meshes = list(meshes)
        type(self)._made = self._number = comm.allreduce(self._made, MPI.MAX) + 1
        self()

    def __call__(self) -> None:
        """Free what is out of use (collective)."""
        if self.comm.size == 1:
            return
        same = (MPI.IDENT, MPI.CONGRUENT)
        mine = {n for n, c in self._ended.items() if MPI.Comm.Compare(c.comm, self.comm) in same}
        everywhere = sorted(set.intersection(*self.comm.allgather(mine)))
        for cleaner in [*map(self._ended.pop, everywhere), self]:
            for domain in cleaner.meshes:
                PETSc.garbage_cleanup(domain.comm)

    def end(self) -> None:
        """Leave what the problem has to the next one (not collective)."""
        if self.comm.size > 1:
            self._ended[self._number] = self
