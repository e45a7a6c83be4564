# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Parameters that are refused."""

import numpy as np
import pytest
from compare import raises

import mpm_dolfinx as mpm
from mpm_dolfinx.materials import Hencky, LinearElastic, VonMises

MATERIALS = {
    "young 0": (lambda: Hencky(0.0, 0.3), r"young is 0"),
    "young negative": (lambda: LinearElastic(-1.0, 0.3), r"young is -1"),
    "young nan": (lambda: Hencky(np.nan, 0.3), r"young is nan"),
    "young infinite": (lambda: Hencky(np.inf, 0.3), r"young is inf"),
    "young in words": (lambda: Hencky("soft", 0.3), r"young must be a finite number"),
    "poisson 0.5": (lambda: Hencky(1.0, 0.5), r"poisson is 0\.5"),
    "poisson 0.7": (lambda: LinearElastic(1.0, 0.7), r"poisson is 0\.7"),
    "poisson -1": (lambda: VonMises(1.0, -1.0, rho_y=1.0), r"poisson is -1"),
    "rho_y 0": (lambda: VonMises(1.0, 0.3, rho_y=0.0), r"rho_y is 0"),
    "yield_stress negative": (lambda: VonMises(1.0, 0.3, yield_stress=-2.0), r"yield_stress is"),
    "no strength": (lambda: VonMises(1.0, 0.3), r"exactly one of rho_y and yield_stress"),
    "two strengths": (
        lambda: VonMises(1.0, 0.3, rho_y=1.0, yield_stress=1.0),
        r"exactly one of rho_y and yield_stress",
    ),
    "softening": (lambda: VonMises(1.0, 0.3, rho_y=1.0, hardening=-1.0), r"hardening is -1"),
    "one bad value of many": (
        lambda: Hencky(np.array([1.0, -3.0]), 0.3).initial_state(2, 2),
        r"young is -3",
    ),
    "no number among many": (
        lambda: Hencky(1.0, np.array([0.3, np.nan])).initial_state(2, 2),
        r"poisson is nan",
    ),
    "a table of values": (
        lambda: Hencky(np.ones((2, 2)), 0.3),
        r"young must be a finite number, one number per point",
    ),
}


@pytest.mark.parametrize("case", MATERIALS)
def test_materials(case):
    build, sentence = MATERIALS[case]
    raises(build, mpm.MPMError, sentence)
