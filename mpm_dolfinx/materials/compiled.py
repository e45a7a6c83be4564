# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The compiled updates of the laws at finite strain; NumPy's are the reference."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mpm_dolfinx._core import loops
from mpm_dolfinx.materials.base import Parameter, State, Update
from mpm_dolfinx.materials.kinematics import require_valid
from mpm_dolfinx.materials.mandel import num_components

if TYPE_CHECKING:
    from mpm_dolfinx.materials.elastic import IsotropicElastic
    from mpm_dolfinx.materials.von_mises import VonMises

__all__ = ["CompiledUpdate", "update_hencky", "update_von_mises"]

type CompiledUpdate = Callable[..., Update]
"""Called with a material, displacement gradients, a state and whether to find the tangent."""


def _values(parameter: Parameter) -> NDArray[np.float64]:
    return np.ascontiguousarray(np.atleast_1d(parameter), dtype=np.float64)


def _outputs(
    gradient: NDArray[np.float64], tangent: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return arrays for first Piola stress, tangent (empty if not asked for) and stress."""
    n, dim, _ = gradient.shape
    A = np.empty((n if tangent else 0, dim, dim, dim, dim))
    return np.empty_like(gradient), A, np.empty((n, num_components(dim)))


def _check(invalid: NDArray[np.int64], count: int) -> None:
    valid = np.ones(count, dtype=bool)
    valid[invalid] = False
    require_valid(valid)


def update_hencky(
    material: IsotropicElastic,
    displacement_gradient: NDArray[np.float64],
    state: State,
    tangent: bool,
) -> Update:
    """Update Hencky's law, see :meth:`Material.update`."""
    H = np.ascontiguousarray(displacement_gradient)
    P, A, stress = _outputs(H, tangent)
    invalid = loops.update_hencky(H, _values(material.bulk), _values(material.shear), P, A, stress)
    _check(invalid, len(H))
    return Update(P, A if tangent else None, {"stress": stress})


def update_von_mises(
    material: VonMises,
    displacement_gradient: NDArray[np.float64],
    state: State,
    tangent: bool,
) -> Update:
    """Update von Mises' law at finite strain, see :meth:`Material.update`."""
    H = np.ascontiguousarray(displacement_gradient)
    P, A, stress = _outputs(H, tangent)
    b, plastic_strain = np.empty_like(stress), np.empty(len(H))
    invalid = loops.update_von_mises(
        H,
        *(
            np.ascontiguousarray(state[name])
            for name in ("displacement_gradient", "elastic_b_minus_identity", "plastic_strain")
        ),
        *(_values(p) for p in (material.bulk, material.shear, material.rho_y)),
        _values(material.parameters["hardening"]),
        material.yield_tolerance,
        P,
        A,
        stress,
        b,
        plastic_strain,
    )
    _check(invalid, len(H))
    new = {
        "stress": stress,
        "displacement_gradient": H.copy(),
        "elastic_b_minus_identity": b,
        "plastic_strain": plastic_strain,
    }
    return Update(P, A if tangent else None, new)
