# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Arguments of another kind than a call asks for.

Truths are looked at before a call, as Python takes anything for one; all else where the call breaks
down on it.
"""

from __future__ import annotations

import difflib
import inspect
import re
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from types import NoneType, UnionType
from typing import Any, Literal, TypeAliasType, Union, get_args, get_origin, get_type_hints

import numpy as np

from ..errors import MPMError

__all__ = ["explained", "explaining", "require_truths"]

#: What Python and NumPy raise about an object that cannot do what is asked of it.
CONFUSED = (
    TypeError,
    ValueError,
    AttributeError,
    LookupError,
    ArithmeticError,
    NotImplementedError,  # UFL of no length
)
#: What is taken for a number or a truth.
NUMBERS: dict[Any, tuple[type, ...]] = {
    bool: (bool, np.bool_),
    int: (int, np.integer),
    float: (int, float, np.integer, np.floating),
}
#: What Python says of arguments that do not fit: by a name that is not known, and too many.
STRANGE = re.compile(r"got an unexpected keyword argument '(\w+)'")
TOO_MANY = re.compile(r"takes (?:from \d+ to )?(\d+) positional arguments? but (\d+)")
#: Parameters that stand for several arguments.
SEVERAL = inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL
#: What truths are called in a message.
TRUTHS: dict[Any, str] = {bool: "True or False", bool | None: "True, False or None"}


@contextmanager
def explained(function: Callable[..., Any], args: Any, given: Any) -> Iterator[None]:
    """Raise an error that names an argument of another kind, where a call breaks down on it.

    Args:
        function: What is called, with annotations.
        args: Its arguments.
        given: Those by name.

    Raises:
        MPMError: One of them is not what the annotation says, and the block fails for it.
        TypeError: One has a name that the call does not know, or there are too many without one.
    """
    try:
        yield
    except CONFUSED as error:
        if (told := _misfit(function, args, given)) is not None:
            raise MPMError(told) from error
        if (told := _unknown(error, function, args, given)) is not None:
            raise TypeError(told) from None
        raise


def explaining[T](kind: type[T]) -> type[T]:
    """Return a class, whose constructor now explains what does not fit."""
    made: Callable[..., None] = vars(kind)["__init__"]

    @wraps(made)
    def make(*args: Any, **given: Any) -> None:
        with explained(made, args, given):
            made(*args, **given)

    setattr(kind, "__init__", make)
    return kind


def require_truths(function: Callable[..., Any], args: Any, given: Any) -> None:
    """Raise an error unless arguments are truths that are to be.

    Args:
        function: What is called, with annotations.
        args: Its arguments.
        given: Those by name.
    """
    if (told := _misfit(function, args, given, among=TRUTHS)) is not None:
        raise MPMError(told)


def _misfit(
    function: Callable[..., Any], args: Any, given: Any, among: Collection[Any] | None = None
) -> str | None:
    """Return a sentence about the first argument that is not of its kind, if there is one.

    Args:
        function: What is called.
        args: Its arguments.
        given: Those by name.
        among: Annotations of those that count; ``None``: of any.
    """
    kinds = _kinds_of(function)
    if among is not None:
        kinds = {name: kind for name, kind in kinds.items() if kind in among}
    if not kinds:
        return None
    signature = inspect.signature(function)
    try:
        arguments = signature.bind(*args, **given).arguments
    except TypeError:  # Python's own sentence says what is missing
        return None
    for name, kind in kinds.items():
        if name not in arguments or _fits(arguments[name], kind):
            continue
        called = function.__qualname__.removesuffix(".__init__").rpartition(".")[2]
        wanted = TRUTHS.get(kind, signature.parameters[name].annotation)
        return f"{name} of {called}() must be {wanted}, not {arguments[name]!r}."
    return None


def _unknown(error: Exception, function: Callable[..., Any], args: Any, given: Any) -> str | None:
    """Return Python's sentence about arguments that a call does not take.

    It has the user's class, where Python's has the base that came to it at last, and what is known.
    """
    strange, many = STRANGE.search(str(error)), TOO_MANY.search(str(error))
    if not isinstance(error, TypeError) or (many is None and strange is None):
        return None
    if strange is not None and strange[1] not in given:
        return None
    if many is not None and int(many[2]) != len(args):
        return None
    called, takers = function.__qualname__, [function]
    if "." in called:
        kind = type(args[0])
        called = f"{kind.__name__}.{function.__name__}".removesuffix(".__init__")
        if function.__name__ == "__init__":
            takers = [vars(k)["__init__"] for k in kind.__mro__ if "__init__" in vars(k)]
    names: dict[str, None] = {}
    for taker in takers:
        parameters = inspect.signature(taker).parameters.values()
        names |= {p.name: None for p in parameters if p.kind not in SEVERAL and p.name != "self"}
        if all(p.kind is not inspect.Parameter.VAR_KEYWORD for p in parameters):
            break
    known = f"it has {', '.join(names)}."
    if strange is None:
        return f"{called}() got too many arguments without a name; {known}"
    near = difflib.get_close_matches(strange[1], names, 1)
    hint = f"did you mean {near[0]!r}?" if near else known
    return f"{called}() got an unexpected keyword argument {strange[1]!r}; {hint}"


@cache
def _kinds_of(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the annotations of a function's arguments by their names, as far as they are known."""
    try:
        kinds = get_type_hints(function)
    except (TypeError, NameError):
        return {}
    parameters = inspect.signature(function).parameters.values()
    return {p.name: kinds[p.name] for p in parameters if p.name in kinds and p.kind not in SEVERAL}


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
