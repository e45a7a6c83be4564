# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""MkDocs hook: one page per public name, from the package's source without importing it.

Public are the names in ``__all__`` of ``mpm_dolfinx``, of ``mpm_dolfinx.materials``, and of each
module that one of these lists holds. A page also has what its class inherits from bases that are
not public.
"""

from __future__ import annotations

import re
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
    package = griffe.load(
        PACKAGE, search_paths=[root], allow_inspection=False, resolve_aliases=True
    )
    pages: dict[str, str] = {}
    nav = module_pages(package, "api", pages)
    for name, text in pages.items():
        files.append(File.generated(config, name, content=text))
    config.nav.append({"Reference": nav})
    return files


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    if not page.file.src_uri.startswith("api/"):
        return content
    return ROLE.sub(r"\1\2", content).replace("::</p>", ":</p>")


def module_pages(module: Any, folder: str, pages: dict[str, str]) -> list[Any]:
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
            nav.append({name: module_pages(member, f"{folder}/{name}", pages)})
        else:
            target = f"{name}.md"
            pages[f"{folder}/{target}"] = f"::: {module.path}.{name}\n" + inherited(member, names)
            nav.append({name: f"{folder}/{target}"})
        rows.append(f"| [`{name}`]({target}) | {summary} |")
    title = f"# `{module.path}`\n\n{first_sentence(module)}\n\n"
    pages[f"{folder}/index.md"] = title + "\n".join(["| name | |", "| --- | --- |", *rows]) + "\n"
    return nav


def inherited(member: Any, names: list[str]) -> str:
    """Return the option that adds what a class has from bases without a page of their own."""
    bases = [base for base in member.mro() if base.name not in names] if member.is_class else []
    described = [n for b in bases for n, m in b.members.items() if n[0] != "_" and m.docstring]
    return f"    options:\n      inherited_members: {described}\n" if described else ""


def exports(module: Any) -> list[str]:
    """Return the names in ``__all__``, without ``__version__`` and the like."""
    if module.exports is None and not module.parent:
        raise PluginError(f"{module.path} has no __all__ that can be read without importing it.")
    return [str(name) for name in module.exports or () if not str(name).startswith("__")]


def first_sentence(member: Any) -> str:
    """Return the first line of a docstring, fit for a table."""
    lines = member.docstring.value.splitlines() if member.docstring else [""]
    return ROLE.sub(r"\1\2", lines[0]).replace("|", "\\|")
