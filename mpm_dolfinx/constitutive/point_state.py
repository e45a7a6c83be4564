# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Materials at a body's points at one moment: what they keep, and what follows from it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError, as_ours
from ..materials.base import State
from ..meshes.remesh import Column
from .assignment import Assignment
from .governed import Governed
from .softening_average import softened

__all__ = ["Converged", "PointState"]

type Array = NDArray[np.float64]


@dataclass(frozen=True)
class PointState:
    """Materials at a body's points at one moment.

    Attributes:
        laws: The materials, with the numbers that they have now.
        states: What the material of each group keeps.
        gradient: ``F - I`` that they have seen, shape ``(n nq, dim, dim)``.
        average: That of the plastic strain over the length of the body, with which their stress
            was found, shape ``(n nq,)``; ``None`` without a length.
    """

    laws: Assignment
    states: list[State]
    gradient: Array
    average: Array | None

    def cauchy_stress(self, gradient: Array | None = None) -> Array:
        """Return the Cauchy stress, shape ``(n, nq, 3, 3)``.

        Args:
            gradient: ``F - I`` to take it at, ``(n nq, dim, dim)``; ``None``: that which laws saw.
        """
        seen = self.gradient if gradient is None else gradient

        def value(part: Governed, state: State) -> Any:
            return part.cauchy_stress(seen[part.points], state)

        return self._collect((3, 3), value, "cauchy_stress")

    def plastic_strain(self) -> Array:
        """Return the accumulated plastic strain, shape ``(n, nq)``."""
        return self.variable("plastic_strain")

    def variable(self, name: str) -> Array:
        """Return an internal variable, zero where there is none, shape ``(n, nq, ...)``.

        Args:
            name: Key of the materials' states.

        Raises:
            MPMError: No material has it.
        """
        shapes = {s[name].shape[1:] for s in self.states if name in s}
        if not shapes:
            if name != "plastic_strain":
                raise MPMError(f"No material of these particles has a variable {name!r}.")
            shapes = {()}
        return self._collect(shapes.pop(), lambda _, state: state.get(name, 0.0))

    def yield_function(self) -> Array:
        """Return the yield function, shape ``(n, nq)``; -1 where elastic."""

        def value(part: Governed, state: State) -> Any:
            rule = getattr(softened(part, self.average).material, "yield_function", None)
            if rule is None:
                return -1.0
            names = part.inelastic_variables or ("plastic_strain",)
            return rule(state["stress"], *(state[name] for name in names))

        return self._collect((), value, "yield_function")

    def mean_stress(self) -> Array:
        """Return the mean of the laws' own stress, shape ``(n nq,)``."""
        own = self._collect((), lambda _, state: state["stress"][:, :3].sum(axis=1) / 3.0)
        return own.ravel()

    def strain_energy(self) -> Array:
        """Return the materials' elastic energy per undeformed volume, shape ``(n nq,)``.

        It is not a number where a material does not know it.
        """
        result = np.full(self.laws.num_points, np.nan)
        for part, state in zip(self.laws.governed, self.states, strict=True):
            energy = part.strain_energy(state)
            if energy is not None:
                result[part.points] = energy
        return result

    def plastic_work(self) -> tuple[Array, NDArray[np.bool_]]:
        """Return the plastic work per undeformed volume, and where it is known, ``(n nq,)``."""
        result = np.zeros(self.laws.num_points)
        known = np.zeros(self.laws.num_points, dtype=bool)
        for part, state in zip(self.laws.governed, self.states, strict=True):
            work = part.plastic_work(state)
            if work is not None:
                result[part.points], known[part.points] = work, True
        return result, known

    def is_elastic_since(self, before: PointState) -> bool:
        """Return whether no internal variable is another one than before."""
        for part, was, now in zip(self.laws.governed, before.states, self.states, strict=True):
            if was.keys() == {"stress"} or not part.material.inelastic:
                continue
            variables = part.inelastic_variables
            if not variables or not all(np.array_equal(was[v], now[v]) for v in variables):
                return False
        return True

    def has_yielded_since(self, before: PointState) -> NDArray[np.bool_]:
        """Return whether an internal variable of each particle is another one, shape ``(n,)``."""
        result = np.zeros(self.laws.num_points, dtype=bool)
        for part, was, now in zip(self.laws.governed, before.states, self.states, strict=True):
            for name in part.inelastic_variables:
                changed = was[name] != now[name]
                result[part.points] |= changed.any(axis=tuple(range(1, changed.ndim)))
        return self.laws.by_domain(result).any(axis=1)

    def memories(self) -> list[State]:
        """Return the part of each material's state that :meth:`recalled` needs."""
        pairs = zip(self.laws.governed, self.states, strict=True)
        return [part.memory(state) for part, state in pairs]

    def recalled(self, memories: list[State], gradient: Array) -> list[State]:
        """Return the states of which there are memories.

        Args:
            memories: The memories.
            gradient: ``F - I`` that the materials saw then, shape ``(n nq, dim, dim)``.
        """
        known = zip(self.laws.governed, memories, self.states, strict=True)
        return [part.recalled(own, gradient[part.points], s) for part, own, s in known]

    def supposing(self, name: str, values: Array) -> list[State]:
        """Return the states with other values of a variable that comes from outside.

        Args:
            name: Key of the materials' states; those without it are left as they are.
            values: At all points, shape ``(n, nq)``.
        """
        flat = values.reshape(self.laws.num_points)
        return [
            state | {name: flat[part.points]} if name in state else state
            for part, state in zip(self.laws.governed, self.states, strict=True)
        ]

    def _collect(
        self, shape: tuple[int, ...], value: Callable[[Governed, State], Any], what: str = ""
    ) -> Array:
        result = np.zeros((self.laws.num_points, *shape))
        for part, state in zip(self.laws.governed, self.states, strict=True):
            try:
                result[part.points] = value(part, state)
            except MPMError:
                raise
            except Exception as error:
                raise as_ours(error, f"{what} of {type(part.material).__name__}") from error
        return self.laws.by_domain(result)


