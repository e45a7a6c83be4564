# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Numbers in README.md are those that were measured last."""

from pathlib import Path

import programs
import pytest

SCRIPT = Path(__file__).parents[2] / "scripts" / "readme_numbers.py"


@pytest.mark.skip_in_parallel
def test_the_table_of_the_readme_follows():
    done = programs.run(SCRIPT, "--check")
    assert done.returncode == 0, done.stderr


@pytest.mark.skip_in_parallel
def test_tables_of_the_documentation_come_from_somewhere():
    """Whether they are new is what ``make studies ARGS=--check`` tells."""
    make = Path(__file__).parents[2] / "docs" / "studies" / "make.py"
    done = programs.run(make, "--still")
    assert done.stdout, done.stderr
    *told, total = done.stdout.splitlines()
    assert int(total.split()[0]) > 80
    late = (
        "have changed since it was made",
        "no comment says where its numbers come from",
        "it has not been made yet",
    )
    assert not [line for line in told if not line.endswith(late)]
