# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The numbers that a body's materials have at the moment."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import agree
from ..materials.base import Material, Parameter
from .assignment import Assignment
from .averaging import VolumeAveraging
from .governed import Governed
from .moduli import resisting_modulus

__all__ = ["Governing", "Numbers"]


class Governing(NamedTuple):
    """Materials at their points with their present numbers, and F-bar's modulus or ``None``."""

    materials: list[Governed]
    modulus: NDArray[np.float64] | None


class Numbers:
    """The parameters of materials, which change while a problem runs, and what depends on them.

    Args:
        laws: The materials at their points.
        averaging: F-bar, which resists with a modulus of theirs, or ``None``.
    """

    def __init__(self, laws: Assignment, averaging: VolumeAveraging | None) -> None:
        self._laws, self._averaging = laws, averaging

    def follow(self) -> None:
        """Take over the present values of parameters that are Functions or Constants (collective).

        Raises:
            MPMError: They are not allowed, or the parameters of a material are other objects than
                when this was made.
        """
        if self._laws.follow_parameters():
            self._resist()

    def present(self) -> Governing:
        """Return the materials with the numbers that they have now, for :meth:`take`."""
        modulus = None if self._averaging is None else self._averaging.modulus
        return Governing(list(self._laws.governed), modulus)

    def take(self, governing: Governing) -> None:
        """Let materials have the numbers again that they once had."""
        self._laws.governed = list(governing.materials)
        if self._averaging is not None and governing.modulus is not None:
            self._averaging.modulus = governing.modulus

    def assume(self, law: Material, name: str, value: Parameter) -> None:
        """Let a material, as it was given, have another number until the next call (collective)."""
        with agree(self._laws.particles.mesh.comm):
            self._laws.assume(law, name, value)
        self._resist()

    def _resist(self) -> None:
        if self._averaging is not None:
            self._averaging.modulus = resisting_modulus(self._laws)
