# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Stress at the points of a body that moves: what acts over a step in time, and its work.

``"conserving"`` has the discrete gradient P* of :mod:`.discrete_gradient`, with Gonzalez' c where
the stress derives from an energy W of the strain E, so that the work P* : (F_1 - F_n) is W_1 - W_n.
As S* is symmetric, angular momentum is kept. Metals have such an energy over each step as well:
elastic energy and plastic work together, of which the stress of a radial return is the derivative
(Ortiz & Stainier 1999).

Where a law whose pressure may vanish by yielding (sand) knows its elastic energy W, c is that of
Gonzalez if it is positive, and 0 otherwise: the mean of two stresses that yield is not one that
does, and could give back more work than there was energy, as where a body falls apart.
So P* : (F_1 - F_n) >= W_1 - W_n at each of its points. (The tangent takes the stress for the
derivative of W there, which is exact where the point has become free of stress.) With F-bar, W is
the energy of a group of domains and depends on F at all of its points, with the effective stress P
as its derivative; numerator and denominator of c are integrals over the group then, and so is what
is said of W. Where a law is evaluated at a pressure of its own, which acts through the whole step,
c is 0 for the rest of its stress. A law of small strains takes the mean of its stresses, which has
the same two merits as far as they go there. Damping in proportion to the stiffness C of the
undeformed body is
``P_v = F_m (beta C : (E_1 - E_n) / dt)``: it resists no rotation and never gives energy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._core import loops
from ..meshes.quadrature import volume_ratio
from ..particles.reference import Reference
from .averaging import Linearised, LowRankTerm
from .discrete_gradient import Ends, Gradients, abandon, by_end, mean, mean_of_groups
from .energies import elastic_energy, has_potential, potential_energy
from .groups import Groups
from .moduli import undeformed_tangent
from .points import MaterialPoints
from .pressure import VolumeStrain, is_linear_in_volume, slope_of_volume

__all__ = ["StepStress"]

type Array = NDArray[np.float64]


class _Volume(NamedTuple):
    """Volume strain at the points, ``(n,)``, and its derivative by F, ``(n, dim, dim)``."""

    value: Array
    slope: Array


class _Beginning(NamedTuple):
    """The points at a step's beginning.

    Attributes:
        reference: What the body's mesh is strained by, the same object while it is the same.
        gradient: F - I.
        stress: First Piola stress, without that of a pressure of its own.
        potential: Energy of which the stress is the derivative, where stress is of the whole step.
        volume: What the pressure works on, if there is one.
        undeformed: Tangent of the undeformed body, if there is damping in proportion to it.
    """

    reference: Reference | None
    gradient: Array
    stress: Array
    potential: Array | None
    volume: _Volume | None
    undeformed: Array | None

    def arrays(self) -> list[Array]:
        """Return the arrays that the stress of a step depends on."""
        whole = [] if self.potential is None else [self.stress, self.potential]
        if self.undeformed is not None:
            whole.append(self.undeformed)
        return [self.gradient, *whole] if whole else []


@dataclass(frozen=True)
class _Evaluation:
    """Stress over a step that ends at a displacement.

    Attributes:
        stress: First Piola stress, over the share.
        tangent: Its derivative by F.
        own: Stress at the end that is not of a pressure of its own, if there is one.
        slope: What that pressure is multiplied with in the stress.
        by_pressure: Derivative of the stress by that pressure.
        viscous: The part of damping, not over the share.
        low_rank: What other points of a group add to the tangent.
    """

    stress: Array
    tangent: Array
    own: Array | None = None
    slope: Array | None = None
    by_pressure: Array | None = None
    viscous: Array | None = None
    low_rank: LowRankTerm | None = None


class _Works(NamedTuple):
    """This rank's works in a step: against stress, that of the whole step, and damping."""

    stress: float = 0.0
    of_step: float = 0.0
    damping: float = 0.0


