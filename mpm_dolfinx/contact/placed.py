# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A shape in one place: what it is from outside, and what points are in its own frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError, as_ours
from .rotation import Pose
from .shapes import Shape

__all__ = ["Placed", "distance_within", "framed", "placed"]


class Placed(NamedTuple):
    """An obstacle in one place.

    Attributes:
        distance: Its signed distance, a function of points ``(n, gdim)``.
        bounds: Corners of a box around it, shape ``(2, gdim)``; ``None`` where it has none.
        facets: Points and facets of its surface, ``None`` where it has no facets.
    """

    distance: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    bounds: NDArray[np.float64] | None
    facets: tuple[NDArray[np.float64], NDArray[np.int64]] | None


def placed(shape: Shape, pose: Pose) -> Placed:
    """Return a shape where it is put."""
    bounds = None
    if shape.bounds is not None:
        corners = np.stack(np.meshgrid(*shape.bounds.T), axis=-1).reshape(-1, shape.dim)
        bounds = np.array([f(unframed(shape, pose, corners), axis=0) for f in (np.min, np.max)])
    facets = None
    if shape.outline is not None:
        facets = unframed(shape, pose, shape.outline[0]), shape.outline[1]

    def distance(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(shape.distance(framed(shape, pose, x))[0])

    return Placed(distance, bounds, facets)


def framed(shape: Shape, pose: Pose, x: NDArray[Any]) -> NDArray[Any]:
    """Return positions ``(..., gdim)`` in the frame of a shape that is put somewhere."""
    arms = x.reshape(-1, x.shape[-1]) - (shape.pivot + pose.offset)
    return (arms @ pose.Q + shape.pivot).reshape(x.shape)


def unframed(shape: Shape, pose: Pose, y: NDArray[Any]) -> NDArray[Any]:
    """Return positions ``(..., gdim)`` of what is there in the frame of a shape."""
    return np.asarray((y - shape.pivot) @ pose.Q.T + (shape.pivot + pose.offset))


def distance_within(
    shape: Shape, y: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return gaps and normals of points in the frame of a shape.

    Raises:
        MPMError: The shape, which may be a user's, raises an error.
    """
    try:
        return shape.distance(y)
    except MPMError:
        raise
    except Exception as error:
        raise as_ours(error, "The shape of a Rigid") from error
