# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The boundary between this package and a user's code, which all ranks cross together.

Inwards, :func:`collective` compares what a call is given. Outwards, a :class:`Hooked` class lets
ranks agree after each of its methods that a user has written. Either way an error on one rank ends
the call on all of them. What this package calls of its own is not looked at, nor anything on a
single rank, nor what users call of their own.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from types import CodeType
from typing import Any, cast

from mpi4py import MPI

from ..errors import MPMError, agree, called_last, forget
from .given import is_ours, require_same
from .kinds import explained, require_truths

__all__ = [
    "Hooked",
    "Owned",
    "asked",
    "by_itself",
    "collective",
    "hooks_of",
    "is_collective",
    "of_user",
]

#: What tells the ranks of an object, one after the other.
KNOWN_BY = ("comm", "mesh", "V", "function_space", "bodies", "particles", "problem")
_COLLECTIVE, _OWN, _BY_ITSELF = "__collective__", "__own__", "__by_itself__"
_HOOKS = "__hooks__"

#: The ranks that are within this package together, innermost last; ``None``: in a user's code.
_within: list[MPI.Comm | None] = []


@contextmanager
def _in(comm: MPI.Comm | None) -> Iterator[None]:
    _within.append(comm)
    try:
        yield
    finally:
        _within.pop()


