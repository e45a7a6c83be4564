# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Input of users, taken for real or whole numbers."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem

__all__ = ["as_finite", "as_reals", "as_wholes", "holds_ufl", "is_one_of"]


def as_reals(value: Any) -> NDArray[np.float64]:
    """Return numbers as a new array.

    Raises:
        TypeError: Complex numbers, whose imaginary part would be dropped, truths, ``None``, which
            NumPy takes for not a number, or UFL that has no value (NumPy goes through the
            components of a scalar without end).
        ValueError: Something else that is none.
    """
    if holds_ufl(value, fem.Constant):
        raise TypeError("UFL is no number")
    array = np.asarray(value)
    if array.dtype.kind in "cb" or _holds(value, (bool, np.bool_, type(None))):
        raise TypeError("complex numbers, truths, or nothing")
    try:
        return np.array(array, dtype=np.float64)
    except OverflowError as error:
        raise ValueError("too large a number") from error


def as_finite(value: Any, *shape: int | None) -> NDArray[np.float64] | None:
    """Return finite numbers as a new array, or ``None``: they are something else.

    Args:
        value: Anything.
        *shape: Sizes of the array along its axes; ``None``: any.
    """
    try:
        array = as_reals(value)
    except (TypeError, ValueError):
        return None
    if len(shape) != array.ndim or not np.isfinite(array).all():
        return None
    fits = all(size in (None, own) for size, own in zip(shape, array.shape, strict=True))
    return array if fits else None


def as_wholes(value: Any) -> NDArray[np.int64]:
    """Return whole numbers, such as indices or tags, as a new array.

    Raises:
        TypeError: Truths, or something else that are none.
        ValueError: Lists of different lengths.
    """
    array = np.asarray(value)
    if array.size and (array.dtype.kind not in "iu" or _holds(value, (bool, np.bool_))):
        raise TypeError("no whole numbers")
    return array.astype(np.int64)


def holds_ufl(value: Any, *besides: type) -> bool:
    """Return whether a value is UFL, or a list that holds some.

    Args:
        value: Anything.
        *besides: Kinds of UFL that do not count.
    """
    return _holds(value, (ufl.core.expr.Expr,), besides)


def _holds(value: Any, kinds: tuple[type, ...], besides: tuple[type, ...] = ()) -> bool:
    """Return whether a value is of some kinds, or a list that holds such values."""
    if isinstance(value, list | tuple):
        return any(_holds(part, kinds, besides) for part in value)
    return isinstance(value, kinds) and not isinstance(value, besides)


def is_one_of(value: Any, names: Collection[str]) -> bool:
    """Return whether a value is one of some names."""
    return isinstance(value, str) and value in names
