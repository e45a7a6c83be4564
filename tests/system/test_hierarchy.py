# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The coarse levels of multigrid."""

from itertools import pairwise

from petsc4py import PETSc

import numpy as np
import pytest
import scenes
from posed import posed
from scenes import HEXAHEDRON, QUADRILATERAL, TETRAHEDRON, TRIANGLE, WORLD

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky
from mpm_dolfinx.system.hierarchy import FieldDofs, interpolations


def begun(cell, degree, n, **options):
    """Return a problem whose step has begun: a block away from the sides of its background."""
    dim = 3 if cell in (TETRAHEDRON, HEXAHEDRON) else 2
    V = scenes.vectors(scenes.box([0.0] * dim, [2.0] * dim, [2 * n] * dim, cell), degree)
    body = scenes.box([0.3] * dim, [1.4] * dim, [round(1.5 * n)] * dim, cell)
    problem = posed(
        mpm.QuasiStaticProblem, mpm.Particles(body, V, degree=degree), Hencky(1e4, 0.3), **options
    )
    problem.reduced.begin([np.zeros_like(problem.particles.increment.x.array)], 1.0)
    return problem


def places(problem):
    """Return points and components of all unknowns, in the order of the numbering."""
    field = problem.reduced.fields[0]
    level = field.level()
    return level.points, level.components


@pytest.mark.parametrize(
    ("cell", "degree", "n"),
    [(QUADRILATERAL, 1, 16), (TRIANGLE, 1, 16), (TRIANGLE, 2, 10), (QUADRILATERAL, 3, 6),
     (HEXAHEDRON, 1, 6), (TETRAHEDRON, 1, 6)],
    ids=str,
)  # fmt: skip
def test_linear_displacements_are_on_all_levels(cell, degree, n):
    problem = begun(cell, degree, n, stabilisation=None)
    points, components = places(problem)
    field = problem.reduced.fields[0].level()
    found = interpolations(WORLD, problem.reduced.unknowns.sizes[0], [field], coarsest=20)
    assert len(found) >= 2
    sizes = [problem.reduced.unknowns.sizes[1]] + [P.getSize()[1] for P in found]
    assert [P.getSize() for P in found] == list(pairwise(sizes))
    assert all(coarse <= 0.7 * fine for fine, coarse in pairwise(sizes))
    # The coarse dofs' places, from which a linear function is interpolated: least squares finds
    # values that give it, exactly.
    gradient = np.array([[0.3, -1.0, 0.4], [2.0, 0.7, -0.2], [0.1, 0.5, 1.0]])
    exact = np.einsum("ni,ni->n", points, gradient[components, : points.shape[1]]) + components
    x = PETSc.Vec().createMPI(problem.reduced.unknowns.sizes, comm=WORLD)
    x.array_w[:] = exact
    values, P = scenes.gather(exact), scenes.dense(found[0])
    for other in found[1:]:
        P = P @ scenes.dense(other)
    assert np.allclose(P.sum(axis=1), 1.0, rtol=0.0, atol=1e-13)
    best = np.linalg.lstsq(P, values, rcond=1e-12)[0]
    assert np.abs(P @ best - values).max() < 1e-10


def test_fields_have_levels_of_their_own():
    lines = [np.linspace(0.0, 8.0, 9)] * 2
    grid = np.stack(np.meshgrid(*[np.linspace(0.0, 8.0, 17)] * 2), axis=-1).reshape(-1, 2)
    mine = np.array_split(np.arange(len(grid)), WORLD.size)[WORLD.rank]
    n = len(mine)
    one = FieldDofs(np.arange(n), grid[mine], np.zeros(n, dtype=np.int64), lines, 1)
    two = FieldDofs(
        n + np.arange(2 * n),
        np.repeat(grid[mine], 2, axis=0),
        np.tile([0, 1], n),
        [np.linspace(0.0, 8.0, 5)] * 2,
        2,
    )
    found = interpolations(WORLD, 3 * n, [one, two], coarsest=30)
    assert [P.getSize() for P in found[:2]] == [(3 * 17**2, 9**2 + 2 * 5**2), (131, 25 + 18)]
    kind = scenes.gather(np.concatenate([np.zeros(n), 1 + np.tile([0, 1], n)]))
    P = scenes.dense(found[0])
    used = [set(np.flatnonzero(P[kind == k].any(axis=0))) for k in range(3)]
    assert [len(columns) for columns in used] == [81, 25, 25]
    assert not used[0] & used[1] and not used[1] & used[2] and not used[0] & used[2]


def test_few_unknowns_have_no_levels():
    assert begun(QUADRILATERAL, 1, 4).reduced.levels.interpolations(600) == []
