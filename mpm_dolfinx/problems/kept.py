# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""State that every problem keeps: bodies, points, Functions, increments, and its progress."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal, override

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..constitutive.points import MaterialPoints
from ..errors import MPMError, ParticleOutsideError
from ..history import Attempt, History, Loss, Stage, Statistics, Step
from ..io.snapshot import Kept, Taken, fill, of_cells
from ..meshes.remesh import Column
from ..particles.field import CarriedField
from ..particles.free import chosen_nodes
from ..particles.particles import Particles
from ..particles.reference import Reference
from ..stepping.automatic import control_of
from ..stepping.control import Converged, Progress, Run
from ..system.reduced import ReducedSystem

__all__ = ["Bodies", "Functions", "Increments", "Material", "Past", "Standing", "Values"]


class Bodies(Kept):
    """Displacement of the bodies, what they are on their meshes, and what was deleted of them."""

    def __init__(self, bodies: Sequence[Particles]) -> None:
        self._bodies = bodies

    @override
    def numbers(self) -> dict[str, Any]:
        return {"cuts": [body.trail.cuts.tolist() for body in self._bodies]}

    @override
    def columns(self, body: int | None) -> dict[str, Column]:
        return {} if body is None else _columns_of(self._bodies[body])

    def require(self, source: str, taken: Taken) -> None:
        """Raise an error where a state holds what nothing here takes."""
        for body, columns in zip(self._bodies, taken.columns, strict=False):
            kept = _columns_of(body).keys()
            if unknown := sorted(columns.keys() - kept):
                raise MPMError(f"{source} holds {unknown}, which this problem does not keep.")
            if missing := sorted(kept - columns.keys()):
                raise MPMError(f"{source} does not hold {missing}, which this problem keeps.")

    @override
    def restore(self, taken: Taken) -> None:
        for body, columns in zip(self._bodies, taken.columns, strict=False):
            _restore_body(body, columns)


def _columns_of(body: Particles) -> dict[str, Column]:
    """Return the last converged step of a body, cell by cell."""
    nodal = body.placement.displacement[body.domain_nodes]
    columns = {"displacement": Column(nodal, "nodes")}
    if body.free_nodes is not None:
        state = body.free_nodes.chosen.astype(np.float64) - body.free_nodes.spent
        columns["free"] = Column(state[body.domain_nodes], "nodes")
        led = body.free_nodes.led.x.array.reshape(len(state), -1)
        columns["led"] = Column(led[body.domain_nodes], "nodes")
    if body.deletion is not None:
        columns["deleted"] = Column(body.deletion.mask, "cells")
        columns["kept"] = Column(body.deletion.kept(nodal), "nodes")
    undeformed = body.undeformed
    if undeformed.mass_share is not None:
        columns |= undeformed.reference.columns()
        columns["mass share"] = Column(undeformed.mass_shares(), "nodes")
    if undeformed.origin is not None:
        columns["mesh nodes"] = Column(body.geometry.mesh_nodes, "nodes")
    return columns


def _restore_body(body: Particles, columns: dict[str, NDArray[Any]]) -> None:
    """Make what :func:`_columns_of` once returned the last converged step (collective)."""
    d, placement, undeformed = body.displacement.x, body.placement, body.undeformed
    d.array.reshape(-1, body.geometry.gdim)[body.domain_nodes] = columns["displacement"]
    d.scatter_forward()
    if body.free_nodes is not None:
        states = (columns["free"] > 0.5, columns["free"] < -0.5)
        nodes = (np.unique(body.domain_nodes[state]) for state in states)
        placement.choose_free(*(chosen_nodes(body.W, some) for some in nodes))
        led = body.free_nodes.led.x
        led.array.reshape(-1, body.geometry.gdim)[body.domain_nodes] = columns["led"]
        led.scatter_forward()
    if body.deletion is not None:
        placement.restore_deleted(columns["deleted"], columns["kept"])
    if undeformed.mass_share is not None:
        reference = (columns[f"reference {name}"] for name in Reference._fields)
        undeformed.refer(Reference(*reference))
        undeformed.set_mass_shares(columns["mass share"])
    body.commit()


