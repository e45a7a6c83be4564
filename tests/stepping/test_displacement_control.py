# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Displacement control: exact limit loads, snap-through against finite elements, errors."""

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from marks import all_but
from posed import posed
from routes import ROUTES
from scenes import HEXAHEDRON, QUADRILATERAL, TRIANGLE, WORLD

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, VonMises


def bar(material, height, stretch, **options):
    """Return a bar 0.5 by 1 pulled upwards by a unit traction, and the control of its end."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [0.625, height], [4, 16], QUADRILATERAL))
    body = scenes.box([0.0, 0.0], [0.5, 1.0], [4, 16], QUADRILATERAL)
    # Exact for 2 pi r P : grad v where the stress is uniform.
    rule = 3 if options.get("axisymmetric") else None
    particles = mpm.Particles(body, V, quadrature_degree=rule)
    problem = posed(
        mpm.QuasiStaticProblem,
        particles,
        material,
        bcs=[
            scenes.fix(V, scenes.at(0, 0.0), component=0),
            scenes.fix(V, scenes.at(1, 0.0), component=1),
        ],
        tractions=[((0.0, 1.0), 1)],
        facet_tags=scenes.facet_tags(body, scenes.at(1, 1.0)),
        **options,
    )
    # Not a node of the body.
    return problem, mpm.DisplacementControl(particles, stretch - 1.0, (0.15, 1.0), (0.0, 2.0))


# -- Limit loads that are known ----------------------------------------------------------


@pytest.mark.parametrize("route", ROUTES, indirect=True)
@pytest.mark.usefixtures("route")
def test_elastic_bar_beyond_its_largest_load():
    # Hencky: P = E' ln(stretch) / stretch, largest at the stretch e.
    problem, control = bar(Hencky(1e3, 0.3), 5.0, np.exp(1.5))
    problem.solve(steps=10, control=control)
    history = problem.history
    strain = np.log1p([step.displacement for step in history.steps])
    np.testing.assert_allclose(np.expm1(strain[-1]), np.expm1(1.5), rtol=1e-14)
    np.testing.assert_allclose(
        history.load, 1e3 / (1.0 - 0.3**2) * strain * np.exp(-strain), rtol=1e-9
    )
    assert np.argmax(history.load) == 4 and history.cutbacks == 0
    assert float(problem.particles.load.value) == history.load[-1]
    assert control.present() == pytest.approx(control.value, rel=1e-13)
    np.testing.assert_allclose(
        problem.reaction(problem.bcs[1])[1], -0.5 * history.load[-1], rtol=1e-9
    )


@pytest.mark.parametrize("route", ROUTES, indirect=True)
@pytest.mark.usefixtures("route")
def test_limit_load_of_a_plastic_bar():
    # Uniaxial stress with linear hardening: P = tau / stretch, largest at ln(stretch) = 1 - y / H
    # (Considere 1885).
    young, y, H = 1e2, 1.0, 2.0
    material = VonMises(young, 0.3, yield_stress=y, hardening=H)
    problem, control = bar(material, 2.5, np.exp(0.65), axisymmetric=True)
    problem.solve(steps=10, control=control)
    loads = np.array(problem.history.load)
    strain = np.log1p([step.displacement for step in problem.history.steps])
    tau = np.minimum(young * strain, (y + H * strain) / (1.0 + H / young))
    np.testing.assert_allclose(loads, tau * np.exp(-strain), rtol=1e-9)
    most = H * np.exp(y / H - 1.0) / (1.0 + H / young)
    assert 0.0 < 1.0 - loads.max() / most < 1e-3
    assert loads[-1] < 0.99 * loads.max()


# -- Snap-through ------------------------------------------------------------------------

SPAN, RISE, DEPTH = 10.0, 1.0, 0.5


def arch(n, comm=WORLD, cell=QUADRILATERAL):
    """Return a mesh of the left half of a shallow arch."""
    half = scenes.box([0.0, 0.0], [SPAN, DEPTH], n, cell, comm)
    x = half.geometry.x
    x[:, 1] += RISE * np.sin(np.pi / 2 * x[:, 0] / SPAN)
    return half


def clamps(V):
    """Return conditions: the left end clamped, symmetry at the crown."""
    ends = scenes.fix(V, scenes.at(0, 0.0)), scenes.fix(V, scenes.at(0, SPAN), component=0)
    return list(ends)


def weight(space, d, load):
    """Return the residual of an elastic arch under a load along its upper face."""
    x = ufl.SpatialCoordinate(space.mesh)
    v = ufl.TestFunction(space)
    push = ufl.conditional(ufl.ge(x[0], 0.7 * SPAN), 1.0, 0.0) * v[1]
    rule = {"quadrature_degree": 4}
    energy = scenes.neo_hookean(d) * ufl.dx(metadata=rule)
    return ufl.derivative(energy, d, v) + load * push * ufl.dx(metadata=rule)


def finite_elements(n, displacements, degree=1):
    """Return loads of the arch by stock DOLFINx, Newton's method on the bordered dense matrix."""
    W = scenes.vectors(arch(n, MPI.COMM_SELF), degree)
    d, load = fem.Function(W), fem.Constant(W.mesh, 0.0)
    R = weight(W, d, load)
    residual, tangent = fem.form(R), fem.form(ufl.derivative(R, d))
    bcs = clamps(W)
    fixed = np.unique(np.concatenate([bc.dof_indices()[0] for bc in bcs]))
    free = np.setdiff1d(np.arange(len(d.x.array)), fixed)
    X = W.tabulate_dof_coordinates()
    (crown,) = np.flatnonzero(np.isclose(X[:, 0], SPAN) & np.isclose(X[:, 1], RISE))
    row = (free == 2 * crown + 1) * -1.0
    loads = []
    for displacement in displacements:
        for _ in range(30):
            r = fem.assemble_vector(residual).array[free]
            present = load.value.copy()
            load.value = present + 1.0
            q = fem.assemble_vector(residual).array[free] - r
            load.value = present
            K = fem.assemble_matrix(tangent).to_dense()[np.ix_(free, free)]
            bordered = np.block([[K, q[:, None]], [row, 0.0]])
            gap = row @ d.x.array[free] - displacement
            step = np.linalg.solve(bordered, -np.append(r, gap))
            d.x.array[free] += step[:-1]
            load.value += step[-1]
            if np.linalg.norm(step) < 1e-12 * SPAN:
                break
        else:
            pytest.fail("finite elements did not converge")
        loads.append(float(load.value))
    return np.array(loads)


