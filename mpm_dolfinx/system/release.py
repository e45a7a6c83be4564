# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Forces that keep bodies as they are where a stage begins, and that go over it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, cast, override

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..io.snapshot import Kept, Taken, fill, of_cells
from ..meshes.remesh import Column, Place
from ..particles.field import CarriedField
from ..particles.particles import Particles
from .term import Term

__all__ = ["Release"]

type Array = NDArray[np.float64]


class Release(Term):
    """Forces of what a stage takes away or adds at once, held back and let go over the stage.

    Let r be the residual with the loads and bodies of the stage, and q what it differs by from that
    of before, both in the state of before. The stage solves ``r - s q = 0``, where s goes from 1
    to 0: it begins in equilibrium, and ends in that of the stage. q has values at the bodies' nodes
    and, for Dirichlet conditions that are taken away, at dofs of the backgrounds.

    Attributes:
        remaining: s at the last converged step; 0 where nothing is held back.
    """

    one_sided = False
    symmetric = True

    def __init__(self) -> None:
        super().__init__()
        self.remaining = 0.0
        self._aim = self._factor = 0.0
        self._nodal: list[fem.Function] = []
        self._reactions: list[fem.Function] = []

    def follow(
        self,
        bodies: Sequence[Particles | CarriedField],
        spaces: Sequence[fem.FunctionSpace],
    ) -> None:
        """Take bodies on their present meshes, without any force on them (collective).

        Args:
            bodies: The bodies, then their other fields.
            spaces: Their backgrounds.
        """
        self.bodies, self._spaces = cast("tuple[Particles, ...]", tuple(bodies)), list(spaces)
        self.let_go()

    def left(self) -> list[Array]:
        """Return the forces held back now on this rank's own dofs of each background."""
        found = []
        for i, V in enumerate(self._spaces):
            count = V.dofmap.index_map.size_local * V.dofmap.index_map_bs
            held = self._reactions[i].x.array[:count] if self._reactions else np.zeros(count)
            found.append(np.asarray(self.remaining * held))
        return found

    @property
    def held(self) -> list[Array]:
        """The forces held back in whole, at nodes of bodies and dofs of backgrounds, to be set."""
        return [np.asarray(f.x.array) for f in (*self._nodal, *self._reactions)]

    def let_go(self) -> None:
        """Hold nothing back any more."""
        self.remaining = self._aim = self._factor = 0.0
        self._nodal, self._reactions = [], []

    def hold(self, nodal: Sequence[Array], reactions: Sequence[Array]) -> None:
        """Hold forces back, in place of those that were held before (collective).

        Args:
            nodal: q on this rank's own dofs of W of each body, and of each of its fields.
            reactions: q on this rank's own dofs of each background.
        """
        self._nodal = [_function(b.W, f) for b, f in zip(self.bodies, nodal, strict=True)]
        self._reactions = [_function(V, f) for V, f in zip(self._spaces, reactions, strict=True)]
        some = any(np.any(f) for f in (*nodal, *reactions))
        if self.bodies[0].mesh.comm.allreduce(some):
            self.remaining = self._aim = self._factor = 1.0
        else:
            self.let_go()

    def aim(self, remaining: float) -> None:
        """Take a value of s for the end of the steps that begin from now on."""
        self._aim = remaining if self._nodal else 0.0

    # -- A step ---------------------------------------------------------------------------

    @override
    def begin(self) -> Sequence[PETSc.Vec]:
        self._factor = self._aim
        return self.residuals()

    @override
    def residuals(self) -> Sequence[PETSc.Vec]:
        if self._factor == 0.0:
            return ()
        forces = []
        for function in self._nodal:
            dofs = function.function_space.dofmap
            vector = PETSc.Vec().createMPI(
                (dofs.index_map.size_local * dofs.index_map_bs, None),
                comm=function.function_space.mesh.comm,
            )
            vector.array_w[:] = -self._factor * function.x.array[: vector.getLocalSize()]
            forces.append(vector)
        return forces

    def background_forces(self, V: fem.FunctionSpace) -> Array | None:
        """Return the forces on this rank's own dofs of a background, or none (collective)."""
        if self._factor == 0.0:
            return None
        function = next(f for f in self._reactions if f.function_space is V)
        count = V.dofmap.index_map.size_local * V.dofmap.index_map_bs
        return np.asarray(-self._factor * function.x.array[:count])

    @override
    def commit(self) -> Callable[[], None]:
        before = self.remaining, self._nodal, self._reactions

        def undo() -> None:
            self.remaining, self._nodal, self._reactions = before

        self.remaining = self._factor
        if self.remaining == 0.0:
            self.let_go()
        return undo

    @override
    def roll_back(self) -> None:
        self._factor = self.remaining

    # -- What goes with the problem -------------------------------------------------------

    @override
    def kept(self) -> Sequence[Kept]:
        return [_Held(self)]

    def columns(self, body: int) -> dict[str, Column]:
        """Return the forces held back at the nodes of a body, and for its fields."""
        if not self._nodal:
            return {}
        return {
            name: Column(of_cells(self._nodal[number]), place)
            for number, name, place in self._of_body(body)
        }

    def _of_body(self, body: int) -> list[tuple[int, str, Place]]:
        """Return the numbers of a body and of its fields, what they are called, and where."""
        found: list[tuple[int, str, Place]] = [(body, "force", "forces")]
        for number, one in enumerate(self.bodies):
            if isinstance(one, CarriedField) and one.field.particles is self.bodies[body]:
                place: Place = "forces" if one.place == "nodes" else one.place
                found.append((number, f"force {one.field.name}", place))
        return found

    def on_cells(self, number: int) -> dict[str, Column]:
        """Return the forces held back on a background."""
        if not self._reactions:
            return {}
        return {"reaction": Column(of_cells(self._reactions[number]), "nodes")}

    def take(self, taken: Taken) -> None:
        """Take over what was once kept (collective)."""
        self.let_go()
        remaining = float(taken.numbers.get("remaining", 0.0))
        if remaining == 0.0:
            return
        self._nodal = [fem.Function(one.W) for one in self.bodies]
        for body, columns in enumerate(taken.columns[:-1]):
            for number, name, _ in self._of_body(body):
                fill(self._nodal[number], columns[name])
        for V, columns in zip(self._spaces, taken.backgrounds, strict=True):
            self._reactions.append(fem.Function(V))
            fill(self._reactions[-1], columns["reaction"])
        self.remaining = self._aim = self._factor = remaining


class _Held(Kept):
    """Forces held back, and their share.

    Args:
        release: Has it.
    """

    key = "release"

    def __init__(self, release: Release) -> None:
        self._release = release

    @override
    def numbers(self) -> dict[str, Any]:
        return {"remaining": self._release.remaining}

    @override
    def columns(self, body: int | None) -> dict[str, Column]:
        return {} if body is None else self._release.columns(body)

    @override
    def on_background(self, number: int) -> dict[str, Column]:
        return self._release.on_cells(number)

    @override
    def require(self, source: str, taken: Taken) -> None:
        """Take any state, one from before there were stages too."""

    @override
    def restore(self, taken: Taken) -> None:
        self._release.take(taken)


def _function(space: fem.FunctionSpace, owned: Array) -> fem.Function:
    """Return a Function with values on this rank's own dofs (collective)."""
    function = fem.Function(space)
    function.x.array[: len(owned)] = owned
    function.x.scatter_forward()
    return function