class Material(Kept):
    """The history at the bodies' points, or one of the user's own.

    Args:
        get: Returns it at the last converged step.
        put: Takes it again.
        at: Where arrays live that do not say it; ``None``: they must.
        points: The materials at the points of each body, which may be weakened.
    """

    key = "history"

    def __init__(
        self,
        get: Callable[[], list[dict[str, Any]]],
        put: Callable[[list[dict[str, NDArray[Any]]]], None],
        at: Any,
        points: Sequence[MaterialPoints] = (),
    ) -> None:
        self._get, self._put, self._at, self._points = get, put, at, points

    @override
    def numbers(self) -> dict[str, Any]:
        factors = [points.laws.weakening for points in self._points]
        return {"weakening": factors} if factors else {}

    @override
    def columns(self, body: int | None) -> dict[str, Column]:
        if body is None:
            return {}
        return {
            name: value
            if isinstance(value, Column) or self._at is None
            else Column(np.asarray(value), self._at)
            for name, value in self._get()[body].items()
        }

    @override
    def require(self, source: str, taken: Taken) -> None:
        for number, history in enumerate(taken.columns[:-1]):
            present = self.columns(number)
            for name, column in present.items():
                shape = None if name not in history else history[name].shape[1:]
                if shape != column.values.shape[1:]:
                    raise MPMError(
                        f"{source} has no history {name!r} of the kind that this problem has."
                    )
            if history and not present:
                raise MPMError(
                    f"{source} has a history of stress, which this problem has no use for."
                )

    @override
    def restore(self, taken: Taken) -> None:
        """Restore; a state that has no strength leaves it as it is."""
        for points, factor in zip(self._points, taken.numbers.get("weakening", ()), strict=False):
            if factor != points.laws.weakening:
                points.laws.weaken(factor)
        self._put(taken.columns[:-1])


class Functions(Kept):
    """Functions on the bodies' meshes that are part of the user's state.

    Args:
        functions: As given to ``save`` or ``restore``.
        bodies: The bodies.
        needed: Functions at quadrature points that must be among them.

    Raises:
        MPMError: They cannot be kept, or one is missing.
    """

    key = "function"

    def __init__(
        self,
        functions: Sequence[fem.Function],
        bodies: Sequence[Particles],
        needed: set[fem.Function],
    ) -> None:
        known = isinstance(functions, list | tuple) and all(
            isinstance(f, fem.Function)
            and any(f.function_space.mesh is body.mesh for body in bodies)
            for f in functions
        )
        if not known:
            raise MPMError("functions must be a list of dolfinx.fem.Function on the body mesh.")
        shares = [[f for f in functions if f.function_space.mesh is body.mesh] for body in bodies]
        for own in shares:
            names = [f.name for f in own]
            if len(set(names)) < len(names):
                raise MPMError(
                    "functions are known by their names, which must differ, not "
                    f"{', '.join(names)}."
                )
        missing = needed.difference(functions)
        elsewhere = sorted(
            f.name
            for f in missing
            if all(f.function_space.mesh is not body.mesh for body in bodies)
        )
        if elsewhere:
            raise MPMError(
                "The residual holds data on another mesh than the body's "
                f"({', '.join(elsewhere)}), which a checkpoint does not know; return them from "
                "converged_state() of an heir of the problem, and take them in "
                "set_converged_state()."
            )
        if missing:
            names = sorted(f.name for f in missing)
            raise MPMError(
                f"The residual holds data at quadrature points ({', '.join(names)}); give these "
                "Functions as functions=[...], so that they are saved and restored too."
            )
        self._of = shares

    @override
    def columns(self, body: int | None) -> dict[str, Column]:
        own = [] if body is None else self._of[body]
        return {f.name: Column(of_cells(f), "nodes") for f in own}

    @override
    def require(self, source: str, taken: Taken) -> None:
        for own, columns in zip(self._of, taken.columns, strict=False):
            given = {f.name for f in own}
            if columns.keys() != given:
                raise MPMError(
                    f"{source} holds the functions {sorted(columns)}, but functions= names "
                    f"{sorted(given)}."
                )
            for function in own:
                space = function.function_space
                shape = (space.dofmap.list.shape[1], space.dofmap.bs)
                if columns[function.name].shape[1:] != shape:
                    raise MPMError(f"{source} holds the function {function.name} in another space.")

    @override
    def restore(self, taken: Taken) -> None:
        for own, columns in zip(self._of, taken.columns, strict=False):
            for function in own:
                fill(function, columns[function.name])


