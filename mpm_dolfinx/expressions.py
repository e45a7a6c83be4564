# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Numbers, tuples and tags of a user, as UFL on the body mesh."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import ufl
from dolfinx import fem, mesh

from . import _compat
from .errors import MPMError, agree
from .materials import Material
from .particles import Particles

__all__ = ["as_expression", "carried", "facet_measure", "holds", "known_tags", "require_movable"]


def as_expression(value: Any, particles: Particles, name: str, shape: tuple[int, ...]) -> Any:
    """Return a value as a UFL expression on the body mesh.

    Args:
        value: Numbers or UFL, or a function that makes UFL from the body mesh.
        particles: The body.
        name: What it is called in a message.
        shape: The shape that it must have.

    Raises:
        MPMError: It is something else, not finite, of another shape, or on another mesh.
    """
    if callable(value) and not isinstance(value, ufl.core.expr.Expr):
        value = value(particles.mesh)
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
    elif name == "density" and isinstance(value, fem.Function):
        with agree(particles.mesh.comm):
            wrong = value.x.array[~(value.x.array >= 0.0)]
            if len(wrong):
                raise MPMError(f"density must not be negative, not {wrong[0]:g}.")
    if value.ufl_shape != shape:
        raise MPMError(f"{name} has the shape {value.ufl_shape}, but must have {shape}.")
    for domain in ufl.domain.extract_domains(value):
        if domain != particles.mesh.ufl_domain():
            raise MPMError(f"{name} lives on another mesh; write it on the body mesh.")
    return value


def carried(particles: Particles, assignment: Any) -> Any:
    """Return materials with their DG0 parameters on the mesh to which the particles have moved."""
    if isinstance(assignment, Mapping):
        return {tag: carried(particles, material) for tag, material in assignment.items()}
    if not isinstance(assignment, Material):
        return assignment
    functions = {
        name: particles.carry(value)
        for name, value in assignment.parameters.items()
        if isinstance(value, fem.Function)
    }
    return assignment.with_parameters(**functions) if functions else assignment


def require_movable(
    arguments: Mapping[str, Any], consequence: str = "the particles cannot move"
) -> None:
    """Raise an error unless a problem can be made again on another mesh of its body.

    Args:
        arguments: Those of :class:`QuasiStaticProblem`.
        consequence: What else cannot be.

    Raises:
        MPMError: Something among them lives on the present body mesh.
    """
    for name in ("density", "body_force", "tractions", "pressures"):
        if holds(arguments[name], ufl.core.expr.Expr):
            raise MPMError(
                f"{name} is written on the present body mesh, so {consequence}; give a function "
                "that makes it from a mesh, e.g. lambda mesh: ufl.SpatialCoordinate(mesh)[1]."
            )
    if arguments["supports"]:
        raise MPMError(f"supports= lie on the present body mesh, so {consequence}.")
    materials = arguments["material"]
    for given in materials if isinstance(materials, list | tuple) else [materials]:
        for law in given.values() if isinstance(given, Mapping) else [given]:
            if any(isinstance(value, np.ndarray) for value in law.parameters.values()):
                raise MPMError(
                    "A material has arrays of parameters, one value for each particle of a rank, "
                    f"so {consequence}; use DG0 Functions."
                )


def holds(value: Any, kind: Any) -> bool:
    """Return whether a value, or one in lists and tuples, is of a kind."""
    if isinstance(value, list | tuple):
        return any(holds(entry, kind) for entry in value)
    return isinstance(value, kind)


def known_tags(particles: Particles, facet_tags: Any, what: str) -> set[int]:
    """Return the tags of a body's boundary on all ranks (collective).

    Raises:
        MPMError: They are no tags of facets, or those of another mesh.
    """
    body = particles.mesh
    if not isinstance(facet_tags, mesh.MeshTags) or facet_tags.dim != body.topology.dim - 1:
        raise MPMError(f"{what} need facet_tags=, tags of the body's facets.")
    if not _compat.are_tags_of(facet_tags, body):
        raise MPMError(f"{what} need facet_tags= of the body's mesh, not of another one.")
    body.topology.create_connectivity(facet_tags.dim, body.topology.dim)
    outer = mesh.exterior_facet_indices(body.topology)
    found = facet_tags.values[np.isin(facet_tags.indices, outer)]
    return set().union(*body.comm.allgather({int(t) for t in np.unique(found)}))


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
                f"{what} are pairs of a value and a tag of facets on the boundary, among "
                f"{sorted(known)}, not {load!r}."
            )
    return ufl.Measure(
        "ds",
        domain=particles.mesh,
        subdomain_data=facet_tags,
        metadata=particles.dx_exact.metadata(),
    )
