# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Scenes that are measured: particles and stock finite elements on one mesh converge alike."""

import json
from pathlib import Path

import numpy as np
import programs
import pytest

pytestmark = pytest.mark.skip_in_parallel

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
SIZES = {"D": (1, 2), "H": (2, 4), "V": (8, 16)}
ORDERS = {"D": 1.7, "H": 0.4, "V": 1.5}  # H: down to the penalty's own error
RUNS = """
import json
import sys
import finite_elements
import scenes

def ran(scene):
    scene.solve()
    return scene.measure() | scene.account()

rows = {}
for case, sizes in json.loads(sys.argv[1]).items():
    for size in sizes:
        rows[f"particles {case} {size}"] = ran(scenes.CASES[case](size))
        rows[f"elements {case} {size}"] = ran(finite_elements.CASES[case](size, 1))
for parts in json.loads(sys.argv[2]):
    rows[f"elements P {parts}"] = ran(finite_elements.block(2, 1, 4, parts))
    rows["particles P"] = ran(scenes.block(2, steps=4))
rows["limit"] = scenes.BLOCK_FORCE
values = [3.0 + 0.7 * n**-1.3 for n in (2, 3, 5)]
rows["extrapolated"] = finite_elements.extrapolated((2, 3, 5), values)
print(json.dumps(rows))
"""


def rows(cases, parts=()):
    """Run scenes in a process of their own: benchmarks have modules with names of tests."""
    sizes = {case: SIZES[case] for case in cases}
    done = programs.run("-c", RUNS, json.dumps(sizes), json.dumps(parts), cwd=BENCHMARKS)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("case", SIZES)
@pytest.mark.slow
def test_errors_fall_with_the_size_of_cells(case):
    found = rows([case])
    assert found["extrapolated"] == pytest.approx([1.3, 3.0])
    for kind in ("particles", "elements"):
        ran = [found[f"{kind} {case} {size}"] for size in SIZES[case]]
        assert all(row["cutbacks"] == 0 for row in ran)
        errors = [row["error"] for row in ran]
        assert errors[0] < 0.1
        order = np.log(errors[0] / errors[1]) / np.log(SIZES[case][1] / SIZES[case][0])
        assert order > ORDERS[case], kind


@pytest.mark.slow
def test_the_plastic_block_is_as_stiff_as_that_of_finite_elements():
    # the particles' cells are as large as the coarse elements; all are too stiff by their size
    found = rows([], (1, 2))
    coarse, fine = (found[f"elements P {parts}"]["force"] for parts in (1, 2))
    assert found["limit"] < fine < coarse
    assert found["particles P"]["force"] == pytest.approx(coarse, rel=0.1)
