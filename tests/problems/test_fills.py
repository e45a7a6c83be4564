# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Fills of soil without dilation on soft clay: they stand, and what fails is told by its cause."""

import warnings

import pytest
from marks import thinned
from posed import posed
from scenes import QUADRILATERAL, WORLD, at, box, fix, vectors

import mpm_dolfinx as mpm
from mpm_dolfinx import materials
from mpm_dolfinx.stepping import control

GRAVITY = (0.0, -10.0)


def fill(lifts, rows, cutoff=None, **options):
    """Return an embankment of height 2 and slope 1:2 (kPa, m, t), built in lifts."""
    V = vectors(box([0, 0], [26, 9], [26, 9], QUADRILATERAL))
    problem = posed(
        mpm.QuasiStaticProblem,
        mpm.Particles(box([0, 0], [26, 6], [52, 12], QUADRILATERAL), V),
        materials.Tresca(4500.0, 0.49, cohesion=15.0),
        density=1.6,
        body_force=GRAVITY,
        bcs=[fix(V, at(0, 0, 26), component=0), *(fix(V, at(1, 0), component=i) for i in (0, 1))],
        f_bar="patch",
        initial_stress=mpm.geostatic(6.0, 1.6, 0.8, GRAVITY),
        **options,
    )
    problem.solve()
    given = {} if cutoff is None else {"tension_cutoff": cutoff}
    soil = materials.MohrCoulomb(2e4, 0.3, cohesion=2.0, friction_angle=32.0, **given)
    height = 2.0 / lifts
    for k in range(lifts):
        lift = box([0, 0], [1, 1], [16, rows], QUADRILATERAL)
        x = lift.geometry.x
        x[:, 1] = 6.0 + height * (k + x[:, 1])
        x[:, 0] *= 4.0 + 2.0 * (8.0 - x[:, 1])
        heap = mpm.Body(
            mpm.Particles(lift, V), soil, density=1.9, body_force=GRAVITY, f_bar="patch"
        )
        problem.add(heap)
        problem.solve(3)
    return problem


@pytest.mark.parametrize(("lifts", "seconds", "solves"), thinned(2, [(1, 0, 30), (2, 1, 60)]))
def test_what_a_prediction_is_too_far_from_is_found(lifts, seconds, solves):
    """Newton's method goes forward over folds; where it goes round still, it begins at zero."""
    problem = fill(lifts, 4 // lifts, stabilisation=None)
    assert problem.history.cutbacks == 0
    assert problem.history.statistics["second_attempts"] >= seconds
    assert problem.history.total_iterations <= solves


def test_a_node_that_is_hardly_held_is_named(monkeypatch):
    """The toe of a lift hangs on a node of weight 2e-7, as it is a row of cells too high."""
    monkeypatch.setattr(control, "MOST_HALVINGS", 3)  # no smaller step helps
    cause = "the background's node near (7.0, 8.0) is held by next to nothing (a weight of"
    try:
        problem = fill(4, 1, stabilisation=None)
    except mpm.ConvergenceError as error:  # by another round-off it ends there already
        assert cause in str(error)
        return
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = mpm.strength_reduction(problem, tolerance=0.05)
    assert found.reason == "no convergence" and found.factor < 1.5
    assert found.displacements[-1] < 0.01
    assert cause in str(found.failure)
    if WORLD.rank == 0:
        assert "may be too low" in str(caught[-1].message) and cause in str(caught[-1].message)
    assert "limit load" not in str(found.failure)


@pytest.mark.parametrize(
    ("lifts", "rows", "cutoff"),
    [*thinned(3, [(4, 1, None), (4, 1, 0.0), (4, 2, None), (3, 1, None)])],
)
def test_lifts_are_built_by_default(lifts, rows, cutoff):
    """What next to nothing holds follows the cell below: none stops at a toe that is let loose."""
    problem = fill(lifts, rows, cutoff)
    assert problem.history.cutbacks == 0
    assert problem.history.total_iterations < 60
