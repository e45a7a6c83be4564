# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bodies against rigid obstacles, compared with exact solutions and Hertz's."""

import itertools

import numpy as np
import pytest
import scenes
from compare import EXACT, outcome, same_run
from marks import thinned
from obstacles import (
    CONFINED,
    POISSON,
    YOUNG,
    between_plates,
    close,
    dragged,
    error_of_facets,
    hertz,
    on_plane,
    tilted,
    told,
    turning,
)
from scenes import ALL, HEXAHEDRON, PLANE, QUADRILATERAL, TETRAHEDRON, TRIANGLE, WORLD, anywhere

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import contact
from mpm_dolfinx.materials import Hencky, LinearElastic
from mpm_dolfinx.meshes.redistribution import Redistribution


@pytest.mark.parametrize(
    ("friction", "angle", "cell"),
    [
        pytest.param(0.3, 0.0, QUADRILATERAL, marks=pytest.mark.slow),
        (0.5, 20.0, TRIANGLE),
    ],
)
def test_a_block_sticks_up_to_the_angle_of_friction(friction, angle, cell):
    problem, ground, force = on_plane(friction, cell, angle)
    path = turning(force, angle, 100.0, 1.2 * np.arctan(friction))
    last = 0.0
    t, normal = tilted(angle)
    with pytest.raises(mpm.MPMError, match=r"load|limit"):
        for _ in problem.steps(12, update=path):
            last = path.angle
            reaction = problem.reaction(ground)
            # equilibrium: the body is pushed back by what weighs it down
            assert np.abs(reaction + 0.5 * problem.particles.load.value * force.value).max() < 1e-6
    exact = np.degrees(np.arctan(friction))
    assert exact - 0.02 < last <= exact + 1e-9
    reaction = problem.reaction(ground)
    assert reaction @ t / (reaction @ normal) == pytest.approx(friction, rel=2e-3)
    assert problem.history.cutbacks > 0


@pytest.mark.parametrize("cell", ALL, ids=scenes.name)
def test_a_block_between_plates_is_compressed_evenly(cell):
    # The stress is uniform, so the gap of the penalty is known: plates give way by p h / M each,
    # and by less where the faces have become wider in the step before.
    dim = 2 if cell in PLANE else 3
    strain, up = 0.01, np.eye(dim)[-1]
    problem, below, above = between_plates(cell, LinearElastic(YOUNG, POISSON))
    particles = problem.particles
    p = strain * (YOUNG / (1 - POISSON**2) if dim == 2 else YOUNG)
    h = 1 / 3  # (a triangle's, or a tetrahedron's, height is that of its square or cube)
    wider = POISSON * p / YOUNG * (1 + POISSON if dim == 2 else 1.0)
    area = (1.0 + 0.5 * wider) ** (dim - 1)
    gap = p * h / CONFINED
    half, whole = 0.5 * strain + gap, strain + 2.0 * gap / area
    problem.solve(2, update=lambda t: above.move(-(whole if t == 1.0 else half) * up))
    assert np.abs(problem.reaction(above) + p * up).max() < 1e-8 * p
    assert np.abs(problem.reaction(below) - p * up).max() < 1e-8 * p
    middle = np.full(dim, 0.5 * (1 + wider))
    assert np.abs(below.moment(middle)).max() < 1e-8 * p
    stress = scenes.gather(particles.stress[:, dim - 1, dim - 1])
    assert np.abs(stress + p).max() < 1e-8 * p
    here = below.touches
    assert WORLD.allreduce(below.area[here].sum()) == pytest.approx(1.0)
    assert scenes.largest(below.pressure[here] - p) < 1e-8 * p
    assert scenes.largest(below.gap[here] + gap / area) < 1e-11


