# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Public names, with their members and arguments, stay as ``data/public_api.txt`` has them.

Where a name is meant to come, change or go, write the list anew with
``python tests/test_public_api.py``: its difference is what users notice.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import mpm_dolfinx

LIST = Path(__file__).resolve().parent / "data" / "public_api.txt"
PACKAGE = mpm_dolfinx.__name__
#: Modules that users import names from; all of them are attributes of the package.
MODULES = ("", "boundary", "errors", "history", "materials", "plot")


def public_api() -> list[str]:
    """Return a line for each public name, member and argument."""
    lines: list[str] = []
    for name in MODULES:
        module = getattr(mpm_dolfinx, name) if name else mpm_dolfinx
        for exported in sorted(module.__all__):
            lines += described(f"{name}.{exported}".lstrip("."), getattr(module, exported))
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


if __name__ == "__main__":
    LIST.write_text("\n".join(public_api()) + "\n", encoding="utf-8")
