# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The stress that a body carries before anything has moved."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem

from ..assembly.inputs import as_expression
from ..errors import MPMError, agree, as_ours
from ..meshes.quadrature import quadrature_rule
from ..parallel.compilation import compiled_expression
from ..particles.particles import Particles
from ..reals import as_reals
from .water_table import WaterTable

__all__ = ["geostatic", "initial_stress_at_points"]

type Array = NDArray[np.float64]


@dataclass(frozen=True)
class _Geostatic:
    """The stress of level ground, a function of coordinates.

    Attributes:
        surface: Level of the ground.
        strength: Size of gravity.
        down: Its direction, shape ``(3,)``.
        tops: Depth at which each layer begins, shape ``(m,)``.
        densities: Of each layer.
        ratios: K0 of each layer.
        loads: Vertical pressure where each begins.
        water: The water in it, which carries a share of the stress, and may stand on it.
    """

    surface: float
    strength: float
    down: Array
    tops: Array
    densities: Array
    ratios: Array
    loads: Array
    water: WaterTable | None

    def require_for(self, gdim: int) -> None:
        """Raise an error where gravity does not lie in a body's plane."""
        if np.any(self.down[gdim:] != 0.0):
            raise MPMError(
                f"geostatic has gravity with a third component, but the body has {gdim} "
                "dimensions; give it the body_force."
            )

    def __call__(self, x: Array) -> Array:
        depth = self.surface + self.down @ x
        layer = np.clip(np.searchsorted(self.tops, depth, side="right") - 1, 0, None)
        unit = self.densities[layer] * self.strength
        vertical = self.loads[layer] + unit * (depth - self.tops[layer])
        if self.water is not None:
            standing = self.water.on(self.surface, x)
            vertical = vertical + standing - self.water.on(-(self.down @ x), x)
        vertical = np.where(depth >= 0.0, vertical, 0.0)
        along = np.outer(self.down, self.down)
        return np.asarray(
            -np.multiply.outer(along, vertical)
            - np.multiply.outer(np.eye(3) - along, self.ratios[layer] * vertical)
        )


def geostatic(
    surface: float,
    density: float | Sequence[tuple[float, float]],
    K0: float | Sequence[float],
    gravity: Sequence[float],
    surcharge: float = 0.0,
    water: WaterTable | None = None,
) -> Callable[[Array], Array]:
    """Return the stress of level ground under its own weight, for ``initial_stress=``.

    The vertical stress is the weight of what lies above, the horizontal one is K0 times it (the
    K0 procedure). Under its body force, with sides and base that do not move, such ground is in
    equilibrium as it is.

    Args:
        surface: Level of the ground, measured against gravity: ``x[1]`` for gravity ``(0, -g)``.
        density: Mass per volume, or layers from the surface downwards: pairs of a thickness and a
            density; the last layer goes on for ever.
        K0: Horizontal over vertical stress, a number or one for each layer.
        gravity: Force per mass, a vector, as it is given for ``body_force``.
        surcharge: Pressure on the surface.
        water: Water in the ground: the stress is the effective one then, densities are those of
            soil and water together, and K0 is that of effective stresses.

    Returns:
        A function of coordinates, shape ``(3, n)``, that returns Cauchy stresses ``(3, 3, n)``;
        above the surface they are zero.

    Raises:
        MPMError: Values that are not finite or negative, layers without thickness, or no gravity.
    """
    try:
        g = np.zeros(3)
        g[: len(gravity)] = as_reals(gravity)
        layers = [(np.inf, float(density))] if np.ndim(density) == 0 else list(density)  # type: ignore[arg-type]
        thickness, densities = as_reals(layers).T
        ratios = np.broadcast_to(as_reals(K0), len(layers))
        numbers = as_reals([surface, surcharge])
    except (TypeError, ValueError):
        raise MPMError(
            "geostatic needs a level, a density or layers (pairs of a thickness and a density), "
            "K0 as a number or one for each layer, and gravity as a vector."
        ) from None
    tops = np.concatenate([[0.0], np.cumsum(thickness[:-1])])
    known = [g, densities, ratios, numbers, tops]
    if not all(np.isfinite(values).all() for values in known) or (thickness <= 0.0).any():
        raise MPMError("geostatic needs finite numbers, and layers with a positive thickness.")
    if (densities < 0.0).any() or (ratios < 0.0).any():
        raise MPMError("geostatic needs densities and K0 that are not negative.")
    strength = float(np.linalg.norm(g))
    if strength == 0.0:
        raise MPMError("geostatic needs gravity that is not zero.")
    weights = np.cumsum(densities[:-1] * np.diff(tops)) * strength
    loads = float(surcharge) + np.concatenate([[0.0], weights])
    if water is not None and not isinstance(water, WaterTable):
        raise MPMError(f"water= of geostatic is an mpm.WaterTable, not a {type(water).__name__}.")
    down = g / strength
    return _Geostatic(float(surface), strength, down, tops, densities, ratios, loads, water)


