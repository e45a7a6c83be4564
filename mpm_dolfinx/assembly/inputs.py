# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Numbers, tuples and tags of a user, as UFL on the body mesh."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import ufl
from dolfinx import fem, mesh

from .. import _compat
from ..errors import MPMError, agree, as_ours
from ..materials.base import Material
from ..meshes.quadrature import quadrature_rule
from ..parallel.compilation import compiled_expression
from ..parallel.given import require_same
from ..particles.particles import Particles
from ..reals import as_reals, holds_ufl

__all__ = ["Density", "as_expression", "facet_measure", "functions_of", "is_tag", "known_tags"]


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
    with agree(particles.mesh.comm):
        made = _expression(value, particles, name, shape)
    if callable(value) and not isinstance(value, ufl.core.expr.Expr):
        require_same(particles.mesh.comm, **{name: made})
    return made


def _expression(value: Any, particles: Particles, name: str, shape: tuple[int, ...]) -> Any:
    if callable(value) and not isinstance(value, ufl.core.expr.Expr):
        try:
            value = value(particles.mesh)
        except Exception as error:
            what = f"The function that makes {name}, and is given the body mesh,"
            raise as_ours(error, what) from error
    if isinstance(value, list | tuple) and holds_ufl(value):
        # (with its Constants, whose values may change, and not what they are now)
        try:
            value = ufl.as_tensor(value)
        except Exception as error:
            raise as_ours(error, f"{name} must be numbers or UFL") from error
    if not isinstance(value, ufl.core.expr.Expr):
        try:
            array = as_reals(value)
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


class NotNegative:
    """Something of a body that must not be negative anywhere, whatever values it gets.

    Args:
        value: Numbers or UFL, or a function that makes UFL from the body mesh.
        particles: The body.
        name: What it is called in a message.

    Attributes:
        value: UFL on the body mesh.

    Raises:
        MPMError: See :func:`as_expression`.
    """

    def __init__(self, value: Any, particles: Particles, name: str) -> None:
        self.value = as_expression(value, particles, name, ())
        if not ufl.domain.extract_domains(self.value):  # UFL that is a number
            self.value = as_expression(float(self.value), particles, name, ())
        self._particles, self._name = particles, name
        self._at_points: fem.Expression | None = None
        if not isinstance(self.value, fem.Constant | fem.Function):
            degree = particles.dx_exact.metadata()["quadrature_degree"]
            points, _ = quadrature_rule(particles.mesh.basix_cell(), degree)
            self._at_points = compiled_expression(self.value, points, particles.mesh.comm)

    def require(self) -> None:
        """Look at the present values at the points of integration (collective).

        Raises:
            MPMError: Some are negative, or no numbers.
        """
        particles = self._particles
        if self._at_points is not None:
            cells = np.arange(particles.num_local, dtype=np.int32)
            values = self._at_points.eval(particles.mesh, cells)
        elif isinstance(self.value, fem.Function):
            values = self.value.x.array[self.value.function_space.dofmap.list]
            values = values[: particles.num_local]
        else:
            values = np.broadcast_to(self.value.value, (particles.num_local, 1))
        least = values.min(axis=1, initial=np.inf)
        wrong = ~(least >= 0.0) & ~particles.deleted
        with agree(particles.mesh.comm):
            if wrong.any():
                raise MPMError(
                    f"{self._name} must not be negative, not {least[wrong][0]:g} "
                    "(at {particles}).",
                    particles.global_index[wrong],
                )


class Density(NotNegative):
    """The mass per undeformed volume of a body; see :class:`NotNegative`."""

    def __init__(self, value: Any, particles: Particles) -> None:
        super().__init__(value, particles, "density")


def functions_of(assignment: Any) -> list[fem.Function]:
    """Return the Functions among the parameters of materials."""
    if isinstance(assignment, Mapping):
        return [function for material in assignment.values() for function in functions_of(material)]
    if not isinstance(assignment, Material):
        return []
    return [v for v in assignment.parameters.values() if isinstance(v, fem.Function)]


def is_tag(value: Any) -> bool:
    """Return whether a value is a whole number, as tags are."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def known_tags(
    particles: Particles, facet_tags: Any, what: str, wanted: Sequence[Any] = ()
) -> set[int]:
    """Return the tags of a body's boundary on all ranks (collective).

    Args:
        particles: The body.
        facet_tags: Tags of its facets.
        what: What they are for, in a sentence.
        wanted: The tags that are used.

    Raises:
        MPMError: They are no tags of facets, those of another mesh, a facet has one twice, or one
            that is used is on facets inside the body.
    """
    body = particles.mesh
    needs = f"{what} {'needs' if what.startswith('A ') else 'need'}"
    if not isinstance(facet_tags, mesh.MeshTags) or facet_tags.dim != body.topology.dim - 1:
        raise MPMError(f"{needs} facet_tags=, tags of the body's facets.")
    if not _compat.are_tags_of(facet_tags, body):
        raise MPMError(f"{needs} facet_tags= of the body's mesh, not of another one.")
    with agree(body.comm):
        pairs, times = np.unique(
            np.column_stack([facet_tags.indices, facet_tags.values]), axis=0, return_counts=True
        )
        if (times > 1).any():
            raise MPMError(
                f"facet_tags= name a facet twice with the tag {pairs[times > 1][0, 1]}, and {what} "
                "on it would count twice; make them of facets that np.unique has sorted."
            )
    body.topology.create_connectivity(facet_tags.dim, body.topology.dim)
    outer = mesh.exterior_facet_indices(body.topology)
    own = facet_tags.indices < body.topology.index_map(facet_tags.dim).size_local
    inside = facet_tags.values[own & ~np.isin(facet_tags.indices, outer)]
    with agree(body.comm):
        for tag in wanted:
            count = int(np.count_nonzero(inside == tag)) if is_tag(tag) else 0
            if count:
                raise MPMError(
                    f"The tag {tag} of {what} is on facets inside the body too, where they cannot "
                    "act; tag facets of the boundary alone."
                )
    found = facet_tags.values[np.isin(facet_tags.indices, outer)]
    return set().union(*body.comm.allgather({int(t) for t in np.unique(found)}))


def facet_measure(
    particles: Particles, facet_tags: Any, loads: Sequence[tuple[Any, int]], what: str
) -> ufl.Measure:
    """Return the measure on a body's tagged facets, for pairs of a value and a tag.

    Raises:
        MPMError: Something else than such pairs, or tags that are none.
    """
    pairs = [load for load in loads if isinstance(load, tuple) and len(load) == 2]
    known = known_tags(particles, facet_tags, what)
    if all(is_tag(tag) and tag in known for _, tag in pairs):
        known_tags(particles, facet_tags, what, [tag for _, tag in pairs])
    for load in loads:
        usable = isinstance(load, tuple) and len(load) == 2
        if not usable or not is_tag(load[1]) or load[1] not in known:
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
