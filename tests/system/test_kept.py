# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What lasts from step to step where nothing moves relative to what carries it.

Each run is walked beside one that makes T, and with it all else, anew in each step.
"""

import numpy as np
import pytest
from compare import outcome, same_run
from marks import all_but
from scenes import QUADRILATERAL, at, box, facet_tags, vectors

import mpm_dolfinx as mpm
from mpm_dolfinx import materials
from mpm_dolfinx.particles.placement import Placement
from mpm_dolfinx.transfer.elements import FiniteElements

LAW = materials.Hencky(1e3, 0.3)


def forgetful(monkeypatch):
    """Let bodies of finite elements make their T anew in each step."""
    rows, go = FiniteElements.rows, Placement.go

    def copied(self, *where):
        found = rows(self, *where)
        basis = found.basis._replace(nodes=found.basis.nodes.copy())
        return found._replace(basis=basis)

    def forgets(self, displacement):
        before = go(self, displacement)
        self.forget_transfer()
        return before

    monkeypatch.setattr(FiniteElements, "rows", copied)
    monkeypatch.setattr(Placement, "go", forgets)


def column(degree=1, left=0.0):
    """Return a body of finite elements with its law and weight, and what holds its foot."""
    mesh = box([left, 0.0], [left + 1.0, 1.0], [4, 4], QUADRILATERAL)
    body = mpm.Particles(mesh, degree=degree)
    own = mpm.Body(body, LAW, density=1.0, body_force=(2.0, -10.0))
    return own, mpm.held(body.W, where=at(1, 0.0))


def on_it(carried):
    """Return a softer body upon the column, and the pair of both."""
    mesh = box([0.2, 1.0], [0.7, 1.5], [4, 4], QUADRILATERAL)
    V = vectors(box([-1.03, 0.4], [2.97, 2.4], [16, 8], QUADRILATERAL)) if carried else None
    body = mpm.Particles(mesh, V, quadrature_degree=2)
    return mpm.Body(body, LAW, density=1.0, body_force=(3.0, -10.0))


def stages(directory):
    own, foot = column(2)
    side = mpm.held(own.particles.W, 0, where=at(0, 0.0))
    problem = mpm.QuasiStaticProblem(own, bcs=[foot, side])
    problem.solve(2)
    problem.stage("side free", bcs=[foot])
    problem.solve(2)
    tags = facet_tags(own.particles.mesh, at(0, 1.0))
    wall = mpm.boundary.roller(own.particles, tags, 1, normal=(1.0, 0.0), modulus=1e3)
    problem.stage("a wall", supports=[wall])
    problem.solve(2)
    problem.stage("side held", bcs=[foot, side], supports=[])
    problem.solve(2)
    return problem


def removed(directory):
    own, foot = column()
    problem = mpm.QuasiStaticProblem(own, bcs=[foot])
    problem.solve(2)
    for level in (0.75, 0.5):
        problem.remove(lambda x, level=level: (x[0] > 0.5) & (x[1] > level))
        problem.solve(2)
    problem.stage("more weight", problem.body().replace(body_force=(4.0, -20.0)))
    problem.solve(1)
    return problem


def rubs(directory, carried=False, repartition=None):
    below, foot = column()
    above = on_it(carried)
    V = above.particles.V
    push = mpm.held(V, value=(0.4, -0.03), where=lambda x: x[1] > 1.39)
    pair = mpm.contact.Pair(above.particles, below.particles, friction=0.2)
    problem = mpm.QuasiStaticProblem([below, above], bcs=[foot, push], terms=[pair])
    steps = problem.steps(6)
    next(steps), next(steps), next(steps)
    if repartition is not None:
        problem.repartition(repartition)
    for _ in steps:
        pass
    problem.stage("lifted", bcs=[foot, mpm.held(V, value=(0.4, 0.02), where=lambda x: x[1] > 1.39)])
    problem.solve(2)
    return problem


def tied(directory):
    below, foot = column()
    above = on_it(False)
    tags = facet_tags(above.particles.mesh, at(1, 1.0))
    tie = mpm.Tie(above.particles, below.particles, tags, 1, stiffness=1e5)
    hold = mpm.held(above.particles.W, where=at(1, 1.5))
    problem = mpm.QuasiStaticProblem([below, above], bcs=[foot, hold], terms=[tie])
    problem.solve(2)
    problem.stage("let go", terms=[])
    problem.solve(2)
    problem.stage("tied again", terms=[tie])
    problem.solve(2)
    return problem


def moves(directory):
    own, foot = column(2)
    problem = mpm.DynamicProblem(own, bcs=[foot])
    problem.solve(time=0.1, dt=0.02)
    more, its_foot = column(left=2.0)
    problem.add(more)
    problem.stage("held", bcs=[foot, its_foot])
    problem.solve(time=0.14, dt=0.01)
    problem.stage("let go", bcs=[its_foot])
    problem.solve(time=0.2, dt=0.02)
    return problem


def goes_on(directory):
    def made():
        own, foot = column(2)
        return mpm.DynamicProblem(own, bcs=[foot])

    problem, path = made(), directory / "state"
    problem.solve(time=0.1, dt=0.02)
    problem.save(path)
    problem.solve(time=0.2, dt=0.05)
    problem.restore(path)
    problem.solve(time=0.2, dt=0.02)
    return problem


def chosen(directory, free=()):
    mesh = box([0.0, 0.0], [1.0, 1.0], [8, 8], QUADRILATERAL)
    V = vectors(box([-1.03, 0.0], [2.97, 2.0], [16, 8], QUADRILATERAL))
    body = mpm.Particles(mesh, V, quadrature_degree=2, free=free)
    own = mpm.Body(body, LAW, density=1.0, body_force=(3.0, -20.0))
    problem = mpm.QuasiStaticProblem(own, bcs=[mpm.held(V, where=at(1, 0.0))])
    if free == "auto":
        problem.solve(6)
        return problem
    for where in (at(0, 0.0), at(1, 1.0), []):
        body.free = where
        problem.stage(None, problem.body().replace(body_force=(2.0, -10.0)))
        problem.solve(2)
    return problem


RUNS = {
    "stages": stages,
    "remove": removed,
    "contact": rubs,
    "contact with a carried body": lambda d: rubs(d, True),
    "repartition": lambda d: rubs(d, True, 0.0),
    "tie": tied,
    "motion": moves,
    "restart": goes_on,
    "free nodes": chosen,
    "as long as they last": lambda d: chosen(d, "auto"),
}


@pytest.mark.parametrize("run", all_but(RUNS.keys() - {"contact with a carried body"}, RUNS))
def test_what_lasts_is_what_would_be_made(run, monkeypatch, mpi_tmp_path):
    kept = RUNS[run](mpi_tmp_path)
    with monkeypatch.context() as changed:
        forgetful(changed)
        anew = RUNS[run](mpi_tmp_path)
    assert max(np.abs(body.displacement.x.array).max(initial=0.0) for body in kept.bodies) > 1e-3
    same_run(outcome(kept), outcome(anew), 1e-9)