@dataclass(frozen=True)
class Converged(PointState):
    """Points at the last converged step.

    Attributes:
        stress: First Piola stress that acts, shape ``(n nq, dim, dim)``.
        volume: Volume strain, where a pressure takes the place of the mean stress, ``(n nq,)``.
        compliance: Its own, where a law is evaluated at the pressure.
        recovery: Correction of the particles' Cauchy stress by the recovery of averaged stresses,
            shape ``(n, 3, 3)``, or 0.
        resisted: Energy that F-bar resists, shape ``(n nq,)``; ``None`` without F-bar.
        growth: Change of the average in the last step, by which it is expected to change in the
            next; ``None`` without a length.
        begun: Cauchy stress that the points began with, ``(n nq, 3, 3)``; ``None``: without one.
    """

    stress: Array
    volume: Array | None = None
    compliance: Array | None = None
    recovery: Array | float = 0.0
    resisted: Array | None = None
    growth: Array | None = None
    begun: Array | None = None

    def gained_stress(self, deformation: Array) -> Array:
        """Return the Cauchy stress beyond the one that the points began with, ``(n, nq, 3, 3)``.

        Args:
            deformation: Deformation gradient F, with whose rotation that one turns, ``(n, nq, 3,
                3)``.
        """
        stress = self.cauchy_stress()
        if self.begun is None:
            return stress
        left, _, right = np.linalg.svd(deformation)
        R = left @ right
        turned = R @ self.laws.by_domain(self.begun) @ R.swapaxes(-1, -2)
        return np.asarray(stress - turned / np.linalg.det(deformation)[..., None, None])

    def columns(self) -> dict[str, Column]:
        """Return all there is, as a checkpoint keeps it.

        Returns:
            Columns ``(n, nq, ...)`` by name (``recovery``: ``(n, 3, 3)``); a variable of the
            materials has the numbers of those that have it in its name.
        """
        whole: dict[str, NDArray[Any]] = {"gradient": self.gradient, "first_piola": self.stress}
        if self.volume is not None and self.compliance is not None:
            whole["volume_strain"] = self.volume
            if not self.laws.comes_apart:
                whole["compliance"] = self.compliance
        owners: dict[tuple[str, tuple[int, ...], np.dtype[Any]], list[int]] = {}
        for number, state in enumerate(self.states):
            for name, values in state.items():
                owners.setdefault((name, values.shape[1:], values.dtype), []).append(number)
        for (name, shape, dtype), numbers in owners.items():
            values = np.zeros((self.laws.num_points, *shape), dtype)
            for number in numbers:
                values[self.laws.governed[number].points] = self.states[number][name]
            whole[f"{name}@{','.join(map(str, numbers))}"] = values
        if self.average is not None and self.growth is not None:
            whole |= {"average": self.average, "growth": self.growth}
        if self.resisted is not None:
            whole["resisted"] = self.resisted
        if self.begun is not None:
            whole["begun"] = self.begun
        columns = {
            name: Column(self.laws.by_domain(values), "points") for name, values in whole.items()
        }
        if self.resisted is not None:
            n = self.laws.particles.num_local
            columns["recovery"] = Column(np.broadcast_to(self.recovery, (n, 3, 3)), "cells")
        return columns

    def with_columns(self, arrays: dict[str, NDArray[Any]]) -> Converged:
        """Return the points as :meth:`columns` once gave them.

        Args:
            arrays: By name, as there.
        """
        flat = {
            name: values.reshape(self.laws.num_points, *values.shape[2:])
            for name, values in arrays.items()
            if name != "recovery"
        }
        states: list[State] = [{} for _ in self.states]

        def taken(name: str, present: Array | None) -> Array | None:
            found = flat.pop(name, present)
            return None if present is None else found

        now = replace(
            self,
            states=states,
            gradient=flat.pop("gradient"),
            stress=flat.pop("first_piola"),
            volume=taken("volume_strain", self.volume),
            compliance=taken("compliance", self.compliance),
            recovery=arrays.get("recovery", 0.0),
            resisted=taken("resisted", self.resisted),
            average=taken("average", self.average),
            growth=taken("growth", self.growth),
            begun=taken("begun", self.begun),
        )
        for key, values in flat.items():
            name, numbers = key.rsplit("@", 1)
            for number in map(int, numbers.split(",")):
                states[number][name] = values[self.laws.governed[number].points]
        return now
