# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Two bodies by Nitsche's method: no gap is left, and the rest is as with a penalty."""

import numpy as np
import pytest
import scenes
from compare import EXACT, error_of_blocks, outcome, same_run
from pairs import POISSON, YOUNG, balance, fail_after, go_on_other_meshes, hertz, patch, spaces, two
from posed import posed
from scenes import HEXAHEDRON, QUADRILATERAL, TETRAHEDRON, TRIANGLE, WORLD

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import contact
from mpm_dolfinx.contact.pair import DEGREES
from mpm_dolfinx.materials import Hencky, LinearElastic, VonMises


def stacked(cells, material, friction=0.0, rule=None, law="nitsche", **options):
    """Return two blocks with facets that do not match, one on the other, between plates.

    The upper one is pressed down by what a path says, and both are free to widen.
    """
    dim = 2 if cells[0] in scenes.PLANE else 3
    V = spaces([0.0] * (dim - 1) + [-0.15], [1.5] * (dim - 1) + [1.35], [5] * dim)
    up, wide = np.eye(dim)[-1], np.ones(dim)
    wide[-1] = 0.5
    upper = scenes.box(0.5 * up, wide + 0.5 * up, [7] * (dim - 1) + [3], cells[0])
    lower = scenes.box(0.0 * up, wide, [6] * (dim - 1) + [3], cells[1])
    a, b = (
        mpm.Particles(body, space, quadrature_degree=rule)
        for body, space in zip((upper, lower), V, strict=True)
    )
    axisymmetric = options.get("axisymmetric", False)
    touch = contact.Pair(a, b, friction, law=law, axisymmetric=axisymmetric)
    above = contact.Rigid(a, contact.plane(up, -up), law=law, axisymmetric=axisymmetric)
    below = contact.Rigid(b, contact.plane(0.0 * up, up), law=law, axisymmetric=axisymmetric)
    bcs = [scenes.fix(W, scenes.at(i, 0.0), component=i) for W in V for i in range(dim - 1)]
    problem = posed(
        mpm.QuasiStaticProblem, [a, b], material, bcs=bcs, terms=[touch, above, below], **options
    )
    return problem, touch, above, up


CELLS = {
    "quadrilaterals": (QUADRILATERAL, QUADRILATERAL),
    "triangles": (TRIANGLE, QUADRILATERAL),
    "hexahedra": (HEXAHEDRON, HEXAHEDRON),
    "tetrahedra": (TETRAHEDRON, HEXAHEDRON),
}


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    "cells", ["quadrilaterals", "triangles", "hexahedra", pytest.param("tetrahedra", marks=SLOW)]
)
def test_blocks_leave_no_gap(cells):
    # (facets of one are not those of the other: a rule sees their kinks to some 1e-3)
    problem, touch, above, up = stacked(CELLS[cells], LinearElastic(YOUNG, POISSON))
    problem.solve(1, update=lambda t: above.move(-0.01 * t * up))
    p = 0.01 * (YOUNG / (1 - POISSON**2) if len(up) == 2 else YOUNG)
    assert problem.reaction(touch) @ up == pytest.approx(p, rel=1e-4)
    assert scenes.largest(touch.pressure[touch.touches] - p) < 2e-2 * p
    assert scenes.largest(touch.gap[touch.touches]) < 5e-3 * 0.01


