# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The stabilisation of a pressure against its own formula, cell by cell."""

from types import SimpleNamespace

import numpy as np
import scenes
from scenes import QUADRILATERAL, gather

from dolfinx import fem

import mpm_dolfinx as mpm
from mpm_dolfinx.particles.field import CarriedField
from mpm_dolfinx.system.smoothing import PressureSmoothing


def test_forces_are_those_of_deviations_from_the_means_of_cells():
    # (with cells that are empty)
    V = scenes.vectors(scenes.box([0.0, 0.0], [4.0 / 3.0, 1.0], [4, 3], QUADRILATERAL))
    body = scenes.box([0.1, 0.1], [0.9, 0.95], [7, 6], QUADRILATERAL)
    particles = mpm.Particles(body, V)
    field = mpm.ParticleField(
        particles, fem.functionspace(V.mesh, ("Lagrange", 1)), at="points", name="p"
    )
    at = particles.initial_centroid
    volumes = particles.initial_volume * (1.0 + at[:, 0])
    shear = 50.0 * (1.0 + at[:, 1])
    tangent = np.zeros((len(at), 2, 2, 2, 2))
    tangent[:, 0, 1, 0, 1] = shear
    law = SimpleNamespace(points=slice(None), undeformed_tangent=lambda: tangent)
    laws = SimpleNamespace(num_points=len(at), dim=2, governed=[law])
    material = SimpleNamespace(strain=SimpleNamespace(weights=volumes[:, None]), laws=laws)
    field.x.array[: len(at)] = np.sin(5.0 * at[:, 0]) + at[:, 1] ** 2
    carried = CarriedField(field)
    carried.locate()
    term = PressureSmoothing(carried, material)
    with np.errstate(all="raise"):
        force = gather(term.residuals()[0].array_r)
    p, volumes, shear, at = (
        gather(a) for a in (field.x.array[: len(at)], volumes, shear, particles.initial_centroid)
    )
    expected = np.zeros(len(p))
    cells = np.floor(3.0 * at).astype(int) @ (1, 10)
    for cell in np.unique(cells):
        own = cells == cell
        v = volumes[own] / volumes[own].sum()
        compliance = 0.5 / (v @ shear[own])
        expected[own] = -compliance * volumes[own] * (p[own] - v @ p[own])
    np.testing.assert_allclose(force, expected, atol=1e-12 * np.abs(expected).max())
