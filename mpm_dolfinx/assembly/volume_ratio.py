# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The volume ratio averaged over groups of domains, for energies written in UFL."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

import ufl
from dolfinx import fem

from ..constitutive.averaging import LowRankTerm, VolumeAveraging
from ..constitutive.strain import Strain
from ..errors import MPMError
from ..meshes.quadrature import volume_ratio
from ..parallel.compilation import compiled_form
from ..particles.particles import Particles
from .expansion import expanded
from .rules import depends_on, split_by_rule

__all__ = ["AveragedVolumeRatio", "average_in"]

type Array = NDArray[np.float64]


class AveragedVolumeRatio(fem.Function):
    """The mean of J = det F over groups of domains: a piecewise constant Function for energies.

    An energy ``psi(F, Jbar)`` with it, e.g. of ``Fbar = (Jbar / J)**(1/2) F`` (de Souza Neto,
    Peric, Dutko & Owen 1996), or ``psi_iso(F) + U(Jbar)`` (the mean dilatation of Simo, Taylor &
    Pister 1985: displacement, dilatation and pressure of a group, the latter two eliminated), has
    a residual and a tangent that UFL alone does not see, since Jbar depends on the displacement of
    whole groups. :meth:`residual` makes the one; a :class:`ParticleProblem` with that residual
    keeps this Function up to date and adds what its tangent lacks.

    Args:
        particles: The body.
        over: What a group is: ``"domain"`` or ``"patch"``, as in
            ``QuasiStaticProblem(..., f_bar=...)``. J is that at the points of ``particles.dx``.

    Attributes:
        particles: The body.
        groups: The groups of domains.
        pressure: The energy's derivative by Jbar, its mean over the group, piecewise constant:
            for ``psi_iso(F) + U(Jbar)`` minus the pressure.

    Raises:
        MPMError: Domains that such a group is not for.
    """

    def __init__(self, particles: Particles, over: str = "domain") -> None:
        if over not in ("domain", "patch"):
            raise MPMError(f"Unknown over={over!r}; choose 'domain' or 'patch'.")
        space = fem.functionspace(particles.mesh, ("Discontinuous Lagrange", 0))
        super().__init__(space, name="averaged_volume_ratio")
        self.x.array[:] = 1.0
        self.particles = particles
        self.pressure = fem.Function(space, name="volumetric_pressure")
        n = particles.num_local
        self._averaging = VolumeAveraging(
            Strain(particles),
            over,
            np.zeros(n, dtype=np.int64),
            np.zeros(n),
            symmetric=True,
        )
        self.groups = self._averaging.groups
        self._cells = space.dofmap.list[:n, 0]
        self._energy: ufl.Form | None = None

    def residual(self, energy: ufl.Form) -> ufl.Form:
        """Return the derivative of an energy by the displacement, that of Jbar included.

        Args:
            energy: UFL form without test function, in ``particles.displacement`` and this
                Function; the whole energy that depends on it.

        Returns:
            Form in a test function of ``particles.W``.

        Raises:
            MPMError: Something else, or a second energy.
        """
        if not isinstance(energy, ufl.Form) or energy.arguments() or not depends_on(energy, self):
            raise MPMError(
                "residual() needs an energy that depends on the averaged volume ratio: a UFL form "
                "without test functions."
            )
        if self._energy is not None:
            raise MPMError(
                "residual() was called before; give it the whole energy that depends on the "
                "averaged volume ratio at once."
            )
        self._energy = energy
        d, test = self.particles.displacement, ufl.TestFunction(self.particles.W)
        work = self.pressure * self._ratio * self.particles.dx
        form: ufl.Form = ufl.derivative(energy, d, test) + ufl.derivative(work, d, test)
        return form

    @cached_property
    def _ratio(self) -> Any:
        gdim = self.particles.mesh.geometry.dim
        return ufl.det(ufl.Identity(gdim) + ufl.grad(self.particles.displacement))

    @cached_property
    def _forms(self) -> tuple[list[fem.Form], list[fem.Form], list[fem.Form], list[fem.Form]]:
        """The energy by Jbar, twice by Jbar, by Jbar and d, and the volume by d; by domains."""
        d, W = self.particles.displacement, self.particles.W
        element = W.ufl_element()
        each = ufl.TestFunction(self.function_space)
        nodal = ufl.TestFunction(
            fem.functionspace(
                W.mesh, ("Discontinuous Lagrange", element.degree, (element.block_size,))
            )
        )
        one = fem.Function(self.function_space)
        one.x.array[:] = 1.0
        first = ufl.derivative(self._energy, self, each)
        return (
            self._compile(first),
            self._compile(ufl.derivative(first, self, one)),
            self._compile(ufl.derivative(ufl.derivative(self._energy, d, nodal), self, one)),
            self._compile(ufl.derivative(self._ratio * self.particles.dx, d, nodal)),
        )

    def _compile(self, form: ufl.Form) -> list[fem.Form]:
        form = expanded(form)
        return [compiled_form(part) for part in split_by_rule(form, self.particles.displacement)]

    def _of_domains(self, forms: list[fem.Form], shape: tuple[int, ...] = ()) -> Array:
        """Return the integrals of forms over the owned domains, shape ``(n, *shape)``."""
        n = self.particles.num_local
        total = np.zeros((n, *shape))
        for form in forms:
            total += fem.assemble_vector(form).array[: total.size].reshape(total.shape)
        total[self.particles.deleted] = 0.0
        return total

    def _group_sum(self, values: Array) -> Array:
        """Return the integral of values at points over each owned domain's group (collective)."""
        integrals = (self.particles.undeformed.point_volumes() * values).sum(axis=1)
        sums = self._averaging.groups.sum(np.where(self.particles.deleted, 0.0, integrals))
        return np.where(self.particles.deleted, integrals, sums)

    def update(self) -> None:
        """Set this Function and the pressure for the present displacement (collective)."""
        ratio = volume_ratio(self.particles.displacement_gradient())
        volume = self._group_sum(np.ones_like(ratio))
        self.x.array[self._cells] = self._group_sum(ratio) / volume
        self.x.scatter_forward()
        force = self._averaging.groups.sum(self._of_domains(self._forms[0]))
        self.pressure.x.array[self._cells] = force / volume
        self.pressure.x.scatter_forward()

    def linearise(self) -> LowRankTerm:
        """Return the part of the present tangent that UFL's derivative lacks (collective)."""
        _, twice, mixed, slope = self._forms
        shape = (self.particles.domain_nodes.shape[1], self.particles.mesh.geometry.dim)
        groups = self._averaging.groups
        volume = self._group_sum(np.ones_like(self.particles.undeformed.point_volumes()))
        g = self._of_domains(slope, shape) / volume[:, None, None]
        cross = self._of_domains(mixed, shape)
        h = groups.sum(self._of_domains(twice))
        return LowRankTerm.of(groups, h, g, cross, cross)


def average_in(residual: Any) -> AveragedVolumeRatio | None:
    """Return the averaged volume ratio that a residual holds, if any.

    Raises:
        MPMError: The residual was not made by :meth:`AveragedVolumeRatio.residual`, or holds
            several.
    """
    coefficients = residual.coefficients() if isinstance(residual, ufl.Form) else ()
    ratios = [c for c in coefficients if isinstance(c, AveragedVolumeRatio)]
    if len(ratios) > 1:
        raise MPMError("A residual may hold one averaged volume ratio, not several.")
    if any(all(c is not ratio.pressure for c in coefficients) for ratio in ratios):
        raise MPMError(
            "The residual holds an averaged volume ratio without its variation; write it with "
            "its residual(energy)."
        )
    return ratios[0] if ratios else None
