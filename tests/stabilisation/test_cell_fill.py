# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Which part of a cell the bodies fill."""

import numpy as np
import scenes
from scenes import QUADRILATERAL

import mpm_dolfinx as mpm
from mpm_dolfinx.background.pairs import CellPairs
from mpm_dolfinx.stabilisation.cell_fill import CellFill


def test_fill_is_the_share_of_the_body():
    grid = scenes.box([0.0, 0.0], [4.0, 2.0], [4, 2], QUADRILATERAL)
    body = scenes.box([0.0, 0.0], [2.5, 1.0], [20, 8], QUADRILATERAL)
    particles = mpm.Particles(body, scenes.vectors(grid, 2), degree=2)
    cells = CellPairs(particles.V)
    found = CellFill.of([particles], cells)
    middle = cells.vertices(np.arange(cells.num_own)).mean(axis=1)
    exact = np.where(middle[:, 1] < 1.0, np.clip(2.5 - (middle[:, 0] - 0.5), 0.0, 1.0), 0.0)
    assert np.allclose(found.fill[:, 0], exact, atol=1e-12)
    assert np.array_equal(found.active, exact > 0.0)
