# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The compiled loops, where they were built."""

from __future__ import annotations

from importlib import import_module
from typing import Any

__all__ = ["loops"]


def _load() -> Any:
    try:
        return import_module("mpm_dolfinx._core._loops")
    except ImportError:
        return None


#: The compiled module; ``None`` where the package was installed without a C++ compiler.
loops: Any = _load()
