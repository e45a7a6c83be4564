# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Facets that are left out in a step touch nothing, however bodies and obstacles move."""

import numpy as np
import pytest
import scenes
from scenes import HEXAHEDRON, QUADRILATERAL

import mpm_dolfinx as mpm
from mpm_dolfinx import contact
from mpm_dolfinx.contact.memory import ShapeMemory
from mpm_dolfinx.contact.outcome import untouched
from mpm_dolfinx.contact.placed import placed
from mpm_dolfinx.contact.reach import Reach
from mpm_dolfinx.contact.rotation import Pose
from mpm_dolfinx.contact.surface import Surface

SHAPES = {
    "disc": contact.disc((0.5, 1.6), 0.5),
    "polygon": contact.polygon([(0.1, 1.05), (0.9, 1.05), (0.5, 2.0)]),
    "sphere": contact.sphere((0.5, 0.5, 1.6), 0.5),
}


def at_rest(surface, shape, pose):
    """Return what is known of points that nothing has touched yet."""
    x = surface.positions(converged=True)
    gap = placed(shape, pose).distance(x.reshape(-1, shape.dim)).reshape(x.shape[:2])
    return ShapeMemory(pose, x, 0.0 * x, untouched(x, gap), np.zeros((*gap.shape, 0)))


@pytest.mark.parametrize("name", SHAPES)
def test_no_facet_that_touches_is_left_out(name):
    shape = SHAPES[name]
    dim, spin = shape.dim, 1 if shape.dim == 2 else 3
    cell = QUADRILATERAL if dim == 2 else HEXAHEDRON
    V = scenes.vectors(scenes.box([-0.5] * dim, [1.5] * dim, [4] * dim, cell))
    body = mpm.Particles(scenes.unit(8 if dim == 2 else 5, cell), V)
    surface = Surface(body, None, None, False, "It")
    surface.settle()
    memory = at_rest(surface, shape, Pose(np.zeros(dim), np.zeros(spin)))
    reach = Reach(surface, shape)
    reach.look(memory)
    rng = np.random.default_rng(3)
    left_out = touching = 0
    for size in np.geomspace(1e-3, 1.0, 25):
        direction = np.append(rng.normal(size=dim - 1), -1.0)
        pose = Pose(size * 0.5 * direction, size * rng.normal(size=spin))
        body.displacement.x.array[:] = 0.2 * size * rng.normal(size=body.displacement.x.array.size)
        body.displacement.x.scatter_forward()
        found = reach.of(memory, pose)
        x = surface.positions()
        gap = placed(shape, pose).distance(x.reshape(-1, dim)).reshape(x.shape[:2])
        touches = np.flatnonzero((gap <= surface.touch).any(axis=1))
        touching += len(touches)
        if found is None:
            continue
        assert np.isin(touches, found.facets).all()
        left_out += len(x) - len(found.facets)
    count = scenes.WORLD.allreduce(np.array([left_out, touching]))
    assert np.all(count > 20)
