# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Quadrilaterals and their diagonals."""

import numpy as np

from mpm_dolfinx.meshes.remesh import diagonals


def test_diagonals_make_triangles_of_positive_area():
    # The reflex corner of a concave quadrilateral is an end of the diagonal.
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    slopes = np.array([[-1.0, 1, 0, 0], [-1, 1, 0, 0], [0, 0, -1, 1], [0, 0, -1, 1]])
    across = np.array([[-1.0, 0, 1, 0], [0, -1, 0, 1], [-1, 0, 1, 0], [0, -1, 0, 1]])
    for reflex in range(4):
        x = corners.copy()
        x[reflex] += 0.7 * (0.5 - x[reflex]) * 2.0
        det = np.linalg.det(np.stack([slopes @ x, across @ x], axis=1))
        diagonal, least = diagonals(det[None])
        assert diagonal[0] == (0 if reflex in (0, 3) else 1) and least[0] > 0.0
