# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The demos: each is a lecture note that runs by itself, and ends with a check and a picture."""

import ast
import re
import shutil
import statistics
import subprocess
import sys
from pathlib import Path

import programs
import pytest
from marks import all_but

DEMOS = Path(__file__).parents[2] / "demos"
NAMES = sorted(path.stem for path in DEMOS.glob("*.py"))
#: Those of a second or two, which ``make test`` runs.
SHORT = ("demo_column_roller", "demo_gmsh_body")


KEPT = DEMOS.parent / "docs" / "images" / "demos"
NUMBER = re.compile(r"-?\d+(?:\.\d*)?(?:e[+-]?\d+)?")


@pytest.mark.skip_in_parallel
@pytest.mark.parametrize("name", NAMES)
def test_text_is_a_lecture_note(name):
    text = (DEMOS / f"{name}.py").read_text("utf-8")
    assert re.search(r"^# Level: [123]\.\d+: .{20,80}$", text, re.MULTILINE)
    assert "# It illustrates how to:\n" in text
    assert "\nassert " in text and "\n# ## Exercises\n" in text
    assert "argparse" not in text
    assert len(text.splitlines()) <= 180


@pytest.mark.skip_in_parallel
@pytest.mark.parametrize("name", NAMES)
def test_each_exercise_has_its_answer(name):
    asked = (DEMOS / f"{name}.py").read_text("utf-8").partition("\n# ## Exercises\n")[2]
    answers = (DEMOS.parent / "docs" / "answers.md").read_text("utf-8")
    title = rf"^### .+ \{{ #{name.removeprefix('demo_')} \}}\n+"
    found = re.search(title + r"(.+?)(?=^##|\Z)", answers, re.MULTILINE | re.DOTALL)
    assert found is not None
    assert re.findall(r"^(\d)\. ", found[1], re.MULTILINE) == re.findall(
        r"^# (\d)\. ", asked, re.MULTILINE
    )


@pytest.mark.skip_in_parallel
@pytest.mark.parametrize("name", NAMES)
def test_code_fits_into_the_80_columns_of_a_page(name):
    """Pages have code formatted anew; what the formatter cannot break is too long."""
    ruff = shutil.which("ruff", path=str(Path(sys.executable).parent)) or shutil.which("ruff")
    if ruff is None:
        pytest.skip("ruff formats what pages show")
    done = subprocess.run(
        [ruff, "format", "--isolated", "--line-length=80", "-"],
        input=(DEMOS / f"{name}.py").read_text("utf-8"),
        capture_output=True,
        encoding="utf-8",
        check=True,
    )
    # Text stands apart from code; a comment right above code is shown with it.
    parts = [part.splitlines() for part in re.split(r"\n{2,}", done.stdout)]
    code = [part for part in parts if not all(line.startswith("#") for line in part)]
    assert not [line for part in code for line in part if len(line) > 80]


@pytest.mark.skip_in_parallel
def test_demos_are_short():
    lines = [len((DEMOS / f"{name}.py").read_text("utf-8").splitlines()) for name in NAMES]
    assert statistics.median(lines) < 120


def agrees(found, kept):
    """Return whether two outputs have the same words, and numbers that differ by less than 5 %."""
    if NUMBER.sub("#", found).split() != NUMBER.sub("#", kept).split():
        return False
    pairs = zip(NUMBER.findall(found), NUMBER.findall(kept), strict=True)
    numbers = [(float(a), float(b)) for a, b in pairs]
    return all(abs(a - b) <= 0.05 * abs(b) or max(abs(a), abs(b)) < 1e-7 for a, b in numbers)


@pytest.mark.skip_in_parallel
@pytest.mark.parametrize("name", NAMES)
def test_stands_alone(name):
    tree = ast.parse((DEMOS / f"{name}.py").read_text("utf-8"))
    imported = {
        module
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for module in (
            [node.module] if isinstance(node, ast.ImportFrom) else [a.name for a in node.names]
        )
    }
    assert not any(module.startswith("mpm_dolfinx.") or "demo" in module for module in imported)
    assert not imported & {"argparse", "json", "sys"}


@pytest.mark.skip_in_parallel
@pytest.mark.parametrize("name", all_but(SHORT, NAMES))
def test_runs_and_meets_its_own_assertions(name, tmp_path):
    # In a process of its own, from a directory of its own, where it leaves its picture.
    if name == "demo_gmsh_body":
        pytest.importorskip("gmsh", exc_type=(ImportError, OSError))
    done = programs.run(DEMOS / f"{name}.py", cwd=tmp_path, MPLBACKEND="agg")
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() and "Exception ignored" not in done.stderr
    picture = (tmp_path / f"{name.removeprefix('demo_')}.png").read_bytes()
    kept = (KEPT / f"{name.removeprefix('demo_')}.txt").read_text("utf-8")
    assert agrees(done.stdout, kept), f"python scripts/run_demos.py {name[5:]}, and look at it"
    assert picture[:8] == b"\x89PNG\r\n\x1a\n" and len(picture) > 5000
