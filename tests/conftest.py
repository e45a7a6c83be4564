# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Ranks in step, one rank that reports, and a directory that all ranks see.

Under mpirun the ranks agree on each test's outcome: a test that fails on any rank fails on
all, and rank 0 reports it with the other ranks' messages. The messages of this file have a
communicator of their own, so that they cannot be mistaken for a test's.
"""

from __future__ import annotations

import contextlib
import gc
import io
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest
from marks import between_ranks
from programs import patient_compilers, read_headers, remembered_forms, whole_forms

comm = MPI.COMM_WORLD.Dup()

# How long a rank on which a test failed waits for the others, which may be stuck in a
# collective call that it will never reach. (Other hangs: faulthandler_timeout.)
PATIENCE = 30.0

OUTCOMES = ("passed", "skipped", "failed")


class State:
    """What this rank knows of the run."""

    out_of_step = False
    quiet = io.StringIO()
    collection_errors: tuple[str, ...] = ()


def gather(value: int, patience: float | None) -> np.ndarray | None:
    """Return the value of each rank, or None where they do not come in time."""
    mine = np.array([value], dtype=np.int32)
    values = np.empty(comm.size, dtype=np.int32)
    request = comm.Iallgather(mine, values)
    start = time.monotonic()
    while not request.Test():
        waited = time.monotonic() - start
        if patience is not None and waited > patience:
            return None
        time.sleep(min(1e-3, waited))
    return values


@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    """Let rank 0 alone report."""
    ranks = int(os.environ.get("MPM_DOLFINX_RANKS", comm.size))
    if ranks != comm.size:
        pytest.exit(
            f"{comm.size} MPI rank(s) where {ranks} were asked for: "
            "the launcher does not belong to the MPI library of mpi4py",
            returncode=4,
        )
    with contextlib.ExitStack() as stack:
        if comm.rank == 0:
            stack.enter_context(whole_forms())
            read_headers()
        comm.Barrier()
        stack.enter_context(patient_compilers())
        stack.enter_context(remembered_forms())
        config.add_cleanup(stack.pop_all().close)
    if comm.rank > 0:
        config.pluginmanager.unregister(name="terminalreporter")
        reporter = pytest.TerminalReporter(config, State.quiet)
        config.pluginmanager.register(reporter, "terminalreporter")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--between-ranks",
        action="store_true",
        help="leave out what ranks have nothing to do with each other in (marks.between_ranks)",
    )


@pytest.hookimpl(trylast=True)  # of those that are not slow
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("between_ranks"):
        items[:], others = between_ranks(items, comm.size)
        config.hook.pytest_deselected(items=others)


def pytest_report_header() -> str:
    petsc = ".".join(str(i) for i in PETSc.Sys.getVersion())
    return f"MPI: {comm.size} rank(s); PETSc {petsc}"


def pytest_collectreport(report: pytest.CollectReport) -> None:
    if report.failed:
        State.collection_errors += (report.longreprtext,)


@pytest.hookimpl(trylast=True)
def pytest_collection_finish(session: pytest.Session) -> None:
    """Stop where the ranks collected different tests: they would wait for each other."""
    gc.collect()
    gc.freeze()  # what is there already need not be looked through after each test
    if comm.size == 1:
        return
    tests = comm.allgather([item.nodeid for item in session.items])
    errors = comm.allgather(State.collection_errors)
    if any(t != tests[0] for t in tests) or len({len(e) for e in errors}) > 1:
        found = [f"rank {r}: {len(t)} tests" for r, t in enumerate(tests)]
        found += [f"rank {r}: {text}" for r, texts in enumerate(errors) for text in texts]
        pytest.exit("the ranks collected different tests\n" + "\n".join(found), returncode=2)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    if comm.size > 1 and item.get_closest_marker("skip_in_parallel"):
        pytest.skip("runs on one rank only")
    if comm.size == 1 and item.get_closest_marker("mpi"):
        pytest.skip("needs two ranks or more")


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport(
    item: pytest.Item,
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Agree on the outcome of a phase (set-up, call, teardown)."""
    report = yield
    if comm.size > 1 and not State.out_of_step:
        agree(item, report)
    return report


def agree(item: pytest.Item, report: pytest.TestReport) -> None:
    """Make this rank's outcome the worst of all ranks' (collective)."""
    outcomes = gather(OUTCOMES.index(report.outcome), PATIENCE if report.failed else None)
    if outcomes is None:
        State.out_of_step = True
        reason = f"rank {comm.rank} failed and the others did not follow in {PATIENCE:.0f} s"
        report.sections.append(("MPI", f"{reason}: they are stuck in this test"))
        item.session.shouldfail = f"{reason}, so the run ends here"
        return
    worst = OUTCOMES[outcomes.max()]
    if worst == "failed":
        texts = comm.allgather(report.longreprtext if report.failed else None)
        failures = {r: text for r, text in enumerate(texts) if text is not None}
        if not report.failed:
            rank = min(failures)
            report.outcome = "failed"
            text = failures.pop(rank)
            report.longrepr = f"failed on rank {rank}, not on rank {comm.rank}\n{text}"
        for rank, text in failures.items():
            if rank != comm.rank:
                report.sections.append((f"failure of rank {rank}", text))
    elif worst == "skipped" and report.passed:
        report.outcome = "skipped"
        report.longrepr = (str(item.path), item.location[1], "skipped on another rank")


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> Generator[None]:
    """Destroy what a test left, on all ranks together: destructors may be collective."""
    try:
        return (yield)
    finally:
        # A failed test's traceback keeps its objects alive.
        for name in ("last_exc", "last_traceback", "last_type", "last_value"):
            sys.__dict__.pop(name, None)
        if not State.out_of_step:
            gc.collect()
            if nextitem is None or nextitem.path != item.path:
                gc.freeze()  # modules and forms that it loaded, as after the collection of tests
            PETSc.garbage_cleanup()
            MPI.COMM_WORLD.Barrier()


@pytest.hookimpl(trylast=True)
def pytest_unconfigure() -> None:
    """End ranks that are stuck, after the report."""
    if State.out_of_step:
        sys.stdout.write(State.quiet.getvalue())
        sys.stdout.flush()
        sys.stderr.flush()
        MPI.COMM_WORLD.Abort(1)


@pytest.fixture
def mpi_tmp_path() -> Iterator[Path]:
    """A directory that is the same on all ranks, made for one test and removed after it."""
    name = tempfile.mkdtemp(prefix="mpm_dolfinx_") if comm.rank == 0 else None
    path = Path(comm.bcast(name))
    yield path
    if not State.out_of_step:
        comm.Barrier()
    if comm.rank == 0:
        shutil.rmtree(path, ignore_errors=True)


@pytest.fixture
def take() -> Iterator[Callable[[str], None]]:
    """A function that lets the rest of a test take a route of assembly."""
    from routes import on_route

    with contextlib.ExitStack() as stack:
        yield lambda route: stack.enter_context(on_route(route))


@pytest.fixture
def route(request: pytest.FixtureRequest, take: Callable[[str], None]) -> None:
    """Let a test take the route that is its parameter."""
    take(request.param)
