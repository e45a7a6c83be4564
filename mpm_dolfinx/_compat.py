# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""The only place that knows DOLFINx versions and installations."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI  # noqa: F401  (before DOLFINx: the wheel finds its MPI library by it)

import numpy as np
from numpy.typing import NDArray

try:
    import dolfinx
except ImportError as error:  # pragma: no cover
    raise ImportError(
        "mpm_dolfinx needs DOLFINx 0.11 with PETSc; install it with "
        "'pip install mpm-dolfinx[wheel]', or from conda-forge, apt or source."
    ) from error

from petsc4py import PETSc

from dolfinx import fem, geometry, mesh

__all__ = [
    "candidate_cells",
    "cell_tree",
    "geometry_degree",
    "geometry_dofmap",
    "is_condition_on",
    "require_supported",
]

_VERSION = tuple(int(part) for part in dolfinx.__version__.split(".")[:2])


def require_supported() -> None:
    """Raise ImportError where this DOLFINx cannot run the package."""
    if _VERSION < (0, 11):
        raise ImportError(
            f"mpm_dolfinx needs DOLFINx 0.11 or newer, this is {dolfinx.__version__}."
        )
    if np.issubdtype(PETSc.ScalarType, np.complexfloating):
        raise ImportError("mpm_dolfinx needs a DOLFINx and PETSc with real scalars.")


def geometry_dofmap(domain: mesh.Mesh) -> NDArray[np.int32]:
    """Return the geometry nodes of each local cell (``.dofmap`` before 0.11)."""
    return np.asarray(domain.geometry.dofmaps[0])


def geometry_degree(domain: mesh.Mesh) -> int:
    """Return the degree of the coordinate element (``.cmap`` before 0.11)."""
    return int(domain.geometry.cmaps[0].degree)


def cell_tree(domain: mesh.Mesh, cells: NDArray[np.int32], padding: float) -> Any:
    """Return a bounding-box tree of some cells (keyword arguments since 0.10)."""
    return geometry.bb_tree(domain, domain.topology.dim, padding=padding, entities=cells)


def candidate_cells(
    tree: Any, points: NDArray[np.float64]
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return offsets and cells whose boxes hold each point, ``points`` of shape (n, 3)."""
    found = geometry.compute_collisions_points(tree, points)
    return found.offsets, found.array


def is_condition_on(bc: fem.DirichletBC, V: fem.FunctionSpace) -> bool:
    """Return whether a Dirichlet condition is on a space or on a component of it."""
    own = V._cpp_object
    return bool(bc.function_space == own or own.contains(bc.function_space))
