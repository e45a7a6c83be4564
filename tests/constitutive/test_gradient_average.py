# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Averages over a length against stock DOLFINx."""

from mpi4py import MPI

import numpy as np
import pytest
from marks import slow

import ufl
from dolfinx import fem, mesh
from dolfinx.fem.petsc import LinearProblem

import mpm_dolfinx as mpm
from mpm_dolfinx.constitutive.gradient_average import GradientAverage
from mpm_dolfinx.constitutive.strain import strain_of

comm = MPI.COMM_WORLD
LENGTH = 0.3


def body_of(degree, kind, dim):
    cells = mesh.CellType.quadrilateral if dim == 2 else mesh.CellType.hexahedron
    box = mesh.create_rectangle if dim == 2 else mesh.create_box
    background = box(comm, [[0.0] * dim, [3.0] * dim], [3] * dim, cells)
    V = fem.functionspace(background, ("Lagrange", degree, (dim,)))
    body = box(comm, [[0.5] * dim, [2.0, 1.5, 1.0][:dim]], [6, 4, 2][:dim], kind)
    return mpm.Particles(body, V, degree=degree, quadrature_degree=2 * degree)


@pytest.mark.parametrize("axisymmetric", [False, True])
@pytest.mark.parametrize("degree", [*slow(1), 2])
@pytest.mark.parametrize("kind", ["quadrilateral", "triangle"])
def test_average_is_that_of_finite_elements(kind, degree, axisymmetric):
    particles = body_of(degree, mesh.CellType[kind], 2)
    strain = strain_of(particles, axisymmetric)
    values = particles.quadrature_function("values")
    points = particles.placement.points()
    numbers = np.sin(3.0 * points[:, :, 0]) * points[:, :, 1] ** 2
    values.x.array[: numbers.size] = numbers.ravel()
    found = GradientAverage(strain, LENGTH, np.ones(particles.num_local, dtype=bool)).of(numbers)

    Q = fem.functionspace(particles.mesh, ("Lagrange", degree))
    k, q = ufl.TrialFunction(Q), ufl.TestFunction(Q)
    turn = strain.turn
    a = (
        turn
        * (k * q + LENGTH**2 * ufl.dot(ufl.grad(k), ufl.grad(q)))
        * ufl.dx(degree=2 * degree + 2)
    )
    stock = LinearProblem(
        a,
        turn * values * q * particles.dx,
        petsc_options={"ksp_type": "preonly", "pc_type": "lu"},
        petsc_options_prefix="average_",
    ).solve()
    expression = fem.Expression(stock, values.function_space.element.interpolation_points)
    there = particles.quadrature_function("there")
    there.interpolate(expression)
    reference = there.x.array[: numbers.size].reshape(numbers.shape)
    np.testing.assert_allclose(found, reference, rtol=0.0, atol=1e-10)


def test_what_does_not_count_neither_gives_nor_takes():
    particles = body_of(1, mesh.CellType.hexahedron, 3)
    strain = strain_of(particles, False)
    counts = particles.initial_centroid[:, 0] < 1.0
    values = np.where(counts[:, None], 2.0, 7.0) * np.ones((1, particles.num_points))
    found = GradientAverage(strain, LENGTH, counts).of(values)
    np.testing.assert_allclose(found[counts], 2.0, rtol=1e-11)
    assert not found[~counts].any()


def test_domains_without_common_nodes_are_refused():
    grid = mesh.create_rectangle(comm, [[0, 0], [3, 3]], [3, 3], mesh.CellType.quadrilateral)
    V = fem.functionspace(grid, ("Lagrange", 1, (2,)))
    body = mesh.create_rectangle(comm, [[1, 1], [2, 2]], [2, 2], mesh.CellType.quadrilateral)
    particles = mpm.Particles(body, V, method="mpm")
    law = mpm.materials.Tresca(1e3, 0.3, 1.0).with_softening(10.0, cohesion=0.5)
    with pytest.raises(mpm.MPMError, match=r"length= needs method='cpdi2' of mpm\.Particles"):
        mpm.QuasiStaticProblem(mpm.Body(particles, law, length=0.1))


def test_what_is_taken_away_neither_gives_nor_takes_from_then_on():
    particles = body_of(1, mesh.CellType.quadrilateral, 2)
    average = GradientAverage(
        strain_of(particles, False), LENGTH, np.ones(particles.num_local, dtype=bool)
    )
    gone = particles.initial_centroid[:, 0] > 1.0
    values = np.where(gone[:, None], 7.0, 2.0) * np.ones((1, particles.num_points))
    assert comm.allreduce(average.of(values)[~gone].max(initial=0.0), MPI.MAX) > 2.1
    particles.remove(np.flatnonzero(gone))
    found = average.of(values)
    np.testing.assert_allclose(found[~gone], 2.0, rtol=1e-11)
    assert (found[gone] == 0.0).all()
