# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Velocities and forces at the nodes of bodies, from step to step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, override

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..errors import MPMError
from ..io.snapshot import Kept, Taken, fill, of_cells, spaces_of
from ..meshes.remesh import Column, Place
from ..particles.particles import Particles
from .account import Account
from .schemes import Scheme
from .term import Term

__all__ = ["Velocities"]

FORCES = ("force", "external")


class Velocities(Kept):
    """Velocities, the forces that were there with them, and the account of energies.

    Args:
        bodies: The bodies.
        velocities: At the beginning, on W of each body.
        scheme: The time scheme.
        rayleigh: Damping in proportion to mass and stiffness.
        static: The bodies that have no inertia.
        account: The account of energies.

    Attributes:
        bodies: As given.
        scheme: As given.
        velocities: At the last converged step, on W of each body.
        forces: Of all terms, at the same time.
        external: Those of them that are loads.
        kept: What the scheme keeps.
        time: Time of the last converged step.
        last: Its duration; 0 before the first.
    """

    key = "inertia"

    def __init__(
        self,
        bodies: Sequence[Particles],
        velocities: Sequence[fem.Function],
        scheme: Scheme,
        rayleigh: tuple[float, float],
        static: Sequence[Particles],
        account: Account,
    ) -> None:
        self.bodies = tuple(bodies)
        self.scheme, self._rayleigh, self._static = scheme, rayleigh, static
        self._account = account
        self.velocities = list(velocities)
        self.forces = [fem.Function(body.W) for body in bodies]
        self.external = [fem.Function(body.W) for body in bodies]
        self.kept = [[fem.Function(body.W) for body in bodies] for _ in scheme.keeps]
        self.time, self.last = 0.0, 0.0
        self._rates: list[NDArray[np.float64]] = []  # of Dirichlet values, in the last step

    def is_static(self, body: Particles) -> bool:
        """Return whether a body has no inertia."""
        return any(body is one for one in self._static)

    def number(self, body: Particles) -> int:
        """Return the number of a body."""
        return next(i for i, one in enumerate(self.bodies) if one is body)

    def join(self, bodies: Sequence[Particles]) -> None:
        """Hold some more bodies, which are at rest, or fewer of the last (collective).

        Args:
            bodies: All bodies, in the problem's order.
        """
        self.bodies = tuple(bodies)
        for functions in self._fields().values():
            del functions[len(bodies) :]
            for body in bodies[len(functions) :]:
                functions.append(fem.Function(body.W, name="velocity"))

    def _fields(self) -> dict[str, list[fem.Function]]:
        """Return all fields by their names in a checkpoint."""
        own = {"velocity": self.velocities, "force": self.forces, "external": self.external}
        kept = zip(self.scheme.keeps, self.kept, strict=True)
        return own | {f"{self.scheme.name} {name}": functions for name, functions in kept}

    # -- Steps ------------------------------------------------------------------------------------

    def beginning(
        self, forces: Sequence[NDArray[np.float64]] | None = None
    ) -> list[NDArray[np.float64]]:
        """Return all that a step begins with, to be set: velocities, what is kept, forces, rates.

        Args:
            forces: Others in place of those.
        """
        moved = [one.x.array for functions in (self.velocities, *self.kept) for one in functions]
        own = [one.x.array for one in self.forces] if forces is None else forces
        return [np.asarray(values) for values in (*moved, *own, *self._rates)]

    def note_forces(self, terms: Sequence[Term], balanced: bool = False) -> None:
        """Keep the forces of all other terms, as they are now (collective).

        Args:
            terms: The terms.
            balanced: Whether they are those of a step that has converged, which a term that begins
                anew may find otherwise, as where points of contact have stayed with their facets.
        """
        for function in (*self.forces, *self.external):
            function.x.array[:] = 0.0
        for term in terms:
            if balanced:
                self._gather(term, term.end_forces(), self.forces)
            self._gather(term, term.begin(), self.external)
            if not balanced:
                self._gather(term, term.end_forces(), self.forces)
        for function in (*self.forces, *self.external):
            function.x.scatter_forward()

    def _gather(self, term: Term, vectors: Sequence[Any], to: Sequence[fem.Function]) -> None:
        """Add a term's forces to those of its bodies."""
        for body, vector in zip(term.bodies if vectors else (), vectors, strict=True):
            to[self.number(body)].x.array[: vector.getLocalSize()] += vector.array_r

    def driven(self, changes: Sequence[NDArray[np.float64]], dt: float) -> list[Any]:
        """Return the rates of Dirichlet values at a step's beginning.

        They are those of a parabola through the last three values.

        Args:
            changes: Of the values in the step, on own dofs of each background.
            dt: Its duration.
        """
        rates = [change / dt for change in changes]
        if self.last > 0.0 and len(self._rates) == len(rates):
            part = dt / (dt + self.last)
            before = zip(self._rates, rates, strict=True)
            rates = [part * last + (1.0 - part) * now for last, now in before]
        return rates

    def commit(
        self, fields: Sequence[Sequence[Any]], changes: Sequence[NDArray[np.float64]], time: float
    ) -> None:
        """Take over a step that has converged (collective).

        Args:
            fields: Velocities at its end, and what the scheme keeps of it; vectors for each body.
            changes: Of Dirichlet values in it.
            time: Time of its end.
        """
        for functions, vectors in zip((self.velocities, *self.kept), fields, strict=True):
            for function, vector in zip(functions, vectors, strict=True):
                function.x.array[: vector.getLocalSize()] = vector.array_r
                function.x.scatter_forward()
        dt = time - self.time
        self._rates = [change / dt for change in changes]
        self.time, self.last = time, dt

    def undo(self) -> Callable[[], None]:
        """Return a function that takes back all changes from now on, also in the account."""
        functions = [one for fields in self._fields().values() for one in fields]
        values = [function.x.array.copy() for function in functions]
        before, account = (self.time, self.last, self._rates), self._account.undo()

        def undo() -> None:
            for function, its in zip(functions, values, strict=True):
                function.x.array[:] = its
            self.time, self.last, self._rates = before
            account()

        return undo

    # -- Checkpoints ------------------------------------------------------------------------------

    @override
    def numbers(self) -> dict[str, Any]:
        return {
            "scheme": [self.scheme.name, "reflect" if self.scheme.reflects else "project"],
            "rayleigh": list(self._rayleigh),
            "static": [number for number, body in enumerate(self.bodies) if self.is_static(body)],
            "time": self.time,
            "rates": self.last,
            **self._account.numbers(),
        }

    @override
    def columns(self, body: int | None) -> dict[str, Column]:
        if body is None:
            return self.on_background(0)
        return {name: _column(name, its[body]) for name, its in self._fields().items()}

    @override
    def on_background(self, number: int) -> dict[str, Column]:
        """Return the rates of Dirichlet values in the last step."""
        spaces = spaces_of(self.bodies)
        if number >= len(spaces):  # that of a pressure, which has no rates
            return {}
        function = fem.Function(spaces[number])
        if self.last > 0.0 and number < len(self._rates):
            function.x.array[: len(self._rates[number])] = self._rates[number]
            function.x.scatter_forward()
        return {"rates": Column(of_cells(function), "nodes")}

    @override
    def require(self, source: str, taken: Taken) -> None:
        if "scheme" not in taken.numbers:
            raise MPMError(f"{source} holds no velocities; it is not that of a DynamicProblem.")
        present = self.numbers()
        mine, its = present["scheme"], taken.numbers["scheme"]
        if list(its) != mine:
            raise MPMError(
                f"{source} was made with scheme={its[0]!r}, out_of_range={its[1]!r}, and this "
                f"problem with {mine[0]!r}, {mine[1]!r}."
            )
        damping = taken.numbers.get("rayleigh")  # which older files do not tell
        if damping is not None and damping != present["rayleigh"]:
            raise MPMError(
                f"{source} was made with rayleigh={tuple(damping)}, and this problem with "
                f"{tuple(present['rayleigh'])}."
            )
        if taken.numbers.get("static", []) != present["static"]:
            raise MPMError(f"{source} has other bodies without inertia than quasi_static= says.")
        super().require(source, taken)

    @override
    def restore(self, taken: Taken) -> None:
        for name, functions in self._fields().items():
            for number, body in enumerate(self.bodies):
                if functions[number].function_space is not body.W:
                    functions[number] = fem.Function(body.W, name=functions[number].name)
                fill(functions[number], taken.columns[number][name])
        self.time, self.last = taken.numbers["time"], taken.numbers["rates"]
        self._account.restore(taken.numbers)
        self._rates = []
        for V, columns in zip(spaces_of(self.bodies), taken.backgrounds, strict=False):
            function = fem.Function(V)
            fill(function, columns["rates"])
            owned = V.dofmap.index_map.size_local * V.dofmap.index_map_bs
            self._rates.append(np.array(function.x.array[:owned]))


def _column(name: str, function: fem.Function) -> Column:
    """Return the column of a field in a checkpoint."""
    place: Place = "forces" if name in FORCES else "nodes"
    return Column(of_cells(function), place)
