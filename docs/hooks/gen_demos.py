# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""MkDocs hook: one page per demo, made from its script (jupytext, light) without running it.

What the script printed and drew is in ``images/demos``, kept by ``scripts/run_demos.py``; it comes
before the exercises, and a link to their answers after them. Beside each page are the script and a
notebook made of it. The gallery has the demos by the level that stands below their licence, as
``# Level: 1.2: Clay under its weight``: the second of the first level, and what stands below its
title there.
"""

from __future__ import annotations

import html
import logging
import re
from pathlib import Path

import jupytext
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

log = logging.getLogger("mkdocs.hooks.demos")

HEADER = re.compile(r"\A(?:#!.*\n)?(?:# (?:Copyright|SPDX-|Level:).*\n)+(?:#?\n)*")
LEVEL = re.compile(r"^# Level: ([123])\.(\d+): (.+)$", re.MULTILINE)
LEVELS = ("First steps", "Standard problems", "Further on")
EXERCISES = "\n## Exercises\n"
ANSWERS = "answers.md"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    root = Path(config.config_file_path).parent
    levels: list[list[tuple[int, str, str, str]]] = [[] for _ in LEVELS]
    for script in sorted((root / "demos").glob("demo_*.py")):
        source = script.read_text("utf-8")
        level = LEVEL.search(source)
        if level is None:
            log.warning("%s has no '# Level: 1.2: its physics' below its licence.", script.name)
        name = script.stem.removeprefix("demo_")
        model = root / "docs" / "images" / "demos" / f"{name}_model.png"
        sketch = f"![The model](../images/demos/{model.name})\n" if model.exists() else ""
        title, text = page(script.name, source, sketch, results(root / "docs", name))
        files.append(File.generated(config, f"demos/{script.stem}.md", content=text))
        files.append(File.generated(config, f"demos/{script.name}", content=source))
        notebook = jupytext.reads(HEADER.sub("", source), fmt="py:light")
        notebook.metadata["kernelspec"] = {
            "name": "python3",
            "display_name": "Python 3",
            "language": "python",
        }
        for number, cell in enumerate(notebook.cells):
            cell["id"] = f"cell-{number}"
        text = jupytext.writes(notebook, fmt="ipynb")
        files.append(File.generated(config, f"demos/{script.stem}.ipynb", content=text))
        place, told = (int(level[2]), level[3]) if level else (99, "")
        levels[int(level[1]) - 1 if level else -1].append((place, title, name, told))
    nav: list[object] = ["demos/index.md"]
    parts = ["# Demos", "Each is a script that runs alone, and a notebook of the same text."]
    for heading, entries in zip(LEVELS, levels, strict=True):
        if not entries:
            continue
        parts.append(f"## {heading}")
        entries.sort()
        cards = [
            f'<a href="demo_{name}.html">{thumbnail(root / "docs", name)}'
            f"<strong>{html.escape(title)}</strong><span>{html.escape(told)}</span></a>"
            for _, title, name, told in entries
        ]
        parts.append('<div class="gallery">\n' + "\n".join(cards) + "\n</div>")
        nav.append({heading: [{title: f"demos/demo_{name}.md"} for _, title, name, _ in entries]})
    files.append(File.generated(config, "demos/index.md", content="\n\n".join(parts) + "\n"))
    nav.append({"Answers to the exercises": ANSWERS})
    config.nav.append({"Demos": nav})
    return files


def thumbnail(docs: Path, name: str) -> str:
    """Return a demo's picture for the gallery, if it is kept."""
    card = f"images/demos/{name}_card.png"
    return f'<img src="../{card}" alt="" loading="lazy">' if (docs / card).exists() else ""


def results(docs: Path, name: str) -> str:
    """Return the part of a page with what the demo drew and printed."""
    kept = docs / "images" / "demos"
    picture, output = kept / f"{name}.png", kept / f"{name}.txt"
    if not picture.exists() or not output.exists():
        log.info("The demo %s has not been run: python scripts/run_demos.py %s", name, name)
        return ""
    movie = f"\n![The run as a movie](../images/demos/{name}.gif)\n"
    parts = [
        "\n## What it draws and prints\n",
        f"![The picture that the script leaves](../images/demos/{name}.png)\n",
        movie if (kept / f"{name}.gif").exists() else "",
        f"```text\n{output.read_text('utf-8').rstrip()}\n```\n",
    ]
    return "\n".join(part for part in parts if part)


def page(script: str, source: str, sketch: str, shown: str) -> tuple[str, str]:
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
    body = "\n\n".join(blocks) + "\n"
    title = re.match(r"# (.+)\n", body)
    if title is None:
        raise PluginError(f"{script} must start with a title: a comment '# # Title'.")
    before, exercises, after = body.partition(EXERCISES)
    stem = script.removesuffix(".py")
    if exercises:
        after += f"\n[Answers](../{ANSWERS}#{stem.removeprefix('demo_')})\n"
    body = before + shown + exercises + after
    note = f"*The script: [{script}]({script}); as a notebook: [{stem}.ipynb]({stem}.ipynb).*"
    text, code, rest = body[title.end() :].partition("\n```python")
    return title[1].strip(), f"{title[0]}\n{note}\n{text}\n{sketch}{code}{rest}\n"