def initial_stress_at_points(value: Any, particles: Particles) -> Array:
    """Return an initial stress at the history's points (collective).

    Args:
        value: See :class:`QuasiStaticProblem`.
        particles: The body, which has not moved.

    Returns:
        Cauchy stresses, shape ``(n, nq, 3, 3)``.

    Raises:
        MPMError: It is something else, of another shape, or not finite.
    """
    n, nq = particles.num_local, particles.num_points
    if isinstance(value, ufl.core.expr.Expr):
        made = as_expression(value, particles, "initial_stress", (3, 3))
        made = fem.Constant(particles.mesh, 1.0) * made  # a constant one knows no ranks
        points, _ = quadrature_rule(
            particles.mesh.basix_cell(), particles.geometry.quadrature_degree
        )
        cells = np.arange(n, dtype=np.int32)
        at_points = compiled_expression(made, points, particles.mesh.comm)
        evaluated: Any = at_points.eval(particles.mesh, cells)
        values: Array = evaluated.reshape(n, nq, 3, 3)
    else:
        with agree(particles.mesh.comm):
            values = _at_points(value, particles)
    with agree(particles.mesh.comm):
        bad = ~np.isfinite(values).all(axis=(1, 2, 3))
        if bad.any():
            raise MPMError(
                "initial_stress is not finite at {particles}.", particles.global_index[bad]
            )
    return np.array(values, dtype=np.float64)


def _at_points(value: Any, particles: Particles) -> Array:
    n, nq = particles.num_local, particles.num_points
    if isinstance(value, _Geostatic):
        value.require_for(particles.mesh.geometry.dim)
    if callable(value):
        x = np.zeros((3, n * nq))
        points = particles.initial_points
        x[: points.shape[-1]] = points.reshape(n * nq, points.shape[-1]).T
        try:
            found = as_reals(value(x))
        except MPMError:
            raise
        except Exception as error:
            raise as_ours(error, "The function that gives initial_stress") from error
        if found.shape != (3, 3, n * nq):
            raise MPMError(
                "The function that gives initial_stress must return, for coordinates (3, n), "
                f"stresses of the shape (3, 3, n), not {found.shape} for n = {n * nq}."
            )
        return np.moveaxis(found, -1, 0).reshape(n, nq, 3, 3)
    try:
        array = as_reals(value)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape not in ((3, 3), (n, 3, 3), (n, nq, 3, 3)):
        raise MPMError(
            "initial_stress must be a stress (3, 3), an array of them for each owned particle or "
            "point, (n, 3, 3) or (n, nq, 3, 3), UFL of the shape (3, 3), a function of "
            f"coordinates, or mpm.geostatic(...), not {type(value).__name__} of the shape "
            f"{array.shape}."
        )
    return np.broadcast_to(array if array.ndim != 3 else array[:, None], (n, nq, 3, 3))
