# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""How pictures look."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import MPMError
from ..parallel.given import is_number
from ..parallel.kinds import require_truths
from ..reals import as_finite
from .fields import LABELS, Field

__all__ = ["Look", "corners", "look_of"]


@dataclass(frozen=True)
class Look:
    """How a picture looks, by keywords of :func:`scene` and :func:`movie`.

    Attributes:
        label: What the colour bar says; the field's name without.
        cmap: Colour map.
        limits: First and last value of the colours; ``None`` in a place is the smallest or
            largest value, in a movie that of the whole run.
        lines: Whether edges of domains are drawn; by default where there are not too many.
        camera: In space, from which side it is seen: anything that pyvista takes as
            ``camera_position``, such as ``"xz"`` or a vector towards the eye.
        title: A line above it.
        box: What is shown instead of all bodies: the lower and the upper corner of a box, shape
            ``(2, gdim)``.
        background: Whether the background is drawn: its cells in the plane; in space its box, if
            that is not much larger than the bodies, or lies in ``box``.
        warp: Factor on the displacement.
    """

    label: str | None = None
    cmap: Any = "viridis"
    limits: tuple[float | None, float | None] | None = None
    lines: bool | None = None
    camera: Any = None
    title: str | None = None
    box: NDArray[np.float64] | None = None
    background: bool = True
    warp: float = 1.0


def look_of(given: Mapping[str, Any], field: Field, gdim: int) -> Look:
    """Return the look that a user gives by keywords.

    Args:
        given: The keywords.
        field: What is shown, which has the label unless another is given.
        gdim: Dimension of the bodies.

    Raises:
        MPMError: There is no such keyword, or its value cannot be.
    """
    known = [each.name for each in fields(Look)]
    for name in given:
        if name not in known:
            raise MPMError(f"A picture has no {name}=; it has {', '.join(known)}.")
    require_truths(Look, (), given)
    own = dict(given)
    if own.get("label") is None:
        name = field if isinstance(field, str) else ""
        own["label"] = LABELS.get(name, name.replace("_", " "))
    own["box"] = corners(given.get("box"), gdim)
    own["limits"] = _ends(given.get("limits"))
    warp = own.get("warp", 1.0)
    if not is_number(warp) or not abs(warp) < np.inf:
        raise MPMError(f"warp must be a finite number, not {warp!r}.")
    return Look(**own)


def corners(box: Any, gdim: int) -> NDArray[np.float64] | None:
    """Return the corners of a box that a user gives, shape ``(2, gdim)``.

    Raises:
        MPMError: It is none.
    """
    if box is None:
        return None
    given = as_finite(box, 2, gdim)
    if given is None or (given[0] >= given[1]).any():
        raise MPMError(
            f"box must be the lower and the upper corner of what is shown, {gdim} coordinates "
            f"each, not {box!r}."
        )
    return given


def _ends(limits: Any) -> tuple[float | None, float | None] | None:
    """Return the first and the last value of colours that a user gives."""
    if limits is None:
        return None
    given = list(limits) if isinstance(limits, list | tuple | np.ndarray) else []
    if len(given) != 2 or not all(v is None or (is_number(v) and abs(v) < np.inf) for v in given):
        raise MPMError(
            "limits must be the first and the last value of the colours, each a number or None, "
            f"not {limits!r}."
        )
    return given[0], given[1]
