# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Moduli of a body's materials where nothing is strained."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import agree
from .assignment import Assignment

__all__ = [
    "axial_modulus",
    "bulk_and_shear_moduli",
    "mean_shear_modulus",
    "resisting_modulus",
    "undeformed_tangent",
]

type Array = NDArray[np.float64]


def undeformed_tangent(laws: Assignment) -> Array:
    """Return dP/dF of all points, shape ``(n nq, dim, dim, dim, dim)``.

    Args:
        laws: The materials at the points.
    """
    result = np.zeros((laws.num_points, *(laws.dim,) * 4))
    for part in laws.governed:
        result[part.points] = part.undeformed_tangent()
    return result


def bulk_and_shear_moduli(laws: Assignment) -> tuple[Array, Array]:
    """Return bulk and shear modulus of all points, shape ``(n nq,)`` each (collective)."""
    with agree(laws.particles.mesh.comm):
        tangent = undeformed_tangent(laws)
    shear = tangent[:, 0, 1, 0, 1]
    return tangent[:, 0, 0, 0, 0] - 4.0 / 3.0 * shear, shear


def mean_shear_modulus(laws: Assignment, volumes: Array) -> float:
    """Return the mean shear modulus of a body (collective).

    Args:
        laws: The materials at its points.
        volumes: Undeformed volumes of the points, shape ``(n, nq)``.
    """
    own = volumes.ravel()
    shear = bulk_and_shear_moduli(laws)[1]
    whole, volume = laws.particles.mesh.comm.allreduce(np.array([own @ shear, own.sum()]))
    return float(whole / volume)


def axial_modulus(laws: Assignment) -> Array:
    """Return the largest modulus of each domain in one direction, shape ``(n,)`` (collective)."""
    with agree(laws.particles.mesh.comm):
        tangent = undeformed_tangent(laws)
    largest = np.einsum("niiii->ni", tangent).max(axis=1, initial=0.0)
    return np.asarray(laws.by_domain(largest).mean(axis=1))


def resisting_modulus(laws: Assignment) -> Array:
    """Return three times the shear modulus of each domain, shape ``(n,)`` (collective)."""
    modulus = np.zeros(laws.particles.num_local)
    with agree(laws.particles.mesh.comm):
        for part in laws.governed:
            shear = part.undeformed_tangent()[:, 0, 1, 0, 1]
            modulus[part.points // laws.particles.num_points] = 3.0 * shear
    return modulus
