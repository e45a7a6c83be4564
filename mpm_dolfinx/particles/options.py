# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Options of particles, and the errors for those that are not valid."""

from __future__ import annotations

import zlib
from typing import Any

from mpi4py import MPI

import numpy as np
from numpy.typing import NDArray

import basix
import basix.ufl
from dolfinx import fem, mesh

from .. import _compat
from ..errors import DomainDistortionError, MPMError, agree, name_particles, not_with
from ..meshes.boxes import BOX_CELLS
from ..meshes.cells import cell_vertices, input_cell_index
from ..meshes.jacobian_bound import JacobianBound
from ..meshes.order import gmsh_order
from ..meshes.quadrature import default_degree, determinant
from ..parallel.exchange import swap
from ..parallel.given import require_whole
from ..reals import is_one_of
from ..tolerances import BLOCK
from ..transfer.methods import METHODS

__all__ = [
    "Coordinates",
    "not_divisible",
    "validate_cells",
    "validate_distortion",
    "validate_options",
    "validate_spaces",
]

DEGREES = (1, 2, 3)


class Coordinates:
    """Coordinates of a mesh at an earlier time.

    Args:
        domain: The mesh.
        what: What it is called in a sentence.
    """

    def __init__(self, domain: mesh.Mesh, what: str) -> None:
        self._domain = domain
        self._what = what
        self._sum = self._checksum()

    def _checksum(self) -> int:
        return zlib.crc32(np.ascontiguousarray(self._domain.geometry.x))

    def require_same(self) -> None:
        """Raise an error where they are others now on this rank."""
        if self._checksum() != self._sum:
            raise MPMError(
                f"The coordinates of the {self._what} mesh were changed after the particles were "
                "made; make the particles and the problem anew, on the mesh as it is."
            )


def validate_spaces(body: Any, V: Any) -> None:
    """Raise an error unless a body and a background space, if any, go together (collective)."""
    if not isinstance(body, mesh.Mesh):
        raise MPMError(f"The body must be a dolfinx.mesh.Mesh, not {type(body).__name__}.")
    with agree(body.comm):
        _require_mesh("body", body)
        if V is not None:
            _require_spaces(body, V)


def _require_mesh(what: str, domain: mesh.Mesh) -> None:
    gdim = domain.geometry.dim
    if what == "body" and (gdim not in (2, 3) or domain.topology.dim != gdim):
        raise MPMError(
            f"The body must fill its space in 2-D or 3-D; it has topological dimension "
            f"{domain.topology.dim} in {gdim} dimensions."
        )
    cells = ("triangle", "quadrilateral", "tetrahedron", "hexahedron")
    if domain.topology.cell_name() not in cells:
        raise MPMError(
            f"The {what} has {domain.topology.cell_name()} cells; use one of {', '.join(cells)}."
        )
    if domain.geometry.x.dtype != np.float64:
        raise MPMError(
            f"The {what} mesh has coordinates of type {domain.geometry.x.dtype}; make it with "
            "dtype=np.float64, as PETSc here has double precision."
        )


def _require_spaces(body: mesh.Mesh, V: Any) -> None:
    if not isinstance(V, fem.FunctionSpace):
        raise MPMError(
            f"V must be a dolfinx FunctionSpace on the background, not {type(V).__name__}."
        )
    background = V.mesh
    gdim = body.geometry.dim
    if V.mesh is body:
        raise MPMError(
            "V lives on the body mesh; make it on the background mesh, or omit it for finite "
            "elements."
        )
    if background.geometry.dim != gdim or background.topology.dim != gdim:
        raise MPMError(
            f"The body is {gdim}-dimensional, the background {background.geometry.dim}-"
            "dimensional; both must have the same dimension."
        )
    _require_mesh("background", background)
    element = V.ufl_element()
    if (
        element.reference_value_shape != (gdim,)
        or element.family_name != "P"
        or (element.discontinuous)
    ):
        raise MPMError(
            f"V must be a continuous Lagrange space of vectors with {gdim} components, e.g. "
            f'fem.functionspace(background, ("Lagrange", 1, ({gdim},))).'
        )
    if V.dofmap.index_map_bs != gdim:
        raise MPMError("V must not be a subspace; pass the whole vector space.")
    if body.comm.size != background.comm.size:
        raise MPMError(
            "The body and the background live on different numbers of ranks; make both on the "
            "same communicator."
        )
    if MPI.Comm.Compare(body.comm, background.comm) not in (MPI.IDENT, MPI.CONGRUENT):
        raise MPMError(
            "The body and the background number their ranks differently; make both on the same "
            "communicator."
        )


