# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Arguments of another kind than a call asks for, named where it breaks down on them."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import NoneType, UnionType
from typing import Any, Literal, TypeAliasType, Union, get_args, get_origin, get_type_hints

import numpy as np

from ..errors import MPMError

__all__ = ["explained"]

#: What Python and NumPy raise about an object that cannot do what is asked of it.
CONFUSED = (TypeError, ValueError, AttributeError, LookupError, ArithmeticError)
#: What is taken for a number or a truth.
NUMBERS: dict[Any, tuple[type, ...]] = {
    bool: (bool, np.bool_),
    int: (int, np.integer),
    float: (int, float, np.integer, np.floating),
}


@contextmanager
def explained(function: Callable[..., Any], args: Any, given: Any) -> Iterator[None]:
    """Raise an error that names an argument of another kind, where a call breaks down on it.

    Args:
        function: What is called, with annotations.
        args: Its arguments.
        given: Those by name.

    Raises:
        MPMError: One of them is not what the annotation says, and the block fails for it.
    """
    try:
        yield
    except CONFUSED as error:
        told = _misfit(function, args, given)
        if told is None:
            raise
        raise MPMError(told) from error


def _misfit(function: Callable[..., Any], args: Any, given: Any) -> str | None:
    """Return a sentence about the first argument that is not of its kind, if there is one."""
    signature = inspect.signature(function)
    try:
        arguments = signature.bind(*args, **given).arguments
        kinds = get_type_hints(function)
    except (TypeError, NameError):  # Python's own sentence says what is missing
        return None
    for name, value in arguments.items():
        parameter = signature.parameters[name]
        several = parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL)
        if name != "self" and not several and not _fits(value, kinds.get(name, Any)):
            called = function.__qualname__.removesuffix(".__init__").rpartition(".")[2]
            return f"{name} of {called}() must be {parameter.annotation}, not {value!r}."
    return None


def _fits(value: Any, kind: Any) -> bool:
    """Return whether a value is of a kind, as far as that can be seen."""
    if isinstance(kind, TypeAliasType):
        return _fits(value, kind.__value__)
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return any(_fits(value, part) for part in parts)
    if origin is Literal:
        return value in parts
    if kind in NUMBERS:
        whole = isinstance(value, NUMBERS[kind])
        return whole and (kind is bool or not isinstance(value, bool)) and value == value
    wanted = NoneType if kind is None else origin or kind
    if not isinstance(wanted, type) or wanted in (Any, object):
        return True
    if isinstance(value, str):  # which is a sequence, but never meant
        return wanted is str
    if isinstance(value, list | tuple) and len(parts) == 1:
        return issubclass(type(value), wanted) and all(_fits(entry, parts[0]) for entry in value)
    return isinstance(value, wanted)
