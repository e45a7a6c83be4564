# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Point MPM, GIMP and CPDI beside CPDI2: weights, updates, published errors."""

import numpy as np
import pytest
import scenes
from scenes import (
    HEXAHEDRON,
    QUADRILATERAL,
    TETRAHEDRON,
    TRIANGLE,
    WORLD,
    A,
    B,
    box,
    vectors,
)

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, VonMises

METHODS = ["cpdi2", "cpdi", "gimp", "mpm"]


def law(case):
    if np.isfinite(case.rho_y):
        return VonMises(case.young, case.poisson, rho_y=case.rho_y)
    return Hencky(case.young, case.poisson)


# -- Errors that independent codes publish or gave when they were run -----------------------


@pytest.mark.parametrize(
    ("case", "ne", "method", "error"),
    [
        (A, 16, "gimp", 3.659e-3),
        (A, 64, "gimp", 4.357e-4),
        (B, 16, "gimp", 3.844e-3),
        (A, 16, "mpm", 8.7e-2),
        (A, 64, "mpm", 8.3e-2),
        (A, 16, "cpdi", 2.57e-3),
    ],
)
def test_errors_of_the_columns(case, ne, method, error):
    problem = scenes.column(case, ne, QUADRILATERAL, law(case), method=method)
    problem.solve(steps=40)
    along = case.stress(problem.particles.initial_centroid[:, 1])[1]
    assert scenes.stress_error(problem, case, 1, along) == pytest.approx(error, rel=0.01)
    assert sum(problem.history.iterations) <= (170 if method == "mpm" else 130)


# -- Weights --------------------------------------------------------------------------------


def hat(x, node, h):
    """Return the one-dimensional basis function of a node and its slope."""
    r = (x - node) / h
    inside = np.abs(r) < 1
    return np.where(inside, 1 - np.abs(r), 0.0), np.where(inside, -np.sign(r) / h, 0.0)


def box_average(centre, half, node, h, samples=4001):
    """Return the average of a hat and of its slope over an interval, by brute force."""
    edges = np.linspace(centre - half, centre + half, samples)
    values, _ = hat(edges, node, h)
    average = np.sum((values[1:] + values[:-1]) / 2) / (samples - 1)
    return average, (values[-1] - values[0]) / (2 * half)


def moved_particles(method, gradient, lengths=(0.1, 0.1), **options):
    """Return 2 x 2 boxes in a 6 x 6 grid of cells 0.25, displaced linearly."""
    V = vectors(box([-0.5, -0.5], [1.0, 1.0], [6, 6], QUADRILATERAL))
    corner = [0.03 + 2 * lengths[0], 0.07 + 2 * lengths[1]]
    body = box([0.03, 0.07], corner, [2, 2], QUADRILATERAL)
    particles = mpm.Particles(body, V, method=method, **options)
    scenes.move(particles, lambda X: X @ np.array(gradient).T + [0.013, -0.021])
    return particles


def dense_weights(particles):
    """Return S and grad S of all particles as dense arrays, and the nodes' positions."""
    w = particles.weights()
    x = scenes.coordinates(particles.V)
    S = np.zeros((particles.num_local, len(x)))
    G = np.zeros((*S.shape, x.shape[1]))
    row = np.repeat(np.arange(len(S)), np.diff(w.offsets))
    S[row, w.nodes], G[row, w.nodes] = w.S, w.grad_S
    return S, G, x


GRADIENT = [[0.2, 0.15], [-0.1, -0.15]]


@pytest.mark.parametrize("lengths", [(0.1, 0.1), (0.22, 0.09), (0.3, 0.4)])
@pytest.mark.parametrize("update", ["stretch", "fixed"])
def test_gimp_weights_are_averages_over_the_box(lengths, update):
    # The last box is larger than a cell, where the five-branch formula does not hold.
    particles = moved_particles("gimp", GRADIENT, lengths, domain_update=update)
    S, G, x = dense_weights(particles)
    F = np.eye(2) + GRADIENT
    values, vectors_ = np.linalg.eigh(F.T @ F)
    U = vectors_ @ np.diag(np.sqrt(values)) @ vectors_.T
    half = 0.5 * np.array(lengths) * (np.diag(U) if update == "stretch" else 1.0)
    centre = particles.centroid
    for p in range(particles.num_local):
        for i, node in enumerate(x):
            (sx, gx), (sy, gy) = (
                box_average(centre[p, k], half[k], node[k], 0.25) for k in range(2)
            )
            assert S[p, i] == pytest.approx(sx * sy, abs=2e-7)
            np.testing.assert_allclose(G[p, i], [gx * sy, sx * gy], atol=2e-6)
    spans = np.ptp(particles.domains, axis=1)
    np.testing.assert_allclose(spans, np.tile(2 * half, (len(spans), 1)), rtol=1e-12)


