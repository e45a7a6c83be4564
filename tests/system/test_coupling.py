# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Two bodies that a term ties together."""

from petsc4py import PETSc

import numpy as np
import pytest
import scenes
from posed import posed
from scenes import HEXAHEDRON, QUADRILATERAL, TETRAHEDRON, TRIANGLE, WORLD

import dolfinx
import ufl
from dolfinx import fem
from dolfinx.fem.petsc import LinearProblem

import mpm_dolfinx as mpm
from mpm_dolfinx.io.snapshot import Kept
from mpm_dolfinx.materials import Hencky

YOUNG, POISSON = 1e3, 0.3


def half(first, last, n, h, cell=QUADRILATERAL, degree=1, dim=2, shift=0.0):
    """Return the part of a bar of length 2 between two places, on a background of its own.

    Args:
        first: Where it begins.
        last: Where it ends.
        n: Domains along a length of 1.
        h: Size of the background's cells.
        cell: Kind of the domains.
        degree: Of background and domains.
        dim: Dimension of space.
        shift: By how much grid lines miss the ends.
    """
    lower, upper = np.full(dim, -h), np.full(dim, 1.0 + h)
    lower[0], upper[0] = first - h, last + h
    lower -= shift
    cells = np.round((upper - lower + shift) / h).astype(int)
    background = HEXAHEDRON if dim == 3 else QUADRILATERAL
    V = scenes.vectors(scenes.box(lower, lower + h * cells, cells, background), degree)
    corners = np.zeros(dim), np.ones(dim)
    corners[0][0], corners[1][0] = first, last
    shape = [round(n * (last - first)), *[n] * (dim - 1)]
    return mpm.Particles(scenes.box(*corners, shape, cell), V, degree=degree)


def hold(V, where, value=0.0):
    """Return a condition on all nodes where a marker holds, also within the background."""
    dim = V.mesh.geometry.dim
    return fem.dirichletbc(np.full(dim, value), fem.locate_dofs_geometrical(V, where), V)


def linear(particles, load):
    """Return the residual of a linear elastic body under a body force."""
    d, v = particles.displacement, ufl.TestFunction(particles.W)
    R = ufl.inner(scenes.linear_stress(d, YOUNG, POISSON), ufl.grad(v)) * particles.dx_exact
    return R - particles.load * ufl.inner(ufl.as_vector(load), v) * particles.dx_exact


def tied(stiffness, left, right, load=(3.0, -2.0), **options):
    """Return a bar of two parts, held at its left end."""
    tags = scenes.facet_tags(left.mesh, scenes.at(0, 1.0))
    tie = mpm.Tie(left, right, tags, 1, stiffness)
    return posed(
        mpm.ParticleProblem,
        [linear(body, load) for body in (left, right)],
        [left, right],
        bcs=[hold(left.V, scenes.at(0, 0.0))],
        symmetric=True,
        terms=[tie],
        **options,
    ), tie


