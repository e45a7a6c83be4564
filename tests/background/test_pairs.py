# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Pairs of background cells, across ranks too."""

import numpy as np
import scenes
from scenes import TRIANGLE, WORLD

from dolfinx import mesh

from mpm_dolfinx.background.pairs import CellPairs


def test_pairs_do_not_need_ghost_cells():
    counts = set()
    for ghosts in (mesh.GhostMode.none, mesh.GhostMode.shared_facet):
        grid = scenes.box([0.0, 0.0], [1.0, 1.0], [5, 4], TRIANGLE, ghost_mode=ghosts)
        cells = CellPairs(scenes.vectors(grid))
        pairs = cells.pairs[cells.mine]
        counts.add(WORLD.allreduce(len(pairs)))
        middles = cells.vertices(np.arange(len(cells.nodes))).mean(axis=1)
        gap = np.linalg.norm(np.diff(middles[pairs], axis=1), axis=2)
        assert WORLD.allreduce(int((gap > 0.2).sum())) == 0
    assert counts == {20 + 16 + 15}  # diagonals, upright and level edges
