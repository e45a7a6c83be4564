# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The stress that a body carries before anything has moved."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError, agree, warn
from ..meshes.quadrature import quadrature_rule
from ..meshes.regions import in_space
from ..meshes.values import AtPoints, Value, as_ufl, at_points, is_function
from ..parallel.given import ON_A_MESH, not_a_value
from ..particles.particles import Particles
from ..reals import as_reals, holds_ufl
from .body import Body
from .water_table import WaterTable

__all__ = ["geostatic", "initial_stress_at_points", "warn_of_other_ground"]

type Array = NDArray[np.float64]

#: Share of the weight, or of the largest stress, from which ground is not what geostatic was told.
NOTICED = 0.01


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

    def weight(self, x: Array) -> Array:
        """Return the weight per volume that the stress balances, a vector ``(3, n)``."""
        depth, layer = self._layer(x)
        return np.outer(self.down, np.where(depth >= 0.0, self.densities[layer], 0.0)) * (
            self.strength
        )

    def vertical(self, x: Array) -> Array:
        """Return the vertical stress, positive in compression, shape ``(n,)``."""
        return np.asarray(-self.down @ np.einsum("ijn,j->in", self(x), self.down))

    def _layer(self, x: Array) -> tuple[Array, NDArray[np.int64]]:
        """Return depths below the surface, and the numbers of layers."""
        depth = self.surface + self.down @ x
        return depth, np.clip(np.searchsorted(self.tops, depth, side="right") - 1, 0, None)

    def __call__(self, x: Array) -> Array:
        depth, layer = self._layer(x)
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
    equilibrium as it is. A problem warns where the body has another weight, water or surface.

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


def warn_of_other_ground(given: Sequence[Body], every: Sequence[Body]) -> None:
    """Warn where :func:`geostatic` was told of other ground than bodies are (collective).

    Its stress balances a weight and a pressure of water at each point, and what acts on the highest
    place. That the ground slopes below its surface is meant to be possible.

    Args:
        given: Bodies that have not moved.
        every: These, and what else is there.
    """
    for body in given:
        stress = body.initial_stress
        if not isinstance(stress, _Geostatic):
            continue
        found = (
            _other_weight(stress, body)
            or _other_water(stress, body)
            or _other_surface(stress, body, every)
        )
        if found:
            warn(
                body.particles.mesh.comm,
                f"initial_stress= is not that of the body: {found}; the body moves by the "
                "difference as its loads come.",
            )


def _other_weight(stress: _Geostatic, body: Body) -> str:
    """Tell where a body has another weight than geostatic was told, if it has (collective)."""
    particles = body.particles
    gdim = particles.mesh.geometry.dim
    told = stress.weight(_coordinates(particles))[:gdim]
    weight = np.zeros_like(told)
    if body.body_force is not None:
        density = 1.0 if body.density is None else body.density
        force = _of_loads(body.body_force, particles, "body_force", (gdim,))
        mass = _of_loads(density, particles, "density", ())
        product = force * mass[..., None]
        weight = product.reshape(-1, gdim).T
    return _where_other(
        particles, "density times body_force", weight, told, np.linalg.norm(told, axis=0)
    )


def _other_water(stress: _Geostatic, body: Body) -> str:
    """Tell where a body has another pore pressure at rest than geostatic was told (collective)."""
    particles, x = body.particles, _coordinates(body.particles)
    known, water = body.pore_pressure, stress.water
    if body.pore_fluid is not None or (
        water is not None and known is not None and not isinstance(known, WaterTable)
    ):
        return ""
    told = np.zeros(x.shape[1]) if water is None else water.on(-(stress.down @ x), x)
    pressure = np.zeros_like(told)
    if known is not None:
        pressure = _of_loads(known, particles, "pore_pressure", ()).ravel()
    size = np.maximum(stress.vertical(x), 0.0) + told
    return _where_other(particles, "pore_pressure", pressure[None], told[None], size)