def test_mpm_weights_are_the_basis_at_the_particle():
    particles = moved_particles("mpm", GRADIENT)
    S, G, x = dense_weights(particles)
    for p, centre in enumerate(particles.centroid):
        (sx, gx), (sy, gy) = (hat(centre[k], x[:, k], 0.25) for k in range(2))
        np.testing.assert_allclose(S[p], sx * sy, atol=1e-12)
        np.testing.assert_allclose(G[p], np.stack([gx * sy, sx * gy], axis=1), atol=1e-11)


def test_cpdi_weights_are_those_of_the_parallelogram():
    # Sadeghirad, Brannon & Burghardt (2011), eqs 17 and 18: corners x_p -+ r1 -+ r2 with the
    # current half-edges r1, r2.
    particles = moved_particles("cpdi", GRADIENT)
    S, G, x = dense_weights(particles)
    r1, r2 = (np.eye(2) + GRADIENT) @ (0.05 * np.eye(2))
    r1, r2 = np.array([r1[0], r2[0]]), np.array([r1[1], r2[1]])
    volume = 4 * abs(r1[0] * r2[1] - r1[1] * r2[0])
    for p, centre in enumerate(particles.centroid):
        N = []
        for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
            (sx, _), (sy, _) = (hat((centre + s * r1 + t * r2)[k], x[:, k], 0.25) for k in (0, 1))
            N.append(sx * sy)
        slope = np.outer(N[0] - N[2], [r1[1] - r2[1], r2[0] - r1[0]])
        slope += np.outer(N[1] - N[3], [r1[1] + r2[1], -r1[0] - r2[0]])
        np.testing.assert_allclose(S[p], sum(N) / 4, atol=1e-12)
        np.testing.assert_allclose(G[p], slope / volume, atol=1e-10)


