# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Averaged volume ratios in UFL, against problems with a material, finite elements, differences."""

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from marks import thinned
from posed import posed
from scenes import HEXAHEDRON, QUADRILATERAL, TETRAHEDRON, TRIANGLE, WORLD

import basix.ufl
import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky

YOUNG, POISSON = 1e3, 0.49
SHEAR, BULK = 300.0, 5e5
TIGHT = {"petsc_options": {"snes_rtol": 1e-12}}


def hencky(F):
    """Return Hencky's energy in plane strain, whose round-off is below that of the tests."""
    lame, shear = scenes.lame(YOUNG, POISSON)
    C = F.T * F
    mean = ufl.tr(C) / 2
    root = ufl.sqrt(((C[0, 0] - C[1, 1]) / 2) ** 2 + C[0, 1] ** 2 + 1e-18)
    a, b = ufl.ln(mean + root) / 2, ufl.ln(mean - root) / 2
    return lame / 2 * (a + b) ** 2 + shear * (a**2 + b**2)


def rubber(d, ratio):
    """Return an energy of shape and one of volume: the mean dilatation of groups."""
    dim = d.ufl_shape[0]
    F = ufl.Identity(dim) + ufl.grad(d)
    J = ufl.det(F)
    shape = ufl.tr(F.T * F) * J ** (-2.0 / dim) - dim
    return SHEAR / 2 * shape + BULK / 2 * (ratio - 1) ** 2


def block(cell, rule, bent=0.02, n=4):
    """Return particles of a block in a larger background, and its conditions."""
    dim = 3 if cell in (HEXAHEDRON, TETRAHEDRON) else 2
    grid = QUADRILATERAL if dim == 2 else HEXAHEDRON
    lower, upper = [0.0, -0.75, -0.25][:dim], [1.75, 1.25, 1.25][:dim]
    V = scenes.vectors(scenes.box(lower, upper, [5, 6, 4][:dim], grid))
    body = scenes.bend(scenes.unit(n, cell), bent)
    particles = mpm.Particles(body, V, quadrature_degree=rule)
    return particles, [scenes.fix(V, scenes.at(0, 0.0))]


def weight(particles):
    """Return what a body force downwards adds to a residual."""
    v = ufl.TestFunction(particles.W)
    return particles.load * 20.0 * v[1] * particles.dx_exact


CASES = [
    (QUADRILATERAL, "domain", 2),
    (QUADRILATERAL, "patch", 1),
    (QUADRILATERAL, "patch", 2),
    (TRIANGLE, "patch", 1),
]


def label(value):
    return scenes.name(value) or str(value)


@pytest.mark.parametrize(("cell", "over", "rule"), thinned(2, CASES), ids=label)
def test_is_the_f_bar_of_materials(cell, over, rule):
    particles, bcs = block(cell, rule)
    material = posed(
        mpm.QuasiStaticProblem,
        particles,
        Hencky(YOUNG, POISSON),
        2.0,
        (0.0, -10.0),
        bcs,
        f_bar=over,
        **TIGHT,
    )
    material.solve(steps=2)
    other, bcs = block(cell, rule)
    ratio = mpm.AveragedVolumeRatio(other, over)
    F = ufl.Identity(2) + ufl.grad(other.displacement)
    R = ratio.residual(hencky(ufl.sqrt(ratio / ufl.det(F)) * F) * other.dx) + weight(other)
    problem = posed(mpm.ParticleProblem, R, other, bcs=bcs, symmetric=True, **TIGHT)
    problem.solve(steps=2)
    gap = particles.displacement.x.array - other.displacement.x.array
    assert scenes.largest(gap) < 1e-12 < scenes.largest(other.displacement.x.array)
    assert problem.history.iterations == material.history.iterations


