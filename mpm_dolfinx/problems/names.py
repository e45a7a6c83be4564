# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Names of a problem's attributes, which a user's subclass may not take for its own."""

from __future__ import annotations

import inspect
from typing import Any

from ..errors import MPMError
from ..parallel.given import is_ours
from ..system.hooks import Hooks

__all__ = ["OwnNames"]


class OwnNames:
    """A class whose attributes stay its own where users derive from it.

    An attribute that this package sets is refused to all others: before it is set, afterwards, and
    in the bodies of their classes. So is what cannot be called in the place of a method.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute, unless its name is that of another one.

        Raises:
            MPMError: A subclass takes one of this package, or has taken it before.
        """
        ours = vars(self).setdefault("_set_by_us", {"_set_by_us"})
        classes = [(is_ours(each.__module__), vars(each)) for each in type(self).__mro__]
        # (CPython has frames; one that is kept would keep itself, and all that its callers know)
        if is_ours(inspect.currentframe().f_back.f_globals.get("__name__", "")):  # type: ignore[union-attr]
            taken = name in vars(self).keys() - ours
            taken = taken or any(name in each for our, each in classes if not our)
            ours.add(name)
        else:
            stands = [each[name] for our, each in classes if our and name in each]
            method = all(callable(each) for each in stands) and callable(value)
            taken = name in ours or (bool(stands) and not method and name not in vars(Hooks))
        if taken:
            raise MPMError(
                f"The name '{name}' is one of this package's in a {type(self).__name__}; "
                "give the attribute of your class another one."
            )
        super().__setattr__(name, value)
