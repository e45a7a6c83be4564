# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Forms that another run compiles, or was killed while it compiled them."""

import os
import re
from pathlib import Path

import programs
import pytest
import scenes
from compare import raises
from scenes import WORLD

import ufl

import mpm_dolfinx as mpm
from mpm_dolfinx.parallel.compilation import compiled_form

PACKAGE = Path(mpm.__file__).parent


def half_compiled(cache):
    """Leave a cache as a run that was killed while it compiled does."""
    WORLD.Barrier()
    if WORLD.rank == 0:
        for file in cache.iterdir():
            if file.suffix == ".c":
                os.truncate(file, 0)
            else:
                file.unlink()
    WORLD.Barrier()


def test_a_run_that_was_killed_while_it_compiled(mpi_tmp_path):
    domain = scenes.unit(2, scenes.QUADRILATERAL)
    x = ufl.SpatialCoordinate(domain)
    options = {"jit_options": {"cache_dir": str(mpi_tmp_path), "timeout": 1}}

    def compile_it():
        return compiled_form(x[0] ** 2 * x[1] ** 3 * ufl.dx, **options)

    compile_it()
    half_compiled(mpi_tmp_path)
    file = re.escape(str(mpi_tmp_path)) + r"/libffcx_\w+\.c"
    sentence = rf"killed while it compiled it on .*: .* remove '({file})' and start again; "
    caught = raises(compile_it, mpm.MPMError, sentence)
    if WORLD.rank == 0:
        Path(re.search(sentence, str(caught))[1]).unlink()
    WORLD.Barrier()
    compile_it()


def test_other_errors_of_compilation_are_told_as_they_are(mpi_tmp_path):
    domain = scenes.unit(2, scenes.QUADRILATERAL)
    x = ufl.SpatialCoordinate(domain)
    wrong = {"cache_dir": str(mpi_tmp_path), "cffi_extra_compile_args": ["-no-such-option"]}
    error = "VerificationError" if WORLD.size == 1 else "RuntimeError"
    try:
        compiled_form(x[0] ** 2 * x[1] ** 4 * ufl.dx, jit_options=wrong)
    except Exception as caught:
        told = WORLD.allgather((type(caught).__name__, str(caught)))
    assert set(told) == {told[0]}
    assert told[0][0] == error


@pytest.mark.skip_in_parallel
def test_the_cache_of_tests_has_whole_forms_alone(tmp_path):
    for name in ("a.c", "a.so", f"a{programs.READY}", "b.c"):
        (tmp_path / name).touch()
    with programs.whole_forms(tmp_path):
        kept = {"a.c", "a.so", "a.c.cached", "lock"}
        assert {file.name for file in tmp_path.iterdir()} == kept
        (tmp_path / "c.c").touch()  # which this run compiles now
        with programs.whole_forms(tmp_path):
            assert (tmp_path / "c.c").exists()


def test_all_forms_are_compiled_there():
    calls = re.compile(r"\bfem\.(form|Expression)\(")
    found = {f.name for f in PACKAGE.rglob("*.py") if calls.search(f.read_text("utf-8"))}
    assert found == {"compilation.py"}
