# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
r"""MkDocs hook: LaTeX formulas become MathML when the pages are built.

Browsers show MathML by themselves, so no script is loaded from the net. A formula with a command
that is not understood gives a warning. ``\tag{1}`` numbers an equation.
"""

from __future__ import annotations

import html
import logging
import re
import unicodedata

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import Files
from mkdocs.structure.pages import Page

log = logging.getLogger("mkdocs.hooks.mathml")

INLINE = re.compile(r'(<span class="arithmatex">)\\\((.*?)\\\)(</span>)', re.DOTALL)
DISPLAY = re.compile(r'(<div class="arithmatex">)\s*\\\[(.*?)\\\]\s*(</div>)', re.DOTALL)
TAG = re.compile(r"\\tag\{([^{}]*)\}")

# What latex2mathml does not know or renders for MathJax only.
LATEX = [
    (re.compile(r"\\(begin|end)\{aligned\}"), r"\\\1{split}"),
    (re.compile(r"\\(begin|end)\{(?:equation\*?|gather\*?)\}"), ""),
    (re.compile(r"\\mathrm\{(\w)\}|\\mathrm (\w)"), r"\\text{\1\2}"),
    (re.compile(r"\\mathrm\{(\w\w+)\}"), r"\\operatorname{\1}"),
]
BOLD = re.compile(r'<mi mathvariant="bold-italic">(&#x[0-9A-Fa-f]+;|\w)</mi>')
UNKNOWN = re.compile(r"<m[io]>(\\[A-Za-z]+)</m[io]>")


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    where = page.file.src_uri
    content = DISPLAY.sub(lambda m: m[1] + mathml(m[2], "block", where) + m[3], content)
    return INLINE.sub(lambda m: m[1] + mathml(m[2], "inline", where) + m[3], content)


def mathml(escaped: str, display: str, where: str) -> str:
    """Return a formula as MathML, with its number behind it."""
    latex = html.unescape(escaped).strip()
    number = TAG.search(latex)
    text = TAG.sub("", latex)
    for pattern, replacement in LATEX:
        text = pattern.sub(replacement, text)
    try:
        result = convert(text, display=display)
    except Exception as error:
        log.warning("%s: the formula %r cannot be read (%r)", where, latex, error)
        return f"<code>{html.escape(latex)}</code>"
    for command in UNKNOWN.findall(result):
        log.warning("%s: unknown command %s in the formula %r", where, command, latex)
    result = BOLD.sub(lambda m: f"<mi>{bold(html.unescape(m[1]))}</mi>", result)
    result = result.replace("<mi>&</mi>", "").replace("negativethinmathspace", "-0.167em")
    return result + (f'<span class="equation-number">({number[1]})</span>' if number else "")


def bold(letter: str) -> str:
    r"""Return a letter's bold italic form (\boldsymbol), where Unicode has one."""
    name = unicodedata.name(letter, "").split()
    if len(name) == 4 and name[0] in ("LATIN", "GREEK") and name[2] == "LETTER":
        try:
            return unicodedata.lookup(f"MATHEMATICAL BOLD ITALIC {name[1]} {name[3]}")
        except KeyError:
            pass
    return letter
