# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""By what the materials of a body are known again."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..materials.base import Material
from ..parallel.given import options_of
from .points import MaterialPoints

__all__ = ["identity"]


def identity(points: MaterialPoints) -> list[tuple[str, dict[str, Any]]]:
    """Return name and parameters of each material; arrays with the indices of their points.

    They are those of the material as it was given, whatever its strength is divided by.
    """
    nq = points.strain.particles.num_points
    index = (points.strain.particles.global_index[:, None] * nq + np.arange(nq)).ravel()
    common: dict[str, Any] = {} if points.mean_stress is None else {"mixed": "pressure"}
    common["f_bar"] = "none" if points.averaging is None else points.averaging.kind
    if points.softening is not None:
        common["length"] = points.softening.length
    found = []
    materials = points.laws.as_strong_as_given()
    for material, part in zip(materials, points.laws.governed, strict=True):
        where = index[part.points]
        parameters = {
            name: (where, value) if isinstance(value, np.ndarray) else value
            for name, value in material.parameters.items()
        }
        whole = {**parameters, "points": (where, np.ones(len(where))), **common}
        if options := _told(material):
            whole["options"] = options
        found.append((type(material).__name__, whole))
    return found


def _told(law: Material) -> str:
    """Return the traits of a law besides its class and its parameters, in words."""
    found = options_of(law).items()
    return ", ".join(
        f"{name}={type(one).__name__}({_told(one)})"
        if isinstance(one, Material)
        else f"{name}={one}"
        for name, one in found
    )
