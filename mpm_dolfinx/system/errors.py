# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The estimated error of the last converged step, body by body."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..assembly.petsc import absolute
from ..constitutive.moduli import bulk_and_shear_moduli
from ..constitutive.points import MaterialPoints
from ..constitutive.recovery import parts, stress_errors
from ..errors import MPMError
from ..particles.particles import Particles
from ..tolerances import SMALL, UNCERTAIN
from .body import BodyTerm
from .conditions import fixed_dofs
from .estimate import nodal_errors, shares_of_domains
from .reduced import ReducedSystem

__all__ = ["Errors", "estimated"]


class Errors(NamedTuple):
    """Errors of a state of equilibrium, in energy.

    Attributes:
        nodal: What the background cannot do: squares of energies at this rank's own nodes of W of
            each body, shape ``(N,)``.
        own: What the bodies' own elements cannot: those of this rank's own domains, ``(n,)``.
        energy: Square of the energy norm of all bodies' deformation.
        flow: Share of the distortion that is plastic flow, by the work that stress would do on it.
    """

    nodal: Sequence[NDArray[np.float64]]
    own: Sequence[NDArray[np.float64]]
    energy: float
    flow: float = 0.0

    @property
    def doubt(self) -> str | None:
        """A warning where much of the deformation is flow, of which stress tells little."""
        if self.flow <= UNCERTAIN:
            return None
        return (
            "More than a tenth of the distortion is plastic flow. The estimated error is that of "
            "the stress; strains, and displacements with them, may err by several times as much."
        )

    def total(self, bodies: Sequence[Particles]) -> float:
        """Return the error over the size of the deformation (collective)."""
        mine = sum(float(values.sum()) for values in (*self.nodal, *self.own))
        whole = bodies[0].mesh.comm.allreduce(mine)
        return float(np.sqrt(whole / self.energy)) if self.energy > 0.0 else 0.0

    def of_particles(self, number: int, particles: Particles) -> NDArray[np.float64]:
        """Return the share of each particle of a body, of which squares add up (collective)."""
        parts = shares_of_domains(particles, self.nodal[number]) + self.own[number]
        return np.sqrt(parts / self.energy) if self.energy > 0.0 else np.zeros(len(parts))


def estimated(
    bodies: Sequence[Particles],
    terms: Sequence[BodyTerm],
    reduced: ReducedSystem,
    size: float | None = None,
) -> Errors:
    """Return the errors of the last converged step (collective).

    Args:
        bodies: The bodies.
        terms: What each is made of and loaded by.
        reduced: Their system.
        size: Of the forces on their nodes in that step, by which these are known again; ``None``:
            they are those.

    Raises:
        MPMError: Forces are others than in that step.
    """
    forces = reduced.terms.nodal_forces()
    if (failure := reduced.terms.update()) is not None:
        raise failure
    now = reduced.terms.size_of_forces()
    if size is not None and abs(now - size) > SMALL * reduced.terms.size_of_contributions():
        reduced.terms.roll_back()
        raise MPMError(
            f"The forces on the bodies, {now:.6g} in all, are not those of the last converged step "
            f"any more, {size:.6g}, of which error() tells: loads, conditions or obstacles have "
            "been changed since; ask before, or set them as they were."
        )
    nodal, own, sizes = [], [], np.zeros(3)
    for body, term, force in zip(bodies, terms, forces, strict=False):
        field = next(field for field in reduced.fields if any(b is body for b in field.bodies))
        free = _unprescribed(body, list(field.prescribed))
        nodal.append(nodal_errors(body, reduced.terms, force, free))
        points = term.forms.internal
        if isinstance(points, MaterialPoints):
            moduli = bulk_and_shear_moduli(points.laws)
            own.append(stress_errors(body, points, moduli))
            sizes += _sizes(body, points, moduli[1])
        else:
            own.append(np.zeros(body.num_local))
            inner = force - term.forms.external.array_r
            sizes[0] += float(inner @ body.converged_displacement[: len(force)])
    reduced.terms.roll_back()
    energy, distortion, flow = bodies[0].mesh.comm.allreduce(sizes)
    return Errors(nodal, own, abs(float(energy)), float(flow / distortion) if flow > 0.0 else 0.0)


def _unprescribed(body: Particles, conditions: Sequence[fem.DirichletBC]) -> NDArray[np.float64]:
    """Return which share of the weights of own rows of T is on free dofs of V (collective)."""
    T = absolute(body.T)
    weights = T.createVecRight()
    weights.set(1.0)
    every = (T * weights).array_r
    weights.array_w[:] = ~fixed_dofs(conditions, body.V)
    free = (T * weights).array_r
    return np.asarray(np.where(every > 0.0, free / np.where(every > 0.0, every, 1.0), 0.0))


def _sizes(
    body: Particles, points: MaterialPoints, shear: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return this rank's part of the square of a body's energy norm, and of what that consists.

    With parts of the mean and of the deviator of ``tau``, beyond the stress that the body began
    with, and of ``ln V`` it is the integral of ``|p v| + |s| |e|``: twice the energy of an
    isotropic elastic body of Hencky's law; and where plastic flow has left strain, it does not
    vanish as the body is unloaded.

    Args:
        body: The body.
        points: Its material.
        shear: The shear modulus of each point.

    Returns:
        That square; the part of distortion in it, the integral of ``|s| |e|``; and what plastic
        flow has of this, where there was any, ``|s| (|e| - |s| / 2 mu)``.
    """
    F = body.point_deformation_gradient
    squares, axes = np.linalg.eigh(F @ F.swapaxes(-1, -2))
    strain = np.einsum("nqik,nqk,nqjk->nqij", axes, 0.5 * np.log(squares), axes)
    stress = np.linalg.det(F)[..., None, None] * points.last.gained_stress(F)
    (p, s), (v, e) = (parts(tensor) for tensor in (stress, strain))
    elastic = s / (2.0 * shear.reshape(s.shape))
    flows = points.last.plastic_strain() > 0.0
    densities = np.array([3.0 * np.abs(p * v) + s * e, s * e, flows * s * (e - elastic)])
    return np.asarray((points.strain.weights * densities)[:, ~body.deleted].sum(axis=(1, 2)))
