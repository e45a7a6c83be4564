# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""A check of a material's tangent, for those who write one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError
from ..parallel.given import as_positive, is_number, require_whole
from ..tolerances import INEXACT
from .base import Material, State
from .derivatives import RELATIVE_STEP

__all__ = ["check_tangent"]

STENCIL = np.array([-25.0, 48.0, -36.0, 16.0, -3.0]) / 12.0
"""Weights of a one-sided difference of fourth order."""


def check_tangent(
    material: Material,
    dim: int = 2,
    strain: float = 1e-2,
    seed: int = 0,
    points: int = 24,
    steps: int = 4,
    rotation: float | None = None,
    tolerance: float = 1e-6,
) -> float:
    """Compare a material's tangent with differences of its stress over a random history.

    Points are strained by increments of 0.01 to 1 times ``strain`` and rotated, and the state is
    kept after each step. Choose ``strain`` well above the yield strain, so that small increments
    are elastic and large ones plastic.

    Args:
        material: The material; with parameters per point, their number is the number of points.
        dim: 2 (plane strain) or 3.
        strain: Size of the largest strain increments.
        seed: Seed of the random history.
        points: Number of points, each with its own history.
        steps: Number of steps.
        rotation: Largest rotation per step in radians; by default 1, or none for a material
            with small-strain kinematics.
        tolerance: Largest error allowed, relative to the largest entry of a point's tangent.

    Returns:
        The largest relative error.

    Raises:
        MPMError: The error exceeds the tolerance, the tangent lacks the symmetry that
            ``material.symmetric`` claims, or ``update`` modified the state it was given.
    """
    if not isinstance(material, Material):
        raise MPMError(f"check_tangent() needs a material, not {material!r}.")
    require_whole("dim", dim, 3, least=2)
    require_whole("seed", seed)
    require_whole("points", points, least=1)
    require_whole("steps", steps, least=1)
    strain, tolerance = as_positive(strain, "strain"), as_positive(tolerance, "tolerance")
    if rotation is not None and not (is_number(rotation) and np.isfinite(rotation)):
        raise MPMError(f"rotation must be a finite number of radians or None, not {rotation!r}.")
    name = type(material).__name__
    arrays = [v for v in material.parameters.values() if isinstance(v, np.ndarray)]
    points = len(arrays[0]) if arrays else points
    if rotation is None:
        rotation = 0.0 if material.kinematics == "small" else 1.0
    random = np.random.default_rng(seed)
    F = np.broadcast_to(np.eye(dim), (points, dim, dim))
    state = material.initial_state(points, dim)
    worst = 0.0
    for step in range(1, steps + 1):
        size = strain * 10.0 ** random.uniform(-2.0, 0.0, points)
        stretch = random.uniform(-1.0, 1.0, (points, dim, dim)) * size[:, None, None]
        F = _rotations(random, points, dim, rotation) @ (np.eye(dim) + stretch) @ F
        H = F - np.eye(dim)
        before = {key: values.copy() for key, values in state.items()}
        answer = material.update(H, state)
        if any(not np.array_equal(before[key], state[key]) for key in before):
            raise MPMError(f"{name}.update modified the state that it was given")
        A = answer.tangent
        if A is None:
            raise MPMError(f"{name}.update returned no tangent")
        largest = np.abs(A).max(axis=(1, 2, 3, 4))
        largest[largest == 0.0] = 1.0  # a material that has nothing to resist with: so be it
        if material.symmetric:
            skew = np.abs(A - A.transpose(0, 3, 4, 1, 2)).max(axis=(1, 2, 3, 4)) / largest
            if not skew.max() <= tolerance:
                raise MPMError(
                    f"{name} claims a symmetric tangent, but in step {step} it is unsymmetric by "
                    f"{skew.max():.1e} of its largest entry"
                )
        # Where yield sets in nearby, one side and the smaller step are still smooth.
        errors = [
            np.abs(A - _differences(material, H, state, signed * size))
            for h in (RELATIVE_STEP, INEXACT * RELATIVE_STEP)
            for signed in (h, -h)
        ]
        error = np.min(errors, axis=0).max(axis=(1, 2, 3, 4)) / largest
        if not error.max() <= tolerance:
            raise MPMError(
                f"the tangent of {name} differs from differences of its stress by "
                f"{np.nanmax(error):.1e} of its largest entry (allowed: {tolerance:.1e}) in step "
                f"{step}, at a strain increment of {size[np.nanargmax(error)]:.1e}",
                particles=np.flatnonzero(~(error <= tolerance)),
            )
        worst = max(worst, float(error.max()))
        state = answer.state
    return worst


def _rotations(
    random: np.random.Generator, points: int, dim: int, largest: float
) -> NDArray[np.float64]:
    """Return random rotations, shape ``(points, dim, dim)``, by Cayley's formula."""
    spin = np.tan(0.5 * largest) * random.uniform(-1.0, 1.0, (points, dim, dim)) / (dim - 1)
    spin = np.triu(spin, 1) - np.triu(spin, 1).swapaxes(1, 2)
    return np.asarray(np.linalg.solve(np.eye(dim) - spin, np.eye(dim) + spin))


def _differences(
    material: Material, H: NDArray[np.float64], state: State, step: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return dP/dF, shape ``(n, dim, dim, dim, dim)``, by one-sided differences."""
    n, dim = H.shape[:2]
    directions = np.eye(dim * dim).reshape(dim * dim, dim, dim)
    # One update sees all shifted gradients, as if they were points of their own.
    shifts = np.einsum("a,dkL,n->adnkL", np.arange(len(STENCIL)), directions, step)
    points = np.tile(np.arange(n), len(STENCIL) * len(directions))
    answer = material.at(points).update(
        (H + shifts).reshape(-1, dim, dim),
        {name: values[points] for name, values in state.items()},
        tangent=False,
    )
    P = answer.first_piola.reshape(len(STENCIL), dim, dim, n, dim, dim)
    A = np.einsum("a,akLniJ->niJkL", STENCIL, P)
    return np.asarray(A / step[:, None, None, None, None])
