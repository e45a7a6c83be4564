# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Generalised interpolation against averages over boxes."""

import numpy as np
import pytest
import scenes
from scenes import QUADRILATERAL, TRIANGLE, box, vectors
from transfer.moved import GRADIENT, dense_weights, hat, moved_particles

import mpm_dolfinx as mpm


def box_average(centre, half, node, h, samples=4001):
    """Return the average of a hat and of its slope over an interval, by brute force."""
    edges = np.linspace(centre - half, centre + half, samples)
    values, _ = hat(edges, node, h)
    average = np.sum((values[1:] + values[:-1]) / 2) / (samples - 1)
    return average, (values[-1] - values[0]) / (2 * half)


@pytest.mark.parametrize("lengths", [(0.1, 0.1), (0.22, 0.09), (0.3, 0.4)])
@pytest.mark.parametrize("method", ["gimp", "ugimp"])
def test_gimp_weights_are_averages_over_the_box(lengths, method):
    # The last box is larger than a cell, where the five-branch formula does not hold.
    particles = moved_particles(method, GRADIENT, lengths)
    S, G, x = dense_weights(particles)
    F = np.eye(2) + GRADIENT
    values, vectors_ = np.linalg.eigh(F.T @ F)
    U = vectors_ @ np.diag(np.sqrt(values)) @ vectors_.T
    half = 0.5 * np.array(lengths) * (np.diag(U) if method == "gimp" else 1.0)
    centre = particles.centroid
    for p in range(particles.num_local):
        for i, node in enumerate(x):
            (sx, gx), (sy, gy) = (
                box_average(centre[p, k], half[k], node[k], 0.25) for k in range(2)
            )
            assert S[p, i] == pytest.approx(sx * sy, abs=2e-7)
            np.testing.assert_allclose(G[p, i], [gx * sy, sx * gy], atol=2e-6)
    spans = np.ptp(particles.domains, axis=1)
    np.testing.assert_allclose(spans, np.tile(2 * half, (len(spans), 1)), rtol=1e-12)


def test_gimp_needs_boxes_on_a_grid():
    grid = vectors(box([-1.0, -1.0], [2.0, 2.0], [6, 6], QUADRILATERAL))
    triangles = vectors(box([-1.0, -1.0], [2.0, 2.0], [6, 6], TRIANGLE))
    sheared = vectors(scenes.shear(box([-1.0, -1.0], [2.0, 2.0], [6, 6], QUADRILATERAL)))
    boxes = scenes.unit(4, QUADRILATERAL)
    with pytest.raises(mpm.MPMError, match="domains that are axis-aligned"):
        mpm.Particles(scenes.unit(4, TRIANGLE), grid, method="gimp")
    with pytest.raises(mpm.MPMError, match="domains that are axis-aligned"):
        mpm.Particles(scenes.bend(scenes.unit(4, QUADRILATERAL), 0.02), grid, method="gimp")
    for V in (triangles, sheared):
        with pytest.raises(mpm.MPMError, match="structured background"):
            mpm.Particles(boxes, V, method="gimp")
    with pytest.raises(mpm.MPMError, match="one quadrature point"):
        mpm.Particles(boxes, grid, method="mpm", quadrature_degree=3)