def _validate_degrees(body: mesh.Mesh, background: int | None, domains: Any) -> None:
    """Raise an error unless the degrees of background and domains are a good pair.

    Domains of a lower degree than the background's lose its order; quadrilaterals and hexahedra
    with one point also have modes without strain at any density (docs/high-order.md).
    """
    if background is not None and background not in DEGREES:
        raise MPMError(
            f"The background has degree {background}; use "
            f"{'1' if background < 1 else '3, the highest that is supported'}."
        )
    if isinstance(domains, bool) or not isinstance(domains, int) or domains not in DEGREES:
        raise MPMError(f"The domains' degree must be 1, 2 or 3, not {domains!r}.")
    if background is not None and domains < background:
        hourglass = domains == 1 and body.basix_cell() in BOX_CELLS
        why = "leave modes without strain and lose its order" if hourglass else "lose its order"
        raise MPMError(
            f"Domains of degree {domains} on a background of degree {background} {why}; use "
            f"degree={background}, or a background of degree {domains}."
        )


def validate_options(
    body: mesh.Mesh,
    V: fem.FunctionSpace | None,
    method: str,
    degree: int,
    quadrature_degree: int | None,
    outside: str,
    free: bool,
) -> None:
    """Raise an error unless method, degrees and policies go together.

    Those of :class:`Particles`, and whether some nodes have unknowns of their own.
    """
    if not is_one_of(method, METHODS):
        raise MPMError(f"Unknown method {method!r}; choose one of {', '.join(map(repr, METHODS))}.")
    if METHODS[method].free != (V is None):
        raise MPMError(
            f"Method {method!r} has no background; omit V."
            if V is not None
            else f"Method {method!r} needs a background space V; finite elements have no method."
        )
    background = None if V is None else V.ufl_element().degree
    _validate_degrees(body, background, degree)
    if METHODS[method].one_point and (background, degree, quadrature_degree or 1) != (1, 1, 1):
        raise MPMError(
            f"Method {method!r} has one quadrature point per domain of degree 1, on a background "
            "of degree 1; use 'cpdi2' for others."
        )
    if quadrature_degree is not None:
        require_whole("quadrature_degree", quadrature_degree, 30)  # 16 points each way
    enough = default_degree(body.basix_cell().name, degree, free)
    least = enough if free else 2 * degree - 2
    if quadrature_degree is not None and quadrature_degree < least and (degree > 1 or free):
        raise MPMError(
            f"A rule of degree {quadrature_degree} does not see all strains of a domain of degree "
            f"{degree}; use quadrature_degree={enough} or more"
            + (", as nodes with unknowns of their own need." if free else ".")
        )
    if not is_one_of(outside, ("error", "stop", "delete")):
        raise MPMError(f"Unknown policy outside={outside!r}; choose 'error', 'stop' or 'delete'.")
    if V is None and outside != "error":
        elements = "finite elements, which have no background to leave"
        raise not_with(f"outside={outside!r}", elements, "omit it")


def validate_free(V: fem.FunctionSpace | None, method: str, on_distortion: str) -> None:
    """Raise an error unless some nodes may be free and the others carried."""
    if V is None:
        raise MPMError("Without V all nodes are free; omit free=.")
    if method != "cpdi2":
        raise MPMError(f"Free nodes are shared by neighbours; use method='cpdi2', not {method!r}.")
    if on_distortion != "error":
        raise not_divisible()


def validate_distortion(
    body: mesh.Mesh, method: str, degree: int, quadrature_degree: int | None, policy: str
) -> None:
    """Raise an error unless the policy for distorted domains is one for these domains."""
    if not is_one_of(policy, ("error", "split")):
        raise MPMError(f"Unknown policy on_distortion={policy!r}; choose 'error' or 'split'.")
    plain = (body.basix_cell(), _compat.geometry_degree(body)) == (BOX_CELLS[0], 1)
    one_point = plain and (method, degree) == ("cpdi2", 1) and quadrature_degree in (None, 0, 1)
    if policy == "split" and not one_point:
        raise not_divisible()


def not_divisible() -> MPMError:
    """Return the error that says which domains can be split."""
    return MPMError(
        "Only quadrilaterals in the plane with one quadrature point, method 'cpdi2' and no free "
        "nodes can be split, where no f_bar= or length= averages over several (on_distortion="
        "'split'); others fold less with quadrature_degree=2 and f_bar='domain'."
    )


def validate_cells(domain: mesh.Mesh, what: str) -> None:
    """Raise an error where cells of a mesh have no volume or overlap (collective).

    Cells with a Jacobian determinant of both signs are folded (a quadrilateral that crosses itself
    or is concave); neighbours on the same side of their facet lie on each other.

    Args:
        domain: The mesh.
        what: What it is called in a sentence.

    Raises:
        DomainDistortionError: It names the cells, as particles are named.
    """
    comm, gdim, cell = domain.comm, domain.geometry.dim, domain.basix_cell()
    index = input_cell_index(domain)
    nodes = domain.geometry.x[_compat.geometry_dofmap(domain)[: len(index)], :gdim]
    span = np.ptp(nodes, axis=1).max(axis=1, initial=0.0)
    sign, volume, folded = _shapes(cell, _compat.geometry_degree(domain), nodes)
    flat = ~(np.abs(volume) > 1e-12 * span**gdim)
    wrong, every = comm.allreduce(np.array([np.count_nonzero(folded), len(index)]))
    if 2 * wrong > every:
        order = gmsh_order(cell, nodes.shape[1])
        still = _shapes(cell, _compat.geometry_degree(domain), nodes[:, order])[2].sum()
        if comm.allreduce(int(still)) == 0:
            raise DomainDistortionError(
                f"The cells of the {what} cross themselves, as their vertices are in Gmsh's order "
                f"(around the cell); give cells[:, {order.tolist()}] to create_mesh, which wants "
                "DOLFINx's, or read the file by dolfinx.io."
            )
    with agree(comm):
        _require_none(what, "have no volume", index[flat])
        _require_none(what, "are folded or concave", index[folded])
    lying = _on_each_other(domain, sign, index)
    with agree(comm):
        _require_none(what, "lie on a neighbour, as where a vertex is beyond an edge", lying)


