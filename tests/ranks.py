# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What one rank does otherwise than the others, and how to see that all end alike."""

import time

from mpi4py import MPI

import pytest
from scenes import WORLD

import mpm_dolfinx as mpm

LAST = WORLD.rank == WORLD.size - 1
QUIET = MPI.COMM_WORLD.Dup()
PATIENCE = 120.0  # others may compile a form, on a busy machine


def in_step(value):
    """Return the value of each rank; fail where the others do not come in time."""
    request = QUIET.Ibarrier()
    start = time.monotonic()
    while not request.Test():
        assert time.monotonic() - start < PATIENCE, f"the others do not follow: {value}"
        time.sleep(1e-3)
    return QUIET.allgather(value)


def fails(build, sentence, kind=mpm.MPMError):
    """Check that all ranks fail with one sentence, and in time."""
    try:
        build()
        caught = None
    except Exception as error:
        caught = error
    told = in_step(f"{type(caught).__name__}: {caught}")
    assert len(set(told)) == 1, told
    assert type(caught) is kind, told[0]
    with pytest.raises(kind, match=sentence):
        raise caught
    return caught


def differing(usual, other):
    """Return one value on the last rank, and another one elsewhere."""
    return other if LAST else usual
