# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""MkDocs hook: one page per public name, from the package's source without importing it.

Public are the names in ``__all__`` of ``mpm_dolfinx``, of ``mpm_dolfinx.materials``, and of each
module that one of these lists holds. A page also has what its class inherits from bases that are
not public. ``api_members.toml`` puts the members of large classes into groups and leaves out what
is no business of users.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import griffe
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

PACKAGE = "mpm_dolfinx"
ALWAYS = ("materials",)
# What docstrings have for Sphinx: roles, and the double colon before a block of code.
ROLE = re.compile(r":(?:class|meth|func|mod|attr):(`|<code>)~?(?:[\w.]+\.)?(\w+)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    root = Path(config.config_file_path).parent
    members = tomllib.loads((Path(__file__).parent / "api_members.toml").read_text("utf-8"))
    package = griffe.load(
        PACKAGE, search_paths=[root], allow_inspection=False, resolve_aliases=True
    )
    pages: dict[str, str] = {}
    index, *entries = module_pages(package, "api", pages, members)
    names = [entry for entry in entries if isinstance(next(iter(entry.values())), str)]
    modules = [entry for entry in entries if entry not in names]
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    config.nav.append({"Reference": [index, {PACKAGE: names}, *modules]})
    return files


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    if not page.file.src_uri.startswith("api/"):
        return content
    if content.startswith("<table>"):  # the groups come after the heading
        end = content.index("</table>") + len("</table>")
        heading = content.index("</h1>", end) + len("</h1>")
        content = content[end:heading] + content[:end] + content[heading:]
    return ROLE.sub(r"\1\2", content).replace("::</p>", ":</p>")


def module_pages(
    module: Any, folder: str, pages: dict[str, str], members: dict[str, Any]
) -> list[Any]:
    """Add the pages of a module and return its part of the navigation."""
    names = exports(module)
    if not module.parent:
        names += [n for n in ALWAYS if n in module.members and n not in names]
    nav: list[Any] = [f"{folder}/index.md"]
    rows = []
    for name in sorted(names, key=lambda n: (n.islower(), n)):
        try:
            member = module[name]
            summary, is_module = first_sentence(member), member.is_module
        except (KeyError, griffe.AliasResolutionError) as error:
            raise PluginError(f"'{name}' in {module.path}.__all__ is not defined there.") from error
        if is_module and exports(member):
            target = f"{name}/index.md"
            nav.append({name: module_pages(member, f"{folder}/{name}", pages, members)})
        else:
            target = f"{name}.md"
            path = f"{module.path}.{name}"
            shown, overview = choice(member, path, members, names)
            pages[f"{folder}/{target}"] = overview + f"::: {path}\n" + options(member, names, shown)
            nav.append({name: f"{folder}/{target}"})
        rows.append(f"| [`{name}`]({target}) | {summary} |")
    title = f"# `{module.path}`\n\n{first_sentence(module)}\n\n"
    pages[f"{folder}/index.md"] = title + "\n".join(["| name | |", "| --- | --- |", *rows]) + "\n"
    return nav


def choice(
    member: Any, path: str, members: dict[str, Any], names: list[str]
) -> tuple[list[str] | None, str]:
    """Return what members a page leaves out, and a table of the others by groups.

    Args:
        member: What the page is about.
        path: Its public name.
        members: Groups and what is left out, by class.
        names: Public names of the module, which have pages.

    Returns:
        ``None`` and nothing, unless the member is a class that has groups.
    """
    if not member.is_class:
        return None, ""
    lineage = [member, *member.mro()]
    known = [members[base.name] for base in reversed(lineage) if base.name in members]
    if not known:
        return None, ""
    there = {n for base in lineage for n in base.members}
    there |= {a.name for base in lineage for a in attributes(base)}
    groups: dict[str, list[str]] = {}
    hidden: list[str] = []
    for entry in known:
        hidden += entry["internals"]
        for title, some in entry["groups"].items():
            groups.setdefault(title, []).extend(some)
    listed = {name for some in groups.values() for name in some}
    if gone := sorted((listed | set(hidden)) - there):
        raise PluginError(f"docs/hooks/api_members.toml: {path} has no {', '.join(gone)}.")
    places = headings(lineage, path, names)
    if others := [n for n in places if n not in listed and n not in hidden]:
        groups["Other"] = others
    rows = [
        f"| {title} | {', '.join(linked(name, places) for name in some)} |"
        for title, some in groups.items()
    ]
    return hidden, "\n".join(["| at a glance | |", "| --- | --- |", *rows]) + "\n\n"


def headings(lineage: list[Any], path: str, names: list[str]) -> dict[str, str]:
    """Return the place of the heading of each described member: on this page, or on a base's."""
    places: dict[str, str] = {}
    module = path.rpartition(".")[0]
    for base in lineage:
        own = base is lineage[0] or base.name not in names
        page = "" if own else f"{base.name}.md"
        of = path if own else f"{module}.{base.name}"
        for name, member in base.members.items():
            if name[0] != "_" and member.docstring:
                places.setdefault(name, f"{page}#{of}.{name}")
    return places


def linked(name: str, places: dict[str, str]) -> str:
    """Return a member's name, with a link where it has a heading."""
    return f"[`{name}`]({places[name]})" if name in places else f"`{name}`"


def attributes(base: Any) -> list[Any]:
    """Return the attributes that a class's docstring lists."""
    if not base.docstring:
        return []
    sections = base.docstring.parse("google")
    return [a for section in sections if section.kind.value == "attributes" for a in section.value]


def options(member: Any, names: list[str], hidden: list[str] | None) -> str:
    """Return a page's options: what is left out, and what comes from bases without a page."""
    lines = []
    bases = [base for base in member.mro() if base.name not in names] if member.is_class else []
    described = [
        n
        for b in bases
        for n, m in b.members.items()
        if n[0] != "_" and m.docstring and n not in (hidden or ())
    ]
    if described:
        lines.append(f"inherited_members: {described}")
    if hidden is not None:
        patterns = ["!^_", *(f"!^{name}$" for name in hidden)]
        lines.append(f"filters: {patterns}")
    return "    options:\n" + "".join(f"      {line}\n" for line in lines) if lines else ""


def exports(module: Any) -> list[str]:
    """Return the names in ``__all__``, without ``__version__`` and the like."""
    if module.exports is None and not module.parent:
        raise PluginError(f"{module.path} has no __all__ that can be read without importing it.")
    return [str(name) for name in module.exports or () if not str(name).startswith("__")]


def first_sentence(member: Any) -> str:
    """Return the first line of a docstring, fit for a table."""
    lines = member.docstring.value.splitlines() if member.docstring else [""]
    return ROLE.sub(r"\1\2", lines[0]).replace("|", "\\|")
