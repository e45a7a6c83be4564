# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Stretches of structures at large rotations, and what forces by them do at the nodes.

With the slopes G of the shape functions along an orthonormal frame of a cell, the vectors
``a = sum_i G_i x_i`` are what the frame has become. A line's stretch is the length of its a, around
an axis it is ``r / R``; those of a surface are the roots of the eigenvalues of ``a^T a``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import basix

from ..tolerances import HALF_DIGITS
from .laws import Law
from .layout import Layout

__all__ = ["Nodal", "Rule", "rule_of", "stretched"]

type Array = NDArray[np.float64]


class Rule(NamedTuple):
    """The points of a structure of some shape.

    Attributes:
        cells: Nodes of each cell, shape ``(m, k)``.
        slopes: Of the shape functions along an orthonormal frame, ``(m, q, k, dim)``.
        weights: Size of each point, shape ``(m, q)``.
        around: Shape functions over the radius, shape ``(m, q, k)``, of a sheet of revolution;
            ``None``: it is not one.
        components: Number of principal forces.
    """

    cells: NDArray[np.int64]
    slopes: Array
    weights: Array
    around: Array | None
    components: int

    def means(self, values: Array) -> Array:
        """Return means over each cell, shape ``(m, c)``, of values at points ``(m, q, c)``."""
        shares = self.weights / self.weights.sum(axis=1)[:, None]
        return np.asarray(np.einsum("mq,mqc->mc", shares, values))


class Nodal(NamedTuple):
    """Forces of a stretched structure at its nodes, and their derivatives.

    Attributes:
        forces: On the nodes of each cell, shape ``(m, k, gdim)``.
        tangent: Their derivatives, shape ``(m, k, gdim, k, gdim)``.
        principal: Forces at the points, none where a cell is not there, shape ``(m, q, c)``.
        offset: See :class:`.Response`, shape ``(m, q)``.
        special: The same, shape ``(m, q)``.
    """

    forces: Array
    tangent: Array
    principal: Array
    offset: Array
    special: NDArray[np.bool_]


def rule_of(layout: Layout, nodes: Array, count: int, axisymmetric: bool) -> Rule:
    """Return the points of a structure whose nodes are at some places, without stress.

    Args:
        layout: Its cells.
        nodes: The places, shape ``(N, gdim)``.
        count: Number of principal forces.
        axisymmetric: Whether ``x[0]`` is a radius.
    """
    hoop = axisymmetric and count == 2
    full = layout.kind == basix.CellType.quadrilateral or hoop
    degree = 2 * layout.degree - (0 if full else 2)
    points, weights = map(np.asarray, basix.make_quadrature(layout.kind, degree))
    table = np.asarray(layout.element.tabulate(1, points), dtype=np.float64)[:, :, :, 0]
    corners = nodes[layout.cells]
    jacobians = np.einsum("jqk,mkg->mqgj", table[1:], corners)
    _, R = np.linalg.qr(jacobians)
    slopes = np.einsum("jqk,mqjt->mqkt", table[1:], np.linalg.inv(R))
    sizes = weights * np.abs(np.linalg.det(R))
    around = None
    if axisymmetric:
        radius = corners[:, :, 0] @ table[0].T
        sizes = 2.0 * np.pi * radius * sizes
        if hoop:
            around = table[0] / radius[:, :, None]
    return Rule(layout.cells, slopes, sizes, around, count)


def stretched(rule: Rule, law: Law, nodes: Array, offset: Array, present: Array) -> Nodal:
    """Return the forces of a structure whose nodes are where they are.

    Args:
        rule: Its points.
        law: Its law.
        nodes: Where its nodes are, shape ``(N, gdim)``.
        offset: Force at no stretch, shape ``(m, q)``.
        present: 1 for each cell that is there, 0 for others, shape ``(m,)``.
    """
    a = np.einsum("mqkt,mkg->mqgt", rule.slopes, nodes[rule.cells])
    weights = rule.weights * present[:, None]
    if rule.slopes.shape[3] == 2:
        found = _surface(rule, law, a, offset, weights)
    else:
        found = _line(rule, law, nodes, a[..., 0], offset, weights)
    return found._replace(principal=found.principal * present[:, None, None])


