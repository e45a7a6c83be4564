# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Tags that users name: of cells, and of facets on a boundary."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dolfinx import mesh

from .. import _compat
from ..errors import MPMError, agree
from ..reals import as_wholes

__all__ = [
    "as_tags",
    "cells_with",
    "is_pair_with_tags",
    "is_tag",
    "require_on_boundary",
    "require_tag",
    "require_tags",
]


def is_tag(value: Any) -> bool:
    """Return whether a value is a whole number, as tags are."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def is_pair_with_tags(value: Any) -> bool:
    """Return whether a value is ``(tags, tag)``."""
    return isinstance(value, tuple) and len(value) == 2 and isinstance(value[0], mesh.MeshTags)


def as_tags(wanted: Any, what: str) -> NDArray[np.int64]:
    """Return one tag, or several, shape ``(n,)``.

    Args:
        wanted: What a user gives.
        what: What they are for, in a sentence.

    Raises:
        MPMError: They are no whole numbers.
    """
    try:
        return as_wholes(wanted).ravel()
    except (TypeError, ValueError):
        raise _no_tag(wanted, what) from None


def require_tag(value: Any, what: str) -> None:
    """Raise an error unless a value is one tag."""
    if not is_tag(value):
        raise _no_tag(value, what)


def _no_tag(value: Any, what: str) -> MPMError:
    return MPMError(f"A tag of {what} is a whole number, not {value!r}.")


def _require_known(wanted: Iterable[int], known: set[int], entity: str, what: str) -> None:
    missing = sorted(set(wanted) - known)
    if missing:
        raise MPMError(
            f"No {entity} has the tag {missing[0]} of {what}; there are {sorted(known)}."
        )


def _of_all(comm: Any, values: NDArray[Any]) -> set[int]:
    """Return values of all ranks, each once (collective)."""
    return set().union(*comm.allgather({int(value) for value in np.unique(values)}))


def require_tags(domain: mesh.Mesh, tags: Any, entities: str, what: str) -> None:
    """Raise an error unless something is tags of a body's ``"cells"`` or ``"facets"``."""
    dim = domain.topology.dim - (entities == "facets")
    if not isinstance(tags, mesh.MeshTags):
        raise MPMError(
            f"A tag of {what} needs {entities[:-1]}_tags=, tags of the body's {entities}."
        )
    if tags.dim != dim or not _compat.are_tags_of(tags, domain):
        raise MPMError(
            f"The tags of {what} must be those of {entities} of the present body mesh, "
            "particles.mesh; particles.carry() takes older ones over to it."
        )


def cells_with(
    domain: mesh.Mesh, cell_tags: Any, wanted: Any, what: str
) -> NDArray[np.integer[Any]]:
    """Return the cells with one of some tags that this rank knows (collective).

    Args:
        domain: The mesh.
        cell_tags: Tags of its cells.
        wanted: One tag, or several.
        what: What they are for, in a sentence.

    Raises:
        MPMError: They are no tags of its cells, no whole numbers, or no cell has one.
    """
    with agree(domain.comm):
        require_tags(domain, cell_tags, "cells", what)
        tags = as_tags(wanted, what)
    _require_known(tags.tolist(), _of_all(domain.comm, cell_tags.values), "cell", what)
    return np.asarray(cell_tags.indices[np.isin(cell_tags.values, tags)])


def require_on_boundary(
    domain: mesh.Mesh, facet_tags: Any, wanted: Iterable[Any], what: str
) -> None:
    """Raise an error unless facets on the boundary have tags, each of them once (collective).

    Args:
        domain: The mesh of a body.
        facet_tags: Tags of its facets.
        wanted: The tags.
        what: What they are for, in a sentence.

    Raises:
        MPMError: They are no tags of facets, those of another mesh, a facet has one twice, no facet
            of the boundary has it, or one inside the body has it too.
    """
    dim = domain.topology.dim - 1
    with agree(domain.comm):
        require_tags(domain, facet_tags, "facets", what)
        pairs, times = np.unique(
            np.column_stack([facet_tags.indices, facet_tags.values]), axis=0, return_counts=True
        )
        if (times > 1).any():
            raise MPMError(
                f"facet_tags= name a facet twice with the tag {pairs[times > 1][0, 1]}, and {what} "
                "on it would count twice; make them of facets that np.unique has sorted."
            )
        tags = list(wanted)
        for tag in tags:
            require_tag(tag, what)
    domain.topology.create_connectivity(dim, dim + 1)
    outer = np.isin(facet_tags.indices, mesh.exterior_facet_indices(domain.topology))
    _require_known(
        tags, _of_all(domain.comm, facet_tags.values[outer]), "facet of the boundary", what
    )
    own = facet_tags.indices < domain.topology.index_map(dim).size_local
    inside = np.intersect1d(tags, facet_tags.values[own & ~outer])
    with agree(domain.comm):
        if len(inside):
            raise MPMError(
                f"The tag {inside[0]} of {what} is on facets inside the body too, where they "
                "cannot act; tag facets of the boundary alone."
            )
