# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Discrete gradients: what acts over a step, made of a potential's derivatives at its ends.

With F_m the mean of the deformation gradients at a step's ends, and S = F^-1 P,

    P* = F_m S*,     S* = (S_n + S_1)/2 + c (E_1 - E_n),

c = 0 (Simo & Tarnow 1992) or, where the work P* : (F_1 - F_n) is the change of a potential W,

    c = (W_1 - W_n - (S_n + S_1)/2 : (E_1 - E_n)) / |E_1 - E_n|^2

(Gonzalez 2000), at each point; where W is one of a group of domains, both are integrals over it.
In small strains ``P* = (P_n + P_1)/2``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .._core import loops
from ..errors import ConvergenceError
from ..tolerances import SMALL
from .averaging import LowRankTerm, VolumeAveraging

__all__ = ["Ends", "Gradients", "abandon", "by_end", "mean", "mean_of_groups"]

type Array = NDArray[np.float64]


class Ends(NamedTuple):
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


class Gradients(NamedTuple):
    """F - I at a step's ends, shape ``(n, dim, dim)``.

    Attributes:
        end: At its end.
        begin: At its beginning.
    """

    end: Array
    begin: Array

    @property
    def mean(self) -> Array:
        """Mean of F."""
        return np.asarray(np.eye(self.end.shape[-1]) + 0.5 * (self.end + self.begin))

    @property
    def inverse(self) -> Array:
        """Inverse of F at the end."""
        return np.asarray(np.linalg.inv(np.eye(self.end.shape[-1]) + self.end))

    def strain(self) -> tuple[Array, Array]:
        """Return the change of Green's strain, and its derivative by F at the end."""
        dim = self.end.shape[-1]
        F = np.eye(dim) + self.end
        half = self.mean.swapaxes(1, 2) @ (self.end - self.begin)
        slope = np.zeros((len(F), dim, dim, dim, dim))
        for J in range(dim):
            slope[:, :, J, :, J] += 0.5 * F.swapaxes(1, 2)
            slope[:, J, :, :, J] += 0.5 * F.swapaxes(1, 2)
        return 0.5 * (half + half.swapaxes(1, 2)), slope


def mean(ends: Ends, gradients: Gradients, factor: float) -> tuple[Array, Array]:
    """Return the discrete gradient, and its derivative by F at the end.

    Args:
        ends: Derivatives of the potential.
        gradients: Where these are.
        factor: How often both count.

    Raises:
        ConvergenceError: F is singular.
    """
    stress, tangent = np.empty(ends.stress.shape), np.empty(ends.tangent.shape)
    none = np.zeros(0)
    singular = loops.step_stress(
        np.ascontiguousarray(gradients.end),
        np.ascontiguousarray(gradients.begin),
        np.ascontiguousarray(ends.stress),
        np.ascontiguousarray(ends.before),
        np.ascontiguousarray(ends.tangent),
        *(ends.potentials or (none, none)),
        ends.kind,
        SMALL,
        factor,
        stress,
        tangent,
    )
    if len(singular):
        raise ConvergenceError("A deformation gradient is singular")
    return stress, tangent


def by_end(gradients: Gradients, small: NDArray[np.bool_]) -> Array:
    """Return by which the stress at the end comes into :func:`mean` without correction.

    Args:
        gradients: At the ends.
        small: Where strains are small.

    Returns:
        Matrices to multiply it with from the left, ``(n, dim, dim)``.
    """
    half = 0.5 * gradients.mean @ gradients.inverse
    half[small] = 0.5 * np.eye(half.shape[-1])
    return np.asarray(half)


def abandon(averaging: VolumeAveraging) -> None:
    """Take part in the sums of an evaluation that failed on this rank (collective)."""
    averaging.groups.sum(np.zeros((averaging.counted().shape[0], len(_Sums._fields))))


class _Sums(NamedTuple):
    """Numbers of domains that are summed over their groups, shape ``(n, nq)`` or ``(n,)``.

    Attributes:
        change: Numerator of c.
        size: Its denominator.
        whole: The change of strain along the part of the tangent from the group, on the left.
        gamma: That along the part on the right.
    """

    change: Array
    size: Array
    whole: Array
    gamma: Array


