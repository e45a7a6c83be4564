# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Pictures: what is drawn is where the particles are."""

import numpy as np
import pytest
import scenes
from scenes import QUADRILATERAL, TRIANGLE, WORLD

import mpm_dolfinx as mpm

STRETCH = np.array([0.3, -0.2])


def displaced(method, cell):
    """Return particles that converged in one place and have another displacement now."""
    V = scenes.vectors(scenes.box([-0.5, -0.5], [2.0, 2.0], [5, 5], QUADRILATERAL))
    particles = mpm.Particles(scenes.unit(2, cell), V, method=method)
    scenes.move(particles, lambda X: 0.1 * X)
    scenes.move(particles, lambda X: STRETCH * X, commit=False)
    return particles


def expected(particles, factor=1.0):
    """Return the corners of all domains by global index, each sorted."""
    corners = (1.0 + factor * STRETCH) * scenes.in_order(particles, particles.initial_domains)
    return np.array([sorted(map(tuple, each.round(12).tolist())) for each in corners])


@pytest.mark.parametrize("cell", [TRIANGLE, QUADRILATERAL], ids=scenes.name)
@pytest.mark.parametrize("method", ["cpdi2", "cpdi", "mpm", "gimp"])
@pytest.mark.parametrize("warp", [1.0, 0.5])
def test_domains_are_drawn_where_the_displacement_puts_them(method, cell, warp):
    pytest.importorskip("matplotlib").use("agg")
    plt = pytest.importorskip("matplotlib.pyplot")
    if method == "gimp" and cell == TRIANGLE:
        return
    particles = displaced(method, cell)
    wanted = expected(particles, warp)
    artist = mpm.plot.domains(particles, warp=warp)
    if WORLD.rank == 0:
        drawn = [path.vertices[:-1] for path in artist.get_paths()]
        found = np.array([sorted(map(tuple, each.round(12).tolist())) for each in drawn])
        np.testing.assert_allclose(found, wanted, atol=1e-11)
        plt.close("all")


@pytest.mark.parametrize("method", ["cpdi2", "gimp"])
def test_grid_is_where_the_displacement_puts_it(method):
    pytest.importorskip("pyvista")
    particles = displaced(method, QUADRILATERAL)
    wanted = expected(particles)
    grid = mpm.plot.grid(particles)
    if WORLD.rank == 0:
        found = grid.points[:, :2].reshape(wanted.shape)
        found = np.array([sorted(map(tuple, each.round(12).tolist())) for each in found])
        np.testing.assert_allclose(found, wanted, atol=1e-11)
        np.testing.assert_allclose(
            grid.compute_cell_sizes().cell_data["Area"], 0.25 * 1.3 * 0.8, rtol=1e-12
        )


def test_one_displacement_after_the_other():
    """Four displacements make four pictures of the areas that the particles have."""
    pytest.importorskip("matplotlib").use("agg")
    plt = pytest.importorskip("matplotlib.pyplot")
    particles = displaced("cpdi2", TRIANGLE)
    areas, drawn = [], []
    for angle in np.radians([0.0, 30.0, 60.0, 90.0]):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        scenes.move(particles, lambda X, turn=turn: X @ ((1.0 + angle) * turn - np.eye(2)).T, False)
        artist = mpm.plot.domains(particles)
        areas.append(scenes.total(particles, particles.volume))
        if WORLD.rank == 0:
            x = np.array([path.vertices for path in artist.get_paths()])
            one, two = x[:, :-1], x[:, 1:]
            twice = one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0]
            drawn.append(0.5 * np.abs(twice.sum(axis=1)).sum())
            plt.close("all")
    if WORLD.rank == 0:
        np.testing.assert_allclose(drawn, areas, rtol=1e-12)
        np.testing.assert_allclose(drawn, (1.0 + np.radians([0.0, 30.0, 60.0, 90.0])) ** 2)