class _PressurePart:
    """The part of the stress that is of a pressure of its own, which acts through a whole step.

    Args:
        points: The material with its history.
    """

    def __init__(self, points: MaterialPoints) -> None:
        self._points = points
        self._small = points.laws.has_small_strain
        # points whose law is evaluated at the pressure, and knows no volume strain of its own
        self.pressed = points.laws.at_pressure

    @property
    def pressure(self) -> Array:
        """The pressure at the points."""
        found = self._points.mean_stress
        assert found is not None
        return found.values

    @property
    def converged(self) -> Array:
        """That of the last converged step."""
        return np.where(self.pressed, self.pressure, self._points.last.mean_stress())

    def stored(self, pressure: Array) -> Array:
        """Return the energy that a potential has by the pressure, per volume."""
        return np.asarray(0.5 * self._points.volume_strain.compliance * pressure**2)

    def volume(self, H: Array) -> _Volume:
        """Return the volume strain in the last update, at ``F - I``.

        Laws that are evaluated at the pressure count that of the whole strain.
        """
        found, pressed = self._points.volume_strain, self.pressed
        if not pressed.any():
            return _Volume(found.volume, found.slope)
        volume, slope = found.volume.copy(), found.slope.copy()
        small = self._small[pressed]
        logarithmic = np.log(volume_ratio(H[pressed]))
        volume[pressed] = np.where(small, np.einsum("nii->n", H[pressed]), logarithmic)
        slope[pressed] = slope_of_volume(H[pressed], small)
        return _Volume(volume, slope)

    def turning(self, slope: Array) -> Array:
        """Return the derivative of the volume strain's slope by F."""
        factor = np.where(self._small, 0.0, -1.0)
        return np.asarray(np.einsum("n,niL,nkJ->niJkL", factor, slope, slope, optimize=True))

    def by_pressure(self, slope: Array) -> Array:
        """Return the derivative by the pressure of the stress at the end that is not of it."""
        its = self._points.by_pressure - slope
        return np.where(self.pressed[:, None, None], its, 0.0)

    def over_step(
        self, before: _Volume, volume: _Volume, gradients: Gradients, share: float, conserving: bool
    ) -> tuple[Array, Array, Array]:
        """Return the factor of a pressure of the whole step in the stress, and derivatives.

        Those are by F at the step's end, and that of all stress by the pressure.
        """
        turning, own, factor = (
            self.turning(volume.slope),
            self.by_pressure(volume.slope),
            1.0 / share,
        )
        if not conserving:
            slope = _between(share, before.slope, volume.slope) * factor
            return slope, turning, slope + own
        kind = np.where(self._small, 0, 2).astype(np.uint8)
        ends = Ends(volume.slope, before.slope, turning, (volume.value, before.value), kind)
        slope, tangent = mean(ends, gradients, factor)
        if self.pressed.any():
            own = factor * by_end(gradients, self._small) @ own
        return slope, tangent, slope + own


class _OfGroups:
    """The low-rank part of a tangent, from other points of a group.

    Args:
        last: Returns the last evaluation.
        groups: The groups of domains.
    """

    def __init__(self, last: Callable[[], _Evaluation], groups: Groups) -> None:
        self._last, self.groups = last, groups

    def linearise(self) -> LowRankTerm:
        """See :class:`Linearised`."""
        found = self._last().low_rank
        assert found is not None
        return found