@pytest.mark.parametrize(
    ("cell", "over", "rule"),
    thinned(2, [*CASES[1:], (HEXAHEDRON, "domain", 2), (TETRAHEDRON, "patch", 1)]),
    ids=label,
)
def test_tangent_is_exact_and_symmetric(cell, over, rule):
    particles, bcs = block(cell, rule, n=4 if cell in scenes.PLANE else 2)
    ratio = mpm.AveragedVolumeRatio(particles, over)
    R = ratio.residual(rubber(particles.displacement, ratio) * particles.dx)
    problem = mpm.ParticleProblem(R, particles, bcs=bcs)
    forms, d = problem.built.body_terms[0].forms, particles.displacement.x
    dim = particles.mesh.geometry.dim
    X = particles.W.tabulate_dof_coordinates()[:, :dim]
    start, ahead = (0.02 * np.sin(X @ (shift + np.eye(dim))).ravel() for shift in (1.0, 2.0))

    def residual(displacement):
        d.array[:] = displacement
        ratio.update()
        return forms.assemble_residual().array_r.copy()

    residual(start)
    modes = [ahead, *(np.sin(k * X @ (2.0 + np.eye(dim))).ravel() for k in range(1, 6))]
    products = [scenes.times_tangent(problem, mode) for mode in modes]
    K = WORLD.allreduce(np.array([[m[: len(p)] @ p for p in products] for m in modes]))
    assert np.linalg.norm(K - K.T) < 1e-13 * np.linalg.norm(K) > 0.0
    eps = 1e-5
    change = (residual(start + eps * ahead) - residual(start - eps * ahead)) / (2 * eps)
    size = np.sqrt(WORLD.allreduce(change @ change))
    gap = change - products[0]
    assert np.sqrt(WORLD.allreduce(gap @ gap)) < 1e-7 * size


def mixed_finite_elements(n, load):
    """Return displacements of a hanging block by stock DOLFINx: Q1 and constant pressures."""
    domain = scenes.bend(scenes.unit(n, QUADRILATERAL, MPI.COMM_SELF), 0.02)
    vector = basix.ufl.element("Lagrange", "quadrilateral", 1, shape=(2,))
    constant = basix.ufl.element("Discontinuous Lagrange", "quadrilateral", 0)
    space = fem.functionspace(domain, basix.ufl.mixed_element([vector, constant]))
    w = fem.Function(space)
    d, p = ufl.split(w)
    F = ufl.Identity(2) + ufl.grad(d)
    J = ufl.det(F)
    energy = SHEAR / 2 * (ufl.tr(F.T * F) / J - 2) + p * (J - 1) - p**2 / (2 * BULK)
    rule = ufl.dx(metadata={"quadrature_degree": 3})
    force = fem.Constant(domain, 0.0)
    test = ufl.TestFunction(space)
    R = ufl.derivative(energy * rule, w, test)
    R += force * ufl.split(test)[0][1] * ufl.dx(metadata={"quadrature_degree": 3})
    form, slope = fem.form(R), fem.form(ufl.derivative(R, w))
    subspace, to_whole = space.sub(0).collapse()
    X = subspace.tabulate_dof_coordinates()
    to_whole = np.asarray(to_whole).reshape(-1, 2)
    free = np.setdiff1d(np.arange(len(w.x.array)), to_whole[np.isclose(X[:, 0], 0.0)].ravel())
    for part in (0.5, 1.0):
        force.value = part * load
        for _ in range(20):
            r = fem.assemble_vector(form).array[free]
            K = fem.assemble_matrix(slope).to_dense()[np.ix_(free, free)]
            step = np.linalg.solve(K, r)
            w.x.array[free] -= step
            if np.abs(step[np.abs(step) < 1.0]).max() < 1e-13:
                break
    return X[:, :2], w.x.array[to_whole]


