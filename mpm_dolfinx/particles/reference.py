# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The undeformed state that a body's mesh is counted from."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..meshes.remesh import Column

__all__ = ["Reference"]


class Reference(NamedTuple):
    """The undeformed body, as far as a body mesh that was made anew does not show it.

    Attributes:
        gradient: ``F - I`` of the mesh where it is not displaced, at the history's points, shape
            ``(n, nq, gdim, gdim)``.
        volume: Undeformed volume of each domain, shape ``(n,)``.
        averages: Averages of the shape functions over the undeformed domains, shape ``(n, k)``.
        domains: Undeformed nodes of each domain, shape ``(n, k, gdim)``.
    """

    gradient: NDArray[np.float64]
    volume: NDArray[np.float64]
    averages: NDArray[np.float64]
    domains: NDArray[np.float64]

    def columns(self) -> dict[str, Column]:
        """Return all of it by the names of a checkpoint."""
        return {
            "reference gradient": Column(self.gradient, "points"),
            "reference volume": Column(self.volume, "cells"),
            "reference averages": Column(self.averages, "cells"),
            "reference domains": Column(self.domains, "nodes"),
        }
