# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Stability of displacement and pressure on cut cells: the inf-sup test (Chapelle & Bathe 1993)."""

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from marks import slow
from scenes import HEXAHEDRON, QUADRILATERAL, TETRAHEDRON, TRIANGLE

import ufl
from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky

pytestmark = pytest.mark.skip_in_parallel  # everything is on one rank
OFFSETS = (0.0, 0.1, 0.37, 1e-9, 0.9, 0.999)


def inf_sup(cell, n, offset, degree=2, smooth=False):
    """Return the inf-sup constant of degree 2 and 1 for a free block that lies off the grid.

    The norms are ``2 (|strain|^2 + |u|^2)``, with the ghost penalty, and ``p^2 / 2``; the block has
    2 domains in each direction of a cell. ``degree`` is that of the displacement; with ``smooth``
    the stabilisation that belongs to a pressure of degree 1 counts as well.
    """
    comm, dim = MPI.COMM_SELF, 3 if cell in (TETRAHEDRON, HEXAHEDRON) else 2
    h = 1.0 / n
    background = scenes.box([-h] * dim, [1.0 + 2 * h] * dim, [n + 3] * dim, cell, comm)
    body = scenes.box([offset * h] * dim, [1.0 + offset * h] * dim, [2 * n] * dim, cell, comm)
    particles = mpm.Particles(body, scenes.vectors(background, degree), degree=degree)
    p = mpm.ParticleField(particles, fem.functionspace(background, ("Lagrange", 1)), name="p")
    d, v, q = particles.displacement, ufl.TestFunction(particles.W), ufl.TestFunction(p.W)
    product = ufl.inner(ufl.sym(ufl.grad(d)), ufl.sym(ufl.grad(v))) + ufl.inner(d, v)
    R_u = (2.0 * product + p * ufl.div(v)) * particles.dx
    R_p = q * (ufl.div(d) - p / 2.0) * particles.dx
    problem = mpm.ParticleProblem([R_u, R_p], particles, fields=[p], symmetric=True)
    reduced = problem.reduced
    reduced.begin([np.zeros(len(f.bodies[0].increment.x.array)) for f in reduced.fields], 1.0)
    x = reduced.unknowns.restricted(reduced.unknowns.forces)
    assert reduced.residual(x, x.duplicate()) is None
    K = reduced.tangent().convert("dense").getDenseArray().copy()
    own, others = reduced.unknowns.parts
    A, B, M = K[own, own], K[others, own], -K[others, others]
    size = 1.0 / np.sqrt(A.diagonal())
    A, B = A * size * size[:, None], B * size
    unit = 1.0 / np.sqrt(M.diagonal())
    M, B = M * unit * unit[:, None], B * unit[:, None]
    values, vectors = np.linalg.eigh(M)
    seen = values > 1e-12 * values.max()  # others are no pressure anywhere
    S = smoothing(particles, reduced, unit) if smooth else np.zeros_like(M)
    to_seen = vectors[:, seen] / np.sqrt(values[seen])
    B, S = to_seen.T @ B, to_seen.T @ S @ to_seen
    # Where a corner of the block alone sees two nodes of the background, on an edge, they can move
    # so that it does not. That is no motion, and it must not change the volume.
    values, vectors = np.linalg.eigh(A)
    felt = values > 1e-12 * values.max()
    assert np.abs(B @ vectors[:, ~felt]).max(initial=0.0) <= 1e-12
    B = (B @ vectors[:, felt]) / np.sqrt(values[felt])
    return float(np.sqrt(max(np.linalg.eigvalsh(B @ B.T + S)[0], 0.0)))


def smoothing(particles, reduced, unit):
    """Return the stabilisation of a body with a shear modulus of 1, in the unknowns of a system.

    It is the difference of two tangents, of a problem with it and one without.
    """
    law = Hencky(2.6, 0.3)
    problem = mpm.QuasiStaticProblem(mpm.Body(particles, law), mixed="stabilised pressure")
    own = problem.reduced
    own.begin([np.zeros(len(f.bodies[0].increment.x.array)) for f in own.fields], 1.0)
    x = own.unknowns.restricted(own.unknowns.forces)
    assert own.residual(x, x.duplicate()) is None
    K = own.tangent().convert("dense").getDenseArray().copy()
    _, others = own.unknowns.parts
    volumes = own.levels.mass().convert("dense").getDenseArray()  # int p q dX in the system's units
    whole = -K[others, others] - volumes / law.bulk
    theirs = reduced.levels.mass().convert("dense").getDenseArray()
    return whole * (theirs[0, 0] / volumes[0, 0]) * unit * unit[:, None]


@pytest.mark.parametrize("cell", [TRIANGLE, *slow(QUADRILATERAL)], ids=scenes.name)
def test_the_constant_in_the_plane(cell):
    coarse, fine = ([inf_sup(cell, n, offset) for offset in OFFSETS] for n in (3, 6))
    assert min(*coarse, *fine) >= (0.8 if cell is TRIANGLE else 0.97)
    for one, other in zip(coarse, fine, strict=True):
        assert other >= 0.9 * one


@pytest.mark.parametrize(
    "offsets", [OFFSETS[2:3], pytest.param(OFFSETS, marks=pytest.mark.slow)], ids=["one", "all"]
)
def test_the_constant_of_degree_1(offsets):
    """With the stabilisation, without which there is none."""
    coarse, fine = (
        [inf_sup(QUADRILATERAL, n, offset, degree=1, smooth=True) for offset in offsets]
        for n in (4, 8)
    )
    assert min(*coarse, *fine) >= 0.8
    for one, other in zip(coarse, fine, strict=True):
        assert other >= 0.9 * one
    assert inf_sup(HEXAHEDRON, 2, 0.1, degree=1, smooth=True) >= 0.8
    assert inf_sup(QUADRILATERAL, 4, 0.0, degree=1) < 0.1


@pytest.mark.parametrize("cell", [*slow(TETRAHEDRON), HEXAHEDRON], ids=scenes.name)
@pytest.mark.parametrize("offset", [*slow(0.1), 0.999])
def test_the_constant_in_space(cell, offset):
    assert inf_sup(cell, 2, offset) >= 0.4
