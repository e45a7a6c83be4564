# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The standard material point method: particles are points."""

from __future__ import annotations

from typing import override

from ..background.basis import BackgroundBasis
from .method import CornerBasis, DomainState, Method, affine

__all__ = ["Points"]


class Points(Method):
    """The background at the particle alone (Sulsky, Chen & Schreyer 1994).

    Its domains are parallelograms of the particle's volume, for pictures and integrals over the
    undeformed body.
    """

    name = "mpm"

    @override
    def rows(self, state: DomainState, background: BackgroundBasis) -> CornerBasis:
        basis = background.at(state.particles.centroid, gradients=True)
        return CornerBasis(state.parallelograms(), affine(state, state.arms(), basis))
