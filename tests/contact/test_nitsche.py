# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Rigid obstacles by Nitsche's method: no gap is left, and the rest is as with a penalty."""

import itertools

import numpy as np
import obstacles
import pytest
import scenes
from compare import EXACT, error_of_blocks, outcome, same_run
from marks import all_but, slow
from obstacles import (
    CONFINED,
    POISSON,
    YOUNG,
    close,
    dragged,
    error_of_facets,
    hertz,
    on_plane,
    tilted,
    told,
    turning,
)
from scenes import ALL, HEXAHEDRON, QUADRILATERAL, TETRAHEDRON, TRIANGLE, WORLD

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import contact
from mpm_dolfinx.contact.behind import extrapolation
from mpm_dolfinx.materials import Hencky, LinearElastic, VonMises
from mpm_dolfinx.meshes.quadrature import quadrature_rule

SLOW = pytest.mark.slow


def between_plates(cell, material, **options):
    """Return a unit block between plates by Nitsche's method, the lower and the upper one."""
    return obstacles.between_plates(cell, material, law="nitsche", **options)


@pytest.mark.parametrize("cell", ALL, ids=scenes.name)
def test_plates_leave_no_gap(cell):
    strain = 0.01
    problem, below, above = between_plates(cell, LinearElastic(YOUNG, POISSON))
    up = np.eye(problem.particles.mesh.geometry.dim)[-1]
    problem.solve(2, update=lambda t: above.move(-t * strain * up))
    p = strain * (YOUNG / (1 - POISSON**2) if len(up) == 2 else YOUNG)
    assert np.abs(problem.reaction(above) + p * up).max() < 1e-8 * p
    for plate in (below, above):
        here = plate.touches
        assert WORLD.allreduce(plate.area[here].sum()) == pytest.approx(1.0)
        assert scenes.largest(plate.pressure[here] - p) < 1e-8 * p
        assert scenes.largest(plate.gap[here]) < 1e-10


