# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Quadrature on particle domains, and forms split into one rule each."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

import basix.ufl
from dolfinx import mesh

from .. import _compat
from .._core import loops
from ..tolerances import BLOCK

__all__ = [
    "DomainQuadrature",
    "cell_volumes",
    "default_degree",
    "determinant",
    "exact_degree",
    "means_around_axis",
    "nodal_forces",
    "quadrature_element",
    "quadrature_rule",
    "shape_averages",
    "vector_product",
    "volume_ratio",
    "with_hoop",
]


def exact_degree(cell: str, degree: int) -> int:
    """Return the degree that integrates products of two shape functions of a domain.

    Args:
        cell: Name of the cell type.
        degree: Degree of the shape functions.

    Returns:
        Twice the degree, plus that of the Jacobian determinant where the map is not affine.
    """
    return 2 * degree + {"quadrilateral": 1, "hexahedron": 2}.get(cell, 0)


def default_degree(cell: str, degree: int, free: bool = False) -> int:
    """Return the degree of the rule that carries the history by default.

    It is the smallest that sees all strains of a domain and keeps the order: degree^dim Gauss
    points on quadrilaterals and hexahedra (one for degree 1: CPDI2 as published), and on
    triangles 1, 3, 6, on tetrahedra 1, 4, 14 points for the degrees 1, 2, 3. Quadrilaterals and
    hexahedra whose nodes have unknowns of their own take (degree + 1)^dim points: with fewer they
    have modes without strain.

    Args:
        cell: Name of the cell type.
        degree: Degree of the shape functions.
        free: Whether the nodes have unknowns of their own.
    """
    if free and cell in ("quadrilateral", "hexahedron"):
        return 2 * degree
    if degree == 1 or cell in ("quadrilateral", "hexahedron"):
        return 2 * degree - 1
    return 2 * degree - 2


