# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Finite elements: bodies whose nodes have unknowns of their own, without a background.

With other features they are walked through by ``tests/physics/test_combinations.py``.
"""

from functools import partial

from mpi4py import MPI

import numpy as np
import pytest
import stock
from compare import outcome, raises, same_run
from marks import thinned
from scenes import (
    HEXAHEDRON,
    QUADRILATERAL,
    TETRAHEDRON,
    TRIANGLE,
    WORLD,
    at,
    box,
    facet_tags,
    fix,
    in_order,
    largest,
    vectors,
)

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx import materials

FORCE = {2: (3.0, -20.0), 3: (3.0, -20.0, 5.0)}


def energy(d):
    """Return the stored energy of a neo-Hookean body, in the plane or in space."""
    dim = d.function_space.mesh.geometry.dim
    mu, lmbda = 1e3 / 2.6, 1e3 * 0.3 / 1.3 / 0.4
    F = ufl.Identity(dim) + ufl.grad(d)
    J = ufl.det(F)
    return mu / 2 * (ufl.tr(F.T * F) - dim) - mu * ufl.ln(J) + lmbda / 2 * ufl.ln(J) ** 2


def bar(cell, n):
    dim = 3 if cell in (TETRAHEDRON, HEXAHEDRON) else 2
    return box([0] * dim, [2] + [1] * (dim - 1), [2 * n] + [n] * (dim - 1), cell)


KINDS = [
    (cell, degree)
    for cell in (QUADRILATERAL, TRIANGLE, HEXAHEDRON, TETRAHEDRON)
    for degree in (1, 2)
]


@pytest.mark.parametrize(("cell", "degree"), thinned(3, [*KINDS, (QUADRILATERAL, 3)]))
def test_they_are_those_of_stock_dolfinx(cell, degree):
    body = mpm.Particles(bar(cell, 2), degree=degree)
    dim = body.mesh.geometry.dim
    d, v, dx = body.displacement, ufl.TestFunction(body.W), body.dx
    R = ufl.derivative(energy(d) * dx, d, v)
    R -= body.load * ufl.inner(ufl.as_vector(FORCE[dim]), v) * dx
    how = mpm.Solver(petsc_options={"snes_rtol": 1e-12})
    problem = mpm.ParticleProblem(R, body, bcs=[mpm.held(body.W, where=at(0, 0.0))], solver=how)
    problem.solve(2)

    own = bar(cell, 2)
    W = vectors(own, degree)
    w, v = fem.Function(W), ufl.TestFunction(W)
    load, dx = fem.Constant(own, 0.0), ufl.dx(own, metadata=dx.metadata())
    F = ufl.derivative(energy(w) * dx, w, v) - load * ufl.inner(ufl.as_vector(FORCE[dim]), v) * dx
    for value in (0.5, 1.0):
        load.value = value
        stock.newton(F, w, [fix(W, at(0, 0.0))])
    assert largest(w.x.array) > 0.1
    stock.same_values(d, w, 1e-9)


@pytest.mark.parametrize(
    ("degree", "cells", "within"), [(2, (1, 15), 5e-4), (2, (2, 30), 1e-4), (1, (4, 120), 4e-2)]
)
def test_a_thin_wall_bends(degree, cells, within):
    """Beside Timoshenko's beam; a wall of degree 1 is stiff in shear."""
    width, height, young, force = 0.1, 3.0, 1e6, 1e-3
    wall = mpm.Particles(box([0, 0], [width, height], cells, QUADRILATERAL), degree=degree)
    own = mpm.Body(
        wall,
        materials.LinearElastic(young, 0.0),
        tractions=[((force / width, 0.0), 1)],
        facet_tags=facet_tags(wall.mesh, at(1, height)),
    )
    problem = mpm.QuasiStaticProblem(own, bcs=[mpm.held(wall.W, where=at(1, 0.0))])
    problem.solve(1)
    inertia, shear = width**3 / 12.0, young / 2.0 * width * 5.0 / 6.0
    exact = force * height**3 / 3.0 / young / inertia + force * height / shear
    assert largest(wall.displacement.x.array) == pytest.approx(exact, rel=within)
    assert problem.reaction(problem.bcs[0])[0] == pytest.approx(-force, rel=1e-6)