def collective[**P, R](*own: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator for what users call on all ranks together.

    What they give must be the same on all ranks, and what fails on one of them fails on all.

    Args:
        *own: Names of parameters that may differ between ranks.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(function)

        @functools.wraps(function)
        def call(*args: P.args, **given: P.kwargs) -> R:
            if _within and _within[-1] is not None:
                return function(*args, **given)
            comm = _ranks_of([*args, *given.values()], 3) or called_last() or MPI.COMM_SELF
            with _entered(comm), explained(function, args, given):
                if comm.size > 1:
                    require_same(comm, **_named(signature, own, args, given))
                require_truths(function, args, given)
                result = function(*args, **given)
            return cast(R, _together(result, comm)) if isinstance(result, Generator) else result

        setattr(call, _COLLECTIVE, True)
        setattr(call, _OWN, own)
        return call

    return decorate


@contextmanager
def _entered(comm: MPI.Comm) -> Iterator[None]:
    """Let a block of this package end in the same way on all ranks."""
    try:
        with agree(comm), _in(comm):
            yield
    except BaseException as error:
        if not _within:
            forget(error)
        raise


def _together[T](values: Generator[T], comm: MPI.Comm) -> Iterator[T]:
    """Yield the values of a generator of this package, between which the user goes on."""
    end = object()
    try:
        while True:
            with _entered(comm):
                value = next(values, end)
            if value is end:
                return
            yield cast(T, value)
    finally:
        values.close()


def _named(
    signature: inspect.Signature, own: tuple[str, ...], args: Any, given: Any
) -> dict[str, Any]:
    """Return the values that a call was given, by names of parameters, but for those of a rank.

    There are none where arguments do not fit: the call has Python's own sentence about that.
    """
    try:
        bound = signature.bind(*args, **given)
    except TypeError:
        return {}
    bound.apply_defaults()
    named: dict[str, Any] = {}
    for name, value in bound.arguments.items():
        if signature.parameters[name].kind is inspect.Parameter.VAR_KEYWORD:
            named |= value
        elif name != "self":
            named[name] = value
    return {name: value for name, value in named.items() if name not in own}


def _ranks_of(value: Any, depth: int) -> MPI.Comm | None:
    """Return the ranks that something is spread over, if it says so."""
    if isinstance(value, MPI.Comm):
        return value
    if isinstance(value, list | tuple):
        found = (_ranks_of(entry, depth) for entry in value)
    elif value is None or depth == 0 or isinstance(value, str | type):
        return None
    else:
        found = (_ranks_of(getattr(value, name, None), depth - 1) for name in KNOWN_BY)
    return next((comm for comm in found if comm is not None), None)


def of_user[**P, R](comm: MPI.Comm, function: Callable[P, R]) -> Callable[P, R]:
    """Return a user's function that fails on all ranks, with one error, where it fails on any.

    Args:
        comm: The ranks, which call the function together (collective).
        function: The function.
    """

    def call(*args: P.args, **given: P.kwargs) -> R:
        with agree(comm), _in(None):
            return function(*args, **given)

    return call


def asked[**P, R](function: Callable[P, R], name: str) -> Callable[P, R]:
    """Return a user's method that fails on all ranks where it fails on any, if this package asks.

    Args:
        function: The method.
        name: What a message calls it.
    """

    @functools.wraps(function)
    def call(*args: P.args, **given: P.kwargs) -> R:
        comm = _within[-1] if _within else None
        if comm is None:
            return function(*args, **given)
        with agree(comm, name), _in(None):
            return function(*args, **given)

    return call


def by_itself[F: Callable[..., Any]](function: F) -> F:
    """Mark a method of a :class:`Hooked` class whose caller lets ranks agree on its errors."""
    setattr(function, _BY_ITSELF, True)
    return function


def is_collective(thing: Any) -> bool:
    """Return whether something is what users call on all ranks together."""
    return hasattr(getattr(thing, "fget", thing), _COLLECTIVE)


class Owned:
    """A class whose names stay its own where users derive from it, but for what heirs are to write.

    That is all that stands in a class of this package made with ``hooks=True``. A method that is
    not, or that a further class of this package has made its own, does what the rest needs: one
    that an heir puts in its place must call it.
    """

    def __init_subclass__(cls, *, hooks: bool = False, **options: Any) -> None:
        """Refuse what takes a name of this package's by chance.

        Raises:
            MPMError: A method takes the place of one that is no hook, and does not call it.
        """
        super().__init_subclass__(**options)
        if is_ours(cls.__module__):
            setattr(cls, _HOOKS, hooks)
            return
        for name, written in _written(cls):
            if not _is_free(cls, name) and not _calls(written, name):
                raise MPMError(
                    f"{cls.__name__}.{name} takes the place of what this package has by that name; "
                    f"give it another one, or have it call super().{name}."
                )


class Hooked(Owned):
    """A class whose public methods and properties its heirs may override, for this package to ask.

    Where an heir outside of this package does, ranks agree after each call, and a truth that is a
    property must be the same on all of them.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        """Let ranks agree on what a user overrides."""
        super().__init_subclass__(**options)
        if is_ours(cls.__module__):
            return
        hooks = hooks_of(cls)
        for name, value in list(_written(cls)):
            if name not in hooks:
                continue
            whole = f"{cls.__name__}.{name}"
            if isinstance(value, property) and value.fget is not None:
                setattr(cls, name, value.getter(_same_truth(asked(value.fget, whole), whole)))
            elif inspect.isfunction(value):
                setattr(cls, name, asked(value, f"{whole}()"))


def _written(cls: type) -> Iterator[tuple[str, Any]]:
    """Yield what a user's class puts in the place of this package's, by name.

    Besides its own that is what comes from classes that have nothing to do with this package.
    """
    users = [each for each in cls.__mro__ if not is_ours(each.__module__)]
    for name in sorted({name for each in users for name in vars(each)}):
        home = next(each for each in cls.__mro__ if name in vars(each))
        replaces = any(name in vars(each) for each in cls.__mro__ if is_ours(each.__module__))
        if name.startswith("__") or not replaces or home not in users:
            continue
        if home is cls or not issubclass(home, Owned):  # (another heir has been looked at)
            yield name, vars(home)[name]


def _is_free(cls: type, name: str) -> bool:
    """Return whether heirs may replace what a class has from this package by a name.

    A method is as its nearest class has it; an option that a hook has is one in all classes.
    """
    having = [each for each in cls.__mro__ if is_ours(each.__module__) and name in vars(each)]
    value = vars(having[0])[name]
    nearest = having if not callable(value) and not hasattr(value, "__get__") else having[:1]
    return any(vars(each).get(_HOOKS, False) for each in nearest)


def _calls(written: Any, name: str) -> bool:
    """Return whether what stands in the place of a method calls it, as far as its code tells."""
    parts = (getattr(written, part, None) for part in ("fget", "func", "__func__"))
    function = next((part for part in parts if part is not None), written)
    return name in _named_in(getattr(inspect.unwrap(function), "__code__", None))


def _named_in(code: Any) -> set[str]:
    """Return the names of what code calls or reads, and what is defined in it."""
    if not isinstance(code, CodeType):
        return set()
    return set(code.co_names).union(*map(_named_in, code.co_consts))


def _same_truth(function: Callable[[Any], Any], name: str) -> Callable[[Any], Any]:
    """Return a property that raises an error where its truth differs between ranks."""

    @functools.wraps(function)
    def call(thing: Any) -> Any:
        value = function(thing)
        if isinstance(value, bool) and _within and _within[-1] is not None:
            require_same(_within[-1], **{name: value})
        return value

    return call


def hooks_of(cls: type) -> set[str]:
    """Return the names of what a user may override of this package's :class:`Hooked` classes."""
    found, not_asked = set(), set()
    for base in cls.__mro__:
        if not (is_ours(base.__module__) and issubclass(base, Hooked)):
            continue
        for name, value in vars(base).items():
            if is_collective(value) or hasattr(value, _BY_ITSELF):
                not_asked.add(name)
            elif inspect.isfunction(value) or isinstance(value, property):
                found.add(name)
    return {name for name in found - not_asked if not name.startswith("_")}
