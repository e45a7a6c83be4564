# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The material point methods by name; a new one is a file of its own and a line here."""

from __future__ import annotations

from .cpdi import CPDI, CPDI2
from .elements import FiniteElements
from .gimp import GIMP, UGIMP
from .method import Method
from .points import Points

__all__ = ["METHODS"]

METHODS: dict[str, type[Method]] = {
    method.name: method for method in (CPDI2, CPDI, GIMP, UGIMP, Points, FiniteElements)
}
