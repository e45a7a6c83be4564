# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Checkpoints: an interrupted run equals one that was not, on any number of ranks."""

import struct

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from compare import EXACT, outcome, same_run
from laws import Brittle
from marks import slow
from scenes import HEXAHEDRON, QUADRILATERAL, TRIANGLE, WORLD
from stress import kills

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import materials
from mpm_dolfinx.io import checkpoint, files
from mpm_dolfinx.materials import Hencky, VonMises

SELF = MPI.COMM_SELF


def whole_outcome(problem):
    """Return the outcome of a run, with its loads."""
    return {"load": np.array(problem.history.load), **outcome(problem)}


def interrupt(make, steps, path, after, other=None, update=None):
    """Compare a run with one that begins anew from a checkpoint after some of its steps."""
    problem = make()
    for number, _ in enumerate(problem.steps(steps, update=update and update(problem))):
        if number == after:
            before = whole_outcome(problem)
            problem.save(path)
    whole = whole_outcome(problem)
    resumed = (other or make)()
    resumed.restore(path)
    same_run(whole_outcome(resumed), before, 0.0 if other is None else 1e-12)
    history = resumed.solve(steps, update=update and update(resumed))
    assert history.iterations == problem.history.iterations
    assert history.cutbacks == problem.history.cutbacks
    assert history.failed_iterations == problem.history.failed_iterations
    same_run(whole_outcome(resumed), whole, EXACT if other is None else 1e-9)
    return problem


def test_flowing_column(mpi_tmp_path):
    problem = interrupt(
        lambda: scenes.slump(TRIANGLE, 20e3, h=1.0), 12, mpi_tmp_path / "column.ckpt", 5
    )
    assert scenes.largest(problem.particles.plastic_strain) > 0.3


@pytest.mark.parametrize("after", [*slow(1), 4])
def test_within_cutbacks(after, mpi_tmp_path):
    path = mpi_tmp_path / "block.ckpt"
    law = Brittle(0.02, 30.0, 200.0)
    problem = interrupt(lambda: scenes.block(law, force=(0.0, -14.0)), 3, path, after)
    sizes = np.diff([0.0, *problem.history.load])
    assert problem.history.cutbacks > 2 and sizes.min() < 0.5 * sizes.max()
    assert scenes.largest(problem.particles.plastic_strain) > 0.01


@pytest.mark.parametrize("method", ["cpdi", "gimp", "mpm"])
def test_methods(method, mpi_tmp_path):
    case = scenes.Column(10.0, 2e5, 0.3, 800.0, 20e3)
    law = VonMises(case.young, case.poisson, rho_y=case.rho_y)
    interrupt(
        lambda: scenes.column(case, 8, QUADRILATERAL, law, method=method),
        6,
        mpi_tmp_path / "column.ckpt",
        3,
    )


@pytest.mark.parametrize("kind", ["domain", "patch"])
def test_f_bar(kind, mpi_tmp_path):
    def make():
        V = scenes.vectors(scenes.box([0.0, 0.0], [3.0, 1.5], [6, 3], QUADRILATERAL))
        body = scenes.box([0.0, 0.0], [1.0, 1.0], [4, 4], QUADRILATERAL)
        degree = 2 if kind == "domain" else None
        return mpm.QuasiStaticProblem(
            mpm.Body(
                mpm.Particles(body, V, quadrature_degree=degree),
                VonMises(1e3, 0.3, rho_y=20.0, hardening=50.0),
                body_force=(0.0, -60.0),
                f_bar=kind,
            ),
            bcs=[scenes.fix(V, scenes.at(i, 0.0), component=i) for i in (0, 1)],
        )

    problem = interrupt(make, 4, mpi_tmp_path / "block.ckpt", 2)
    assert scenes.largest(problem.particles.plastic_strain) > 0.01


