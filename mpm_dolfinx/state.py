# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The whole state of a problem, apart from how it is spread over ranks, and back again.

Cells are known by their input index, and nodal values are kept cell by cell: a cell's nodes have
the same order on any number of ranks, while nodes have no name of their own in DOLFINx.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem, mesh

from . import _compat
from .checkpoint import Snapshot, Table
from .errors import MPMError, ParticleOutsideError, agree
from .exchange import RowExchange
from .history import Loss, Statistics, Step
from .loading import Converged, go_back
from .particles import Particles
from .stepping import Run

if TYPE_CHECKING:
    from .problem import ParticleProblem

__all__ = ["adopt", "capture", "identity", "require_same"]

#: Relative difference up to which numbers of two problems count as the same.
SAME = 1e-12


def capture(problem: ParticleProblem, functions: Sequence[fem.Function] = ()) -> Snapshot:
    """Return the state at the last converged step (collective).

    Args:
        problem: The problem.
        functions: Functions on the bodies' meshes that are part of the user's state.

    Raises:
        MPMError: Functions that cannot be kept, or that are missing.
    """
    shares = _by_body(problem, functions)
    if functions and problem.identity is not None:
        raise MPMError(
            "Domains were split or the body rebased, so functions= on its new mesh could not be "
            "restored; save the state without them."
        )
    predictor = problem.reduced.predictor
    past = [] if predictor is None else predictor.past
    tables = []
    for number, (body, kept, own) in enumerate(
        zip(problem.bodies, problem.converged_state(), shares, strict=True)
    ):
        columns = body.converged_state()
        columns |= {f"history {name}": values for name, values in kept.items()}
        columns |= {f"function {f.name}": _of_cells(f.function_space, f.x.array) for f in own}
        for i, (_, increments) in enumerate(past):
            columns[f"past {i}"] = _of_cells(body.W, _with_ghosts(body.W, increments[number]))
        tables.append(Table(body.global_index, columns))
    run, converged = problem._run, problem._converged
    V = problem.bodies[0].V
    totals = {
        "prescribed": converged.prescribed,
        "reactions": converged.reactions,
        "base": None if run is None else run.base,
    }
    columns = {name: _of_cells(V, _with_ghosts(V, values)) for name, values in totals.items()}
    some = np.any([np.any(c != 0.0, axis=(1, 2)) for c in columns.values()], axis=0)
    tables.append(
        Table(
            _compat.input_cell_index(V.mesh)[some],
            {name: values[some] for name, values in columns.items()},
        )
    )
    history = problem.history
    numbers = {
        "identity": identity(problem),
        "cuts": [body.cuts.tolist() for body in problem.bodies],
        "load": converged.load,
        "parameter": converged.parameter,
        "reactions": converged.reactions is not None,
        "run": None if run is None else run.numbers(),
        "past": [size for size, _ in past],
        "experience": problem._newton.experience,
        "moduli": problem.reduced.moduli,
        "steps": [[s.load, s.iterations, s.residuals, s.displacement] for s in history.steps],
        "cutbacks": history.cutbacks,
        "failed_iterations": history.failed_iterations,
        "losses": [vars(loss) for loss in history.losses],
        "stopped": None if history.stopped is None else history.stopped.__reduce__()[1],
        "statistics": _average(problem._comm, history.statistics),
        "series": problem._output.written(),
    }
    return Snapshot(numbers, tables)


