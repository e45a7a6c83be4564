# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""What a node's residual would do to it alone, and the shares of domains in that."""

from petsc4py import PETSc

import numpy as np
import pytest
import scenes
from scenes import QUADRILATERAL, WORLD

import mpm_dolfinx as mpm
from mpm_dolfinx.system.estimate import nodal_errors, shares_of_domains


def particles(lower=(0.0, 0.0)):
    upper = (lower[0] + 1.0, lower[1] + 1.0)
    V = scenes.vectors(scenes.box([-0.5, -0.5], [2.5, 2.5], [6, 6], QUADRILATERAL))
    body = scenes.box(lower, upper, [4, 4], QUADRILATERAL)
    return mpm.Particles(body, V, outside="delete")


class Springs(mpm.Term):
    """Springs to each node of bodies, along the axes and with some stiffness between these."""

    def __init__(self, bodies, stiffness):
        super().__init__(bodies)
        self.stiffness = np.asarray(stiffness)

    def tangents(self):
        found = {}
        for number, body in enumerate(self.bodies):
            sizes = body.W.dofmap.index_map
            own, whole = 2 * sizes.size_local, 2 * sizes.size_global
            K = PETSc.Mat().createAIJ([(own, whole), (own, whole)], comm=body.mesh.comm)
            K.setUp()
            first = 2 * sizes.local_range[0]
            for row in range(first, first + own, 2):
                for i in (0, 1):
                    for j in (0, 1):
                        K.setValue(row + i, row + j, self.stiffness[i, j] * (1 + number))
            K.assemble()
            found[number, number] = K
        return found


K = np.array([[2.0, 0.5], [0.5, 3.0]])


def alone(body, terms, force, free=(1.0, 1.0)):
    """Return the first node's error; all have the same force and share of motion."""
    count = body.W.dofmap.index_map.size_local
    found = nodal_errors(body, terms, np.tile(force, count), np.tile(np.array(free), count))
    assert found.shape == (count,)
    assert found == pytest.approx(found[0] if count else 0.0)
    return found[0] if count else None


def test_it_is_the_energy_of_what_the_residual_would_do_to_the_node():
    body, R = particles(), np.array([1.0, -4.0])
    found = alone(body, [Springs([body], K), Springs([body], K)], R)
    if found is not None:
        assert found == pytest.approx(R @ np.linalg.solve(2.0 * K, R))


def test_a_tangent_that_is_not_symmetric_counts_by_the_energy_that_it_has():
    body, R = particles(), np.array([1.0, -4.0])
    for slip in (np.array([[0.0, 0.8], [-0.8, 0.0]]), np.array([[0.0, -0.8], [0.8, 0.0]])):
        found = alone(body, [Springs([body], K + slip)], R)
        if found is not None:
            assert found == pytest.approx(R @ np.linalg.solve(K, R))


def test_tangents_of_each_of_several_bodies_are_its_own():
    bodies, R = [particles(), particles((1.0, 1.0))], np.array([1.0, -4.0])
    for number, body in enumerate(bodies):
        found = alone(body, [Springs(bodies, K)], R)
        if found is not None:
            assert found == pytest.approx(R @ np.linalg.solve((1 + number) * K, R))


def test_what_is_held_has_a_reaction_and_no_error():
    body, R = particles(), np.array([1.0, -4.0])
    for free, expected in (
        ((1.0, 0.0), R[0] ** 2 / K[0, 0]),
        ((0.0, 1.0), R[1] ** 2 / K[1, 1]),
        ((0.0, 0.0), 0.0),
        # what is held in part is free to move, by the part of its force that is no reaction
        ((0.5, 1.0), (h := R * (0.5, 1.0)) @ np.linalg.solve(K, h)),
    ):
        found = alone(body, [Springs([body], K)], R, free)
        if found is not None:
            assert found == pytest.approx(expected)


@pytest.mark.parametrize(("soft", "counts"), [(1e-3, 1e-3), (-1e-3, 1e-3), (0.0, 1e-6)])
def test_a_soft_direction_is_as_soft_as_it_is(soft, counts):
    body, R = particles(), np.array([0.0, 1.0])
    found = alone(body, [Springs([body], np.diag([1.0, soft]))], R)
    if found is not None:
        assert found == pytest.approx(1.0 / counts)


def test_without_stiffness_there_is_none():
    body = particles()
    assert alone(body, [Springs([body], np.zeros((2, 2)))], np.ones(2)) in (0.0, None)


def test_shares_of_nodes_go_to_the_domains_that_are_left():
    body = particles()
    nodal = np.ones(body.W.dofmap.index_map.size_local)
    shares = shares_of_domains(body, nodal)
    assert WORLD.allreduce(shares.sum()) == pytest.approx(25.0)  # of 5 x 5 nodes
    gone = np.flatnonzero(np.isin(body.global_index, (0, 1)))
    body.placement.delete(gone)
    left = shares_of_domains(body, nodal)
    assert not left[gone].any() and len(gone) == np.count_nonzero(body.deleted)
    assert WORLD.allreduce(left.sum()) == pytest.approx(25.0 - lone_nodes(body))


def lone_nodes(body):
    """Return how many nodes have deleted domains alone around them."""
    x = np.concatenate(WORLD.allgather(body.initial_domains[~body.deleted].reshape(-1, 2)))
    return 25 - len(np.unique(np.round(x, 9), axis=0))