def test_deleted_particles(mpi_tmp_path):
    def make():
        V = scenes.vectors(scenes.box([0.0, 0.0], [5.0, 9.0], [10, 18], QUADRILATERAL))
        body = scenes.box([0.0, 0.0], [4.0, 8.0], [8, 16], TRIANGLE)
        bcs = [scenes.fix(V, scenes.at(i, 0.0), component=i) for i in (0, 1)]
        return mpm.QuasiStaticProblem(
            mpm.Body(
                mpm.Particles(body, V, outside="delete"),
                VonMises(1e6, 0.3, rho_y=20e3),
                density=1000.0,
                body_force=(0.0, -10.0),
            ),
            bcs=bcs,
        )

    problem = make()
    path = mpi_tmp_path / "lost.ckpt"
    for step in problem.steps(20):
        if problem.history.losses and not path.exists():
            saved = step.load
            problem.save(path)
        WORLD.Barrier()
    resumed = make()
    resumed.restore(path)
    assert resumed.history.losses == problem.history.losses[: len(resumed.history.losses)] != []
    resumed.solve(20)
    assert saved < 1.0 and resumed.history.losses == problem.history.losses
    same_run(whole_outcome(resumed), whole_outcome(problem), EXACT)


def two_bodies(comm=WORLD, young=1e3):
    """A soft block with two materials on a stiff one, under their weight."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 2.5], [8, 10], QUADRILATERAL, comm))
    lower = scenes.box([0.5, 0.0], [1.5, 1.0], [4, 4], TRIANGLE, comm)
    upper = scenes.box([0.5, 1.0], [1.5, 2.0], [4, 4], TRIANGLE, comm)
    stiffness = fem.Function(fem.functionspace(lower, ("Discontinuous Lagrange", 0)))
    stiffness.interpolate(lambda x: young * (2.0 + x[0]))
    tags = scenes.cell_tags(upper, lambda x: 1 + (x[:, 0] > 1.0))
    laws = {1: Hencky(5e2, 0.2), 2: VonMises(8e2, 0.3, rho_y=30.0, hardening=50.0)}
    return mpm.QuasiStaticProblem(
        [
            mpm.Body(
                mpm.Particles(lower, V),
                VonMises(stiffness, 0.3, rho_y=40.0, hardening=100.0),
                density=1.0,
                body_force=(2.0, -40.0),
                cell_tags=tags,
            ),
            mpm.Body(
                mpm.Particles(upper, V), laws, density=1.0, body_force=(2.0, -40.0), cell_tags=tags
            ),
        ],
        bcs=[
            scenes.fix(V, scenes.at(1, 0.0)),
            scenes.fix(V, scenes.at(0, 2.0), component=0),
        ],
    )


def test_several_bodies_and_materials(mpi_tmp_path):
    problem = interrupt(two_bodies, 4, mpi_tmp_path / "bodies.ckpt", 1)
    assert max(scenes.largest(body.plastic_strain) for body in problem.bodies) > 0.0


def test_path(mpi_tmp_path):
    def make():
        V = scenes.vectors(scenes.box([0.0, -0.5], [2.0, 1.5], [8, 8], QUADRILATERAL))
        body = scenes.box([0.0, 0.0], [1.0, 1.0], [4, 4], TRIANGLE)
        grip = np.flatnonzero(V.tabulate_dof_coordinates()[:, 0] > 0.99).astype(np.int32)
        value = fem.Constant(V.mesh, np.zeros(2))
        bcs = [scenes.fix(V, scenes.at(0, 0.0)), fem.dirichletbc(value, grip, V)]
        problem = mpm.QuasiStaticProblem(
            mpm.Body(mpm.Particles(body, V), Brittle(0.2, 30.0, 200.0), body_force=(0.0, -3.0)),
            bcs=bcs,
        )
        problem.grip = value
        return problem

    def path(problem):
        def update(t):
            problem.grip.value[:] = (0.4 * max(2 * t - 1, 0.0), 0.1 * t)
            problem.particles.load.value = min(2 * t, 1.0)

        return update

    interrupt(make, 4, mpi_tmp_path / "path.ckpt", 3, update=path)


@pytest.mark.parametrize(("degree", "cell"), [(2, QUADRILATERAL), (3, TRIANGLE)])
def test_higher_degrees(degree, cell, mpi_tmp_path):
    def make(comm=WORLD):
        V = scenes.vectors(scenes.box([0.0, -0.5], [2.0, 1.5], [5, 5], QUADRILATERAL, comm), degree)
        body = scenes.box([0.0, 0.0], [1.0, 1.0], [4, 4], cell, comm)
        return mpm.QuasiStaticProblem(
            mpm.Body(
                mpm.Particles(body, V, degree=degree),
                VonMises(1e3, 0.3, rho_y=20.0, hardening=50.0),
                body_force=(0.0, -5.0),
            ),
            bcs=[scenes.fix(V, scenes.at(0, 0.0))],
        )

    path = mpi_tmp_path / "order.ckpt"
    interrupt(make, 3, path, 1)
    interrupt(make, 3, path, 1, lambda: make(SELF))


def test_in_space(mpi_tmp_path):
    def make():
        V = scenes.vectors(scenes.unit(3, HEXAHEDRON))
        body = scenes.box([0.0] * 3, [0.9, 0.9, 0.8], [4, 4, 3], HEXAHEDRON)
        return mpm.QuasiStaticProblem(
            mpm.Body(
                mpm.Particles(body, V),
                VonMises(1e3, 0.3, rho_y=10.0, hardening=20.0),
                body_force=(0.0, 0.0, -20.0),
            ),
            bcs=[scenes.fix(V, scenes.at(i, 0.0), component=i) for i in range(3)],
        )

    interrupt(make, 3, mpi_tmp_path / "box.ckpt", 1)


def test_written_by_all_ranks_read_by_one(mpi_tmp_path):
    interrupt(two_bodies, 4, mpi_tmp_path / "bodies.ckpt", 1, lambda: two_bodies(SELF))


def test_ranks_without_particles(mpi_tmp_path):
    path = mpi_tmp_path / "one.ckpt"
    interrupt(lambda: scenes.block(n=1), 3, path, 1)
    interrupt(lambda: scenes.block(n=1), 3, path, 1, lambda: scenes.block(n=1, comm=SELF))


@pytest.mark.mpi
def test_written_by_one_rank_read_by_all(mpi_tmp_path):
    path = mpi_tmp_path / "bodies.ckpt"
    alone = two_bodies(SELF)
    for number, _ in enumerate(alone.steps(4)):
        if number == 1:
            if WORLD.rank == 0:
                alone.save(path)
            WORLD.Barrier()
    together = two_bodies()
    together.restore(path)
    together.solve(4)
    assert together.history.iterations == alone.history.iterations
    same_run(whole_outcome(together), whole_outcome(alone), 1e-9)


def test_a_file_in_many_chunks(mpi_tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "BLOCK", 3)
    monkeypatch.setattr(files, "PIECE", 10)
    interrupt(two_bodies, 2, mpi_tmp_path / "bodies.ckpt", 0)


def softening():
    """A block whose stiffness at the points the user lowers after each step."""
    V = scenes.vectors(scenes.box([0.0, -0.25], [2.0, 1.25], [8, 6], QUADRILATERAL))
    body = scenes.box([0.0, 0.0], [1.0, 1.0], [4, 4], TRIANGLE)
    particles = mpm.Particles(body, V)
    d, v = particles.displacement, ufl.TestFunction(particles.W)
    stiffness = particles.quadrature_function("stiffness")
    stiffness.x.array[:] = 1.0
    R = stiffness * ufl.derivative(scenes.neo_hookean(d, 1e3), d, v) * particles.dx
    load = ufl.as_vector((0.0, -15.0))
    R -= particles.load * ufl.inner(load, v) * particles.dx_exact
    problem = mpm.ParticleProblem(R, particles, bcs=[scenes.fix(V, scenes.at(0, 0.0))])
    return problem, stiffness


def soften(problem, stiffness):
    n = problem.particles.num_local
    J = np.linalg.det(problem.particles.deformation_gradient)
    stiffness.x.array[:n] = 1.0 - 0.2 * problem.particles.load.value - 0.5 * np.abs(J - 1.0)
    stiffness.x.scatter_forward()


def test_functions(mpi_tmp_path):
    path = mpi_tmp_path / "ufl.ckpt"
    problem, stiffness = softening()
    for number, _ in enumerate(problem.steps(4)):
        soften(problem, stiffness)
        if number == 1:
            with pytest.raises(mpm.MPMError, match=r"data at quadrature points \(stiffness\)"):
                problem.save(path)
            assert not path.exists()
            problem.save(path, functions=[stiffness])
    resumed, other = softening()
    with pytest.raises(mpm.MPMError, match="give these"):
        resumed.restore(path)
    resumed.restore(path, functions=[other])
    assert scenes.largest(other.x.array - 1.0) > 0.1
    for _ in resumed.steps(4):
        soften(resumed, other)
    same_run(whole_outcome(resumed), whole_outcome(problem), EXACT)
    wrong = fem.Function(fem.functionspace(resumed.particles.mesh, ("Lagrange", 1)), name="x")
    with pytest.raises(mpm.MPMError, match=r"holds the functions \['stiffness'\]"):
        resumed.restore(path, functions=[other, wrong])
    wrong = fem.Function(resumed.particles.V, name="x")
    with pytest.raises(mpm.MPMError, match="on the body mesh"):
        resumed.save(path, functions=[other, wrong])
    same = resumed.particles.quadrature_function("stiffness")
    with pytest.raises(mpm.MPMError, match="must differ"):
        resumed.save(path, functions=[other, same])


class Counting(mpm.ParticleProblem):
    """A history of the user's own: how often a step was committed, by particle."""

    counts = None

    def commit(self):
        old = self.converged_state()[0]["counts"]
        self.counts = old + self.particles.global_index[:, None]

    def converged_state(self):
        if self.counts is None:
            self.counts = np.zeros((self.particles.num_local, 1), np.int64)
        return [{"counts": self.counts}]

    def set_converged_state(self, states):
        self.counts = states[0]["counts"]