LAWS = {
    "Hencky": (materials.Hencky(1e3, 0.3), {}),
    "VonMises": (materials.VonMises(1e3, 0.3, rho_y=6.0), {"f_bar": "domain"}),
    "MohrCoulomb": (materials.MohrCoulomb(1e3, 0.3, 4.0, 30.0), {}),
    "degree 2": (materials.VonMises(1e3, 0.3, rho_y=6.0), {"degree": 2}),
    "pressure": (materials.Hencky(1e3, 0.4999), {"degree": 2, "mixed": "pressure"}),
    "axisymmetric": (materials.Hencky(1e3, 0.3), {"axisymmetric": True}),
}


def settled(law, options, kind, free):
    """Return a problem after one step; its background, if any, is a copy of the body's mesh."""
    options = dict(options)
    body, grid = (box([0, 0], [1, 1], [4, 4], QUADRILATERAL) for _ in range(2))
    degree = options.pop("degree", 1)
    V = None if free else vectors(grid, degree)
    particles = mpm.Particles(body, V, degree=degree, quadrature_degree=2 * degree)
    water = mpm.PoreFluid(permeability=1e-3, density=0.0) if kind is mpm.PorousProblem else None
    own = mpm.Body(
        particles,
        law,
        density=1.0,
        body_force=(0.0, -10.0),
        f_bar=options.pop("f_bar", "none"),
        pore_fluid=water,
    )
    V = particles.V
    held = [mpm.held(V, where=at(1, 0.0)), mpm.held(V, 0, where=at(0, 0.0))]
    problem = kind(own, bcs=held, solver=mpm.Solver(stabilisation=None), **options)
    if kind is mpm.QuasiStaticProblem:
        problem.solve(1)
    else:
        problem.solve(time=0.05, dt=0.05)
    return problem


MOTIONS = {
    "midpoint": (mpm.DynamicProblem, {"scheme": "midpoint"}),
    "conserving": (mpm.DynamicProblem, {"scheme": "conserving"}),
    "water": (mpm.PorousProblem, {"degree": 2}),
}


@pytest.mark.parametrize("case", [*LAWS, *MOTIONS])
def test_the_first_step_is_that_on_a_background_with_the_same_nodes(case):
    kind, options = MOTIONS.get(case, (mpm.QuasiStaticProblem, None))
    law, options = LAWS[case] if options is None else (materials.Hencky(1e3, 0.3), options)
    one, two = (settled(law, options, kind, free) for free in (True, False))
    same_run(outcome(one), outcome(two), 1e-9)


def test_bodies_of_both_kinds_touch():
    """A steel footing of finite elements on particles: forces balance, and the mesh is its own."""
    V = vectors(box([-1, -1], [2, 1], [12, 8], QUADRILATERAL))
    soil = mpm.Particles(box([-0.5, -1], [1.5, 0], [16, 8], QUADRILATERAL), V, quadrature_degree=2)
    steel = mpm.Particles(box([0.25, 0], [0.75, 0.5], [4, 4], QUADRILATERAL))
    down = mpm.held(steel.W, value=(0.0, -0.02), where=at(1, 0.5))
    base = mpm.held(V, where=at(1, -1.0))
    bodies = [
        mpm.Body(soil, materials.Hencky(1e4, 0.3)),
        mpm.Body(steel, materials.Hencky(1e6, 0.3)),
    ]
    pair = mpm.contact.Pair(steel, soil, friction=0.3)
    problem = mpm.QuasiStaticProblem(bodies, bcs=[base, down], terms=[pair])
    problem.solve(4)
    force = problem.reaction(base)
    assert force[1] > 100.0
    np.testing.assert_allclose(problem.reaction(down), -force, atol=1e-7 * force[1])
    lines = problem.summary()
    assert "16 quadrilateral finite elements of degree 1, 4 points each" in lines
    assert lines.count("dofs of degree") == 1  # one background
    assert not problem.repartition(0.9)
    mesh = steel.mesh
    problem.repartition(0.0)
    assert steel.mesh is mesh