@pytest.mark.parametrize("degree", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_plates_leave_no_gap_to_large_strains_of_any_degree(degree):
    # uniaxial stress of logarithmic strain: sigma = E' ln(1 - 0.2), over the width it has then
    problem, _, above = between_plates(QUADRILATERAL, Hencky(YOUNG, POISSON), n=1, degree=degree)
    problem.solve(4, update=lambda t: above.move((0.0, -0.2 * t)))
    strain = np.log(0.8)
    kirchhoff = YOUNG / (1 - POISSON**2) * strain
    assert problem.reaction(above)[1] == pytest.approx(kirchhoff / 0.8, rel=1e-8)
    assert scenes.largest(above.gap[above.touches]) < 1e-9


@pytest.mark.parametrize("f_bar", ["none", "patch"])
def test_a_cylinder_between_plates_leaves_no_gap(f_bar):
    problem, _, above = between_plates(
        QUADRILATERAL, LinearElastic(YOUNG, POISSON), axisymmetric=True, f_bar=f_bar
    )
    problem.solve(2, update=lambda t: above.move((0.0, -0.01 * t)))
    assert problem.reaction(above)[1] == pytest.approx(-np.pi * 0.01 * YOUNG, rel=1e-8)
    assert scenes.largest(above.gap[above.touches]) < 1e-10


def test_force_of_a_disc_has_no_compliance():
    # a penalty of 1000 gives the force that has none, if not the pressure
    problem, die, half, most = hertz(4, 1.0, 2, law="nitsche")
    stiff, rigid, *_ = hertz(4, 1000.0, 2)
    soft, other, *_ = hertz(4, 1.0, 2)
    exact = stiff.reaction(rigid)[1]
    assert problem.reaction(die)[1] == pytest.approx(exact, rel=3e-3)
    assert soft.reaction(other)[1] != pytest.approx(exact, rel=2e-2)
    assert error_of_facets(die, half, most) < 0.04


@pytest.mark.slow
def test_pressure_under_a_disc_is_that_of_hertz():
    problem, die, half, most = hertz(8, 0.5, 8, law="nitsche")
    assert error_of_facets(die, half, most) < 0.03
    assert scenes.largest(die.pressure) == pytest.approx(most, rel=0.03)
    assert problem.history.statistics["halvings"] == 0
    assert sum(problem.history.iterations) <= 30


SOFT = VonMises(1e3, 0.45, rho_y=7.0)
TANGENTS = {
    "elastic": {"material": LinearElastic(1e3, POISSON)},
    "smooth": {"friction": 0.0},
    "triangles": {"cell": TRIANGLE},
    "domain": {"quadrature_degree": 2, "f_bar": "domain"},
    "patch": {"quadrature_degree": 2, "f_bar": "patch"},
    "reference": {"quadrature_degree": 2, "f_bar": "patch", "route": "reference"},
    "patches of triangles": {"cell": TRIANGLE, "f_bar": "patch"},
    "degree 2": {"degree": 2, "n": 4},
}


@pytest.mark.mpi
@pytest.mark.parametrize("name", all_but(("smooth", "domain", "patch", "degree 2"), TANGENTS))
def test_tangent_is_that_of_differences(name, take):
    options = dict(TANGENTS[name])
    take(options.pop("route", "loops"))
    problem, die, path = dragged(law="nitsche", **options)
    problem.solve(4, update=path)
    assert WORLD.allreduce(int(die.touches.sum())) > 0
    # (the motion is that of numbers of unknowns: on any ranks no point may begin to slip in a step)
    assert error_of_blocks(problem, step=1e-8, size=1e-5) < 1e-7


@pytest.mark.parametrize("f_bar", ["none", "patch"])
def test_tangent_where_the_body_yields(f_bar):
    # (an even compression: no point is at the edge of yield, of contact or of slip)
    problem, _, above = between_plates(QUADRILATERAL, SOFT, f_bar=f_bar)
    problem.solve(6, update=lambda t: above.move((0.0, -0.05 * t)))
    assert scenes.gather(problem.particles.plastic_strain).min() > 0.01
    assert error_of_blocks(problem, step=1e-8, size=1e-3) < 1e-5
    assert scenes.largest(above.gap[above.touches]) < 1e-9


@pytest.mark.parametrize("cell", [HEXAHEDRON, TETRAHEDRON], ids=scenes.name)
def test_tangent_in_space(cell):
    V = scenes.vectors(scenes.box([-0.2] * 3, [1.2] * 3, [4] * 3, HEXAHEDRON))
    particles = mpm.Particles(scenes.unit(4, cell), V)
    ball = contact.Rigid(particles, contact.sphere((0.5, 0.5, 1.5), 0.5), 0.3, law="nitsche")
    bottom = fem.locate_dofs_geometrical(V, lambda x: x[2] < 0.2)
    bcs = [fem.dirichletbc(np.zeros(3), bottom, V)]
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, Hencky(1e3, POISSON)), bcs=bcs, terms=[ball]
    )
    problem.solve(3, update=lambda t: ball.move((0.05 * t, 0.0, -0.1 * t)))
    assert WORLD.allreduce(int(ball.touches.sum())) > 0
    # (within 1e-7 a point of the tetrahedra begins to slip)
    assert error_of_blocks(problem, step=1e-8, size=1e-5) < 1e-7


def test_a_body_of_revolution_has_an_exact_tangent():
    problem, _, above = between_plates(
        QUADRILATERAL, Hencky(YOUNG, POISSON), axisymmetric=True, f_bar="patch"
    )
    problem.solve(2, update=lambda t: above.move((0.0, -0.1 * t)))
    assert error_of_blocks(problem, step=1e-7, size=1e-5) < 1e-6


@pytest.mark.slow
def test_a_block_sticks_up_to_the_angle_of_friction():
    problem, ground, force = on_plane(0.3, angle=20.0, law="nitsche")
    path = turning(force, 20.0, 100.0, 1.2 * np.arctan(0.3))
    last = 0.0
    t, normal = tilted(20.0)
    with pytest.raises(mpm.MPMError, match=r"load|limit"):
        for _ in problem.steps(12, update=path):
            last = path.angle
    exact = np.degrees(np.arctan(0.3))
    assert exact - 0.02 < last <= exact + 1e-9
    reaction = problem.reaction(ground)
    assert reaction @ t / (reaction @ normal) == pytest.approx(0.3, rel=2e-3)


@pytest.mark.slow
def test_a_dragged_disc_bears_more_than_with_a_penalty():
    forces = {}
    for law, n in (("nitsche", 8), ("penalty", 8), ("nitsche", 16)):
        problem, die, path = dragged(law=law, n=n)
        problem.solve(10, update=path)
        forces[law, n] = die.reaction[1]
    exact = forces["nitsche", 16]
    assert forces["nitsche", 8] == pytest.approx(exact, rel=0.05)
    assert forces["penalty", 8] != pytest.approx(exact, rel=0.15)


