# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The rules that keep the package a house: read from its source, nothing is imported."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

PACKAGE = "mpm_dolfinx"
ROOT = Path(__file__).resolve().parents[1] / PACKAGE

#: Folders (and the files beside them) from the ground up; none imports what stands in its own line
#: or above.
FLOORS = (
    ("errors", "_compat", "_core", "log", "reals", "tolerances"),
    ("parallel",),
    ("meshes", "materials", "history"),
    ("background", "solvers"),
    ("transfer",),
    ("particles",),
    ("constitutive", "io", "plot"),
    ("assembly",),
    ("stabilisation", "boundary"),
    ("system",),
    ("contact", "structures"),
    ("stepping",),
    ("problems",),
    ("gradients",),
    ("",),  # the package's own face
)
FLOOR = {name: floor for floor, names in enumerate(FLOORS) for name in names}
#: Faces that files may import: they choose among compiled modules.
FREE_FACES = ("_core",)
#: The one module that may look into DOLFINx's own objects.
BRIDGE = "_compat"
#: Their keywords are those of a problem's user, and are held in dataclasses.
PUBLIC_PROBLEMS = (
    "DynamicParticleProblem",
    "DynamicProblem",
    "ParticleProblem",
    "QuasiStaticProblem",
)
MOST_PARAMETERS = 12
#: Public in spite of their underscore, so that names of fields cannot hide them.
OF_NAMED_TUPLES = ("_asdict", "_fields", "_make", "_replace")


def name_of(path: Path) -> str:
    """Return the dotted name of a file within the package; a face has its folder's."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


PATHS = {name_of(path): path for path in sorted(ROOT.rglob("*.py"))}
FACES = {name for name, path in PATHS.items() if path.name == "__init__.py"}


@cache
def nodes_of(name: str) -> list[ast.AST]:
    """Return all of a file's syntax tree, which is looked through once for all rules."""
    return list(ast.walk(ast.parse(PATHS[name].read_text(encoding="utf-8"))))


def imports(name: str) -> Iterator[tuple[str, str]]:
    """Yield the modules of the package that one imports, with the name taken (or nothing).

    Those within functions and below ``if TYPE_CHECKING`` count as well.
    """
    package = name if name in FACES else name.rpartition(".")[0]
    for node in nodes_of(name):
        if isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.split(".")[0] == PACKAGE:
                    yield alias.name.partition(".")[2], ""
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                above = package.split(".") if package else []
                base = above[: len(above) - node.level + 1]
                source = ".".join(base + (node.module.split(".") if node.module else []))
            elif (node.module or "").split(".")[0] == PACKAGE:
                source = (node.module or "").partition(".")[2]
            else:
                continue
            for alias in node.names:
                module = f"{source}.{alias.name}".lstrip(".")
                yield (module, "") if module in PATHS else (source, alias.name)


def folder(name: str) -> str:
    """Return the folder, or the file beside folders, that a module belongs to."""
    return name.split(".")[0]


def without_place() -> Iterator[str]:
    """Yield what stands beside the folders and has no floor."""
    yield from (name for name in {folder(name): None for name in PATHS} if name not in FLOOR)


def upward() -> Iterator[str]:
    """Yield imports that do not go down."""
    for name in PATHS:
        for source, _ in imports(name):
            one, other = folder(name), folder(source)
            both = one in FLOOR and other in FLOOR
            if both and one != other and FLOOR[other] >= FLOOR[one]:
                yield f"{name} imports {source}"


def of_faces() -> Iterator[str]:
    """Yield imports of names from a folder's face, which is for users."""
    for name in PATHS:
        for source, taken in imports(name):
            if name and source in FACES and source not in FREE_FACES:
                yield f"{name} imports {taken or 'it'} from {source or PACKAGE}"


def private(name: str) -> bool:
    return name.startswith("_") and not name.endswith("__") and name not in OF_NAMED_TUPLES


def foreign_underscores() -> Iterator[str]:
    """Yield uses of what another object or another module keeps to itself."""
    for name in PATHS:
        if name == BRIDGE:
            continue
        for node in nodes_of(name):
            if isinstance(node, ast.Attribute) and private(node.attr):
                owner = ast.unparse(node.value)
                if owner not in ("self", "cls", "type(self)", "super()"):
                    yield f"{name}: {owner}.{node.attr}"
        for source, taken in imports(name):
            if private(taken) and source != name:
                yield f"{name} imports {taken} from {source}"


def circles() -> Iterator[str]:
    """Yield the circles of modules, each once, with those that only types close."""
    graph = {name: sorted({s for s, _ in imports(name)} - {name, ""}) for name in PATHS}
    reached: dict[str, set[str]] = {}
    for name in graph:
        seen, ahead = set(), list(graph[name])
        while ahead:
            if (step := ahead.pop()) not in seen:
                seen.add(step)
                ahead += graph.get(step, [])
        reached[name] = seen
    for name in graph:
        circle = sorted(other for other in reached[name] if name in reached[other])
        if circle and circle[0] == name:
            yield " - ".join(circle)


def made_again() -> Iterator[str]:
    """Yield what empties objects, initialises them again, or asks whether it was made before."""
    for name in PATHS:
        constructors = [
            node
            for node in nodes_of(name)
            if isinstance(node, ast.FunctionDef) and node.name in ("__init__", "__new__")
        ]
        within = {id(inner) for node in constructors for inner in ast.walk(node)}
        for node in nodes_of(name):
            if isinstance(node, ast.Attribute) and node.attr == "__dict__":
                yield f"{name}: {ast.unparse(node)}"
            if not isinstance(node, ast.Call):
                continue
            called = ast.unparse(node.func)
            if called == "locals":
                yield f"{name}: locals()"
            if called.endswith(".__init__") and (
                id(node) not in within or not called.startswith("super(")
            ):
                yield f"{name}: {called}"


def long_constructors() -> Iterator[str]:
    """Yield the package's own classes that are made of too many things."""
    for name in PATHS:
        for node in nodes_of(name):
            if not isinstance(node, ast.ClassDef) or node.name in PUBLIC_PROBLEMS:
                continue
            for method in node.body:
                if isinstance(method, ast.FunctionDef) and method.name == "__init__":
                    a = method.args
                    if len(a.posonlyargs + a.args + a.kwonlyargs) - 1 > MOST_PARAMETERS:
                        yield f"{name}.{node.name}"


RULES = {
    "each module has its place": without_place,
    "a folder imports only folders below it": upward,
    "files import files, not a folder's face": of_faces,
    "nobody touches another's underscore": foreign_underscores,
    "no circle of modules": circles,
    "no object is made again": made_again,
    "a constructor takes twelve things": long_constructors,
}


@pytest.mark.parametrize("rule", RULES)
def test_nothing_breaks_the_rule(rule: str) -> None:
    breaches = sorted(set(RULES[rule]()))
    assert not breaches, f"{rule}:\n" + "\n".join(breaches)
