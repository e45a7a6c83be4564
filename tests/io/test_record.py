# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Curves of a bar that is drawn and let back, beside exact ones, and the table of them."""

import numpy as np
import pytest
import scenes

from dolfinx import fem

import mpm_dolfinx as mpm

YOUNG, LENGTH = 1e3, 2.0


def bar():
    """Return a bar of width 1 that its end draws out, its end's value, and a record."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [3.0, 1.0], [6, 2], scenes.QUADRILATERAL))
    body = scenes.box([0.0, 0.0], [LENGTH, 1.0], [8, 4], scenes.TRIANGLE)
    particles = mpm.Particles(body, V)
    drawn = fem.Constant(V.mesh, 0.2)
    end = mpm.held(V, 0, x=(LENGTH, 3.0), value=drawn)
    rest = [mpm.held(V, 0, x=0.0), mpm.held(V, 1, x=(0.0, 3.0))]
    material = mpm.materials.Hencky(YOUNG, 0.0)
    problem = mpm.QuasiStaticProblem(mpm.Body(particles, material), bcs=[end, *rest])
    curve = mpm.Record(
        problem,
        force=lambda: problem.reaction(end)[0],
        tip=lambda: mpm.probe(particles, (LENGTH, 0.5)),
        stress=lambda: mpm.probe(particles, [(0.3, 0.7), (1.6, 0.2)], "stress"),
    )
    return problem, drawn, curve


def test_curves_of_two_runs(mpi_tmp_path):
    problem, drawn, curve = bar()
    wall, tips, yielded = problem.bcs[1], [np.array([0.0, 0.0])], []
    back = problem.steps(2, update=lambda t: setattr(drawn, "value", 0.2 - 0.1 * t))
    for run in (problem.steps(4), back):
        for step in curve.follow(run):
            yielded.append(step)
            tips.append(mpm.probe(problem.particles, (LENGTH, 0.5)))
            assert np.isclose(curve["force"][-1], -problem.reaction(wall)[0], rtol=1e-7)
    assert yielded == problem.history.steps and len(curve["time"]) == 7
    assert list(curve) == ["time", "load", "force", "tip", "stress"]
    for name in ("time", "load"):
        assert np.array_equal(curve[name], [0.0, *(getattr(step, name) for step in yielded)])
    assert np.array_equal(curve["tip"], tips) and curve["stress"].shape == (7, 2, 3, 3)
    assert np.allclose(curve["tip"][:, 0], [0.0, 0.05, 0.1, 0.15, 0.2, 0.15, 0.1], atol=1e-10)
    assert curve["force"][0] == 0.0 and not curve["stress"][0].any()
    stretch = 1.025  # the first step, before the end goes on into the next cell
    exact = YOUNG * np.log(stretch) / stretch  # over an area that stays 1
    assert np.allclose(curve["force"][1], exact, rtol=1e-7)
    assert np.allclose(curve["stress"][1, :, 0, 0], exact, rtol=1e-7)

    curve.write(mpi_tmp_path / "curve.csv")
    table = np.genfromtxt(mpi_tmp_path / "curve.csv", delimiter=",", names=True)
    assert table.dtype.names[:5] == ("time", "load", "force", "tip_0", "tip_1")
    assert len(table.dtype.names) == 5 + 2 * 9
    assert np.array_equal(table["tip_0"], curve["tip"][:, 0])
    assert np.array_equal(table["stress_1_0_0"], curve["stress"][:, 1, 0, 0])


def test_a_step_that_is_halved_is_noted_once_it_has_converged():
    problem, drawn, curve = bar()
    failed = []

    def path(t):
        drawn.value = 0.2 * t
        if t > 0.8 and not failed:
            failed.append(t)
            raise mpm.ConvergenceError("too far")

    for _ in curve.follow(problem.steps(2, update=path)):
        pass
    assert problem.history.cutbacks == 1 and failed == [1.0]
    assert np.allclose(curve["tip"][:, 0], 0.2 * np.array([0.0, 0.5, 0.75, 1.0]), atol=1e-10)


@pytest.mark.parametrize(
    "functions, sentence",
    [
        ({}, "not none"),
        ({"load": lambda: 1.0}, "not load"),
        ({"force": 3.0}, "not force"),
        ({"force": lambda: "much"}, "force of a record is 'much', and no number"),
        ({"force": lambda: None}, "force of a record is None"),
        ({"force": lambda: 1 / 0}, "division by zero"),
    ],
)
def test_what_is_no_record_is_refused(functions, sentence):
    problem, _, _ = bar()
    with pytest.raises((mpm.MPMError, ZeroDivisionError), match=sentence):
        next(mpm.Record(problem, **functions).follow(problem.steps(1)))


def test_a_column_keeps_its_shape():
    problem, _, _ = bar()
    values = iter([1.0, [1.0, 2.0]])
    curve = mpm.Record(problem, force=lambda: next(values))
    with pytest.raises(mpm.MPMError, match=r"shape \(2,\), and had \(\) before"):
        list(curve.follow(problem.steps(2)))
    assert len(curve["force"]) == len(curve["load"]) == 1


def test_a_run_that_goes_on_begins_where_it_was_left(mpi_tmp_path):
    problem, _, curve = bar()
    for step in curve.follow(problem.steps(4)):
        if step.load == 0.5:
            problem.save(mpi_tmp_path / "half.npz")
            break
    assert np.array_equal(curve["load"], [0.0, 0.25, 0.5])
    again, _, rest = bar()
    again.restore(mpi_tmp_path / "half.npz")
    list(rest.follow(again.steps(4)))
    assert np.array_equal(rest["load"], [0.5, 0.75, 1.0])
    for name in curve:
        assert np.array_equal(rest[name][0], curve[name][-1])
    list(curve.follow(problem.steps(2)))  # from where the loop was left: no row twice
    assert np.array_equal(curve["load"], [0.0, 0.25, 0.5, 0.75, 1.0])


def test_what_is_not_known_before_the_first_step_is_no_number():
    problem, _, _ = bar()
    history = problem.history
    curve = mpm.Record(problem, solves=lambda: [history.steps[-1].iterations, len(history.steps)])
    list(curve.follow(problem.steps(2)))
    assert curve["solves"].shape == (3, 2) and np.isnan(curve["solves"][0]).all()
    exact = np.column_stack([history.iterations, [1, 2]])
    assert np.array_equal(curve["solves"][1:], exact)


@pytest.mark.mpi
def test_ranks_must_note_the_same():
    problem, _, _ = bar()
    comm = problem.particles.mesh.comm
    curve = mpm.Record(problem, force=lambda: float(comm.rank))
    if comm.size == 1:
        assert len(list(curve.follow(problem.steps(1)))) == 1
        return
    with pytest.raises(mpm.MPMError, match="force differs between the ranks"):
        list(curve.follow(problem.steps(1)))