@pytest.mark.mpi
def test_the_same_on_any_number_of_ranks():
    options = {"quadrature_degree": 2, "f_bar": "patch", "law": "nitsche"}
    problem, die, path = dragged(**options)
    problem.solve(6, update=path)
    other, alone, path = dragged(comm=scenes.MPI.COMM_SELF, **options)
    other.solve(6, update=path)
    expected = alone.reaction
    assert np.abs(die.reaction - expected).max() < 1e-9 * np.abs(expected).max()
    same_run(outcome(problem), outcome(other), 1e-9)


def test_a_step_that_fails_leaves_everything_as_it_was():
    problem, die, path = dragged(law="nitsche")
    for _ in itertools.islice(problem.steps(10, update=path), 5):
        pass
    before = scenes.state(problem)
    points = {key: value.copy() for key, value in told(die).items()}
    die.move((0.0, -1.9))
    with pytest.raises(mpm.MPMError):
        problem.step()
    scenes.assert_same_state(before, scenes.state(problem))
    for key, value in told(die).items():
        assert np.array_equal(points[key], value), key


@pytest.mark.mpi
def test_a_checkpoint_goes_on_as_the_run_does(mpi_tmp_path):
    problem, die, path = dragged(law="nitsche")
    for _ in problem.steps(10, update=path):
        if len(problem.history.steps) == 6:
            problem.save(mpi_tmp_path / "half.ckpt")
            before = told(die)
    other, again, path = dragged(law="nitsche")
    other.restore(mpi_tmp_path / "half.ckpt")
    close(before, told(again), 1e-11)
    other.solve(10, update=path)
    close(told(die), told(again), 1e-8)
    same_run(outcome(other), outcome(problem), EXACT)
    third, _, _ = dragged()
    with pytest.raises(mpm.MPMError, match=r"knows the contact .*nitsche.*here it is .*penalty"):
        third.restore(mpi_tmp_path / "half.ckpt")


@pytest.fixture(scope="module")
def as_it_is():
    """The force on a die that is dragged over a body whose mesh stays as it is."""
    problem, die, path = dragged(law="nitsche")
    problem.solve(6, update=path)
    return die.reaction


@pytest.mark.parametrize("what", ["split", "rebase"])
def test_it_follows_other_meshes_of_the_body(what, as_it_is):
    problem, die, path = dragged(law="nitsche")
    for number, _ in enumerate(problem.steps(6, update=path)):
        if number == 3:
            before = told(die)
            if what == "rebase":
                problem.rebase()
            else:
                problem.split(np.arange(0, problem.particles.num_global, 2))
            close(before, told(die), 1e-10)
    bound = 5e-2 if what == "split" else 1e-7
    close({"reaction": die.reaction}, {"reaction": as_it_is}, bound)
    assert error_of_blocks(problem, step=1e-7, size=1e-5) < 1e-7


@pytest.mark.parametrize(
    ("cell", "degree"),
    [(QUADRILATERAL, 1), (TRIANGLE, 2), pytest.param(TRIANGLE, 3, marks=pytest.mark.slow)],
)
def test_a_body_that_is_rebased_goes_on_as_one_that_is_not(cell, degree):
    # (curved facets of domains that are strained unevenly)
    found = []
    for rebased in (False, True):
        V = scenes.vectors(scenes.box([0.0, -0.5], [2.0, 1.5], [4, 4], QUADRILATERAL), degree)
        shape = scenes.bend(scenes.unit(4 if degree == 1 else 2, cell), 0.03)
        particles = mpm.Particles(shape, V, degree=degree)
        plane = contact.plane((0.0, 0.0), (0.0, 1.0))
        ground = contact.Rigid(particles, plane, 0.3, law="nitsche")
        problem = mpm.QuasiStaticProblem(
            mpm.Body(
                particles,
                Hencky(1e3, POISSON),
                body_force=(20.0, -50.0),
                pressures=[(30.0, 1)],
                facet_tags=scenes.facet_tags(shape, scenes.at(1, 1.0)),
            ),
            bcs=[scenes.fix(V, scenes.at(0, 0.0), component=0)],
            terms=[ground],
            solver=mpm.Solver(petsc_options={"snes_rtol": 1e-12}),
        )
        for _ in problem.steps(3):
            if rebased:
                problem.rebase()
        found.append(outcome(problem) | {"reaction of the ground": ground.reaction})
    assert np.abs(found[0]["deformation_gradient 0"] - np.eye(3)).max() > 0.05
    same_run(found[1], found[0], 1e-9)