@pytest.mark.parametrize(
    ("f_bar", "rebased"), [("none", False), ("domain", False), ("domain", True)]
)
def test_a_cylinder_between_plates(f_bar, rebased):
    strain = 0.01
    V = scenes.vectors(scenes.box([0.0, -0.3], [1.5, 1.5], [3, 4], QUADRILATERAL))
    particles = mpm.Particles(scenes.unit(4, QUADRILATERAL), V, quadrature_degree=2)
    options = {"axisymmetric": True}
    below = contact.Rigid(particles, contact.plane((0.0, 0.0), (0.0, 1.0)), **options)
    above = contact.Rigid(particles, contact.plane((0.0, 1.0), (0.0, -1.0)), **options)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, LinearElastic(YOUNG, POISSON), f_bar=f_bar),
        bcs=[scenes.fix(V, scenes.at(0, 0.0), component=0)],
        axisymmetric=True,
        terms=[below, above],
    )
    p = strain * YOUNG
    gap, area = p * 0.25 / CONFINED, (1.0 + 0.5 * POISSON * strain) ** 2
    half, whole = 0.5 * strain + gap, strain + 2.0 * gap / area
    path = {0.5: half, 1.0: whole}
    for number, _ in enumerate(problem.steps(2, update=lambda t: above.move((0.0, -path[t])))):
        if rebased and number == 0:  # (on what has become wider)
            problem.rebase()
    assert problem.reaction(below)[1] == pytest.approx(np.pi * p, rel=1e-8)
    assert problem.reaction(above)[1] == pytest.approx(-np.pi * p, rel=1e-8)
    assert scenes.largest(particles.stress[:, 1, 1] + p) < 1e-7 * p


