# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Matrices between nodes of two bodies whose facets meet."""

import numpy as np
import scenes
from scenes import QUADRILATERAL, box

from mpm_dolfinx.contact.pair_matrices import Met, PairMatrices

BODIES = ((5, 3), (4, 6))


def spaces():
    return [
        scenes.vectors(box([0.0, 0.0], [1.0, 1.0], list(counts), QUADRILATERAL))
        for counts in BODIES
    ]


def met(number, count, rng, W):
    """Return facets of two nodes each that meet at some points of a pass, with their anchors."""
    last = [space.dofmap.index_map.size_global - 1 for space in W]
    mine, its = last[number], last[1 - number]
    facets = np.column_stack([rng.integers(0, most, count) for most in (mine, its, its)])
    # (a facet's nodes follow from its number)
    nodes = tuple(np.stack([column, column + 1], axis=1) for column in facets.T)
    return Met(facets, nodes)


def dense(matrix):
    """Return the whole of a matrix, on all ranks."""
    rows = matrix.getOwnershipRange()
    own = np.zeros(matrix.getSize())
    own[slice(*rows)] = matrix.getValues(range(*rows), range(matrix.getSize()[1]))
    return matrix.comm.tompi4py().allreduce(own)


def test_blocks_are_where_their_nodes_say_also_where_others_come_up_later():
    W = spaces()
    comm = W[0].mesh.comm
    rng = np.random.default_rng(comm.rank)
    matrices, before = PairMatrices(W), {}
    whole = [met(number, 30, rng, W) for number in range(2)]
    for count in (0, 8, 8, 30):
        passes = [Met(one.facets[:count], tuple(x[:count] for x in one.nodes)) for one in whole]
        known = {
            (i, j): np.zeros([2 * space.dofmap.index_map.size_global for space in (W[i], W[j])])
            for i in (0, 1)
            for j in (0, 1)
        }
        for number, (one, (group, positions, values)) in enumerate(
            zip(passes, matrices.begin(passes), strict=True)
        ):
            sides = [(number, one.nodes[0]), *((1 - number, nodes) for nodes in one.nodes[1:])]
            places = [(side, nodes[:, k]) for side, nodes in sides for k in range(2)]
            for p in range(count):
                for a, (i, rows) in enumerate(places[:4]):
                    for b, (j, columns) in enumerate(places):
                        block = rng.normal(size=(2, 2))
                        values[positions[group[p], a, b]] += block
                        row, column = 2 * rows[p], 2 * columns[p]
                        known[i, j][row : row + 2, column : column + 2] += block
        found = matrices.assembled()
        assert set(found) == (set(known) if count else set())
        for pair, matrix in found.items():
            expected = comm.allreduce(known[pair])
            np.testing.assert_allclose(dense(matrix), expected, atol=1e-13)
            same = before.get(pair) is matrix
            assert same == (count == 8 and bool(before))
        before = found
