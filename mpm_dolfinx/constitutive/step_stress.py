# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Stress at the points of a body that moves: what acts over a step in time, and its work.

With F_m the mean of the deformation gradients at a step's ends, and S = F^-1 P, ``"conserving"``
has

    P* = F_m S*,     S* = (S_n + S_1)/2 + c (E_1 - E_n),

c = 0 (Simo & Tarnow 1992), or, where the stress derives from an energy W of the strain E,

    c = (W_1 - W_n - (S_n + S_1)/2 : (E_1 - E_n)) / |E_1 - E_n|^2

(Gonzalez 2000), so that the work P* : (F_1 - F_n) is W_1 - W_n. As S* is symmetric, angular
momentum is kept. Metals have such an energy over each step as well: elastic energy and plastic work
together, of which the stress of a radial return is the derivative (Ortiz & Stainier 1999).

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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._core import loops
from ..errors import ConvergenceError
from ..meshes.quadrature import volume_ratio
from ..particles.reference import Reference
from .averaging import Linearised, LowRankTerm, VolumeAveraging
from .groups import Groups
from .points import MaterialPoints
from .pressure import MeanStress, VolumeStrain, slope_of_volume

__all__ = ["StepStress"]

#: Change of strain below which Gonzalez' correction, a quotient of small numbers, is faded out.
SMALL = 1e-6
#: How many numbers of each domain are summed over its group in an evaluation.
SUMS = 4

type Array = NDArray[np.float64]


