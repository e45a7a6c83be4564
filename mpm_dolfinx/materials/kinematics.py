# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Strain from the displacement gradient, and the way back to the first Piola stress.

Two kinematics with one interface: a trial elastic strain for the law, then the first Piola
stress, its tangent and the history from the law's answer. A law in strain space sees Mandel
vectors only.

Inside, arrays have their points last (see :mod:`mpm_dolfinx.materials.tensors`).
Displacement gradients are taken about zero, not deformation gradients about one, so small
strains keep their full relative precision.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ..errors import DomainDistortionError
from .mandel import POSITIONS, WEIGHTS, num_components
from .tensors import (
    determinant,
    eigen,
    inverse,
    logarithm_quotient,
    pack,
    points_first,
    points_last,
    unpack,
)

__all__ = ["KINEMATICS", "Kinematics", "LogarithmicStrain", "SmallStrain", "require_valid"]

Array = NDArray[np.float64]


def require_valid(valid: NDArray[np.bool_]) -> None:
    """Raise an error that names the points that are not valid.

    Args:
        valid: Whether the deformation of each point is possible, shape ``(n,)``.

    Raises:
        DomainDistortionError: Some are not; its ``particles`` are the numbers of these points.
    """
    if not valid.all():
        points = np.flatnonzero(~valid)
        raise DomainDistortionError(
            f"the deformation gradient of {len(points)} of {len(valid)} points is not finite "
            "with a positive determinant: a domain is inverted or crushed, take smaller steps",
            particles=points,
        )


class SmallStrain:
    """Infinitesimal strain: one stress, no difference of configurations.

    Args:
        displacement_gradient: Gradient of the total displacement with respect to the undeformed
            body, shape ``(n, dim, dim)``.
        history: State of the last converged step, ``None`` for elastic laws.

    Attributes:
        trial_strain: Trial elastic strain for the law, shape ``(n, m)``.
    """

    def __init__(self, displacement_gradient: Array, history: Mapping[str, Array] | None) -> None:
        self._gradient = points_last(displacement_gradient)
        self._dim = len(self._gradient)
        if history is None:
            self.trial_strain = pack(self._gradient).T
        else:
            increment = self._gradient - np.moveaxis(history["displacement_gradient"], 0, -1)
            self.trial_strain = pack(increment).T + history["elastic_strain"]

    @staticmethod
    def history_of(elastic_strain: Array, displacement_gradient: Array) -> dict[str, Array]:
        """Return the history of points of an elastic strain ``(n, m)`` at ``(n, dim, dim)``."""
        return {
            "displacement_gradient": displacement_gradient.copy(),
            "elastic_strain": elastic_strain.copy(),
        }

    def history(self, elastic_strain: Array) -> dict[str, Array]:
        """Return the new history for the law's elastic strain, shape ``(n, m)``."""
        gradient = np.moveaxis(self._gradient, -1, 0)
        return {"displacement_gradient": gradient, "elastic_strain": elastic_strain}

    def first_piola(self, stress: Array) -> Array:
        """Return the first Piola stress ``(n, dim, dim)`` of the law's stress ``(n, m)``: it."""
        return points_first(unpack(stress.T, self._dim))

    def tangent(self, stress: Array, tangent: Array) -> Array:
        """Return dP_iJ/dF_kL, ``(n, dim, dim, dim, dim)``, of the law's tangent ``(n, m, m)``."""
        n, dim, m = len(tangent), self._dim, tangent.shape[1]
        at = POSITIONS[:dim, :dim].ravel()
        weights = WEIGHTS[:dim, :dim].ravel()
        entries = tangent.reshape(n, m * m)[:, (m * at[:, None] + at).ravel()]
        entries *= np.outer(weights, weights).ravel()
        return entries.reshape(n, dim, dim, dim, dim)

    @staticmethod
    def volume_ratio(displacement_gradient: Array) -> Array:
        """Return the law's stress over Cauchy's, shape ``(n,)``: one."""
        return np.ones(len(displacement_gradient))


