# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bodies that lock are told, and no others."""

import warnings

import numpy as np
import pytest
from scenes import QUADRILATERAL, TRIANGLE, WORLD, box, vectors

import mpm_dolfinx as mpm
from mpm_dolfinx import materials

TOLD = "goes up and down between particles"


def pressed(law, cell=QUADRILATERAL, degree=1, mixed=None, points=None, way=0.03, **options):
    """Return a block that rough plates press, after it; its force; and what was told of locking."""
    V = vectors(box([0, 0], [2, 1.5], [8 // degree, 6 // degree], QUADRILATERAL), degree)
    domains = box([0, 0], [1.6, 1.0], [12 // degree, 8 // degree], cell)
    block = mpm.Particles(domains, V, degree=degree, quadrature_degree=points)
    top = mpm.facet_tags(block.mesh, {1: mpm.region(y=1.0)})
    plate = mpm.boundary.fixed(block, top, 1, value=(0.0, -way))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(block, law, **options),
        bcs=[mpm.held(V, 0, x=0.0), mpm.held(V, y=0.0)],
        supports=[plate],
        mixed=mixed,
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        problem.solve(6)
        problem.step()
    told = [str(one.message) for one in caught if TOLD in str(one.message)]
    return problem, float(problem.reaction(plate)[1]), told


CLAY = materials.VonMises(1e3, 0.49, rho_y=np.sqrt(2.0))


@pytest.mark.parametrize("cell", [QUADRILATERAL, TRIANGLE])
def test_clay_that_locks_is_told_once_and_too_strong(cell):
    _, soft, nothing = pressed(CLAY, cell, f_bar="patch")
    _, stiff, told = pressed(CLAY, cell)
    assert nothing == []
    assert abs(stiff) > 1.15 * abs(soft)
    assert len(told) == (1 if WORLD.rank == 0 else 0)
    assert all("f_bar='patch'" in text for text in told)


def test_a_cut_that_locks_as_its_strength_is_reduced_is_told():
    # By defaults clay bears its weight without yielding, and then several times what it can.
    V = vectors(box([0, 0], [4, 2.5], [16, 10], QUADRILATERAL))
    law = materials.Tresca(1e5, 0.3, cohesion=20.0)
    held = [mpm.held(V, 0, x=0.0), mpm.held(V, y=0.0)]
    factors = {}
    for f_bar in ("patch", "none"):
        clay = mpm.Particles(box([0, 0], [3, 2], [24, 16], QUADRILATERAL), V)
        body = mpm.Body(clay, law, density=2.0, body_force=(0.0, -10.0), f_bar=f_bar)
        problem = mpm.QuasiStaticProblem(body, bcs=held)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            problem.solve(1)
            before = [one for one in caught if TOLD in str(one.message)]
            factors[f_bar] = mpm.strength_reduction(problem, tolerance=0.2, most=8.0).factor
        told = [one for one in caught if TOLD in str(one.message)]
        assert before == []
        assert len(told) == (1 if f_bar == "none" and WORLD.rank == 0 else 0)
    assert factors["none"] > 1.5 * factors["patch"]


def test_an_average_over_a_domain_does_not_cure_four_domains_in_a_cell():
    *_, told = pressed(CLAY, points=2, f_bar="domain")
    assert len(told) == (1 if WORLD.rank == 0 else 0)


def test_what_does_not_lock_is_not_told():
    elastic = materials.Hencky(1e3, 0.3)
    sand = materials.MohrCoulomb(1e3, 0.3, cohesion=1.0, friction_angle=30.0, dilation_angle=30.0)
    pressure = {"degree": 2, "points": 3, "mixed": "pressure"}
    for law, options in ((elastic, {}), (CLAY, pressure), (sand, {"points": 1})):
        assert pressed(law, **options)[2] == []
    # the same pressure everywhere, and no shear but what round-off leaves
    V = vectors(box([0, 0], [2, 2], [4, 4], QUADRILATERAL))
    block = mpm.Particles(box([0, 0], [1, 1], [4, 4], QUADRILATERAL), V)
    tags = mpm.facet_tags(block.mesh, {1: lambda x: (x[0] > 1 - 1e-9) | (x[1] > 1 - 1e-9)})
    problem = mpm.QuasiStaticProblem(
        mpm.Body(block, elastic, pressures=[(10.0, 1)], facet_tags=tags),
        bcs=[mpm.held(V, 0, x=0.0), mpm.held(V, 1, y=0.0)],
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        problem.solve(1)


def test_ground_at_rest_is_not_told_by_what_round_off_leaves_of_its_stress():
    V = vectors(box([0, 0], [4, 4], [8, 8], QUADRILATERAL))
    ground = mpm.Particles(box([0, 0], [4, 3], [16, 12], QUADRILATERAL), V)
    stiff = materials.Tresca(5e6, 0.45, cohesion=12e3)
    at_rest = mpm.geostatic(3.0, 1600.0, 0.9, (0.0, -10.0))
    problem = mpm.QuasiStaticProblem(
        mpm.Body(ground, stiff, density=1600.0, body_force=(0.0, -10.0), initial_stress=at_rest),
        bcs=[mpm.held(V, 0, x=0.0), mpm.held(V, 0, x=4.0), mpm.held(V, y=0.0)],
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        problem.solve()