def test_it_goes_on_from_a_checkpoint(mpi_tmp_path):
    def made():
        body = mpm.Particles(box([0, 0], [1, 1], [4, 4], QUADRILATERAL))
        law = materials.VonMises(1e3, 0.3, rho_y=6.0)
        own = mpm.Body(body, law, density=1.0, body_force=(0.0, -10.0))
        return mpm.QuasiStaticProblem(own, bcs=[mpm.held(body.W, where=at(1, 0.0))])

    whole = made()
    steps = whole.steps(4)
    next(steps), next(steps)
    whole.save(mpi_tmp_path / "state")
    for _ in steps:
        pass
    again = made()
    again.restore(mpi_tmp_path / "state")
    again.solve(4)  # two of them are done
    same_run(outcome(again), outcome(whole), 1e-11 if WORLD.size > 1 else 0.0)


@pytest.mark.parametrize("cell", [QUADRILATERAL, TRIANGLE])
def test_patches_of_elements_do_not_lock(cell):
    """Nearly incompressible: beside elements of degree 2."""

    def top(degree, f_bar):
        body = mpm.Particles(box([0, 0], [1, 1], [8, 8], cell), degree=degree)
        own = mpm.Body(
            body,
            materials.LinearElastic(1e3, 0.4999),
            tractions=[((5.0, 0.0), 1)],
            facet_tags=facet_tags(body.mesh, at(1, 1.0)),
            f_bar=f_bar,
        )
        problem = mpm.QuasiStaticProblem(own, bcs=[mpm.held(body.W, where=at(1, 0.0))])
        problem.solve(1)
        return largest(body.displacement.x.array)

    right = top(2, "none")
    assert top(1, "patch") == pytest.approx(right, rel=0.06)
    assert top(1, "none") < top(1, "patch")


def test_ranks():
    ends = []
    for comm in (MPI.COMM_SELF, WORLD):
        body = mpm.Particles(box([0, 0], [1, 2], [4, 8], QUADRILATERAL, comm))
        law = materials.VonMises(1e3, 0.3, rho_y=6.0)
        own = mpm.Body(body, law, density=1.0, body_force=(0.0, -4.0), f_bar="patch")
        problem = mpm.QuasiStaticProblem(own, bcs=[mpm.held(body.W, where=at(1, 0.0))])
        problem.solve(3)
        ends.append((in_order(body, body.centroid), in_order(body, body.stress)))
    for one, two in zip(*ends, strict=True):
        np.testing.assert_allclose(two, one, rtol=0.0, atol=1e-9 * np.abs(one).max())


def test_what_makes_no_sense():
    body = box([0, 0], [1, 1], [2, 2], QUADRILATERAL)
    V = vectors(box([-1, -1], [2, 2], [3, 3], QUADRILATERAL))
    line = box([0, 0], [1, 1], [2, 2], QUADRILATERAL)
    for options, sentence in (
        ({"method": "cpdi2"}, "needs a background space V"),
        ({"V": V, "method": "fem"}, "omit V"),
        ({"quadrature_degree": 1}, "does not see all strains.*quadrature_degree=2"),
        ({"degree": 2, "quadrature_degree": 3}, "quadrature_degree=4 or more"),
        ({"degree": 4}, "must be 1, 2 or 3"),
        ({"outside": "delete"}, "'delete' does not go with finite elements"),
        ({"on_distortion": "split"}, "can be split"),
        ({"V": vectors(body)}, "or omit it for finite elements"),
    ):
        raises(partial(mpm.Particles, body, **options), mpm.MPMError, sentence)
    free = mpm.Particles(line)
    elsewhere = mpm.held(vectors(line), where=at(1, 0.0))
    own = mpm.Body(free, materials.Hencky(1e3, 0.3))
    raises(
        lambda: mpm.QuasiStaticProblem(own, bcs=[elsewhere]), mpm.MPMError, "not on the background"
    )
    problem = mpm.QuasiStaticProblem(own, bcs=[mpm.held(free.W, where=at(1, 0.0))])
    problem.solve(1)
    raises(problem.rebase, mpm.MPMError, "needs method='cpdi2' without free nodes")
    raises(lambda: problem.split([0]), mpm.MPMError, "can be split")
