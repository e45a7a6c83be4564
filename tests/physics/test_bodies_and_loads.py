# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bodies of revolution, follower pressure, several bodies on one background."""

import itertools

import numpy as np
import pytest
import scenes
from marks import all_but
from posed import posed
from scenes import QUADRILATERAL, TRIANGLE, WORLD, A, B, box, vectors
from scipy.integrate import solve_bvp

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, VonMises

YOUNG, POISSON, PRESSURE = 1e3, 0.3, 80.0
INNER, OUTER = 1.0, 2.0


def kirchhoff(radial, hoop):
    """Return Hencky's principal Kirchhoff stresses of a cylinder in plane strain."""
    bulk, shear = YOUNG / (3 * (1 - 2 * POISSON)), YOUNG / (2 * (1 + POISSON))
    strain = np.log([radial, hoop, np.ones_like(radial)])
    trace = strain.sum(axis=0)
    return bulk * trace + 2 * shear * (strain - trace / 3)


def radial_stretch(P, hoop):
    """Return the radial stretch at which the radial first Piola stress is P."""
    x, step = np.ones_like(P), 1e-6
    for _ in range(8):  # of Newton's method, for all of them together
        gap, slope = (kirchhoff(y, hoop)[0] / y - P for y in (x, x + step))
        x = x - gap * step / (slope - gap)
    assert np.abs(kirchhoff(x, hoop)[0] / x - P).max() < 1e-10 * YOUNG
    return x


@pytest.fixture(scope="module")
def cylinder():
    """Return r(R) of an inflated cylinder: d P_R/dR + (P_R - P_hoop)/R = 0."""

    def slope(R, y):
        hoop = y[0] / R
        stretch = radial_stretch(y[1], hoop)
        return np.vstack([stretch, (kirchhoff(stretch, hoop)[1] / hoop - y[1]) / R])

    def ends(inner, outer):
        return np.array([inner[1] + PRESSURE * inner[0] / INNER, outer[1]])

    R = np.linspace(INNER, OUTER, 41)
    guess = np.vstack([1.05 * R, -PRESSURE * (OUTER - R)])
    answer = solve_bvp(slope, ends, R, guess, tol=1e-8)
    assert answer.status == 0
    return answer.sol


def disc(n, cell, comm=WORLD, **options):
    """Return a slice of the cylinder in the (r, z) plane under inner pressure."""
    h = (OUTER - INNER) / n
    V = vectors(box([0.5, 0.0], [3.0, h], [round(2.5 / h), 1], QUADRILATERAL, comm))
    body = box([INNER, 0.0], [OUTER, h], [2 * n, 2], cell, comm)
    return posed(
        mpm.QuasiStaticProblem,
        mpm.Particles(body, V),
        Hencky(YOUNG, POISSON),
        bcs=[scenes.fix(V, scenes.at(1, 0.0, h), component=1)],
        pressures=[(PRESSURE, 1)],
        facet_tags=scenes.facet_tags(body, scenes.at(0, INNER)),
        axisymmetric=True,
        **options,
    )


@pytest.mark.parametrize("cell", all_but([scenes.QUADRILATERAL], scenes.PLANE), ids=scenes.name)
def test_inflated_cylinder(cylinder, cell):
    errors = []
    for n in (8, 16, 32):
        problem = disc(n, cell)
        problem.solve(steps=10)
        particles = problem.particles
        gap = particles.centroid[:, 0] - cylinder(particles.initial_centroid[:, 0])[0]
        errors.append(scenes.largest(gap) / OUTER)
    assert errors[0] < 1e-3
    assert np.log2(errors[0] / errors[2]) / 2 > 1.7
    # Closing in on the solution is quadratic although the load follows the body.
    residuals = problem.history.steps[-1].residuals
    assert residuals[-1] < 1e-9 and len(residuals) <= 5


