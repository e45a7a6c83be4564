# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Problems and particles that end while an exception is on its way: nothing hangs after it."""

from pathlib import Path

import programs
import pytest
from scenes import WORLD

BEGINNING = """
import faulthandler
faulthandler.dump_traceback_later(400, exit=True)
import sys
sys.path.insert(0, {tests!r})
import scenes
import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky

def particles():
    V = scenes.vectors(scenes.box([0.0, -1.0], [2.0, 2.0], [4, 6], scenes.QUADRILATERAL))
    return mpm.Particles(scenes.unit(2, scenes.QUADRILATERAL), V, quadrature_degree=2)

def refused(call, error):
    try:
        call()
    except error as caught:
        return print(str(caught))
    raise AssertionError("no error")

"""
ENDS = {
    # What Python refuses to call drops the only reference to its arguments, or to the object.
    "constructor": "refused(lambda: mpm.QuasiStaticProblem(particles(), bodyforce=1), TypeError)",
    "method": (
        "refused(lambda: mpm.QuasiStaticProblem(mpm.Body(particles(), Hencky(1e3, 0.3)))"
        ".solve(stepps=1), TypeError)"
    ),
    "half built": (
        "foo = mpm.Solver(petsc_options={'pc_type': 'foo'})\n"
        "refused(lambda: mpm.QuasiStaticProblem(mpm.Body(particles(), Hencky(1e3, 0.3)),"
        " solver=foo), mpm.MPMError)\n"
        "refused(lambda: mpm.QuasiStaticProblem(particles(), bodyforce=1), TypeError)"
    ),
}


@pytest.mark.skipif(WORLD.size > 1, reason="starts a process of its own")
@pytest.mark.parametrize("how", ENDS)
def test_what_is_made_after_a_call_that_was_refused(how):
    program = BEGINNING.format(tests=str(Path(__file__).parents[1])) + ENDS[how]
    program += (
        "\nfor _ in range(3):\n"
        "    mpm.QuasiStaticProblem(mpm.Body(particles(), Hencky(1e3, 0.3))).solve(steps=1)\n"
        "print('went on')"
    )
    done = programs.run("-c", program)
    assert done.returncode == 0, done.stderr
    assert "SystemError" not in done.stderr
    told = done.stdout.splitlines()
    assert told[-1] == "went on"
    if how != "method":
        assert "unexpected keyword argument 'bodyforce'" in told[-2]