def test_history_of_a_subclass(mpi_tmp_path):
    def make():
        particles = scenes.block().particles
        d, v = particles.displacement, ufl.TestFunction(particles.W)
        R = ufl.derivative(scenes.neo_hookean(d) * particles.dx, d, v)
        R -= particles.load * ufl.inner(ufl.as_vector((0.0, -9.0)), v) * particles.dx_exact
        return Counting(R, particles, bcs=[scenes.fix(particles.V, scenes.at(0, 0.0))])

    path = mpi_tmp_path / "own.ckpt"
    interrupt(make, 3, path, 1)
    resumed = make()
    resumed.restore(path)
    assert np.array_equal(resumed.counts[:, 0], 2 * resumed.particles.global_index)


def test_the_run_that_was_interrupted(mpi_tmp_path):
    path = mpi_tmp_path / "block.ckpt"
    problem = scenes.block()
    for step in problem.steps(4):
        if step.load == 0.5:
            problem.save(path)
    resumed = scenes.block()
    resumed.restore(path)
    assert float(resumed.particles.load.value) == 0.5
    for wrong in ({"steps": 5}, {"steps": 4, "update": lambda t: None}):
        with pytest.raises(mpm.MPMError, match=r"in a run of 4 steps with no path"):
            resumed.solve(**wrong)
    assert [step.load for step in resumed.steps(4)] == [0.75, 1.0]
    assert resumed.history.load == [0.25, 0.5, 0.75, 1.0]
    with pytest.raises(mpm.MPMError, match="whole load is applied"):
        resumed.solve(4)

    resumed.restore(path, resume=False)
    assert [step.load for step in resumed.steps(2)] == [0.75, 1.0]

    resumed.restore(path)
    resumed.particles.load.value = 0.6
    assert resumed.step().load == 0.6
    assert [step.load for step in resumed.steps(2)] == pytest.approx([0.8, 1.0])


