# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Forces of structures by their stretches: of bars, and of sheets.

Both are linear in the stretch less one (Biot's strain), in which a stiffness is what it is called:
force over elongation per length.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["Bar", "Law", "Response", "Sheet"]


class Response(NamedTuple):
    """Forces at points.

    Attributes:
        forces: Per undeformed width, by principal stretches, shape ``(n, c)``.
        tangent: Their derivatives by these, shape ``(n, c, c)``.
        offset: Force at no stretch from here on, shape ``(n,)``: what prestress and yielding leave.
        special: Whether points yield or are slack, shape ``(n,)``.
    """

    forces: NDArray[np.float64]
    tangent: NDArray[np.float64]
    offset: NDArray[np.float64]
    special: NDArray[np.bool_]


class Law(Protocol):
    """Forces by principal stretches."""

    @property
    def compression(self) -> bool:
        """Whether it bears compression."""

    def respond(self, stretch: NDArray[np.float64], offset: NDArray[np.float64]) -> Response:
        """Return the forces.

        Args:
            stretch: Principal stretches, shape ``(n, c)``.
            offset: Force at no stretch at the last converged step, shape ``(n,)``.
        """


class Bar(NamedTuple):
    """An axial force of a bar, elastic up to a force at which it yields.

    Attributes:
        stiffness: EA.
        yield_force: Largest axial force.
        compression: Whether it bears compression; else it is slack there.
    """

    stiffness: float
    yield_force: float
    compression: bool

    def trial(
        self, stretch: NDArray[np.float64], offset: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the force without any limit, shape ``(n,)``."""
        return np.asarray(offset + self.stiffness * (stretch[:, 0] - 1.0))

    def respond(self, stretch: NDArray[np.float64], offset: NDArray[np.float64]) -> Response:
        """Return the forces; see :class:`Law`."""
        trial = self.trial(stretch, offset)
        least = -self.yield_force if self.compression else -np.inf
        yielded = np.clip(trial, least, self.yield_force)
        force = yielded if self.compression else np.maximum(yielded, 0.0)
        left = offset + (yielded - trial)
        tangent = np.where(force == trial, self.stiffness, 0.0)
        return Response(force[:, None], tangent[:, None, None], left, force != trial)


class Sheet(NamedTuple):
    """Forces of a thin isotropic sheet per width, in plane stress.

    Attributes:
        stiffness: Young's modulus times thickness.
        poisson: Poisson's ratio.
        compression: Whether it bears compression; else it wrinkles, or is slack.
    """

    stiffness: float
    poisson: float
    compression: bool

    def respond(self, stretch: NDArray[np.float64], offset: NDArray[np.float64]) -> Response:
        """Return the forces; see :class:`Law`."""
        n, (e, nu) = len(stretch), self[:2]
        strain = stretch - 1.0
        D = e / (1.0 - nu**2) * np.array([[1.0, nu], [nu, 1.0]])
        forces, tangent = strain @ D, np.broadcast_to(D, (n, 2, 2)).copy()
        special = np.zeros(n, dtype=bool)
        if not self.compression:
            for one, other in ((0, 1), (1, 0)):
                # taut along one axis, wrinkled across: no force there, whatever the width
                across = (forces[:, other] < 0.0) & (strain[:, one] >= strain[:, other])
                special |= across
                taut = e * (strain[:, one] > 0.0)
                forces[across] = 0.0
                forces[across, one] = (taut * strain[:, one])[across]
                tangent[across] = 0.0
                tangent[across, one, one] = taut[across]
        return Response(forces, tangent, offset, special)
