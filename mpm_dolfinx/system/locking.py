# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bodies that lock, known by their mean stress."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..constitutive.points import MaterialPoints
from ..constitutive.recovery import recovered
from ..errors import agree
from ..particles.particles import Particles
from ..tolerances import SMALL
from .body import BodyTerm

__all__ = ["locking"]


def locking(bodies: Sequence[Particles], terms: Sequence[BodyTerm]) -> str | None:
    """Return a warning where bodies lock (collective).

    Where elements cannot keep the volume that their law wants kept, the mean stress goes up and
    down from one point to the next, while the shear stress is even (Hughes 2000, section 4.3). A
    body locks that has mean stresses which differ from a continuous one by more than half of its
    shear stress and by more than twice what shear stresses do, all in the square mean: 1.4 to 160
    and 0.01 to 0.2 for what was measured, with and without locking. Averages over patches, and
    pressures of their own, do not.

    Args:
        bodies: The bodies.
        terms: What each is made of and loaded by.
    """
    found = []
    for number, (body, term) in enumerate(zip(bodies, terms, strict=False)):
        points = term.forms.internal
        if not isinstance(points, MaterialPoints) or points.mean_stress is not None:
            continue
        if points.averaging is not None and points.averaging.kind == "patch":
            continue
        comm = body.mesh.comm
        with agree(comm):
            whole = points.last.cauchy_stress()
        stress, smooth = recovered(body, points)
        weights = points.strain.weights * ~body.deleted[:, None]
        every = (stress - smooth, stress, whole)
        sums = np.array([np.sum(weights * _squares(part), axis=(1, 2)) for part in every])
        up_and_down, uneven, _, shear, *sizes = np.sqrt(comm.allreduce(sums).ravel())
        if up_and_down > max(0.5 * shear, 2.0 * uneven, SMALL * sum(sizes)):
            found.append((f"body {number}", up_and_down / shear))
    if not found:
        return None
    names = " and of ".join(name for name, _ in found) if len(bodies) > 1 else "the body"
    return (
        f"The mean stress of {names} goes up and down between particles by "
        f"{max(share for _, share in found):.2g} times the shear stress, as where elements lock: "
        "too stiff, with limit loads and factors of safety that are too high, perhaps by several "
        "times. Take f_bar='patch', or with degree 2 mixed='pressure'."
    )


def _squares(stress: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return squares of the mean and of the deviator of stresses, shape ``(2, n, nq)``."""
    mean = np.trace(stress, axis1=2, axis2=3) / 3.0
    deviator = stress - mean[..., None, None] * np.eye(3)
    return np.array([mean**2, np.einsum("nqij,nqij->nq", deviator, deviator)])
