# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The paper cites what is in its bibliography, and its figures are there."""

import re
from pathlib import Path

PAPER = Path(__file__).resolve().parents[2] / "paper"


def test_references_resolve():
    text = (PAPER / "paper.md").read_text("utf-8")
    entries = re.findall(r"^@\w+\{(\w+),", (PAPER / "paper.bib").read_text("utf-8"), re.MULTILINE)
    assert len(entries) == len(set(entries))
    body = text.split("---", 2)[2]
    assert set(re.findall(r"@(\w+)", body)) == set(entries)
    assert {*re.findall(r"\\autoref\{([\w:]+)\}", body)} == {
        *re.findall(r"\\label\{([\w:]+)\}", body)
    }
    for picture in re.findall(r"\]\(([^)]+\.png)\)", body):
        assert (PAPER / picture).is_file()


def test_sections_that_are_asked_for_are_there():
    text = (PAPER / "paper.md").read_text("utf-8")
    for section in ("Summary", "Statement of need", "State of the field", "References"):
        assert f"\n# {section}\n" in text
    assert 750 < len(re.findall(r"\w+", text.split("---", 2)[2])) < 1750
