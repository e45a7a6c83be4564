# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Which problem governs bodies: the one that was made of them last."""

from __future__ import annotations

from collections.abc import Sequence

from ..errors import MPMError
from ..particles.particles import Particles

__all__ = ["Reign"]


class Reign:
    """The government of bodies by a problem, from now on and until another one is made of them.

    Args:
        bodies: The bodies.
    """

    def __init__(self, bodies: Sequence[Particles]) -> None:
        self._bodies, self._token = bodies, object()
        for body in bodies:
            body.governed_by = self._token

    @property
    def holds(self) -> bool:
        """Whether no later problem was made of the bodies."""
        return all(body.governed_by is self._token for body in self._bodies)

    def require(self) -> None:
        """Raise an error where a later problem has taken a body over."""
        if not self.holds:
            raise MPMError(
                "Another problem was made of these particles since, and governs them now; go on "
                "with that one, or give each problem particles of its own."
            )