@pytest.mark.parametrize("passes", [1, 2])
@pytest.mark.parametrize("law", ["nitsche", "penalty"])
@pytest.mark.parametrize(
    "cells",
    [
        (QUADRILATERAL, TRIANGLE),
        (TRIANGLE, TRIANGLE),
        pytest.param((TRIANGLE, QUADRILATERAL), marks=SLOW),
        pytest.param((HEXAHEDRON, HEXAHEDRON), marks=SLOW),
        pytest.param((TETRAHEDRON, TETRAHEDRON), marks=SLOW),
    ],
)
def test_points_that_face_nothing_are_not_pressed(cells, law, passes):
    # the ground around a small block: in one plane with its base, and under stress
    dim = 2 if cells[0] in scenes.PLANE else 3
    up = np.eye(dim)[-1]
    wide = 1.0 - up
    Va, Vb = spaces(-0.2 * np.ones(dim), 1.2 * wide + up, [7] * (dim - 1) + [6])
    upper = scenes.box(0.23 * wide + 0.5 * up, 0.79 * wide + 0.8 * up, [3] * dim, cells[0])
    ground = scenes.box(0.0 * up, wide + 0.5 * up, [8] * (dim - 1) + [4], cells[1])
    a, b = mpm.Particles(upper, Va), mpm.Particles(ground, Vb)
    touch = contact.Pair(b, a, law=law, passes=passes)
    motion = fem.Constant(Va.mesh, -0.02 * up)
    top = fem.locate_dofs_geometrical(Va, lambda x: x[dim - 1] > 0.7)
    base = fem.locate_dofs_geometrical(Vb, lambda x: x[dim - 1] < 0.01)
    bcs = [fem.dirichletbc(motion, top, Va), fem.dirichletbc(np.zeros(dim), base, Vb)]
    problem = mpm.QuasiStaticProblem(
        [mpm.Body(p, Hencky(YOUNG, POISSON)) for p in (a, b)], bcs=bcs, terms=[touch]
    )
    problem.solve(1)
    x, p, gap = (scenes.gather(v) for v in (touch.points, touch.pressure, touch.gap))
    foot = scenes.gather(a.domains.reshape(-1, dim))[:, :-1]
    # (how deep they are is how far beside an edge they may still be behind it)
    depth = 2.0 * max(-gap.min(), 0.0)
    low, high = foot.min(axis=0) - depth, foot.max(axis=0) + depth
    outside = ((x[:, :-1] < low) | (x[:, :-1] > high)).any(axis=1)
    assert outside.sum() > 0.2 * len(x) and (p[~outside] > 0.0).sum() > 2
    assert (p[outside] == 0.0).all()


def test_blocks_of_large_strain_have_no_compliance_of_contact():
    # uniaxial stress of logarithmic strain: sigma = E' ln(0.8), over the width it has then
    exact = -YOUNG / (1 - POISSON**2) * np.log(0.8) / 0.8
    found = {}
    for law in ("penalty", "nitsche"):
        material = Hencky(YOUNG, POISSON)
        problem, touch, above, _ = stacked(CELLS["quadrilaterals"], material, law=law)
        problem.solve(4, update=lambda t, above=above: above.move((0.0, -0.2 * t)))
        found[law] = problem.reaction(touch)[1]
    assert found["nitsche"] == pytest.approx(exact, rel=1e-3)
    assert found["penalty"] < 0.7 * exact  # six domains high, with half of one at each face


@pytest.mark.parametrize("f_bar", ["none", "patch"])
def test_blocks_that_yield_bear_their_strength(f_bar):
    soft = VonMises(1e3, 0.45, rho_y=7.0)
    problem, touch, above, _ = stacked(CELLS["quadrilaterals"], soft, rule=2, f_bar=f_bar)
    problem.solve(5, update=lambda t: above.move((0.0, -0.05 * t)))
    alone = scenes.gather(problem.bodies[0].plastic_strain)
    assert alone.min() > 0.01
    stress = [scenes.gather(body.stress)[:, 1, 1] for body in problem.bodies]
    width = 0.95**-1.0
    force = problem.reaction(touch)[1]
    for parts in stress:
        assert force == pytest.approx(-parts.mean() * width, rel=0.01)
    assert error_of_blocks(problem, step=1e-8, size=1e-3) < 1e-5


def test_cylinders_on_each_other_leave_no_gap():
    problem, touch, above, _ = stacked(
        CELLS["quadrilaterals"], LinearElastic(YOUNG, POISSON), rule=2, axisymmetric=True
    )
    problem.solve(1, update=lambda t: above.move((0.0, -0.01 * t)))
    assert problem.reaction(touch)[1] == pytest.approx(np.pi * 0.01 * YOUNG, rel=1e-3)
    assert scenes.largest(touch.gap[touch.touches]) < 1e-3 * 0.01


