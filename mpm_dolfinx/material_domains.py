# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Domains with a material: their stress, internal variables and fields for output."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .domains import Domains
from .errors import MPMError

if TYPE_CHECKING:
    from .constitutive import ConstitutiveHistory

__all__ = ["MaterialDomains"]


class MaterialDomains(Domains):
    """Domains for whose stress and internal variables a history may answer."""

    _constitutive: ConstitutiveHistory | None = None

    def attach(self, history: ConstitutiveHistory) -> None:
        """Let a history answer for stress and internal variables."""
        self._constitutive = history

    def _average(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return volume averages of values ``(n, nq, ...)`` over the undeformed domains."""
        weights = self.point_volumes(self._axisymmetric)
        share = weights / weights.sum(axis=1, keepdims=True)
        return np.asarray(np.einsum("nq,nq...->n...", share, values))

    @property
    def deformation_gradient(self) -> NDArray[np.float64]:
        """Deformation gradient, shape ``(n, 3, 3)`` (volume averages, plane strain in 2-D)."""
        return _in_space(self._average(self.displacement_gradient(self._axisymmetric)))

    @property
    def _axisymmetric(self) -> bool:
        return self._constitutive is not None and self._constitutive.axisymmetric

    @property
    def has_material(self) -> bool:
        """Whether a problem with a material governs these particles."""
        return self._constitutive is not None

    @property
    def stress(self) -> NDArray[np.float64]:
        """Cauchy stress, shape ``(n, 3, 3)`` (volume averages).

        With ``f_bar="pair"`` or ``"patch"`` the part of it that is constant on a patch is
        recovered linearly from the patches around.

        Raises:
            MPMError: The particles have no material (a problem written in UFL).
        """
        history = self._history("stress")
        return self._average(history.cauchy_stress()) + history.recovery

    @property
    def plastic_strain(self) -> NDArray[np.float64]:
        """Accumulated plastic strain ``sqrt(2/3) |d eps_p|``, shape ``(n,)``."""
        return self._average(self._history("plastic strain").plastic_strain())

    @property
    def point_stress(self) -> NDArray[np.float64]:
        """Cauchy stress at the quadrature points, shape ``(n, nq, 3, 3)``.

        Raises:
            MPMError: The particles have no material (a problem written in UFL).
        """
        return self._history("stress").cauchy_stress()

    @property
    def point_plastic_strain(self) -> NDArray[np.float64]:
        """Accumulated plastic strain at the quadrature points, shape ``(n, nq)``."""
        return self._history("plastic strain").plastic_strain()

    @property
    def point_deformation_gradient(self) -> NDArray[np.float64]:
        """Deformation gradient at the quadrature points, shape ``(n, nq, 3, 3)``."""
        return _in_space(self.displacement_gradient(self._axisymmetric))

    def fields(self) -> dict[str, NDArray[np.float64]]:
        """Return what is known of each particle, for output: arrays ``(n, ...)`` by name.

        ``volume_ratio`` and, where there is a material, ``stress`` (Cauchy), ``pressure``
        (mean of the normal stresses, compression positive) and ``plastic_strain``; with
        ``outside="delete"`` also ``deleted`` (1 where a particle is).
        """
        values = {"volume_ratio": self.volume / self.initial_volume}
        if self.has_material:
            values["stress"] = self.stress
            values["pressure"] = -np.trace(values["stress"], axis1=1, axis2=2) / 3.0
            values["plastic_strain"] = self.plastic_strain
        if self.deletion is not None:
            values["deleted"] = self.deleted.astype(np.float64)
        return values

    def _history(self, what: str) -> ConstitutiveHistory:
        if self._constitutive is None:
            raise MPMError(
                f"These particles have no material, so no {what}; give them one with "
                "QuasiStaticProblem, or evaluate your own UFL expression."
            )
        return self._constitutive


def _in_space(gradient: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``I + H`` of gradients ``(..., dim, dim)``, shape ``(..., 3, 3)``."""
    dim = gradient.shape[-1]
    F = np.tile(np.eye(3), (*gradient.shape[:-2], 1, 1))
    F[..., :dim, :dim] += gradient
    return F
