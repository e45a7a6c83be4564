# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Input of a constructor or a run, compared over the ranks by a hash.

Each rank runs the user's program, and what differs between them (a number of steps, a modulus, one
condition more) would let one wait for ever in a call that another never reaches.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

import ufl
from dolfinx import fem, mesh
from ufl.corealg.traversal import traverse_unique_terminals

from ..errors import MPMError, gathered, met

__all__ = [
    "ON_A_MESH",
    "as_positive",
    "is_number",
    "is_ours",
    "not_a_value",
    "one_line",
    "options_of",
    "require_same",
    "require_truth",
    "require_whole",
]

#: What a value may be besides numbers, where a mesh is known.
ON_A_MESH = "a Constant, a Function or other UFL on the body mesh, or a function of coordinates"
#: What describes a law besides its parameters.
KINDS = ("symmetric", "kinematics", "inelastic")


def is_ours(module: str) -> bool:
    """Return whether a module, by its name, is one of this package."""
    return module.partition(".")[0] == __name__.partition(".")[0]


def require_same(comm: MPI.Comm, /, **given: Any) -> None:
    """Raise an error unless all ranks were given the same (collective).

    Arrays of a material's parameters, or of more than two dimensions, Functions and tags are a
    rank's own part of what is the same for all, so only their kind is compared.

    Args:
        comm: The ranks.
        **given: Values by the names that a user knows them by.

    Raises:
        MPMError: Something differs; it names what, and the values of two ranks.
    """
    if comm.size == 1:
        return
    parts = [part for name, value in given.items() for part in _parts(name, value)]
    digest = hashlib.sha256(repr(parts).encode()).digest()
    same, _ = met(comm, int.from_bytes(digest[:7]))
    if same:
        return
    every = [dict(each) for each in gathered(comm, parts)]
    names = {name: None for each in every for name in each}  # in the order in which they stand
    for name in names:
        values = [each.get(name, "nothing") for each in every]
        rank = next((r for r, value in enumerate(values) if value != values[0]), None)
        if rank is not None:
            raise MPMError(
                f"{name} differs between the ranks: {values[0]} on rank 0, {values[rank]} on rank "
                f"{rank}; give the same on all."
            )


def require_truth(name: str, value: Any) -> None:
    """Raise an error unless an option is a truth.

    Args:
        name: What it is called in a message.
        value: What is given.
    """
    if not isinstance(value, bool | np.bool_):
        raise MPMError(f"{name} must be True or False, not {value!r}.")


def require_whole(name: str, value: Any, most: int | None = None, least: int = 0) -> None:
    """Raise an error unless a value is a whole number, such as a degree or a count.

    Args:
        name: What it is called in a message.
        value: What is given.
        most: The highest; ``None``: there is none.
        least: The lowest.
    """
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or value < least or (most is not None and value > most):
        how = f"from {least} {'on' if most is None else f'to {most}'}"
        raise MPMError(f"{name} must be a whole number {how}, not {value!r}.")


def is_number(value: Any) -> bool:
    """Return whether a value is a real number, and no truth."""
    return isinstance(value, float | int | np.integer | np.floating) and not isinstance(value, bool)


def as_positive(value: Any, name: str) -> float:
    """Return a positive number.

    Raises:
        MPMError: It is something else.
    """
    if not is_number(value) or not 0.0 < value < np.inf:
        raise MPMError(f"{name} must be a positive number, not {value!r}.")
    return float(value)


def one_line(value: Any) -> str:
    """Return a value in words, on one line."""
    return " ".join(repr(value).split())


def not_a_value(
    name: str, value: Any, shape: tuple[int, ...] = (), kinds: str = ON_A_MESH
) -> MPMError:
    """Return the error that something is none of the kinds of values that are taken.

    Args:
        name: What it is called.
        value: What was given.
        shape: The shape that it must have.
        kinds: What it may be besides numbers.
    """
    numbers = f"{' x '.join(map(str, shape))} finite numbers" if shape else "a finite number"
    return MPMError(f"{name} must be {numbers}, {kinds}, not {one_line(value):.80}.")


def options_of(law: Any) -> dict[str, Any]:
    """Return the words, truths and laws that a law was given besides its parameters, by name."""
    kinds = str | bool | np.bool_
    return {
        name: value
        for name, value in sorted(vars(law).items())
        if isinstance(value, kinds) or hasattr(value, "initial_state")
    }


