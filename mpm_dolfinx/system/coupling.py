# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Terms that tie bodies together, whatever backgrounds move them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, override

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

import basix
from dolfinx import fem, mesh

from .. import _compat
from ..background.basis import BackgroundBasis
from ..errors import MPMError, agree
from ..meshes.tags import require_on_boundary
from ..parallel.boundary import collective
from ..parallel.given import as_positive, require_whole
from ..particles.particles import Particles, require_shared_nodes
from ..tolerances import NEGLIGIBLE
from .term import Term

__all__ = ["Tie", "at_present", "interpolation"]


class _Faces(NamedTuple):
    """The points of a tied face in both bodies.

    Attributes:
        spaces: W of each body.
        rows: Of each body: the matrix from dofs of W to values at the points.
        weights: Of each component at each point.
    """

    spaces: tuple[fem.FunctionSpace, ...]
    rows: list[PETSc.Mat]
    weights: NDArray[np.float64]


class _Springs(NamedTuple):
    """Springs at the points where both bodies are still there.

    Attributes:
        held: Which components at points that is.
        weights: Of each component at each point, zero elsewhere.
        blocks: Tangents for a stiffness of one.
        tangents: Matrices of the same patterns.
    """

    held: NDArray[np.bool_]
    weights: NDArray[np.float64]
    blocks: dict[tuple[int, int], PETSc.Mat]
    tangents: dict[tuple[int, int], PETSc.Mat]


