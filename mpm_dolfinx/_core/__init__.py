# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The compiled loops, and what they may take for an object of Python."""

from __future__ import annotations

from importlib import import_module
from typing import Any

__all__ = ["is_as_inherited", "loops"]


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


def is_as_inherited(one: object, name: str) -> bool:
    """Return whether nothing is changed of the class that an attribute of an object is of.

    What knows a class by heart, such as a compiled loop that a class names, does not ask its
    methods: an heir that overrides any of them, or an object with one of its own, is another thing.

    Args:
        one: The object.
        name: The attribute.
    """
    heirs: list[type] = []
    for its in type(one).__mro__:
        if name in vars(its):
            changed = {other for heir in heirs for other in vars(heir) if hasattr(its, other)}
            changed |= {
                own for own in getattr(one, "__dict__", ()) if callable(getattr(its, own, None))
            }
            return all(other.startswith("__") or other == "_abc_impl" for other in changed)
        heirs.append(its)
    return False
