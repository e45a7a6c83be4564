# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Domains that are refused."""

import numpy as np
import scenes
from bad_input import background, touching
from compare import raises
from scenes import TRIANGLE, WORLD

from dolfinx import mesh

import mpm_dolfinx as mpm


def test_one_flat_domain():
    # A corner of the body is moved onto the diagonal of its cell.
    domain = mesh.create_rectangle(
        WORLD, [[0.0, 0.0], [1.0, 1.0]], [4, 4], TRIANGLE, diagonal=mesh.DiagonalType.left
    )
    x = domain.geometry.x
    x[(x[:, 0] > 0.9) & (x[:, 1] > 0.9), :2] = [0.875, 0.875]
    expected = touching(domain, lambda x: np.isclose(x[..., 0], 0.875))
    assert len(expected) == 1
    error = raises(
        lambda: mpm.Particles(domain, scenes.vectors(background())),
        mpm.DomainDistortionError,
        r"have no volume",
    )
    assert error.particles == expected
