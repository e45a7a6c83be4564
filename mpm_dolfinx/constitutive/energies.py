# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Energies of the materials at a body's points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import agree
from .points import MaterialPoints

__all__ = ["elastic_energy", "has_potential", "potential_energy"]


def elastic_energy(points: MaterialPoints, trial: bool = False) -> NDArray[np.float64]:
    """Return the elastic energy per undeformed volume of all points, ``(n nq,)`` (collective).

    Args:
        points: The points.
        trial: Whether it is that of the last update, not of the last converged step. Whoever
            updates lets ranks agree then.

    Returns:
        That of the material, and of what F-bar resists; not a number where a material does not
        know it.
    """
    if trial:
        result = points.trial.strain_energy()
        return result if points.averaging is None else result + points.averaging.energy().ravel()
    with agree(points.strain.particles.mesh.comm):
        result = points.last.strain_energy()
    return result if points.last.resisted is None else result + points.last.resisted


def potential_energy(points: MaterialPoints, trial: bool = False) -> NDArray[np.float64]:
    """Return elastic energy and, where laws know it, plastic work, ``(n nq,)`` (collective).

    Args:
        points: The points.
        trial: As for :func:`elastic_energy`.
    """
    result = elastic_energy(points, trial)
    if trial:
        return result + points.trial.plastic_work()[0]
    with agree(points.strain.particles.mesh.comm):
        return result + points.last.plastic_work()[0]


def has_potential(points: MaterialPoints) -> NDArray[np.bool_]:
    """Return where stresses derive from :func:`potential_energy` over a step, ``(n nq,)``.

    Collective. That is one of F there; with F-bar, of F at the points of a group, which has one
    material. With a pressure of its own that is the stress without it.
    """
    elastic = points.laws.where(lambda part: not part.material.inelastic)
    with agree(points.strain.particles.mesh.comm):
        known = points.last.plastic_work()[1]
    return (elastic | known) & np.isfinite(elastic_energy(points))
