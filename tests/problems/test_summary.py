# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What objects say of themselves, and what a run logs."""

import logging

import numpy as np
import pytest
from scenes import QUADRILATERAL, TRIANGLE, block, neo_hookean, slump, unit, vectors

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm


def test_each_object_is_one_helpful_line():
    problem = block(cell=TRIANGLE)
    particles = problem.particles
    assert repr(particles) == (
        "<Particles: 32 triangle domains (cpdi2, degree 1, 1 point each) in a background of 48 "
        "quadrilaterals of degree 1>"
    )
    start = "<QuasiStaticProblem: 1 body, 32 particles, 1 Dirichlet condition; "
    assert repr(problem) == start + "no step yet>"
    assert repr(problem.history) == "<History: no step yet>"
    problem.solve(steps=2)
    count = problem.history.total_iterations
    assert repr(problem.history) == f"<History: 2 steps to load 1, {count} linear solves>"
    assert repr(problem) == f"{start}2 steps to load 1, {count} linear solves>"
    problem.history.cutbacks = 1
    assert repr(problem.history).endswith("linear solves, 1 cutback>")


def test_materials_show_their_parameters():
    law = mpm.materials.VonMises(1e6, 0.3, rho_y=2e4)
    assert repr(law) == "VonMises(young=1e+06, poisson=0.3, rho_y=20000, hardening=0)"
    varied = law.with_parameters(young=np.array([1.0, 3.0]))
    assert "young=<2 values from 1 to 3>" in repr(varied)
    young = fem.Function(fem.functionspace(unit(2, TRIANGLE), ("DG", 0)), name="stiffness")
    young.x.array[:] = 5.0
    assert "young=<Function 'stiffness'>" in repr(mpm.materials.Hencky(young, 0.3))


@pytest.mark.parametrize("solved", [False, True])
def test_summary_is_a_screenful_and_the_same_on_all_ranks(solved):
    problem = slump(TRIANGLE, 1e4, h=1.0)
    if solved:
        problem.solve(steps=2)
    text = problem.summary()
    lines = text.splitlines()
    assert len(lines) <= 24 and all(len(line) <= 80 for line in lines)
    assert "VonMises(young=1e+06" in text and "2 Dirichlet conditions" in text
    assert ("seconds" in text) == solved
    comm = problem.particles.mesh.comm
    assert comm.bcast(text) == text
    if solved:
        largest = np.linalg.norm(problem.particles.displacement.x.array.reshape(-1, 2), axis=1)
        largest = max(comm.allgather(float(largest.max(initial=0.0))))
        assert f"displacement up to {largest:.4g}" in " ".join(text.split())


def test_summary_of_a_residual_in_ufl():
    V = vectors(unit(4, QUADRILATERAL))
    particles = mpm.Particles(unit(4, TRIANGLE), V)
    energy = neo_hookean(particles.displacement) * particles.dx
    R = ufl.derivative(energy, particles.displacement, ufl.TestFunction(particles.W))
    text = mpm.ParticleProblem(R, particles).summary()
    assert "residual in UFL" in text and "32 triangle domains" in text


def test_steps_and_iterations_are_logged_on_one_rank(caplog):
    problem = block()
    caplog.set_level(logging.INFO, logger="mpm_dolfinx")
    problem.solve(steps=3)
    comm = problem.particles.mesh.comm
    told = [r.getMessage() for r in caplog.records if r.name == "mpm_dolfinx.steps"]
    newton = [r for r in caplog.records if r.name == "mpm_dolfinx.newton"]
    if comm.rank > 0:
        assert not told and not newton
        return
    iterations = problem.history.iterations
    assert len(told) == 3 and told[0].startswith("step 1: time 0.333333,")
    for number, line in zip(iterations, told, strict=True):
        assert f" {number} iterations, relative residual" in line
    assert len(newton) >= sum(iterations)


def test_cutbacks_are_logged(caplog):
    problem = block(material=mpm.materials.VonMises(1e3, 0.3, rho_y=1e9), force=(0.0, -400.0))
    caplog.set_level(logging.INFO, logger="mpm_dolfinx.steps")
    try:
        problem.solve(steps=1)
    except mpm.MPMError:
        pass
    cutbacks = [r for r in caplog.records if r.getMessage().startswith("cutback ")]
    if problem.particles.mesh.comm.rank == 0:
        assert len(cutbacks) == problem.history.cutbacks > 0


@pytest.mark.skip_in_parallel
@pytest.mark.parametrize("module", [mpm, mpm.materials, mpm.boundary, mpm.plot])
def test_dir_lists_the_public_names(module):
    assert dir(module) == sorted(module.__all__)


def pressed(law, degree=1, n=3, mixed=None, **options):
    """Return a square under its weight on a background that its own cells do not fit."""
    V = vectors(unit(4, QUADRILATERAL), degree)
    particles = mpm.Particles(unit(n, QUADRILATERAL), V, degree=degree)
    body = mpm.Body(particles, law, body_force=(0.0, -1.0))
    bcs, solver = [mpm.held(V, y=0.0)], mpm.Solver(**options)
    return mpm.QuasiStaticProblem(body, bcs=bcs, mixed=mixed, solver=solver)


@pytest.mark.parametrize(
    "law, options, words",
    [
        (mpm.materials.Hencky(1e6, 0.3), {}, "LDL^T by PETSc (symmetric tangent, few unknowns)"),
        (mpm.materials.Hencky(1e6, 0.3), {"shift": 0.0}, "LDL^T by MUMPS (symmetric tangent)"),
        (
            mpm.materials.MohrCoulomb(1e6, 0.3, cohesion=1e6, friction_angle=20.0),
            {},
            "LU by MUMPS (unsymmetric tangent)",
        ),
        (mpm.materials.Hencky(1e6, 0.3), {"petsc_options": {"pc_type": "svd"}}, "preonly with svd"),
    ],
)
def test_the_summary_says_which_solver_was_chosen(law, options, words):
    problem = pressed(law, n=8, **options)
    if problem.particles.mesh.comm.size > 1:
        words = words.replace("PETSc", "MUMPS").replace(", few unknowns", "")
        if "svd" in words:
            return  # PETSc's is for one rank
    assert "linear" not in problem.summary()
    problem.solve()
    text = " ".join(problem.summary().split())
    assert f"solver linear {words}" in text and "stabilisation auto (nothing to hold)" in text


def test_the_summary_counts_what_holds_badly_supported_nodes():
    problem = pressed(mpm.materials.NeoHooke(1e3, 0.3), degree=2, mixed="pressure")
    problem.solve()
    text, counts = " ".join(problem.summary().split()), problem.history.statistics
    assert f"stabilisation auto ({int(counts['ghost_facets'])} ghost facets)" in text
    assert "mixed with a pressure" in text


def test_water_goes_through_time():
    V = vectors(unit(2, QUADRILATERAL), 2)
    particles = mpm.Particles(unit(2, QUADRILATERAL), V, degree=2)
    water = mpm.PoreFluid(0.1)
    body = mpm.Body(particles, mpm.materials.Hencky(1e3, 0.3), pore_fluid=water)
    problem = mpm.PorousProblem(body, bcs=[mpm.held(V, y=0.0)])
    problem.solve(time=80.0, dt=40.0)
    assert "2 steps to time 80," in problem.history.in_words()
