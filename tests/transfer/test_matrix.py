# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""T against dense loops over cells."""

import numpy as np
import pytest
import scenes
from scenes import ALL
from transfer.reference import PAIRS, SOLID, basis_by_loop, local_positions, scene

from dolfinx import geometry

import mpm_dolfinx as mpm
from mpm_dolfinx.transfer import matrix


@pytest.mark.parametrize(("background", "cell"), [*PAIRS, *SOLID], ids=scenes.name)
@pytest.mark.parametrize("moved", [False, True])
def test_T_against_loop_over_cells(background, cell, moved):
    particles = scene(background, cell, moved)
    dim = particles.mesh.geometry.dim
    owned = particles.W.dofmap.index_map.size_local
    N = scenes.gather(basis_by_loop(particles.V, local_positions(particles)[:owned]))
    T = scenes.dense(particles.T)
    np.testing.assert_allclose(T, np.kron(N, np.eye(dim)), atol=1e-12)
    # partition of unity and linear reproduction
    np.testing.assert_allclose(T.sum(axis=1), 1.0, atol=1e-12)
    u = (scenes.coordinates(particles.V) @ np.arange(1, dim * dim + 1).reshape(dim, dim)).ravel()
    x = scenes.gather(local_positions(particles)[:owned])
    expected = (x @ np.arange(1, dim * dim + 1).reshape(dim, dim)).ravel()
    np.testing.assert_allclose(T @ u, expected, atol=1e-12)


@pytest.mark.parametrize(("background", "cell"), [*PAIRS, *SOLID[:2]], ids=scenes.name)
def test_T_by_functions_of_the_background(background, cell):
    # T u is the background Function u at the body's nodes, for any u.
    particles = scene(background, cell)
    u = particles.increment
    u.interpolate(lambda x: np.sin(np.outer([1.0, 2.0, 3.0][: len(u)], 3 * x[0] + 2 * x[1])))
    result = particles.T.createVecLeft()
    particles.T.mult(u.x.petsc_vec, result)
    owned = particles.W.dofmap.index_map.size_local
    dim = particles.mesh.geometry.dim
    x = scenes.gather(local_positions(particles)[:owned])
    padded = np.zeros((len(x), 3))
    padded[:, :dim] = x
    domain = particles.V.mesh
    tree = geometry.bb_tree(domain, domain.topology.dim)
    near = geometry.compute_collisions_points(tree, padded)
    cells = geometry.compute_colliding_cells(domain, near, padded)
    mine = np.flatnonzero(np.diff(cells.offsets))
    values = np.full((len(x), dim), -np.inf)
    if len(mine):
        values[mine] = u.eval(padded[mine], cells.array[cells.offsets[mine]])
    expected = np.max(scenes.WORLD.allgather(values), axis=0)
    np.testing.assert_allclose(scenes.gather(result.array_r.reshape(-1, dim)), expected, atol=1e-12)


@pytest.mark.parametrize(("background", "cell"), [PAIRS[0], SOLID[0]], ids=scenes.name)
def test_what_acts_for_T_multiplies_as_it_does(background, cell):
    transfer = scene(background, cell, True).transfer
    T, action = transfer.T, transfer.action
    assert (action is T) == (T.comm.size > 1)
    u, d = T.createVecs()
    u.array_w[:] = np.sin(1.0 + 1.7 * np.arange(u.getLocalSize()))
    others = action.createVecLeft(), action.createVecRight()
    T.mult(u, d)
    action.mult(u, others[0])
    np.testing.assert_allclose(others[0].array_r, d.array_r, atol=1e-14)
    back, total, start = u.duplicate(), u.duplicate(), u.copy()
    T.multTranspose(d, back)
    action.multTranspose(d, others[1])
    np.testing.assert_allclose(others[1].array_r, back.array_r, atol=1e-13)
    action.multTransposeAdd(d, u, total)
    np.testing.assert_allclose(total.array_r, (start + back).array_r, atol=1e-13)
    action.multTransposeAdd(d, u, u)
    np.testing.assert_allclose(u.array_r, total.array_r, atol=1e-14)


@pytest.mark.mpi
@pytest.mark.parametrize(("background", "cell"), [*PAIRS, *SOLID], ids=scenes.name)
def test_ranks_move_nodes_that_they_share_by_the_same_weights(background, cell):
    # Bit by bit, as those of a node beside a facet are no larger than round-off of its position.
    particles = scene(background, cell)
    rows, layout = particles.node_basis, particles.W.dofmap.index_map
    numbers = layout.local_to_global(np.arange(len(rows.nodes), dtype=np.int32))
    weights = np.column_stack([rows.nodes, rows.values, rows.found])
    owned = scenes.gather(weights[: layout.size_local])
    assert scenes.WORLD.allreduce(layout.num_ghosts) > 0
    assert scenes.WORLD.allreduce(np.count_nonzero(weights != owned[numbers])) == 0


@pytest.mark.parametrize(("background", "cell"), [*PAIRS, *SOLID], ids=scenes.name)
def test_active_dofs_are_the_columns_of_T(background, cell):
    particles = scene(background, cell)
    columns = np.flatnonzero(np.abs(scenes.dense(particles.T)).max(axis=0))
    bs = particles.V.dofmap.index_map_bs
    first, last = np.array(particles.V.dofmap.index_map.local_range) * bs
    mine = columns[(columns >= first) & (columns < last)]
    assert np.array_equal(particles.active_dofs, mine)
    if (background, cell) in PAIRS:
        assert 0 < len(columns) < particles.T.getSize()[1]


@pytest.mark.parametrize("cell", ALL, ids=scenes.name)
def test_T_is_the_identity_where_particles_are_cells(cell):
    V = scenes.vectors(scenes.bend(scenes.unit(3, cell), 0.04))
    particles = mpm.Particles(scenes.bend(scenes.unit(3, cell), 0.04), V)
    same = scenes.coordinates(particles.W)[:, None] == scenes.coordinates(V)[None]
    identity = np.kron(same.all(axis=2), np.eye(V.mesh.geometry.dim))
    np.testing.assert_allclose(scenes.dense(particles.T), identity, atol=1e-12)
    assert scenes.WORLD.allreduce(len(particles.active_dofs)) == particles.T.getSize()[1]


def by_numpy(nodes, values, bs):
    """Return offsets, columns and values of rows for each component, sorted, without zeros."""
    order = np.argsort(nodes, axis=1)
    nodes, values = (np.take_along_axis(part, order, axis=1) for part in (nodes, values))
    kept = values != 0.0
    counts = np.repeat(kept.sum(axis=1), bs)
    shape = (len(nodes), bs, nodes.shape[1])
    keep = np.broadcast_to(kept[:, None, :], shape)
    columns = (nodes[:, None, :] * bs + np.arange(bs)[None, :, None])[keep]
    offsets = np.concatenate([[0], np.cumsum(counts)])
    return offsets, columns, np.broadcast_to(values[:, None, :], shape)[keep]


@pytest.mark.parametrize(("background", "cell"), [*PAIRS, *SOLID[:2]], ids=scenes.name)
def test_compiled_rows_are_those_of_numpy(background, cell):
    particles = scene(background, cell)
    rows = particles.transfer.rows.basis
    T = matrix.transfer_matrix(rows, particles.W, particles.V)
    owned = particles.W.dofmap.index_map.size_local
    reference = by_numpy(rows.nodes[:owned], rows.values[:owned], particles.V.dofmap.bs)
    for one, other in zip(T.getValuesCSR(), reference, strict=True):
        np.testing.assert_array_equal(one, other)
