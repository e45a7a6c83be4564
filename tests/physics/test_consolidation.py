# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A soil with water in its pores, which settles as the water leaves (Biot 1941)."""

import numpy as np
import pytest
import scenes
from marks import slow
from scenes import QUADRILATERAL, WORLD

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm


def terzaghi(z, time, terms=2000):
    """Return pressure over the load, z from the drained top over the height (Terzaghi 1943)."""
    M = (2.0 * np.arange(terms) + 1.0) * np.pi / 2.0
    return (2.0 / M * np.sin(np.outer(z, M)) * np.exp(-M * M * time)).sum(axis=1)


def column(n, offset=0.37, settlement=1e-3, comm=WORLD):
    """Return a problem of a column under a load on its top, which alone is drained.

    Its bottom, held there, and its top lie off the grid by a share of a cell. The height is 1, as
    is the load, and time is that over ``H^2 / c_v``.
    """
    h = 1.0 / n
    background = scenes.box([0.0, -2 * h], [2 * h, 1 + 3 * h], (2, n + 5), QUADRILATERAL, comm)
    low = offset * h
    shape = scenes.box([0.0, low], [2 * h, 1 + low], (4, 2 * n), QUADRILATERAL, comm)
    V = scenes.vectors(background, 2)
    particles = mpm.Particles(shape, V, degree=2, quadrature_degree=4)
    p = mpm.ParticleField(
        particles, fem.functionspace(background, ("Lagrange", 1)), at="nodes", name="pressure"
    )
    # (constants, so that forms of all columns are compiled once)
    permeability, size = fem.Constant(shape, settlement), fem.Constant(shape, h)
    oedometric, poisson = 1.0 / permeability, 0.25
    shear = oedometric * (1.0 - 2.0 * poisson) / 2.0 / (1.0 - poisson)
    lame = oedometric - 2.0 * shear
    d, v, q = particles.displacement, ufl.TestFunction(particles.W), ufl.TestFunction(p.W)
    before = fem.Function(particles.W)
    dt = fem.Constant(shape, 1.0)
    tags = scenes.facet_tags(shape, scenes.at(1, 1 + low), scenes.at(1, low))
    ds = ufl.Measure("ds", domain=shape, subdomain_data=tags)
    normal = ufl.FacetNormal(shape)
    strain = ufl.sym(ufl.grad(d))
    stress = 2.0 * shear * strain + (lame * ufl.tr(strain) - p) * ufl.Identity(2)
    R_u = ufl.inner(stress, ufl.grad(v)) * particles.dx + v[1] * ds(1)
    R_u += 1e4 * oedometric / size * d[1] * v[1] * ds(2)
    flow = -permeability * dt  # c_v is 1 then
    R_p = -q * ufl.div(d - before) * particles.dx
    R_p += flow * ufl.dot(ufl.grad(p), ufl.grad(q)) * particles.dx
    R_p += flow * (10.0 / size * p * q) * ds(1)
    R_p -= flow * (ufl.dot(ufl.grad(p), normal) * q + ufl.dot(ufl.grad(q), normal) * p) * ds(1)
    bcs = [scenes.fix(V, scenes.at(0, place), component=0) for place in (0.0, 2 * h)]
    problem = mpm.ParticleProblem([R_u, R_p], particles, bcs=bcs, fields=[p], symmetric=True)
    return problem, p, before, dt, low


def consolidate(n, sizes, **options):
    """Return the error of the pressure after steps of these sizes, in the L2 norm, and more."""
    problem, p, before, dt, low = column(n, **options)
    particles, solves = problem.particles, 0
    particles.load.value = 1.0
    for size in sizes:
        dt.value = size
        solves += problem.step().iterations
        before.x.array[:] = particles.displacement.x.array
    y = p.W.tabulate_dof_coordinates()[:, 1] - low
    exact = fem.Function(p.W)
    exact.x.array[:] = terzaghi(1.0 - y, sum(sizes))
    gap, whole = (
        WORLD.allreduce(fem.assemble_scalar(fem.form(f**2 * particles.dx)))
        for f in (p - exact, exact)
    )
    return np.sqrt(gap / whole), solves, y, p


@pytest.mark.parametrize("settlement", [*slow(1e-3), 0.3])
def test_consolidation_is_of_second_order(settlement):
    """Also where the body settles through cells of the background."""
    errors = [
        consolidate(n, np.full(steps, 0.1 / steps), settlement=settlement)[0]
        for n, steps in ((4, 4), (8, 16))
    ]
    assert errors[1] <= 7.5e-3
    assert np.log2(errors[0] / errors[1]) > 1.8


@pytest.mark.parametrize("offset", [0.0, 0.37])
def test_an_undrained_step_does_not_oscillate(offset):
    _, solves, y, p = consolidate(8, [1e-8], offset=offset)
    inside = p.x.array[y < 0.7]
    assert scenes.largest(inside - 1.0) <= 1e-6
    assert solves <= 3
