# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The paper cites what is in its bibliography, and its figures are there."""

import re
from pathlib import Path

import programs
import pytest

ROOT = Path(__file__).resolve().parents[2]
PAPER = ROOT / "paper"


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


@pytest.mark.skip_in_parallel
def test_the_pdf_is_made_and_a_lost_reference_is_told(tmp_path):
    for name in ("pypandoc", "typst"):
        pytest.importorskip(name, reason="the paper needs pip install '.[paper]'")
    done = programs.run(ROOT / "scripts" / "make_paper.py", tmp_path / "paper.pdf")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "paper.pdf").read_bytes()[:5] == b"%PDF-"
    for part in ("paper", "scripts", "docs/images"):
        (tmp_path / part).mkdir(parents=True)
    for path in ("paper/paper.bib", "scripts/make_paper.py", "docs/images/work_precision.png"):
        (tmp_path / path).write_bytes((ROOT / path).read_bytes())
    text = (PAPER / "paper.md").read_text("utf-8")
    (tmp_path / "paper" / "paper.md").write_text(text.replace("[@ample]", "[@nobody]"), "utf-8")
    done = programs.run(tmp_path / "scripts" / "make_paper.py", tmp_path / "other.pdf")
    assert done.returncode != 0 and "nobody" in done.stderr
    assert not (tmp_path / "other.pdf").exists()