def _where_other(particles: Particles, name: str, here: Array, told: Array, size: Array) -> str:
    """Tell where something is another than geostatic was told, if it is in the mean (collective).

    Args:
        particles: The body.
        name: What it is.
        here: Values at its points, shape ``(k, n)``.
        told: Those of geostatic.
        size: What they are measured by, shape ``(n,)``.
    """
    comm, gdim = particles.mesh.comm, particles.mesh.geometry.dim
    off = np.linalg.norm(here - told, axis=0)
    if comm.allreduce(off.sum()) <= NOTICED * comm.allreduce(size.sum()):
        return ""
    worst: list[Any] = []
    if len(off):
        at = int(off.argmax())
        place = _coordinates(particles)[:gdim]
        worst = [float(off[at]), *(v[:, at].tolist() for v in (place, here, told))]
    _, place, has, expected = max(comm.allgather(worst))
    return (
        f"at {_in_words(place)} the body has a {name} of {_in_words(has)}, and mpm.geostatic of "
        f"{_in_words(expected)}"
    )


def _other_surface(stress: _Geostatic, body: Body, every: Sequence[Body]) -> str:
    """Tell of a stress at what is highest, where nothing acts, if there is one (collective)."""
    if any(other.tractions or other.pressures for other in every):
        return ""
    comm = body.particles.mesh.comm
    nodes = np.vstack([other.particles.mesh.geometry.x for other in every])
    height = -(nodes @ stress.down)
    top = comm.allreduce(height.max(initial=-np.inf), MPI.MAX)
    there = stress.vertical(nodes[height == top].T).max(initial=0.0)
    most = stress.vertical(_coordinates(body.particles)).max(initial=0.0)
    there, most = (comm.allreduce(value, MPI.MAX) for value in (there, most))
    if there <= NOTICED * most:
        return ""
    return (
        f"nothing acts on its top at {top:g}, where mpm.geostatic, with a surface at "
        f"{stress.surface:g}, has a vertical stress of {there:g}"
    )


def _in_words(values: Sequence[float]) -> str:
    words = ", ".join(f"{value + 0.0:g}" for value in values)
    return words if len(values) == 1 else f"({words})"


def _coordinates(particles: Particles) -> Array:
    """Return where the history's points were at first, shape ``(3, n nq)``."""
    points = particles.initial_points
    return in_space(points.reshape(-1, points.shape[-1]))


def _of_loads(value: Any, particles: Particles, name: str, shape: tuple[int, ...]) -> Array:
    """Return a value that acts in a run at the history's points, ``(n, nq, ...)`` (collective)."""
    made = as_ufl(value, particles.mesh, name, shape)
    return AtPoints(made, particles.mesh, _rule(particles)).values()


def _rule(particles: Particles) -> Array:
    """Return the history's points in the reference cell."""
    degree = particles.geometry.quadrature_degree
    return quadrature_rule(particles.mesh.basix_cell(), degree)[0]


def initial_stress_at_points(value: Value, particles: Particles) -> Array:
    """Return an initial stress at the history's points (collective).

    Args:
        value: See :class:`QuasiStaticProblem`.
        particles: The body, which has not moved.

    Returns:
        Cauchy stresses, shape ``(n, nq, 3, 3)``.

    Raises:
        MPMError: It is something else, of another shape, or not finite.
    """
    name, body = "initial_stress", particles.mesh
    if isinstance(value, _Geostatic):
        with agree(body.comm):
            value.require_for(body.geometry.dim)
    if is_function(value) or holds_ufl(value):
        rule, x = _rule(particles), _coordinates(particles)
        values = at_points(value, body, name, (3, 3), rule, x)
    else:
        with agree(body.comm):
            values = _of_numbers(value, name, particles)
    with agree(body.comm):
        bad = ~np.isfinite(values).all(axis=(1, 2, 3))
        if bad.any():
            raise MPMError(f"{name} is not finite at {{particles}}.", particles.global_index[bad])
    return np.array(values, dtype=np.float64)


def _of_numbers(value: Any, name: str, particles: Particles) -> Array:
    n, nq = particles.num_local, particles.num_points
    try:
        array = as_reals(value)
    except (TypeError, ValueError):
        array = np.zeros(0)
    if array.shape not in ((3, 3), (n, 3, 3), (n, nq, 3, 3)):
        each = "one for each owned particle or point, (n, 3, 3) or (n, nq, 3, 3)"
        raise not_a_value(name, value, (3, 3), f"{each}, {ON_A_MESH} such as mpm.geostatic(...)")
    return np.broadcast_to(array if array.ndim != 3 else array[:, None], (n, nq, 3, 3))
