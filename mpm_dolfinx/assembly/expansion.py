# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Forms with their derivatives carried out."""

from __future__ import annotations

from collections.abc import Iterator
from functools import singledispatchmethod
from typing import Any

from ufl.algorithms import expand_derivatives

__all__ = ["expanded"]


def expanded(form: Any) -> Any:
    """Return a form or an integrand with its derivatives carried out.

    UFL's traversals dispatch by ``functools.singledispatchmethod``, which with Python 3.13 keeps
    for ever what it was used for: all of the form, down to meshes and their communicators. So what
    was kept is dropped.
    """
    result = expand_derivatives(form)
    for traversal in _traversals():
        for method in vars(traversal).values():
            kept = getattr(method, "_method_cache", None)
            if isinstance(method, singledispatchmethod) and kept is not None:
                kept.clear()
    return result


def _traversals() -> Iterator[type]:
    """Yield the classes of UFL's traversals (since 2025.1)."""
    try:
        from ufl.corealg.dag_traverser import DAGTraverser
    except ImportError:
        return
    classes: list[type] = [DAGTraverser]
    while classes:
        yield classes[-1]
        classes.extend(classes.pop().__subclasses__())