@pytest.mark.parametrize("cell", ALL, ids=scenes.name)
@pytest.mark.parametrize("degree", [1, 2, 3])
def test_extrapolation_of_stresses_is_exact_for_their_polynomials(cell, degree):
    particles = mpm.Particles(
        scenes.unit(1, cell), scenes.vectors(scenes.unit(1, cell), 1), degree=degree
    )
    cell = particles.mesh.basix_cell()
    rule, _ = quadrature_rule(cell, particles.geometry.quadrature_degree)
    places = np.random.default_rng(3).uniform(0.0, 0.3, (4, rule.shape[1]))
    taken = extrapolation(cell, rule, places, degree)
    assert np.allclose(taken.sum(axis=1), 1.0, atol=1e-12)
    for power in range(degree):
        assert np.allclose(taken @ rule.sum(axis=1) ** power, places.sum(axis=1) ** power)


# -- What cannot be ------------------------------------------------------------------------


def body(degree=1):
    """Return a unit block on the ground, and their contact."""
    V = scenes.vectors(scenes.box([-0.5, -0.5], [1.5, 1.5], [4, 4], QUADRILATERAL), degree)
    particles = mpm.Particles(
        scenes.unit(2, QUADRILATERAL), V, degree=degree, quadrature_degree=2 * degree
    )
    plane = contact.plane((0.0, 0.0), (0.0, 1.0))
    return particles, contact.Rigid(particles, plane, law="nitsche")


def test_what_cannot_be_is_refused():
    particles, ground = body()
    d, v = particles.displacement, ufl.TestFunction(particles.W)
    form = ufl.inner(ufl.grad(d), ufl.grad(v)) * particles.dx
    with pytest.raises(mpm.MPMError, match=r"takes the stress.*use a QuasiStaticProblem"):
        mpm.ParticleProblem(form, particles, terms=[ground])
    particles, ground = body(2)
    with pytest.raises(mpm.MPMError, match=r"does not go with mixed='pressure'"):
        mpm.QuasiStaticProblem(
            mpm.Body(particles, Hencky(1e3, 0.3)), mixed="pressure", terms=[ground]
        )
    particles, ground = body()
    with pytest.raises(mpm.MPMError, match=r"forces of a step's end.*scheme='euler'"):
        mpm.DynamicProblem(mpm.Body(particles, Hencky(1e3, 0.3), density=1.0), terms=[ground])
    with pytest.raises(mpm.MPMError, match="law must be one of 'penalty', 'nitsche', not 'hard'"):
        contact.Rigid(particles, ground.shape, law="hard")


def test_it_goes_with_implicit_euler():
    # a block that is let go on the ground comes to rest with its weight on it
    particles, ground = body()
    problem = mpm.DynamicProblem(
        mpm.Body(particles, LinearElastic(1e4, POISSON), density=1.0, body_force=(0.0, -10.0)),
        scheme="euler",
        terms=[ground],
    )
    problem.solve(time=0.5, dt=0.05)
    assert problem.reaction(ground)[1] == pytest.approx(10.0, rel=1e-6)
    # domains have the mean of their stress, 7.5: the penalty bears a quarter of the weight
    assert scenes.largest(ground.gap[ground.touches]) < 0.3 * 10.0 * 0.5 / CONFINED


@pytest.mark.parametrize(
    ("cell", "steps"),
    [
        (QUADRILATERAL, 20),
        pytest.param(QUADRILATERAL, 60, marks=SLOW),
        pytest.param(TRIANGLE, 20, marks=SLOW),
        pytest.param(TRIANGLE, 60, marks=SLOW),
    ],
)
@pytest.mark.parametrize("friction", [*slow(0.0), 0.6])
def test_an_impact_wins_no_energy(cell, steps, friction):
    # Nearly as fast as sound. Held by the modulus alone a gap was left, and closed under a higher
    # pressure: triangles with friction had 1.65 times their energy in 60 steps.
    domain = scenes.box([-0.5, -1.0], [1.5, 1.0], [8, 8], QUADRILATERAL)
    block = scenes.box([0.0, 0.0], [1.0, 0.5], [8, 5], cell)
    particles = mpm.Particles(block, scenes.vectors(domain))
    ground = contact.Rigid(
        particles, contact.plane((0.0, -0.03), (0.0, 1.0)), friction, law="nitsche"
    )
    problem = mpm.DynamicProblem(
        mpm.Body(particles, Hencky(1.0, 0.0), density=1.0, velocity=(0.1, -0.8)),
        scheme="euler",
        terms=[ground],
    )
    problem.solve(time=0.75, dt=0.75 / steps)
    energies = problem.history.energies
    whole = np.array([energy.kinetic + energy.strain for energy in energies])
    assert np.diff([energy.kinetic for energy in energies]).max() > 0.01 * whole[0]  # it bounces
    assert whole.max() <= whole[0] * (1.0 + 1e-9)
