# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Quadrature on particle domains, and forms split into one rule each."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

import basix.ufl
import ufl
from dolfinx import fem, mesh
from ufl.algorithms import expand_derivatives
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.estimate_degrees import estimate_total_polynomial_degree
from ufl.corealg.traversal import traverse_unique_terminals

from . import _compat
from ._core import loops
from .errors import MPMError

__all__ = [
    "DomainQuadrature",
    "data_at_points",
    "default_degree",
    "depends_on",
    "exact_degree",
    "follows",
    "quadrature_element",
    "split_by_rule",
    "volume_ratio",
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


def default_degree(cell: str, degree: int) -> int:
    """Return the degree of the rule that carries the history by default.

    It is the smallest that sees all strains of a domain and keeps the order: degree^dim Gauss
    points on quadrilaterals and hexahedra (one for degree 1: CPDI2 as published), and on
    triangles 1, 3, 6, on tetrahedra 1, 4, 14 points for the degrees 1, 2, 3.

    Args:
        cell: Name of the cell type.
        degree: Degree of the shape functions.
    """
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
        cell = body.basix_cell()
        gdim = body.geometry.dim
        points, weights = quadrature_rule(cell, degree)
        count = body.topology.index_map(body.topology.dim).size_local
        nodes = body.geometry.x[_compat.geometry_dofmap(body)[:count], :gdim]
        coordinate_map = basix.ufl.element(
            "Lagrange", cell.name, _compat.geometry_degree(body)
        ).basix_element
        slopes = coordinate_map.tabulate(1, points)[1:, :, :, 0]
        jacobian = np.einsum("jqk,nki->nqij", slopes, nodes)
        table = shape_functions.tabulate(1, points)[:, :, :, 0]
        self.shapes: NDArray[np.float64] = table[0]
        size = np.abs(np.linalg.det(jacobian))
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
        if loops is None:
            return self.displacement_gradient(displacement.reshape(-1, gdim)[domain_nodes])
        gradient = np.empty((n, nq, gdim, gdim))
        loops.displacement_gradient(displacement, domain_nodes, self.gradients, gradient)
        return gradient


def volume_ratio(gradient: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``det(I + H)`` of displacement gradients H, shape ``(..., dim, dim)``."""
    H, dim = gradient, gradient.shape[-1]
    diagonal = [1.0 + H[..., i, i] for i in range(dim)]
    with np.errstate(invalid="ignore", over="ignore"):
        if dim == 2:
            return np.asarray(diagonal[0] * diagonal[1] - H[..., 0, 1] * H[..., 1, 0])
        x, y, z = diagonal
        return np.asarray(
            x * (y * z - H[..., 1, 2] * H[..., 2, 1])
            - H[..., 0, 1] * (H[..., 1, 0] * z - H[..., 1, 2] * H[..., 2, 0])
            + H[..., 0, 2] * (H[..., 1, 0] * H[..., 2, 1] - y * H[..., 2, 0])
        )


def depends_on(form: ufl.Form, function: fem.Function) -> bool:
    """Return whether a form contains a function."""
    return any(c is function for c in form.coefficients())


def follows(form: ufl.Form, displacement: fem.Function) -> bool:
    """Return whether a form changes during a step.

    It does where it has the displacement, or data injected at quadrature points.
    """
    return depends_on(form, displacement) or bool(data_at_points(form))


def data_at_points(form: ufl.Form) -> set[fem.Function]:
    """Return the Functions at quadrature points that a form holds."""
    return {c for c in form.coefficients() if c.ufl_element().has_custom_quadrature}


def _rule(integral: Any) -> tuple[int, str]:
    """Return the degree and scheme that one integral is meant to be integrated with."""
    metadata = integral.metadata()
    degree = metadata.get("quadrature_degree", -1)
    scheme = str(metadata.get("quadrature_rule", "default"))
    for terminal in traverse_unique_terminals(integral.integrand()):
        element = (
            terminal.function_space.ufl_element() if isinstance(terminal, fem.Function) else None
        )
        if element is None or not element.has_custom_quadrature:
            continue
        points = element.custom_quadrature()[0]
        if degree == -1:
            degree = element.degree
        cell = terminal.function_space.mesh.basix_cell()
        rule, _ = quadrature_rule(cell, degree)
        if points.shape != rule.shape or not np.allclose(points, rule):
            raise MPMError(
                f"The form integrates '{terminal.name}', known at {len(points)} quadrature "
                f"point(s) of a domain, with a rule of {len(rule)} point(s); integrate it with "
                "particles.dx."
            )
    if degree == -1:
        lowered = expand_derivatives(apply_algebra_lowering(integral.integrand()))
        estimate = estimate_total_polynomial_degree(lowered)
        degree = max(estimate) if isinstance(estimate, tuple) else estimate
    return int(degree), scheme


def split_by_rule(form: ufl.Form, displacement: fem.Function) -> list[ufl.Form]:
    """Split a form so that each part has one rule, one kind of dependence and one set of tags.

    FFCx (0.9 to 0.11) miscompiles a form that mixes a one-point rule with another rule, so
    each rule gets a form of its own; parts that are constant during a step are apart too.

    Args:
        form: Any UFL form on the body mesh.
        displacement: The displacement of the body.

    Returns:
        The parts, whose sum is ``form``.

    Raises:
        MPMError: Where data at quadrature points meet another rule.
    """
    parts: dict[tuple[bool, str, int, str, int], list[Any]] = defaultdict(list)
    markers: list[Any] = []
    for integral in form.integrals():
        degree, scheme = _rule(integral)
        metadata = dict(integral.metadata())
        metadata.update(quadrature_degree=degree, quadrature_rule=scheme)
        one = integral.reconstruct(metadata=metadata)
        constant = not follows(ufl.Form([one]), displacement)
        tags = integral.subdomain_data()
        seen = [i for i, known in enumerate(markers) if known is tags]
        if not seen:
            markers.append(tags)
        place = seen[0] if seen else len(markers) - 1
        parts[constant, integral.integral_type(), degree, scheme, place].append(one)
    return [ufl.Form(parts[key]) for key in sorted(parts)]
