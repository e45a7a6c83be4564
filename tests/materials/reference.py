# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Independent references: one point at a time, matrix functions of SciPy."""

import numpy as np
from scipy.linalg import expm, logm


def rotation(angle, axis=(0.0, 0.0, 1.0)):
    """Return a rotation about an axis, (3, 3), by the formula of Rodrigues."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    spin = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * spin + 2.0 * np.sin(0.5 * angle) ** 2 * spin @ spin


def embed(H):
    """Return displacement gradients (n, dim, dim) as (n, 3, 3)."""
    full = np.zeros((len(H), 3, 3))
    full[:, : H.shape[1], : H.shape[1]] = H
    return full


def moduli(young, poisson):
    """Return bulk and shear modulus."""
    return young / (3 * (1 - 2 * poisson)), young / (2 * (1 + poisson))


def dev(A):
    """Return the deviator of a tensor (3, 3)."""
    return A - np.trace(A) * np.eye(3) / 3


def von_mises_path(path, young, poisson, rho_y, hardening):
    """Return Kirchhoff stress, first Piola stress and plastic strain at the end of a path.

    Args:
        path: Deformation gradients (steps, 3, 3) of one point.
        young: Young's modulus.
        poisson: Poisson's ratio.
        rho_y: Norm of the deviator at first yield.
        hardening: d(uniaxial stress)/d(plastic strain).
    """
    K, G = moduli(young, poisson)
    F_old, b, kappa = np.eye(3), np.eye(3), 0.0
    for F in path:
        f = F @ np.linalg.inv(F_old)
        eps = 0.5 * np.real(logm(f @ b @ f.T))
        e = dev(eps)
        rho = rho_y + np.sqrt(2 / 3) * hardening * kappa
        excess = 2 * G * np.linalg.norm(e) - rho
        if excess > 0:
            flow = excess / (2 * G + 2 / 3 * hardening)
            eps = eps - flow * e / np.linalg.norm(e)
            kappa += np.sqrt(2 / 3) * flow
        b, F_old = np.real(expm(2 * eps)), F
        tau = K * np.trace(eps) * np.eye(3) + 2 * G * dev(eps)
    return tau, tau @ np.linalg.inv(F_old).T, kappa
