# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""MkDocs hook: one page per demo, made from its script (jupytext, light) without running it."""

from __future__ import annotations

import re
from pathlib import Path

import jupytext
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

HEADER = re.compile(r"\A(?:#!.*\n)?(?:# (?:Copyright|SPDX-).*\n)+(?:#?\n)*")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    folder = Path(config.config_file_path).parent / "demos"
    pages, entries = [], []
    for script in sorted(folder.glob("demo_*.py")):
        source = script.read_text("utf-8")
        title, text = page(script.name, source)
        name = f"demos/{script.stem}.md"
        files.append(File.generated(config, name, content=text))
        files.append(File.generated(config, f"demos/{script.name}", content=source))
        pages.append({title: name})
        entries.append(f"- [{title}]({script.stem}.md)")
    index = "# Demos\n\n" + ("\n".join(entries) or "There are none yet.") + "\n"
    files.append(File.generated(config, "demos/index.md", content=index))
    config.nav.append({"Demos": ["demos/index.md", *pages]})
    return files


def page(script: str, source: str) -> tuple[str, str]:
    """Return a demo's title and its page."""
    blocks: list[str] = []
    last = ""
    for cell in jupytext.reads(HEADER.sub("", source), fmt="py:light").cells:
        text = cell.source.strip("\n")
        if not text:
            continue
        if cell.cell_type != "code":
            blocks.append(text)
        elif last == "code":  # the light format parts code at blank lines
            blocks[-1] = blocks[-1].removesuffix("\n```") + f"\n\n{text}\n```"
        else:
            blocks.append(f"```python\n{text}\n```")
        last = cell.cell_type
    body = "\n\n".join(blocks)
    title = re.match(r"# (.+)\n", body)
    if title is None:
        raise PluginError(f"{script} must start with a title: a comment '# # Title'.")
    note = f"*The script: [{script}]({script}).*"
    return title[1].strip(), f"{title[0]}\n{note}\n{body[title.end() :]}\n"
