# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The compiled updates of the laws at finite strain; NumPy's are the reference."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
from numpy.typing import NDArray

from .._core import loops
from .base import Parameter, State, StrainMaterial, Update
from .kinematics import require_valid
from .mandel import num_components

__all__ = ["CompiledMaterial", "update_hencky", "update_plastic", "update_von_mises"]


class CompiledMaterial(StrainMaterial):
    """A law that may have a compiled update: the method ``_compiled_update`` of its class.

    Attributes:
        compiled: Whether a compiled update is used where the law itself (not a law derived from
            it) has one and the package was built with it; its answer differs from
            :meth:`StrainMaterial.update` by round-off alone.
    """

    compiled: bool = True

    def update(
        self, displacement_gradient: NDArray[np.float64], state: State, tangent: bool = True
    ) -> Update:
        """See :meth:`Material.update`."""
        rule = vars(type(self)).get("_compiled_update")
        if rule is None or loops is None or not self.compiled:
            return super().update(displacement_gradient, state, tangent)
        return cast(Update, rule(self, displacement_gradient, state, tangent))


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
    bulk: Parameter,
    shear: Parameter,
    displacement_gradient: NDArray[np.float64],
    tangent: bool,
) -> Update:
    """Update Hencky's law.

    Args:
        bulk: Bulk modulus, a number or shape ``(n,)``, as all parameters.
        shear: Shear modulus.
        displacement_gradient: As for :meth:`Material.update`.
        tangent: As there.
    """
    H = np.ascontiguousarray(displacement_gradient)
    P, A, stress = _outputs(H, tangent)
    invalid = loops.update_hencky(H, _values(bulk), _values(shear), P, A, stress)
    _check(invalid, len(H))
    return Update(P, A if tangent else None, {"stress": stress})


def update_plastic(
    law: str,
    parameters: Sequence[Parameter],
    variables: Sequence[str],
    yield_tolerance: float,
    displacement_gradient: NDArray[np.float64],
    state: State,
    tangent: bool,
) -> Update:
    """Update a law with a history at finite strain.

    Args:
        law: Name of the law in ``material.h``.
        parameters: Bulk and shear modulus and the constants of the law, numbers or shape ``(n,)``.
        variables: Names of its internal variables.
        yield_tolerance: Excess of the yield function over the strength that counts as round-off.
        displacement_gradient: As for :meth:`Material.update`.
        state: As there.
        tangent: As there.
    """
    H = np.ascontiguousarray(displacement_gradient)
    P, A, stress = _outputs(H, tangent)
    b, new_variables = np.empty_like(stress), [np.empty(len(H)) for _ in variables]
    invalid = loops.update_plastic(
        law,
        H,
        np.ascontiguousarray(state["displacement_gradient"]),
        np.ascontiguousarray(state["elastic_b_minus_identity"]),
        [np.ascontiguousarray(state[name]) for name in variables],
        [_values(p) for p in parameters],
        yield_tolerance,
        P,
        A,
        stress,
        b,
        new_variables,
    )
    _check(invalid, len(H))
    new = {"stress": stress, "displacement_gradient": H.copy(), "elastic_b_minus_identity": b}
    new |= dict(zip(variables, new_variables, strict=True))
    return Update(P, A if tangent else None, new)


def update_von_mises(
    elastic: tuple[Parameter, Parameter],
    plastic: tuple[Parameter, Parameter],
    yield_tolerance: float,
    displacement_gradient: NDArray[np.float64],
    state: State,
    tangent: bool,
) -> Update:
    """Update von Mises' law at finite strain.

    Args:
        elastic: Bulk and shear modulus, numbers or shape ``(n,)``.
        plastic: Norm of the stress deviator at first yield, and hardening.
        yield_tolerance: Value of the yield function that counts as round-off.
        displacement_gradient: As for :meth:`Material.update`.
        state: As there.
        tangent: As there.
    """
    H = np.ascontiguousarray(displacement_gradient)
    P, A, stress = _outputs(H, tangent)
    b, plastic_strain = np.empty_like(stress), np.empty(len(H))
    invalid = loops.update_von_mises(
        H,
        *(
            np.ascontiguousarray(state[name])
            for name in ("displacement_gradient", "elastic_b_minus_identity", "plastic_strain")
        ),
        *(_values(p) for p in (*elastic, *plastic)),
        yield_tolerance,
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
