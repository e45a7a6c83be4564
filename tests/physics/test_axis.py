# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A solid cylinder in uniform compression: the stress is uniform up to the axis."""

import numpy as np
import pytest
import scenes
from marks import all_but
from posed import posed, staged
from routes import ROUTES
from scenes import QUADRILATERAL, TRIANGLE, gather

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, VonMises

FORCE = 10.0
LAW = Hencky(1e3, 0.3)
TOP = 1


def cylinder(
    n=3, off=0.31, degree=1, bent=False, cell=QUADRILATERAL, ratio=2, inner=0.0, **options
):
    """Return particles of a cylinder whose top lies within cells, rollers, and tags."""
    h = 1.0 / n
    top = 1.0 + off * h
    far = inner + 1 + 3 * h
    grid = scenes.box([0, 0], [far, 1 + 3 * h], [round(far / h), n + 3], QUADRILATERAL)
    V = scenes.vectors(grid, degree)
    body = scenes.unit(ratio * n, cell)
    if bent:
        scenes.bend(body, 0.04)
    body.geometry.x[:, 0] += inner
    body.geometry.x[:, 1] *= top
    particles = mpm.Particles(body, V, degree=degree, **options)
    bcs = [scenes.fix(V, scenes.at(i, 0.0), component=i) for i in (0, 1)]
    tags = scenes.facet_tags(body, scenes.at(1, top))
    return particles, bcs[inner > 0.0 :], tags


def pressed(material=LAW, force=FORCE, steps=2, **options):
    """Return a problem with a cylinder under a dead traction on its top, solved."""
    own = {"assembly", "f_bar", "mixed"} & options.keys()
    given = {name: options.pop(name) for name in own}
    particles, bcs, tags = cylinder(**options)
    made = posed(
        mpm.QuasiStaticProblem,
        particles,
        material,
        bcs=bcs,
        axisymmetric=True,
        tractions=[((0.0, -force), TOP)],
        facet_tags=tags,
        petsc_options={"snes_rtol": 1e-13},
        **given,
    )
    made.solve(steps)
    return made


def unevenness(problem, force=FORCE):
    """Return how far nominal stresses are from that of the load, and strains from uniform."""
    particles = problem.particles
    F, stress = gather(particles.deformation_gradient), gather(particles.stress)
    nominal = stress[:, 1, 1] * F[:, 0, 0] * F[:, 2, 2]
    others = np.delete(stress.reshape(-1, 9), 4, axis=1)
    return max(
        np.abs(nominal / -force - 1.0).max(), np.abs(others).max() / force, np.ptp(F, axis=0).max()
    )


CASES = {
    "default": {},
    "finer": {"ratio": 4},
    "coarser": {"ratio": 1},
    "along cells": {"off": 0.0},
    "bent": {"bent": True},
    "bent, patches": {"bent": True, "f_bar": "patch"},
    "patches": {"f_bar": "patch"},
    "domains": {"f_bar": "domain", "quadrature_degree": 2},
    "pressure": {"mixed": "pressure", "degree": 2},
    "stabilised pressure": {"mixed": "stabilised pressure"},
    "2 x 2": {"quadrature_degree": 2},
    "triangles": {"cell": TRIANGLE},
    "degree 2": {"degree": 2, "ratio": 1},
    "by forms": {"route": "reference", "bent": True},
    "nearly incompressible": {"material": Hencky(1e3, 0.4999), "f_bar": "patch"},
    "about to yield": {"material": VonMises(1e3, 0.3, rho_y=1.01 * np.sqrt(2 / 3) * FORCE)},
    "cpdi": {"method": "cpdi"},
    "ring": {"inner": 1.0},
}


QUICK = ("default", "bent, patches", "stabilised pressure", "by forms", "cpdi")


@pytest.mark.parametrize("name", all_but(QUICK, CASES))
def test_uniform_compression(name, take):
    options = dict(CASES[name])
    take(options.pop("route", "loops"))
    assert unevenness(pressed(**options)) < 1e-9


@pytest.mark.parametrize("options", [{}, {"route": "reference"}, {"f_bar": "patch"}], ids=str)
def test_uniform_compression_goes_on_after_a_rebase(options, take):
    options = dict(options)
    take(options.pop("route", "loops"))
    problem = pressed(bent=True, force=60.0, **options)
    problem.rebase()
    before = scenes.in_order(problem.particles, problem.particles.stress)
    problem.step()
    assert unevenness(problem, 60.0) < 1e-9
    np.testing.assert_allclose(
        scenes.in_order(problem.particles, problem.particles.stress), before, atol=1e-9 * 60.0
    )
    plain = pressed(force=60.0, bent=True, **options)
    for one in (problem, plain):
        staged(one, tractions=[((0.0, -90.0), TOP)])
        one.solve(2)
    assert unevenness(problem, 90.0) < 1e-9
    np.testing.assert_allclose(
        problem.particles.centroid, plain.particles.centroid, rtol=0, atol=1e-10
    )


