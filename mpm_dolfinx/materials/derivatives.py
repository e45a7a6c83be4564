# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Derivatives of a user's function of stress and plastic strain that need no formulas.

First derivatives are complex steps (Squire & Trapp 1998): exact to round-off, if the function
is analytic where it is called. Second derivatives are complex steps of a gradient, or central
differences of fourth order of complex steps: about 1e-11 relative.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .mandel import deviator, norm

__all__ = ["RELATIVE_STEP", "difference_by_stress", "slope_by_plastic_strain", "slope_by_stress"]

type Function = Callable[[NDArray[Any], NDArray[Any]], NDArray[Any]]
"""Function of stress ``(n, m)`` and plastic strain ``(n,)`` with values ``(n, ...)``."""

#: Complex steps have no round-off: so small that nothing is left of their square.
IMAGINARY_STEP = float(np.sqrt(np.finfo(float).tiny))
#: Step at which errors of differences of fourth order and of round-off are equal.
RELATIVE_STEP = float(np.finfo(float).eps ** (1.0 / 5.0))


def slope_by_stress(
    function: Function, stress: NDArray[np.float64], plastic_strain: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the derivative by stress through complex steps.

    Args:
        function: Analytic function with values ``(n, ...)``.
        stress: Shape ``(n, m)``.
        plastic_strain: Shape ``(n,)``.

    Returns:
        Shape ``(n, ..., m)``.
    """
    size = norm(stress)
    step = IMAGINARY_STEP * np.where(size > 0.0, size, 1.0)
    columns = []
    for j in range(stress.shape[1]):
        shifted = stress.astype(np.complex128)
        shifted[:, j] += 1j * step
        values = np.imag(function(shifted, plastic_strain))
        columns.append(values / step.reshape((-1,) + (1,) * (values.ndim - 1)))
    return np.stack(columns, axis=-1)


def slope_by_plastic_strain(
    function: Function, stress: NDArray[np.float64], plastic_strain: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the derivative by plastic strain, shape ``(n, ...)``, through a complex step."""
    values = function(stress, plastic_strain + 1j * IMAGINARY_STEP)
    return np.asarray(np.imag(values) / IMAGINARY_STEP)


def difference_by_stress(
    function: Function, stress: NDArray[np.float64], plastic_strain: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the derivative by stress, shape ``(n, ..., m)``, through central differences.

    The step follows the stress deviator, since yield functions vary over its size, however
    large the pressure is.
    """
    size = norm(deviator(stress))
    size = np.where(size > 1e-6 * norm(stress), size, norm(stress))
    step = RELATIVE_STEP * np.where(size > 0.0, size, 1.0)
    columns = []
    for j in range(stress.shape[1]):
        total: NDArray[Any] = np.zeros(())
        for multiple, weight in ((-2, 1.0), (-1, -8.0), (1, 8.0), (2, -1.0)):
            shifted = stress.copy()
            shifted[:, j] += multiple * step
            total = total + weight * function(shifted, plastic_strain)
        columns.append(total / (12.0 * step).reshape((-1,) + (1,) * (total.ndim - 1)))
    return np.stack(columns, axis=-1)
