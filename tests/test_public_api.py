# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Public names, with their members and arguments, stay as ``data/public_api.txt`` has them.

Where a name is meant to come, change or go, write the list anew with
``python tests/test_public_api.py``: its difference is what users notice.
"""

from __future__ import annotations

import inspect
import re
import tomllib
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import mpm_dolfinx

ROOT = Path(__file__).resolve().parents[1]
LIST = ROOT / "tests" / "data" / "public_api.txt"
PACKAGE = mpm_dolfinx.__name__


#: Modules that users import names from, besides those that the package and its modules list.
MODULES = ("errors", "history", "io")


def faces() -> dict[str, ModuleType]:
    """Return the modules that users import names from, by their names in the package."""
    found = {"": mpm_dolfinx} | {name: import_module(f"{PACKAGE}.{name}") for name in MODULES}
    left = list(found.items())
    while left:
        name, module = left.pop()
        inner = {
            f"{name}.{exported}".lstrip("."): getattr(module, exported)
            for exported in module.__all__
            if inspect.ismodule(getattr(module, exported))
        }
        found |= inner
        left += inner.items()
    return found


def public_api() -> list[str]:
    """Return a line for each public name, member and argument."""
    lines: list[str] = []
    known: dict[int, str] = {}
    for name, module in faces().items():
        for exported in sorted(module.__all__):
            thing, path = getattr(module, exported), f"{name}.{exported}".lstrip(".")
            first = known.setdefault(id(thing), path)
            again = first != path and not inspect.ismodule(thing)
            lines += [f"{path}: {first}"] if again else described(path, thing)
    return sorted(dict.fromkeys(lines))


def described(name: str, thing: Any) -> Iterator[str]:
    """Yield the lines of one name."""
    if isinstance(thing, ModuleType):
        yield f"{name}: module"
    elif inspect.isclass(thing):
        yield f"{name}: class"
        if thing.__init__ is not object.__init__ or "__new__" in vars(thing):
            yield from arguments(name, thing)
        for member, value in members(thing).items():
            yield from described(f"{name}.{member}", value)
    elif callable(thing):
        yield f"{name}: function"
        yield from arguments(name, thing)
    elif isinstance(thing, property) or inspect.isdatadescriptor(thing):
        yield f"{name}: attribute" + (" that may be set" if getattr(thing, "fset", None) else "")
    else:
        yield f"{name}: attribute"


def members(cls: type) -> dict[str, Any]:
    """Return the public members that a class has from this package, its bases' too."""
    own = [base for base in reversed(cls.__mro__) if base.__module__.split(".")[0] == PACKAGE]
    found: dict[str, Any] = {}
    for base in own:
        for name in getattr(base, "__annotations__", {}):
            found.setdefault(name, None)
        for name, value in vars(base).items():
            found[name] = value.__func__ if isinstance(value, staticmethod) else value
    found = {n: v.__func__ if isinstance(v, classmethod) else v for n, v in found.items()}
    return {name: value for name, value in found.items() if not name.startswith("_")}


def arguments(name: str, thing: Any) -> Iterator[str]:
    """Yield a line for each argument: its place where it has one, and its default."""
    try:
        parameters = inspect.signature(thing).parameters.values()
    except (TypeError, ValueError):
        return
    place = 0
    for p in parameters:
        text = {p.VAR_POSITIONAL: "*", p.VAR_KEYWORD: "**"}.get(p.kind, "") + p.name
        if p.default is not p.empty:
            plain = isinstance(p.default, bool | int | float | str | tuple | None)
            text += f"={p.default!r}" if plain else "=..."
        if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD):
            text += f" (place {place})"
            place += 1
        yield f"{name}({text})"


@pytest.mark.skip_in_parallel
def test_public_names_members_and_arguments_are_those_of_the_list() -> None:
    listed, found = LIST.read_text(encoding="utf-8").splitlines(), public_api()
    gone = [line for line in listed if line not in found]
    come = [line for line in found if line not in listed]
    assert not gone and not come, (
        f"gone: {gone}; come: {come}. If this is meant, run python tests/test_public_api.py"
    )


@pytest.mark.skip_in_parallel
def test_groups_of_the_reference_have_members_that_there_are() -> None:
    """The strict build of the documentation refuses others, but takes a minute."""
    listed = tomllib.loads((ROOT / "docs" / "hooks" / "api_members.toml").read_text("utf-8"))
    public = [vars(module).get(name) for module in faces().values() for name in module.__all__]
    unused, stale = set(listed), {}
    for cls in filter(inspect.isclass, public):
        there = {member for base in cls.__mro__ for member in own_names(base)}
        for base in cls.__mro__:
            if (entry := listed.get(base.__name__)) is None:
                continue
            unused.discard(base.__name__)
            named = {member for some in entry["groups"].values() for member in some}
            if gone := (named | set(entry["internals"])) - there:
                stale[cls.__name__] = sorted(gone)
    assert not unused and not stale


def own_names(cls: type) -> set[str]:
    """Return names of what a class has, and of the attributes that its docstring lists."""
    listed = (inspect.getdoc(cls) or "").partition("\nAttributes:\n")[2]
    attributes = re.findall(r"^ {4}(\w+):", listed, re.MULTILINE)
    return {*vars(cls), *getattr(cls, "__annotations__", {}), *attributes}


if __name__ == "__main__":
    LIST.write_text("\n".join(public_api()) + "\n", encoding="utf-8")
