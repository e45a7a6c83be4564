# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Positions of nodes, from whatever cell and on however many ranks."""

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from scenes import ALL, WORLD

from dolfinx import fem

from mpm_dolfinx.meshes.nodes import node_positions


@pytest.mark.parametrize("degree", [1, 2, 3])
@pytest.mark.parametrize("cell", ALL, ids=scenes.name)
def test_nodes_are_in_one_place_on_any_number_of_ranks(cell, degree):
    found = []
    for comm in (WORLD, MPI.COMM_SELF):
        dim = 3 if cell in (scenes.TETRAHEDRON, scenes.HEXAHEDRON) else 2
        domain = scenes.bend(scenes.box([0.1] * dim, [0.8] * dim, [3] * dim, cell, comm), 0.04)
        space = fem.functionspace(domain, ("Lagrange", degree))
        x = node_positions(space)
        np.testing.assert_allclose(x, space.tabulate_dof_coordinates()[:, :dim], atol=1e-15)
        if comm == WORLD:
            found.append(np.unique(scenes.gather(x), axis=0))
            assert len(found[0]) == space.dofmap.index_map.size_global
        else:
            found.append(np.unique(x, axis=0))
    np.testing.assert_array_equal(*found)


def test_vertices_are_those_of_the_mesh():
    domain = scenes.bend(scenes.unit(3, scenes.HEXAHEDRON), 0.04)
    x = node_positions(fem.functionspace(domain, ("Lagrange", 1)))
    np.testing.assert_array_equal(np.unique(x, axis=0), np.unique(domain.geometry.x, axis=0))
