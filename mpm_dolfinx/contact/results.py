# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Results of a contact, at the last converged step."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError
from ..meshes.quadrature import vector_product
from ..reals import as_finite
from ..system.term import Term
from .one_pass import Pass
from .passes import Passes

__all__ = ["Results"]


class Results(Term):
    """Tractions of a contact at points of its (first) body.

    With two passes each bears a share of the load; tractions are those of points that bear all.
    """

    _passes: Passes

    def _every(self) -> list[Pass[Any, Any]]:
        """Return its passes."""
        if not self._passes.every:
            raise MPMError("A contact belongs to no problem yet; give it as terms=[contact].")
        return list(self._passes.every)

    @property
    def points(self) -> NDArray[np.float64]:
        """Positions of this rank's points, shape ``(n, gdim)``."""
        first = self._every()[0]
        return first.told.positions.reshape(-1, first.source.gdim)

    @property
    def gap(self) -> NDArray[np.float64]:
        """Gap at this rank's points, negative where they penetrate, shape ``(n,)``."""
        return self._every()[0].gap.ravel()

    @property
    def pressure(self) -> NDArray[np.float64]:
        """Pressure per undeformed area at this rank's points, shape ``(n,)``."""
        return self._every()[0].told.pressure.ravel()

    @property
    def traction(self) -> NDArray[np.float64]:
        """Traction on the body per undeformed area at this rank's points, shape ``(n, gdim)``."""
        first = self._every()[0]
        return first.told.traction.reshape(-1, first.source.gdim)

    @property
    def area(self) -> NDArray[np.float64]:
        """Undeformed area of this rank's points, shape ``(n,)``."""
        return np.array(self._every()[0].source.weights.ravel())

    @property
    def touches(self) -> NDArray[np.bool_]:
        """Whether each of this rank's points is in contact, shape ``(n,)``."""
        return self._every()[0].told.inside.ravel()

    @property
    def sticks(self) -> NDArray[np.bool_]:
        """Whether each of this rank's points is in contact and does not slip, shape ``(n,)``."""
        told = self._every()[0].told
        return (told.inside & ~told.slips).ravel()

    @property
    def friction_memory(self) -> NDArray[np.float64]:
        """Memory of the law of friction at this rank's points, shape ``(n, k)``."""
        return self._every()[0].rubbed

    def _forces(self) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """Return positions of the points of each pass, and forces there on the (first) body."""
        found = []
        for number, each in enumerate(self._every()):
            share = (1.0 - 2.0 * number) * each.share
            force = share * each.source.weights[:, :, None] * each.told.traction
            gdim = each.source.gdim
            found.append((each.told.positions.reshape(-1, gdim), force.reshape(-1, gdim)))
        return found

    @property
    def reaction(self) -> NDArray[np.float64]:
        """Force on the (first) body, shape ``(gdim,)``, on all ranks (collective).

        That on the other body of a :class:`Pair` is the opposite, as is the moment.
        """
        mine = np.sum([force.sum(axis=0) for _, force in self._forces()], axis=0)
        return np.asarray(self.bodies[0].mesh.comm.allreduce(mine))

    def moment(self, about: Any) -> NDArray[np.float64]:
        """Return the moment of the tractions on the (first) body about a point (collective).

        Args:
            about: Shape ``(gdim,)``.

        Returns:
            Shape ``(1,)`` in the plane, or ``(3,)``, on all ranks.
        """
        gdim = self.bodies[0].mesh.geometry.dim
        centre = as_finite(about, gdim)
        if centre is None:
            raise MPMError(f"A moment is about {gdim} coordinates, not {about!r}.")
        parts = [vector_product(x - centre, force).sum(axis=0) for x, force in self._forces()]
        whole = np.atleast_1d(np.sum(parts, axis=0))
        return np.asarray(self.bodies[0].mesh.comm.allreduce(whole))
