# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The deviation of stresses from those recovered at nodes, against means that are taken by hand."""

import numpy as np
import pytest
import scenes
from scenes import QUADRILATERAL, WORLD

import mpm_dolfinx as mpm
from mpm_dolfinx.constitutive.moduli import bulk_and_shear_moduli
from mpm_dolfinx.constitutive.recovery import stress_errors
from mpm_dolfinx.materials import Hencky

YOUNG, POISSON = 1e3, 0.3


def by_hand(particles, moduli):
    """Return the energies of deviations where domains have one point, by global index."""
    every = [
        np.concatenate(WORLD.allgather(values))
        for values in (
            particles.global_index,
            particles.initial_domains,
            particles.initial_volume,
            particles.stress,
        )
    ]
    order = np.argsort(every[0])
    corners, volumes, stress = (values[order] for values in every[1:])
    young = np.broadcast_to(moduli, len(volumes))
    _, node = np.unique(np.round(corners.reshape(-1, 2), 9), axis=0, return_inverse=True)
    node = node.reshape(len(volumes), 4)
    change = np.zeros_like(stress)
    for law in np.unique(young):
        own = young == law
        sums, weights = np.zeros((node.max() + 1, 3, 3)), np.zeros(node.max() + 1)
        for corner in node.T:
            np.add.at(sums, corner[own], volumes[own, None, None] * stress[own])
            np.add.at(weights, corner[own], volumes[own])
        means = sums / np.where(weights > 0.0, weights, 1.0)[:, None, None]
        change[own] = means[node[own]].mean(axis=1) - stress[own]
    trace = np.trace(change, axis1=1, axis2=2)
    squares = (change**2).sum(axis=(1, 2))
    return volumes * ((1.0 + POISSON) * squares - POISSON * trace**2) / young


@pytest.mark.parametrize("f_bar", ["none", "patch"])
@pytest.mark.parametrize("laws", [1, 2])
def test_energies_of_deviations(f_bar, laws):
    mesh = scenes.box([0.0, 0.0], [1.0, 0.5], [8, 4], QUADRILATERAL)
    V = scenes.vectors(scenes.box([-0.5, -0.5], [1.5, 1.0], [8, 6], QUADRILATERAL))
    particles = mpm.Particles(mesh, V)
    tags = scenes.cell_tags(mesh, lambda x: np.where(x[:, 0] < 0.5, 1, laws))
    law = {1: Hencky(YOUNG, POISSON), 2: Hencky(5.0 * YOUNG, POISSON)}
    law = law if laws == 2 else law[1]
    body = mpm.Body(
        particles, law, body_force=(0.0, -40.0), f_bar=f_bar, cell_tags=tags if laws == 2 else None
    )
    problem = mpm.QuasiStaticProblem(body, bcs=[mpm.held(V, x=0.0)])
    problem.solve(1)
    # a mean stress that volume ratios are averages of has its jumps taken away, as in the output
    young = np.where(scenes.in_order(particles, particles.initial_centroid)[:, 0] < 0.5, 1.0, 5.0)
    expected = by_hand(particles, YOUNG * (young if laws == 2 else 1.0))
    points = problem.points[0]
    moduli = bulk_and_shear_moduli(points.laws)
    found = scenes.in_order(particles, stress_errors(particles, points, moduli))
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12 * expected.max())