class Tie(Term):
    """Springs between two faces that lie on each other in the undeformed bodies.

    The energy ``1/2 int k |d_a - d_b|^2 dS`` over facets of the undeformed body a pulls each of
    their points to the point of body b that was at the same place. Meshes and backgrounds need
    not match. A traction t opens a gap of ``t / k``; where that is to be small beside the strain of
    domains of size h, take k some hundred times a modulus over h. Where particles of either are
    deleted (``outside="delete"``) nothing is tied any more.

    Give it to ``QuasiStaticProblem([a, b], ..., terms=[tie])``.

    Args:
        a: The body whose facets are integrated over; best the one with the finer mesh.
        b: The other body.
        facet_tags: Tags of the facets of a.
        tag: The tag of those that are tied.
        stiffness: k, force per undeformed area and gap.
        quadrature_degree: Degree of the rule on each facet; ``None`` is twice that of the shape
            functions of a, which is exact where the nodes of both faces match.
        axisymmetric: Whether ``x[0]`` is a radius, and the face that of a body of revolution.

    Raises:
        MPMError: Bodies that do not hang together (methods with domains apart), curved facets, or
            what makes no sense.
    """

    one_sided = False
    symmetric = True
    movable = True  # it finds its points on other ranks

    @collective()
    def __init__(
        self,
        a: Particles,
        b: Particles,
        facet_tags: mesh.MeshTags,
        tag: int,
        stiffness: float,
        quadrature_degree: int | None = None,
        axisymmetric: bool = False,
    ) -> None:
        for body in (a, b):
            require_shared_nodes("A Tie", body)
        if a is b:
            raise MPMError("A Tie needs two bodies, not the same one twice.")
        self.stiffness = as_positive(stiffness, "The stiffness of a Tie")
        if _compat.geometry_degree(a.mesh) > 1:
            raise MPMError("A Tie needs straight facets; exchange the two bodies.")
        require_on_boundary(a.mesh, facet_tags, [tag], "a Tie")
        super().__init__([a, b])
        self._tags, self._tag = facet_tags, tag
        degree = 2 * a.W.ufl_element().degree if quadrature_degree is None else quadrature_degree
        require_whole("quadrature_degree of a Tie", degree, 100)  # 51 points each way
        self._degree, self.axisymmetric = int(degree), axisymmetric
        self._faces = self._found()
        self._springs = self._sprung(self._present())

    @override
    def begin(self) -> Sequence[PETSc.Vec]:
        """Look for the points again where bodies have other meshes, or lost domains."""
        bodies = zip(self.bodies, self._faces.spaces, strict=True)
        if any(body.W is not known for body, known in bodies):
            self._faces = self._found()
            self._springs = self._sprung(self._present())
            return ()
        held = self._present()
        changed = not np.array_equal(held, self._springs.held)
        if self.bodies[0].mesh.comm.allreduce(changed, MPI.LOR):
            self._springs = self._sprung(held)
        return ()

    def _found(self) -> _Faces:
        """Return the points of the face in both bodies (collective)."""
        a, b = self.bodies
        points, weights = self._points(a, a.carry(self._tags))
        spaces = a.W, b.W
        at = [interpolation(W, points, a.mesh.comm) for W in spaces]
        with agree(a.mesh.comm):
            for body, (_, found) in zip((a, b), at, strict=True):
                if not found.all():
                    where = tuple(float(f"{x:.6g}") for x in points[~found][0])
                    count = "no" if body is a else "only one"
                    raise MPMError(
                        f"The point {where} of a Tie is in {count} body; "
                        "faces that are tied lie on each other in the undeformed bodies."
                    )
        return _Faces(spaces, [rows for rows, _ in at], np.repeat(weights, points.shape[1]))

    def _present(self) -> NDArray[np.bool_]:
        """Return at which rows of the points both bodies are still there (collective)."""
        held = np.ones(len(self._faces.weights), dtype=bool)
        for body, rows in zip(self.bodies, self._faces.rows, strict=True):
            held &= at_present(body, rows)
        return held

    def _sprung(self, held: NDArray[np.bool_]) -> _Springs:
        """Return the springs at points that are held (collective)."""
        weights = np.where(held, self._faces.weights, 0.0)
        diagonal = self._faces.rows[0].createVecLeft()
        diagonal.array_w[:] = weights
        blocks: dict[tuple[int, int], PETSc.Mat] = {}
        for j, right in enumerate(self._faces.rows):
            scaled = right.copy()
            scaled.diagonalScale(L=diagonal)
            for i, left in enumerate(self._faces.rows):
                block = left.transposeMatMult(scaled)
                if i != j:
                    block.scale(-1.0)
                blocks[i, j] = block
        return _Springs(held, weights, blocks, {pair: one.copy() for pair, one in blocks.items()})

    def _points(
        self, body: Particles, tags: mesh.MeshTags
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return points and weights of this rank's own facets."""
        domain, dim = body.mesh, body.mesh.topology.dim - 1
        own = tags.find(self._tag)
        own = own[own < domain.topology.index_map(dim).size_local]
        kinds = (basix.CellType.interval, basix.CellType.triangle)
        cell = domain.basix_cell()
        kind = kinds[dim - 1]
        if cell == basix.CellType.hexahedron:
            kind = basix.CellType.quadrilateral
        reference, weights = map(np.asarray, basix.make_quadrature(kind, self._degree))
        element = basix.create_element(basix.ElementFamily.P, kind, 1)
        shapes = np.asarray(element.tabulate(1, reference), dtype=np.float64)
        corners = domain.geometry.x[_compat.entity_nodes(domain, dim, own)][:, :, : dim + 1]
        points = np.einsum("qk,nki->nqi", shapes[0, :, :, 0], corners)
        along = np.einsum("jqk,nki->nqij", shapes[1:, :, :, 0], corners)
        area = np.sqrt(np.linalg.det(along.swapaxes(2, 3) @ along))
        if self.axisymmetric:
            area = 2.0 * np.pi * points[:, :, 0] * area
        return points.reshape(-1, dim + 1), (weights * area).ravel()

    def tractions(self) -> NDArray[np.float64]:
        """Return the pull of the springs on b at this rank's points, shape ``(n, gdim)``."""
        gaps = []
        for body, rows in zip(self.bodies, self._faces.rows, strict=True):
            d, gap = rows.createVecs()
            d.array_w[:] = body.displacement.x.array[: d.getLocalSize()]
            rows.mult(d, gap)
            gaps.append(gap.array_r)
        gdim = self.bodies[0].mesh.geometry.dim
        pull = np.where(self._springs.held, self.stiffness * (gaps[0] - gaps[1]), 0.0)
        return pull.reshape(-1, gdim)

    @property
    def reaction(self) -> NDArray[np.float64]:
        """Force on the first body, shape ``(gdim,)`` (collective)."""
        pull = -self._springs.weights * self.tractions().ravel()
        own = pull.reshape(-1, self.bodies[0].mesh.geometry.dim).sum(axis=0)
        return np.asarray(self.bodies[0].mesh.comm.allreduce(own))

    @override
    def residuals(self) -> Sequence[PETSc.Vec]:
        pull = self._springs.weights * self.tractions().ravel()
        forces = []
        for sign, rows in zip((1.0, -1.0), self._faces.rows, strict=True):
            force, at_points = rows.createVecs()
            at_points.array_w[:] = sign * pull
            rows.multTranspose(at_points, force)
            forces.append(force)
        return forces

    @override
    def tangents(self) -> Mapping[tuple[int, int], PETSc.Mat]:
        tangents = self._springs.tangents
        for pair, block in self._springs.blocks.items():
            block.copy(tangents[pair], structure=PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
            tangents[pair].scale(self.stiffness)
        return tangents


def at_present(body: Particles, rows: PETSc.Mat) -> NDArray[np.bool_]:
    """Return at which points a body is still there, for each component (collective).

    Args:
        body: The body.
        rows: The matrix from dofs of W to values at this rank's points.
    """
    if body.deletion is None:
        return np.ones(rows.getLocalSize()[0], dtype=bool)
    nodes, points = rows.createVecs()
    dim = body.mesh.geometry.dim
    nodes.array_w[:] = np.repeat(body.deletion.dead, dim)[: nodes.getLocalSize()]
    rows.mult(nodes, points)
    return np.asarray(np.abs(points.array_r) < NEGLIGIBLE)


def interpolation(
    W: fem.FunctionSpace, points: NDArray[np.float64], comm: Any
) -> tuple[PETSc.Mat, NDArray[np.bool_]]:
    """Return the matrix from dofs of W to values at points, and which points are in its mesh.

    Args:
        W: Space of a body (collective).
        points: This rank's points, shape ``(n, gdim)``.
        comm: Communicator of the points.
    """
    basis = BackgroundBasis(W).at(points)
    n, k = basis.nodes.shape
    gdim = points.shape[1]
    component = np.arange(gdim)
    columns = basis.nodes[:, None, :] * gdim + component[:, None]
    values = np.broadcast_to(basis.values[:, None, :], columns.shape)
    offsets = k * np.arange(n * gdim + 1)
    size = W.dofmap.index_map
    csr = (
        offsets.astype(PETSc.IntType),
        columns.ravel().astype(PETSc.IntType),
        np.ascontiguousarray(values).ravel(),
    )
    sizes = ((n * gdim, None), (size.size_local * gdim, size.size_global * gdim))
    return PETSc.Mat().createAIJ(sizes, csr=csr, comm=comm), basis.found