def test_is_the_mixed_method_with_constant_pressures():
    particles, _ = block(QUADRILATERAL, 3)
    body = particles.mesh
    V = scenes.vectors(scenes.bend(scenes.unit(4, QUADRILATERAL), 0.02))
    particles = mpm.Particles(body, V, quadrature_degree=3)
    ratio = mpm.AveragedVolumeRatio(particles)
    d = particles.displacement
    v = ufl.TestFunction(particles.W)
    R = ratio.residual(rubber(d, ratio) * particles.dx)
    R += particles.load * 20.0 * v[1] * ufl.dx(domain=body, metadata={"quadrature_degree": 3})
    bcs = [scenes.fix(V, scenes.at(0, 0.0))]
    problem = posed(mpm.ParticleProblem, R, particles, bcs=bcs, symmetric=True, **TIGHT)
    particles.load.value = 1.0
    problem.step()
    X, exact = mixed_finite_elements(4, 20.0)
    own = particles.W.dofmap.index_map.size_local
    mine = particles.W.tabulate_dof_coordinates()[:own, :2]
    nearest = np.linalg.norm(mine[:, None] - X[None], axis=2).argmin(axis=1)
    gap = d.x.array.reshape(-1, 2)[:own] - exact[nearest]
    assert scenes.largest(exact) > 0.02 and scenes.largest(gap) < 1e-10
    # Volume is kept, and the pressure is that of the volume.
    cells = ratio.function_space.dofmap.list[: particles.num_local, 0]
    np.testing.assert_allclose(ratio.x.array[cells], particles.volume / particles.initial_volume)
    np.testing.assert_allclose(
        ratio.pressure.x.array[cells], BULK * (ratio.x.array[cells] - 1), atol=1e-9
    )


def test_a_failed_step_leaves_the_averages():
    particles, bcs = block(TRIANGLE, None)
    ratio = mpm.AveragedVolumeRatio(particles, "patch")
    R = ratio.residual(rubber(particles.displacement, ratio) * particles.dx) + weight(particles)
    problem = mpm.ParticleProblem(R, particles, bcs=bcs, symmetric=True)
    particles.load.value = 0.5
    problem.step()
    before = ratio.x.array.copy()
    particles.load.value = 1e6
    with pytest.raises(mpm.MPMError):
        problem.step()
    np.testing.assert_array_equal(ratio.x.array, before)


def test_bad_input():
    particles, bcs = block(QUADRILATERAL, None)
    d, v = particles.displacement, ufl.TestFunction(particles.W)
    with pytest.raises(mpm.MPMError, match="choose 'domain' or 'patch'"):
        mpm.AveragedVolumeRatio(particles, "cell")
    with pytest.raises(mpm.MPMError, match="one each"):
        mpm.AveragedVolumeRatio(particles, "domain")
    ratio = mpm.AveragedVolumeRatio(particles, "patch")
    energy = rubber(d, ratio) * particles.dx
    for wrong in (1.0, ufl.derivative(energy, d, v), rubber(d, 1.0) * particles.dx):
        with pytest.raises(mpm.MPMError, match="needs an energy that depends on"):
            ratio.residual(wrong)
    with pytest.raises(mpm.MPMError, match="without its variation"):
        mpm.ParticleProblem(ufl.derivative(energy, d, v), particles, bcs=bcs)
    R = ratio.residual(energy)
    with pytest.raises(mpm.MPMError, match="called before"):
        ratio.residual(energy)
    other = mpm.AveragedVolumeRatio(particles, "patch")
    with pytest.raises(mpm.MPMError, match="not several"):
        mpm.ParticleProblem(R + other.residual(rubber(d, other) * particles.dx), particles)


def test_deleted_domains_have_no_part_in_the_averages():
    particles, bcs = block(QUADRILATERAL, None, n=8)
    ratio = mpm.AveragedVolumeRatio(particles, "patch")
    d = particles.displacement
    energy = rubber(d, ratio) + 7.0 * ratio  # (with a pressure at no deformation)
    R = ratio.residual(energy * particles.dx) + weight(particles)
    mpm.ParticleProblem(R, particles, bcs=bcs, symmetric=True)
    X = particles.W.tabulate_dof_coordinates()[:, :2]
    d.x.array[:] = (0.1 * np.sin(X @ (1.0 + np.eye(2)))).ravel()
    gone = np.flatnonzero((particles.global_index == 0) | (particles.global_index == 5))
    particles.remove(gone)
    ratio.update()
    cells = ratio.function_space.dofmap.list[: particles.num_local, 0]
    there = ~particles.deleted
    values, pressure = (f.x.array[cells][there] for f in (ratio, ratio.pressure))
    np.testing.assert_allclose(pressure, BULK * (values - 1.0) + 7.0, rtol=1e-12)
    assert WORLD.allreduce(int(np.unique(values.round(12)).size)) > 3