def particles_of_arch(n, background, displacement, degree=1, cell=QUADRILATERAL, **options):
    """Return the arch as particles, and the control of its crown."""
    V = scenes.vectors(background, degree)
    particles = mpm.Particles(arch(n, cell=cell), V, degree=degree)
    R = weight(particles.W, particles.displacement, particles.load)
    problem = posed(mpm.ParticleProblem, R, particles, bcs=clamps(V), **options)
    return problem, mpm.DisplacementControl(particles, displacement, (SPAN, RISE), (0.0, -1.0))


@pytest.mark.filterwarnings("ignore:The run is complete")  # it leaves the mesh it began on
@pytest.mark.parametrize("displacement", all_but([0.4], [0.4, 1.0, 2.2]))
def test_one_step_is_that_of_finite_elements(displacement):
    # Before the largest load, between it and the smallest, and beyond.
    n = [20, 2]
    problem, control = particles_of_arch(n, arch(n), displacement)
    problem.solve(steps=1, control=control)
    exact = finite_elements(n, np.linspace(0.0, displacement, 12)[1:])
    np.testing.assert_allclose(problem.history.load, exact[-1:], rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("route", ROUTES, indirect=True)
@pytest.mark.usefixtures("route")
def test_snap_through():
    # Degree 2: what is left is the reset of the background.
    grid = scenes.box([0.0, -2.0], [SPAN, 2.0], [20, 8], QUADRILATERAL)
    problem, control = particles_of_arch([20, 2], grid, 2.5, degree=2, symmetric=True)
    problem.solve(steps=10, control=control)
    loads = np.array(problem.history.load)
    exact = finite_elements([20, 2], np.linspace(0.0, 2.5, 11)[1:], degree=2)
    assert exact[4] < 0.75 * exact[1] and np.argmax(exact[:5]) == 1 and np.argmin(exact[1:]) == 3
    np.testing.assert_allclose(loads, exact, rtol=5e-4)
    assert problem.history.cutbacks == 0


# -- The same states by load -------------------------------------------------------------


def footing(load="support", **options):
    """Return soil under a strip or a pressure, and its mean settlement there."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 1.25], [8, 5], QUADRILATERAL))
    body = scenes.box([0.0, 0.0], [2.0, 1.0], [16, 8], QUADRILATERAL)
    tags = scenes.facet_tags(body, lambda x: np.isclose(x[1], 1.0) & (x[0] < 0.5 + 1e-9))
    particles = mpm.Particles(body, V)
    loads = {}
    if load == "support":
        strip = mpm.boundary.roller(particles, tags, 1, (0.0, 1.0), -0.002, penalty=10.0)
        loads = {"supports": [strip]}
    elif load == "pressure":
        loads = {"pressures": [(2600.0, 1)]}
    problem = posed(
        mpm.QuasiStaticProblem,
        particles,
        VonMises(1e7, 0.48, rho_y=np.sqrt(2.0) * 490.0),
        bcs=[
            scenes.fix(V, scenes.at(0, 0.0, 2.0), component=0),
            scenes.fix(V, scenes.at(1, 0.0), component=1),
        ],
        facet_tags=tags,
        f_bar="patch",
        petsc_options={"snes_rtol": 1e-11},
        **loads,
        **options,
    )
    ds = ufl.Measure("ds", domain=body, subdomain_data=tags, subdomain_id=1)
    return problem, -particles.displacement[1] / 0.5 * ds


@pytest.mark.parametrize(("load", "value"), [("support", 0.001), ("pressure", 0.00015)])
def test_found_loads_give_the_same_states(load, value):
    # A strip driven into the soil until all of it flows; a pressure that follows the surface.
    found, settlement = footing(load)
    control = mpm.DisplacementControl(found.particles, value, functional=settlement)
    found.solve(steps=10, control=control)
    given, settlement = footing(load)
    mean = fem.form(settlement)
    for step in found.history.steps:
        given.particles.load.value = step.load
        given.step()
        reached = WORLD.allreduce(fem.assemble_scalar(mean))
        np.testing.assert_allclose(reached, step.displacement, rtol=1e-7)
    gap = found.particles.displacement.x.array - given.particles.displacement.x.array
    assert scenes.largest(gap) < 1e-6 * value
    base = [problem.reaction(problem.bcs[1])[1] for problem in (found, given)]
    np.testing.assert_allclose(*base, rtol=1e-7)


def test_limit_pressure_is_kept():
    # By load no step gets over it; the settlement can go on.
    problem, settlement = footing("pressure")
    control = mpm.DisplacementControl(problem.particles, 0.0016, functional=settlement)
    problem.solve(steps=8, control=control)
    pressure = np.array(problem.history.load) * 2600.0
    assert 0.8 < pressure[-1] / ((2.0 + np.pi) * 490.0) < 1.1
    assert abs(pressure[-1] / pressure[-5] - 1.0) < 1e-3


@pytest.mark.slow
def test_limit_pressure_is_that_of_a_run_by_load():
    problem, settlement = footing("pressure")
    control = mpm.DisplacementControl(problem.particles, 0.0016, functional=settlement)
    problem.solve(steps=8, control=control)
    driven, _ = footing("pressure")
    with pytest.raises(mpm.ConvergenceError, match="limit load"):
        driven.solve(steps=10)
    assert driven.history.load[-1] == pytest.approx(problem.history.load[-1], rel=2e-3)


# -- What it goes with -------------------------------------------------------------------


def cantilever(cell=TRIANGLE, method="cpdi2", degree=1, n=4, **options):
    """Return a block held at its left side under its own weight, and the control of a corner."""
    dim = 3 if cell is HEXAHEDRON else 2
    lower, upper = [0.0, -0.75, -0.25][:dim], [1.5, 1.5, 1.25][:dim]
    kind, n_cells = (cell, [3, 4, 3]) if dim == 3 else (QUADRILATERAL, [6, 9])
    V = scenes.vectors(scenes.box(lower, upper, n_cells, kind), degree)
    body = scenes.box([0.0] * dim, [1.0] * dim, [n] * dim, cell)
    problem = posed(
        mpm.QuasiStaticProblem,
        mpm.Particles(body, V, method=method, degree=degree),
        Hencky(1e3, 0.3),
        density=2.0,
        body_force=(0.0, -10.0, 0.0)[:dim],
        bcs=[scenes.fix(V, scenes.at(0, 0.0))],
        **options,
    )
    control = mpm.DisplacementControl(problem.particles, 0.2, np.ones(dim), (0.0, -1.0, 0.0)[:dim])
    return problem, control


@pytest.mark.parametrize(
    ("cell", "options"),
    [
        (TRIANGLE, {}),
        (HEXAHEDRON, {}),
        (QUADRILATERAL, {"method": "mpm"}),
        (QUADRILATERAL, {"degree": 2, "stabilisation": "ghost"}),
        (TRIANGLE, {"petsc_options": {"ksp_type": "cg", "pc_type": "gamg", "ksp_rtol": 1e-10}}),
        (TRIANGLE, {"line_search": False, "predictor": False, "shift": 0.0}),
    ],
    ids=str,
)
def test_load_and_displacement_meet(cell, options):
    found, control = cantilever(cell, **options)
    found.solve(steps=3, control=control)
    assert control.present() == pytest.approx(0.2, rel=1e-12)
    given, other = cantilever(cell, **options)
    for load in found.history.load:
        given.particles.load.value = load
        given.step()
    assert other.present() == pytest.approx(0.2, rel=1e-6)


def test_several_bodies_and_two_runs():
    V = scenes.vectors(scenes.box([-0.5, 0.0], [2.5, 2.5], [12, 10], QUADRILATERAL))
    lower = scenes.box([0.0, 0.0], [2.0, 1.0], [8, 4], TRIANGLE)
    upper = scenes.box([0.5, 1.0], [1.5, 2.0], [4, 4], QUADRILATERAL)
    bodies = [mpm.Particles(lower, V), mpm.Particles(upper, V, quadrature_degree=2)]
    problem = posed(
        mpm.QuasiStaticProblem,
        bodies,
        Hencky(1e3, 0.2),
        density=[0.0, 1.0],
        body_force=(0.0, -10.0),
        bcs=[scenes.fix(V, scenes.at(1, 0.0))],
    )
    down = {"point": (1.0, 2.0), "direction": (0.0, -1.0)}
    control = mpm.DisplacementControl(bodies[1], 0.1, **down)
    first = problem.solve(steps=2, control=control).load[-1]
    assert [step.displacement for step in problem.history.steps] == [0.05, 0.1]
    assert all(float(body.load.value) == first for body in bodies)
    base = problem.reaction(problem.bcs[0])
    np.testing.assert_allclose(base, [0.0, 10.0 * first], atol=1e-8 * base[1])
    # Back again, then to the whole load.
    back = mpm.DisplacementControl(bodies[1], 0.0, **down)
    problem.solve(steps=2, control=back)
    assert abs(problem.history.load[-1]) < 0.02 * first
    problem.solve(steps=2)
    assert problem.history.load[-1] == 1.0 and problem.history.steps[-1].displacement is None
    assert 0.0 < control.present() < 0.1


def test_functional_of_the_whole_body():
    found, _ = cantilever()
    body = found.particles
    control = mpm.DisplacementControl(body, 0.1, functional=-body.displacement[1] * body.dx)
    found.solve(steps=2, control=control)
    height = fem.form((ufl.SpatialCoordinate(body.mesh)[1] + body.displacement[1]) * ufl.dx)
    mean = WORLD.allreduce(fem.assemble_scalar(height))
    assert mean == pytest.approx(0.5 - 0.1, rel=1e-12)


class Weak(Hencky):
    """Hencky's law, whose update fails beyond a strain."""

    def update(self, displacement_gradient, state, tangent=True):
        failed = np.flatnonzero(np.abs(displacement_gradient).max(axis=(1, 2)) > 0.05)
        if len(failed):
            raise mpm.ConvergenceError("The law has no stress", failed)
        return super().update(displacement_gradient, state, tangent)


def test_a_failed_run_leaves_the_last_step():
    problem, control = bar(Weak(1e3, 0.3), 2.0, 1.2)
    states = []
    with pytest.raises(mpm.ConvergenceError, match="in the step after load") as caught:
        for _ in problem.steps(8, control=control):
            states.append(scenes.state(problem))
    scenes.assert_same_state(states[-1], scenes.state(problem))
    history = problem.history
    assert caught.value.load == history.load[-1] == float(problem.particles.load.value)
    assert history.cutbacks >= 10 and 0.0499 < history.steps[-1].displacement <= 0.05
    assert control.present() == pytest.approx(history.steps[-1].displacement, rel=1e-12)


def test_checkpoint_within_a_run(mpi_tmp_path):
    whole, control = cantilever()
    whole.solve(steps=4, control=control)
    first, control = cantilever()
    path = first.steps(4, control=control)
    next(path), next(path)
    first.save(mpi_tmp_path / "control.mpm")
    second, control = cantilever()
    second.restore(mpi_tmp_path / "control.mpm")
    with pytest.raises(mpm.MPMError, match=r"displacement control to 0\.2"):
        second.solve(steps=4)
    second.solve(steps=4, control=control)
    np.testing.assert_allclose(second.history.load, whole.history.load, rtol=1e-12)
    assert [s.displacement for s in second.history.steps] == [
        s.displacement for s in whole.history.steps
    ]


def test_particles_move_to_other_ranks_within_a_run():
    problem, control = cantilever()
    problem.solve(steps=2, control=control, repartition=0.0)
    other, stays = cantilever()
    other.solve(steps=2, control=stays)
    np.testing.assert_allclose(problem.history.load, other.history.load, rtol=1e-9)
    assert control.present() == pytest.approx(0.2, rel=1e-12)


# -- Bad input ---------------------------------------------------------------------------


@pytest.mark.parametrize("point", [(0.5, 1.0), (0.0, 1.0), (0.375, 1.0), (0.47, 0.99)])
def test_point_of_split_domains(point):
    # Corners of halves too, where the map of a quadrilateral with two corners in one is singular.
    problem, _ = bar(Hencky(1e3, 0.3), 5.0, 2.0)
    body = problem.particles
    problem.split(np.arange(body.num_global))
    control = mpm.DisplacementControl(body, 1.0, point, (0.0, 1.0))
    row = control.row().array_r.reshape(-1, 2)[:, 1]
    x = body.W.tabulate_dof_coordinates()[: len(row), :2]
    found = WORLD.allreduce(np.array([row.sum(), *(row @ x)]))
    np.testing.assert_allclose(found, [1.0, *point], rtol=0.0, atol=1e-14)
    problem.solve(steps=2, control=control)
    stretch = 1.0 + 1.0 / point[1]
    load = 1e3 / (1.0 - 0.3**2) * np.log(stretch) / stretch
    np.testing.assert_allclose(problem.history.load[-1], load, rtol=1e-9)


def test_control_of_before_a_rebase():
    problem, control = bar(Hencky(1e3, 0.3), 5.0, 1.5)
    problem.solve(steps=2, control=control)
    problem.rebase()
    control.value = 1.0
    with pytest.raises(mpm.MPMError, match="rebased since"):
        problem.solve(steps=2, control=control)
    new = mpm.DisplacementControl(problem.particles, 0.5, (0.15, 1.5), (0.0, 1.0))
    problem.solve(steps=2, control=new)
    load = 1e3 / (1.0 - 0.3**2) * np.log(2.0) / 2.0
    np.testing.assert_allclose(problem.history.load[-1], load, rtol=1e-9)


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"value": np.inf}, "finite number"),
        ({"value": "much"}, "finite number"),
        ({"point": (3.0, 3.0)}, "is not in the body"),
        ({"point": (1.0, 1.0, 1.0)}, "point must be 2 finite numbers"),
        ({"direction": (0.0, 0.0)}, "direction must not be zero"),
        ({"direction": None}, "either point= and direction=, or functional="),
        ({"functional": 1.0}, "either point= and direction=, or functional="),
        ({"particles": None}, "needs mpm.Particles"),
        ({"value": True}, "finite number"),
    ],
)
def test_bad_control(options, sentence):
    problem, _ = cantilever()
    given = {"particles": problem.particles, "value": 0.1, "point": (1.0, 1.0)}
    with pytest.raises(mpm.MPMError, match=sentence):
        mpm.DisplacementControl(**{**given, "direction": (0.0, 1.0), **options})