@pytest.mark.parametrize("law", ["penalty", "nitsche"])
def test_pressure_of_contact_is_uniform_up_to_the_axis(law):
    particles, bcs, _ = cylinder()
    top = float(np.abs(particles.mesh.geometry.x[:, 1]).max(initial=0.0))
    top = scenes.largest(top)
    shape = mpm.contact.plane((0.0, top), (0.0, -1.0))
    plate = mpm.contact.Rigid(particles, shape, axisymmetric=True, law=law)
    problem = mpm.QuasiStaticProblem(
        mpm.Body(particles, LAW),
        bcs=bcs,
        axisymmetric=True,
        terms=[plate],
        solver=mpm.Solver(petsc_options={"snes_rtol": 1e-13}),
    )
    problem.solve(2, update=lambda t: plate.move((0.0, -0.01 * t)))
    stress = gather(particles.stress)[:, 1, 1]
    pressures = gather(plate.pressure[plate.touches])
    assert len(pressures)
    assert np.ptp(stress) < 1e-9 * np.abs(stress).max()
    assert np.ptp(pressures) < 1e-9 * pressures.max()


@pytest.mark.parametrize("route", ROUTES, indirect=True)
@pytest.mark.usefixtures("route")
def test_ground_around_an_axis_rests_under_its_weight():
    particles, bcs, _ = cylinder(off=0.0)
    V, gravity = particles.V, (0.0, -9.81)
    V.mesh.topology.create_connectivity(1, 2)
    facets = mesh.locate_entities(V.mesh, 1, scenes.at(0, 1.0))
    wall = fem.locate_dofs_topological(V.sub(0), 1, facets)
    side = fem.dirichletbc(0.0, wall, V.sub(0))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(
            particles,
            Hencky(1e6, 0.3),
            density=2000.0,
            body_force=gravity,
            initial_stress=mpm.geostatic(1.0, 2000.0, 0.5, gravity),
        ),
        bcs=[*bcs, side],
        axisymmetric=True,
    )
    problem.solve()
    settled = 2000.0 * 9.81 / 1e6
    assert scenes.largest(particles.displacement.x.array) < 1e-12 * settled


def test_a_cylinder_swings_as_a_bar():
    """A motion that is uniform across the cylinder does not bend its cross-sections."""
    particles, bcs, _ = cylinder(off=0.0)
    problem = mpm.DynamicProblem(
        mpm.Body(
            particles,
            Hencky(1e3, 0.0),
            density=1.0,
            velocity=lambda x: np.array([0.0 * x[0], -0.1 * x[1]]),
        ),
        bcs=bcs,
        axisymmetric=True,
        solver=mpm.Solver(petsc_options={"snes_rtol": 1e-13}),
    )
    problem.solve(time=0.02, dt=0.005)
    at, stress = gather(particles.initial_centroid), gather(particles.stress)[:, 1, 1]
    for level in np.unique(at[:, 1].round(6)):
        row = stress[np.isclose(at[:, 1], level)]
        assert np.ptp(row) < 1e-8 * np.abs(stress).max()


def test_forms_of_ones_own_around_an_axis_need_more_than_one_point():
    def residual(particles, near=0.0):
        r, d = ufl.SpatialCoordinate(particles.mesh)[0] + near, particles.displacement
        v = ufl.TestFunction(particles.W)
        hoop = ufl.inner(d[0] / r, v[0] / r)
        work = ufl.inner(ufl.sym(ufl.grad(d)), ufl.sym(ufl.grad(v))) + hoop
        return 2.0 * np.pi * r * work * particles.dx

    particles, bcs, _ = cylinder()
    with pytest.raises(mpm.MPMError, match=r"divides a displacement by the radius x\[0\]"):
        mpm.ParticleProblem(residual(particles), particles=particles, bcs=bcs)
    for options in ({"quadrature_degree": 2}, {"cell": TRIANGLE}):
        particles, bcs, _ = cylinder(**options)
        mpm.ParticleProblem(residual(particles), particles=particles, bcs=bcs)


@pytest.mark.parametrize("method", ["gimp", "mpm"])
def test_methods_with_weights_of_the_plane_are_refused(method):
    """Their stress at the axis was wrong by 7 % for boxes along the cells of any grid."""
    with pytest.raises(mpm.MPMError, match="A body of revolution needs method='cpdi2' or 'cpdi'"):
        pressed(method=method, off=0.0)
