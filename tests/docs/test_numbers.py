# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Numbers in README.md are those that were measured last."""

import shutil
from pathlib import Path

import programs
import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "scripts" / "readme_numbers.py"


@pytest.mark.skip_in_parallel
def test_the_table_of_the_readme_follows():
    done = programs.run(SCRIPT, "--check")
    assert done.returncode == 0, done.stderr


@pytest.mark.skip_in_parallel
def test_tables_of_the_documentation_come_from_somewhere():
    """Whether they are new is what ``make studies ARGS=--check`` tells."""
    done = programs.run(ROOT / "docs" / "studies" / "make.py", "--still")
    assert done.stdout, done.stderr
    *told, total = done.stdout.splitlines()
    assert int(total.split()[0]) > 80
    late = (
        "have changed since it was made",
        "no comment says where its numbers come from",
        "it has not been made yet",
    )
    assert not [line for line in told if not line.endswith(late)]


@pytest.mark.skip_in_parallel
def test_one_table_of_a_page_is_stamped(tmp_path):
    shutil.copytree(ROOT / "docs", tmp_path / "docs", ignore=shutil.ignore_patterns("images"))
    (tmp_path / "benchmarks").symlink_to(ROOT / "benchmarks")
    page = tmp_path / "docs" / "dynamics-measured.md"
    lines = page.read_text("utf-8").splitlines()
    marks = [i for i, text in enumerate(lines) if text.startswith("<!-- table by benchmarks/")]
    assert len(marks) > 1
    for i in marks:
        lines[i] = lines[i].rsplit(":", 1)[0] + ": 00000000 00000000 -->"
    page.write_text("\n".join(lines) + "\n", "utf-8")
    program = f"""
import make
make.stamp("docs/dynamics-measured.md:{marks[1] + 3}")
make.stamp("docs/dynamics-measured.md")
"""
    done = programs.run("-c", program, cwd=tmp_path / "docs" / "studies")
    told = "'docs/dynamics-measured.md' names 0 tables where one is stamped.\n"
    assert told in done.stderr, done.stderr
    stamped = page.read_text("utf-8").splitlines()
    assert [i for i, text in enumerate(stamped) if text != lines[i]] == marks[1:2]