def adopt(
    problem: ParticleProblem,
    snapshot: Snapshot,
    functions: Sequence[fem.Function],
    resume: bool,
    source: str,
) -> None:
    """Put a problem into a state (collective); where that cannot be, it stays in its own.

    Args:
        problem: The problem.
        snapshot: The state, its rows on any ranks.
        functions: As they were given to :func:`capture`.
        resume: Whether a run that was interrupted is to go on.
        source: What to call the state in an error.

    Raises:
        MPMError: The state is that of another problem.
    """
    shares = _by_body(problem, functions)
    numbers, comm = snapshot.numbers, problem._comm
    require_same(problem, snapshot, source)
    taken = []
    for body, table in zip(problem.bodies, snapshot.tables, strict=False):
        exchange = RowExchange(comm, table.rows, body.global_index)
        with agree(comm):
            if not exchange.found.all():
                lost = body.global_index[~exchange.found]
                raise MPMError(f"{source} does not know {{particles}}.", lost)
        taken.append({name: exchange(values) for name, values in table.columns.items()})
    V = problem.bodies[0].V
    table = snapshot.tables[-1]
    exchange = RowExchange(comm, table.rows, _compat.input_cell_index(V.mesh))
    totals = {name: _nodal(V, exchange(values)) for name, values in table.columns.items()}
    histories = [
        {name.split(" ", 1)[1]: v for name, v in columns.items() if name.startswith("history ")}
        for columns in taken
    ]
    with agree(comm):
        for columns, own, kept, present in zip(
            taken, shares, histories, problem.converged_state(), strict=True
        ):
            _require_columns(source, columns, own, kept, present)

    for body, columns, own in zip(problem.bodies, taken, shares, strict=True):
        body.set_converged_state(columns)
        for function in own:
            _fill(function, columns[f"function {function.name}"])
    problem.set_converged_state(histories)
    reactions = totals["reactions"][: _owned(V)].copy() if numbers["reactions"] else None
    problem._converged = Converged(
        numbers["load"], numbers["parameter"], totals["prescribed"], reactions
    )
    if problem.reduced.predictor is not None:
        problem.reduced.predictor.past = [
            (
                size,
                [
                    _nodal(body.W, columns[f"past {i}"])[: _owned(body.W)].copy()
                    for body, columns in zip(problem.bodies, taken, strict=True)
                ],
            )
            for i, size in enumerate(numbers["past"])
        ]
    problem.reduced.moduli = numbers["moduli"]
    problem._newton.experience = tuple(numbers["experience"])
    problem._run = None
    problem._resume = False
    if numbers["run"] is not None and resume:
        problem._run = Run.of(numbers["run"], totals["base"])
        problem._resume = True
    history = problem.history
    history.steps[:] = [Step(*entries) for entries in numbers["steps"]]
    history.cutbacks = numbers["cutbacks"]
    history.failed_iterations = numbers["failed_iterations"]
    history.losses[:] = [Loss(**entries) for entries in numbers["losses"]]
    stopped = numbers["stopped"]
    history.stopped = None if stopped is None else ParticleOutsideError(*stopped)
    history.statistics.update(numbers["statistics"])
    problem.reduced.forget()
    go_back(problem)


def require_same(problem: ParticleProblem, snapshot: Snapshot, source: str) -> None:
    """Raise an error unless a state is one of this problem (collective)."""
    known = snapshot.numbers["identity"]
    with agree(problem._comm):
        for name, present in identity(problem).items():
            if not _same(known.get(name), present):
                raise MPMError(f"{source} is of another problem: {name} is not the same.")


# -- Values cell by cell -----------------------------------------------------------------


