# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The neo-Hookean solid against its closed forms and the same energy in UFL."""

from mpi4py import MPI

import numpy as np
import pytest
from laws import in_python

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import NeoHooke, check_tangent

YOUNG, POISSON = 3.0, 0.3
LAW = NeoHooke(YOUNG, POISSON)
ROUTES = pytest.mark.parametrize("law", [LAW, in_python(LAW)], ids=["compiled", "numpy"])


def moved(dim, size=0.3):
    """Displacement gradients of points that are not inverted, one of them at equal stretches."""
    H = size * np.random.default_rng(dim).normal(size=(200, dim, dim))
    H = H[np.linalg.det(np.eye(dim) + H) > 0.1]
    H[0] = 0.2 * np.eye(dim)
    return H


@ROUTES
@pytest.mark.parametrize("dim", [2, 3])
def test_stress_and_energy(law, dim):
    """P = G (F - F^-T) + lambda ln J F^-T."""
    H = moved(dim)
    F, J = np.eye(dim) + H, np.linalg.det(np.eye(dim) + H)
    inverse = np.linalg.inv(F).swapaxes(1, 2)
    G, lame = law.shear, law.lame
    answer = law.update(H, law.initial_state(len(H), dim))
    P = G * (F - inverse) + lame * np.log(J)[:, None, None] * inverse
    np.testing.assert_allclose(answer.first_piola, P, rtol=0.0, atol=1e-13 * np.abs(P).max())
    squares = np.einsum("nij,nij->n", F, F) + 3 - dim
    energy = 0.5 * G * (squares - 3.0) - G * np.log(J) + 0.5 * lame * np.log(J) ** 2
    np.testing.assert_allclose(law.strain_energy(answer.state), energy, atol=1e-13 * energy.max())
    assert check_tangent(law, dim, strain=0.3) < 1e-8


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.49, 0.4999])
@pytest.mark.parametrize("size", [1e-8, 1e-3, 0.3, 1.0])
def test_strain_of_a_stress(poisson, size):
    law, draw = NeoHooke(YOUNG, poisson), np.random.default_rng(3)
    strain = size * draw.normal(size=(500, 6))
    stress = law.integrate(strain, {}, False).stress
    found = law.elastic_strain(stress)
    softest = np.exp(-2.0 * np.abs(strain).max()) * law.shear / (law.lame + 2.0 * law.shear)
    np.testing.assert_allclose(found, strain, rtol=0.0, atol=1e-14 * size / softest)


def test_stresses_that_no_strain_has():
    """Without lateral strain a stress below -G is none: b would have to be negative."""
    law = NeoHooke(YOUNG, 0.0)
    stress = np.zeros((2, 6))
    stress[:, 0] = -0.999 * law.shear, -1.001 * law.shear
    assert np.isfinite(law.elastic_strain(stress)).all(axis=1).tolist() == [True, False]


@pytest.mark.parametrize("dim", [2, 3])
def test_a_given_pressure(dim):
    """The stress is that at another volume, of which the mean is the pressure."""
    H = moved(dim, 0.1)
    pressure = np.linspace(-0.3, 0.3, len(H))
    answer = LAW.at_pressure(
        H, LAW.initial_state(len(H), dim), pressure, np.full(len(H), LAW.shear)
    )
    F, growth = np.zeros((len(H), 3, 3)) + np.eye(3), np.exp(-2.0 / 3.0 * answer.gap)
    F[:, :dim, :dim] += H
    b = growth[:, None, None] * F @ F.swapaxes(1, 2)
    volume = np.log(np.linalg.det(F)) - answer.gap
    found = LAW.cauchy_stress(H, answer.state) * np.linalg.det(F)[:, None, None]
    tau = LAW.shear * (b - np.eye(3)) + LAW.lame * volume[:, None, None] * np.eye(3)
    np.testing.assert_allclose(found, tau, atol=1e-12)


@pytest.mark.parametrize("name", ["particles", "finite elements"])
def test_a_body_of_it_is_that_of_the_energy_in_ufl(name):
    comm, cell = MPI.COMM_WORLD, mesh.CellType.quadrilateral
    ends, force = [], 0.2
    for law in (LAW, None):
        body = mesh.create_rectangle(comm, [[0, 0], [1, 1]], [8, 8], cell)
        grid = mesh.create_rectangle(comm, [[0, 0], [1.5, 1.5]], [6, 6], cell)
        V = fem.functionspace(grid, ("Lagrange", 1, (2,)))
        particles = mpm.Particles(body, V if name == "particles" else None, quadrature_degree=2)
        bcs, d = [mpm.held(particles.V, y=0.0)], particles.displacement
        if law is None:
            F, G, lame = ufl.Identity(2) + ufl.grad(d), LAW.shear, LAW.lame
            squares, J = ufl.inner(F, F) + 1.0, ufl.det(F)
            energy = 0.5 * G * (squares - 3.0) - G * ufl.ln(J) + 0.5 * lame * ufl.ln(J) ** 2
            energy -= force * particles.load * d[0]
            R = ufl.derivative(energy * particles.dx, d, ufl.TestFunction(particles.W))
            problem = mpm.ParticleProblem(R, particles, bcs=bcs)
        else:
            problem = mpm.QuasiStaticProblem(mpm.Body(particles, law, body_force=(force, 0.0)), bcs)
        problem.solve(steps=3)
        ends.append(d.x.array.copy())
    assert comm.allreduce(np.abs(ends[0]).max(), MPI.MAX) > 0.03
    np.testing.assert_allclose(ends[0], ends[1], rtol=0.0, atol=1e-10)
