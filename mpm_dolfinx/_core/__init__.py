# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The compiled loops."""

from __future__ import annotations

from importlib import import_module
from typing import Any

__all__ = ["loops"]


def _load() -> Any:
    try:
        return import_module("mpm_dolfinx._core._loops")
    except ModuleNotFoundError as error:
        raise ImportError(
            "mpm_dolfinx has no compiled loops: it was installed without a C++ compiler; install "
            "one, or a wheel, and then mpm_dolfinx again."
        ) from error


#: The compiled module.
loops: Any = _load()
