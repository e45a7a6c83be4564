# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Materials: the contract, laws in strain space, and tools to write and check one's own."""

from mpm_dolfinx.materials import mandel
from mpm_dolfinx.materials.base import (
    Integration,
    Material,
    Parameter,
    State,
    StrainMaterial,
    Update,
    check_parameter,
    per_row,
)
from mpm_dolfinx.materials.check import check_tangent
from mpm_dolfinx.materials.elastic import Hencky, IsotropicElastic, LinearElastic
from mpm_dolfinx.materials.return_mapping import ReturnMapping
from mpm_dolfinx.materials.von_mises import SmallStrainVonMises, VonMises

__all__ = [
    "Hencky",
    "Integration",
    "IsotropicElastic",
    "LinearElastic",
    "Material",
    "Parameter",
    "ReturnMapping",
    "SmallStrainVonMises",
    "State",
    "StrainMaterial",
    "Update",
    "VonMises",
    "check_parameter",
    "check_tangent",
    "mandel",
    "per_row",
]