def test_at_the_end_of_a_run(mpi_tmp_path):
    path = mpi_tmp_path / "block.ckpt"
    problem = scenes.block()
    for _ in problem.steps(2):
        problem.save(path)
    resumed = scenes.block()
    resumed.restore(path)
    assert list(resumed.steps(2)) == []  # the run is at its end
    assert resumed.history.load == [0.5, 1.0]
    problem.save(path)
    resumed.restore(path)
    with pytest.raises(mpm.MPMError, match="whole load is applied"):
        resumed.solve(2)


def test_before_the_first_step(mpi_tmp_path):
    path = mpi_tmp_path / "start.ckpt"
    problem = scenes.block()
    problem.save(path)
    problem.solve(2)
    whole = whole_outcome(problem)
    problem.restore(path)
    assert problem.history.load == []
    problem.solve(2)
    same_run(whole_outcome(problem), whole, EXACT)


def test_statistics(mpi_tmp_path):
    path = mpi_tmp_path / "block.ckpt"
    problem = scenes.block()
    problem.solve(2)
    problem.save(path)
    resumed = scenes.block()
    resumed.restore(path)
    mine, theirs = (p.history.statistics for p in (problem, resumed))
    seconds = sorted(mine.seconds)
    assert {k: v for k, v in mine.items() if k not in seconds} == {
        k: v for k, v in theirs.items() if k not in seconds
    }
    assert resumed.history.steps == problem.history.steps
    for name in seconds:
        mean = WORLD.allreduce(mine[name]) / WORLD.size
        assert theirs[name] == pytest.approx(mean, rel=1e-12)