def _parts(name: str, value: Any) -> Iterator[tuple[str, str]]:
    """Yield the parts of a value, each with a name and a description."""
    if isinstance(value, Mapping):
        yield f"The number of {name}", str(len(value))
        for key in sorted(value, key=str):
            yield from _parts(f"{key} of {name}", value[key])
    elif isinstance(value, list | tuple) and not _numbers(value):
        yield f"The number of {name}", str(len(value))
        for place, entry in enumerate(value):
            yield from _parts(f"{name}[{place}]", entry)
    elif hasattr(value, "initial_state"):
        kinds = ", ".join(f"{kind}={getattr(value, kind, None)}" for kind in KINDS)
        yield name, f"{type(value).__name__} ({kinds})"
        for key, option in options_of(value).items():
            yield from _parts(f"{key} of {type(value).__name__}", option)
        for key, parameter in sorted(getattr(value, "parameters", {}).items()):
            own = isinstance(parameter, np.ndarray) and parameter.ndim > 0
            yield from [(key, "an array")] if own else _parts(key, parameter)
    elif hasattr(value, "told"):
        yield from _parts(name, value.told)
    elif is_dataclass(value) and is_ours(type(value).__module__):
        yield name, type(value).__name__
        for field in fields(value):
            yield from _parts(f"{field.name} of {name}", getattr(value, field.name))
    elif isinstance(value, np.ndarray) and value.ndim > 2:
        yield name, "an array"
    elif isinstance(value, fem.DirichletBC):
        held: Any = value.g
        number = getattr(held, "value", None)
        yield name, "a Function" if number is None else _shown(np.asarray(number))
    elif isinstance(value, ufl.Form):
        yield name, f"a form ({hashlib.sha256(value.signature().encode()).hexdigest()[:8]})"
        yield from _constants(name, value.constants())
    elif isinstance(value, fem.Constant):
        yield name, _shown(np.asarray(value.value))
    elif isinstance(value, fem.Function):
        yield name, f"a Function of {value.function_space.ufl_element()}"
    elif isinstance(value, ufl.core.expr.Expr):
        terminals = sorted(traverse_unique_terminals(value), key=_order)
        numbers = [float(t) for t in terminals if isinstance(t, ufl.constantvalue.RealValue)]
        told = f"UFL of shape {value.ufl_shape} with {len(terminals)} terminals"
        yield name, f"{told}, of numbers {_shown(sorted(numbers))}" if numbers else told
        yield from _constants(name, [t for t in terminals if isinstance(t, fem.Constant)])
    elif isinstance(value, fem.FunctionSpace):
        yield name, f"a space of {value.ufl_element()}"
    elif isinstance(value, mesh.MeshTags):
        yield name, f"tags of dimension {value.dim}"
    elif isinstance(value, str | Path):
        yield name, repr(str(value))
    elif value is None or _numbers(value):
        yield name, _shown(value)
    else:
        yield name, "a function" if callable(value) else type(value).__name__


def _constants(name: str, constants: Any) -> Iterator[tuple[str, str]]:
    for place, constant in enumerate(constants):
        yield f"Constant {place} of {name}", _shown(np.asarray(constant.value))


def _order(terminal: Any) -> tuple[str, int]:
    return type(terminal).__name__, terminal.count() if hasattr(terminal, "count") else 0


def _numbers(value: Any) -> bool:
    """Return whether a value is a number, or an array, list or tuple of numbers."""
    number = int | float | np.number | np.bool_
    if isinstance(value, list | tuple):
        return len(value) > 0 and all(isinstance(entry, number) for entry in value)
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "biuf"
    return isinstance(value, number)


def _shown(value: Any) -> str:
    """Return numbers as text that differs where they do."""
    if value is None or isinstance(value, bool | np.bool_):
        return str(value)
    array = np.asarray(value)
    shown = str(array.tolist() if array.dtype.kind == "b" else (array + 0.0).tolist())
    if len(shown) <= 60:  # what is longer is told by its hash
        return shown
    return f"an array of shape {array.shape} ({hashlib.sha256(shown.encode()).hexdigest()[:8]})"