def _line(rule: Rule, law: Law, nodes: Array, a: Array, offset: Array, weights: Array) -> Nodal:
    """Return the forces of a line, or of the sheet of which it is the section."""
    (m, q, gdim), k = a.shape, rule.cells.shape[1]
    stretches = np.ones((m, q, rule.components))
    stretches[..., 0] = np.maximum(np.linalg.norm(a, axis=2), HALF_DIGITS)
    along = a / stretches[..., :1]
    # what a motion of the nodes stretches: B_c is the derivative of a stretch
    B = np.zeros((rule.components, m, q, k, gdim))
    B[0] = np.einsum("mqk,mqg->mqkg", rule.slopes[..., 0], along)
    if rule.around is not None:
        stretches[..., 1] = np.einsum("mqk,mk->mq", rule.around, nodes[rule.cells][:, :, 0])
        B[1, ..., 0] = rule.around
    found = law.respond(stretches.reshape(m * q, -1), offset.ravel())
    n = found.forces.reshape(m, q, -1)
    H = found.tangent.reshape(m, q, rule.components, rule.components)
    forces = np.einsum("mq,mqc,cmqkg->mkg", weights, n, B, optimize=True)
    tangent = np.einsum("mq,mqcd,cmqkg,dmqlh->mkglh", weights, H, B, B, optimize=True)
    turning = np.eye(gdim) - np.einsum("mqg,mqh->mqgh", along, along)
    pull = weights * n[..., 0] / stretches[..., 0]
    G = rule.slopes[..., 0]
    tangent += np.einsum("mq,mqk,mql,mqgh->mkglh", pull, G, G, turning, optimize=True)
    return Nodal(forces, tangent, n, found.offset.reshape(m, q), found.special.reshape(m, q))


def _surface(rule: Rule, law: Law, a: Array, offset: Array, weights: Array) -> Nodal:
    """Return the forces of a surface."""
    m, q, gdim, _ = a.shape
    squares, axes = np.linalg.eigh(np.einsum("mqgs,mqgt->mqst", a, a))
    stretches = np.maximum(np.sqrt(np.maximum(squares, 0.0)), HALF_DIGITS)
    found = law.respond(stretches.reshape(m * q, 2), offset.ravel())
    n, H = found.forces.reshape(m, q, 2), found.tangent.reshape(m, q, 2, 2)
    # second Piola forces S_i = n_i / l_i and their derivatives by Green's strain, on these axes
    S = n / stretches
    D = H / stretches[..., :, None] / stretches[..., None, :]
    places = np.arange(2)
    D[..., places, places] -= S / stretches**2
    apart = stretches[..., 1] ** 2 - stretches[..., 0] ** 2
    near = apart < 1e-6 * stretches[..., 1] ** 2
    shear = np.where(
        near,
        0.5 * (D[..., 0, 0] + D[..., 1, 1] - D[..., 0, 1] - D[..., 1, 0]) / 2.0,
        (S[..., 1] - S[..., 0]) / np.where(near, 1.0, apart),
    )
    # a motion's strains on the axes: B_ij of the nodes, shape (m, q, k, gdim)
    G = np.einsum("mqkt,mqti->mqki", rule.slopes, axes)
    b = np.einsum("mqgt,mqti->mqgi", a, axes)
    B = np.einsum("mqki,mqgi->imqkg", G, b)
    slide = np.einsum("mqk,mqg->mqkg", G[..., 0], b[..., 1])
    slide += np.einsum("mqk,mqg->mqkg", G[..., 1], b[..., 0])
    forces = np.einsum("mq,mqi,imqkg->mkg", weights, S, B, optimize=True)
    tangent = np.einsum("mq,mqij,imqkg,jmqlh->mkglh", weights, D, B, B, optimize=True)
    tangent += np.einsum("mq,mqkg,mqlh->mkglh", weights * shear, slide, slide, optimize=True)
    turning = np.einsum("mq,mqi,mqki,mqli->mkl", weights, S, G, G, optimize=True)
    tangent += np.einsum("mkl,gh->mkglh", turning, np.eye(gdim))
    return Nodal(
        forces, tangent, n[..., ::-1], found.offset.reshape(m, q), found.special.reshape(m, q)
    )