@pytest.mark.parametrize("axisymmetric", [False, True])
def test_a_limit_of_friction_is_per_area_of_the_stretched_facets(axisymmetric):
    limit, wider, higher, rise = 0.7, 0.502, 0.2, 0.1
    V = scenes.vectors(scenes.box([0.0, -0.3], [2.1, 1.8], [7, 7], QUADRILATERAL))
    particles = mpm.Particles(scenes.box([0.5, 0.0], [1.0, 1.0], [3, 5], QUADRILATERAL), V)
    wall = contact.Rigid(
        particles,
        contact.cavity(contact.box((-1.5, -9.0), (1.5, 9.0), 0.1)),
        contact.Coulomb(0.4, limit=limit),
        axisymmetric=axisymmetric,
    )
    value = fem.Function(V)
    everywhere = fem.dirichletbc(value, np.arange(len(value.x.array) // 2, dtype=np.int32))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, Hencky(YOUNG, POISSON)),
        bcs=[everywhere],
        axisymmetric=axisymmetric,
        terms=[wall],
    )

    def path(t):  # first wider and higher, until it is pressed against the wall, then upwards
        grows = min(2.0 * t, 1.0)
        value.interpolate(
            lambda x: (grows * wider * x[0], grows * higher * x[1] + rise * max(2.0 * t - 1.0, 0.0))
        )

    problem.solve(2, update=path)  # (values are of places, so each in one step)
    around = 2.0 * np.pi * (1.0 + wider) if axisymmetric else 1.0
    assert np.all(0.4 * wall.pressure[wall.touches] > 3.0 * limit) and problem.history.cutbacks == 0
    assert problem.reaction(wall)[1] == pytest.approx(-limit * around * (1.0 + higher), rel=1e-9)


def test_pressure_under_a_disc_is_that_of_hertz():
    problem, die, half, most = hertz(8, 1.0, 8)
    assert half == pytest.approx(0.2, rel=0.1)
    assert error_of_facets(die, half, most) < 0.04
    x, p, w = (scenes.gather(v) for v in (die.points[:, 0], die.pressure, die.area))
    assert p.max() == pytest.approx(most, rel=0.03)
    assert problem.history.statistics["halvings"] <= 2
    assert sum(problem.history.iterations) <= 30
    assert problem.history.cutbacks == 0
    # the half width by the second moment of the pressure
    assert np.sqrt(8 * (w * p) @ x**2 / (2 * (w @ p))) == pytest.approx(half, rel=0.03)


# -- A disc that is pressed into a block and dragged along it -----------------------------


@pytest.mark.mpi
@pytest.mark.parametrize("cell", PLANE, ids=scenes.name)
def test_a_dragged_disc_is_the_same_on_any_number_of_ranks(cell):
    problem, die, path = dragged(cell)
    problem.solve(10, update=path)
    other, alone, path = dragged(cell, comm=scenes.MPI.COMM_SELF)
    other.solve(10, update=path)
    assert (
        np.abs(problem.reaction(die) - other.reaction(alone)).max()
        < 1e-9 * np.abs(other.reaction(alone)).max()
    )
    assert np.abs(die.moment((0, 0)) - alone.moment((0, 0))).max() < 1e-8
    same_run(outcome(problem), outcome(other), 1e-9)
    # some points stick, others slip, and none of these bears more or less than friction allows
    p, t, s = die.pressure, die.traction, die.sticks
    n = die.points - (die.offset + np.array([0.7, 1.6]))
    n /= np.linalg.norm(n, axis=1)[:, None]
    shear = np.linalg.norm(t - (t * n).sum(axis=1)[:, None] * n, axis=1)
    slides = die.touches & ~s
    assert np.allclose(shear[slides], 0.4 * p[slides], rtol=1e-9)
    assert np.all(shear[s] <= 0.4 * p[s] + 1e-9)
    assert WORLD.allreduce(int(slides.sum())) > 0
    # what the base bears is what the disc brings
    assert np.abs(problem.reaction(problem.bcs[0]) + die.reaction).max() < 1e-6


def test_moment_is_that_of_the_reactions():
    problem, die, path = dragged()
    problem.solve(10, update=path)
    field = problem.reduced.fields[0]
    x = field.V.tabulate_dof_coordinates()[: len(field.force.array_r) // 2, :2]
    # forces of supports on all dofs of V; the contact's among them are at nodes of V, which carry
    # moments exactly, as T has linear functions
    held = np.where(x[:, 1:] < 0.01, field.force.array_r.reshape(-1, 2), 0.0)
    mine = (x[:, 0] * held[:, 1] - x[:, 1] * held[:, 0]).sum()
    moment = WORLD.allreduce(mine)
    # (x of the nodes is that of the step's beginning, the contact's that of its end)
    assert moment == pytest.approx(-die.moment((0.0, 0.0))[0], rel=2e-2)


def test_a_step_that_fails_leaves_everything_as_it_was():
    problem, die, path = dragged()
    steps = problem.steps(10, update=path)
    for _ in itertools.islice(steps, 5):
        pass
    before = scenes.state(problem)
    points = {key: value.copy() for key, value in told(die).items()}
    columns = {key: c.values.copy() for key, c in die.columns(0).items()}
    die.move((0.0, -1.9))
    with pytest.raises(mpm.MPMError):
        problem.step()
    scenes.assert_same_state(before, scenes.state(problem))
    for key, value in told(die).items():
        assert np.array_equal(points[key], value), key
    for key, column in die.columns(0).items():
        assert np.array_equal(columns[key], column.values), key


def test_a_checkpoint_goes_on_as_the_run_does(mpi_tmp_path):
    problem, die, path = dragged()
    for step in problem.steps(6, update=path):
        if len(problem.history.steps) == 4:
            problem.save(mpi_tmp_path / "half.ckpt")
            before = told(die)
    other, again, path = dragged()
    other.restore(mpi_tmp_path / "half.ckpt")
    close(before, told(again), 1e-11)
    other.solve(6, update=path)
    close(told(die), told(again), 1e-8)
    same_run(outcome(problem), outcome(other), EXACT)
    third, _, _ = dragged(friction=0.0)
    third.restore(mpi_tmp_path / "half.ckpt")  # another law is another run, not another state


@pytest.mark.mpi
def test_contact_moves_with_the_particles_to_other_ranks():
    problem, die, path = dragged()
    other, alone, still = dragged()
    for number, _ in enumerate(problem.steps(10, update=path)):
        before = told(die)
        body = problem.particles
        ranks = anywhere(body.mesh, number)
        if number < 9:
            problem.state.renew(
                lambda ranks=ranks, body=body: body.live_on(Redistribution(body.mesh, ranks)),
                lambda state: state,
            )
            close(before, told(die), 1e-10)
    other.solve(10, update=still)
    close(told(die), told(alone), 1e-7)
    same_run(outcome(problem), outcome(other), 1e-8)


@pytest.fixture(scope="module")
def as_it_is():
    """What a die tells that is dragged over a body whose mesh stays as it is."""
    problem, die, path = dragged()
    problem.solve(6, update=path)
    return told(die)


@pytest.mark.parametrize("what", ["split", "rebase"])
def test_contact_follows_other_meshes_of_the_body(what, as_it_is):
    problem, die, path = dragged()
    for number, _ in enumerate(problem.steps(6, update=path)):
        if number == 3:
            before = told(die)
            if what == "rebase":
                problem.rebase()
            else:
                problem.split(np.arange(0, problem.particles.num_global, 2))
            after = told(die)
            close(before, after, 1e-10)
    close({"reaction": die.reaction}, {"reaction": as_it_is["reaction"]}, 3e-2)
    if what == "rebase":
        close(told(die), as_it_is, 1e-6)


@pytest.fixture(scope="module")
def on_a_fine_grid():
    """The force on a die that is dragged over finer domains."""
    problem, die, path = dragged(n=12, friction=0.2)
    problem.solve(5, update=path)
    return die.reaction


@pytest.mark.parametrize("method", ["cpdi2", "cpdi", "gimp", "mpm"])
def test_all_methods_feel_an_obstacle(method, on_a_fine_grid):
    problem, die, path = dragged(method=method, friction=0.2)
    problem.solve(5, update=path)
    base = problem.reaction(problem.bcs[0])
    assert np.abs(base + die.reaction).max() < 1e-6 * np.abs(base).max()
    assert die.reaction[1] == pytest.approx(on_a_fine_grid[1], rel=0.25)
    assert abs(die.reaction[0] / die.reaction[1]) == pytest.approx(0.2, abs=0.05)


def test_domains_of_degree_two_are_curved():
    problem, die, path = dragged(degree=2, n=4)
    problem.solve(5, update=path)
    other, alone, path = dragged(n=12)
    other.solve(5, update=path)
    assert die.reaction == pytest.approx(alone.reaction, rel=0.12)


def test_a_sphere_pressed_into_a_cube_and_turned():
    V = scenes.vectors(scenes.box([-0.2] * 3, [1.2] * 3, [4] * 3, HEXAHEDRON))
    bottom = fem.locate_dofs_geometrical(V, lambda x: x[2] < 0.2)
    particles = mpm.Particles(scenes.unit(4, TETRAHEDRON), V)
    ball = contact.Rigid(particles, contact.sphere((0.5, 0.5, 1.5), 0.5), 0.5)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, Hencky(1e3, POISSON)),
        bcs=[fem.dirichletbc(np.zeros(3), bottom, V)],
        terms=[ball],
    )

    def path(t):
        ball.move((0.0, 0.0, -0.1 * min(2 * t, 1.0)), (0.0, 0.0, 0.3 * max(2 * t - 1, 0.0)))

    problem.solve(8, update=path)
    force, moment = problem.reaction(ball), ball.moment((0.5, 0.5, 1.0))
    assert abs(force[2]) > 10 * np.abs(force[:2]).max()
    # the ball turns anticlockwise, and takes the cube along
    assert moment[2] > 0.0 and moment[2] > 3 * np.abs(moment[:2]).max()
    assert np.abs(problem.reaction(problem.bcs[0]) + force).max() < 1e-6 * abs(force[2])


