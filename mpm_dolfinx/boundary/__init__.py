# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Supports on the body's own boundary, which need not lie on lines of the background.

A support pushes back with a traction on facets of the body,

    t = -penalty M / h (n . d - value) n,

M a modulus of the material and h the thickness of the domain behind the facet (its volume over
the facet's area), so that ``penalty`` is a number without unit. The term is symmetric and its
error, a gap of ``strain h / penalty``, is far below that of the domains' displacement.
"""

from .supports import Support, dashpot, fixed, roller

__all__ = ["Support", "dashpot", "fixed", "roller"]


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted(__all__)