def refuse(problem, path, match):
    """Demand an error and that the problem is left as it was."""
    before, history = scenes.state(problem), list(problem.history.steps)
    with pytest.raises(mpm.MPMError, match=match) as caught:
        problem.restore(path)
    texts = WORLD.allgather(str(caught.value))
    del caught  # it holds this frame, and so the problem
    assert len(set(texts)) == 1 and str(path) in texts[0]
    scenes.assert_same_state(before, scenes.state(problem))
    assert history == problem.history.steps


def test_damaged_files(mpi_tmp_path):
    problem = scenes.block()
    good = mpi_tmp_path / "block.ckpt"
    for _ in problem.steps(2):
        problem.save(good)
    content = good.read_bytes()
    start = len(checkpoint.MAGIC)

    def altered(new):
        path = mpi_tmp_path / "altered.ckpt"
        WORLD.Barrier()
        if WORLD.rank == 0:
            path.write_bytes(new)
        WORLD.Barrier()
        return path

    for length in (10, start, start + 5, start + 40, len(content) // 2, len(content) - 1):
        refuse(problem, altered(content[:length]), "is truncated")
    refuse(problem, altered(b""), "is not a checkpoint")
    refuse(problem, altered(b"x" * len(content)), "is not a checkpoint")
    newer = content[:start] + struct.pack("<I", checkpoint.VERSION + 1) + content[start + 4 :]
    refuse(problem, altered(newer), r"a newer mpm_dolfinx \(format 3, this one reads 2\)")
    refuse(problem, altered(content + b"\0"), "is damaged")
    dice = np.random.default_rng(3)
    for place in dice.integers(start + checkpoint.START.size, len(content), 12):
        flipped = bytearray(content)
        flipped[place] ^= 1 << int(dice.integers(8))
        refuse(problem, altered(bytes(flipped)), "is damaged")
    refuse(problem, mpi_tmp_path / "none.ckpt", "No such file")
    refuse(problem, mpi_tmp_path, "cannot be read")
    problem.restore(altered(content))


def test_another_problem(mpi_tmp_path):
    path = mpi_tmp_path / "block.ckpt"
    problem = scenes.block(VonMises(1e3, 0.3, rho_y=100.0))
    problem.solve(1)
    problem.save(path)
    law = VonMises(1e3, 0.3, rho_y=100.0)
    refuse(scenes.block(Hencky(1e3, 0.3)), path, "the material is not the same")
    refuse(scenes.block(VonMises(1e3, 0.31, rho_y=100.0)), path, "the material is not the same")
    refuse(scenes.block(law, n=5), path, "the body mesh is not the same")
    refuse(scenes.block(law, cell=QUADRILATERAL), path, "the body mesh is not the same")
    moved = scenes.block(law)
    V, body = moved.particles.V, moved.particles.mesh
    corner = np.isclose(body.geometry.x, [1.0, 1.0, 0.0]).all(axis=1)
    body.geometry.x[corner, 0] += 1e-5
    moved = mpm.QuasiStaticProblem(mpm.Body(mpm.Particles(body, V), law), bcs=moved.bcs)
    refuse(moved, path, "the body mesh is not the same")
    wide = scenes.vectors(scenes.box([0.0, -0.25], [2.5, 1.25], [8, 6], QUADRILATERAL))
    fine = scenes.vectors(scenes.box([0.0, -0.25], [2.0, 1.25], [8, 7], QUADRILATERAL))
    for V in (wide, fine):
        body = scenes.box([0.0, 0.0], [1.0, 1.0], [4, 4], TRIANGLE)
        refuse(
            mpm.QuasiStaticProblem(mpm.Body(mpm.Particles(body, V), law)),
            path,
            "the background mesh is not the same",
        )
    V = scenes.block().particles.V
    for options, what in (({"method": "cpdi"}, "method"), ({"quadrature_degree": 2}, "method")):
        body = scenes.box([0.0, 0.0], [1.0, 1.0], [4, 4], TRIANGLE)
        other = mpm.QuasiStaticProblem(mpm.Body(mpm.Particles(body, V, **options), law))
        refuse(other, path, f"the particles' {what} is not the same")
    twins = two_bodies()
    with pytest.raises(mpm.MPMError, match="the number of bodies is not the same"):
        twins.restore(path)
    young = mpi_tmp_path / "bodies.ckpt"
    twins.save(young)
    with pytest.raises(mpm.MPMError, match="the material of body 0 is not the same"):
        two_bodies(young=1.1e3).restore(young)


def of_fracture(law="Hencky", **options):
    return materials.Fracture(getattr(materials, law)(1e3, 0.3), 1.0, 0.5, **options)


def drained(law):
    return materials.Undrained(getattr(materials, law)(1e3, 0.3, 5.0, 20.0, 5.0), 1e3)


@pytest.mark.parametrize(
    ("law", "other"),
    [
        (of_fracture(), of_fracture(model="AT2")),
        (of_fracture(), of_fracture(split="volumetric")),
        (of_fracture(), of_fracture("NeoHooke")),
        (drained("MohrCoulomb"), drained("DruckerPrager")),
        (
            materials.DruckerPrager(1e3, 0.3, 5.0, 20.0),
            materials.DruckerPrager(1e3, 0.3, 5.0, 20.0, match="plane_strain"),
        ),
    ],
    ids=["model", "split", "elastic law", "law of the effective stress", "match"],
)
def test_a_law_of_other_options(law, other, mpi_tmp_path):
    def made(law):
        V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 2.0], [4, 4], QUADRILATERAL))
        body = mpm.Particles(scenes.unit(4, QUADRILATERAL), V, quadrature_degree=2)
        return mpm.QuasiStaticProblem(mpm.Body(body, law), bcs=[mpm.held(V, y=0.0)])

    made(law).save(mpi_tmp_path / "law.ckpt")
    refuse(made(other), mpi_tmp_path / "law.ckpt", "the material is not the same")
    made(law).restore(mpi_tmp_path / "law.ckpt")