def mean_of_groups(
    averaging: VolumeAveraging, ends: Ends, gradients: Gradients, factor: float
) -> tuple[Array, Array, LowRankTerm]:
    """Return :func:`mean` with F-bar, where c is that of a group (collective).

    Returns:
        What acts, its pointwise derivative, and what other points of the group add to that.

    Raises:
        ConvergenceError: F is singular.
    """
    small = ends.kind == 0
    try:
        plain = ends._replace(kind=np.where(small, 0, 1).astype(np.uint8))
        stress, tangent = mean(plain, gradients, factor)
        inverse = gradients.inverse
    except (ConvergenceError, np.linalg.LinAlgError):
        abandon(averaging)
        raise ConvergenceError("A deformation gradient is singular") from None
    F_mean, F_n = gradients.mean, np.eye(stress.shape[-1]) + gradients.begin
    S = inverse @ ends.stress
    S_mean = 0.5 * (S + np.linalg.solve(F_n, ends.before))
    h, gamma, left, right = averaging.grouped_tangent()
    shape, volumes = gamma.shape, averaging.counted()
    change, slope = gradients.strain()
    turned = np.einsum("nIi,nIJ->niJ", inverse, change)
    whole = h[:, None, None, None] * gamma + left
    over, under = _quotient(ends, S_mean, change)
    own = _Sums(
        over.reshape(volumes.shape),
        under.reshape(volumes.shape),
        np.einsum("nqiJ,nqiJ->nq", turned.reshape(shape), whole),
        np.einsum("nqiJ,nqiJ->nq", turned.reshape(shape), gamma),
    )
    summed = averaging.groups.sum(np.stack([(volumes * part).sum(axis=1) for part in own], 1))
    sums = _Sums(*summed.T)
    size = np.where(sums.size > 0.0, sums.size, 1.0)
    kind = ends.kind.reshape(volumes.shape)[:, 0]
    c = sums.change / size
    exact = (kind == 2) | ((kind == 3) & (c > 0.0))
    each = np.repeat(np.where(exact, c, 0.0), volumes.shape[1])[:, None, None]
    # how c changes with F at the points, times its denominator
    X = np.einsum("nIJ,nIJkL->nkL", S - S_mean - 2.0 * each * change, slope)
    X -= 0.5 * (np.einsum("niJ,niJkL->nkL", turned, ends.tangent) - turned @ S.swapaxes(1, 2))

    each *= factor
    stress += each * (F_mean @ change)
    tangent += _times(F_mean, each[:, :, :, None, None] * slope)
    for i in range(F_mean.shape[-1]):
        tangent[:, i, :, i, :] += 0.5 * each * change
    inverse_size = np.where(exact, 1.0 / size, 0.0)[:, None, None]
    half = factor * by_end(gradients, small)
    first, second = (
        averaging.nodal((half @ one.reshape(S.shape)).reshape(shape)) for one in (whole, gamma)
    )
    along = averaging.nodal((factor * F_mean @ change).reshape(shape)) * inverse_size
    first -= 0.5 * sums.whole[:, None, None] * along
    second -= 0.5 * sums.gamma[:, None, None] * along
    after = (averaging.nodal(gamma), averaging.nodal(right), averaging.nodal(X.reshape(shape)))
    return stress, tangent, LowRankTerm(averaging.groups, (first, second, along), after)


def _quotient(ends: Ends, S_mean: Array, change: Array) -> tuple[Array, Array]:
    """Return numerator and denominator of c at each point."""
    energy = np.zeros(len(change))
    if ends.potentials is not None:
        energy = np.where(ends.kind >= 2, ends.potentials[0] - ends.potentials[1], 0.0)
    work = np.einsum("nIJ,nIJ->n", S_mean, change)
    return energy - work, np.einsum("nIJ,nIJ->n", change, change) + SMALL**2


def _times(factor: Array, tangent: Array) -> Array:
    """Return ``factor_Ii tangent_iJkL`` at all points."""
    n, dim = factor.shape[:2]
    return np.asarray((factor @ tangent.reshape(n, dim, dim**3)).reshape(tangent.shape))
