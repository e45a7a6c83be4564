# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Hashes of what numbers are made of, which comments, layout and other rows do not change."""

from __future__ import annotations

import ast
import hashlib
import re
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from functools import cache, partial
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import case_runs
from case_runs import CASES, ROOT, Table

OURS = tuple(ROOT / part for part in ("docs", "benchmarks", "tests"))


def digest(text: str, length: int = 8) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:length]


@cache
def plain(path: Path) -> str:
    """Return the code of a script, without its comments and docstrings, in one layout."""
    return ast.unparse(_tree(path))


def of_row(table: Table, label: str) -> str:
    """Return a hash of what a row is made of: its function, what that uses, cases that it runs."""
    text = "\n".join(_parts(table.rows[label], set()))
    words = set(re.findall(r"\w+", text))
    run = [case for case in table.cases if case in words] or table.cases
    return digest("\n".join([text, *(plain(CASES / f"{case}.py") for case in run)]), 4)


@cache
def _tree(path: Path) -> ast.Module:
    tree = ast.parse(path.read_text("utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(
            node
        ):
            node.body = node.body[1:] or [ast.Pass()]
    return tree


def _parts(thing: Any, seen: set[int]) -> Iterator[str]:
    """Yield the texts that tell a thing apart from others of its kind."""
    thing = getattr(thing, "__wrapped__", thing)  # (of a function that is cached)
    if isinstance(thing, str | int | float | bool | None | Path):
        yield thing.name if isinstance(thing, Path) else repr(thing)
        return
    if id(thing) in seen:
        return
    seen.add(id(thing))
    if isinstance(thing, partial):
        yield from _all([thing.func, *thing.args, thing.keywords], seen)
    elif isinstance(thing, Mapping):
        yield from _all([*thing.keys(), *thing.values()], seen)
    elif isinstance(thing, list | tuple):
        yield from _all(thing, seen)
    elif isinstance(thing, FunctionType | type) and (path := _path(thing)) is not None:
        yield from _source(thing, path)
        if isinstance(thing, FunctionType):
            yield from _all(_used(thing), seen)
    else:
        yield getattr(thing, "__qualname__", type(thing).__qualname__)


def _all(things: Iterable[Any], seen: set[int]) -> Iterator[str]:
    for thing in things:
        yield from _parts(thing, seen)


def _path(thing: Any) -> Path | None:
    """Return where a function, class or module is written, if that is here."""
    if thing is case_runs or getattr(thing, "__module__", None) == case_runs.__name__:
        return None
    module = thing if isinstance(thing, ModuleType) else sys.modules.get(thing.__module__)
    path = Path(getattr(module, "__file__", None) or "/").resolve()
    return path if any(path.is_relative_to(part) for part in OURS) else None


@cache
def _source(thing: FunctionType | type, path: Path) -> list[str]:
    """Return the code of a function or class; of lambdas all that begin in the same line."""
    kind, line = ast.FunctionDef, None
    if isinstance(thing, type):
        kind = ast.ClassDef
    elif thing.__name__ == "<lambda>":
        kind, line = ast.Lambda, thing.__code__.co_firstlineno
    return [ast.unparse(node) for node in _nodes(path).get((kind, line or thing.__name__), [])]


@cache
def _nodes(path: Path) -> dict[tuple[type, str | int], list[ast.AST]]:
    """Return the functions and classes of a file by their names, and lambdas by their lines."""
    found = defaultdict(list)
    for node in ast.walk(_tree(path)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found[type(node), node.name].append(node)
        elif isinstance(node, ast.Lambda):
            found[ast.Lambda, node.lineno].append(node)
    return found


def _used(function: FunctionType) -> Iterator[Any]:
    """Yield what a function refers to: what it closes over, its defaults, globals by name."""
    yield from (cell.cell_contents for cell in function.__closure__ or ())
    yield from function.__defaults__ or ()
    names = _names(function.__code__)
    for name in names:
        thing = function.__globals__.get(name)
        if isinstance(thing, ModuleType):
            if _path(thing) is not None:
                yield from (getattr(thing, n) for n in names if hasattr(thing, n))
        elif thing is not None:
            yield thing


def _names(code: CodeType) -> list[str]:
    inner = [_names(part) for part in code.co_consts if isinstance(part, CodeType)]
    return list(dict.fromkeys([*code.co_names, *(name for names in inner for name in names)]))