def test_a_file_that_cannot_be_written(mpi_tmp_path, monkeypatch):
    path = mpi_tmp_path / "block.ckpt"
    problem = scenes.block()
    problem.solve(1)
    problem.save(path)
    content = path.read_bytes()
    with pytest.raises(mpm.MPMError, match="cannot be written"):
        problem.save(path / "below")

    def full(place):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(files, "_flush", full)
        with pytest.raises(mpm.MPMError, match="No space left on device"):
            problem.save(path)
    assert path.read_bytes() == content
    WORLD.Barrier()
    assert [p.name for p in mpi_tmp_path.iterdir()] == [path.name]
    # What a killed run leaves half-written is no hindrance.
    WORLD.Barrier()
    draft = mpi_tmp_path / ".block.ckpt.part"
    if WORLD.rank == 0:
        draft.write_bytes(b"?" * (2 * len(content)))
    WORLD.Barrier()
    problem.save(path)
    scenes.block().restore(path)
    WORLD.Barrier()
    assert [p.name for p in mpi_tmp_path.iterdir()] == [path.name]


@pytest.mark.skip_in_parallel
def test_killed_runs_go_on(tmp_path):
    killed, ended, difference = kills.run(2, 1, tmp_path / "run.ckpt")
    assert killed == 2 and ended >= 1
    assert difference == 0.0