def by_finite_elements(n, load=(3.0, -2.0)):
    """Return the displacement of the bar by stock DOLFINx, on one mesh."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 1.0], [2 * n, n], QUADRILATERAL))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    a = ufl.inner(scenes.linear_stress(u, YOUNG, POISSON), ufl.grad(v)) * ufl.dx
    L = ufl.inner(ufl.as_vector(load), v) * ufl.dx
    bcs = [hold(V, scenes.at(0, 0.0))]
    options = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}
    names = {} if dolfinx.__version__.startswith("0.9") else {"petsc_options_prefix": "bar_"}
    return LinearProblem(a, L, bcs=bcs, petsc_options=options, **names).solve()


def differences(bodies, exact):
    """Return the largest difference of the bodies' nodes to a Function, and the Function's size."""
    x = {tuple(np.round(p, 9)): u for p, u in rows(exact.function_space, exact)}
    gap = 0.0
    for body in bodies:
        for p, d in rows(body.W, body.displacement):
            gap = max(gap, np.abs(d - x[tuple(np.round(p, 9))]).max())
    return gap, max(np.abs(u).max() for u in x.values())


def rows(space, function):
    """Return positions and values of all nodes on all ranks."""
    n = space.dofmap.index_map.size_local
    dim = space.mesh.geometry.dim
    x = space.tabulate_dof_coordinates()[:n, :dim]
    values = scenes.own(function).reshape(n, dim)
    return [pair for part in WORLD.allgather(list(zip(x, values, strict=True))) for pair in part]


def test_two_bodies_on_two_backgrounds_are_one_body_as_the_tie_stiffens():
    n = 4
    exact = by_finite_elements(n)
    V = scenes.vectors(scenes.box([-0.25, -0.25], [2.25, 1.25], [10, 6], QUADRILATERAL))
    whole = mpm.Particles(scenes.box([0.0, 0.0], [2.0, 1.0], [2 * n, n], QUADRILATERAL), V)
    one = mpm.ParticleProblem(
        linear(whole, (3.0, -2.0)), whole, bcs=[hold(V, scenes.at(0, 0.0))], symmetric=True
    )
    one.solve()
    gap, size = differences([whole], exact)
    assert gap < 1e-9 * size
    gaps = []
    for stiffness in (1e5, 1e6, 1e7):
        problem, _ = tied(stiffness, half(0.0, 1.0, n, 0.25), half(1.0, 2.0, n, 0.25))
        problem.solve()
        assert len(problem.reduced.fields) == 2
        assert problem.history.iterations == [1]
        assert np.allclose(problem.reaction(problem.bcs[0]), [-6.0, 4.0], rtol=1e-9)
        gaps.append(differences(problem.bodies, exact)[0] / size)
    assert gaps[0] < 2e-2
    assert np.allclose([gaps[0] / gaps[1], gaps[1] / gaps[2]], 10.0, rtol=0.05)


@pytest.mark.parametrize("cell", [TRIANGLE, QUADRILATERAL, TETRAHEDRON, HEXAHEDRON])
def test_a_tie_of_faces_that_do_not_match_carries_a_uniform_stress(cell):
    # Uniform tension along the bar: the tie transmits it whatever the meshes and the grids are.
    dim = 3 if cell in (TETRAHEDRON, HEXAHEDRON) else 2
    left = half(0.0, 1.0, 5, 0.3, cell, dim=dim, shift=0.05)
    right = half(1.0, 2.0, 3, 0.4, cell, dim=dim, shift=0.11)
    tags = scenes.facet_tags(left.mesh, scenes.at(0, 1.0), scenes.at(0, 0.0))
    ends = scenes.facet_tags(right.mesh, scenes.at(0, 2.0))
    tie = mpm.Tie(left, right, tags, 1, 1e6)
    law = Hencky(YOUNG, 0.0)
    problem = mpm.QuasiStaticProblem(
        [
            mpm.Body(left, law, facet_tags=tags),
            mpm.Body(right, law, tractions=[((1.0, *[0.0] * (dim - 1)), 1)], facet_tags=ends),
        ],
        supports=[mpm.boundary.fixed(left, tags, 2)],
        terms=[tie],
        solver=mpm.Solver(petsc_options={"snes_rtol": 1e-12}),
    )
    problem.solve()
    assert np.allclose(problem.reaction(problem.setup.supports[0])[0], -1.0, rtol=1e-8)
    # On b pull the springs by the traction, and open a gap of a 1e-6th.
    tractions = scenes.gather(tie.tractions())
    assert np.allclose(tractions[:, 0], -1.0, atol=0.1)
    assert np.abs(tractions[:, 1:]).max() < 0.1


def test_tangent_and_lift_of_a_tie_by_finite_differences():
    left = half(0.0, 1.0, 4, 0.3, TRIANGLE, shift=0.05)
    right = half(1.0, 2.0, 3, 0.4, QUADRILATERAL, degree=2, shift=0.11)
    tags = scenes.facet_tags(left.mesh, scenes.at(0, 1.0))
    ends = [hold(right.V, lambda x: x[0] > 1.9, 0.01)]
    problem = mpm.QuasiStaticProblem(
        [mpm.Body(p, Hencky(YOUNG, POISSON)) for p in (left, right)],
        bcs=ends,
        terms=[mpm.Tie(left, right, tags, 1, 1e4)],
    )
    system = problem.reduced
    changes = []
    for field in system.fields:
        change = fem.Function(field.V).x.array.copy()
        for bc in field.prescribed:
            bc.set(change, None, 1.0)
        changes.append(change)
    system.begin(changes, 1.0)
    x = PETSc.Vec().createMPI(system.unknowns.sizes, comm=WORLD)
    F, ahead, behind, p = (x.duplicate() for _ in range(4))
    start = x.getOwnershipRange()[0]
    p.array_w[:] = np.sin(1.7 * (start + np.arange(system.unknowns.sizes[0])))
    x.array_w[:] = 0.005 * np.cos(0.9 * (start + np.arange(system.unknowns.sizes[0])))
    assert system.residual(x, F) is None
    K = system.tangent()
    product = F.duplicate()
    K.mult(p, product)
    eps = 1e-6
    assert system.residual(x + eps * p, ahead) is None
    assert system.residual(x - eps * p, behind) is None
    quotient = (ahead - behind) * (0.5 / eps)
    assert (quotient - product).norm() < 1e-7 * product.norm() > 0.0
    # The change of the residual by the conditions is what lift says.
    x.set(0.0)
    assert system.residual(x, behind) is None
    system.tangent()
    small = [1e-6 * change for change in changes]
    for field, change in zip(system.fields, small, strict=True):
        field.begin(change)
    assert system.impose()
    lift = system.lift()
    assert system.residual(x, ahead) is None
    assert (ahead - behind - lift).norm() < 1e-5 * lift.norm() > 0.0


def test_tied_particles_move_to_other_ranks():
    ends = []
    for moves in (False, True):
        left, right = half(0.0, 1.0, 5, 0.3, shift=0.05), half(1.0, 2.0, 3, 0.4, shift=0.11)
        tags = scenes.facet_tags(left.mesh, scenes.at(0, 1.0))
        problem = mpm.QuasiStaticProblem(
            [mpm.Body(p, Hencky(YOUNG, POISSON), body_force=(0.0, -20.0)) for p in (left, right)],
            bcs=[hold(left.V, lambda x: x[0] < 0.1)],
            terms=[mpm.Tie(left, right, tags, 1, 1e5)],
            solver=mpm.Solver(petsc_options={"snes_rtol": 1e-12}),
        )
        for _ in problem.steps(3):
            if moves:
                problem.repartition(0.0)
        ends.append(scenes.in_order(right, right.centroid))
    assert np.abs(ends[0] - ends[1]).max() < 1e-10
    if WORLD.size > 1:
        assert problem.history.statistics["repartitions"] > 0
    with pytest.raises(mpm.MPMError, match="Tie lives on the present body mesh"):
        problem.rebase()


def test_what_is_deleted_is_tied_no_more():
    # The right part is pushed out of its background, which ends where it begins.
    left = half(0.0, 1.0, 4, 0.25)
    V = scenes.vectors(scenes.box([1.0, -0.25], [2.25, 1.25], [5, 6], QUADRILATERAL))
    right = mpm.Particles(
        scenes.box([1.0, 0.0], [2.0, 1.0], [8, 8], QUADRILATERAL), V, outside="delete"
    )
    tags = scenes.facet_tags(left.mesh, scenes.at(0, 1.0))
    tie = mpm.Tie(left, right, tags, 1, 10.0)
    push = fem.Constant(V.mesh, (-0.2, 0.0))
    held = fem.locate_dofs_geometrical(V, lambda x: x[0] > 1.9)
    bcs = [hold(left.V, lambda x: x[0] < 1e-9), fem.dirichletbc(push, held, V)]
    problem = mpm.QuasiStaticProblem(
        [
            mpm.Body(left, Hencky(YOUNG, POISSON), body_force=(0.0, -5.0)),
            mpm.Body(right, Hencky(YOUNG, POISSON), body_force=(0.0, 0.0)),
        ],
        bcs=bcs,
        terms=[tie],
        solver=mpm.Solver(petsc_options={"snes_rtol": 1e-12}),
    )
    problem.solve()
    assert [loss.body for loss in problem.history.losses] == [1]
    assert right.deleted[right.initial_centroid[:, 0] < 1.1].all()
    assert WORLD.allreduce(int(right.deleted.sum())) < 32
    assert problem.reaction(bcs[0])[0] > 1.0  # it was pushed until then
    problem.step()
    assert np.abs(tie.tractions()).max(initial=0.0) == 0.0
    assert np.allclose(problem.reaction(bcs[0]), [0.0, 5.0], rtol=0.0, atol=1e-9)


class Wearing(mpm.Tie):
    """A tie that gets softer with each step."""

    age = trial = 0

    class Age(Kept):
        key = "tie"

        def __init__(self, tie):
            self.tie = tie

        def numbers(self):
            return {"age": self.tie.age}

        def restore(self, taken):
            self.tie.age = taken.numbers["age"]

    def kept(self):
        return [self.Age(self)]

    def update(self):
        self.trial = self.age + 1
        self.stiffness = 1e4 / self.trial
        return None

    def commit(self):
        self.age = self.trial

    def roll_back(self):
        self.trial = self.age


def wearing():
    left, right = half(0.0, 1.0, 4, 0.3, shift=0.05), half(1.0, 2.0, 4, 0.4, shift=0.11)
    tags = scenes.facet_tags(left.mesh, scenes.at(0, 1.0))
    tie = Wearing(left, right, tags, 1, 1e4)
    bcs = [hold(left.V, lambda x: x[0] < 0.1)]
    law = Hencky(YOUNG, POISSON)
    options = {"body_force": (5.0, -5.0), "petsc_options": {"snes_rtol": 1e-12}}
    return posed(mpm.QuasiStaticProblem, [left, right], law, bcs=bcs, terms=[tie], **options), tie


def test_what_a_term_remembers_is_committed_rolled_back_saved_and_restored(tmp_path):
    path = WORLD.bcast(tmp_path) / "wear"
    problem, tie = wearing()
    for step in problem.steps(4):
        assert tie.age == len(problem.history.steps)
        if step.load == 0.5:
            problem.save(path)
    again, other = wearing()
    again.restore(path)
    assert other.age == 2
    again.solve(steps=4)
    assert other.age == 4
    for one, two in zip(problem.bodies, again.bodies, strict=True):
        gap = scenes.in_order(one, one.centroid) - scenes.in_order(two, two.centroid)
        assert np.abs(gap).max() < 1e-12
    # A step that fails leaves it as it was.
    problem.solver.setTolerances(max_it=1)
    for body in problem.bodies:
        body.load.value = 30.0
    with pytest.raises(mpm.MPMError):
        problem.step()
    assert tie.age == tie.trial == 4


def test_ties_that_cannot_be():
    left, right = half(0.0, 1.0, 4, 0.25), half(1.0, 2.0, 4, 0.25)
    tags = scenes.facet_tags(left.mesh, scenes.at(0, 1.0), scenes.at(0, 0.0))
    points = mpm.Particles(right.mesh, right.V, method="mpm")
    for arguments, sentence in (
        ((left, left, tags, 1, 1e3), "twice"),
        ((left, points, tags, 1, 1e3), "cpdi2"),
        ((left, right, tags, 3, 1e3), "has the tag 3 of a Tie; there are"),
        ((left, right, tags, 1, -1.0), "positive"),
        ((left, right, tags, 2, 1e3), "only one body"),
        ((right, left, tags, 1, 1e3), "of the present body mesh"),
    ):
        with pytest.raises(mpm.MPMError, match=sentence):
            mpm.Tie(*arguments)
    tie = mpm.Tie(left, right, tags, 1, 1e3)
    with pytest.raises(mpm.MPMError, match="A Tie acts on other particles"):
        mpm.QuasiStaticProblem(mpm.Body(left, Hencky(1e3, 0.3)), terms=[tie])
    with pytest.raises(mpm.MPMError, match="A Tie was made with axisymmetric=False"):
        mpm.QuasiStaticProblem(
            [mpm.Body(p, Hencky(1e3, 0.3)) for p in (left, right)], axisymmetric=True, terms=[tie]
        )
    with pytest.raises(mpm.MPMError, match="terms must be a list"):
        mpm.QuasiStaticProblem(mpm.Body(left, Hencky(1e3, 0.3)), terms=tie)
    R = ufl.inner(ufl.grad(left.displacement), ufl.grad(ufl.TestFunction(left.W))) * left.dx
    with pytest.raises(mpm.MPMError, match="terms must be a list"):
        mpm.ParticleProblem(R, left, terms=tie)


@pytest.mark.parametrize("n", [3, 6])
def test_a_face_counts_once_on_any_number_of_ranks(n):
    lower, upper = (
        mpm.Particles(
            scenes.box([0.0, y], [1.0, y + 1.0], [n, n], QUADRILATERAL),
            scenes.vectors(scenes.box([-0.5, y - 0.5], [1.5, y + 1.5], [4, 4], QUADRILATERAL)),
        )
        for y in (0.0, 1.0)
    )
    # (also of ghosts)
    tags = mpm.facet_tags(lower.mesh, {1: mpm.region(y=1.0)}, interior=True)
    K = mpm.Tie(lower, upper, tags, 1, 3.0).tangents()[0, 0]
    motion, force = K.createVecs()
    motion.set(1.0)
    K.mult(motion, force)
    assert motion.dot(force) == pytest.approx(2 * 3.0)
    ring = mpm.Tie(lower, upper, tags, 1, 3.0, axisymmetric=True).tangents()[0, 0]
    ring.mult(motion, force)
    assert motion.dot(force) == pytest.approx(2 * 3.0 * np.pi)
