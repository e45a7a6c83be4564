# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a body keeps in memory, counted where arrays are made, whatever the heap does with it."""

import tracemalloc

import numpy as np
import pytest
import scenes

from dolfinx.mesh import CellType

import mpm_dolfinx as mpm


def kept_and_most(cells):
    """Return particles, bytes of arrays that live after two tries, and the most at a time."""
    h = 1.0 / cells
    V = scenes.vectors(
        scenes.box([0.0, 0.0], [1.0 + h, 1.0 + h], [cells + 1] * 2, CellType.quadrilateral)
    )
    low, high = [0.37 * h] * 2, [1.0 + 0.37 * h] * 2
    body = scenes.box(low, high, [2 * cells] * 2, CellType.quadrilateral)
    tracemalloc.start()
    try:
        particles = mpm.Particles(body, V)
        law = mpm.materials.VonMises(1e6, 0.3, rho_y=20e3)
        problem = mpm.QuasiStaticProblem(mpm.Body(particles, law, body_force=(0.0, -1.0)))
        (term,) = problem.built.body_terms
        problem.reduced.begin([np.zeros_like(particles.increment.x.array)], 1.0)
        tracemalloc.reset_peak()
        for stretch in (1e-3, 2e-3):
            particles.displacement.x.array[:] = stretch * h
            assert term.update() is None
            problem.reduced.tangent()
        return particles.num_local, *tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()


@pytest.mark.skip_in_parallel
def test_bytes_a_particle():
    """Per particle in the plane, from two sizes: 1.2 kB of arrays, and one try at a time."""
    kept_and_most(4)  # compiles forms, and fills what keeps them
    (n, kept, most), (m, more, most_more) = kept_and_most(40), kept_and_most(80)
    kept, most = (more - kept) / (m - n), (most_more - most) / (m - n)
    assert kept < 1220.0
    assert most - kept < 250.0