@pytest.mark.parametrize(
    ("friction", "scheme"),
    thinned(3, [(0.2, "euler"), (0.6, "euler"), (0.2, "midpoint"), (0.6, "conserving")]),
)
def test_a_block_slides_down_an_incline_or_stays(friction, scheme):
    t, normal = tilted(30.0)
    body = scenes.box([0.0, 0.0], [1.0, 0.5], [6, 3], QUADRILATERAL)
    body.geometry.x[:, :2] = body.geometry.x[:, :2] @ np.array([t, normal])
    V = scenes.vectors(scenes.box([-1.1, -1.1], [1.7, 1.8], [9, 9], QUADRILATERAL))
    particles = mpm.Particles(body, V)
    ground = contact.Rigid(particles, contact.plane((0.0, 0.0), normal), friction)
    problem = mpm.DynamicProblem(
        mpm.Body(particles, LinearElastic(YOUNG, POISSON), density=1.0, body_force=(0.0, -10.0)),
        scheme=scheme,
        terms=[ground],
    )
    exact = 10.0 * max(0.5 - friction * np.sqrt(0.75), 0.0)
    speeds, reactions = [], []
    for _ in problem.steps(time=0.2, dt=0.01):
        speeds.append(problem.momentum @ -t / 0.5)
        reactions.append(problem.reaction(ground))
    if exact > 0.0:
        if scheme == "euler":
            assert np.diff(speeds)[10:].mean() / 0.01 == pytest.approx(exact, rel=1e-4)
        # (without the losses of euler the block goes on to vibrate on its ground)
        assert speeds[-1] / 0.2 == pytest.approx(exact, rel=5e-2)
        for force in reactions[2:]:
            assert force @ t / (force @ normal) == pytest.approx(friction, rel=1e-9)
    else:
        # (it sways on what holds it, by less than it would have slid in a step)
        assert abs(speeds[-1]) < (1e-3 if scheme == "euler" else 0.01 * 10.0)


