# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Bars that bear an axial force."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Self, override

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError
from ..parallel.boundary import collective
from ..parallel.given import as_positive, is_number
from ..particles.particles import Particles
from .bond import Bond
from .laws import Bar
from .stretching import rule_of
from .structure import State, Structure

__all__ = ["Truss"]


class Truss(Structure):
    """Bars in bodies that bear an axial force: an anchor, a nail, a cable, a geogrid.

    Its nodes follow the bodies that they lie in, at any rotation; its force is ``stiffness`` times
    the stretch less one. With ``degree=1`` a cell touches bodies at its two ends alone, as the free
    length of an anchor. In the plane it is one per thickness, in a body of revolution one per
    length around the axis. It has no mass.

    Give it to a problem as ``terms=[truss]``. In a stage it begins without stress where the bodies
    are then, and what it changes at once (``prestress``) comes over the next run. One that is put
    in place of another, drawn in the same way, goes on with the force of that one.

    Args:
        bodies: The body that it lies in, or several: a node belongs to the first that has it.
        shape: Where it lies in the undeformed bodies: a mesh of lines, or the points of a polyline,
            shape ``(N, gdim)``. Best with one cell for each domain that it goes through.
        stiffness: EA, a force; 0 with a ``prestress`` that is to stay as it is.
        yield_force: Axial force at which it yields, in compression too; ``None``: it is elastic.
        compression: Whether it bears compression; if not it is slack there, as a cable.
        prestress: Axial force at the beginning; ``None``: none, or that of the one before.
        bond: A :class:`Bond` along which it slips; ``None``: it moves with the bodies.
        held: A function of undeformed coordinates, such as ``mpm.region(...)``: nodes there are
            held in space, in a body or beside all, and follow :meth:`move`.
        degree: Of its shape functions, from 1 to 3: with nodes within its cells too it follows the
            bodies there. ``None``: that of the bodies.
        axisymmetric: Whether ``x[0]`` is a radius.

    Raises:
        MPMError: Nodes that lie in no body, curved cells, or numbers that make no sense.
    """

    law: Bar
    results = ("axial_force",)

    @collective()
    def __init__(
        self,
        bodies: Particles | Sequence[Particles],
        shape: Any,
        stiffness: float,
        *,
        yield_force: float | None = None,
        compression: bool = True,
        prestress: float | None = None,
        bond: Bond | None = None,
        held: Callable[..., Any] | None = None,
        degree: int | None = None,
        axisymmetric: bool = False,
    ) -> None:
        if prestress is not None and not (is_number(prestress) and abs(prestress) < np.inf):
            raise MPMError(f"prestress of a Truss must be a number, not {prestress!r}.")
        if not prestress or stiffness != 0.0:
            as_positive(stiffness, "stiffness of a Truss")
        limit = np.inf if yield_force is None else as_positive(yield_force, "yield_force")
        if bond is not None and not isinstance(bond, Bond):
            raise MPMError(f"bond of a Truss is an mpm.Bond, not a {type(bond).__name__}.")
        self._prestress = None if prestress is None else float(prestress)
        law = Bar(float(stiffness), limit, compression)
        super().__init__(bodies, shape, law, degree, False, held, axisymmetric, bond)

    @override
    def _drawn(self) -> State:
        state = super()._drawn()
        if self._prestress is None:
            return state
        pull = np.full_like(state.offset, self._prestress)
        return state._replace(offset=pull, forces=pull[:, :, None])

    @override
    def continued(self, other: Self) -> State:
        state = super().continued(other)
        places = self.layout.nodes + state.reference
        a, b = (rule_of(self.layout, x, 1, False).weights for x in (other.places(), places))
        stretch = (a / b).reshape(-1, 1)
        force = other.law.trial(stretch, state.offset.ravel())
        if self._prestress is not None:
            force = np.full_like(force, self._prestress)
        offset = force - self.law.trial(stretch, np.zeros_like(force))
        return state._replace(offset=offset.reshape(state.offset.shape))

    @property
    def force(self) -> NDArray[np.float64]:
        """Axial force of each cell at the last converged step, tension positive, ``(m,)``."""
        return self._rule.means(self.state.forces)[:, 0]
