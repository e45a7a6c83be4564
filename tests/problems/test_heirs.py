# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""An heir of a problem class, with a term and a kept state of its own."""

import numpy as np
import pytest
import scenes
from compare import outcome, same_run
from scenes import QUADRILATERAL

import ufl
from dolfinx import fem, la
from dolfinx.fem import petsc as fem_petsc

import mpm_dolfinx as mpm
from mpm_dolfinx.io import Column, Kept, fill, of_cells
from mpm_dolfinx.materials import VonMises

BEDDING = 40.0


class Bedding(mpm.Term, Kept):
    """Springs in the volume that give way: half of their stretch is gone after each step."""

    key = "bedding"
    movable = remeshable = True

    def __init__(self, particles):
        super().__init__([particles])
        self.anchor = fem.Function(particles.W)
        self.form = None

    @property
    def symmetric(self):
        return True

    def kept(self):
        return [self]

    def columns(self, body):
        return {} if body is None else {"anchor": Column(of_cells(self.anchor), "nodes")}

    def restore(self, taken):
        (columns, _) = taken.columns
        self.anchor = fem.Function(self.bodies[0].W)
        fill(self.anchor, columns["anchor"])
        self.form = None

    def begin(self):
        (body,) = self.bodies
        if self.form is None or self.anchor.function_space is not body.W:
            u, v = ufl.TrialFunction(body.W), ufl.TestFunction(body.W)
            stretch = body.displacement - self.anchor
            self.form = fem.form(BEDDING * ufl.inner(stretch, v) * body.dx_exact)
            self.K = fem_petsc.assemble_matrix(fem.form(BEDDING * ufl.inner(u, v) * body.dx_exact))
            self.K.assemble()
            self.r = self.K.createVecLeft()
        return ()

    def residuals(self):
        vector = fem.assemble_vector(self.form)
        vector.scatter_reverse(la.InsertMode.add)
        self.r.array[:] = vector.array[: len(self.r.array)]
        return [self.r]

    def tangents(self):
        return {(0, 0): self.K}

    def smooth(self):
        return True

    def commit(self):
        d = self.bodies[0].displacement.x.array
        self.anchor.x.array[:] += 0.5 * (d - self.anchor.x.array)


class Bedded(mpm.QuasiStaticProblem):
    """A problem that brings its own term, and counts its steps."""

    def __init__(self, body, **options):
        self.bedding = Bedding(body.particles)
        self.count = 0
        super().__init__(body, terms=[self.bedding], **options)
        self.keep(Count(self))

    def commit(self):
        super().commit()
        self.count += 1


class Count(Kept):
    """The number of steps of a problem."""

    key = "count"

    def __init__(self, problem):
        self.problem = problem

    def numbers(self):
        return {"count": self.problem.count}

    def restore(self, taken):
        self.problem.count = taken.numbers["count"]


def made():
    V = scenes.vectors(scenes.box([0.0, -0.5], [2.0, 1.5], [8, 8], QUADRILATERAL))
    body = scenes.box([0.0, 0.0], [0.75, 0.75], [6, 6], QUADRILATERAL)
    law = VonMises(1e3, 0.3, rho_y=20.0, hardening=100.0)
    return Bedded(
        mpm.Body(mpm.Particles(body, V), law, density=1.0, body_force=(0.0, -60.0)),
        bcs=[scenes.fix(V, scenes.at(0, 0.0))],
        solver=mpm.Solver(petsc_options={"snes_rtol": 1e-12}),
    )


def anchors(problem):
    return scenes.in_order(problem.particles, of_cells(problem.bedding.anchor))


