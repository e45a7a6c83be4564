# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Reactions balance loads, whatever their size, the tolerance and the contrast of stiffnesses."""

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest
import scenes
from posed import posed
from scenes import QUADRILATERAL, WORLD

from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, LinearElastic
from mpm_dolfinx.parallel.magnitudes import joint_norm, norm, sign_of_product

YOUNG = 1e4


def is_top(x):
    return x[1] > 1.0


def is_inclusion(x):
    return (np.abs(x[0] - 0.5) < 0.25) & (np.abs(x[1] - 1.0) < 0.25)


def column(contrast=1.0, where=is_top, law=LinearElastic, load=10.0, held=None, **options):
    """Return a column on its base, stiff in a part, under a weight that leans."""
    V = scenes.vectors(scenes.box([-0.5, 0.0], [1.5, 2.5], [8, 10], QUADRILATERAL))
    body = scenes.box([0.0, 0.0], [1.0, 2.0], [8, 16], QUADRILATERAL)
    young = fem.Function(fem.functionspace(body, ("DG", 0)))
    cells = np.arange(len(young.x.array), dtype=np.int32)
    middles = mesh.compute_midpoints(body, 2, cells)
    young.x.array[:] = np.where(where(middles.T), contrast, 1.0) * YOUNG
    problem = posed(
        mpm.QuasiStaticProblem,
        mpm.Particles(body, V),
        law(young, 0.3),
        body_force=(-0.15 * load, -0.5 * load),
        bcs=[scenes.fix(V, scenes.at(1, 0.0), component=held)],
        **options,
    )
    return problem


def imbalance(problem, load=10.0):
    """Return what reactions and loads differ by, relative to the load."""
    reaction = problem.reaction(problem.bcs[0]) / load
    return np.abs(reaction - [0.3, 1.0]).max()


def nodal(problem):
    """Return the largest displacement of all nodes."""
    return WORLD.allreduce(np.abs(problem.particles.displacement.x.array).max(), max)


@pytest.mark.parametrize("law", [LinearElastic, Hencky])
@pytest.mark.parametrize("where", [is_top, is_inclusion])
def test_stiff_parts_on_soft_ones(law, where):
    moved = {}
    for contrast in (1e6, 1e10, 1e12):
        problem = column(contrast, where, law)
        problem.solve(steps=1)
        assert problem.history.cutbacks == 0 or contrast < 1e12
        assert imbalance(problem) < 2e-8
        if problem.history.cutbacks == 0:
            moved[contrast] = nodal(problem)
    # The limit of rigid parts, from which a contrast of 1e6 is some 1e-6.
    assert len(moved) >= 2
    np.testing.assert_allclose(list(moved.values()), moved[1e6], rtol=1e-5)


def test_what_is_too_stiff_is_refused():
    problem = column(1e16)
    with pytest.raises(mpm.ConvergenceError):
        problem.solve(steps=1)
    assert not np.any(problem.particles.displacement.x.array)


def test_a_stiff_body_that_nothing_holds():
    problem = column(1e12, held=1)
    with pytest.raises(mpm.MPMError, match="nothing holds the bodies"):
        problem.solve(steps=1)


@pytest.mark.parametrize("law", [LinearElastic, Hencky])
@pytest.mark.parametrize("exponent", [-300, -200, -160, -60, 0])
def test_loads_of_any_size(law, exponent):
    load = 10.0**exponent
    problem = column(law=law, load=load)
    problem.solve(steps=1)
    assert imbalance(problem, load) < 1e-9
    # Linear as far as strains of 4e-4 let the finite law be.
    np.testing.assert_allclose(nodal(problem) / load, 4.01191e-4, rtol=1e-3)


@pytest.mark.parametrize("exponent", [-300, -100, 100, 150])
def test_stiffnesses_of_any_size(exponent):
    unit = 10.0**exponent
    problem = column(unit, lambda x: x[0] < 9.0, Hencky, load=10.0 * unit)
    problem.solve(steps=1)
    assert imbalance(problem, 10.0 * unit) < 1e-9
    same = column(law=Hencky)
    same.solve(steps=1)
    np.testing.assert_allclose(nodal(problem), nodal(same), rtol=1e-9)


@pytest.mark.parametrize("rtol", [1e-1, 1e-2, 1e-4, 1e-6, 1e-11])
@pytest.mark.parametrize("contrast", [1.0, 1e10])
def test_tolerances_of_any_size(rtol, contrast):
    options = {"snes_rtol": rtol}
    problem = column(contrast, law=Hencky, load=100.0, petsc_options=options)
    problem.solve(steps=3)
    assert imbalance(problem, 100.0) < 10.0 * rtol
    assert problem.history.cutbacks == 0


def test_norms_of_vectors_whose_squares_are_no_numbers():
    v = PETSc.Vec().createMPI((5, None), comm=MPI.COMM_WORLD)
    n = v.getSize()
    for size in (1e-320, 1e-310, 1e-200, 1.0, 1e200, 1e300):
        v.set(size)
        rtol = 1e-3 if size < 1e-305 else 1e-14
        np.testing.assert_allclose(norm(v), size * np.sqrt(n), rtol=rtol)
        own = np.full(v.getLocalSize(), size)
        assert np.isclose(joint_norm(own, WORLD), norm(v), rtol=1e-14, atol=0.0)
        w = v.copy()
        w.scale(-1.0)
        assert sign_of_product(v, v) > 0.0 > sign_of_product(v, w)
    v.set(0.0)
    assert norm(v) == 0.0 == sign_of_product(v, v)


def test_norms_of_what_is_not_a_number_on_one_rank():
    v = PETSc.Vec().createMPI((3, None), comm=WORLD)
    v.set(2.0)
    if WORLD.rank == WORLD.size - 1:
        v.setValue(v.getOwnershipRange()[0], np.nan)
    v.assemble()
    assert np.isnan(norm(v))
    assert np.isnan(sign_of_product(v, v))
    assert np.isnan(joint_norm(v.array_r, WORLD))
