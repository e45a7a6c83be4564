# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bodies that a linear motion of the background has moved."""

import numpy as np
import scenes
from scenes import QUADRILATERAL, box, vectors

import mpm_dolfinx as mpm


def hat(x, node, h):
    """Return the one-dimensional basis function of a node and its slope."""
    r = (x - node) / h
    inside = np.abs(r) < 1
    return np.where(inside, 1 - np.abs(r), 0.0), np.where(inside, -np.sign(r) / h, 0.0)


def moved_particles(method, gradient, lengths=(0.1, 0.1), **options):
    """Return 2 x 2 boxes in a 6 x 6 grid of cells 0.25, displaced linearly."""
    V = vectors(box([-0.5, -0.5], [1.0, 1.0], [6, 6], QUADRILATERAL))
    corner = [0.03 + 2 * lengths[0], 0.07 + 2 * lengths[1]]
    body = box([0.03, 0.07], corner, [2, 2], QUADRILATERAL)
    particles = mpm.Particles(body, V, method=method, **options)
    scenes.move(particles, lambda X: X @ np.array(gradient).T + [0.013, -0.021])
    return particles


def dense_weights(particles):
    """Return S and grad S of all particles as dense arrays, and the nodes' positions."""
    w = particles.weights()
    x = scenes.coordinates(particles.V)
    S = np.zeros((particles.num_local, len(x)))
    G = np.zeros((*S.shape, x.shape[1]))
    row = np.repeat(np.arange(len(S)), np.diff(w.offsets))
    S[row, w.nodes], G[row, w.nodes] = w.S, w.grad_S
    return S, G, x


GRADIENT = [[0.2, 0.15], [-0.1, -0.15]]
