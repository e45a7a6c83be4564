# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Values that users give: numbers, UFL, or functions of coordinates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import ufl
from dolfinx import fem, mesh

from .. import _compat
from ..errors import MPMError, agree, as_ours
from ..parallel.compilation import compiled_expression
from ..parallel.given import not_a_value, require_same
from ..reals import as_reals, holds_ufl

__all__ = ["AtPoints", "Value", "as_ufl", "at_points", "interpolated", "is_function"]

type Value = ArrayLike | ufl.core.expr.Expr | Sequence[Any] | Callable[[Any], Any]
"""A value at each place of a body: finite numbers; a Constant, a Function or other UFL on the body
mesh, or a list of components that are such; or a function of coordinates that returns them. What
acts in a run calls it with ``x = ufl.SpatialCoordinate(mesh)``; what a body begins with, and
Dirichlet values, with arrays ``x`` of shape ``(3, n)``, for components of the shape ``(n,)``, or
numbers. ``lambda x: (0.0, -2.0 * x[1])`` is right for both."""

type Array = NDArray[np.float64]


def is_function(value: Any) -> bool:
    """Return whether a value is a function; UFL can be called too."""
    return callable(value) and not isinstance(value, ufl.core.expr.Expr)


def as_ufl(
    value: Any, domain: mesh.Mesh, name: str, shape: tuple[int, ...] = (), negative: bool = True
) -> Any:
    """Return a value as UFL on a mesh (collective).

    Args:
        value: A :data:`Value`, whose function is called with UFL coordinates.
        domain: The mesh.
        name: What it is called in a message.
        shape: The shape that it must have.
        negative: Whether a number may be negative.

    Raises:
        MPMError: It is something else, not finite, of another shape, or on another mesh.
    """
    with agree(domain.comm):
        made = value
        if is_function(value):
            try:
                made = value(ufl.SpatialCoordinate(domain))
            except Exception as error:
                what = f"The function that gives {name}, and is given UFL coordinates,"
                raise as_ours(error, what) from error
        if holds_ufl(made):
            made = _ufl(made, domain, name, shape)
        else:
            numbers = _numbers(made, name, shape)
            if not negative and (numbers < 0.0).any():
                raise MPMError(f"{name} must not be negative, not {value!r}.")
            made = fem.Constant(domain, numbers)
    if is_function(value):
        require_same(domain.comm, **{name: made})
    return made


def _ufl(value: Any, domain: mesh.Mesh, name: str, shape: tuple[int, ...]) -> Any:
    """Return UFL, or lists that hold some, as one expression."""
    try:
        made = ufl.as_tensor(value) if isinstance(value, list | tuple) else value
    except Exception:
        raise not_a_value(name, value, shape) from None
    if made.ufl_shape != shape:
        raise MPMError(f"{name} has the shape {made.ufl_shape}, but must have {shape}.")
    domains = ufl.domain.extract_domains(made)
    if any(own != domain.ufl_domain() for own in domains):
        raise MPMError(f"{name} lives on another mesh; write it on the one that it is for.")
    if not domains and shape == ():  # UFL that is a number
        return fem.Constant(domain, _numbers(float(made), name, ()))
    return made


def _finite(value: Any) -> Array | None:
    """Return finite numbers as a new array, or ``None``: they are something else."""
    try:
        found = as_reals(value)
    except (TypeError, ValueError):
        return None
    return found if np.isfinite(found).all() else None


def _numbers(value: Any, name: str, shape: tuple[int, ...]) -> Array:
    """Return finite numbers of a shape."""
    found = _finite(value)
    if found is None:
        raise not_a_value(name, value, shape)
    if found.shape != shape:
        raise MPMError(f"{name} has the shape {found.shape}, but must have {shape}.")
    return found


