# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Domains with a material: their stress, internal variables and fields for output."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, override

import numpy as np
from numpy.typing import NDArray

from dolfinx import fem

from ..errors import MPMError
from .deletion import Deletion
from .domains import Domains
from .undeformed import Undeformed

__all__ = ["MaterialDomains", "Response"]


class Kinematics(Protocol):
    """Kinematics of the points of a body."""

    @property
    def hoop(self) -> NDArray[np.float64] | None:
        """Hoop strains of the nodes of a body of revolution, or ``None``."""

    def gradient(self) -> NDArray[np.float64]:
        """Return ``F - I`` at the points, shape ``(n, nq, dim, dim)``."""

    def average(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return volume averages of values ``(n, nq, ...)``."""


class Answers(Protocol):
    """Stress and internal variables at a body's points."""

    @property
    def recovery(self) -> NDArray[np.float64] | float:
        """Correction of the mean stress of each domain, shape ``(n, 3, 3)``, or 0."""

    def cauchy_stress(self) -> NDArray[np.float64]:
        """Return the Cauchy stress, shape ``(n, nq, 3, 3)``."""

    def plastic_strain(self) -> NDArray[np.float64]:
        """Return the accumulated plastic strain, shape ``(n, nq)``."""


class Laws(Protocol):
    """Materials of a body's points."""

    @property
    def has_small_strain(self) -> NDArray[np.bool_]:
        """Which points have a law of small strains, shape ``(n nq,)``."""


class Response(Protocol):
    """Material at the points of a body."""

    @property
    def laws(self) -> Laws:
        """The materials."""

    @property
    def strain(self) -> Kinematics:
        """Kinematics of the points."""

    @property
    def last(self) -> Answers:
        """Stress and internal variables at the last converged step."""


class Unknown(Protocol):
    """An unknown of a problem on a body besides its displacement."""

    name: str

    def at_points(self) -> NDArray[np.float64]:
        """Return its values at the points, shape ``(n, nq, ...)``."""

    def from_nodes(self) -> fem.Function | None:
        """Return the Function all over the domains; ``None`` if only points have values."""


class MaterialDomains(Domains):
    """Domains for whose stress and internal variables a response may answer.

    Attributes:
        governed_by: What stands for the problem that was made of them last, ``None`` before one.
    """

    governed_by: object | None = None

    @override
    def _live_on(self, undeformed: Undeformed, deletion: Deletion | None) -> None:
        """Live on another mesh, for whose domains no response answers yet."""
        super()._live_on(undeformed, deletion)
        self._response: Response | None = None
        self._unknowns: Sequence[Unknown] = ()
        self._water: Sequence[Unknown] = ()

    def attach(self, response: Response) -> None:
        """Let a response answer for stress and internal variables."""
        self._response = response

    def attach_unknowns(self, unknowns: Sequence[Unknown]) -> None:
        """Let unknowns of a problem, besides displacements, be among the fields."""
        self._unknowns = unknowns

    def fill_pores(self, water: Sequence[Unknown]) -> None:
        """Let the pores be full of water: the response's stress is effective then.

        Args:
            water: The pore pressure, and parts of it that are fields too; none of a dry body.
        """
        self._water = water

    def _average(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return volume averages of values ``(n, nq, ...)`` over the undeformed domains."""
        if self._response is not None:
            return self._response.strain.average(values)
        weights = self.undeformed.point_volumes()
        parts = weights / weights.sum(axis=1, keepdims=True)
        return np.asarray(np.einsum("nq,nq...->n...", parts, values))

    @property
    def deformation_gradient(self) -> NDArray[np.float64]:
        """Deformation gradient, shape ``(n, 3, 3)`` (volume averages, plane strain in 2-D)."""
        return _in_space(self._average(self._strained()))

    def _strained(self) -> NDArray[np.float64]:
        """Return ``F - I`` at the points, with what its response adds to that of the mesh."""
        if self._response is None:
            return self.displacement_gradient()
        return self._response.strain.gradient()

    @property
    def has_material(self) -> bool:
        """Whether a problem with a material governs these particles."""
        return self._response is not None

    @property
    def stress(self) -> NDArray[np.float64]:
        """Cauchy stress, shape ``(n, 3, 3)`` (volume averages).

        With ``f_bar="patch"`` the part of it that is constant on a patch is
        recovered linearly from the patches around.

        Raises:
            MPMError: The particles have no material (a problem written in UFL).
        """
        last = self._answering("stress").last
        return self._average(last.cauchy_stress()) + last.recovery

    @property
    def plastic_strain(self) -> NDArray[np.float64]:
        """Accumulated plastic strain ``sqrt(2/3) |d eps_p|``, shape ``(n,)``."""
        return self._average(self._answering("plastic strain").last.plastic_strain())

    @property
    def point_stress(self) -> NDArray[np.float64]:
        """Cauchy stress at the quadrature points, shape ``(n, nq, 3, 3)``.

        Raises:
            MPMError: The particles have no material (a problem written in UFL).
        """
        return self._answering("stress").last.cauchy_stress()

    @property
    def point_total_stress(self) -> NDArray[np.float64]:
        """Cauchy stress of the skeleton and the water in it, shape ``(n, nq, 3, 3)``."""
        stress = self.point_stress
        if not self._water:
            return stress
        water = self._water[0].at_points()
        return np.asarray(stress - water[..., None, None] * np.eye(3))

    @property
    def has_small_strain(self) -> NDArray[np.bool_]:
        """Which particles have a law of small strains, shape ``(n,)``."""
        return self._answering("stress").laws.has_small_strain[:: self.num_points]

    @property
    def revolves(self) -> bool:
        """Whether a problem takes it for a body of revolution."""
        return self._response is not None and self._response.strain.hoop is not None

    @property
    def point_plastic_strain(self) -> NDArray[np.float64]:
        """Accumulated plastic strain at the quadrature points, shape ``(n, nq)``."""
        return self._answering("plastic strain").last.plastic_strain()

    @property
    def point_deformation_gradient(self) -> NDArray[np.float64]:
        """Deformation gradient at the quadrature points, shape ``(n, nq, 3, 3)``."""
        return _in_space(self._strained())

    def fields(self) -> dict[str, NDArray[np.float64]]:
        """Return all fields of the particles for output: arrays ``(n, ...)`` by name.

        ``volume_ratio`` and, where there is a material, ``stress`` (Cauchy), ``pressure``
        (mean of the normal stresses, compression positive) and ``plastic_strain``; with
        ``outside="delete"`` also ``deleted`` (1 where a particle is). Unknowns besides the
        displacement stand here by their names, as means over the domains.

        Of a body with water in its pores ``stress`` is the effective stress,
        ``mean_effective_stress`` its mean (compression positive); ``total_stress`` is that less
        ``pore_pressure``. Nothing is called ``pressure`` there. Of an undrained material
        ``excess_pore_pressure`` is what it has found, a part of ``pore_pressure``.
        """
        values = {"volume_ratio": self.volume / self.initial_volume}
        besides = {one.name: one for one in (*self._unknowns, *self._water)}
        unknowns = {name: self._average(one.at_points()) for name, one in besides.items()}
        if self.has_material:
            stress = values["stress"] = self.stress
            mean = -np.trace(stress, axis1=1, axis2=2) / 3.0
            if not self._water:
                values["pressure"] = mean
            else:
                water = unknowns[self._water[0].name]
                values["mean_effective_stress"] = mean
                values["total_stress"] = stress - water[:, None, None] * np.eye(3)
            values["plastic_strain"] = self.plastic_strain
        values = unknowns | values
        if self.deletion is not None:
            values["deleted"] = self.deleted.astype(np.float64)
        return values

    def functions(self) -> dict[str, fem.Function]:
        """Return the fields that have values all over the domains, by name."""
        known = {one.name: one.from_nodes() for one in (*self._unknowns, *self._water)}
        found = {name: one for name, one in known.items() if one is not None}
        return {"displacement": self.displacement, **found}

    def _answering(self, what: str) -> Response:
        if self._response is None:
            raise MPMError(
                f"These particles have no material, so no {what}; give them one with "
                "QuasiStaticProblem, or evaluate your own UFL expression."
            )
        return self._response


def _in_space(gradient: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``I + H`` of gradients ``(..., dim, dim)``, shape ``(..., 3, 3)``."""
    dim = gradient.shape[-1]
    F = np.tile(np.eye(3), (*gradient.shape[:-2], 1, 1))
    F[..., :dim, :dim] += gradient
    return F