def quadrature_rule(
    cell: basix.CellType, degree: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points ``(nq, tdim)`` and weights ``(nq,)`` of the default rule."""
    points, weights = basix.make_quadrature(cell, degree)
    return np.asarray(points), np.asarray(weights)


def quadrature_element(cell: str, degree: int, shape: tuple[int, ...] = ()) -> Any:
    """Return the quadrature element of the default rule."""
    return basix.ufl.quadrature_element(cell, value_shape=shape, scheme="default", degree=degree)


class DomainQuadrature:
    """A rule on every domain this rank owns: weights, shape functions and their gradients.

    Attributes:
        weights: Reference volume of each point, shape ``(n, nq)``; a rule may have negative
            ones.
        flat: Whether a domain has no volume at a point, shape ``(n,)``.
        shapes: Shape functions of W at the points, shape ``(nq, k)``.
        gradients: Their gradients in the undeformed body, shape ``(n, nq, k, gdim)``.
    """

    def __init__(self, body: mesh.Mesh, shape_functions: Any, degree: int) -> None:
        points, weights = quadrature_rule(body.basix_cell(), degree)
        nodes, slopes = _geometry(body, points)
        gdim = nodes.shape[2]
        jacobian = _jacobians(nodes, slopes)
        table = shape_functions.tabulate(1, points)[:, :, :, 0]
        self.shapes: NDArray[np.float64] = table[0]
        size = np.abs(determinant(jacobian))
        span = np.ptp(nodes, axis=1).max(axis=1, initial=0.0) ** gdim
        self.flat: NDArray[np.bool_] = ~(size > 1e-12 * span[:, None]).all(axis=1)
        jacobian[self.flat] = np.eye(gdim)
        self.weights: NDArray[np.float64] = weights * size
        self.gradients: NDArray[np.float64] = np.einsum(
            "jqk,nqji->nqki", table[1:], np.linalg.inv(jacobian)
        )

    def displacement_gradient(self, nodal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return ``grad d`` at the points.

        Args:
            nodal: Displacement of the domains' nodes, shape ``(n, k, gdim)``.

        Returns:
            Gradient with respect to the undeformed body, shape ``(n, nq, gdim, gdim)``.
        """
        return np.asarray(np.matmul(nodal.swapaxes(1, 2)[:, None], self.gradients))

    def gradient_of(
        self, displacement: NDArray[np.float64], domain_nodes: NDArray[np.int32]
    ) -> NDArray[np.float64]:
        """Return ``grad d`` at the points, as :meth:`displacement_gradient` does.

        Args:
            displacement: Displacement at the local dofs of W.
            domain_nodes: Local nodes of each domain, shape ``(n, k)``.
        """
        n, nq, _, gdim = self.gradients.shape
        gradient = np.empty((n, nq, gdim, gdim))
        loops.displacement_gradient(displacement, domain_nodes, self.gradients, gradient)
        return gradient


def shape_averages(body: mesh.Mesh, shape_functions: Any, degree: int) -> NDArray[np.float64]:
    """Return averages of shape functions over the domains this rank owns, shape ``(n, k)``.

    Args:
        body: The body mesh.
        shape_functions: basix element of W.
        degree: Degree of a rule that is exact for them.
    """
    points, weights = quadrature_rule(body.basix_cell(), degree)
    nodes, slopes = _geometry(body, points)
    shapes = shape_functions.tabulate(0, points)[0, :, :, 0]
    averages = np.empty((len(nodes), shapes.shape[1]))
    for start in range(0, len(nodes), BLOCK):  # the Jacobians are many times the size of a body
        part = slice(start, start + BLOCK)
        sizes = weights * np.abs(determinant(_jacobians(nodes[part], slopes)))
        averages[part] = sizes @ shapes / sizes.sum(axis=1, keepdims=True)
    return averages


def cell_volumes(domain: mesh.Mesh) -> NDArray[np.float64]:
    """Return the volumes of the cells that this rank owns, shape ``(c,)``; areas in the plane."""
    degree = domain.geometry.dim * _compat.geometry_degree(domain)
    points, weights = quadrature_rule(domain.basix_cell(), degree)
    nodes, slopes = _geometry(domain, points)
    blocks = np.split(nodes, range(BLOCK, len(nodes), BLOCK))
    sizes = [np.abs(determinant(_jacobians(block, slopes))) @ weights for block in blocks]
    return np.concatenate(sizes)


def means_around_axis(rule: DomainQuadrature, domains: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return means of shape functions' gradients over domains that are turned around ``x[0] = 0``.

    Args:
        rule: A rule on the body mesh that is exact for products of two shape functions.
        domains: Nodes of the undeformed domains, shape ``(n, k, 2)``.

    Returns:
        Gradients in the undeformed domains, shape ``(n, k, 2)``.
    """
    before = np.einsum("nki,nqkj->nqij", domains, rule.gradients)
    volumes = rule.weights * np.linalg.det(before) * (domains[:, :, 0] @ rule.shapes.T)
    parts = volumes / volumes.sum(axis=1, keepdims=True)
    return np.asarray(np.einsum("nq,nqkj,nqji->nki", parts, rule.gradients, np.linalg.inv(before)))


def _geometry(
    body: mesh.Mesh, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return geometry nodes of owned cells, ``(n, k, gdim)``, and slopes of their map.

    Args:
        body: The mesh.
        points: Reference points, shape ``(nq, tdim)``.

    Returns:
        The nodes, and derivatives of the map's shape functions, shape ``(tdim, nq, k)``.
    """
    cell = body.basix_cell()
    count = body.topology.index_map(body.topology.dim).size_local
    nodes = body.geometry.x[_compat.geometry_dofmap(body)[:count], : body.geometry.dim]
    degree = _compat.geometry_degree(body)
    element = basix.ufl.element("Lagrange", cell.name, degree).basix_element
    return nodes, element.tabulate(1, points)[1:, :, :, 0]


def _jacobians(nodes: NDArray[np.float64], slopes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``dx/dX`` at reference points, ``(n, nq, gdim, gdim)``; see :func:`_geometry`."""
    (tdim, nq, k), (n, _, gdim) = slopes.shape, nodes.shape
    product = slopes.reshape(-1, k) @ nodes.transpose(1, 0, 2).reshape(k, -1)
    return product.reshape(tdim, nq, n, gdim).transpose(2, 1, 3, 0)


def nodal_forces(
    stress: NDArray[np.float64],
    weights: NDArray[np.float64],
    gradients: NDArray[np.float64],
    hoop: NDArray[np.float64] | None,
) -> NDArray[np.float64]:
    """Return the integrals of ``stress : grad N`` over each domain, shape ``(n, k, gdim)``.

    Args:
        stress: Shape ``(n, nq, dim, dim)``.
        weights: Volumes of the points, shape ``(n, nq)``.
        gradients: Those of the shape functions, shape ``(n, nq, k, gdim)``.
        hoop: In a body of revolution ``N / r``, shape ``(n, nq, k)``; dim is 3 then.
    """
    n, _, k, gdim = gradients.shape
    forces: NDArray[np.float64] = np.zeros((n, k, gdim))
    loops.internal_force(
        np.ascontiguousarray(stress),
        np.arange(n * k, dtype=np.int32).reshape(n, k),
        gradients,
        weights,
        np.zeros(0) if hoop is None else hoop,
        forces.reshape(-1),
    )
    return forces


def with_hoop(
    gradient: NDArray[np.float64], hoop: NDArray[np.float64], nodal: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return gradients ``(n, nq, 2, 2)`` of a body of revolution with the hoop strain.

    Args:
        gradient: Of the displacement in the plane.
        hoop: ``N / r``, shape ``(n, nq, k)``.
        nodal: Displacement of the domains' nodes, shape ``(n, k, 2)``.

    Returns:
        Shape ``(n, nq, 3, 3)``.
    """
    whole = np.zeros((*gradient.shape[:2], 3, 3))
    whole[:, :, :2, :2] = gradient
    whole[:, :, 2, 2] = np.einsum("nqk,nk->nq", hoop, nodal[:, :, 0])
    return whole


def volume_ratio(gradient: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``det(I + H)`` of displacement gradients H, shape ``(..., dim, dim)``."""
    return determinant(gradient, 1.0)


def determinant(matrix: NDArray[np.float64], shift: float = 0.0) -> NDArray[np.float64]:
    """Return ``det(shift I + H)`` of matrices H, shape ``(..., dim, dim)`` with dim 2 or 3."""
    H, dim = matrix, matrix.shape[-1]
    diagonal = [shift + H[..., i, i] for i in range(dim)]
    with np.errstate(invalid="ignore", over="ignore"):
        if dim == 2:
            return np.asarray(diagonal[0] * diagonal[1] - H[..., 0, 1] * H[..., 1, 0])
        x, y, z = diagonal
        return np.asarray(
            x * (y * z - H[..., 1, 2] * H[..., 2, 1])
            - H[..., 0, 1] * (H[..., 1, 0] * z - H[..., 1, 2] * H[..., 2, 0])
            + H[..., 0, 2] * (H[..., 1, 0] * H[..., 2, 1] - y * H[..., 2, 0])
        )


def vector_product(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the vector product of rows; in the plane its one component."""
    if a.shape[-1] == 3:
        return np.cross(a, b)
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
