# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""MkDocs hook: lists that follow a line of text are lists, and code fits into 80 columns.

Markdown asks for an empty line before a list, which the comments of scripts do without. Scripts
have lines of up to 100 columns; what a page shows of them is formatted anew.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

COLUMNS = 80
RUFF = shutil.which("ruff", path=str(Path(sys.executable).parent)) or "ruff"
FENCE = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
ITEM = re.compile(r"(?:[-*]|\d+\.) ")
TEXT = re.compile(r"[^\s#|>`$<!]")


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    if page.file.src_uri.startswith("api/"):
        return markdown
    return FENCE.sub(lambda m: f"```python\n{fitted(m[1])}```", spaced(markdown))


def spaced(markdown: str) -> str:
    """Put an empty line before each list that follows a line of text."""
    lines: list[str] = []
    fenced = in_list = False
    for line in markdown.split("\n"):
        if line.startswith("```"):
            fenced = not fenced
        starts = ITEM.match(line) is not None
        if not fenced and starts and not in_list and lines and TEXT.match(lines[-1]):
            lines.append("")
        in_list = starts or (in_list and line.strip() != "")
        lines.append(line)
    return "\n".join(lines)


def fitted(code: str) -> str:
    """Return code that fits, formatted by ruff where a line is too long."""
    if all(len(line) <= COLUMNS for line in code.split("\n")):
        return code
    done = subprocess.run(
        [RUFF, "format", "--isolated", f"--line-length={COLUMNS}", "-"],
        input=code,
        capture_output=True,
        text=True,
    )
    return done.stdout if done.returncode == 0 else code
