# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Methods of a problem that its heirs replace."""

from __future__ import annotations

from typing import Any, ClassVar

from numpy.typing import NDArray

from ..errors import MPMError
from ..parallel.boundary import Hooked, by_itself
from ..particles.particles import Particles

__all__ = ["Hooks"]


class Hooks(Hooked, hooks=True):
    """Methods that a subclass of a problem class may override.

    Attributes:
        bodies: The bodies of the problem.
    """

    bodies: list[Particles]

    #: Where arrays of :meth:`converged_state` live that do not say it; ``None``: they must.
    history_at: ClassVar[str | None] = "cells"

    @by_itself
    def evaluate(self) -> MPMError | None:
        """Update what the forms hold besides the displacement; return why that cannot be.

        Called before each assembly with ``particles.displacement`` set. Must not change the
        history. A ``ConvergenceError`` or ``DomainDistortionError`` refuses this displacement, and
        smaller steps are tried; all else, returned or raised, ends the step. It may differ between
        ranks.
        """
        return None

    def smooth(self) -> bool:
        """Return whether no history changes in the last residual, nor contact (collective).

        Newton steps that let the residual grow are taken on trust then. A problem that overrides
        :meth:`evaluate` or :meth:`commit` has a history, unless it says otherwise here.
        """
        own = type(self)
        return own.evaluate is Hooks.evaluate and own.commit is Hooks.commit

    def commit(self) -> None:
        """Make the last evaluation the converged one."""

    def roll_back(self) -> None:
        """Return to the last converged evaluation."""

    def end_step(self) -> None:
        """Do what is to be done between two steps."""

    def converged_state(self) -> list[dict[str, Any]]:
        """Return the history at the last converged step, for a checkpoint.

        Returns:
            One dictionary for each body: arrays ``(n, ...)`` of its owned particles by name, or
            :class:`mpm_dolfinx.io.Column`, which says where they live. A problem that can be
            split needs the latter.
        """
        return [{} for _ in self.bodies]

    def set_converged_state(self, states: list[dict[str, NDArray[Any]]]) -> None:
        """Make what :meth:`converged_state` once returned the history.

        :meth:`roll_back` is called after it.

        Args:
            states: As returned there.
        """
