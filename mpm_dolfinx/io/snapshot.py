# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The state of a problem as tables, whatever the ranks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..errors import MPMError, agree
from ..meshes.cells import input_cell_index
from ..meshes.remesh import PLACES, Column
from ..parallel.boundary import Hooked, collective
from ..parallel.exchange import RowExchange
from ..parallel.given import require_same
from ..particles.particles import Particles
from .checkpoint import Snapshot, Table

__all__ = [
    "Kept",
    "Taken",
    "adopt",
    "belongs",
    "capture",
    "fill",
    "merged",
    "of_cells",
    "require_key",
    "spaces_of",
]


class Kept(Hooked, hooks=True):
    """Something that goes with a problem: split, moved to other ranks, saved and restored.

    A heir says what it is and where it lives, and takes it again; give it to
    :meth:`Problem.keep`. All calls are collective.

    Attributes:
        key: Name, which is the prefix of what is its own in a checkpoint.
    """

    key: str = ""

    def numbers(self) -> dict[str, Any]:
        """Return values that are the same on all ranks, in types that JSON has, by name."""
        return {}

    def columns(self, body: int | None) -> dict[str, Column]:
        """Return arrays that are spread over the ranks, at the last converged step, by name.

        Args:
            body: Number of the body, or ``None``: on the cells of the background.
        """
        return {}

    def on_background(self, number: int) -> dict[str, Column]:
        """Return arrays over the cells of one of several backgrounds, by name.

        Args:
            number: Its number, 0 for that of the first body: what :meth:`columns` returns for
                ``None``.
        """
        return self.columns(None) if number == 0 else {}

    def require(self, source: str, taken: Taken) -> None:
        """Raise an error unless it can take what a state holds.

        Args:
            source: What to call the state.
            taken: What it holds under this key.

        Raises:
            MPMError: There are other names, or values of other shapes, than are kept.
        """
        for number, columns in enumerate(taken.columns):
            body = number if number < len(taken.columns) - 1 else None
            present = {name: c.values.shape[1:] for name, c in self.columns(body).items()}
            if {name: values.shape[1:] for name, values in columns.items()} != present:
                raise MPMError(
                    f"{source} holds {sorted(columns)} under the key {self.key!r}, where this "
                    f"problem keeps {sorted(present)}, or values of other shapes."
                )

    def restore(self, taken: Taken) -> None:
        """Take what was once returned, on the meshes and ranks of now.

        ``roll_back`` of the problem is called after it.

        Args:
            taken: The numbers, and the values of the cells that this rank owns now.
        """
        raise NotImplementedError


class Taken(NamedTuple):
    """Part of a state that belongs to one kept object.

    Attributes:
        numbers: Numbers by name.
        columns: For each body, and at last for the background, values ``(n, ...)`` by name.
        backgrounds: For each background, where there are several.
    """

    numbers: dict[str, Any]
    columns: list[dict[str, NDArray[Any]]]
    backgrounds: list[dict[str, NDArray[Any]]]


def spaces_of(bodies: Sequence[Particles]) -> list[fem.FunctionSpace]:
    """Return the spaces of bodies' unknowns, in the order of the system's fields.

    Background spaces come in the order of their first bodies, each before the spaces W of those of
    its bodies that may have free nodes.
    """
    spaces: list[fem.FunctionSpace] = []
    for body in bodies:
        if any(body.V is V for V in spaces):
            continue
        group = [one for one in bodies if one.V is body.V]
        spaces += [body.V, *(one.W for one in group if one.free_nodes is not None)]
    return spaces


def _cells_of(V: fem.FunctionSpace, bodies: Sequence[Particles]) -> NDArray[np.int64]:
    """Return the input indices of the cells of a space, as they are on any mesh of a body."""
    for body in bodies:
        if V.mesh is body.mesh:
            return body.global_index
    return input_cell_index(V.mesh)


