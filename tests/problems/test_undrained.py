# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Ground that is loaded without drainage: strength by effective stress, and its pore pressure."""

from mpi4py import MPI

import numpy as np
import pytest
from compare import raises
from marks import thinned
from scenes import QUADRILATERAL, box, largest, vectors

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import materials
from mpm_dolfinx.materials import Hencky, LinearElastic, MohrCoulomb, Undrained

WATER = 1e6


def mean(body, values):
    """Return the mean of values of particles over a body."""
    comm, volume = body.mesh.comm, body.initial_volume
    return comm.allreduce(float(volume @ values)) / comm.allreduce(float(volume.sum()))


def block(law):
    """Return finite elements that rollers hold to the left and below, half of their top loaded."""
    body = mpm.Particles(box([0, 0], [1, 1], [4, 4], QUADRILATERAL), degree=2)
    tags = mpm.facet_tags(body.mesh, {1: mpm.region(x=(0.0, 0.5), y=1.0)})
    given = mpm.Body(body, law, tractions=[((0.0, -30.0), 1)], facet_tags=tags)
    W = body.W
    return mpm.QuasiStaticProblem(given, bcs=[mpm.held(W, 0, x=0.0), mpm.held(W, 1, y=0.0)])


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(
    "law",
    [
        LinearElastic(1e3, 0.3),
        materials.VonMises(1e3, 0.3, yield_stress=5.0),
        MohrCoulomb(1e3, 0.3, 3.0, 20.0, 5.0),
    ],
)
def test_tangents_and_energy(law, dim):
    undrained = Undrained(law, 3e4)
    materials.check_tangent(undrained, dim, strain=3e-2)
    rng = np.random.default_rng(3)
    H = 1e-3 * rng.standard_normal((5, dim, dim))
    state = undrained.initial_state(5, dim)
    if not getattr(law, "inelastic", False):
        # the stress is the derivative of the energy
        step, change = 1e-7, rng.standard_normal(H.shape)
        up, down = (undrained.update(H + s * step * change, state).state for s in (1, -1))
        slope = (undrained.strain_energy(up) - undrained.strain_energy(down)) / (2 * step)
        work = np.einsum("nij,nij->n", undrained.update(H, state).first_piola, change)
        assert slope == pytest.approx(work, rel=1e-6)


def test_strength_is_that_of_the_effective_stress_before():
    """Plane compression at a constant lateral stress: the mean effective stress in it is constant.

    So strength is ``c cos phi + p_0 sin phi`` where nothing dilates, and water takes half of what
    the top bears.
    """
    c, phi, p0 = 3.0, np.radians(25.0), 20.0
    law = Undrained(MohrCoulomb(1e5, 0.3, c, 25.0), 200.0 * WATER)
    V = vectors(box([0, 0], [1.5, 1.5], [3, 3], QUADRILATERAL), 1)
    body = box([0, 0], [1, 1], [4, 4], QUADRILATERAL)
    tags = mpm.facet_tags(body, {1: mpm.region(x=1.0), 2: mpm.region(y=1.0)})
    soil = mpm.Particles(body, V, quadrature_degree=2)
    down = mpm.boundary.roller(soil, tags, 2, normal=(0.0, -1.0), value=0.004)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            soil,
            law,
            tractions=[((-p0, 0.0), 1)],
            facet_tags=tags,
            f_bar="patch",
            initial_stress=-p0 * np.eye(3),
        ),
        bcs=[mpm.held(V, 0, x=0.0), mpm.held(V, 1, y=0.0)],
        supports=[down],
    )
    problem.solve(8)
    strength = c * np.cos(phi) + p0 * np.sin(phi)
    fields = soil.fields()
    stress, total = fields["stress"], fields["total_stress"]
    across, along = mean(soil, stress[:, 0, 0]), mean(soil, stress[:, 1, 1])
    assert 0.5 * (across - along) == pytest.approx(strength, rel=2e-3)
    assert 0.5 * (across + along) == pytest.approx(-p0, rel=5e-3)
    assert mean(soil, fields["excess_pore_pressure"]) == pytest.approx(strength, rel=1e-2)
    assert np.allclose(total, stress - fields["pore_pressure"][:, None, None] * np.eye(3))
    assert mean(soil, total[:, 0, 0]) == pytest.approx(-p0, rel=6e-3)
    assert problem.points[0].last.yield_function().max() > -1e-6 * strength