def test_axial_reaction_of_a_cylinder_is_the_integral_of_stress():
    problem = disc(8, QUADRILATERAL)
    V = problem.particles.V
    problem.bcs[:] = [scenes.fix(V, scenes.at(1, z), component=1) for z in (0.0, 0.125)]
    problem.solve(steps=4)
    particles = problem.particles
    # Across the wall at constant z: int sigma_zz 2 pi r dr = int sigma_zz (2 pi r dA) / height
    area = 2 * np.pi * particles.centroid[:, 0] * particles.volume / 0.125
    force = scenes.total(particles, particles.stress[:, 1, 1] * area)
    assert problem.reaction(problem.bcs[1])[1] == pytest.approx(force, rel=1e-2)
    assert problem.reaction(problem.bcs[0])[1] == pytest.approx(-force, rel=1e-2)


def test_tangent_of_follower_pressure_by_finite_differences():
    problem = disc(4, TRIANGLE)
    worst = []

    def check(snes, iteration, norm):
        if iteration != 1:
            return
        x = snes.getSolution()
        K = problem.reduced.tangent().copy()
        direction = x.duplicate()
        start, end = direction.getOwnershipRange()
        direction.array_w[:] = np.sin(np.arange(start, end) + 1.0)
        product = x.duplicate()
        K.mult(direction, product)
        sides, h = [], 1e-6
        for sign in (1, -1):
            point, F = x.copy(), x.duplicate()
            point.axpy(sign * h, direction)
            assert problem.reduced.residual(point, F) is None
            sides.append(F)
        sides[0].axpy(-1.0, sides[1])
        sides[0].scale(0.5 / h)
        sides[0].axpy(-1.0, product)
        worst.append(sides[0].norm() / product.norm())
        problem.reduced.residual(x, problem.b)
        problem.reduced.tangent()

    problem.solver.setMonitor(check)
    problem.solve(steps=2)
    assert len(worst) == 2 and max(worst) < 1e-6


@pytest.mark.parametrize(
    ("case", "material"),
    [
        (A, Hencky(A.young, A.poisson)),
        (B, VonMises(B.young, B.poisson, rho_y=B.rho_y)),
    ],
    ids="AB",
)
def test_two_half_columns_are_one_column(case, material):
    ne, h = 8, case.length / 8
    V = vectors(box([0.0, 0.0], [h, case.length], [1, ne], QUADRILATERAL))
    bcs = [
        scenes.fix(V, scenes.at(0, 0.0, h), component=0),
        scenes.fix(V, scenes.at(1, 0.0), component=1),
    ]
    cuts = [[0.0, case.length], [0.0, case.length / 2, case.length]]
    runs = []
    for ends in cuts:
        bodies = []
        for low, high in itertools.pairwise(ends):
            cells = round(2 * ne * (high - low) / case.length)
            bodies.append(mpm.Particles(box([0.0, low], [h, high], [2, cells], QUADRILATERAL), V))
        problem = posed(
            mpm.QuasiStaticProblem,
            bodies if len(bodies) > 1 else bodies[0],
            material,
            density=case.density,
            body_force=(0.0, -10.0),
            bcs=bcs,
            petsc_options={"snes_rtol": 1e-11},
        )
        problem.solve(steps=10)
        centres = scenes.gather(np.concatenate([b.initial_centroid for b in bodies]))
        order = np.lexsort(centres.round(6).T)
        runs.append(scenes.gather(np.concatenate([b.stress for b in bodies]))[order])
        assert all(float(b.load.value) == 1.0 for b in bodies)
    assert np.abs(runs[0] - runs[1]).max() < 1e-10 * np.abs(runs[0]).max()
    assert problem.yield_function.shape == (sum(b.num_local for b in bodies),)