def test_direction_that_is_bad_on_one_rank():
    problem, _ = cantilever()
    direction = (0.0, 0.0 if WORLD.rank == WORLD.size - 1 else 1.0)
    sentence = "direction differs between" if WORLD.size > 1 else "direction must not be zero"
    with pytest.raises(mpm.MPMError, match=sentence):
        mpm.DisplacementControl(problem.particles, 0.1, (1.0, 1.0), direction)


def test_bad_functional():
    problem, _ = cantilever()
    body = problem.particles
    d = body.displacement
    for functional, sentence in (
        (1.0, "UFL form without test functions"),
        (ufl.inner(d, ufl.TestFunction(body.W)) * body.dx, "UFL form without test functions"),
        (ufl.SpatialCoordinate(body.mesh)[0] * body.dx, "does not depend on the displacement"),
        (ufl.inner(d, d) * body.dx, "linear in the displacement"),
        ((d[0] - 1.0) * body.dx, "vanish where the displacement does"),
    ):
        with pytest.raises(mpm.MPMError, match=sentence):
            mpm.DisplacementControl(body, 0.1, functional=functional)


def test_bad_runs():
    problem, control = cantilever()
    body = problem.particles
    before = scenes.state(problem)
    held = mpm.DisplacementControl(body, 0.1, (0.0, 0.5), (0.0, 1.0))
    functional = mpm.DisplacementControl(body, 0.1, functional=body.displacement[1] * body.dx)
    still = mpm.DisplacementControl(body, 0.0, (1.0, 1.0), (0.0, 1.0))
    _, strange = cantilever()
    for options, sentence in (
        ({"control": held}, "No unknown of the background moves"),
        ({"control": still}, "has its value already"),
        ({"control": strange}, "of particles that this problem has not"),
        ({"control": control, "update": lambda t: None}, "not both"),
        ({"control": functional, "repartition": 0.1}, "cannot move"),
    ):
        with pytest.raises(mpm.MPMError, match=sentence):
            problem.solve(steps=2, **options)
        scenes.assert_same_state(before, scenes.state(problem))


