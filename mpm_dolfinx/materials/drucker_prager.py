# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Plasticity of Drucker and Prager, returned in closed form."""

from __future__ import annotations

from typing import ClassVar, Literal, NamedTuple, get_args, override

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import MPMError
from .base import Field, Integration, Parameter, State
from .mandel import deviator, deviatoric_projector, identity, norm, trace
from .mohr_coulomb import FrictionalMaterial

__all__ = ["DruckerPrager", "Returned", "returned_tangent"]

Array = NDArray[np.float64]
Match = Literal["outer", "inner", "plane_strain"]


class DruckerPrager(FrictionalMaterial):
    """Elastoplasticity of Drucker and Prager at finite strain, with its apex and a cut-off.

    Yield function sqrt(J2) + eta p - xi c of the Kirchhoff stress, with the mean stress p,
    tension positive, and flow along the derivative of sqrt(J2) + eta_psi p. The cut-off is one
    of the mean stress, p at most ``tension_cutoff``, with flow along p. Backward Euler in closed
    form: the cone, or the cap at the largest mean stress, which is the apex without cut-off (de
    Souza Neto, Peric & Owen 2008, section 8.3). Without dilation the apex is returned to along
    the hydrostatic axis.

    The constants are those of a cone that meets Mohr-Coulomb's pyramid (section 6.4.4 there):

    - ``"outer"``: at the edges of triaxial compression, eta = 6 sin(phi)/(sqrt(3) (3 - sin(phi)));
    - ``"inner"``: at those of extension, with 3 + sin(phi) in the denominator;
    - ``"plane_strain"``: where plastic flow in plane strain goes on for ever. With the dilation
      eta_psi = sin(psi)/sqrt(1 + sin(psi)^2/3) and S = sqrt(1 - eta_psi^2/3) this is
      eta = sin(phi)/(S + eta_psi sin(phi)/3), for associated flow
      eta = 3 tan(phi)/sqrt(9 + 12 tan(phi)^2).

    xi is eta/tan(phi), and eta_psi is eta with psi in place of phi, and of associated flow.
    """

    _loop: ClassVar[str] = "drucker_prager"

    def __init__(
        self,
        young: ArrayLike | Field,
        poisson: ArrayLike | Field,
        cohesion: ArrayLike | Field,
        friction_angle: ArrayLike | Field,
        dilation_angle: ArrayLike | Field = 0.0,
        tension_cutoff: ArrayLike | Field | None = None,
        match: Match = "outer",
        *,
        cohesion_residual: ArrayLike | Field | None = None,
        friction_residual: ArrayLike | Field | None = None,
        decay: ArrayLike | Field | None = None,
        relaxation_time: ArrayLike | Field | None = None,
        volume_correction: bool = False,
    ) -> None:
        """Set the parameters.

        Args:
            young: Young's modulus, in units of stress.
            poisson: Poisson's ratio.
            cohesion: Cohesion c of the Mohr-Coulomb law that is matched, in units of stress.
            friction_angle: Its angle of friction phi in degrees.
            dilation_angle: Its angle of dilation psi in degrees, at most that of friction; where
                it is the same (the same number or the same object) flow is associated and the
                tangent symmetric.
            tension_cutoff: Largest mean stress that is borne; ``None``: as far as the cone goes.
            match: ``"outer"``, ``"inner"`` or ``"plane_strain"``.
            cohesion_residual: Cohesion after much plastic strain; ``None``: as before.
            friction_residual: Angle of friction after much plastic strain; ``None``: as before.
                The angle of dilation falls with it where it is larger.
            decay: How fast strength falls: by 1/e in a plastic strain of 1/decay.
            relaxation_time: Time in which stress beyond yield falls by 1/e; ``None``: at once.
            volume_correction: Whether volume that opens at the apex or the cap closes again
                before there is pressure; without it, it is plastic and stays.

        Raises:
            MPMError: A value is out of range; see :class:`FrictionalMaterial`.
        """
        super().__init__(
            young,
            poisson,
            cohesion,
            friction_angle,
            dilation_angle,
            tension_cutoff,
            cohesion_residual=cohesion_residual,
            friction_residual=friction_residual,
            decay=decay,
            relaxation_time=relaxation_time,
            volume_correction=volume_correction,
        )
        if match not in get_args(Match):
            raise MPMError(f"match is {match!r} but must be one of {', '.join(get_args(Match))}")
        self.match = match

    def _constants(self) -> tuple[Parameter, ...]:
        """Return moduli, eta, eta_psi, strength xi c, largest mean stress, and the correction.

        Where an average softens it, those of :meth:`_averaged_constants`.
        """
        if "average" in self.parameters:
            return self._averaged_constants(get_args(Match).index(self.match))
        friction, dilation, cosine = self._sines()
        if self.match == "plane_strain":
            flow = dilation / np.sqrt(1.0 + dilation**2 / 3.0)
            slope = np.sqrt(1.0 - flow**2 / 3.0) + flow * friction / 3.0
            eta, xi = friction / slope, cosine / slope
        else:
            sign = -1.0 if self.match == "outer" else 1.0
            slope = np.sqrt(3.0) * (3.0 + sign * friction) / 6.0
            eta, xi = friction / slope, cosine / slope
            flow = dilation * 6.0 / (np.sqrt(3.0) * (3.0 + sign * dilation))
        strength = xi * self.parameters["cohesion"]
        with np.errstate(divide="ignore", invalid="ignore"):
            apex = np.where(np.equal(eta, 0.0), np.inf, np.divide(strength, eta))
        top = np.minimum(apex, self._tension())
        largest = top if np.ndim(top) else float(top)
        corrects = float(self.volume_correction)
        return self.bulk, self.shear, eta, flow, strength, largest, corrects

    def yield_function(self, stress: Array, plastic_strain: Array) -> Array:
        """Return f, shape ``(n,)``, in units of stress, of stresses ``(n, m)``.

        The larger one of sqrt(J2) + eta p - xi c and p less the cut-off.
        """
        if "decay" in self.parameters:
            return self.softened(plastic_strain).yield_function(stress, plastic_strain)
        _, _, eta, _, strength, *_ = self._constants()
        mean = trace(stress) / 3.0
        cone = np.sqrt(0.5) * norm(deviator(stress)) + eta * mean - strength
        return np.asarray(np.maximum(cone, mean - self._tension()))

    @override
    def give_back(self, trial_strain: Array, variables: State, tangent: bool) -> Integration:
        n, m = trial_strain.shape
        stress = self.elastic_stress(trial_strain)
        D = self.elastic_tangent(n, m) if tangent else None
        constants = _Constants(*(np.broadcast_to(c, n) for c in self._constants()))
        bulk, shear, eta, _, strength, top, _ = constants
        mean = bulk * trace(trial_strain)
        root = np.sqrt(2.0) * shear * norm(deviator(trial_strain))
        room = self.yield_tolerance * (root + np.abs(mean) + strength)
        beyond = (root + eta * mean - strength > room) | (mean - top > room)
        points = np.flatnonzero(beyond)
        if len(points) == 0:
            return Integration(stress, D, trial_strain, variables)
        elastic, kappa = trial_strain.copy(), variables["plastic_strain"].copy()
        stress[points], elastic[points], D_plastic = _give_back(
            _Constants(*(values[points] for values in constants)), trial_strain[points], tangent
        )
        kappa[points] += np.sqrt(2.0 / 3.0) * norm(trial_strain[points] - elastic[points])
        if D is not None:
            D = D.copy()
            D[points] = D_plastic
        return Integration(stress, D, elastic, {"plastic_strain": kappa})