@pytest.mark.slow
@pytest.mark.parametrize(("poisson", "above"), thinned(2, [(0.495, 0.032), (0.4995, 0.007)]))
def test_a_strip_bears_prandtl_s_load_of_that_strength(poisson, above):
    """In the recommended way to limit loads; water that gives way lets a part of the load in.

    The mean effective stress rises by ``(K + G / 3) / K_w`` of the total one, and strength with it.
    """
    half, depth, width, c, p0 = 1.0, 3.0, 5.0, 3.0, 20.0
    phi = np.radians(25.0)
    strength = c * np.cos(phi) + p0 * np.sin(phi)
    across = mpm.grid_lines(0, width, 0.25, equal=(0, 1.75), finer_at=half, halvings=3)
    up = mpm.grid_lines(0, depth, 0.25, equal=(1.75, depth), finer_at=depth, halvings=3)
    room = up[-1] + (up[-1] - up[-2]) * np.array([1, 2])
    V = vectors(mpm.grid(MPI.COMM_WORLD, [across, [*up, *room]]), 2)
    ground = mpm.grid(MPI.COMM_WORLD, [across, up])
    soil = mpm.Particles(ground, V, degree=2, quadrature_degree=3)
    under, beside = (mpm.region(x=x, y=depth) for x in ((0, half), (half, width)))
    tags = mpm.facet_tags(ground, {1: under, 2: beside})
    law = MohrCoulomb(1e5 * strength, 0.3, c, 25.0)
    shear, bulk = law.shear, law.bulk
    water = 2.0 * shear * (1.0 + poisson) / (3.0 * (1.0 - 2.0 * poisson)) - bulk
    down = fem.Constant(ground, 0.0)
    strip = mpm.boundary.roller(soil, tags, 1, normal=(0, -1), value=down)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            soil,
            Undrained(law, water),
            tractions=[((0.0, -p0), 2)],
            facet_tags=tags,
            initial_stress=-p0 * np.eye(3),
        ),
        bcs=[mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=width), mpm.held(V, y=0.0)],
        supports=[strip],
        solver=mpm.Solver(stabilisation=None),
    )
    problem.solve(1)
    problem.solve(16, update=lambda t: setattr(down, "value", 4e-4 * t**2))
    found = (-problem.reaction(strip)[1] / half - p0) / strength
    assert found / (2.0 + np.pi) - 1.0 == pytest.approx(above, abs=2e-3)


def test_water_takes_its_share_of_a_load():
    """Held on all sides but one: ``K_w / (K_w + M)`` of it, besides the pressure of water at rest.

    (Of small strains to round-off.)
    """
    V = vectors(box([0, 0], [1, 1.5], [2, 3], QUADRILATERAL), 1)
    body = box([0, 0], [1, 1], [4, 4], QUADRILATERAL)
    tags = mpm.facet_tags(body, {1: mpm.region(y=1.0)})
    law = LinearElastic(1e4, 0.25)
    stiff = float(law.bulk + 4.0 / 3.0 * law.shear)
    soil = mpm.Particles(body, V, quadrature_degree=2)
    table = mpm.WaterTable(1.0, 10.0)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            soil,
            Undrained(law, 4.0 * stiff),
            density=1.0,
            body_force=(0.0, -20.0),
            tractions=[((0.0, -50.0), 1)],
            facet_tags=tags,
            pore_pressure=table,
            initial_stress=mpm.geostatic(1.0, 1.0, 0.5, (0.0, -20.0), water=table),
        ),
        bcs=[mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=1.0), mpm.held(V, 1, y=0.0)],
    )
    problem.solve()
    fields, y = soil.fields(), soil.initial_centroid[:, 1]
    assert fields["excess_pore_pressure"] == pytest.approx(40.0, rel=1e-6)
    assert fields["pore_pressure"] == pytest.approx(40.0 + 10.0 * (1.0 - y), rel=1e-6)
    assert fields["total_stress"][:, 1, 1] == pytest.approx(-50.0 - 20.0 * (1.0 - y), rel=1e-6)
    assert "pressure" not in fields and "mean_effective_stress" in fields


def test_rapid_drawdown_leaves_the_water_in_the_ground_and_takes_its_load_off():
    """Total stress falls by the water that went, pore pressure by ``K_w / (K_w + M)`` of that.

    Once it has drained the ground is as if the water had gone slowly. (Of small strains.)
    """
    V = vectors(box([0, 0], [1, 1.5], [2, 3], QUADRILATERAL), 1)
    body = box([0, 0], [1, 1], [4, 4], QUADRILATERAL)
    tags = mpm.facet_tags(body, {1: mpm.region(y=1.0)})
    law = LinearElastic(1e4, 0.25)
    stiff = float(law.bulk + 4.0 / 3.0 * law.shear)
    soil = mpm.Particles(body, V, quadrature_degree=2)
    high, low = mpm.WaterTable(3.0, 10.0), mpm.WaterTable([(0.0, 1.8), (1.0, 1.8)], 10.0)
    gravity = (0.0, -20.0)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            soil,
            Undrained(law, 4.0 * stiff),
            density=1.0,
            body_force=gravity,
            facet_tags=tags,
            pore_pressure=high,
            initial_stress=mpm.geostatic(1.0, 1.0, 0.5, gravity, water=high),
        ),
        bcs=[mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=1.0), mpm.held(V, 1, y=0.0)],
    )
    problem.solve()
    assert largest(np.abs(soil.displacement.x.array)) < 1e-12
    pressures = [(lambda x: low(x) - high(x), 1)]
    problem.stage("drawn", problem.body().replace(pressures=pressures))
    problem.solve()
    fields, depth = soil.fields(), 1.0 - soil.initial_centroid[:, 1]
    assert fields["excess_pore_pressure"] == pytest.approx(-9.6, rel=1e-6)
    assert fields["total_stress"][:, 1, 1] == pytest.approx(-8.0 - 20.0 * depth, rel=1e-6)
    drained = problem.body().replace(material=law, pore_pressure=low, pressures=())
    problem.stage("drained", drained)
    problem.solve()
    assert soil.fields()["stress"][:, 1, 1] == pytest.approx(-10.0 * depth, rel=1e-6)
    assert largest(np.abs(soil.displacement.x.array)) < 1e-12


