# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The examples of README and documentation run, each page from top to bottom."""

import logging
import re
from pathlib import Path

import numpy as np
import pytest

from mpm_dolfinx.materials import check_tangent, mandel

ROOT = Path(__file__).parents[2]
EXAMPLE = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
PAGES = {
    page.name: page.read_text("utf-8")
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
    if EXAMPLE.search(page.read_text("utf-8"))
}


@pytest.fixture
def logging_as_before():
    """Take back what an example does to the program's logging."""
    loggers = [logging.getLogger(), *map(logging.getLogger, logging.root.manager.loggerDict)]
    before = [(logger, logger.level, logger.handlers[:]) for logger in loggers]
    yield
    for logger, level, handlers in before:
        logger.setLevel(level)
        logger.handlers[:] = handlers


@pytest.mark.skip_in_parallel
@pytest.mark.parametrize("page", PAGES)
def test_examples_of_a_page_run(page, tmp_path, monkeypatch, logging_as_before):
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "__main__"}
    for example in EXAMPLE.finditer(PAGES[page]):
        line = PAGES[page][: example.start()].count("\n") + 1
        exec(compile("\n" * line + example[1], page, "exec"), names)


@pytest.mark.skip_in_parallel
def test_law_by_jax():
    """The example that needs a package of its own, where there is one."""
    pytest.importorskip("jax", reason="the example is of a law that JAX differentiates")
    example = re.search(r"^```py\n(.*?)^```", PAGES["law-contract.md"], re.MULTILINE | re.DOTALL)
    names = {"__name__": "__main__"}
    exec(compile(example[1], "law-contract.md", "exec"), names)
    for dim in (2, 3):
        assert names["check_tangent"](names["rubber"], dim=dim, strain=0.1) < 1e-8


@pytest.mark.skip_in_parallel
def test_a_run_on_the_tape():
    """The example that needs dolfinx-adjoint, after those before it on its page."""
    pytest.importorskip("dolfinx_adjoint", reason="the example is of its tape")
    pyadjoint = pytest.importorskip("pyadjoint")
    page, of = PAGES["gradients.md"], re.MULTILINE | re.DOTALL
    blocks = re.findall(r"^```py(?:thon)?\n(.*?)^```", page, of)
    names = {"__name__": "__main__"}
    with pyadjoint.set_working_tape(pyadjoint.Tape()):
        for block in blocks[: next(i for i, b in enumerate(blocks) if "mpm.taped" in b) + 1]:
            exec(compile(block, "gradients.md", "exec"), names)
        pyadjoint.pause_annotation()
    assert (names["slope"].x.array < 0.0).all()  # stiffer is nearer


@pytest.mark.skip_in_parallel
def test_law_by_numba():
    """The loop that numba compiles, beside the same law in NumPy, where there is numba."""
    pytest.importorskip("numba", reason="the example is of a law that numba compiles")
    pages = PAGES["own-laws.md"] + PAGES["law-contract.md"]
    blocks = re.findall(r"^```py(?:thon)?\n(.*?)^```", pages, re.MULTILINE | re.DOTALL)
    by_numba = {"__name__": "__main__"}
    by_numpy = {"np": np, "mandel": mandel, "check_tangent": check_tangent}
    exec(next(b for b in blocks if "class CompiledClay" in b), by_numba)
    exec(next(b for b in blocks if "class SofteningClay" in b), by_numpy)
    for m in (4, 6):
        strain = 0.05 * np.random.default_rng(m).standard_normal((50, m))
        names = ((by_numba, "CompiledClay"), (by_numpy, "SofteningClay"))
        one, other = (n[law](2e6, 1e6, 0.05).integrate(strain, {}, True) for n, law in names)
        np.testing.assert_allclose(one.stress, other.stress, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(one.tangent, other.tangent, rtol=0.0, atol=1e-8)