@pytest.mark.parametrize(("passes", "degree", "bound"), [(1, 9, 1e-3), (2, 19, 1e-3)])
def test_pressure_goes_through_facets_that_do_not_match(passes, degree, bound, monkeypatch):
    monkeypatch.setitem(DEGREES, 2, degree)
    problem, touch, error, Q = patch(passes, law="nitsche")
    assert error < bound
    assert np.abs(problem.reaction(touch) - Q[:, 1]).max() < 1e-7
    p = scenes.gather(touch.pressure[touch.touches])
    assert np.abs(p - 1.0).max() < 30 * bound
    # the penalty leaves 3e-4
    assert scenes.largest(touch.gap[touch.touches]) < 1e-6
    assert sum(problem.history.iterations) <= 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("passes", "order", "moduli"),
    [
        (1, (1, 0), (YOUNG, YOUNG)),
        (2, (0, 1), (YOUNG, YOUNG)),
        (2, (0, 1), (YOUNG, 20 * YOUNG)),
    ],
)
def test_cylinders_have_the_force_without_compliance(passes, order, moduli):
    # a stiff penalty gives the force that has none, if not the pressure
    problem, touch, radius = hertz(passes, order, n=4, moduli=moduli, law="nitsche")
    stiff, rigid, _ = hertz(passes, order, n=4, moduli=moduli, penalty=100.0)
    force, exact = (abs(p.reaction(c)[1]) for p, c in ((problem, touch), (stiff, rigid)))
    assert force == pytest.approx(exact, rel=2e-3)
    compliance = sum(1.0 / E for E in moduli) * (1 - POISSON**2)
    half = np.sqrt(4.0 * force * (radius / 2) / np.pi * compliance)
    most = 2.0 * force / np.pi / half
    x, p, w = (scenes.gather(v) for v in (touch.points[:, 0], touch.pressure, touch.area))
    pressure = most * np.sqrt(np.maximum(1.0 - (x / half) ** 2, 0.0))
    assert np.sqrt((w @ (p - pressure) ** 2) / (w @ pressure**2)) < 0.06
    assert problem.history.cutbacks == 0


def test_forces_and_moments_of_friction_balance():
    problem, touch, path = two(law="nitsche")
    for _ in problem.steps(6, update=path):
        total, moment = balance(problem, touch)
        size = np.abs(problem.reaction(touch)).max()
        assert np.abs(total).max() < 1e-12 * size
        assert abs(moment) < 1e-12 * size
    force = problem.reaction(touch)
    assert np.abs(problem.reaction(problem.bcs[1]) - force).max() < 1e-6 * np.abs(force).max()
    assert force[0] / force[1] == pytest.approx(-0.3, abs=0.03)


SOFT = VonMises(1e3, 0.3, rho_y=30.0)
WALK = {
    "smooth": {"friction": 0.0},
    "limited": {"friction": contact.Coulomb(0.3, 0.5, 5.0)},
    "one pass": {"passes": 1},
    "one field of the rule": {"rule": 2, "f_bar": "domain"},
    "patches": {"rule": 2, "f_bar": "patch"},
    "patches of triangles": {"cells": (TRIANGLE, TRIANGLE), "f_bar": "patch"},
    "degree 2": {"degree": 2},
    "degree 3": {"degree": 3, "cells": (QUADRILATERAL, QUADRILATERAL)},
    "yields": {"material": SOFT, "rule": 2, "f_bar": "patch"},
    "gimp": {"cells": (QUADRILATERAL, QUADRILATERAL), "method": "gimp"},
    "mpm": {"cells": (QUADRILATERAL, QUADRILATERAL), "method": "mpm"},
}
QUICK = ("smooth", "patches", "degree 2")