@pytest.mark.parametrize("method", METHODS)
def test_linear_completeness(method):
    S, G, x = dense_weights(particles := moved_particles(method, GRADIENT))
    np.testing.assert_allclose(S.sum(axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(S @ x, particles.centroid, atol=1e-12)
    np.testing.assert_allclose(G.sum(axis=1), 0.0, atol=1e-10)
    np.testing.assert_allclose(
        np.einsum("pid,ic->pdc", G, x), np.tile(np.eye(2), (len(G), 1, 1)), atol=1e-10
    )


# -- Motion ---------------------------------------------------------------------------------


@pytest.mark.parametrize("method", METHODS)
def test_a_linear_motion_of_the_background_is_followed_exactly(method):
    V = vectors(box([-1.0, -1.0], [2.0, 2.0], [12, 12], QUADRILATERAL))
    body = box([0.1, 0.2], [0.6, 0.5], [5, 3], QUADRILATERAL)
    condition, values = scenes.everywhere(V)
    problem = mpm.QuasiStaticProblem(
        mpm.Particles(body, V, method=method), Hencky(1e3, 0.3), bcs=[condition]
    )
    centre = problem.particles.centroid.copy()
    turn, F = 0.0, np.eye(2)
    for _ in range(8):
        # Each step shears and turns the background as it is now; totals are sums of changes.
        turn += 0.1
        step = np.array([[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]])
        step = step @ [[1.0, 0.05], [0.0, 1.0]]
        x = V.tabulate_dof_coordinates()[:, :2]
        values.x.array[:] += (x @ (step - np.eye(2)).T).ravel()
        problem.step()
        F, centre = step @ F, centre @ step.T
    particles = problem.particles
    np.testing.assert_allclose(particles.centroid, centre, atol=1e-12)
    np.testing.assert_allclose(
        particles.deformation_gradient[:, :2, :2], np.tile(F, (len(centre), 1, 1)), atol=1e-11
    )
    np.testing.assert_allclose(particles.volume, particles.initial_volume, rtol=1e-11)


def test_cpdi_is_cpdi2_on_triangles():
    runs = []
    for method in ("cpdi", "cpdi2"):
        problem = scenes.slump(TRIANGLE, 20e3, h=1.0, method=method)
        problem.solve(steps=20)
        runs.append(scenes.in_order(problem.particles, problem.particles.domains))
    assert np.abs(runs[0]).max() > 8.0
    np.testing.assert_allclose(runs[0], runs[1], atol=1e-9)


def test_cpdi_is_cpdi2_on_tetrahedra():
    runs = []
    for method in ("cpdi", "cpdi2"):
        V = vectors(box([0.0] * 3, [2.0, 2.0, 1.2], [4, 4, 3], HEXAHEDRON))
        body = box([0.0] * 3, [1.0, 1.0, 1.0], [3, 3, 3], TETRAHEDRON)
        bcs = [scenes.fix(V, scenes.at(i, 0.0), component=i) for i in range(3)]
        problem = mpm.QuasiStaticProblem(
            mpm.Particles(body, V, method=method),
            Hencky(1e3, 0.3),
            body_force=(0.0, 0.0, -300.0),
            bcs=bcs,
            stabilisation=None,
        )
        problem.solve(steps=4)
        runs.append(scenes.in_order(problem.particles, problem.particles.domains))
    assert np.abs(runs[0] - runs[1]).max() < 1e-10


def test_boxes_without_a_mesh_are_those_of_a_mesh():
    V = vectors(box([0.0, -0.25], [2.0, 1.25], [8, 6], QUADRILATERAL))
    held = scenes.fix(V, scenes.at(0, 0.0))
    bodies = [mpm.Particles(box([0.0, 0.0], [1.0, 1.0], [8, 8], QUADRILATERAL), V, method="gimp")]
    mine = bodies[0].initial_centroid
    bodies.append(mpm.Particles.from_points(mine, 0.125, V))
    stresses = []
    for particles in bodies:
        problem = mpm.QuasiStaticProblem(
            particles, Hencky(1e3, 0.3), density=2.0, body_force=(0.0, -10.0), bcs=[held]
        )
        problem.solve(steps=4)
        stresses.append(particles.stress)
    scale = scenes.largest(stresses[0])
    assert scenes.largest(stresses[0] - stresses[1]) < 1e-9 * scale


# -- What does not exist --------------------------------------------------------------------


def test_gimp_needs_boxes_on_a_grid():
    grid = vectors(box([-1.0, -1.0], [2.0, 2.0], [6, 6], QUADRILATERAL))
    triangles = vectors(box([-1.0, -1.0], [2.0, 2.0], [6, 6], TRIANGLE))
    sheared = vectors(scenes.shear(box([-1.0, -1.0], [2.0, 2.0], [6, 6], QUADRILATERAL)))
    boxes = scenes.unit(4, QUADRILATERAL)
    with pytest.raises(mpm.MPMError, match="domains that are axis-aligned"):
        mpm.Particles(scenes.unit(4, TRIANGLE), grid, method="gimp")
    with pytest.raises(mpm.MPMError, match="domains that are axis-aligned"):
        mpm.Particles(scenes.bend(scenes.unit(4, QUADRILATERAL), 0.02), grid, method="gimp")
    for V in (triangles, sheared):
        with pytest.raises(mpm.MPMError, match="structured background"):
            mpm.Particles(boxes, V, method="gimp")
    with pytest.raises(mpm.MPMError, match="domain_update"):
        mpm.Particles(boxes, grid, method="gimp", domain_update="grow")
    with pytest.raises(mpm.MPMError, match="one quadrature point"):
        mpm.Particles(boxes, grid, method="mpm", quadrature_degree=3)


def test_clouds_that_are_none():
    V = vectors(box([0.0, 0.0], [1.0, 1.0], [4, 4], QUADRILATERAL))
    with pytest.raises(mpm.MPMError, match="shape"):
        mpm.Particles.from_points(np.zeros((3, 3)), 0.1, V)
    with pytest.raises(mpm.MPMError, match="lengths"):
        mpm.Particles.from_points(np.full((3, 2), 0.5), np.ones(5), V)
    with pytest.raises(mpm.MPMError, match="positive"):
        mpm.Particles.from_points(np.full((3, 2), 0.5), -0.1, V)
    with pytest.raises(mpm.ParticleOutsideError):
        mpm.Particles.from_points(np.full((3, 2), 1.5), 0.1, V)


def test_a_rank_without_boxes():
    V = vectors(box([0.0, 0.0], [1.0, 1.0], [4, 4], QUADRILATERAL))
    points = np.array([[0.4, 0.4], [0.6, 0.6]])[: 2 if WORLD.rank == 0 else 0]
    particles = mpm.Particles.from_points(points.reshape(-1, 2), 0.2, V)
    assert particles.num_global == 2
    assert scenes.total(particles, particles.volume) == pytest.approx(0.08)
