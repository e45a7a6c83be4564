# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Dense references of T and of the particles' weights."""

import numpy as np
import scenes
from scenes import HEXAHEDRON, PLANE, TETRAHEDRON

import mpm_dolfinx as mpm

PAIRS = [(b, c) for b in PLANE for c in PLANE]


SOLID = [(b, c) for b in (TETRAHEDRON, HEXAHEDRON) for c in (TETRAHEDRON, HEXAHEDRON)]


def multilinear(vertices, point):
    """Return the shape functions of one cell at a point, by its own vertices."""
    k, dim = vertices.shape
    if k == dim + 1:  # barycentric coordinates
        return np.linalg.solve(np.vstack([vertices.T, np.ones(k)]), [*point, 1.0])
    # In tensor order; the map's inverse by Newton's method.
    corners = (np.arange(k)[:, None] >> np.arange(dim)) & 1
    xi = np.full(dim, 0.5)
    for _ in range(20):
        factors = np.where(corners, xi, 1 - xi)
        slopes = np.array(
            [
                np.prod(np.delete(factors, j, axis=1), axis=1) * (2 * corners[:, j] - 1)
                for j in range(dim)
            ]
        )
        xi = xi + np.linalg.solve((slopes @ vertices).T, point - factors.prod(axis=1) @ vertices)
    return np.where(corners, xi, 1 - xi).prod(axis=1)


def basis_by_loop(V, points):
    """Return the values of all basis functions at points, searching through all cells."""
    dim = V.mesh.geometry.dim
    count = V.mesh.topology.index_map(dim).size_local
    dofs = V.dofmap.list[:count]
    vertices = scenes.gather(V.tabulate_dof_coordinates()[dofs][:, :, :dim])
    nodes = V.dofmap.index_map.local_to_global(dofs.ravel()).reshape(dofs.shape)
    nodes = scenes.gather(nodes)
    values = np.zeros((len(points), V.dofmap.index_map.size_global))
    boxes = vertices.min(axis=1) - 1e-9, vertices.max(axis=1) + 1e-9
    for row, point in zip(values, points, strict=True):
        near = np.flatnonzero(((point >= boxes[0]) & (point <= boxes[1])).all(axis=1))
        N = [multilinear(vertices[c], point) for c in near]
        best = int(np.argmax([n.min() for n in N]))
        assert N[best].min() > -1e-9
        row[nodes[near[best]]] = N[best]
    return values


def local_positions(particles):
    """Return the present positions of this rank's nodes, ghosts too."""
    dim = particles.mesh.geometry.dim
    d = particles.displacement.x.array.reshape(-1, dim)
    return particles.W.tabulate_dof_coordinates()[:, :dim] + d


def distortion(X):
    """A displacement that no background space holds, but for its size."""
    phase = X @ np.array([5.0, 7.0, 3.0])[: X.shape[1]]
    return 0.02 + 0.04 * np.sin(np.outer(phase, [1.0, 1.3, 0.7][: X.shape[1]]))


def scene(background, cell, moved=True):
    """Return particles, distorted if asked, and their background space."""
    dim = 3 if cell in (TETRAHEDRON, HEXAHEDRON) else 2
    domain = scenes.unit(5 if dim == 2 else 2, background)
    V = scenes.vectors(scenes.bend(domain, 0.04))
    lower, upper = [0.1, 0.15, 0.2][:dim], [0.7, 0.8, 0.7][:dim]
    body = scenes.box(lower, upper, [5, 6] if dim == 2 else [2, 2, 2], cell)
    particles = mpm.Particles(body, V)
    if moved:
        scenes.move(particles, distortion)
    return particles
