# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""F-bar: volume ratios averaged over domains or patches, against locking.

A material sees ``Fbar = (Jbar / J)^(1/dim) F`` (de Souza Neto, Peric, Dutko & Owen 1996), in
plane strain with the power 1/2, which leaves the third direction alone; Jbar is the mean of J over
a group of domains. The stress is that of the energy ``int psi(Fbar) dX``: residual
``P(Fbar) : delta Fbar``, so the tangent is symmetric wherever the material's is.

Nothing but shear would keep J at single points, and it would drift as a body flows, until domains
fold. Let d be ln of a point's J over its average. To the energy is added
``int 3 G Phi(d) dX``, G the shear modulus, convex and zero for small d (:func:`deviation`).
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError
from ..materials.tensors import growth
from .groups import Groups, patches, singles
from .strain import Strain

__all__ = [
    "F_BARS",
    "Array",
    "GroupedTangent",
    "Linearised",
    "LowRankTerm",
    "VolumeAveraging",
    "deviation",
    "deviation_energy",
]

F_BARS = ("none", "domain", "patch")
#: Deviation of ln J from its average that costs nothing, and that from which all is resisted.
FREE = {"domain": (0.2, 0.6), "patch": (0.1, 0.5)}
type Array = NDArray[np.float64]


def deviation(d: Array, free: float, whole: float) -> tuple[Array, Array]:
    """Return first and second derivatives, Phi' and Phi'', of the energy of deviations of ln J.

    Phi' is odd, 0 up to ``free``, then a parabola up to ``whole``, and has slope 1 beyond.

    Args:
        d: Deviations, any shape.
        free: Largest deviation that costs nothing.
        whole: Deviation from which the slope is 1.
    """
    width = whole - free
    excess = np.maximum(np.abs(d) - free, 0.0)
    force = np.where(excess < width, excess**2 / (2.0 * width), excess - width / 2.0)
    return np.sign(d) * force, np.minimum(excess / width, 1.0)


def deviation_energy(d: Array, free: float, whole: float) -> Array:
    """Return Phi, of which :func:`deviation` has the derivatives; 0 at 0."""
    width = whole - free
    excess = np.maximum(np.abs(d) - free, 0.0)
    beyond = 0.5 * excess * (excess - width) + width**2 / 6.0
    return np.asarray(np.where(excess < width, excess**3 / (6.0 * width), beyond))


class LowRankTerm(NamedTuple):
    """``sum_m sum_k left_mk right_mk^T`` on the dofs of W, m a group.

    The vectors of a group are the sums of what its domains contribute to their nodes.

    Attributes:
        groups: The groups; ``groups.number`` are those of the owned domains, shape ``(n,)``.
        left: Contributions to the left vectors, each of shape ``(n, k, gdim)``.
        right: Contributions to the right vectors, as many; the same arrays where vectors are.
    """

    groups: Groups
    left: tuple[Array, ...]
    right: tuple[Array, ...]

    @classmethod
    def of(cls, groups: Groups, h: Array, g: Array, left: Array, right: Array) -> LowRankTerm:
        """Return ``sum_m h_m g_m g_m^T + left_m g_m^T + g_m right_m^T``.

        Args:
            groups: The groups.
            h: Factor of each owned domain's group, shape ``(n,)``.
            g: Contributions to g, shape ``(n, k, gdim)``.
            left: Contributions to the left vectors, shape ``(n, k, gdim)``.
            right: The same array where the material's tangent is symmetric.
        """
        half = 0.5 * h[:, None, None] * g
        first = half + left
        return cls(groups, (first, g), (g, first if right is left else half + right))

    def times(self, nodal: Array) -> Array:
        """Return the owned domains' contributions to the term times a vector (collective).

        Args:
            nodal: The vector at the domains' nodes, shape ``(n, k, gdim)``.
        """
        parts = [np.einsum("nki,nki->n", vector, nodal) for vector in self.right]
        sums = self.groups.sum(np.stack(parts, axis=1))[:, :, None, None]
        return np.asarray(sum(sums[:, k] * left for k, left in enumerate(self.left)))


