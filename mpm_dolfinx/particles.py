# Copyright (C) 2026 the mpm-dolfinx authors
# SPDX-License-Identifier: LGPL-3.0-or-later
"""Particles: a body mesh whose displacement is carried by a background space."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

from petsc4py import PETSc

import numpy as np
from numpy.typing import NDArray

import basix
import ufl
from dolfinx import fem, mesh

from .errors import DomainDistortionError, MPMError, ParticleOutsideError, agree
from .location import BackgroundBasis, PointBasis
from .quadrature import DomainQuadrature, exact_degree, quadrature_element, quadrature_rule
from .transfer import Weights, active_nodes, domain_weights, sum_by_particle, transfer_matrix

if TYPE_CHECKING:
    from .constitutive import ConstitutiveHistory

__all__ = ["Particles"]

METHODS = ("cpdi2",)
DEGREES = {(1, 1)}


class Particles:
    """A body as particles with finite domains, moved by a background space.

    Each cell of ``body`` is the domain of one particle (second-order convected particle domain
    interpolation: Sadeghirad, Brannon & Guilkey 2013). The body mesh is the undeformed body and
    never moves; where the particles are is ``displacement``. A step's increment u in V moves
    the nodes of the domains by ``T u``.

    Args:
        body: Undeformed body: triangles or quadrilaterals in the plane, tetrahedra or
            hexahedra in space. Its cells are the particles.
        V: Vector Lagrange space on the background mesh, on the same ranks.
        method: ``"cpdi2"``.
        degree: Degree of the domains' shape functions.
        quadrature_degree: Degree of the rule that carries the history; ``None`` is one point
            per domain for degree 1.
        outside: What happens when a domain leaves the background; ``"error"``.

    Attributes:
        mesh: The body mesh, undeformed.
        V: The background space.
        W: Space of the domains' displacement.
        displacement: Total displacement d in W.
        increment: The background displacement u in V of the step being solved.
        load: The load factor, a Constant on the body mesh.
        dx: Measure with the rule that carries the history.
        dx_exact: Measure exact for body force and mass.
        num_local: Number of particles this rank owns.
        num_global: Number of particles of all ranks.
        global_index: Input index of each owned particle, shape ``(n,)``, the same on any number
            of ranks.

    Raises:
        MPMError: Spaces, meshes, method or degrees that do not go together.
        ParticleOutsideError: The body does not lie inside the background.
        DomainDistortionError: A cell of the body is degenerate.
    """

    def __init__(
        self,
        body: mesh.Mesh,
        V: fem.FunctionSpace,
        method: str = "cpdi2",
        degree: int = 1,
        quadrature_degree: int | None = None,
        outside: str = "error",
    ) -> None:
        _validate(body, V, method, degree, quadrature_degree, outside)
        self.mesh = body
        self.V = V
        self.method = method
        self._gdim = body.geometry.dim
        cell = body.basix_cell()
        self.W = fem.functionspace(body, ("Lagrange", degree, (self._gdim,)))
        self.displacement = fem.Function(self.W, name="displacement")
        self.increment = fem.Function(V, name="increment")
        self.load = fem.Constant(body, 0.0)
        self._degree = quadrature_degree if quadrature_degree is not None else 2 * degree - 1
        self._exact_degree = exact_degree(cell.name, degree)
        self.dx = self._measure(self._degree)
        self.dx_exact = self._measure(self._exact_degree)

        cells = body.topology.index_map(body.topology.dim)
        self.num_local = int(cells.size_local)
        self.num_global = int(cells.size_global)
        self.global_index: NDArray[np.int64] = np.asarray(
            body.topology.original_cell_index[: self.num_local], dtype=np.int64
        )
        self._shape_functions = self.W.ufl_element().basix_element
        self.quadrature = DomainQuadrature(body, self._shape_functions, self._degree)
        self._domain_nodes = self.W.dofmap.list[: self.num_local]
        self._nodes = self.W.tabulate_dof_coordinates()[:, : self._gdim].copy()
        self._background = BackgroundBasis(V)
        self._converged = np.zeros_like(self._nodes)
        self._constitutive: ConstitutiveHistory | None = None
        with agree(body.comm):
            flat = self.global_index[self.quadrature.weights.min(axis=1, initial=1.0) <= 0.0]
            if len(flat):
                raise DomainDistortionError(
                    "The domains of {particles} have no volume; mend the body mesh.",
                    flat,
                )
        self.locate()

    def _measure(self, degree: int) -> ufl.Measure:
        metadata = {"quadrature_degree": degree, "quadrature_rule": "default"}
        return ufl.Measure("dx", domain=self.mesh, metadata=metadata)

    def locate(self) -> None:
        """Find the background cells of all domain nodes, unless that is done (collective).

        Raises:
            ParticleOutsideError: A domain of the last converged step is not wholly inside the
                background.
        """
        self._basis

    def _locate(self) -> PointBasis:
        positions = self._nodes + self._converged
        basis = self._background.at(positions)
        with agree(self.mesh.comm):
            missing = ~basis.found
            if missing.any():
                lost = np.flatnonzero(missing[self._domain_nodes].any(axis=1))
                where = positions[missing][0]
                raise ParticleOutsideError(
                    "The domains of {particles} are outside the background mesh, e.g. at "
                    f"{tuple(float(round(c, 6)) for c in where)}; "
                    "make the background larger or the load smaller.",
                    self.global_index[lost],
                )
        return basis

    @cached_property
    def _basis(self) -> PointBasis:
        """Background basis at the local nodes of W, at the last converged positions."""
        return self._locate()

    @cached_property
    def T(self) -> PETSc.Mat:
        """The transfer: all dofs of W by all dofs of V, at the last converged positions."""
        return transfer_matrix(self._basis, self.W, self.V)

    @cached_property
    def _active_nodes(self) -> NDArray[np.int32]:
        return active_nodes(self._basis, self.W, self.V)

    @property
    def active_dofs(self) -> NDArray[np.int64]:
        """Global dofs of V with weight that this rank owns, sorted."""
        bs = self.V.dofmap.index_map_bs
        start = self.V.dofmap.index_map.local_range[0]
        return np.asarray(
            ((self._active_nodes + start)[:, None] * bs + np.arange(bs)).ravel(), dtype=np.int64
        )

    def weights(self) -> Weights:
        """Return the published weights S_ip and grad S_ip of the current configuration.

        Returns:
            Compressed rows, one for each particle this rank owns (Sadeghirad, Brannon &
            Guilkey 2013; their body force uses these, ours integrates over the undeformed
            body, which is the same for triangles and undistorted quadrilaterals).
        """
        _, average, gradient = self._domain_averages()
        return sum_by_particle(average, gradient, self._basis, self._domain_nodes)

    def _domain_averages(
        self,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        corners = (self._nodes + self._converged)[self._domain_nodes]
        return domain_weights(
            corners, self._shape_functions, self.mesh.basix_cell(), self._exact_degree
        )

    def quadrature_function(self, name: str, shape: tuple[int, ...] = ()) -> fem.Function:
        """Return a Function for data at the history's points, to be injected into a form.

        Args:
            name: Its name.
            shape: Shape of a value.

        Returns:
            Function on a quadrature element, integrated with ``particles.dx``. Its values
            cell by cell are ``f.x.array.reshape(-1, nq, *shape)``.
        """
        element = quadrature_element(self.mesh.basix_cell().name, self._degree, tuple(shape))
        return fem.Function(fem.functionspace(self.mesh, element), name=name)

    @property
    def num_points(self) -> int:
        """Number of quadrature points of each domain."""
        return int(self.quadrature.weights.shape[1])

    def _nodal(self) -> NDArray[np.float64]:
        """Displacement of the domains' nodes now, shape ``(n, k, gdim)``."""
        nodal = self.displacement.x.array.reshape(-1, self._gdim)
        return np.asarray(nodal[self._domain_nodes])

    def displacement_gradient(self) -> NDArray[np.float64]:
        """Return ``grad d`` at the history's points, shape ``(n, nq, gdim, gdim)``."""
        return self.quadrature.displacement_gradient(self._nodal())

    def _average(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return volume averages of values ``(n, nq, ...)`` over the undeformed domains."""
        share = self.quadrature.weights / self.quadrature.weights.sum(axis=1, keepdims=True)
        return np.asarray(np.einsum("nq,nq...->n...", share, values))

    @property
    def deformation_gradient(self) -> NDArray[np.float64]:
        """Deformation gradient, shape ``(n, 3, 3)`` (volume averages, plane strain in 2-D)."""
        F = np.tile(np.eye(3), (self.num_local, 1, 1))
        F[:, : self._gdim, : self._gdim] += self._average(self.displacement_gradient())
        return F

    @property
    def initial_volume(self) -> NDArray[np.float64]:
        """Volume of the undeformed domains, shape ``(n,)``; an area in the plane."""
        return self._whole.weights.sum(axis=1)

    @property
    def volume(self) -> NDArray[np.float64]:
        """Volume of the domains now, shape ``(n,)``; an area in the plane."""
        gradient = self._whole.displacement_gradient(self._nodal())
        jacobian = np.linalg.det(np.eye(self._gdim) + gradient)
        return np.asarray((self._whole.weights * jacobian).sum(axis=1))

    @property
    def initial_centroid(self) -> NDArray[np.float64]:
        """Centroid of the undeformed domains, shape ``(n, gdim)``."""
        return self._mean(self._nodes[self._domain_nodes])

    @property
    def centroid(self) -> NDArray[np.float64]:
        """Particle positions: mean of ``X + d`` over the domains, shape ``(n, gdim)``."""
        return self._mean(self._nodes[self._domain_nodes] + self._nodal())

    def _mean(self, nodal: NDArray[np.float64]) -> NDArray[np.float64]:
        whole = self._whole
        total = np.einsum("nq,qk,nki->ni", whole.weights, whole.shapes, nodal)
        return np.asarray(total / whole.weights.sum(axis=1)[:, None])

    @cached_property
    def _whole(self) -> DomainQuadrature:
        return DomainQuadrature(self.mesh, self._shape_functions, self._exact_degree)

    @property
    def has_material(self) -> bool:
        """Whether a problem with a material governs these particles."""
        return self._constitutive is not None

    @property
    def stress(self) -> NDArray[np.float64]:
        """Cauchy stress, shape ``(n, 3, 3)`` (volume averages).

        Raises:
            MPMError: The particles have no material (a problem written in UFL).
        """
        return self._average(self._history("stress").cauchy_stress())

    @property
    def plastic_strain(self) -> NDArray[np.float64]:
        """Accumulated plastic strain ``sqrt(2/3) |d eps_p|``, shape ``(n,)``."""
        return self._average(self._history("plastic strain").plastic_strain())

    def _history(self, what: str) -> ConstitutiveHistory:
        if self._constitutive is None:
            raise MPMError(
                f"These particles have no material, so no {what}; give them one with "
                "QuasiStaticProblem, or evaluate your own UFL expression."
            )
        return self._constitutive

    def crossed(self) -> NDArray[np.int64]:
        """Return global indices of quadrilaterals whose edges cross.

        A quadrilateral with one corner turned inwards is concave, with two it crosses itself
        and part of it is inverted. Other domains cannot cross without ``det F <= 0``.
        """
        if self.mesh.basix_cell() != basix.CellType.quadrilateral:
            return self.global_index[:0]
        inwards = (self._corner_jacobians() <= 0.0).sum(axis=1)
        return np.asarray(self.global_index[inwards >= 2])

    def _corner_jacobians(self) -> NDArray[np.float64]:
        """Return det J at the corners of the present domains, positive as in the undeformed."""
        points = basix.geometry(self.mesh.basix_cell())
        slopes = self._shape_functions.tabulate(1, points)[1:, :, :, 0]
        now = self._nodes[self._domain_nodes] + self._nodal()
        det = np.linalg.det(np.einsum("jqk,nki->nqij", slopes, now))
        return np.asarray(np.sign(self._orientation) * det)

    def domain_distortion(self) -> NDArray[np.float64]:
        """Return the smallest det J at a node of each domain over its mean, shape ``(n,)``.

        One for an undistorted domain, zero or less where a quadrilateral is concave.
        """
        mean = self.volume / quadrature_rule(self.mesh.basix_cell(), 0)[1].sum()
        return np.asarray(self._corner_jacobians().min(axis=1) / np.abs(mean))

    @cached_property
    def _orientation(self) -> NDArray[np.float64]:
        """Sign of the reference map of each undeformed domain, shape ``(n, 1)``."""
        middle = basix.geometry(self.mesh.basix_cell()).mean(axis=0)[None]
        slopes = self._shape_functions.tabulate(1, middle)[1:, :, :, 0]
        corners = self._nodes[self._domain_nodes]
        return np.asarray(np.linalg.det(np.einsum("jqk,nki->nqij", slopes, corners)))

    def inverted(self) -> NDArray[np.int64]:
        """Return global indices of domains with ``det F <= 0`` or not finite at a point."""
        gradient = self.displacement_gradient()
        jacobian = np.linalg.det(np.eye(self._gdim) + gradient)
        return np.asarray(self.global_index[~(jacobian > 0.0).all(axis=1)])

    def _commit(self) -> None:
        """Make the present displacement the converged one."""
        self._converged = self.displacement.x.array.reshape(-1, self._gdim).copy()
        for name in ("_basis", "_active_nodes", "T"):
            self.__dict__.pop(name, None)

    def _roll_back(self) -> None:
        """Restore the converged displacement."""
        self.displacement.x.array[:] = self._converged.ravel()
        self.increment.x.array[:] = 0.0


def _validate(
    body: Any, V: Any, method: str, degree: int, quadrature_degree: int | None, outside: str
) -> None:
    if not isinstance(body, mesh.Mesh):
        raise MPMError(f"The body must be a dolfinx.mesh.Mesh, not {type(body).__name__}.")
    if not isinstance(V, fem.FunctionSpace):
        raise MPMError(
            f"V must be a dolfinx FunctionSpace on the background, not {type(V).__name__}."
        )
    background = V.mesh
    gdim = body.geometry.dim
    if V.mesh is body:
        raise MPMError("V lives on the body mesh; make it on the background mesh.")
    if gdim not in (2, 3) or body.topology.dim != gdim:
        raise MPMError(
            f"The body must fill its space in 2-D or 3-D; it has topological dimension "
            f"{body.topology.dim} in {gdim} dimensions."
        )
    if background.geometry.dim != gdim or background.topology.dim != gdim:
        raise MPMError(
            f"The body is {gdim}-dimensional, the background {background.geometry.dim}-"
            "dimensional; both must have the same dimension."
        )
    cells = ("triangle", "quadrilateral", "tetrahedron", "hexahedron")
    for what, domain in (("body", body), ("background", background)):
        if domain.topology.cell_name() not in cells:
            raise MPMError(
                f"The {what} has {domain.topology.cell_name()} cells; use one of "
                f"{', '.join(cells)}."
            )
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
    if method not in METHODS:
        raise MPMError(f"Unknown method {method!r}; choose one of {', '.join(map(repr, METHODS))}.")
    if (element.degree, degree) not in DEGREES:
        raise MPMError(
            f"Domains of degree {degree!r} on a background of degree {element.degree} are not "
            "supported; use degree 1 on 1."
        )
    if quadrature_degree is not None and (
        not isinstance(quadrature_degree, int) or quadrature_degree < 0
    ):
        raise MPMError(
            f"quadrature_degree must be a whole number from 0 on, not {quadrature_degree!r}."
        )
    if outside != "error":
        raise MPMError(f"Unknown policy outside={outside!r}; choose 'error'.")
    if body.comm.size != background.comm.size:
        raise MPMError(
            "The body and the background live on different numbers of ranks; make both on the "
            "same communicator."
        )