def _of_coordinates(function: Any, x: Array, name: str, shape: tuple[int, ...]) -> Array:
    """Call a function of coordinates ``(3, n)``; return its values, ``(*shape, n)``."""
    n = x.shape[1]
    try:
        values = function(x)
    except Exception as error:
        raise as_ours(error, f"The function that gives {name}") from error
    if isinstance(values, list | tuple) and len(values) and not holds_ufl(values):
        with suppress(ValueError):  # (of components some may be numbers)
            values = np.stack([np.broadcast_to(component, (n,)) for component in values])
    found = _finite(values)
    if found is not None and found.shape == shape:
        found = np.repeat(found[..., None], n, axis=-1)
    if found is None or found.shape != (*shape, n):
        raise MPMError(
            f"The function that gives {name} must return finite numbers of the shape "
            f"{(*shape, n)} for coordinates {x.shape}, not {_in_words(values)}."
        )
    return found


def _in_words(values: Any) -> str:
    if not isinstance(values, np.ndarray):
        return type(values).__name__
    finite = "" if values.dtype.kind not in "fc" or np.isfinite(values).all() else ", not finite"
    return f"an array of the shape {values.shape}{finite}"


class AtPoints:
    """UFL at points of the cells that this rank owns, whose values may change (collective).

    Args:
        value: UFL on the mesh, as :func:`as_ufl` returns it.
        domain: The mesh.
        points: Points of the reference cell, shape ``(nq, tdim)``.
    """

    def __init__(self, value: Any, domain: mesh.Mesh, points: Array) -> None:
        self._value, self._domain = value, domain
        self._shape = (len(points), *value.ufl_shape)
        self._compiled: fem.Expression | None = None
        if not isinstance(value, fem.Constant):
            if not ufl.domain.extract_domains(value):  # it knows no ranks
                value = fem.Constant(domain, 1.0) * value
            self._compiled = compiled_expression(value, points, domain.comm)

    def values(self) -> Array:
        """Return the present values, shape ``(n, nq, ...)``."""
        domain = self._domain
        n = domain.topology.index_map(domain.topology.dim).size_local
        if self._compiled is None:
            return np.broadcast_to(np.asarray(self._value.value), (n, *self._shape))
        found: Any = self._compiled.eval(domain, np.arange(n, dtype=np.int32))
        return np.asarray(found.reshape(n, *self._shape))


def at_points(
    value: Any, domain: mesh.Mesh, name: str, shape: tuple[int, ...], points: Array, x: Array
) -> Array:
    """Return a value as it is now at points of the cells that this rank owns (collective).

    Args:
        value: A :data:`Value`, whose function is called with arrays.
        domain: The mesh.
        name: What it is called in a message.
        shape: The shape that it must have.
        points: Points of the reference cell, shape ``(nq, tdim)``.
        x: Where they are in each cell, shape ``(3, n nq)``.

    Returns:
        Shape ``(n, nq, *shape)``.

    Raises:
        MPMError: As :func:`as_ufl`.
    """
    if not is_function(value):
        return AtPoints(as_ufl(value, domain, name, shape), domain, points).values()
    with agree(domain.comm):
        values = _of_coordinates(value, x, name, shape)
    return np.moveaxis(values, -1, 0).reshape(-1, len(points), *shape)


def interpolated(value: Any, space: fem.FunctionSpace, name: str) -> fem.Function:
    """Return a Function that has a value as it is now (collective).

    Args:
        value: A :data:`Value`, whose function is called with arrays.
        space: Of Lagrange type.
        name: What it is called in a message.

    Raises:
        MPMError: As :func:`as_ufl`.
    """
    found = fem.Function(space, name=name)
    domain, shape = space.mesh, tuple(space.value_shape)
    if is_function(value):

        def values(x: Array) -> Array:
            return _of_coordinates(value, x, name, shape)

        with agree(domain.comm):
            found.interpolate(values)
    else:
        made = as_ufl(value, domain, name, shape)
        if isinstance(made, fem.Constant):
            found.x.array.reshape(-1, max(made.value.size, 1))[:] = made.value.ravel()
        elif isinstance(made, fem.Function):
            found.interpolate(made)
        else:
            points = _compat.interpolation_points(space)
            found.interpolate(compiled_expression(made, points, domain.comm))
    found.x.scatter_forward()
    with agree(domain.comm):
        if not np.isfinite(found.x.array).all():
            raise MPMError(f"{name} must be finite everywhere.")
    return found