def capture(
    things: Sequence[Kept],
    bodies: Sequence[Particles],
    spaces: Sequence[fem.FunctionSpace] | None = None,
) -> Snapshot:
    """Return the state at the last converged step (collective).

    Args:
        things: What is kept.
        bodies: The bodies, on whose cells it lives.
        spaces: All background spaces; ``None``: those of the bodies.

    Raises:
        MPMError: Something does not say where it lives, or has not one row for each cell.
    """
    comm = bodies[0].V.mesh.comm
    tables = []
    for number, body in enumerate(bodies):
        columns = _columns(things, (number, None), body.num_local, comm)
        values = {name: column.values for name, column in columns.items()}
        tables.append(Table(body.global_index, values, {name: c.at for name, c in columns.items()}))
    for number, V in enumerate(spaces_of(bodies) if spaces is None else spaces):
        index = _cells_of(V, bodies)
        columns = _columns(things, (None, number), len(index), comm)
        some = np.zeros(len(index), dtype=bool)
        for column in columns.values():
            some |= (column.values != 0).reshape(len(index), -1).any(axis=1)
        tables.append(Table(index[some], {name: c.values[some] for name, c in columns.items()}))
    numbers: dict[str, Any] = {}
    for thing in things:
        its = {_name(thing.key, name): value for name, value in thing.numbers().items()}
        if thing.key:
            require_same(comm, **its)
        numbers |= its
    return Snapshot(numbers, tables)


def adopt(
    things: Sequence[Kept],
    bodies: Sequence[Particles],
    snapshot: Snapshot,
    source: str,
    spaces: Sequence[fem.FunctionSpace] | None = None,
) -> None:
    """Let all that is kept take what a state holds for it (collective).

    Where that cannot be, all stays as it is.

    Args:
        things: What is kept, in the order in which it is restored.
        bodies: The bodies, on whose cells it lives.
        snapshot: The state, its rows on any ranks.
        source: What to call the state in an error.
        spaces: All background spaces; ``None``: those of the bodies.

    Raises:
        MPMError: The state is that of another problem.
    """
    comm = bodies[0].V.mesh.comm
    found = []
    for body, table in zip(bodies, snapshot.tables, strict=False):
        exchange = RowExchange(comm, table.rows, body.global_index)
        with agree(comm):
            if not exchange.found.all():
                lost = body.global_index[~exchange.found]
                raise MPMError(f"{source} does not know {{particles}}.", lost)
        found.append({name: exchange(values) for name, values in table.columns.items()})
    spaces = spaces_of(bodies) if spaces is None else spaces
    backgrounds = snapshot.tables[len(bodies) :]
    if len(backgrounds) != len(spaces):
        raise MPMError(
            f"{source} is of another problem: it has {len(backgrounds)} background spaces, of "
            f"displacements and other fields, and this problem {len(spaces)}."
        )
    for V, table in zip(spaces, backgrounds, strict=True):
        exchange = RowExchange(comm, table.rows, _cells_of(V, bodies))
        found.append({name: exchange(values) for name, values in table.columns.items()})
    keys = [thing.key for thing in things]
    taken = [
        Taken(
            _of_key(thing.key, keys, snapshot.numbers),
            [_of_key(thing.key, keys, columns) for columns in found[: len(bodies) + 1]],
            [_of_key(thing.key, keys, columns) for columns in found[len(bodies) :]],
        )
        for thing in things
    ]
    for thing, its in zip(things, taken, strict=True):
        with agree(comm):
            thing.require(source, its)
    for thing, its in zip(things, taken, strict=True):
        thing.restore(its)


def merged(
    before: Snapshot,
    now: Snapshot,
    bodies: tuple[int, int],
    backgrounds: Sequence[int | None],
    renewed: Callable[[int | None, str], bool],
) -> Snapshot:
    """Return a state of before, with what is new or renewed from one of now, on the same meshes.

    Args:
        before: The state of before.
        now: The state of now, which may have more bodies and backgrounds.
        bodies: Number of the bodies before and now.
        backgrounds: For each background now its number before, ``None`` where it is new.
        renewed: Returns whether something that was there before is new too, or no more, by the
            number of its body (``None``: a number, or on a background) and its name.
    """
    old, new = bodies
    numbers = now.numbers | {n: v for n, v in before.numbers.items() if not renewed(None, n)}
    tables = []
    for number, (earlier, present) in enumerate(zip(before.tables[:old], now.tables, strict=False)):
        columns = {n: v for n, v in earlier.columns.items() if not renewed(number, n)}
        tables.append(Table(present.rows, present.columns | columns))
    tables += now.tables[old:new]
    for number, known in enumerate(backgrounds):
        present = now.tables[new + number]
        if known is not None:
            earlier = before.tables[old + known]
            columns = {n: v for n, v in earlier.columns.items() if not renewed(None, n)}
            present = _over(Table(earlier.rows, columns), present)
        tables.append(present)
    return Snapshot(numbers, tables)