class _Ends(NamedTuple):
    """Derivatives of a potential by F at a step's ends.

    Attributes:
        stress: At its end, shape ``(n, dim, dim)``.
        before: At its beginning.
        tangent: Derivative of that at its end.
        potentials: At its end and at its beginning, or ``None``.
        kind: 0: of small strains; 2: the work is to be the change of the potential; 3: or more
            than that; else 1.
    """

    stress: Array
    before: Array
    tangent: Array
    potentials: tuple[Array, Array] | None
    kind: NDArray[np.uint8]


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
        first_piola: Shape ``(n nq, dim, dim)``.
        tangent: Its derivative by F, shape ``(n nq, dim, dim, dim, dim)``.
        symmetric: Whether that is symmetric.
    """

    def __init__(
        self, points: MaterialPoints, conserving: bool, viscosity: float, share: float
    ) -> None:
        self._points = points
        self._conserving, self._viscosity = conserving, viscosity
        self._dt, self._share = 1.0, share
        self._muted = False
        self._work = (0.0, 0.0, 0.0)
        self._splits = points.mean_stress is not None and share < 1.0
        # points whose law is evaluated at the pressure, and knows no volume strain of its own
        self._pressed = points.at_pressure & self._splits
        self._undeformed: Array | None = None
        self._small = points.has_small_strain
        self._exact = points.has_potential & ~self._small
        bounded = points.may_part & ~np.isnan(points.strain_energy()) & ~self._pressed
        self._kind = np.where(bounded, 3, 1).astype(np.uint8)
        self._kind[self._exact], self._kind[self._small] = 2, 0
        plain = not conserving and viscosity == 0.0 and not self._splits
        plain = plain or (bool(self._small.all()) and not self._pressed.any())
        self.symmetric: bool = points.symmetric and plain
        self.settle()
        self._tried: Array = self._H
        self._stress = points.first_piola
        self._viscous: Array | None = None
        self._low_rank: LowRankTerm | None = None
        self.tangent = points.tangent

    @property
    def weights(self) -> Array:
        """Undeformed volume of each point, shape ``(n, nq)``; 0 where deleted."""
        return self._points.weights

    @property
    def hoop(self) -> Array | None:
        """Hoop strains of a body of revolution's nodes, or ``None``."""
        return self._points.hoop

    @property
    def averaging(self) -> VolumeAveraging | None:
        """F-bar, or ``None``."""
        return self._points.averaging

    @property
    def mean_stress(self) -> MeanStress | None:
        """A pressure of its own in place of the mean stress, or ``None``."""
        return self._points.mean_stress

    @property
    def volume_strain(self) -> VolumeStrain:
        """What a pressure of its own is the multiplier of: that at the step's end.

        It counts ``1 / share`` times, as its pressure does: the tangent of small strains is
        symmetric then.
        """
        found = self._points.volume_strain
        return VolumeStrain(*(part / self._share for part in found))

    @property
    def by_pressure(self) -> Array:
        """Derivative of the stress by a pressure of its own, shape ``(n nq, dim, dim)``."""
        return self._of_pressure if self._splits else self._points.by_pressure

    @property
    def first_piola(self) -> Array:
        """First Piola stress."""
        if self._muted:
            if self._conserving:
                return np.zeros_like(self._stress)
            return self._own if self._splits else self._points.first_piola
        return self._stress

    # -- The course of a step -------------------------------------------------------------

    def pace(self, dt: float, share: float) -> None:
        """See :meth:`system.term.Term.pace`."""
        self._dt, self._share = dt, share
        self._points.pace(dt)
        if self._present_reference() is not self._reference:
            self.settle()

    def mute(self, muted: bool) -> None:
        """Leave out, or take in again, what belongs to the whole step."""
        self._muted = muted

    def settle(self) -> None:
        """Take the last converged step for the beginning of the next."""
        points = self._points
        # (a body that was rebased or split learns what its mesh is strained by after that)
        self._reference = self._present_reference()
        self._H = self._gradient()
        self._P = points.first_piola.copy()
        self._energy, self._potential = points.strain_energy(), points.potential()
        if self._splits:
            p = np.where(self._pressed, self._pressure.values, points.converged_pressure)
            self._volume, self._slope = self._volumes(self._H)
            self._now = self._volume, self._slope
            self._of_pressure = self._mean_slope = self._slope / self._share
            self._potential -= 0.5 * points.volume_strain.compliance * p**2
            self._P -= p[:, None, None] * self._slope
            self._own = self._P
        if self._viscosity > 0.0:
            self._undeformed = points.undeformed_tangent()

    def _present_reference(self) -> Reference | None:
        """Return what the body's mesh is strained by now, the same object while it is the same."""
        particles = self._points.strain.particles
        return particles.reference if particles.rebased else None

    def _gradient(self) -> Array:
        """Return F - I at the points at the present displacement."""
        dim = self._points.dim
        return self._points.strain.gradient().reshape(-1, dim, dim)

    def update(self) -> None:
        """Update stress and tangent for the present displacement (collective with F-bar).

        Raises:
            MPMError: The material's update fails, or F is singular.
        """
        points = self._points
        try:
            points.update()
        except BaseException:
            self._abandon()
            raise
        self._stress, self.tangent = points.first_piola, points.tangent
        if not self._conserving and not self._splits and self._viscosity == 0.0:
            return
        self._tried = self._gradient()
        if self._splits:
            self._now = self._volumes(self._tried)
            self._take_pressure_out()
        if self._conserving:
            self._stress, self.tangent = self._whole_step()
        elif self._splits:
            stress, tangent = self._of_volume()
            self._stress, self.tangent = self._own + stress, self.tangent + tangent
        if self._viscosity > 0.0:
            viscous, tangent = self._resisting()
            self._viscous = viscous
            self._stress = self._stress + viscous / self._share
            self.tangent = self.tangent + tangent / self._share

    def _abandon(self) -> None:
        """Take part in the sums of an evaluation that failed on this rank (collective)."""
        averaging = self._points.averaging
        if self._conserving and averaging is not None:
            averaging.groups.sum(np.zeros((self._points.weights.shape[0], SUMS)))

    def _take_pressure_out(self) -> None:
        """Leave in stress and tangent what is not of the pressure."""
        p, (_, slope) = self._pressure.values, self._now
        self._stress = self._own = self._stress - p[:, None, None] * slope
        self.tangent = self.tangent - p[:, None, None, None, None] * self._turning(slope)

    @property
    def _pressure(self) -> MeanStress:
        """The pressure of its own."""
        pressure = self._points.mean_stress
        assert pressure is not None
        return pressure

    def _volumes(self, H: Array) -> tuple[Array, Array]:
        """Return the volume strain in the last update, at ``F - I``, and its derivative by F.

        Laws that are evaluated at the pressure count that of the whole strain.
        """
        found, pressed = self._points.volume_strain, self._pressed
        if not pressed.any():
            return found.volume, found.slope
        volume, slope = found.volume.copy(), found.slope.copy()
        small = self._small[pressed]
        logarithmic = np.log(volume_ratio(H[pressed]))
        volume[pressed] = np.where(small, np.einsum("nii->n", H[pressed]), logarithmic)
        slope[pressed] = slope_of_volume(H[pressed], small)
        return volume, slope

    def _turning(self, slope: Array) -> Array:
        """Return the derivative of the volume strain's slope by F."""
        factor = np.where(self._small, 0.0, -1.0)
        return np.asarray(np.einsum("n,niL,nkJ->niJkL", factor, slope, slope, optimize=True))

    def _whole_step(self) -> tuple[Array, Array]:
        """Return P* and its derivative by F at the step's end, over the share."""
        energies = None
        if (self._kind >= 2).any():
            potential = self._points.potential(trial=True)
            if self._splits:
                p, found = self._pressure.values, self._points.volume_strain
                potential -= 0.5 * found.compliance * p**2
            energies = potential, self._potential
        ends = _Ends(self._stress, self._P, self.tangent, energies, self._kind)
        stress, tangent = self._mean(ends)
        if self._splits:
            more, its = self._of_volume()
            stress, tangent = stress + more, tangent + its
        return stress, tangent

    def _of_volume(self) -> tuple[Array, Array]:
        """Return the stress of the pressure of the whole step, and its derivative, as above."""
        p, (volume, slope) = self._pressure.values, self._now
        turning, before = self._turning(slope), self._slope
        if self._conserving:
            volumes = volume, self._volume
            kind = np.where(self._small, 0, 2).astype(np.uint8)
            mean, tangent = self._mean(_Ends(slope, before, turning, volumes, kind))
        else:
            mean, tangent = self._between(before, slope) / self._share, turning
        self._mean_slope, self._of_pressure = mean, mean + self._own_by_pressure(slope)
        return p[:, None, None] * mean, p[:, None, None, None, None] * tangent

    def _between(self, before: Array, after: Array) -> Array:
        """Return what the ends of a step have as its mean, by their weights."""
        return (1.0 - self._share) * before + self._share * after

    def _own_by_pressure(self, slope: Array) -> Array:
        """Return the derivative by the pressure of the stress that is not of it, over the share."""
        if not self._pressed.any():
            return np.zeros_like(slope)
        own = np.where(self._pressed[:, None, None], self._points.by_pressure - slope, 0.0)
        if not self._conserving:
            return own
        unit = np.eye(self._points.dim)
        turned = np.linalg.solve(unit + self._tried, own)
        turned = (unit + 0.5 * (self._tried + self._H)) @ turned
        return np.where(self._small[:, None, None], own, turned) * (0.5 / self._share)

    def _mean(self, ends: _Ends) -> tuple[Array, Array]:
        """Return what acts over a step, and its derivative by F at the end, over the share."""
        averaging = self._points.averaging
        if averaging is not None:
            return self._mean_of_groups(averaging, ends)
        stress, tangent = np.empty(ends.stress.shape), np.empty(ends.tangent.shape)
        none = np.zeros(0)
        singular = loops.step_stress(
            np.ascontiguousarray(self._tried),
            np.ascontiguousarray(self._H),
            np.ascontiguousarray(ends.stress),
            np.ascontiguousarray(ends.before),
            np.ascontiguousarray(ends.tangent),
            *(ends.potentials or (none, none)),
            ends.kind,
            SMALL,
            1.0 / self._share,
            stress,
            tangent,
        )
        if len(singular):
            raise ConvergenceError("A deformation gradient is singular")
        return stress, tangent

    def _mean_of_groups(self, averaging: VolumeAveraging, ends: _Ends) -> tuple[Array, Array]:
        """Return :meth:`_mean` with F-bar, which corrects group by group (collective)."""
        small, factor = ends.kind == 0, 1.0 / self._share
        P, P_n, A = ends.stress, ends.before, ends.tangent
        unit = np.eye(self._points.dim)
        F, F_n = unit + self._tried, unit + self._H
        try:
            inverse = np.linalg.inv(F)
            S, S_n = inverse @ P, np.linalg.solve(F_n, P_n)
        except np.linalg.LinAlgError:
            self._abandon()
            raise ConvergenceError("A deformation gradient is singular") from None
        dS = _times(inverse, A)
        dS -= np.einsum("nIk,nLJ->nIJkL", inverse, S)
        S_mean, dS_mean = 0.5 * (S + S_n), 0.5 * dS
        F_mean = 0.5 * (F + F_n)
        self._correct_groups(averaging, ends, F_mean, inverse, (S, S_mean, dS_mean))
        stress = F_mean @ S_mean
        tangent = _times(F_mean, dS_mean)
        for i in range(self._points.dim):
            tangent[:, i, :, i, :] += 0.5 * S_mean.swapaxes(1, 2)
        if small.any():
            stress[small] = 0.5 * (P_n[small] + P[small])
            tangent[small] = 0.5 * A[small]
        return factor * stress, factor * tangent

    def _correct_groups(
        self,
        averaging: VolumeAveraging,
        ends: _Ends,
        F_mean: Array,
        inverse: Array,
        stresses: tuple[Array, Array, Array],
    ) -> None:
        """Add the correction of groups to S* and its pointwise derivative, in place (collective).

        The other points of a group change the stress by Jbar and by c: that is kept for
        :meth:`linearise`.

        Args:
            averaging: F-bar.
            ends: The step's ends.
            F_mean: Mean of F.
            inverse: Inverse of F at the end.
            stresses: Second Piola stress at the end, S* and its derivative.
        """
        S, S_mean, dS_mean = stresses
        h, gamma, left, right = averaging.grouped_tangent()
        shape = gamma.shape
        volumes = averaging.counted()
        change, slope = _strain(self._tried, self._H)
        turned = np.einsum("nIi,nIJ->niJ", inverse, change).reshape(shape)
        whole = h[:, None, None, None] * gamma + left
        energy = np.zeros(len(S))
        if ends.potentials is not None:
            energy = np.where(ends.kind >= 2, ends.potentials[0] - ends.potentials[1], 0.0)
        square = np.einsum("nIJ,nIJ->n", change, change) + SMALL**2
        own = [
            (energy - np.einsum("nIJ,nIJ->n", S_mean, change)).reshape(volumes.shape),
            square.reshape(volumes.shape),
            np.einsum("nqiJ,nqiJ->nq", turned, whole),
            np.einsum("nqiJ,nqiJ->nq", turned, gamma),
        ]
        sums = averaging.groups.sum(np.stack([(volumes * part).sum(axis=1) for part in own], 1))
        size = np.where(sums[:, 1] > 0.0, sums[:, 1], 1.0)
        kind = ends.kind.reshape(volumes.shape)[:, 0]
        c = sums[:, 0] / size
        exact = (kind == 2) | ((kind == 3) & (c > 0.0))
        c = np.where(exact, c, 0.0)
        each = np.repeat(c, volumes.shape[1])[:, None, None]
        X = np.einsum("nIJ,nIJkL->nkL", S - S_mean - 2.0 * each * change, slope)
        X -= np.einsum("nIJ,nIJkL->nkL", change, dS_mean)
        S_mean += each * change
        dS_mean += each[:, :, :, None, None] * slope

        over = np.where(exact, 1.0 / size, 0.0)[:, None, None]
        half = 0.5 / self._share * _or_unit(F_mean @ inverse, self._small)
        first = averaging.nodal((half @ whole.reshape(S.shape)).reshape(shape))
        second = averaging.nodal((half @ gamma.reshape(S.shape)).reshape(shape))
        along = averaging.nodal((F_mean @ change / self._share).reshape(shape)) * over
        first -= 0.5 * sums[:, 2, None, None] * along
        second -= 0.5 * sums[:, 3, None, None] * along
        after = (averaging.nodal(gamma), averaging.nodal(right), averaging.nodal(X.reshape(shape)))
        self._low_rank = LowRankTerm(averaging.groups, (first, second, along), after)

    @property
    def grouped(self) -> Linearised | None:
        """What knows what the tangent has from other points of a group; ``None`` without F-bar."""
        averaging = self._points.averaging
        return averaging if averaging is None or not self._conserving else self

    @property
    def groups(self) -> Groups:
        """The groups of domains."""
        averaging = self._points.averaging
        assert averaging is not None
        return averaging.groups

    def linearise(self) -> LowRankTerm:
        """See :class:`Linearised`."""
        assert self._low_rank is not None
        return self._low_rank

    def _resisting(self) -> tuple[Array, Array]:
        """Return the viscous stress P_v and its derivative by F at the step's end."""
        assert self._undeformed is not None
        ends = (np.ascontiguousarray(self._tried), np.ascontiguousarray(self._H))
        P, A = np.empty(ends[0].shape), np.empty(self._undeformed.shape)
        factor = self._viscosity / self._dt
        loops.damping(*ends, self._undeformed, self._small, factor, P, A)
        return P, A

    def initial_modulus(self) -> Array:
        """Return :meth:`MaterialPoints.initial_modulus` (collective)."""
        return self._points.initial_modulus()

    def elastic(self) -> bool:
        """Return whether the history stays as it is in the last update."""
        return self._points.elastic()

    def yielding(self) -> NDArray[np.bool_]:
        """Return :meth:`MaterialPoints.yielding`."""
        return self._points.yielding()

    def commit(self) -> Callable[[], None]:
        """Make the last update the history, and take note of the work done in the step.

        Returns:
            A function that takes it back.
        """
        points = self._points
        settled = ["_H", "_P", "_energy", "_potential", "_work"]
        if self._splits:
            settled += ["_volume", "_slope", "_now", "_of_pressure", "_mean_slope", "_own"]
        before = {name: getattr(self, name) for name in settled}
        H = self._gradient() - self._H
        viscous = 0.0 if self._viscous is None else self._viscous
        whole: Array | float = 0.0
        if self._conserving:
            stress = whole = self._share * self._stress - viscous
        elif self._splits:
            p = self._pressure.values
            whole = self._share * p[:, None, None] * self._mean_slope
            stress = self._between(self._P, self._own) + whole
        else:
            stress = self._between(self._P, points.first_piola)
        weights = points.weights.ravel()
        done, in_step, damped = (
            float(weights @ np.einsum("niJ,niJ->n", np.broadcast_to(one, H.shape), H))
            for one in (stress, whole, viscous)
        )
        self._work = done, in_step, damped
        taken = points.commit()
        self.settle()

        def undo() -> None:
            taken()
            vars(self).update(before)

        return undo

    def roll_back(self) -> None:
        """Return to the stress of the last converged step."""
        self._points.roll_back()
        self.settle()
        self._stress, self.tangent = self._points.first_piola, self._points.tangent
        if self._conserving:
            self._stress = self._stress / self._share
        elif self._splits:
            self._stress = self._own + (self._stress - self._own) / self._share

    # -- Energies -------------------------------------------------------------------------

    def step_work(self) -> tuple[float, float]:
        """Return this rank's work in the last step against what is of the whole step.

        Returns:
            That against stress, and that against damping.
        """
        return self._work[1], self._work[2]

    @property
    def stress_work(self) -> float:
        """This rank's work done in the last step against stress, of the whole step or not."""
        return self._work[0]

    def strain_energy(self) -> float:
        """Return this rank's elastic energy at the last converged step; perhaps not a number."""
        weights = self._points.weights.ravel()
        present = weights > 0.0
        return float(weights[present] @ self._energy[present])


def _strain(H: Array, H_n: Array) -> tuple[Array, Array]:
    """Return the change of Green's strain between gradients F - I, and its derivative by F."""
    dim = H.shape[-1]
    F = np.eye(dim) + H
    mean = np.eye(dim) + 0.5 * (H + H_n)
    half = mean.swapaxes(1, 2) @ (H - H_n)
    slope = np.zeros((len(H), dim, dim, dim, dim))
    for J in range(dim):
        slope[:, :, J, :, J] += 0.5 * F.swapaxes(1, 2)
        slope[:, J, :, :, J] += 0.5 * F.swapaxes(1, 2)
    return 0.5 * (half + half.swapaxes(1, 2)), slope


def _or_unit(values: Array, where: NDArray[np.bool_]) -> Array:
    """Return matrices, with the unit matrix in some places."""
    values[where] = np.eye(values.shape[-1])
    return values


def _times(factor: Array, tangent: Array) -> Array:
    """Return ``factor_Ii tangent_iJkL`` at all points."""
    n, dim = factor.shape[:2]
    return np.asarray((factor @ tangent.reshape(n, dim, dim**3)).reshape(tangent.shape))
