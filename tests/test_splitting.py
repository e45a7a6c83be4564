# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Quadrilaterals split into triangles in the middle of a run: what is kept, and what follows."""

import numpy as np
import pytest
import scenes
from scenes import QUADRILATERAL, WORLD

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, VonMises


def column(on_distortion="error", comm=WORLD, density=1000.0, **options):
    """Return a column of quadrilaterals that slumps, bent at first."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [10.0, 10.0], [10, 10], QUADRILATERAL, comm))
    body = scenes.box([0.0, 0.0], [4.0, 8.0], [6, 12], QUADRILATERAL, comm)
    bcs = [scenes.fix(V, scenes.at(i, 0.0), component=i) for i in (0, 1)]
    options.setdefault("body_force", (0.0, -15.0))
    return mpm.QuasiStaticProblem(
        mpm.Particles(body, V, on_distortion=on_distortion),
        options.pop("material", VonMises(1e6, 0.3, rho_y=20e3, hardening=5e4)),
        density=density,
        bcs=bcs,
        **options,
    )


def some(particles, seed=3, share=0.3):
    """Return global indices of some particles, the same on all ranks."""
    count = particles.num_global
    chosen = np.random.default_rng(seed).random(count) < share
    return np.flatnonzero(chosen)


def sums(problem):
    """Return what a split must leave as it was: sums over the body, and at background nodes."""
    p = problem.particles
    volume = p.initial_volume
    masses = problem.nodal_masses(0)
    at_nodes = fem.Function(fem.functionspace(p.mesh, ("Lagrange", 1)))
    np.add.at(at_nodes.x.array, at_nodes.function_space.dofmap.list[: p.num_local], masses)
    at_nodes.x.scatter_reverse(mpm.deletion.la.InsertMode.add)
    work = p.T.createVecLeft()
    work.array_w.reshape(-1, 2)[:] = scenes.own(at_nodes)[:, None]
    on_background = p.T.createVecRight()
    p.T.multTranspose(work, on_background)
    stress = problem._stresses[0]
    strain = stress.variable("elastic_b_minus_identity")[:, 0]
    return {
        "volume": scenes.total(p, volume),
        "present volume": scenes.total(p, p.volume),
        "mass": scenes.total(p, masses.sum(axis=1)),
        "moment of mass": scenes.total(p, np.einsum("nk,nki->ni", masses, p.domains)),
        "mass at nodes of the background": scenes.gather(on_background.array_r.copy()),
        "elastic strain": scenes.total(p, volume[:, None] * strain),
        "plastic strain": scenes.total(p, volume * p.plastic_strain),
        "stress": scenes.total(p, p.volume[:, None, None] * p.stress),
        "F": scenes.total(p, volume[:, None, None] * p.deformation_gradient),
    }


def test_split_keeps_everything():
    problem = column()
    for step in problem.steps(8):
        if step.load == 0.5:
            break
    before = sums(problem)
    p = problem.particles
    kept = [scenes.in_order(p, a) for a in (p.stress, p.plastic_strain, p.deformation_gradient)]
    problem.split(some(p))
    after = sums(problem)
    for name, value in before.items():
        size = np.abs(value).max()
        print(name, np.abs(value-after[name]).max()/size)
        np.testing.assert_allclose(after[name], value, rtol=0.0, atol=1e-12 * size, err_msg=name)