class StepStress:
    """The stress of which the forces of a step in time are made, at a body's points.

    Stress at the step's end counts once, as its mean with that at the beginning is left to who sums
    up the ends; what belongs to the whole step counts ``1 / share`` times (see
    :meth:`system.term.Term.pace`).

    Args:
        points: The material with its history.
        conserving: Whether the stress is that of the whole step; otherwise it is that of its end.
        viscosity: beta, of damping in proportion to stiffness; a time.
        share: As :meth:`pace` gives it.

    Attributes:
        points: As given.
        strain: What they are strained in.
        averaging: F-bar, or ``None``.
        mean_stress: A pressure of its own in place of the mean stress, or ``None``.
        symmetric: Whether the tangent is symmetric.
    """

    def __init__(
        self, points: MaterialPoints, conserving: bool, viscosity: float, share: float
    ) -> None:
        self.points, self.strain = points, points.strain
        self.averaging, self.mean_stress = points.averaging, points.mean_stress
        self._conserving, self._viscosity = conserving, viscosity
        self._dt, self._share = 1.0, share
        self._muted = False
        self._works = _Works()
        splits = points.mean_stress is not None and share < 1.0
        self._part = _PressurePart(points) if splits else None
        pressed = points.laws.at_pressure & splits
        self._small = points.laws.has_small_strain
        bounded = _may_part(points) & ~np.isnan(elastic_energy(points)) & ~pressed
        self._kind = np.where(bounded, 3, 1).astype(np.uint8)
        self._kind[has_potential(points) & ~self._small], self._kind[self._small] = 2, 0
        plain = not conserving and viscosity == 0.0 and not splits
        plain = plain or (bool(self._small.all()) and not pressed.any())
        self.symmetric: bool = points.symmetric and plain
        first = _Evaluation(points.first_piola, points.tangent)
        self._begin, self._found = self._settled(first)

    @property
    def volume_strain(self) -> VolumeStrain:
        """The strain of which a pressure of its own is the multiplier, at the step's end.

        It counts ``1 / share`` times, as its pressure does: the tangent of small strains is
        symmetric then.
        """
        found = self.points.volume_strain
        return VolumeStrain(*(part / self._share for part in found))

    @property
    def by_pressure(self) -> Array:
        """Derivative of the stress by a pressure of its own, shape ``(n nq, dim, dim)``."""
        found = self._found.by_pressure
        return self.points.by_pressure if found is None else found

    @property
    def first_piola(self) -> Array:
        """First Piola stress, shape ``(n nq, dim, dim)``."""
        if not self._muted:
            return self._found.stress
        if self._conserving:
            return np.zeros_like(self._found.stress)
        return self.points.first_piola if self._found.own is None else self._found.own

    @property
    def tangent(self) -> Array:
        """Its derivative by F, shape ``(n nq, dim, dim, dim, dim)``."""
        return self._found.tangent

    @property
    def grouped(self) -> Linearised | None:
        """The low-rank part of the tangent, from a group's other points; ``None`` without F-bar."""
        averaging = self.points.averaging
        if averaging is None or not self._conserving:
            return averaging
        return _OfGroups(lambda: self._found, averaging.groups)

    # -- The course of a step -------------------------------------------------------------

    def pace(self, dt: float, share: float) -> None:
        """See :meth:`system.term.Term.pace`."""
        self._dt, self._share = dt, share
        self.points.laws.pace(dt)
        if _reference(self.points) is not self._begin.reference:
            self.settle()

    def mute(self, muted: bool) -> None:
        """Leave out, or take in again, what belongs to the whole step."""
        self._muted = muted

    def settle(self) -> None:
        """Take the last converged step for the beginning of the next."""
        self._begin, self._found = self._settled(self._found)

    def beginning(self) -> list[Array]:
        """Return the arrays of :meth:`settle` that stress depends on, to be set."""
        return self._begin.arrays()

    def at_end(self) -> list[Array]:
        """Return them as :meth:`settle` would leave them after the last update (collective)."""
        return self._settled(self._found, trial=True)[0].arrays()

    def _settled(self, found: _Evaluation, trial: bool = False) -> tuple[_Beginning, _Evaluation]:
        """Return the beginning of the next step, and the last evaluation as it is seen then.

        Args:
            found: The last evaluation.
            trial: Whether that is of a step which is not committed.
        """
        points, part, volume = self.points, self._part, None
        H = _gradient(points).copy()  # (which is that of the points until they are strained again)
        stress = points.first_piola.copy()
        potential = potential_energy(points, trial) if self._conserving else None
        if part is not None:
            p, volume = part.converged, part.volume(H)
            if potential is not None:
                potential = potential - part.stored(p)
            stress -= p[:, None, None] * volume.slope
            slope = volume.slope / self._share
            found = replace(found, own=stress, slope=slope, by_pressure=slope)
        reference = _reference(points)
        # (a body that was rebased or split learns what its mesh is strained by after that)
        undeformed = undeformed_tangent(points.laws) if self._viscosity > 0.0 else None
        return _Beginning(reference, H, stress, potential, volume, undeformed), found

    def update(self) -> None:
        """Update stress and tangent for the present displacement (collective with F-bar).

        Raises:
            MPMError: The material's update fails, or F is singular.
        """
        points = self.points
        try:
            points.update()
        except BaseException:
            if self._conserving and points.averaging is not None:
                abandon(points.averaging)
            raise
        plain = not self._conserving and self._part is None and self._viscosity == 0.0
        end = _Evaluation(points.first_piola, points.tangent)
        self._found = end if plain else self._of_step(end)

    def _of_step(self, end: _Evaluation) -> _Evaluation:
        """Return the stress over the step by that at its end."""
        begin, part, factor = self._begin, self._part, 1.0 / self._share
        gradients = Gradients(_gradient(self.points), begin.gradient)
        if part is not None:
            p, volume = part.pressure, part.volume(gradients.end)
            own = end.stress - p[:, None, None] * volume.slope
            tangent = end.tangent - p[:, None, None, None, None] * part.turning(volume.slope)
            end = _Evaluation(own, tangent)
        if self._conserving:
            end = self._whole(end, gradients)
        if part is not None and begin.volume is not None:
            way = gradients, self._share, self._conserving
            slope, its, by = part.over_step(begin.volume, volume, *way)
            stress = end.stress + p[:, None, None] * slope
            tangent = end.tangent + p[:, None, None, None, None] * its
            end = _Evaluation(stress, tangent, own, slope, by, low_rank=end.low_rank)
        if begin.undeformed is not None:
            viscous, A = np.empty(gradients.end.shape), np.empty(begin.undeformed.shape)
            ends = (np.ascontiguousarray(one) for one in gradients)
            rate = self._viscosity / self._dt
            loops.damping(*ends, begin.undeformed, self._small, rate, viscous, A)
            stress, tangent = end.stress + viscous * factor, end.tangent + A * factor
            end = replace(end, stress=stress, tangent=tangent, viscous=viscous)
        return end

    def _whole(self, end: _Evaluation, gradients: Gradients) -> _Evaluation:
        """Return the discrete gradient over the step (collective with F-bar)."""
        begin, potentials, factor = self._begin, None, 1.0 / self._share
        if begin.potential is not None and (self._kind >= 2).any():
            potential = potential_energy(self.points, trial=True)
            if self._part is not None:
                potential = potential - self._part.stored(self._part.pressure)
            potentials = potential, begin.potential
        ends = Ends(end.stress, begin.stress, end.tangent, potentials, self._kind)
        if (averaging := self.points.averaging) is None:
            return _Evaluation(*mean(ends, gradients, factor))
        stress, tangent, low_rank = mean_of_groups(averaging, ends, gradients, factor)
        return _Evaluation(stress, tangent, low_rank=low_rank)

    def initial_modulus(self) -> Array:
        """Return :meth:`MaterialPoints.initial_modulus` (collective)."""
        return self.points.initial_modulus()

    def commit(self) -> Callable[[], None]:
        """Make the last update the history, and take note of the work done in the step.

        Returns:
            A function that takes it back.
        """
        points, found, before = self.points, self._found, (self._begin, self._found, self._works)
        H = _gradient(points) - self._begin.gradient
        viscous: Array | float = 0.0 if found.viscous is None else found.viscous
        whole: Array | float = 0.0
        if self._conserving:
            stress = whole = self._share * found.stress - viscous
        elif self._part is not None and found.own is not None and found.slope is not None:
            whole = self._share * self._part.pressure[:, None, None] * found.slope
            stress = _between(self._share, self._begin.stress, found.own) + whole
        else:
            stress = _between(self._share, self._begin.stress, points.first_piola)
        weights = points.strain.weights.ravel()
        works = (
            float(weights @ np.einsum("niJ,niJ->n", np.broadcast_to(one, H.shape), H))
            for one in (stress, whole, viscous)
        )
        self._works = _Works(*works)
        taken = points.commit()
        self.settle()

        def undo() -> None:
            taken()
            self._begin, self._found, self._works = before

        return undo

    def roll_back(self) -> None:
        """Return to the stress of the last converged step."""
        points = self.points
        points.roll_back()
        self.settle()
        stress, own = points.first_piola, self._found.own
        if self._conserving:
            stress = stress / self._share
        elif own is not None:
            stress = own + (stress - own) / self._share
        self._found = replace(self._found, stress=stress, tangent=points.tangent)

    # -- Energies -------------------------------------------------------------------------

    def step_work(self) -> tuple[float, float]:
        """Return this rank's work in the last step against what is of the whole step.

        Returns:
            That against stress, and that against damping.
        """
        return self._works.of_step, self._works.damping

    @property
    def stress_work(self) -> float:
        """This rank's work done in the last step against stress, of the whole step or not."""
        return self._works.stress

    def strain_energy(self) -> float:
        """Return this rank's elastic energy, last converged; perhaps not a number (collective)."""
        weights, energy = self.strain.weights.ravel(), elastic_energy(self.points)
        present = weights > 0.0
        return float(weights[present] @ energy[present])


def _between(share: float, before: Array, after: Array) -> Array:
    """Return the mean over a step of values at its ends, by their weights."""
    return (1.0 - share) * before + share * after


def _may_part(points: MaterialPoints) -> NDArray[np.bool_]:
    """Return which points have a law whose pressure may vanish by yielding, shape ``(n nq,)``."""
    return points.laws.where(lambda part: not is_linear_in_volume(part.material))


def _gradient(points: MaterialPoints) -> Array:
    """Return F - I at the points at the present displacement."""
    return points.strain.gradient().reshape(-1, points.dim, points.dim)


def _reference(points: MaterialPoints) -> Reference | None:
    """Return the present reference of a body's mesh, the same object while it is the same."""
    undeformed = points.strain.particles.undeformed
    return undeformed.reference if undeformed.differs else None