@pytest.mark.parametrize("name", [n if n in QUICK else pytest.param(n, marks=SLOW) for n in WALK])
def test_tangent_is_that_of_differences(name):
    problem, touch, path = two(law="nitsche", **WALK[name])
    steps = problem.steps(8, update=path)
    # (at other steps some point is about to slip)
    for _ in range({"patches": 4, "degree 2": 2}.get(name, 3)):
        next(steps)
    assert WORLD.allreduce(int(touch.touches.sum())) > 0
    bound = 1e-5 if "material" in WALK[name] else 1e-7
    assert error_of_blocks(problem, step=3e-8, size=1e-5) < bound


def test_solves_are_as_few_where_facets_come_to_touch():
    # (the tangent has blocks of facets that have never met before)
    problem, touch, path = two(law="nitsche", friction=0.0, rule=2, f_bar="patch")
    problem.solve(6, update=path)
    assert WORLD.allreduce(int(touch.touches.sum())) > 0
    assert max(problem.history.iterations) <= 7


@pytest.mark.slow
@pytest.mark.parametrize("name", ["yields", "limited", "degree 3", "mpm"])
def test_a_block_is_dragged(name):
    problem, touch, path = two(law="nitsche", **WALK[name])
    problem.solve(8, update=path)
    force = problem.reaction(touch)
    assert np.abs(problem.reaction(problem.bcs[0]) + force).max() < 1e-6 * np.abs(force).max()
    assert np.abs(problem.reaction(problem.bcs[1]) - force).max() < 1e-6 * np.abs(force).max()
    assert problem.history.cutbacks <= 1


@pytest.mark.slow
@pytest.mark.parametrize("cells", ["hexahedra", "tetrahedra"])
def test_tangent_in_space(cells):
    problem, _, above, up = stacked(CELLS[cells], Hencky(YOUNG, POISSON), friction=0.3)
    problem.solve(2, update=lambda t: above.move(-0.05 * t * up))
    assert error_of_blocks(problem, step=1e-7, size=1e-5) < 1e-7


@pytest.mark.mpi
@pytest.mark.parametrize(
    "options",
    [
        {"rule": 2, "f_bar": "patch"},
        {},
        {"friction": 0.0},
        pytest.param({"cells": (TRIANGLE, TRIANGLE), "passes": 1}, marks=SLOW),
        pytest.param({"cells": (TRIANGLE, TRIANGLE), "law": "penalty"}, marks=SLOW),
    ],
)
def test_a_dragged_block_is_the_same_on_any_number_of_ranks(options):
    options = {"law": "nitsche", **options}
    problem, touch, path = two(**options)
    other, alone, same = two(comm=scenes.MPI.COMM_SELF, **options)
    problem.solve(6, update=path)
    other.solve(6, update=same)
    force = other.reaction(alone)
    assert np.abs(problem.reaction(touch) - force).max() < 1e-9 * np.abs(force).max()
    assert abs(touch.moment((0, 0)) - alone.moment((0, 0)))[0] < 1e-9 * np.abs(force).max()
    same_run(outcome(problem), outcome(other), 1e-9)


def test_a_step_that_fails_leaves_everything_as_it_was():
    fail_after(4, law="nitsche")


@pytest.mark.mpi
def test_a_checkpoint_goes_on_as_the_run_does(mpi_tmp_path):
    problem, touch, path = two(law="nitsche")
    for _ in problem.steps(6, update=path):
        if len(problem.history.steps) == 4:
            problem.save(mpi_tmp_path / "half.ckpt")
            force = problem.reaction(touch)
    other, again, path = two(law="nitsche")
    other.restore(mpi_tmp_path / "half.ckpt")
    assert np.abs(other.reaction(again) - force).max() < 1e-9 * np.abs(force).max()
    other.solve(6, update=path)
    end = problem.reaction(touch)
    assert np.abs(other.reaction(again) - end).max() < 1e-7 * np.abs(end).max()
    same_run(outcome(other), outcome(problem), EXACT)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["move", "rebase", "split"])
def test_it_follows_other_meshes_of_the_bodies(what):
    problem = go_on_other_meshes(what, law="nitsche")
    assert error_of_blocks(problem, step=1e-7, size=1e-5) < 1e-7


# -- What cannot be ------------------------------------------------------------------------