def test_what_has_drained_is_where_a_drained_body_is():
    law = Hencky(1e3, 0.3)
    problem = block(Undrained(law, WATER))
    problem.solve(2)
    body = problem.bodies[0]
    at_once = body.displacement.x.array.copy()
    problem.stage("drained", problem.body().replace(material=law))
    problem.solve(2)
    assert "excess_pore_pressure" not in body.fields() and "pressure" in body.fields()
    drained = block(law)
    drained.solve(2)
    exact = drained.bodies[0].displacement.x.array
    assert largest(np.abs(body.displacement.x.array - exact)) < 1e-8 * largest(np.abs(exact))
    assert largest(np.abs(at_once - exact)) > 0.1 * largest(np.abs(exact))


def test_another_undrained_law_keeps_the_pressure():
    """A stage with another strength, which nothing asks for, moves nothing."""
    problem = block(Undrained(MohrCoulomb(1e3, 0.3, 30.0, 20.0), WATER))
    problem.solve(2)
    body = problem.bodies[0]
    before, fields = body.displacement.x.array.copy(), body.fields()
    other = Undrained(MohrCoulomb(1e3, 0.3, 40.0, 25.0), 2.0 * WATER)
    problem.stage("stronger", problem.body().replace(material=other))
    problem.solve()
    assert largest(np.abs(body.displacement.x.array - before)) < 1e-9 * largest(np.abs(before))
    excess = "excess_pore_pressure"
    assert body.fields()[excess] == pytest.approx(fields[excess], rel=1e-6, abs=1e-6)


def test_it_moves_without_losing_energy():
    V = vectors(box([-1, -1], [2, 2], [6, 6], QUADRILATERAL), 1)
    body = box([0, 0], [1, 1], [4, 4], QUADRILATERAL)
    problem = mpm.DynamicProblem(
        mpm.Body(
            mpm.Particles(body, V, quadrature_degree=2),
            Undrained(Hencky(10.0, 0.3), 50.0),
            density=1.0,
            velocity=lambda x: np.stack([x[1] - 0.5, 0.3 * x[0] ** 2]),
        ),
        scheme="conserving",
        out_of_range="reflect",
        solver=mpm.Solver(petsc_options={"snes_rtol": 1e-12}),
    )
    problem.solve(time=0.4, dt=0.05)
    balances = np.array([e.balance for e in problem.history.energies])
    assert np.ptp(balances) < 1e-9 * problem.history.energies[0].kinetic


def test_strength_is_divided_and_the_rest_is_not():
    weak = Undrained(MohrCoulomb(1e3, 0.3, 30.0, 20.0), 5.0).weakened(2.0)
    assert weak.parameters["cohesion"] == 15.0 and weak.parameters["water_bulk"] == 5.0
    stiff = weak.with_parameters(water_bulk=7.0, cohesion=20.0)
    assert stiff.parameters["water_bulk"] == 7.0 and stiff.law.parameters["cohesion"] == 20.0


def test_a_law_that_takes_time_does_so_beside_water():
    class Relaxing(Hencky):
        def in_time(self, duration):
            return Hencky(1e3 / (1.0 + duration), 0.3)

    whole = Undrained(Relaxing(1e3, 0.3), 2e4)
    now = whole.in_time(1.0)
    assert now.law.parameters["young"] == 500.0 and now.parameters["water_bulk"] == 2e4
    plain = Undrained(Hencky(1e3, 0.3), 2e4)
    assert plain.in_time(1.0) is plain


def test_what_makes_no_sense_is_said():
    law = Hencky(1e3, 0.3)
    raises(lambda: Undrained(Undrained(law, 1.0), 1.0), mpm.MPMError, "law of effective stress")
    raises(lambda: Undrained("clay", 1.0), mpm.MPMError, "law of effective stress")
    mixed = mpm.Body(block(law).bodies[0], Undrained(law, 1.0))
    raises(lambda: mpm.QuasiStaticProblem(mixed, mixed="pressure"), mpm.MPMError, "strain space")
    raises(lambda: Undrained(law, 0.0), mpm.MPMError, "water_bulk is 0 but must be")
    fluid = {"pore_fluid": mpm.PoreFluid(0.1)}
    for wet in (Undrained(law, 1.0), {1: law, 2: Undrained(law, 1.0)}):
        raises(lambda wet=wet: mpm.Body(mixed.particles, wet, **fluid), mpm.MPMError, "same water")