def pressed(terms=lambda plate: [plate]):
    """Return a block 1 x 1 under a plate, and the plate."""
    V = scenes.vectors(scenes.box([-0.4, 0.0], [1.4, 1.25], [7, 5], QUADRILATERAL))
    particles = mpm.Particles(scenes.unit(8, QUADRILATERAL), V)
    plate = contact.Rigid(particles, contact.plane((0.0, 1.0), (0.0, -1.0)))
    bcs = [scenes.fix(V, scenes.at(1, 0.0))]
    return mpm.QuasiStaticProblem(
        mpm.Body(particles, Hencky(YOUNG, POISSON)), bcs=bcs, terms=terms(plate)
    ), plate


def test_what_is_moved_without_a_path_goes_its_way_or_says_that_it_does_not():
    problem, plate = pressed()
    plate.move((0.0, -0.3))  # more than two domains, whatever the load
    with pytest.raises(mpm.ConvergenceError, match="by a path"):
        problem.solve(1)
    assert plate.offset.tolist() == [0.0, 0.0] and problem.history.cutbacks > 0
    plate.move((0.0, -0.1))
    problem.solve(1)
    assert plate.offset.tolist() == [0.0, -0.1]
    stepwise, other = pressed()
    stepwise.solve(4, update=lambda t: other.move((0.0, -0.1 * t)))
    bears = stepwise.reaction(other)[1]
    assert bears < -0.08 * YOUNG
    assert problem.reaction(plate)[1] == pytest.approx(bears, rel=0.02)


# -- What cannot be ----------------------------------------------------------------------


def test_a_contact_that_stands_twice_is_refused():
    with pytest.raises(mpm.MPMError, match="stands twice in terms"):
        pressed(lambda plate: [plate, plate])


