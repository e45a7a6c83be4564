# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""How updates of materials are asked for."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from numpy.typing import NDArray

__all__ = ["Asked"]


class Asked:
    """How updates at points are asked for: with tangents, or with an imposed one.

    Args:
        always: Whether tangents are needed for the stress itself.

    Attributes:
        tangents: Whether tangents are.
        imposed: The tangent to have in place of the materials' own, or ``None``.
    """

    def __init__(self, always: bool) -> None:
        self._always = always
        self.tangents = True
        self.imposed: NDArray[np.float64] | None = None

    @contextmanager
    def without_tangents(self) -> Iterator[None]:
        """Let updates in the block be of stress and history alone, where that is enough."""
        self.tangents = self._always
        try:
            yield
        finally:
            self.tangents = True

    @contextmanager
    def with_tangent(self, tangent: NDArray[np.float64] | None) -> Iterator[None]:
        """Let the tangent of the materials be another one in the block; ``None``: their own."""
        self.imposed = tangent
        try:
            yield
        finally:
            self.imposed = None