@pytest.mark.parametrize("cell", [QUADRILATERAL, TRIANGLE], ids=scenes.name)
def test_two_bodies_whose_nodes_do_not_match(cell):
    # Next to each other in a cell, their nodes make T nearly singular: its singular values of 1e-7
    # are neither zero nor large enough for Newton's method.
    V = vectors(box([0.0, 0.0], [4.0, 4.0], [16, 16], QUADRILATERAL))
    lower = mpm.Particles(box([0.0, 0.0], [2.0, 1.0], [8, 4], cell), V)
    upper = mpm.Particles(box([0.3, 1.0], [1.7, 2.0], [9, 9], TRIANGLE), V)
    problem = mpm.QuasiStaticProblem(
        [
            mpm.Body(p, VonMises(1e3, 0.3, rho_y=20.0), body_force=(0.0, -15.0))
            for p in (lower, upper)
        ],
        bcs=[scenes.fix(V, scenes.at(0, 0.0), component=0), scenes.fix(V, scenes.at(1, 0.0))],
    )
    problem.solve(steps=10)
    assert problem.history.cutbacks == 0 and problem.history.total_iterations <= 40
    assert problem.history.statistics["frozen_residual"] <= 1e-9
    weight = 15.0 * sum(WORLD.allreduce(b.initial_volume.sum()) for b in (lower, upper))
    np.testing.assert_allclose(problem.reaction(problem.bcs[1])[1], weight, rtol=1e-8)


def test_several_bodies_in_ufl_and_their_errors():
    V = vectors(box([0.0, 0.0], [1.0, 2.0], [4, 8], QUADRILATERAL))
    low = mpm.Particles(box([0.0, 0.0], [1.0, 0.5], [8, 4], QUADRILATERAL), V)
    high = mpm.Particles(box([0.0, 0.5], [1.0, 1.0], [8, 4], TRIANGLE), V)
    whole = vectors(scenes.unit(2, scenes.HEXAHEDRON))
    in_space = mpm.Particles(scenes.unit(4, scenes.HEXAHEDRON), whole)
    for bodies, sentence in (
        ([low, low], "twice"),
        ([low, in_space], "same dimension"),
        ([], "one mpm.Body at least"),
        ([low, 3], "made of mpm.Particles, not of a int"),
    ):
        with pytest.raises(mpm.MPMError, match=sentence):
            posed(mpm.QuasiStaticProblem, bodies, Hencky(1e3, 0.3))
    with pytest.raises(mpm.MPMError, match=r"material must be .* not list"):
        mpm.QuasiStaticProblem([mpm.Body(p, [Hencky(1e3, 0.3)] * 3) for p in (low, high)])
    laws = [Hencky(1e3, 0.3), Hencky(4e3, 0.3)]
    problem = mpm.QuasiStaticProblem(
        [
            mpm.Body(low, laws[0], density=2.0, body_force=(0.0, -10.0)),
            mpm.Body(high, laws[1], density=4.0, body_force=(0.0, -10.0)),
        ],
        bcs=[
            scenes.fix(V, scenes.at(0, 0.0, 1.0), component=0),
            scenes.fix(V, scenes.at(1, 0.0), component=1),
        ],
    )
    problem.solve(steps=2)
    assert problem.reaction(problem.bcs[1])[1] == pytest.approx(10 * (2.0 * 0.5 + 4.0 * 0.5))


def test_revolution_needs_a_radius():
    V = vectors(box([-1.0, -1.0], [2.0, 2.0], [6, 6], QUADRILATERAL))
    left = mpm.Particles(box([-0.5, 0.0], [0.5, 1.0], [4, 4], QUADRILATERAL), V)
    with pytest.raises(mpm.MPMError, match="negative radius") as caught:
        mpm.QuasiStaticProblem(mpm.Body(left, Hencky(1e3, 0.3)), axisymmetric=True)
    assert len(caught.value.particles) == 8
    with pytest.raises(mpm.MPMError, match="facet_tags"):
        mpm.QuasiStaticProblem(mpm.Body(left, Hencky(1e3, 0.3), pressures=[(1.0, 1)]))
