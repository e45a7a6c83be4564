# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Plasticity of Drucker and Prager, returned in closed form."""

from __future__ import annotations

from typing import ClassVar, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import MPMError
from .base import Field, Parameter
from .mandel import deviator, norm, trace
from .mohr_coulomb import FrictionalMaterial

__all__ = ["DruckerPrager"]

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