@pytest.mark.mpi
@pytest.mark.parametrize("what", ["shape", "offset", "angle"])
def test_what_differs_between_ranks_is_refused(what):
    other = 0.1 * (WORLD.rank > 0)
    if what == "shape":
        particles = dragged(n=2)[0].particles
        disc = contact.Rigid(particles, contact.disc((0.5, 5.0), 0.3 + other))
        with pytest.raises(mpm.MPMError, match=r"shape\S* differs between the ranks"):
            mpm.QuasiStaticProblem(mpm.Body(particles, Hencky(YOUNG, POISSON)), terms=[disc])
        return
    problem, plate = pressed()
    plate.move((0.0, -other), 0.0) if what == "offset" else plate.move((0.0, 0.0), other)
    with pytest.raises(mpm.MPMError, match=f"{what} differs between the ranks"):
        problem.step()


def test_a_body_that_begins_in_an_obstacle_is_refused():
    particles = mpm.Particles(
        scenes.unit(4, QUADRILATERAL),
        scenes.vectors(scenes.box([-0.5, -0.5], [1.5, 1.5], [4, 4], QUADRILATERAL)),
    )
    ball = contact.Rigid(particles, contact.disc((0.5, 1.2), 0.3))
    with pytest.raises(mpm.MPMError, match=r"begins within the obstacle.*0\.09"):
        mpm.QuasiStaticProblem(mpm.Body(particles, Hencky(1e3, 0.3)), terms=[ball])


def test_a_body_that_nothing_holds_yet_is_no_false_verdict():
    # It hangs over the plane: no step is small enough, and the sentence says so.
    V = scenes.vectors(scenes.box([-0.5, -0.5], [1.5, 2.5], [4, 6], QUADRILATERAL))
    body = scenes.box([0.0, 0.5], [1.0, 1.5], [4, 4], QUADRILATERAL)
    particles = mpm.Particles(body, V)
    ground = contact.Rigid(particles, contact.plane((0.0, 0.0), (0.0, 1.0)))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, Hencky(1e3, 0.3), body_force=(0.0, -1.0)), terms=[ground]
    )
    with pytest.raises(
        mpm.ConvergenceError, match="nothing holds the bodies once what only pushes"
    ):
        problem.solve(2)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"shape": contact.sphere((0, 0, 0), 1.0)}, "one in 3 dimensions, the body in 2"),
        ({"shape": 1.0}, "needs a shape of mpm.contact"),
        ({"friction": -0.1}, "friction must be a number from 0"),
        ({"penalty": 0.0}, "penalty must be a positive number"),
        ({"modulus": -1.0}, "modulus must be a positive number"),
        (
            {"friction": contact.Coulomb(stiffness="1")},
            "Coulomb.stiffness must be a positive number",
        ),
        ({"facets": 3}, r"facets= of a Rigid must be tags and one of them"),
        ({"facets": (None, 3)}, "A tag of a Rigid needs facet_tags="),
    ],
)
def test_what_makes_no_sense_is_refused(options, sentence):
    particles = dragged(n=2)[0].particles
    given = {"shape": contact.disc((0.5, 5.0), 0.3), **options}
    with pytest.raises(mpm.MPMError, match=sentence):
        contact.Rigid(particles, **given)


def test_moves_and_questions_that_make_no_sense_are_refused():
    problem, die, _ = dragged(n=2)
    for offset, angle in [((0.0,), 0.0), ((0.0, np.nan), 0.0), ((0.0, 0.0), (0.0, 1.0)), (None, 0)]:
        with pytest.raises(mpm.MPMError, match=r"of an obstacle must be (2|a) finite number"):
            die.move(offset, angle)
    with pytest.raises(mpm.MPMError, match="is about 2 coordinates"):
        die.moment((0.0, 0.0, 0.0))
    other = contact.Rigid(problem.particles, contact.disc((0.7, 5.0), 0.6))
    with pytest.raises(mpm.MPMError, match="one of the terms of this problem"):
        problem.reaction(other)
    with pytest.raises(mpm.MPMError, match="belongs to no problem yet"):
        _ = other.gap
    with pytest.raises(mpm.MPMError, match=r"needs mpm\.Particles"):
        contact.Rigid(problem, die.shape)
