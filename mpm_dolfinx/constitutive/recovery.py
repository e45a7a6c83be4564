# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The error of a body's stress, by a smoother one that is recovered from it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dolfinx import la

from ..errors import agree
from ..particles.particles import Particles
from .points import MaterialPoints

__all__ = ["parts", "recovered", "stress_errors"]

type Array = NDArray[np.float64]


def parts(tensor: Array) -> tuple[Array, Array]:
    """Return the mean of symmetric tensors ``(..., 3, 3)`` and the size of their deviator."""
    mean = np.trace(tensor, axis1=-2, axis2=-1) / 3.0
    return mean, np.linalg.norm(tensor - mean[..., None, None] * np.eye(3), axis=(-2, -1))


def recovered(particles: Particles, points: MaterialPoints) -> tuple[Array, Array]:
    """Return the stress at all points and a continuous one, ``(n, nq, 3, 3)`` (collective).

    It is the stress beyond the one that the body began with, which is no answer of its elements.
    The continuous stress is linear in the domains' shape functions, with values at nodes that are
    means of the domains around, each continued to its nodes as far as its points tell
    (Zienkiewicz & Zhu 1987). Domains of other laws have means of their own.

    Args:
        particles: The body.
        points: Its material.
    """
    with agree(particles.mesh.comm):  # (a law of the user's tells it)
        stress = points.last.gained_stress(particles.point_deformation_gradient)
    stress = stress + np.broadcast_to(points.last.recovery, (len(stress), 3, 3))[:, None]
    weights = points.strain.weights
    at_nodes = _continued(particles, stress, weights)
    smooth = np.empty_like(stress)
    shapes = particles.undeformed.rule.shapes
    for law in range(len(points.laws.governed)):
        mine = points.laws.numbers == law
        means = _means(particles, at_nodes, weights.sum(axis=1) * mine)
        smooth[mine] = np.einsum("qk,nkij->nqij", shapes, means[mine])
    return stress, smooth


def stress_errors(
    particles: Particles, points: MaterialPoints, moduli: tuple[Array, Array]
) -> Array:
    """Return the energy by which the stress differs from a continuous one (collective).

    With a pressure of its own, the volume strain that it leaves counts as strain that resists as
    shear does (Verfuerth 1989, in whose estimate it is beside the residual of the forces).

    Args:
        particles: The body.
        points: Its material.
        moduli: Bulk and shear modulus of each of its points, undeformed.

    Returns:
        ``int ds : C^-1 : ds + 2/3 mu g^2 dX``, shape ``(n,)``.
    """
    stress, smooth = recovered(particles, points)
    weights = points.strain.weights
    bulk, shear = (modulus.reshape(weights.shape) for modulus in moduli)
    mean, deviator = parts(smooth - stress)
    energy = deviator**2 / (2.0 * shear) + mean**2 / bulk
    if points.mean_stress is not None:
        energy += 2.0 / 3.0 * shear * points.mean_stress.gap.reshape(weights.shape) ** 2
    return np.asarray((weights * energy).sum(axis=1))


def _continued(particles: Particles, values: Array, weights: Array) -> Array:
    """Return values at points at the nodes of their domains, ``(n, k, 3, 3)``.

    They follow the plane through a domain's points where there are enough, else their mean.
    """
    nodes = particles.initial_domains
    whole = weights.sum(axis=1)
    parts = np.divide(weights, whole[:, None], out=np.zeros_like(weights), where=whole[:, None] > 0)
    mean = np.einsum("nq,nqij->nij", parts, values)[:, None]
    gdim = nodes.shape[2]
    if values.shape[1] <= gdim:
        return np.repeat(mean, nodes.shape[1], axis=1)
    places = np.einsum("qk,nki->nqi", particles.undeformed.rule.shapes, nodes)
    middle = np.einsum("nq,nqi->ni", parts, places)[:, None]
    slopes = np.einsum("niq,nqab->niab", np.linalg.pinv(places - middle), values - mean)
    return np.asarray(mean + np.einsum("nki,niab->nkab", nodes - middle, slopes))


def _means(particles: Particles, values: Array, weights: Array) -> Array:
    """Return means over the domains around each node, at the domains' nodes (collective).

    Args:
        particles: The body.
        values: At the nodes of the domains, ``(n, k, 3, 3)``.
        weights: Of the domains, shape ``(n,)``.
    """
    layout, domains = particles.W.dofmap.index_map, particles.domain_nodes
    sums = la.vector(layout, 10)
    table = sums.array.reshape(-1, 10)
    rows = np.concatenate([values.reshape(*domains.shape, 9), np.ones((*domains.shape, 1))], axis=2)
    rows *= weights[:, None, None]
    for column, own in zip(table.T, rows.reshape(-1, 10).T, strict=True):
        column[:] = np.bincount(domains.ravel(), own, len(table))
    sums.scatter_reverse(la.InsertMode.add)
    sums.scatter_forward()
    known = np.where(table[:, 9:] > 0.0, table[:, 9:], 1.0)
    return np.asarray((table[:, :9] / known)[domains].reshape(*domains.shape, 3, 3))
