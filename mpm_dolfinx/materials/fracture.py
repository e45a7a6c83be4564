# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Brittle solids: an elastic law whose energy a phase field of fracture degrades."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, Self, override

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import MPMError
from ..reals import is_one_of
from ..tolerances import HALF_DIGITS, SMALL
from .base import (
    Field,
    Integration,
    Parameter,
    State,
    StrainMaterial,
    checked,
    per_row,
)
from .elastic import IsotropicElastic
from .mandel import identity, trace
from .principal import axes_in_order, from_axes, tangent_from_axes

__all__ = ["Fracture"]

type Array = NDArray[np.float64]

MODELS = ("AT1", "AT2")
SPLITS = ("volumetric", "spectral", "none")
#: Share of its stiffness that a broken point keeps.
RESIDUAL = SMALL
OWN = ("toughness", "length")


class Fracture(StrainMaterial):
    """A brittle solid: an elastic law with a phase field of fracture (Bourdin et al. 2000).

    The energy is ``g(d) psi+ + psi-`` and, per volume, ``G_c / c_w (w(d) / l + l |grad d|^2)``
    with ``g = (1 - d)^2``, where d goes from 0 to 1 and never falls. It is least in d at the
    displacements, and the problem is made of it like of any law: damage is an unknown on the body's
    own mesh, solved for in turn with the displacements within each step
    (``problem.damage``).

    Args:
        law: An elastic law: :class:`LinearElastic`, :class:`Hencky` or :class:`NeoHooke`.
        toughness: Energy G_c to make a crack, per area; as any parameter.
        length: Length l over which a crack is smeared, likewise. The cells where it cracks must be
            smaller than half of it, better a quarter.
        model: ``"AT1"``: w = d, c_w = 8/3: elastic up to a stress ``sqrt(3 G_c E / (8 l))`` and
            damage in a band of 2 l to each side alone; ``"AT2"``: w = d^2, c_w = 2: damage grows
            from the first load on.
        split: What of the energy psi degrades: ``"spectral"``: that of positive principal strains
            and of a volume that grows (Miehe et al. 2010), for laws linear in their strain, where
            it is the default; ``"volumetric"``: all but that of a volume that is pressed together
            (Amor et al. 2009), so that what is broken gives way sideways; ``"none"``: all.

    Raises:
        MPMError: A law that is not elastic, numbers that are not positive, or unknown names.
    """

    symmetric = True
    limits: ClassVar[Mapping[str, Mapping[str, float]]] = MappingProxyType(
        {"toughness": {"above": 0.0}, "length": {"above": 0.0}}
    )
    internal_variables: ClassVar[Mapping[str, tuple[int, ...]]] = MappingProxyType(
        {"damage": (), "driving_energy": (), "stored_energy": ()}
    )

    def __init__(
        self,
        law: StrainMaterial,
        toughness: ArrayLike | Field,
        length: ArrayLike | Field,
        *,
        model: str = "AT1",
        split: str | None = None,
    ) -> None:
        if not isinstance(law, StrainMaterial) or not law.is_elastic:
            raise MPMError(
                "Fracture is of an elastic law in strain space, such as Hencky, LinearElastic or "
                f"NeoHooke, not of {law!r}."
            )
        if split is None:
            split = "spectral" if isinstance(law, IsotropicElastic) else "volumetric"
        for name, value, known in (("model", model, MODELS), ("split", split, SPLITS)):
            if not is_one_of(value, known):
                raise MPMError(
                    f"Unknown {name}={value!r} of Fracture; choose one of "
                    f"{', '.join(map(repr, known))}."
                )
        if split == "spectral" and not isinstance(law, IsotropicElastic):
            raise MPMError(
                "split='spectral' is for laws that are linear in their strain (Hencky, "
                f"LinearElastic), not for {law!r}; use 'volumetric'."
            )
        self.law, self.model, self.split = law, model, split
        self.kinematics = law.kinematics  # type: ignore[misc]
        own = checked(self.limits, toughness=toughness, length=length)
        self.parameters = {**law.parameters, **own}

    @override
    def with_parameters(self, **parameters: Parameter) -> Self:
        other = copy.copy(self)
        own = {name: parameters.pop(name, self.parameters[name]) for name in OWN}
        other.law = self.law.with_parameters(**parameters)
        other.parameters = {**other.law.parameters, **checked(self.limits, **own)}
        return other

    def __repr__(self) -> str:
        toughness, length = (self.parameters[name] for name in OWN)
        return (
            f"Fracture({self.law!r}, toughness={_told(toughness)}, length={_told(length)}, "
            f"model={self.model!r}, split={self.split!r})"
        )

    @override
    def elastic_strain(self, stress: Array) -> Array:
        return self.law.elastic_strain(stress)

    @override
    def strain_energy(self, state: State) -> Array:
        return state["stored_energy"]

    @override
    def integrate(self, trial_strain: Array, variables: State, tangent: bool) -> Integration:
        damage = variables["damage"]
        kept = (1.0 - damage) ** 2 + RESIDUAL
        split = self._spectral if self.split == "spectral" else self._volumetric
        stress, D, driving, rest = split(trial_strain, kept, tangent)
        new = {"damage": damage, "driving_energy": driving, "stored_energy": kept * driving + rest}
        return Integration(stress, D, trial_strain, new)

    def _volumetric(
        self, strain: Array, kept: Array, tangent: bool
    ) -> tuple[Array, Array | None, Array, Array]:
        """Return stress, tangent, the energy that degrades and the rest."""
        law = self.law
        stress, D, _, _ = law.integrate(strain, {}, tangent)
        energy = law.stored_energy(strain)
        pressed = np.zeros_like(strain)
        if self.split == "volumetric":
            pressed[:, :3] = np.minimum(trace(strain), 0.0)[:, None] / 3.0
        rest, slope, _, _ = law.integrate(pressed, {}, tangent)
        lost = 1.0 - kept
        whole = per_row(kept) * stress + per_row(lost) * rest
        tangents = None
        if D is not None and slope is not None:
            one = identity(strain.shape[1])
            bulk = np.einsum("i,nij,j->n", one, slope, one) / 9.0
            bulk *= lost * (pressed[:, 0] < 0.0)
            tangents = kept[:, None, None] * D + bulk[:, None, None] * np.outer(one, one)
        below = law.stored_energy(pressed)
        return whole, tangents, np.maximum(energy - below, 0.0), below

    def _spectral(
        self, strain: Array, kept: Array, tangent: bool
    ) -> tuple[Array, Array | None, Array, Array]:
        """Return stress, tangent, the energy that degrades and the rest."""
        law, m = self.law, strain.shape[1]
        assert isinstance(law, IsotropicElastic)
        shear = law.shear
        lame = law.bulk - 2.0 / 3.0 * shear
        values, axes = axes_in_order(strain)
        volume = values.sum(axis=0)
        share, of_volume = (np.where(v > 0.0, kept, 1.0) for v in (values, volume))
        principal = 2.0 * shear * share * values + lame * of_volume * volume
        stress = from_axes(principal, axes, m)

        def energy(strains: Array, grown: Array) -> Array:
            return np.asarray(0.5 * lame * grown**2 + shear * (strains**2).sum(axis=0))

        driving = energy(np.maximum(values, 0.0), np.maximum(volume, 0.0))
        rest = energy(np.minimum(values, 0.0), np.minimum(volume, 0.0))
        if not tangent:
            return stress, None, driving, rest
        normal = np.broadcast_to(lame * of_volume, (3, 3, len(strain))).copy()
        quotients = np.zeros_like(normal)
        near = HALF_DIGITS * np.abs(values).max(axis=0)
        for a in range(3):
            normal[a, a] += 2.0 * shear * share[a]
            for b in range(a):
                gap = values[a] - values[b]
                equal = np.abs(gap) <= near
                ratio = (share[a] * values[a] - share[b] * values[b]) / np.where(equal, 1.0, gap)
                ratio = np.where(equal, 0.5 * (share[a] + share[b]), ratio)
                quotients[a, b] = quotients[b, a] = 2.0 * shear * ratio
        return stress, tangent_from_axes(normal, quotients, axes, m), driving, rest


def _told(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else type(value).__name__