def test_what_cannot_be_is_refused():
    problem, _, _ = two()
    a, b = problem.bodies
    touch = contact.Pair(a, b, law="nitsche")
    d, v = a.displacement, ufl.TestFunction(a.W)
    form = ufl.inner(ufl.grad(d), ufl.grad(v)) * a.dx
    d, v = b.displacement, ufl.TestFunction(b.W)
    other = ufl.inner(ufl.grad(d), ufl.grad(v)) * b.dx
    with pytest.raises(mpm.MPMError, match=r"of a Pair takes the stress.*use a QuasiStaticProblem"):
        mpm.ParticleProblem([form, other], [a, b], terms=[touch])
    with pytest.raises(mpm.MPMError, match=r"of a Pair does not go with .* forces of a step's end"):
        mpm.DynamicProblem(
            [mpm.Body(p, Hencky(YOUNG, POISSON), density=1.0) for p in (a, b)], terms=[touch]
        )
    with pytest.raises(mpm.MPMError, match="law must be one of 'penalty', 'nitsche', not 'hard'"):
        contact.Pair(a, b, law="hard")
    problem, _, _ = two(degree=2)
    touch = contact.Pair(*problem.bodies, law="nitsche")
    with pytest.raises(mpm.MPMError, match=r"of a Pair does not go with mixed='pressure'"):
        posed(
            mpm.QuasiStaticProblem,
            problem.bodies,
            Hencky(YOUNG, POISSON),
            mixed="pressure",
            terms=[touch],
        )


def test_it_goes_with_implicit_euler():
    # a block that is let go on another comes to rest with its weight on it
    Va, Vb = spaces([-0.5, -0.5], [1.5, 2.0], [4, 5])
    a = mpm.Particles(scenes.box([0.1, 0.5], [0.9, 1.0], [5, 3], QUADRILATERAL), Va)
    b = mpm.Particles(scenes.box([0.0, 0.0], [1.0, 0.5], [4, 2], QUADRILATERAL), Vb)
    touch = contact.Pair(a, b, law="nitsche")
    base = fem.locate_dofs_geometrical(Vb, lambda x: x[1] < 0.01)
    problem = mpm.DynamicProblem(
        [
            mpm.Body(p, LinearElastic(1e4, POISSON), density=1.0, body_force=(0.0, -10.0))
            for p in (a, b)
        ],
        scheme="euler",
        bcs=[fem.dirichletbc(np.zeros(2), base, Vb)],
        terms=[touch],
    )
    problem.solve(time=0.5, dt=0.05)
    assert problem.reaction(touch)[1] == pytest.approx(4.0, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("passes", [1, pytest.param(2, marks=SLOW)])
@pytest.mark.parametrize("steps", [20, pytest.param(60, marks=SLOW)])
def test_an_impact_wins_no_energy(passes, steps):
    # (see the test of the same name of a Rigid)
    Va, Vb = spaces([-0.5, -1.3], [1.5, 1.3], [8, 10])
    a = mpm.Particles(scenes.box([0.0, 0.03], [1.0, 0.5], [8, 5], QUADRILATERAL), Va)
    b = mpm.Particles(scenes.box([0.05, -0.5], [0.95, 0.0], [6, 5], TRIANGLE), Vb)
    problem = mpm.DynamicProblem(
        [
            mpm.Body(a, Hencky(1.0, 0.0), density=1.0, velocity=(0.1, -0.8)),
            mpm.Body(b, Hencky(1.0, 0.0), density=1.0, velocity=(0.0, 0.8)),
        ],
        scheme="euler",
        terms=[contact.Pair(a, b, 0.6, law="nitsche", passes=passes)],
    )
    problem.solve(time=0.75, dt=0.75 / steps)
    energies = problem.history.energies
    whole = np.array([energy.kinetic + energy.strain for energy in energies])
    assert np.diff([energy.kinetic for energy in energies]).max() > 0.005 * whole[0]  # they bounce
    assert whole.max() <= whole[0] * (1.0 + 1e-9)
