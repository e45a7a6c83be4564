# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Numbers, tuples and tags of a user, as UFL on the body mesh."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import ufl
from dolfinx import fem, mesh

from .errors import MPMError
from .particles import Particles

__all__ = ["as_expression", "facet_measure", "known_tags"]


def as_expression(value: Any, particles: Particles, name: str, shape: tuple[int, ...]) -> Any:
    """Return a value as a UFL expression on the body mesh.

    Args:
        value: Numbers or UFL.
        particles: The body.
        name: What it is called in a message.
        shape: The shape that it must have.

    Raises:
        MPMError: It is something else, not finite, of another shape, or on another mesh.
    """
    if not isinstance(value, ufl.core.expr.Expr):
        try:
            array = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError):
            raise MPMError(f"{name} must be numbers or a UFL expression, not {value!r}.") from None
        if not np.all(np.isfinite(array)):
            raise MPMError(f"{name} must be finite, not {value!r}.")
        if name == "density" and array.ndim == 0 and array < 0.0:
            raise MPMError(f"density must not be negative, not {value!r}.")
        value = fem.Constant(particles.mesh, array)
    if value.ufl_shape != shape:
        raise MPMError(f"{name} has the shape {value.ufl_shape}, but must have {shape}.")
    for domain in ufl.domain.extract_domains(value):
        if domain != particles.mesh.ufl_domain():
            raise MPMError(f"{name} lives on another mesh; write it on the body mesh.")
    return value


def known_tags(particles: Particles, facet_tags: Any, what: str) -> set[int]:
    """Return the tags of a body's facets on all ranks (collective).

    Raises:
        MPMError: They are no tags of facets.
    """
    body = particles.mesh
    if not isinstance(facet_tags, mesh.MeshTags) or facet_tags.dim != body.topology.dim - 1:
        raise MPMError(f"{what} need facet_tags=, tags of the body's facets.")
    return set().union(*body.comm.allgather({int(t) for t in np.unique(facet_tags.values)}))


def facet_measure(
    particles: Particles, facet_tags: Any, loads: Sequence[tuple[Any, int]], what: str
) -> ufl.Measure:
    """Return the measure on a body's tagged facets, for pairs of a value and a tag.

    Raises:
        MPMError: Something else than such pairs, or tags that are none.
    """
    known = known_tags(particles, facet_tags, what)
    for load in loads:
        if not isinstance(load, tuple) or len(load) != 2 or load[1] not in known:
            raise MPMError(
                f"{what} are pairs of a value and a facet tag among {sorted(known)}, not {load!r}."
            )
    return ufl.Measure(
        "ds",
        domain=particles.mesh,
        subdomain_data=facet_tags,
        metadata=particles.dx_exact.metadata(),
    )