class _Constants(NamedTuple):
    """Constants of a number of points, shape ``(n,)`` each."""

    bulk: Array
    shear: Array
    eta: Array
    flow: Array
    strength: Array
    top: Array
    corrects: Array


def _give_back(
    constants: _Constants, strain: Array, tangent: bool
) -> tuple[Array, Array, Array | None]:
    """Return stress, elastic strain and tangent of trial strains ``(n, m)`` that yield."""
    n = len(strain)
    bulk, shear, eta, flow, strength, top, corrects = constants
    mean, dev = bulk * trace(strain), deviator(strain)
    size = norm(dev)
    root = np.sqrt(2.0) * shear * size
    # The cone, and where its mean stress is too large, the cap.
    stiffness = shear + bulk * eta * flow
    multiplier = np.maximum(root + eta * mean - strength, 0.0) / stiffness
    returned = mean - bulk * flow * multiplier
    cap = returned > top
    with np.errstate(invalid="ignore"):
        limit = np.where(cap, np.maximum(strength - eta * top, 0.0), np.inf)
    p = np.where(cap, top, returned)
    held = cap & (root < limit)
    q = np.where(cap, np.minimum(root, limit), root - shear * multiplier)
    ratio = np.divide(q, root, out=np.ones(n), where=root > 0.0)
    ratio = np.where(cap & ~held & (root == 0.0), 0.0, ratio)
    elastic = ratio[:, None] * dev
    volume = np.where(cap & (corrects != 0.0), trace(strain), p / bulk)
    elastic[:, :3] += (volume / 3.0)[:, None]
    stress = (2.0 * shear * ratio)[:, None] * dev
    stress[:, :3] += p[:, None]
    if not tangent:
        return stress, elastic, None
    answer = Returned(
        p,
        q,
        p_trace=np.where(cap, 0.0, bulk * (1.0 - bulk * eta * flow / stiffness)),
        p_size=np.where(cap, 0.0, -np.sqrt(2.0) * shear * bulk * flow / stiffness),
        q_trace=np.where(cap, 0.0, -shear * bulk * eta / stiffness),
        q_size=np.sqrt(2.0) * shear * np.where(cap, held, 1.0 - shear / stiffness),
    )
    return stress, elastic, returned_tangent(answer, strain, shear, ratio)


class Returned(NamedTuple):
    """Result of a return in p and q, the root of J2, with derivatives, shape ``(n,)`` each.

    Derivatives are those by the trace and by the size of the deviator of the trial strain.
    """

    p: Array
    q: Array
    p_trace: Array
    p_size: Array
    q_trace: Array
    q_size: Array


def returned_tangent(law: Returned, strain: Array, shear: Array, ratio: Array) -> Array:
    """Return the tangent of a law of two invariants, shape ``(n, m, m)``.

    Args:
        law: What it returns to.
        strain: Trial strains, shape ``(n, m)``.
        shear: Shear modulus, shape ``(n,)``.
        ratio: q over that of the trial state, shape ``(n,)``.
    """
    m = strain.shape[1]
    one, dev = identity(m), deviator(strain)
    size = norm(dev)[:, None]
    direction = np.divide(dev, size, out=np.zeros_like(dev), where=size > 0.0)
    along = np.sqrt(2.0) * law.q_size - 2.0 * shear * ratio
    D = np.einsum("n,ij->nij", 2.0 * shear * ratio, deviatoric_projector(m))
    D += np.einsum("n,ni,nj->nij", along, direction, direction)
    D += np.einsum("n,i,j->nij", law.p_trace, one, one)
    D += np.einsum("n,i,nj->nij", law.p_size, one, direction)
    D += np.einsum("n,ni,j->nij", np.sqrt(2.0) * law.q_trace, direction, one)
    return np.asarray(D)
