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


@pytest.mark.skip_in_parallel
def test_a_table_is_stale_by_what_its_rows_are_made_of(tmp_path):
    shutil.copytree(ROOT / "docs", tmp_path / "docs", ignore=shutil.ignore_patterns("images"))
    shutil.copytree(ROOT / "benchmarks" / "cases", tmp_path / "benchmarks" / "cases")

    def edit(path, old, new):
        text = (tmp_path / path).read_text("utf-8")
        assert text.count(old) == 1
        (tmp_path / path).write_text(text.replace(old, new), "utf-8")

    study, case = "docs/studies/validation.py", "benchmarks/cases/pipe.py"
    program = """
import ingredients, validation
for table in validation.tables().values():
    print(*(ingredients.of_row(table, label) for label in table.rows))
"""

    def hashes():
        # (bytecode of a file that is edited within a second at the same size looks up to date)
        studies = tmp_path / "docs" / "studies"
        done = programs.run("-c", program, cwd=studies, PYTHONDONTWRITEBYTECODE="1")
        assert done.returncode == 0, done.stderr
        return [line.split() for line in done.stdout.splitlines()]

    def changed(before, after):
        return [
            sum(a != b for a, b in zip(*rows, strict=True))
            for rows in zip(before, after, strict=True)
        ]

    before = hashes()
    assert sum(map(len, before)) > 30
    edit(study, "\nCLAMPED = ", "\n# One more comment.\nCLAMPED = ")
    edit(study, '"""Return a relative error, in percent', '"""Return an error, in percent')
    edit(case, "# SPDX-License-Identifier", "# A licence\n# SPDX-License-Identifier")
    assert hashes() == before
    edit(study, "incline --tilt 30 --steps 20", "incline --tilt 30 --steps 25")
    one = hashes()
    assert changed(before, one) == [1, 0, 0, 0, 0, 0]
    with (tmp_path / case).open("a", encoding="utf-8") as file:
        file.write("\nCELLS = 1\n")
    two = hashes()
    assert changed(one, two) == [0, 0, 2, 0, 0, 0]
    edit(study, "if abs(share) >= 5e-5", "if abs(share) >= 6e-5")
    assert changed(two, hashes()) == [len(rows) for rows in two]