class Values(Kept):
    """The values of fields that are no displacements, and the units of their unknowns.

    Args:
        carried: The fields of each body.
        reduced: The system.
    """

    key = "fields"

    def __init__(self, carried: Sequence[Sequence[CarriedField]], reduced: ReducedSystem) -> None:
        self._carried, self._reduced = carried, reduced

    @override
    def numbers(self) -> dict[str, Any]:
        return {"units": [field.unit for field in self._reduced.unknowns.values]}

    @override
    def columns(self, body: int | None) -> dict[str, Column]:
        own = [] if body is None else self._carried[body]
        return {one.field.name: Column(of_cells(one.field.previous), one.place) for one in own}

    @override
    def restore(self, taken: Taken) -> None:
        for own, columns in zip(self._carried, taken.columns, strict=False):
            for one in own:
                fill(one.field.previous, columns[one.field.name])
                one.roll_back()
        fields = self._reduced.unknowns.values
        for field, unit in zip(fields, taken.numbers["units"], strict=False):
            field.unit = unit


class Increments(Kept):
    """The last increments, which predict the next, and their sum where errors are measured.

    Args:
        reduced: The system.
        bodies: All bodies.
        carried: The fields of each body that are no displacements.
    """

    key = "past"

    def __init__(
        self,
        reduced: ReducedSystem,
        bodies: Sequence[Particles],
        carried: Sequence[Sequence[CarriedField]],
    ) -> None:
        self._predictor, self._moved = reduced.predictor, reduced.bodies
        self._of: list[dict[str, Particles | CarriedField]] = []
        for body, fields in zip(bodies, carried, strict=True):
            own: dict[str, Particles | CarriedField] = {f" {one.field.name}": one for one in fields}
            self._of.append(own | {"": body} if self._number(body) >= 0 else own)

    def _number(self, moved: Particles | CarriedField) -> int:
        return next((i for i, other in enumerate(self._moved) if other is moved), -1)

    def numbers(self) -> dict[str, Any]:
        """Return the sizes of their steps, and whether and of what there is a sum."""
        moved = self._predictor.moved
        sizes = [size for size, _ in self._predictor.past]
        return {"": sizes, "measures": moved is not None, "moved": bool(moved)}

    @override
    def columns(self, body: int | None) -> dict[str, Column]:
        if body is None:
            return {}
        past = self._predictor.past
        every = {str(i): increments for i, (_, increments) in enumerate(past)}
        if self._predictor.moved:
            every["moved"] = self._predictor.moved
        return {
            f"{key}{name}": Column(
                of_cells(_function(one.W, increments[self._number(one)])), _place(one)
            )
            for key, increments in every.items()
            for name, one in self._of[body].items()
        }

    @override
    def require(self, source: str, taken: Taken) -> None:
        """Take any state; those of another run are as good."""

    @override
    def restore(self, taken: Taken) -> None:
        numbers = taken.numbers

        def increments(key: str) -> list[NDArray[np.float64]]:
            found = [np.zeros(0)] * len(self._moved)
            for own, columns in zip(self._of, taken.columns, strict=False):
                for name, one in own.items():
                    found[self._number(one)] = _owned(_filled(one.W, columns[f"{key}{name}"]))
            return found

        self._predictor.clear(numbers["measures"])
        self._predictor.past = [(size, increments(str(i))) for i, size in enumerate(numbers[""])]
        if numbers["moved"]:
            self._predictor.moved = increments("moved")


def _place(one: Particles | CarriedField) -> Literal["points", "nodes"]:
    """Return where values live: at the points or the nodes of domains."""
    return one.place if isinstance(one, CarriedField) else "nodes"


class Past(Kept):
    """History of a run, and the moduli that its ghost penalty began with."""

    def __init__(self, history: History, reduced: ReducedSystem, comm: MPI.Comm) -> None:
        self._history, self._reduced, self._comm = history, reduced, comm

    @override
    def numbers(self) -> dict[str, Any]:
        history = self._history
        return {
            "moduli": self._reduced.unknowns.moduli,
            "steps": [
                [
                    *(s.load, s.iterations, s.residuals, s.displacement),
                    *(s.time, s.output, s.error, s.alternations, s.freed),
                    *(s.time_error, s.motion),
                ]
                for s in history.steps
            ],
            "taken_back": [vars(attempt) for attempt in history.taken_back],
            "cutbacks": history.cutbacks,
            "failed_iterations": history.failed_iterations,
            "losses": [vars(loss) for loss in history.losses],
            "stages": [[stage.name, stage.time] for stage in history.stages],
            "stopped": None if history.stopped is None else history.stopped.__reduce__()[1],
            "statistics": _average(self._comm, history.statistics),
        }

    @override
    def require(self, source: str, taken: Taken) -> None:
        pass

    @override
    def restore(self, taken: Taken) -> None:
        numbers, history = taken.numbers, self._history
        self._reduced.unknowns.moduli = numbers["moduli"]
        history.steps[:] = [Step(*entry) for entry in numbers["steps"]]
        history.cutbacks = numbers["cutbacks"]
        history.failed_iterations = numbers["failed_iterations"]
        history.taken_back[:] = [Attempt(**entries) for entries in numbers["taken_back"]]
        history.losses[:] = [Loss(**entries) for entries in numbers["losses"]]
        history.stages[:] = [Stage(*entries) for entries in numbers["stages"]]
        stopped = numbers["stopped"]
        history.stopped = None if stopped is None else ParticleOutsideError(*stopped)
        history.statistics.update(numbers["statistics"])