def _over(one: Table, other: Table) -> Table:
    """Return the columns of two tables of some rows each, those of the first where both have them.

    What a table does not have a row for is zero.
    """
    rows = np.union1d(one.rows, other.rows)
    columns = {}
    for table in (other, one):
        places = np.searchsorted(rows, table.rows)
        for name, values in table.columns.items():
            columns[name] = np.zeros((len(rows), *values.shape[1:]), values.dtype)
            columns[name][places] = values
    return Table(rows, columns)


def require_key(key: str, things: Sequence[Kept], bodies: int) -> None:
    """Raise an error unless a key is a name of its own among those of what is kept (collective).

    Args:
        key: The key.
        things: What is kept already.
        bodies: Number of the bodies.
    """
    taken = {"identity", "series", "keys", *(thing.key for thing in things if thing.key)}
    for thing in things:
        names = list(thing.numbers())
        for body in (*range(bodies), None):
            names += thing.columns(body)
        taken |= {_name(thing.key, name).split(" ")[0] for name in names}
    if not key or " " in key or key in taken:
        raise MPMError(
            f"{key!r} cannot be the key of something that is kept: it must be one word, and none "
            f"of {', '.join(sorted(taken))}."
        )


def belongs(name: str, keys: Sequence[str]) -> bool:
    """Return whether something of a state has one of some keys."""
    return f"{name} ".startswith(tuple(f"{key} " for key in keys if key))


def _name(key: str, name: str) -> str:
    """Return the name of a kept value in a state."""
    return f"{key} {name}".strip()


def _of_key[Value](key: str, keys: Sequence[str], state: Mapping[str, Value]) -> dict[str, Value]:
    """Return the values of a state under a key, by their own names; under none, those of no key."""
    if not key:
        return {name: value for name, value in state.items() if not belongs(name, keys)}
    whole = len(key) + 1
    return {name[whole:]: value for name, value in state.items() if belongs(name, [key])}


def _columns(
    things: Sequence[Kept], place: tuple[int | None, int | None], rows: int, comm: MPI.Comm
) -> dict[str, Column]:
    """Return all that is kept on the cells of a mesh, of a body or a background (collective)."""
    body, background = place
    columns: dict[str, Column] = {}
    keys = [thing.key for thing in things]
    for thing in things:
        mine = thing.columns(body) if background is None else thing.on_background(background)
        with agree(comm):
            for name, column in mine.items():
                if not thing.key and belongs(name, keys):
                    raise MPMError(
                        f"{name!r} belongs to the body, so {name.split(' ')[0]!r} cannot be the "
                        "key of something that is kept."
                    )
                if not isinstance(column, Column) or column.at not in PLACES:
                    raise MPMError(
                        f"{_name(thing.key, name)!r} is kept but does not say where it lives; "
                        f"return a Column(values, at) with at among {', '.join(PLACES)}."
                    )
                if column.values.shape[:1] != (rows,):
                    raise MPMError(
                        f"{_name(thing.key, name)!r} has the shape {column.values.shape}, but "
                        f"needs one row for each of the {rows} cells that the rank owns."
                    )
        columns |= {_name(thing.key, name): column for name, column in mine.items()}
    return columns


def of_cells(function: fem.Function) -> NDArray[np.float64]:
    """Return nodal values of a Function in each owned cell, shape ``(n, k, bs)``."""
    space = function.function_space
    cells = space.mesh.topology.index_map(space.mesh.topology.dim).size_local
    values = function.x.array.reshape(-1, space.dofmap.bs)
    return np.asarray(values[space.dofmap.list[:cells]])


@collective("values")
def fill(function: fem.Function, values: NDArray[np.float64]) -> None:
    """Give a Function the nodal values of each owned cell, ``(n, k, bs)`` (collective)."""
    space = function.function_space
    function.x.array.reshape(-1, space.dofmap.bs)[space.dofmap.list[: len(values)]] = values
    function.x.scatter_forward()