@pytest.mark.filterwarnings("ignore:The domains have one")
def test_an_heir_goes_on_on_other_meshes_and_from_files(mpi_tmp_path):
    whole, other = made(), made()
    for number, _ in enumerate(whole.steps(4)):
        if number == 1:
            whole.save(mpi_tmp_path / "whole.ckpt")
    assert whole.count == 4 and type(whole) is Bedded
    # Saved and restored, and moved to other ranks on the way.
    other.restore(mpi_tmp_path / "whole.ckpt")
    assert other.count == 2
    other.repartition(0.0)
    other.solve(steps=4)
    assert other.count == 4
    same_run(outcome(other), outcome(whole), 1e-9)
    np.testing.assert_allclose(anchors(other), anchors(whole), atol=1e-11)

    # Split and rebased between steps: anchors stay where they are, the motion is about the same.
    cut = made()
    for number, _ in enumerate(cut.steps(4)):
        if number == 1:
            before = anchors(cut)
            cut.split([3, 20])
            assert cut.particles.num_global == 38
            kept = np.setdiff1d(np.arange(36), [3, 20])
            assert np.array_equal(anchors(cut)[kept], before[kept])
            assert {tuple(a) for cell in anchors(cut)[[3, 20, 36, 37]] for a in cell} == {
                tuple(a) for cell in before[[3, 20]] for a in cell
            }
        if number == 2:
            cut.save(mpi_tmp_path / "cut.ckpt")
    assert cut.count == 4 and type(cut) is Bedded and cut.terms == [cut.bedding]
    sag, wanted = (np.abs(anchors(p)[:36]).max() for p in (cut, whole))
    assert sag == pytest.approx(wanted, rel=0.02) and wanted > 1e-3
    resumed = made()
    resumed.restore(mpi_tmp_path / "cut.ckpt")
    assert resumed.count == 3
    resumed.solve(steps=4)
    same_run(outcome(resumed), outcome(cut), 1e-9)
    np.testing.assert_allclose(anchors(resumed), anchors(cut), atol=1e-11)

    # Rebased: displacements, and with them anchors, are counted from new positions.
    total = scenes.in_order(cut.particles, cut.particles.domains)
    cut.rebase()
    assert cut.count == 4
    now = scenes.in_order(cut.particles, cut.particles.domains)
    np.testing.assert_allclose(now, total, atol=1e-14)
    assert not cut.particles.displacement.x.array.any()
    assert len(anchors(cut)) == 38


def test_what_is_derived_from_what_all_problems_have_is_refused():
    with pytest.raises(mpm.MPMError, match="derive it from mpm"):
        type("Own", (mpm.Problem,), {})


def test_a_stage_within_a_reduction_of_strength_is_refused():
    class Own(mpm.QuasiStaticProblem):
        acts = False

        def end_step(self):
            if self.acts:
                self.acts = False
                self.stage("within", self.body().replace(body_force=(0.0, -5.0)))

    V = scenes.vectors(scenes.box([0, 0], [2.25, 1.25], [9, 5], QUADRILATERAL))
    soil = mpm.Particles(scenes.box([0, 0], [2, 1], [16, 8], QUADRILATERAL), V)
    law = mpm.materials.Tresca(1e4, 0.3, cohesion=10.0)
    body = mpm.Body(soil, law, density=1.0, body_force=(0.0, -20.0), f_bar="patch")
    problem = Own(body, bcs=[mpm.held(V, 0, x=0.0), mpm.held(V, y=0.0)])
    problem.solve(2)
    problem.acts = True
    with pytest.raises(mpm.MPMError, match="stage was begun within strength_reduction"):
        mpm.strength_reduction(problem)
    assert problem.points[0].laws.weakening == 1.0


@pytest.mark.parametrize("where", ["before", "in its class", "after", "in evaluate", "a method"])
@pytest.mark.parametrize("name", ["trial", "state", "built", "_output", "bodies"])
def test_a_name_of_the_problem_is_refused_to_a_subclass(name, where):
    name = "step" if where == "a method" else name

    class Own(mpm.ParticleProblem):
        if where == "in its class":
            locals()[name] = 0.0

        def __init__(self, particles):
            d, v = particles.displacement, ufl.TestFunction(particles.W)
            self.stiffness = 1.0
            if where == "before":
                setattr(self, name, 0.0)
            super().__init__(ufl.inner(ufl.grad(d), ufl.grad(v)) * particles.dx, particles)
            self.present = self.stiffness
            if where in ("after", "a method"):
                setattr(self, name, 0.0)

        def evaluate(self):
            self.stiffness = 2.0
            if where == "in evaluate":
                setattr(self, name, 0.0)

    V = scenes.vectors(scenes.box([0, 0], [1, 1], [2, 2], QUADRILATERAL))
    body = mpm.Particles(scenes.box([0, 0], [1, 1], [2, 2], QUADRILATERAL), V)
    with pytest.raises(mpm.MPMError, match=f"'{name}' is one of this package's in a Own"):
        Own(body).step()


def test_methods_may_be_replaced_and_other_names_are_free():
    V = scenes.vectors(scenes.box([0, 0], [1, 1], [2, 2], QUADRILATERAL))
    body = mpm.Particles(scenes.box([0, 0], [1, 1], [2, 2], QUADRILATERAL), V)
    problem = mpm.QuasiStaticProblem(mpm.Body(body, VonMises(1e3, 0.3, rho_y=20.0)))
    called = []
    problem.commit, problem.mine = lambda: called.append(1), 3
    problem.step()
    assert called == [1] and problem.mine == 3
    with pytest.raises(mpm.MPMError, match="'at_rest' is one of this package's"):
        problem.at_rest = 0.5  # (an earth pressure, as a user may mean it)