class Standing(Kept):
    """How far a problem is: the values of the last converged step on V, and the run.

    Args:
        progress: How far it is; after :meth:`restore`, how far it was.
        spaces: The background spaces.

    Attributes:
        progress: As given, or restored.
    """

    def __init__(self, progress: Progress, spaces: Sequence[fem.FunctionSpace]) -> None:
        self.progress, self._spaces = progress, spaces

    @override
    def numbers(self) -> dict[str, Any]:
        converged, run = self.progress.converged, self.progress.run
        return {
            "load": converged.load,
            "parameter": converged.parameter,
            "proportional": converged.proportional,
            "reactions": converged.reactions is not None,
            "supports": None
            if converged.supports is None
            else np.array(converged.supports).tolist(),
            "force": converged.force,
            "run": None if run is None else run.numbers(),
            "experience": self.progress.experience,
        }

    @override
    def on_background(self, number: int) -> dict[str, Column]:
        converged, run = self.progress.converged, self.progress.run
        totals = {
            "prescribed": converged.prescribed[number],
            "reactions": None if converged.reactions is None else converged.reactions[number],
            "base": None if run is None else run.base[number],
        }
        if converged.followed and converged.followed[number] is not None:
            totals["followed"] = converged.followed[number]
        return {
            name: Column(of_cells(_function(self._spaces[number], values)), "nodes")
            for name, values in totals.items()
        }

    @override
    def require(self, source: str, taken: Taken) -> None:
        pass

    @override
    def restore(self, taken: Taken) -> None:
        numbers = taken.numbers
        totals = {
            name: [
                _filled(V, columns[name])
                for V, columns in zip(self._spaces, taken.backgrounds, strict=True)
            ]
            for name in ("prescribed", "reactions", "base")
        }
        reactions = [_owned(f) for f in totals["reactions"]] if numbers["reactions"] else None
        supports = numbers["supports"]
        converged = Converged(
            numbers["load"],
            numbers["parameter"],
            [np.asarray(f.x.array) for f in totals["prescribed"]],
            reactions,
            numbers["proportional"],
            [
                _owned(_filled(V, columns["followed"])) if "followed" in columns else None
                for V, columns in zip(self._spaces, taken.backgrounds, strict=True)
            ],
            None if supports is None else [np.array(force) for force in supports],
            numbers["force"],
        )
        run = None
        if numbers["run"] is not None:
            base = [np.asarray(f.x.array) for f in totals["base"]]
            run = Run.of(numbers["run"], base, control_of)
        self.progress = Progress(converged, tuple(numbers["experience"]), run)


def _function(space: fem.FunctionSpace, owned: NDArray[np.float64] | None) -> fem.Function:
    """Return a Function with owned values, or none."""
    function = fem.Function(space)
    if owned is not None:
        function.x.array[: len(owned)] = owned
    function.x.scatter_forward()
    return function


def _filled(space: fem.FunctionSpace, values: NDArray[np.float64]) -> fem.Function:
    """Return a Function with the nodal values of each owned cell, ``(n, k, bs)``."""
    function = fem.Function(space)
    fill(function, values)
    return function


def _owned(function: fem.Function) -> NDArray[np.float64]:
    """Return a copy of the values that this rank owns; they come first."""
    dofmap = function.function_space.dofmap
    return np.array(function.x.array[: dofmap.index_map.size_local * dofmap.index_map_bs])


def _average(comm: MPI.Comm, statistics: Statistics) -> dict[str, float]:
    """Return counters, which all ranks share, and the mean seconds of the ranks."""
    every = comm.allgather(statistics.seconds)
    mean = {name: sum(s[name] for s in every) / comm.size for name in statistics.seconds}
    return {**statistics, **mean}