def _require_none(what: str, how: str, cells: NDArray[np.int64]) -> None:
    """Raise an error where there are cells of a kind; those of a body are particles."""
    if len(cells) and what == "body":
        raise DomainDistortionError(
            f"The domains of {{particles}} {how}; mend the body mesh.", cells
        )
    if len(cells):
        named = name_particles(cells.tolist()).replace("particle", "cell")
        raise DomainDistortionError(f"The {what} mesh has cells that {how} ({named}); mend it.")


def _shapes(
    cell: basix.CellType, degree: int, nodes: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return sign, size of the Jacobian and whether they are folded, of cells ``(n, k, gdim)``."""
    element = basix.ufl.element("Lagrange", cell.name, degree).basix_element
    reference, gdim = np.asarray(element.points), nodes.shape[2]
    ends = [int(np.abs(reference - e).sum(axis=1).argmin()) for e in np.eye(gdim)]
    origin = nodes[:, :1]
    axes = nodes[:, ends] - origin
    volume = determinant(axes)
    straight = np.einsum("ka,nai->nki", reference, axes) + origin
    slack = 1e-10 * np.ptp(nodes, axis=1).max(axis=1, initial=0.0)
    bent = np.flatnonzero(np.abs(nodes - straight).max(axis=(1, 2), initial=0.0) > slack)
    sign, folded = np.where(volume < 0.0, -1.0, 1.0), np.zeros(len(nodes), dtype=bool)
    if len(bent):
        bound = JacobianBound(cell, element)
        for block in np.split(bent, range(BLOCK, len(bent), BLOCK)):
            sign[block], volume[block], folded[block] = bound.folded(nodes[block])
    return sign, volume, folded


def _on_each_other(
    domain: mesh.Mesh, sign: NDArray[np.float64], index: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return input indices of cells that are on the same side of a facet as a neighbour."""
    comm, cell = domain.comm, domain.basix_cell()
    vertices = cell_vertices(domain, len(index))
    corners = basix.geometry(cell)
    keys, sides = [], []
    for facet in basix.topology(cell)[-2]:
        ring = [facet[i] for i in ((0, 1, 3, 2) if len(facet) == 4 else range(len(facet)))]
        edges = corners[ring[1:3]] - corners[ring[0]]
        if len(ring) == 2:
            normal = np.array([edges[0, 1], -edges[0, 0]])
        else:
            normal = np.cross(edges[0], edges[1])
        outward = np.sign(normal @ (corners[ring].mean(axis=0) - corners.mean(axis=0)))
        around = vertices[:, ring]
        if len(ring) == 2:
            turn = np.where(around[:, 0] < around[:, 1], 1.0, -1.0)
        else:
            least = around.argmin(axis=1)[:, None]
            after = np.take_along_axis(around, (least + 1) % len(ring), axis=1)
            before = np.take_along_axis(around, (least - 1) % len(ring), axis=1)
            turn = np.where(after < before, 1.0, -1.0)[:, 0]
        keys.append(_mixed(around).sum(axis=1))
        sides.append(outward * turn * sign)
    cells = np.tile(np.arange(len(index)), len(keys))
    table = np.column_stack(
        [
            np.concatenate(keys).view(np.int64),
            np.concatenate(sides).astype(np.int64),
            index[cells],
        ]
    )
    pairs, alone = _neighbours(table)
    if comm.size > 1:
        home = alone[:, 0].view(np.uint64) % np.uint64(comm.size)
        parts = [alone[home == rank] for rank in range(comm.size)]
        pairs = np.concatenate([pairs, _neighbours(np.concatenate(swap(comm, parts)))[0]])
    bad = pairs[pairs[:, 1] == pairs[:, 3]]
    named, times = np.unique(bad[:, [2, 4]], return_counts=True)
    whole = len(keys)
    most = named[2 * times > whole]
    return most if len(most) else named


def _neighbours(
    table: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return pairs of rows (key, side, cell) with one key, and rows that are alone."""
    table = table[np.argsort(table[:, 0], kind="stable")]
    same = np.flatnonzero(table[1:, 0] == table[:-1, 0])
    pairs = np.column_stack([table[same], table[same + 1, 1:]])
    paired = np.zeros(len(table), dtype=bool)
    paired[same], paired[same + 1] = True, True
    return pairs, table[~paired]


def _mixed(numbers: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Return numbers as 64 bits without a pattern, to be added up (splitmix64)."""
    z = numbers.astype(np.uint64) + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))
