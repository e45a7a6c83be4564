# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The classes of errors."""

import numpy as np

import mpm_dolfinx as mpm


def test_errors_are_runtime_errors_with_particles_and_load():
    kinds = (mpm.ParticleOutsideError, mpm.DomainDistortionError, mpm.ConvergenceError)
    for kind in kinds:
        error = kind("It failed.", np.array([3, 1], dtype=np.int64), 0.5)
        assert isinstance(error, mpm.MPMError) and isinstance(error, RuntimeError)
        assert error.particles == [1, 3] and error.load == 0.5
        assert [type(p) for p in error.particles] == [int, int]
    assert mpm.MPMError("No.").particles == [] and mpm.MPMError("No.").load is None
