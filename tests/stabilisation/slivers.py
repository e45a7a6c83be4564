# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bodies that leave slivers in cells, and polynomials on them."""

import numpy as np
import scenes
from scenes import HEXAHEDRON, TETRAHEDRON

from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx.transfer.touched import TouchedNodes


def sliver(cell, degree, offset, domain=None, n=4, ghosts=mesh.GhostMode.shared_facet):
    """Return particles that fill a background's lower cells and reach a little into the next."""
    dim = 3 if cell in (TETRAHEDRON, HEXAHEDRON) else 2
    grid = scenes.box([0.0] * dim, [1.0] * dim, [n] * dim, cell, ghost_mode=ghosts)
    height = (n // 2) / n + offset
    body = scenes.box([0.0] * dim, [1.0] * (dim - 1) + [height], [n] * dim, domain or cell)
    return mpm.Particles(body, scenes.vectors(grid, degree), degree=degree)


def polynomial(V, degree):
    """Return a polynomial of total degree `degree` in V."""
    u = fem.Function(V)
    dim = V.mesh.geometry.dim
    u.interpolate(
        lambda x: np.array([(1 + i - x[0] + (2 + i) * x[dim - 1]) ** degree for i in range(dim)])
    )
    return u


def look(ghosts, particles):
    """Tie cells of one body together; return which own nodes are unknowns."""
    owned = particles.W.dofmap.index_map.size_local
    touched = TouchedNodes(particles.V, [particles.node_basis], [owned])
    return ghosts.tie(touched)


def vector(matrix, function):
    x = matrix.createVecRight()
    x.array_w[:] = scenes.own(function)
    return x
