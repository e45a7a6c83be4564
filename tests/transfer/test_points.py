# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The point method against the basis at the particle."""

import numpy as np
from transfer.moved import GRADIENT, dense_weights, hat, moved_particles


def test_mpm_weights_are_the_basis_at_the_particle():
    particles = moved_particles("mpm", GRADIENT)
    S, G, x = dense_weights(particles)
    for p, centre in enumerate(particles.centroid):
        (sx, gx), (sy, gy) = (hat(centre[k], x[:, k], 0.25) for k in range(2))
        np.testing.assert_allclose(S[p], sx * sy, atol=1e-12)
        np.testing.assert_allclose(G[p], np.stack([gx * sy, sx * gy], axis=1), atol=1e-11)