def test_loads_that_control_cannot_find():
    def solve(load=None, value=0.0, control=(0.0, 1.0)):
        V = scenes.vectors(scenes.box([0.0, 0.0], [2.0, 1.0], [8, 4], QUADRILATERAL))
        particles = mpm.Particles(scenes.box([0.0, 0.0], [1.0, 1.0], [4, 4], TRIANGLE), V)
        d, v = particles.displacement, ufl.TestFunction(particles.W)
        R = ufl.derivative(scenes.neo_hookean(d) * particles.dx, d, v)
        if load is not None:
            R -= load(particles.load) * v[0] * particles.dx
        bcs = [
            scenes.fix(V, scenes.at(0, 0.0), component=0),
            scenes.fix(V, scenes.at(1, 0.0, 1.0), value, component=1),
        ]
        problem = mpm.ParticleProblem(R, particles, bcs=bcs)
        problem.solve(steps=1, control=mpm.DisplacementControl(particles, 0.1, (1.0, 0.5), control))

    with pytest.raises(mpm.MPMError, match="nothing in the residual scales"):
        solve()
    with pytest.raises(mpm.MPMError, match=r"affine in particles\.load"):
        solve(lambda load: load**2)
    with pytest.raises(mpm.MPMError, match="Dirichlet values stay as they are"):
        solve(lambda load: load, value=0.1)
    # By symmetry the middle moves along the body only.
    with pytest.raises(mpm.MPMError, match="does not move the controlled displacement"):
        solve(lambda load: load)
    solve(lambda load: load, control=(1.0, 0.0))
