# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Thin sheets that bear forces in their plane."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Self, override

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError
from ..parallel.boundary import collective
from ..parallel.given import as_positive, is_number
from ..particles.particles import Particles
from .laws import Sheet
from .structure import State, Structure

__all__ = ["Membrane"]


class Membrane(Structure):
    """A thin elastic sheet in bodies or on their boundary: a geotextile, a lining, a skin.

    It bears forces in its plane and bends without any. Its nodes follow the bodies that they lie
    in, and it turns with them at any rotation. In space it is a surface; in the plane a line is the
    section of a sheet that does not stretch out of it, and in a body of revolution that of one
    which bears forces around the axis too. It has no mass.

    A lining on facets of a body is drawn by ``dolfinx.mesh.create_submesh`` of these. Give the
    membrane to a problem as ``terms=[membrane]``. In a stage it begins without stress where the
    bodies are then, or goes on as an equal one that is drawn alike.

    Args:
        bodies: The body that it lies in, or several: a node belongs to the first that has it.
        shape: Where it lies in the undeformed bodies: a mesh of lines in the plane, or of triangles
            or quadrilaterals in space; in the plane the points of a polyline too, ``(N, 2)``.
        stiffness: Young's modulus times thickness, a force per length.
        poisson: Poisson's ratio.
        compression: Whether it bears compression; if not it wrinkles there, or is slack.
        held: A function of undeformed coordinates, such as ``mpm.region(...)``: nodes there are
            held in space, in a body or beside all, and follow :meth:`move`.
        degree: Of its shape functions, from 1 to 3; ``None``: that of the bodies.
        axisymmetric: Whether ``x[0]`` is a radius.

    Raises:
        MPMError: Nodes that lie in no body, curved cells, or numbers that make no sense.
    """

    results = ("membrane_force", "membrane_force_across")

    @collective()
    def __init__(
        self,
        bodies: Particles | Sequence[Particles],
        shape: Any,
        stiffness: float,
        poisson: float = 0.0,
        *,
        compression: bool = True,
        held: Callable[..., Any] | None = None,
        degree: int | None = None,
        axisymmetric: bool = False,
    ) -> None:
        as_positive(stiffness, "stiffness of a Membrane")
        if not is_number(poisson) or not -1.0 < poisson < 1.0:
            raise MPMError(f"poisson of a Membrane must be between -1 and 1, not {poisson!r}.")
        law = Sheet(float(stiffness), float(poisson), compression)
        super().__init__(bodies, shape, law, degree, True, held, axisymmetric)
        if self.layout.dim < self.nodes.shape[1] - 1:
            raise MPMError("A Membrane in space is a surface; a line there is a Truss.")

    @override
    def continued(self, other: Self) -> State:
        if other.law != self.law:
            raise MPMError(
                "A Membrane cannot go on as one that is drawn like it with other stiffness, "
                "poisson or compression; draw it in other cells, or take that one away before."
            )
        return super().continued(other)

    @property
    def force(self) -> NDArray[np.float64]:
        """Principal forces per width of each cell at the last converged step, shape ``(m, 2)``.

        Of a surface the larger and the smaller; of a line that along it, and that around the axis
        or out of the plane. Means over the cell's points.
        """
        return self._rule.means(self.state.forces)
