# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bodies that lock, known by their mean stress."""

from __future__ import annotations

from collections.abc import Sequence

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

from ..constitutive.points import MaterialPoints
from ..constitutive.recovery import parts, recovered
from ..errors import agree
from ..particles.particles import Particles
from ..tolerances import SMALL
from .body import BodyTerm

__all__ = ["locking"]

type Array = NDArray[np.float64]


def locking(bodies: Sequence[Particles], terms: Sequence[BodyTerm]) -> str | None:
    """Return a warning where bodies lock (collective).

    Where elements cannot keep the volume that their law wants kept, the mean stress goes up and
    down from one point to the next, while the shear stress is even (Hughes 2000, chapter 4). A body
    locks that has mean stresses which differ from a continuous one by more than half of its shear
    stress and by more than twice what shear stresses do, all in the square mean: 0.9 to 160 and
    0.001 to 0.2 of it for what was measured, with and without locking. Averages over patches, and
    pressures of their own, do not. Nor does what round-off leaves of the stress of ground that
    began with one.

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
        stress, smooth = recovered(body, points)
        weights = points.strain.weights * ~body.deleted[:, None]
        up_and_down, uneven, shear = _sizes(
            comm, weights, *parts(stress - smooth), parts(stress)[1]
        )
        if up_and_down > max(0.5 * shear, 2.0 * uneven):
            with agree(comm):
                whole = points.last.cauchy_stress()
            if up_and_down > SMALL * sum(_sizes(comm, weights, *parts(whole))):
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


def _sizes(comm: MPI.Comm, weights: Array, *values: Array) -> Array:
    """Return roots of integrals of squares of numbers at points (collective)."""
    mine = [float(np.sum(weights * value**2)) for value in values]
    return np.asarray(np.sqrt(comm.allreduce(np.array(mine))))