def _of_cells(space: fem.FunctionSpace, array: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return nodal values of each owned cell, shape ``(n, k, bs)``."""
    cells = space.mesh.topology.index_map(space.mesh.topology.dim).size_local
    return np.asarray(array.reshape(-1, space.dofmap.bs)[space.dofmap.list[:cells]])


def _fill(function: fem.Function, values: NDArray[np.float64]) -> None:
    space = function.function_space
    function.x.array.reshape(-1, space.dofmap.bs)[space.dofmap.list[: len(values)]] = values
    function.x.scatter_forward()


def _nodal(space: fem.FunctionSpace, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return values of the cells ``(n, k, bs)`` on all local dofs."""
    function = fem.Function(space)
    _fill(function, values)
    return np.asarray(function.x.array)


def _owned(space: fem.FunctionSpace) -> int:
    """Return how many dofs this rank owns; they come first."""
    return int(space.dofmap.index_map.size_local * space.dofmap.index_map_bs)


def _with_ghosts(
    space: fem.FunctionSpace, values: NDArray[np.float64] | None
) -> NDArray[np.float64]:
    """Return owned values, or none, on all local dofs."""
    function = fem.Function(space)
    if values is not None:
        function.x.array[: len(values)] = values
    function.x.scatter_forward()
    return np.asarray(function.x.array)


def _by_body(
    problem: ParticleProblem, functions: Sequence[fem.Function]
) -> list[list[fem.Function]]:
    """Return the Functions on each body's mesh, if nothing is wrong with them."""
    known = isinstance(functions, list | tuple) and all(
        isinstance(f, fem.Function)
        and any(f.function_space.mesh is body.mesh for body in problem.bodies)
        for f in functions
    )
    if not known:
        raise MPMError("functions must be a list of dolfinx.fem.Function on the body mesh.")
    shares = [
        [f for f in functions if f.function_space.mesh is body.mesh] for body in problem.bodies
    ]
    for own in shares:
        names = [f.name for f in own]
        if len(set(names)) < len(names):
            raise MPMError(
                f"functions are known by their names, which must differ, not {', '.join(names)}."
            )
    missing = problem.data_at_points().difference(functions)
    if missing:
        names = sorted(f.name for f in missing)
        raise MPMError(
            f"The residual holds data at quadrature points ({', '.join(names)}); give these "
            "Functions as functions=[...], so that they are saved and restored too."
        )
    return shares


def _require_columns(
    source: str,
    columns: dict[str, NDArray[Any]],
    functions: list[fem.Function],
    history: dict[str, NDArray[Any]],
    present: dict[str, NDArray[Any]],
) -> None:
    kept = {name.split(" ", 1)[1] for name in columns if name.startswith("function ")}
    given = {f.name for f in functions}
    if kept != given:
        raise MPMError(
            f"{source} holds the functions {sorted(kept)}, but functions= names {sorted(given)}."
        )
    for function in functions:
        shape = columns[f"function {function.name}"].shape[1:]
        space = function.function_space
        if shape != (space.dofmap.list.shape[1], space.dofmap.bs):
            raise MPMError(f"{source} holds the function {function.name} in another space.")
    for name, values in present.items():
        if name not in history or history[name].shape != values.shape:
            raise MPMError(f"{source} has no history {name!r} of the kind that this problem has.")
    if history and not present:
        raise MPMError(f"{source} has a history of stress, which this problem has no use for.")


# -- What tells problems apart -----------------------------------------------------------


def identity(problem: ParticleProblem) -> dict[str, Any]:
    """Return what two problems must share for a state of one to be one of the other.

    It is that of the problem before domains were split (collective).
    """
    if problem.identity is not None:
        return problem.identity
    V = problem.bodies[0].V
    element = V.ufl_element()
    found: dict[str, Any] = {
        "the number of bodies": len(problem.bodies),
        "the background mesh": _mesh(V.mesh),
        "the background space": [element.family_name, element.degree],
    }
    for i, (body, law) in enumerate(zip(problem.bodies, problem.laws(), strict=True)):
        of = f" of body {i}" if len(problem.bodies) > 1 else ""
        found[f"the body mesh{of}"] = _mesh(body.mesh)
        found[f"the particles' method{of}"] = body.options()
        found[f"the material{of}"] = [
            [name, {key: _parameter(body, value) for key, value in parameters.items()}]
            for name, parameters in law
        ]
    return found


def _mesh(domain: mesh.Mesh) -> list[Any]:
    """Return kind, number of cells, size and a weighted mean of the positions of all cells."""
    cells = domain.topology.index_map(domain.topology.dim)
    index = _compat.input_cell_index(domain)
    corners = domain.geometry.x[_compat.geometry_dofmap(domain)[: len(index)]]
    size = domain.comm.allreduce(float(np.abs(corners).max(initial=0.0)), MPI.MAX)
    places = 1.0 + corners.reshape(len(index), 3 * corners.shape[1]) / (size or 1.0)
    mean = _weighted(domain.comm, index, places)
    return [domain.basix_cell().name, cells.size_global, size, *mean.tolist()]


def _weighted(
    comm: MPI.Comm, index: NDArray[np.int64], values: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return a mean of rows with weights that depend on their index, the same on all ranks."""
    weights = 2.0 + np.cos(index.astype(np.float64))
    total = comm.allreduce(np.einsum("n,ni->i", weights, values))
    return np.asarray(total / max(comm.allreduce(len(index)), 1))


def _parameter(body: Particles, value: Any) -> Any:
    """Return a parameter of a material; of values at points their size and mean."""
    if not isinstance(value, tuple):
        return float(value) if isinstance(value, float | int | np.number) else str(value)
    index, values = value
    size = body.mesh.comm.allreduce(float(np.abs(values).max(initial=0.0)), MPI.MAX)
    places = 1.0 + values[:, None] / (size or 1.0)
    return [size, *_weighted(body.mesh.comm, index, places).tolist()]


def _same(one: Any, two: Any) -> bool:
    if isinstance(one, dict) and isinstance(two, dict):
        return one.keys() == two.keys() and all(_same(one[k], two[k]) for k in one)
    if isinstance(one, list | tuple) and isinstance(two, list | tuple):
        return len(one) == len(two) and all(map(_same, one, two))
    if isinstance(one, float) and isinstance(two, float):
        return math.isclose(one, two, rel_tol=SAME) or (math.isnan(one) and math.isnan(two))
    return bool(one == two)


def _average(comm: MPI.Comm, statistics: Statistics) -> dict[str, float]:
    """Return counters, which all ranks share, and the mean seconds of the ranks."""
    every = comm.allgather(statistics.seconds)
    mean = {name: sum(s[name] for s in every) / comm.size for name in statistics.seconds}
    return {**statistics, **mean}