class GroupedTangent(NamedTuple):
    """Part of the tangent at a point that comes from the other points of its group.

    That is ``(h gamma + left) (gamma : dF) + gamma (right : dF)``, where ``a : dF`` is the integral
    over the group.

    Attributes:
        h: Factor of each owned domain's group, shape ``(n,)``.
        gamma: ``d ln Jbar / dF`` per volume, shape ``(n, nq, dim, dim)``, as are the others.
        left: See above.
        right: The same array where the material's tangent is symmetric.
    """

    h: Array
    gamma: Array
    left: Array
    right: Array


class _Averaged(NamedTuple):
    """Averages of displacement gradients, at points ``(n, nq)``.

    Attributes:
        deviation: Of ln J from its average.
        group_size: Present volume of the group of each domain, shape ``(n,)``.
        counted: Undeformed volume that counts in it.
        J: Determinant of F.
        F: The deformation gradient, ``(n, nq, dim, dim)``.
        Z: The transpose of its inverse.
        s: Scale of F that the material sees.
    """

    deviation: Array
    group_size: Array
    counted: Array
    J: Array
    F: Array
    Z: Array
    s: Array


class Linearised(Protocol):
    """Source of the low-rank part of a body's tangent."""

    @property
    def groups(self) -> Groups:
        """The groups of domains."""

    def linearise(self) -> LowRankTerm:
        """Return it at the last evaluation (collective)."""


