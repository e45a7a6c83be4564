# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bodies to be split and rebased in the middle of a run, and what that must leave as it is."""

import numpy as np
import scenes
from posed import posed
from scenes import HEXAHEDRON, PLANE, QUADRILATERAL, TETRAHEDRON, WORLD

from dolfinx import fem, la

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, VonMises


def column(comm=WORLD, policy="error", outside="error", **options):
    """Return a column of quadrilaterals that slumps, of two materials, under a pressure."""
    V = scenes.vectors(scenes.box([0.0, 0.0], [10.0, 10.0], [10, 10], QUADRILATERAL, comm))
    body = scenes.box([0.0, 0.0], [4.0, 8.0], [6, 12], QUADRILATERAL, comm)
    young = fem.Function(fem.functionspace(body, ("DG", 0)))
    young.interpolate(lambda x: 1e6 * (1.0 + 0.05 * x[1]))
    defaults = {
        "material": {1: VonMises(young, 0.3, rho_y=20e3, hardening=5e4), 2: Hencky(2e6, 0.3)},
        "cell_tags": scenes.cell_tags(body, lambda x: 1 + (x[:, 1] > 6.0)),
        "facet_tags": scenes.facet_tags(body, scenes.at(1, 8.0), scenes.at(0, 4.0)),
        "pressures": [(5e3, 1)],
        "tractions": [((2e3, -1e3), 2)],
        "density": lambda x: 1000.0 + 50.0 * x[0],
        "body_force": (0.0, -12.0),
        "bcs": [scenes.fix(V, scenes.at(i, 0.0), component=i) for i in (0, 1)],
    }
    particles = mpm.Particles(body, V, on_distortion=policy, outside=outside)
    return posed(mpm.QuasiStaticProblem, particles, **{**defaults, **options})


def some(particles, seed=3, share=0.3):
    """Return global indices of some particles, the same on any number of ranks."""
    return np.flatnonzero(np.random.default_rng(seed).random(particles.num_global) < share)


def half_way(problem, steps=8):
    """Take a problem to half of its load."""
    for step in problem.steps(steps):
        if step.load == 0.5:
            return problem
    raise AssertionError


def on_background(particles, vector):
    """Return T^T times a vector of W, by global dof of V."""
    result = particles.T.createVecRight()
    particles.T.multTranspose(vector, result)
    return scenes.gather(result.array_r.copy(), particles.mesh.comm)


def sums(problem):
    """Return what a split must leave as it is: sums over the body, and at background nodes."""
    p = problem.particles
    volume, masses = p.initial_volume, problem.built.mass_matrices(0).sum(axis=2)
    degree = p.W.ufl_element().degree
    at_nodes = fem.Function(fem.functionspace(p.mesh, ("Lagrange", degree)))
    np.add.at(at_nodes.x.array, at_nodes.function_space.dofmap.list[: p.num_local], masses)
    at_nodes.x.scatter_reverse(la.InsertMode.add)
    work = p.T.createVecLeft()
    work.array_w.reshape(-1, p.mesh.geometry.dim)[:] = scenes.own(at_nodes)[:, None]
    forms = problem.built.body_terms[0].forms
    forms.assemble_external()
    (stress,) = problem.points
    strain = stress.strain.average(stress.last.variable("elastic_b_minus_identity"))
    return {
        "volume": scenes.total(p, volume),
        "present volume": scenes.total(p, p.volume),
        "mass": scenes.total(p, masses.sum(axis=1)),
        "moment of mass": scenes.total(p, np.einsum("nk,nki->ni", masses, p.domains)),
        "mass at nodes of the background": on_background(p, work),
        "external forces": on_background(p, forms.external),
        "forces": on_background(p, forms.assemble_residual()),
        "elastic strain": scenes.total(p, volume[:, None] * strain),
        "plastic strain": scenes.total(p, volume * p.plastic_strain),
        "stress": scenes.total(p, p.volume[:, None, None] * p.stress),
        "F": scenes.total(p, volume[:, None, None] * p.deformation_gradient),
        "reactions": np.array([problem.reaction(bc) for bc in problem.bcs]),
    }


def block_of(cell, degree=1, **options):
    """Return a bent block of plastic material on a roller, pulled at its side and pushed on top."""
    dim = 2 if cell in PLANE else 3
    grid = QUADRILATERAL if dim == 2 else HEXAHEDRON
    n = 4 if degree == 1 else 6 - dim - degree // 2
    V = scenes.vectors(scenes.box([0.0] * dim, [2.0] * dim, [n] * dim, grid), degree)
    count = 2 if cell == TETRAHEDRON and degree == 1 else n
    body = scenes.bend(scenes.box([0.0] * dim, [1.0] * dim, [count] * dim, cell), 0.03)
    force, pull = np.zeros(dim), np.zeros(dim)
    force[:2], pull[0] = (2.0, -10.0), 4.0
    return posed(
        mpm.QuasiStaticProblem,
        mpm.Particles(body, V, degree=degree),
        VonMises(1e3, 0.3, yield_stress=12.0, hardening=200.0),
        density=2.0,
        body_force=tuple(force),
        facet_tags=scenes.facet_tags(body, scenes.at(0, 1.0), scenes.at(1, 1.0)),
        tractions=[(tuple(pull), 1)],
        pressures=[(6.0, 2)],
        bcs=[scenes.fix(V, scenes.at(i, 0.0), component=i) for i in range(dim)],
        **options,
    )
