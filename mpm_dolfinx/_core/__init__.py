# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The compiled loops, and what they may take for an object of Python."""

from __future__ import annotations

from hashlib import sha256
from importlib import import_module
from pathlib import Path
from typing import Any

__all__ = ["is_as_inherited", "loops"]


def _digest() -> str:
    """Return the digest of the sources beside this file, as CMakeLists.txt does; or nothing."""
    here = Path(__file__).parent
    files = sorted([*here.glob("*.cpp"), *here.glob("*.h")])
    each = [sha256(file.read_bytes()).hexdigest() for file in files]
    return sha256("".join(each).encode()).hexdigest() if each else ""


def _load() -> Any:
    try:
        found = import_module("mpm_dolfinx._core._loops")
    except ModuleNotFoundError as error:
        raise ImportError(
            "mpm_dolfinx has no compiled loops: it was installed without a C++ compiler; install "
            "one, or a wheel, and then mpm_dolfinx again."
        ) from error
    require_of(_digest(), getattr(found, "sources", ""))
    return found


def require_of(sources: str, made_of: str) -> None:
    """Raise an error where the compiled loops are not those of the sources beside them.

    Args:
        sources: What these are known by; empty where there are none, as in a wheel.
        made_of: What the loops were made of, as they say; nothing where they do not know.

    Raises:
        ImportError: They are out of date, and would take wrong arguments.
    """
    if sources and made_of and sources != made_of:
        raise ImportError(
            "The compiled loops of mpm_dolfinx are of other sources than those beside them in "
            "mpm_dolfinx/_core; install mpm_dolfinx again, which compiles them."
        )


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