class VolumeAveraging:
    """F-bar on the points of a body.

    One evaluation is :meth:`average`, the material's update, then :meth:`effective` or, where the
    update failed, :meth:`abandon`; each is collective.

    Args:
        strain: What the points of the body are strained in.
        kind: ``"domain"`` or ``"patch"``.
        material: Number of each owned domain's material; groups have one material.
        modulus: Modulus that resists deviations from an average, for each owned domain, ``(n,)``.
        symmetric: Whether the material's tangent is symmetric.

    Attributes:
        kind: As given.
        groups: The groups of domains.
        modulus: As given.
        uneven: Mean stress that the points begin with, less its average over their group, shape
            ``(n, nq)``. It acts against deviations as it is, so that what is in equilibrium with
            the given stress point by point is so with averages.

    Raises:
        MPMError: Domains that the kind of average is not for.
    """

    def __init__(
        self,
        strain: Strain,
        kind: str,
        material: NDArray[np.int64],
        modulus: Array,
        symmetric: bool,
    ) -> None:
        self._particles = strain.particles
        self._strain, self._dim = strain, strain.dim
        self._symmetric = symmetric
        self.modulus = modulus
        self.groups = self._grouped(kind, material)
        self.kind = kind
        self.uneven = np.zeros((self._particles.num_local, self._particles.num_points))
        self._grouped_tangent: GroupedTangent | None = None
        self._low_rank: LowRankTerm | None = None
        self._last: _Averaged | None = None

    @property
    def _averaged(self) -> _Averaged:
        """The last averages."""
        assert self._last is not None
        return self._last

    @property
    def _weights(self) -> Array:
        """Undeformed volume of each point, shape ``(n, nq)``."""
        return self._strain.volumes()

    def _grouped(self, kind: str, material: NDArray[np.int64]) -> Groups:
        body = self._particles
        if kind == "domain":
            if body.num_points == 1:
                raise MPMError(
                    "f_bar='domain' averages over the points of a domain, but these have one "
                    "each; make the particles with quadrature_degree=2, or use f_bar='patch'."
                )
            return singles(body)
        return patches(body, material)

    def begin_with(self, stress: Array) -> None:
        """Let the points, which have not moved, carry a stress (collective).

        Args:
            stress: Cauchy stress, shape ``(n, nq, 3, 3)``.
        """
        own = slice(self._dim)
        mean = np.einsum("nqii->nq", stress[:, :, own, own]) / self._dim
        volumes = self._weights * ~self._particles.deleted[:, None]
        sums = self.groups.sum(
            np.stack([(volumes * mean).sum(axis=1), volumes.sum(axis=1)], axis=1)
        )
        of_group = sums[:, 0] / np.where(sums[:, 1] > 0.0, sums[:, 1], 1.0)
        self.uneven[:] = mean - of_group[:, None]

    def average(self, gradient: Array) -> Array:
        """Return the displacement gradient that the material sees, Fbar - I (collective).

        Args:
            gradient: Displacement gradient F - I with det F > 0, shape ``(n, nq, dim, dim)``.
        """
        a = 1.0 / self._dim
        excess = growth(gradient)
        weights = self._weights
        volume, of_domain = weights.sum(axis=1), (weights * excess).sum(axis=1)
        present = ~self._particles.deleted
        sizes = np.stack([volume, of_domain], axis=1)
        sums = self.groups.sum(np.where(present[:, None], sizes, 0.0))
        group_volume = np.where(present, sums[:, 0], volume)
        of_group = np.where(present, sums[:, 1], of_domain)
        ln_group = np.log1p(of_group / group_volume)[:, None]
        change_of_ln_J = np.log1p(excess) - ln_group
        change = -a * change_of_ln_J
        F = np.eye(self._dim) + gradient
        last = self._last = _Averaged(
            change_of_ln_J,
            group_volume + of_group,
            weights * present[:, None],
            1.0 + excess,
            F,
            np.linalg.inv(F).swapaxes(2, 3),
            np.exp(change),
        )
        scale = last.s[:, :, None, None]
        return np.asarray(np.expm1(change)[:, :, None, None] * np.eye(self._dim) + scale * gradient)

    def abandon(self) -> None:
        """Take part in the sums of an evaluation that failed on this rank (collective)."""
        self.groups.sum(np.zeros((self._particles.num_local, 2)))

    def effective(self, P: Array, A: Array) -> tuple[Array, Array]:
        """Return the first Piola stress that does work on F, and its pointwise tangent.

        The rest of the tangent is :meth:`linearise`. Collective.

        Args:
            P: The material's first Piola stress at Fbar, shape ``(n, nq, dim, dim)``.
            A: Its derivative dP_iJ/dFbar_kL, shape ``(n, nq, dim, dim, dim, dim)``.

        Returns:
            Arrays of the same shapes.
        """
        a, last = 1.0 / self._dim, self._averaged
        s, F, Z, J = last.s, last.F, last.Z, last.J
        s2 = s[:, :, None, None]
        left = P + s2 * np.einsum("nqiJkL,nqkL->nqiJ", A, F)
        right = left
        if not self._symmetric:
            right = P + s2 * np.einsum("nqiJ,nqiJkL->nqkL", F, A)
        p = s * np.einsum("nqiJ,nqiJ->nq", P, F)
        stiffness = s * np.einsum("nqiJ,nqiJ->nq", left, F)
        in_domain = a * (self._averaged.counted * p).sum(axis=1)
        H = a**2 * (self._averaged.counted * stiffness).sum(axis=1)
        force, stiffening = self._resistance()
        sums = self.groups.sum(
            np.stack(
                [
                    in_domain - (self._averaged.counted * force).sum(axis=1),
                    H + (self._averaged.counted * stiffening).sum(axis=1),
                ],
                axis=1,
            )
        )
        B = sums[:, 0]
        beta = (B / self._averaged.group_size)[:, None] * J

        factor = (beta + force - a * p)[:, :, None, None]
        stress = s2 * P + factor * Z
        tangent = s2[:, :, :, :, None, None] ** 2 * A
        tangent -= _dyad((a * s2) * left, Z)
        tangent -= _dyad(Z, (a * s2) * right)
        tangent += _dyad((a**2 * stiffness + beta + stiffening)[:, :, None, None] * Z, Z)
        tangent -= np.einsum("nqiL,nqkJ->nqiJkL", factor * Z, Z)

        projected = (a**2 * stiffness + stiffening)[:, :, None, None] * Z
        left = a * s2 * left - projected
        right = left if self._symmetric else a * s2 * right - projected
        gamma = (J / self._averaged.group_size[:, None])[:, :, None, None] * Z
        self._grouped_tangent = GroupedTangent(sums[:, 1] - B, gamma, left, right)
        self._low_rank = None
        return stress, tangent

    def grouped_tangent(self) -> GroupedTangent:
        """Return the part that the last pointwise tangent lacks, at the points."""
        assert self._grouped_tangent is not None
        return self._grouped_tangent

    def linearise(self) -> LowRankTerm:
        """Return the part that the last pointwise tangent lacks, on the nodes."""
        if self._low_rank is None:
            h, gamma, left, right = self.grouped_tangent()
            before = self.nodal(left)
            after = before if right is left else self.nodal(right)
            self._low_rank = LowRankTerm.of(self.groups, h, self.nodal(gamma), before, after)
        return self._low_rank

    def energy(self) -> Array:
        """Return the energy per volume of deviations in the last evaluation, shape ``(n, nq)``."""
        cost = deviation_energy(self._averaged.deviation, *FREE[self.kind])
        return np.asarray(self.modulus[:, None] * cost + self.uneven * self._averaged.deviation)

    def _resistance(self) -> tuple[Array, Array]:
        """Return force and stiffness, per volume, against deviations at the points."""
        modulus = self.modulus[:, None]
        force, stiffness = deviation(self._averaged.deviation, *FREE[self.kind])
        return modulus * force + self.uneven, modulus * stiffness

    def counted(self) -> Array:
        """Return the volume of each point that counts in its group, shape ``(n, nq)``."""
        return self._averaged.counted

    def nodal(self, stress: Array) -> Array:
        """Return the integrals of ``stress : grad N`` over each domain, ``(n, k, gdim)``."""
        return self._strain.nodal(stress, self._averaged.counted)

    # -- Output ---------------------------------------------------------------------------

    def recover(self, stress: Array) -> Array:
        """Return stresses with the averaged part recovered linearly in each patch (collective).

        Only the mean of the normal stresses that an average acts on (in plane strain, and apart
        from it the third) is constant on a patch. It gets the slope of the plane fitted by least
        squares to the patch's and its neighbours' means, about its own.

        Args:
            stress: Volume averages of the Cauchy stress, shape ``(n, 3, 3)``.

        Returns:
            The same shape.
        """
        if self.kind == "domain":
            return stress
        x = self._particles.initial_centroid
        gdim = x.shape[1]
        normal = np.einsum("nii->ni", stress)
        parts = [normal[:, : self._dim].mean(axis=1)]
        parts += [normal[:, 2]] if self._dim == 2 else []
        own = np.stack(parts, axis=1)
        present = ~self._particles.deleted
        weighted = (
            np.column_stack([x, own, np.ones(len(x))])
            * (self._weights.sum(axis=1) * present)[:, None]
        )
        totals = self.groups.totals(weighted)
        means = totals[:, :-1] / np.where(totals[:, -1:] > 0.0, totals[:, -1:], 1.0)
        centre, mean = means[:, :gdim], means[:, gdim:]
        number = self.groups.number
        slopes = self.groups.slopes(centre, mean)[number]
        change = mean[number] - own + np.einsum("nvi,ni->nv", slopes, x - centre[number])
        result = stress.copy()
        for i in range(3):
            result[present, i, i] += change[present, i // self._dim]
        return result


def _dyad(a: Array, b: Array) -> Array:
    return np.asarray(a[..., :, :, None, None] * b[..., None, None, :, :])
