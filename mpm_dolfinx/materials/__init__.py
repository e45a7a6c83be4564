# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Materials: the contract, laws in strain space, and tools to write and check one's own."""

from . import mandel
from .base import (
    Integration,
    Material,
    Parameter,
    State,
    StrainMaterial,
    Update,
    check_parameter,
    per_row,
)
from .cam_clay import ModifiedCamClay
from .check import check_tangent
from .drucker_prager import DruckerPrager
from .elastic import Hencky, IsotropicElastic, LinearElastic
from .fracture import Fracture
from .mohr_coulomb import FrictionalMaterial, MohrCoulomb, Tresca
from .mu_i import MuIRheology
from .neo_hooke import NeoHooke
from .return_mapping import ReturnMapping
from .undrained import Undrained
from .von_mises import SmallStrainVonMises, VonMises

__all__ = [
    "DruckerPrager",
    "Fracture",
    "FrictionalMaterial",
    "Hencky",
    "Integration",
    "IsotropicElastic",
    "LinearElastic",
    "Material",
    "ModifiedCamClay",
    "MohrCoulomb",
    "MuIRheology",
    "NeoHooke",
    "Parameter",
    "ReturnMapping",
    "SmallStrainVonMises",
    "State",
    "StrainMaterial",
    "Tresca",
    "Undrained",
    "Update",
    "VonMises",
    "check_parameter",
    "check_tangent",
    "mandel",
    "per_row",
]


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted(__all__)
