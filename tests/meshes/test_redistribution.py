# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Meshes on other ranks, with their tags and Functions."""

from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
import scenes
from marks import thinned
from scenes import ALL, PLANE, WORLD, anywhere

import ufl
from dolfinx import fem, mesh

import mpm_dolfinx as mpm
from mpm_dolfinx import _compat
from mpm_dolfinx.meshes.cells import disconnected_mesh
from mpm_dolfinx.meshes.redistribution import Redistribution
from mpm_dolfinx.meshes.remesh import Remesh

SELF = MPI.COMM_SELF


def by_index(body, values):
    """Gather values of cells in the order of the input."""
    count = body.topology.index_map(body.topology.dim).size_local
    index = np.concatenate(WORLD.allgather(body.topology.original_cell_index[:count]))
    return np.concatenate(WORLD.allgather(values))[np.argsort(index)]


@pytest.mark.parametrize("cell", ALL, ids=scenes.name)
@pytest.mark.parametrize("ghosts", ["none", "shared_facet"])
def test_mesh_on_other_ranks(cell, ghosts):
    n = [3] * (2 if cell in PLANE else 3)
    mode = getattr(mesh.GhostMode, ghosts)
    body = scenes.box([0.0] * len(n), [1.0] * len(n), n, cell, ghost_mode=mode)
    ranks = anywhere(body)
    moved = Redistribution(body, ranks).mesh
    cells, before = (m.topology.index_map(body.topology.dim) for m in (moved, body))
    assert cells.size_global == before.size_global
    wanted = WORLD.allreduce(np.bincount(ranks, minlength=WORLD.size))
    assert cells.size_local == wanted[WORLD.rank]
    corners = [
        m.geometry.x[_compat.geometry_dofmap(m)[: c.size_local]]
        for m, c in ((body, before), (moved, cells))
    ]
    assert np.array_equal(by_index(body, corners[0]), by_index(moved, corners[1]))
    if WORLD.size > 1:
        some = WORLD.allreduce(cells.num_ghosts)
        assert (some > 0) == (ghosts == "shared_facet")
        # Facets between cells are as many as before: each rank sees both sides of its own.
        inside = ufl.avg(fem.Constant(moved, 1.0)) * ufl.dS
        if ghosts == "shared_facet":
            area = WORLD.allreduce(fem.assemble_scalar(fem.form(inside)))
            whole = scenes.box([0.0] * len(n), [1.0] * len(n), n, cell, SELF)
            inside = ufl.avg(fem.Constant(whole, 1.0)) * ufl.dS
            assert area == pytest.approx(fem.assemble_scalar(fem.form(inside)), rel=1e-12)


def pieces(body):
    """Return a copy of a mesh whose cells share no vertex."""
    nodes = _compat.geometry_dofmap(body)[: body.topology.index_map(body.topology.dim).size_local]
    corners = body.geometry.x[nodes][:, :, : body.geometry.dim]
    return disconnected_mesh(WORLD, corners, body.basix_cell())


def moved_once(body):
    return Redistribution(body, anywhere(body))


def moved_thrice(body):
    """All to one rank, then anywhere, then anywhere else."""
    carrier = Redistribution(body, np.zeros_like(anywhere(body)))
    for seed in (2, 3):
        between = carrier.mesh
        carrier = carrier.then(Redistribution(between, anywhere(between, seed)))
    return carrier


def moved_and_stretched(body):
    """To other ranks, then to other places, then to other ranks."""
    carrier = moved_once(body)
    between = carrier.mesh
    nodes = _compat.geometry_dofmap(between)[: len(anywhere(between))]
    x = between.geometry.x[nodes][:, :, : between.geometry.dim]
    carrier = carrier.then(Remesh(between, np.zeros((0, 2), dtype=np.int64), 2.0 * x))
    return carrier.then(Redistribution(carrier.mesh, anywhere(carrier.mesh, 2)))


def tagged(tags, domain, tag, size):
    """Integrate over what has a tag, in a mesh as it was before it was stretched to a size.

    One form serves all tags and sizes, which are no part of it.
    """
    here = np.sort(tags.find(tag))
    alone = mesh.meshtags(domain, tags.dim, here, np.ones(len(here), dtype=np.int32))
    kind = "dx" if tags.dim == domain.topology.dim else "ds"
    x = ufl.SpatialCoordinate(domain) * fem.Constant(domain, 1.0 / size)
    measure = ufl.Measure(kind, domain=domain, subdomain_data=alone)
    form = fem.form((1.0 + x[0] + 3.0 * x[1]) * measure(1))
    return WORLD.allreduce(fem.assemble_scalar(form)) / size**tags.dim


@pytest.mark.parametrize(
    ("way", "apart", "cell"),
    thinned(5, product([moved_once, moved_thrice, moved_and_stretched], [False, True], ALL)),
    ids=scenes.name,
)
def test_tags_and_functions_move(way, apart, cell):
    body = scenes.unit(3, cell)
    if apart:
        body = pieces(body)
    facets = scenes.facet_tags(body, scenes.at(0, 0.0), scenes.at(1, 1.0))
    cells = scenes.cell_tags(body, lambda x: 1 + (x[:, 0] > 0.4) + (x[:, 1] > 0.6))
    values = fem.Function(fem.functionspace(body, ("DG", 0)), name="stiffness")
    values.interpolate(lambda x: 1.0 + x[0] + 2.0 * x[1])
    move = way(body)
    scale = 2.0 if way is moved_and_stretched else 1.0
    moved = [move.carry(thing) for thing in (facets, cells, values)]
    for old, new in zip((facets, cells), moved, strict=False):
        for tag in (1, 2, 3):
            one, two = tagged(old, body, tag, 1.0), tagged(new, move.mesh, tag, scale)
            assert two == pytest.approx(one, rel=1e-12, abs=1e-14)
    one, two = (
        WORLD.allreduce(fem.assemble_scalar(fem.form(f**2 * ufl.SpatialCoordinate(m)[0] * ufl.dx)))
        / size ** (body.topology.dim + 1)
        for f, m, size in ((values, body, 1.0), (moved[2], move.mesh, scale))
    )
    assert two == pytest.approx(one, rel=1e-12) and moved[2].name == "stiffness"
    if move.mesh is not body:
        linear = fem.Function(fem.functionspace(body, ("Lagrange", 1)))
        with pytest.raises(mpm.MPMError, match="piecewise constant"):
            move.carry(linear)
    assert move.carry(moved[0]) is moved[0] and move.carry(3.0) == 3.0