class LogarithmicStrain:
    """Logarithmic strain and Kirchhoff stress, with the elastic left Cauchy-Green tensor b.

    Trial state b = f b_n f^T with f = F F_n^-1, strain 1/2 ln b, exponential return, of which
    a law sees the algorithm of small strains (Cuitino & Ortiz 1992; Simo 1992; de Souza Neto,
    Peric & Owen 2008, section 14.4). All is written for b - I.
    """

    def __init__(self, displacement_gradient: Array, history: Mapping[str, Array] | None) -> None:
        """Take the displacement gradients of points.

        Raises:
            DomainDistortionError: det F or an eigenvalue of b is not positive and finite; its
                ``particles`` are the numbers of the points.
        """
        self._gradient = H = points_last(displacement_gradient)
        self._dim = dim = len(H)
        self._inverse, det = inverse(H)
        m = num_components(dim)
        with np.errstate(invalid="ignore", over="ignore"):
            if history is None:
                c = pack(2.0 * H + np.einsum("ikn,jkn->ijn", H, H))
            else:
                H_n = np.moveaxis(history["displacement_gradient"], 0, -1)
                c_n = history["elastic_b_minus_identity"].T
                h = np.einsum("ikn,kjn->ijn", H - H_n, inverse(H_n)[0])
                right = np.einsum("ikn,kjn->ijn", h, unpack(c_n, dim)) + h
                c = c_n + pack(2.0 * right + np.einsum("ikn,jkn->ijn", right, h))
        require_valid(np.isfinite(c).all(axis=0) & (det > 0.0))
        self._trial_c = c
        self._principal, self._axes = eigen(unpack(c, dim))
        require_valid((self._principal > -1.0).all(axis=0))
        strain = _assemble(0.5 * np.log1p(self._principal), self._axes)
        if m == 4:
            strain[2] = 0.5 * np.log1p(c[2])
        self.trial_strain = strain.T

    @staticmethod
    def history_of(elastic_strain: Array, displacement_gradient: Array) -> dict[str, Array]:
        """Return displacement gradient and b - I."""
        dim = displacement_gradient.shape[-1]
        return {
            "displacement_gradient": displacement_gradient.copy(),
            "elastic_b_minus_identity": _exponential(elastic_strain.T, dim).T,
        }

    def history(self, elastic_strain: Array) -> dict[str, Array]:
        """Return displacement gradient and b - I.

        Where the law returned the trial strain, b keeps its trial value, free of the round-off
        of a logarithm and an exponential.
        """
        c = self._trial_c.copy()
        (moved,) = np.nonzero((elastic_strain != self.trial_strain).any(axis=1))
        if len(moved):
            c[:, moved] = _exponential(elastic_strain.T[:, moved], self._dim)
        gradient = np.moveaxis(self._gradient, -1, 0)
        return {"displacement_gradient": gradient, "elastic_b_minus_identity": c.T}

    def first_piola(self, stress: Array) -> Array:
        """Return P = tau F^-T."""
        return points_first(self._piola(stress))

    def _piola(self, stress: Array) -> Array:
        """Return P with points last."""
        tau = unpack(stress.T, self._dim)
        return np.asarray(np.einsum("ijn,Jjn->iJn", tau, self._inverse))

    def tangent(self, stress: Array, tangent: Array) -> Array:
        """Return dP_iJ/dF_kL of P = tau F^-T.

        With l = dF F^-1, dP = (D : d eps) F^-T - P l^T, and in the principal frame of the trial
        b, d eps_ab = g_ab (b_b l_ab + b_a l_ba), g_ab = (eps_a - eps_b)/(b_a - b_b): the
        derivative of a tensor logarithm (Ogden 1984, section 2.6). The quotient is written
        with log1p of the difference, which is accurate however close the eigenvalues are.
        """
        dim, n = self._dim, len(stress)
        # In plane strain the trial strain of direction z does not change.
        rows = np.array([0, 1, 3] if dim == 2 else range(6))
        D = np.moveaxis(tangent, 0, -1)[np.ix_(rows, rows)]
        b, Q = 1.0 + self._principal, self._axes
        G = np.empty((len(rows), dim, dim, n))
        for a in range(dim):
            for e in range(a, dim):
                dyad = pack(Q[:, None, a] * Q[None, :, e])[rows]
                response = np.einsum("IJn,Jn->In", D, dyad)
                rate = logarithm_quotient(self._principal[a], self._principal[e])
                G[:, a, e] = response * (2.0 * rate * b[e])
                if a != e:
                    G[:, e, a] = response * (2.0 * rate * b[a])
        moved = np.einsum("Iaen,Len->IaLn", G, np.einsum("Lln,len->Len", self._inverse, Q))
        full = np.zeros((num_components(dim), dim, dim, n))
        full[rows] = np.einsum("IaLn,kan->IkLn", moved, Q)
        A = np.einsum("ijkLn,Jjn->iJkLn", unpack(full, dim), self._inverse)
        A -= np.einsum("iLn,Jkn->iJkLn", self._piola(stress), self._inverse)
        return points_first(A)

    @staticmethod
    def volume_ratio(displacement_gradient: Array) -> Array:
        """Return det F."""
        return determinant(points_last(displacement_gradient))


def _assemble(values: Array, axes: Array) -> Array:
    """Return Mandel vectors ``(m, n)`` from eigenvalues and eigenvectors."""
    return pack(np.einsum("ian,jan->ijn", values * axes, axes))


def _exponential(strain: Array, dim: int) -> Array:
    """Return b - I, shape ``(m, n)``, of elastic strains ``(m, n)``."""
    principal, axes = eigen(unpack(strain, dim))
    c = _assemble(np.expm1(2.0 * principal), axes)
    if dim == 2:
        c[2] = np.expm1(2.0 * strain[2])
    return c


type Kinematics = SmallStrain | LogarithmicStrain

KINEMATICS: dict[str, type[SmallStrain] | type[LogarithmicStrain]] = {
    "small": SmallStrain,
    "logarithmic": LogarithmicStrain,
}
"""Kinematics by the name a :class:`~mpm_dolfinx.materials.StrainMaterial` gives."""
