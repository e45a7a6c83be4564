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

from . import _compat
from .deletion import Deletion, without_deleted
from .errors import DomainDistortionError, MPMError, ParticleOutsideError, agree
from .folding import JacobianBound
from .location import BackgroundBasis, PointBasis
from .methods import (
    BOX_CELLS,
    BoxGrid,
    DomainState,
    Rows,
    boxes,
    cpdi,
    cpdi2,
    gimp,
    mpm,
    require_boxes,
)
from .partition import Redistribution, cell_centres, ranks_of_background
from .quadrature import (
    DomainQuadrature,
    default_degree,
    exact_degree,
    quadrature_element,
    quadrature_rule,
    volume_ratio,
)
from .transfer import Weights, active_nodes, domain_weights, sum_by_particle, transfer_matrix
from .validation import validate_options, validate_spaces

if TYPE_CHECKING:
    from .constitutive import ConstitutiveHistory

__all__ = ["Particles"]


class Particles:
    """A body as particles with finite domains, moved by a background space.

    Each cell of ``body`` is the domain of one particle. The body mesh is the undeformed body
    and never moves; where the particles are is ``displacement``. A step's increment u in V
    moves the nodes of the domains by ``T u``. The methods differ in T alone:

    - ``"cpdi2"``: corners ride on the background (Sadeghirad, Brannon & Guilkey 2013);
    - ``"cpdi"``: parallelograms that the particle's F deforms (Sadeghirad, Brannon &
      Burghardt 2011);
    - ``"gimp"``: axis-aligned boxes (Bardenhagen & Kober 2004), on structured backgrounds of
      rectangles or boxes;
    - ``"mpm"``: points (Sulsky, Chen & Schreyer 1994).

    Args:
        body: Undeformed body: triangles or quadrilaterals in the plane, tetrahedra or
            hexahedra in space. Its cells are the particles.
        V: Vector Lagrange space on the background mesh, on the same ranks.
        method: ``"cpdi2"``, ``"cpdi"``, ``"gimp"`` or ``"mpm"``.
        degree: Degree of the domains' shape functions.
        quadrature_degree: Degree of the rule that carries the history; ``None`` is one point
            per domain for degree 1.
        outside: What happens when a step takes a corner of a domain out of the background:
            ``"error"`` ends the run with an error, ``"stop"`` without one (both before that
            step), ``"delete"`` goes on without the domain and adds up what is lost.
        domain_update: For ``"gimp"``: ``"stretch"`` (half-lengths follow the diagonal of the
            right stretch) or ``"fixed"`` (the box only translates).
        partition: ``"given"`` leaves the cells of ``body`` on their ranks; ``"background"``
            makes ``mesh`` a copy of it whose cells are on the ranks that own the background
            where they lie, as evenly as can be.

    Attributes:
        mesh: The body mesh, undeformed: ``body``, or its copy with ``partition="background"``.
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
        domain_nodes: Local nodes of W of each owned domain, shape ``(n, k)``.
        outside: The policy for domains that leave the background.
        deletion: Which domains are deleted, with ``outside="delete"``, otherwise ``None``.

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
        domain_update: str = "stretch",
        partition: str = "given",
    ) -> None:
        validate_spaces(body, V)
        validate_options(body, V, method, degree, quadrature_degree, outside, domain_update)
        if partition not in ("given", "background"):
            raise MPMError(f"Unknown partition={partition!r}; choose 'given' or 'background'.")
        self._options: dict[str, Any] = {
            "method": method,
            "degree": degree,
            "quadrature_degree": quadrature_degree,
            "outside": outside,
            "domain_update": domain_update,
        }
        self._moves: list[Redistribution] = []
        self._background = BackgroundBasis(V)
        if partition == "background":
            ranks = ranks_of_background(V, self._background, cell_centres(body))
            self._moves.append(Redistribution(body, ranks))
            body = self._moves[-1].mesh
        self.mesh = body
        self.V = V
        self.method = method
        self._gdim = body.geometry.dim
        cell = body.basix_cell()
        family = "Lagrange" if method == "cpdi2" else "Discontinuous Lagrange"
        self.W = fem.functionspace(body, (family, degree, (self._gdim,)))
        self.displacement = fem.Function(self.W, name="displacement")
        self.increment = fem.Function(V, name="increment")
        self.load = fem.Constant(body, 0.0)
        self._degree = (
            default_degree(cell.name, degree) if quadrature_degree is None else quadrature_degree
        )
        self._exact_degree = exact_degree(cell.name, degree)
        self.dx = self._measure(self._degree)
        self.dx_exact = self._measure(self._exact_degree)

        cells = body.topology.index_map(body.topology.dim)
        self.num_local = int(cells.size_local)
        self.num_global = int(cells.size_global)
        self.global_index = _compat.input_cell_index(body)
        self._shape_functions = self.W.ufl_element().basix_element
        self.quadrature = DomainQuadrature(body, self._shape_functions, self._degree)
        self.domain_nodes = self.W.dofmap.list[: self.num_local]
        self._nodes = self.W.tabulate_dof_coordinates()[:, : self._gdim].copy()
        self.outside = outside
        self.deletion = Deletion(body, self.W) if outside == "delete" else None
        self._domain_update = domain_update
        self._grid = None
        if method == "gimp":
            require_boxes(body, self._nodes[self.domain_nodes], self.global_index)
            self._grid = BoxGrid(V.mesh)
        self._converged = np.zeros_like(self._nodes)
        self._constitutive: ConstitutiveHistory | None = None
        self._gradient: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        with agree(body.comm):
            flat = self.global_index[self.quadrature.flat]
            if len(flat):
                raise DomainDistortionError(
                    "The domains of {particles} have no volume; mend the body mesh.",
                    flat,
                )
        self.locate()

    @classmethod
    def from_points(
        cls,
        points: NDArray[np.float64],
        lengths: NDArray[np.float64] | float,
        V: fem.FunctionSpace,
        method: str = "gimp",
        **options: Any,
    ) -> Particles:
        """Make particles of a cloud of axis-aligned boxes, without a mesh.

        Args:
            points: Centres of this rank's boxes, shape ``(n, gdim)``; each box is given by
                one rank.
            lengths: Side lengths, a number or shape ``(n, gdim)``.
            V: As for :class:`Particles`.
            method: As for :class:`Particles`. With ``"cpdi2"`` neighbours are not connected.
            **options: As for :class:`Particles`.

        Raises:
            MPMError: Shapes that do not fit, or lengths that are not positive.
        """
        gdim = V.mesh.geometry.dim
        comm = V.mesh.comm
        with agree(comm):
            centres = np.asarray(points, dtype=np.float64)
            if centres.ndim != 2 or centres.shape[1] != gdim or not np.isfinite(centres).all():
                raise MPMError(f"points must be finite and of shape (n, {gdim}).")
            try:
                sides = np.broadcast_to(np.asarray(lengths, np.float64), centres.shape)
            except ValueError:
                raise MPMError(
                    f"lengths must be a number or of shape {centres.shape}, not "
                    f"{np.shape(lengths)}."
                ) from None
            if not (np.isfinite(sides).all() and (sides > 0.0).all()):
                raise MPMError("lengths must be positive and finite.")
        cell = BOX_CELLS[gdim - 2]
        unit = basix.geometry(cell) - 0.5
        corners = centres[:, None] + unit * sides[:, None]
        return cls(_compat.disconnected_mesh(comm, corners, cell), V, method=method, **options)

    def carry(self, thing: Any) -> Any:
        """Return tags or a DG0 Function on ``mesh``, to which cells have moved (collective).

        Args:
            thing: ``MeshTags`` or a piecewise constant Function on the body mesh that was given,
                or on any ``mesh`` since; anything else is returned as it is.

        Raises:
            MPMError: A Function that is not piecewise constant.
        """
        for move in self._moves:
            thing = move.carry(thing)
        return thing

    def ranks_of_background(self) -> NDArray[np.int64]:
        """Return the rank on which each particle would best be now, shape ``(n,)`` (collective).

        That which owns the background where the particle is, or its own where that has 5 % more
        than an even share already.
        """
        return ranks_of_background(self.V, self._background, self.centroid)

    def move(self, ranks: NDArray[np.int64]) -> None:
        """Move particles to other ranks, undeformed (collective).

        ``mesh``, ``W``, ``displacement`` and ``load`` are new ones then. What else there is to
        be moved is the business of :meth:`QuasiStaticProblem.repartition`.

        Args:
            ranks: New rank of each particle this rank owns, shape ``(n,)``.
        """
        move = Redistribution(self.mesh, ranks)
        moves, V, increment, options = self._moves, self.V, self.increment, self._options
        self.__dict__.clear()
        Particles.__init__(self, move.mesh, V, **options)
        self._moves, self.increment = [*moves, move], increment

    def _measure(self, degree: int) -> ufl.Measure:
        metadata = {"quadrature_degree": degree, "quadrature_rule": "default"}
        return ufl.Measure("dx", domain=self.mesh, metadata=metadata)

    def locate(self) -> None:
        """Find the background cells of all domain nodes, unless that is done (collective).

        Raises:
            ParticleOutsideError: A domain of the last converged step is not wholly inside the
                background.
        """
        self._rows

    def _state(self) -> DomainState:
        """Return where the domains are at the last converged step."""
        return DomainState(
            self._nodes,
            self._converged,
            self.domain_nodes,
            self.initial_centroid,
            self._mean(self._nodes[self.domain_nodes] + self._of_domains(self._converged)),
            np.eye(self._gdim) + self._average(self._converged_gradient()),
        )

    def _found_rows(self) -> tuple[Rows, NDArray[np.int64]]:
        """Return the rows of T, and the local domains that are not wholly in the background."""
        if self.method == "cpdi2":
            rows = cpdi2(self.node_positions, self._background)
        elif self.method == "gimp":
            assert self._grid is not None
            stretch = self._domain_update == "stretch"
            rows = gimp(self._state(), self._background, self._grid, stretch)
        else:
            rows = {"cpdi": cpdi, "mpm": mpm}[self.method](self._state(), self._background)
        lost = (~rows.basis.found)[self.domain_nodes].any(axis=1)
        return rows, np.flatnonzero(lost & ~self.deleted)

    def _require_inside(self, lost: NDArray[np.int64], what: str, advice: str) -> None:
        with agree(self.mesh.comm):
            if len(lost):
                where = self.centroid[lost[0]]
                raise ParticleOutsideError(
                    f"{what} outside the background mesh, e.g. near "
                    f"{tuple(float(round(c, 6)) for c in where)}; {advice}",
                    self.global_index[lost],
                )

    def _of_domains(self, nodal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return displacements of nodes ``(N, gdim)`` for each domain, shape ``(n, k, gdim)``."""
        values: NDArray[np.float64] = nodal[self.domain_nodes]
        return values if self.deletion is None else self.deletion.kept(values)

    def _converged_gradient(self) -> NDArray[np.float64]:
        return self.quadrature.displacement_gradient(self._of_domains(self._converged))

    @cached_property
    def _rows(self) -> Rows:
        """The rows of T at the last converged positions."""
        rows, lost = self._found_rows()
        self._require_inside(
            lost,
            "The domains of {particles} are",
            "make the background larger or the load smaller",
        )
        return self._without_dead(rows)

    def _without_dead(self, rows: Rows) -> Rows:
        """Take the weight from nodes that belong to deleted domains only."""
        if self.deletion is not None:
            values = rows.basis.values
            values[self.deletion.dead[: len(values)]] = 0.0
            if rows.corners is not None:
                rows.corners[self.deleted] = self.domains[self.deleted]
        return rows

    @property
    def present_weights(self) -> NDArray[np.float64]:
        """Reference volumes of the history's points, shape ``(n, nq)``; 0 where deleted."""
        weights = self.quadrature.weights
        return np.where(self.deleted[:, None], 0.0, weights) if self.deletion else weights

    @property
    def deleted(self) -> NDArray[np.bool_]:
        """Whether each particle this rank owns is deleted, shape ``(n,)``."""
        if self.deletion is None:
            return np.zeros(self.num_local, dtype=bool)
        return self.deletion.mask

    def leaving(self) -> NDArray[np.int64]:
        """Return which of this rank's particles the last step took out (collective).

        Returns:
            Their local indices, with ``outside="delete"``; without it there are none.

        Raises:
            ParticleOutsideError: Some are outside and shall not be deleted, or all would be.
        """
        if self.deletion is None:
            self.locate()
            return np.zeros(0, dtype=np.int64)
        rows, lost = self._found_rows()
        left = self.num_local - int(self.deleted.sum()) - len(lost)
        if self.mesh.comm.allreduce(left) == 0:
            self._require_inside(
                lost,
                "The domains of {particles}, the last that were not deleted, are",
                "make the background larger or the load smaller",
            )
        self.__dict__["_rows"] = self._without_dead(rows)
        return lost

    def delete(self, domains: NDArray[np.int64]) -> None:
        """Delete domains (collective), after :meth:`leaving`.

        Args:
            domains: Local indices of this rank's particles.
        """
        assert self.deletion is not None
        self.deletion.add(domains, self._of_domains(self._converged))
        self._without_dead(self._rows)

    @cached_property
    def T(self) -> PETSc.Mat:
        """The transfer: all dofs of W by all dofs of V, at the last converged positions."""
        return transfer_matrix(self._rows.basis, self.W, self.V)

    @cached_property
    def active_nodes(self) -> NDArray[np.int32]:
        """Nodes of V with weight that this rank owns, local numbers, sorted."""
        return active_nodes(self._rows.basis, self.W, self.V)

    @property
    def active_dofs(self) -> NDArray[np.int64]:
        """Global dofs of V with weight that this rank owns, sorted."""
        bs = self.V.dofmap.index_map_bs
        start = self.V.dofmap.index_map.local_range[0]
        return np.asarray(
            ((self.active_nodes + start)[:, None] * bs + np.arange(bs)).ravel(), dtype=np.int64
        )

    def weights(self) -> Weights:
        """Return the published weights S_ip and grad S_ip of the current configuration.

        Returns:
            Compressed rows, one for each particle this rank owns (Sadeghirad, Brannon &
            Guilkey 2013; their body force uses these, ours integrates over the undeformed
            body, which is the same for triangles and undistorted quadrilaterals).
        """
        _, average, gradient = self._domain_averages()
        weights = sum_by_particle(average, gradient, self._rows.basis, self.domain_nodes)
        return weights if self.deletion is None else without_deleted(weights, self.deleted)

    @property
    def domains(self) -> NDArray[np.float64]:
        """Corners of the particles' own domains, shape ``(n, k, gdim)``.

        For cpdi2 they are those of the displaced body mesh, for cpdi parallelograms, for gimp
        boxes; for mpm, whose particles are points, parallelograms of their volume.
        """
        if self.method == "cpdi2":
            positions = self._nodes[self.domain_nodes] + self._of_domains(self._converged)
            return np.asarray(positions)
        state = self._state()
        if self.method == "gimp":
            return boxes(state, self._domain_update == "stretch")
        return np.asarray(state.centroid[:, None] + state.arms())

    @property
    def converged_displacement(self) -> NDArray[np.float64]:
        """Displacement at the last converged step, on the local dofs of W."""
        return self._converged.ravel()

    @property
    def node_positions(self) -> NDArray[np.float64]:
        """Positions of this rank's nodes of W at the last converged step, shape ``(N, gdim)``."""
        return np.asarray(self._nodes + self._converged)

    @property
    def initial_domains(self) -> NDArray[np.float64]:
        """Corners of the undeformed domains, shape ``(n, k, gdim)``."""
        return np.asarray(self._nodes[self.domain_nodes])

    def outlined(self, domains: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the equispaced nodes of domains that are given by their own nodes.

        Args:
            domains: Nodes of domains, shape ``(n, k, gdim)``.
        """
        degree = self._shape_functions.degree
        if degree == 1:
            return domains
        cell = self.mesh.basix_cell()
        element = _compat.equispaced_element(cell, degree, self._gdim).basix_element
        table = self._shape_functions.tabulate(0, element.points)[0, :, :, 0]
        return np.asarray(np.einsum("qk,nki->nqi", table, domains))

    def _domain_averages(
        self,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        corners = self._rows.corners
        return domain_weights(
            self.domains if corners is None else corners,
            self._shape_functions,
            self.mesh.basix_cell(),
            self._exact_degree,
        )

    @property
    def node_basis(self) -> PointBasis:
        """The background basis at the local nodes of W, at the last converged positions."""
        return self._rows.basis

    @property
    def background_basis(self) -> BackgroundBasis:
        """What evaluates the basis of V at points."""
        return self._background

    def quadrature_points(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions ``(n nq, gdim)`` and volumes ``(n nq,)`` of the history's points.

        They are those of the last converged step, without deleted particles.
        """
        there = ~self.deleted
        nodal = self._nodes[self.domain_nodes] + self._of_domains(self._converged)
        points = np.einsum("qk,nki->nqi", self.quadrature.shapes, nodal[there])
        jacobian = np.linalg.det(np.eye(self._gdim) + self._converged_gradient()[there])
        volumes = self.quadrature.weights[there] * jacobian
        return points.reshape(-1, self._gdim), volumes.ravel()

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
        return self._of_domains(np.asarray(nodal, dtype=np.float64))

    def displacement_gradient(self, axisymmetric: bool = False) -> NDArray[np.float64]:
        """Return ``grad d`` at the history's points.

        Args:
            axisymmetric: Whether to add the hoop stretch ``d_r / R``.

        Returns:
            Shape ``(n, nq, gdim, gdim)``, or ``(n, nq, 3, 3)`` where axisymmetric.
        """
        gradient = self._present_gradient()
        if not axisymmetric:
            return gradient
        whole = np.zeros((*gradient.shape[:2], 3, 3))
        whole[:, :, :2, :2] = gradient
        radial = np.einsum("qk,nk->nq", self.quadrature.shapes, self._nodal()[:, :, 0])
        whole[:, :, 2, 2] = radial / self.radii
        return whole

    def _present_gradient(self) -> NDArray[np.float64]:
        """Return ``grad d`` at the history's points, of the same displacement only once."""
        d = self.displacement.x.array
        if self.deletion is not None:
            return self.quadrature.displacement_gradient(self._nodal())
        if self._gradient is not None and np.array_equal(self._gradient[0], d):
            return self._gradient[1]
        gradient = self.quadrature.gradient_of(np.asarray(d), self.domain_nodes)
        self._gradient = np.array(d, dtype=np.float64), gradient
        return gradient

    @property
    def radii(self) -> NDArray[np.float64]:
        """Undeformed radius of the history's points, shape ``(n, nq)``."""
        radii = self._nodes[self.domain_nodes][:, :, 0]
        return np.asarray(np.einsum("qk,nk->nq", self.quadrature.shapes, radii))

    def point_volumes(self, axisymmetric: bool = False) -> NDArray[np.float64]:
        """Return the reference volume of the history's points, shape ``(n, nq)``.

        Args:
            axisymmetric: Whether it is that of a body of revolution, all around.
        """
        weights = self.quadrature.weights
        return weights * (2.0 * np.pi * self.radii) if axisymmetric else weights

    def require_radius(self) -> None:
        """Raise an error unless ``x[0]`` can be a radius (collective)."""
        with agree(self.mesh.comm):
            if self._gdim != 2:
                raise MPMError("An axisymmetric body is a mesh in the (r, z) plane.")
            left = self._nodes[self.domain_nodes][:, :, 0].min(axis=1) < -1e-12
            if left.any():
                raise MPMError(
                    "The domains of {particles} have a negative radius; an axisymmetric body "
                    "lies at x[0] >= 0.",
                    self.global_index[left],
                )

    def attach(self, history: ConstitutiveHistory) -> None:
        """Let a history answer for stress and internal variables."""
        self._constitutive = history

    def _average(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return volume averages of values ``(n, nq, ...)`` over the undeformed domains."""
        weights = self.point_volumes(self._axisymmetric)
        share = weights / weights.sum(axis=1, keepdims=True)
        return np.asarray(np.einsum("nq,nq...->n...", share, values))

    @property
    def deformation_gradient(self) -> NDArray[np.float64]:
        """Deformation gradient, shape ``(n, 3, 3)`` (volume averages, plane strain in 2-D)."""
        gradient = self._average(self.displacement_gradient(self._axisymmetric))
        dim = gradient.shape[1]
        F = np.tile(np.eye(3), (self.num_local, 1, 1))
        F[:, :dim, :dim] += gradient
        return F

    @property
    def _axisymmetric(self) -> bool:
        return self._constitutive is not None and self._constitutive.axisymmetric

    @property
    def initial_volume(self) -> NDArray[np.float64]:
        """Volume of the undeformed domains, shape ``(n,)``; an area in the plane."""
        return self._initial_volume.copy()

    @property
    def volume(self) -> NDArray[np.float64]:
        """Volume of the domains now, shape ``(n,)``; an area in the plane."""
        exact = self._exact_quadrature()
        ratio = volume_ratio(exact.displacement_gradient(self._nodal()))
        return np.asarray((exact.weights * ratio).sum(axis=1))

    @property
    def initial_centroid(self) -> NDArray[np.float64]:
        """Centroid of the undeformed domains, shape ``(n, gdim)``."""
        return self._mean(self._nodes[self.domain_nodes])

    @property
    def centroid(self) -> NDArray[np.float64]:
        """Particle positions: mean of ``X + d`` over the domains, shape ``(n, gdim)``."""
        return self._mean(self._nodes[self.domain_nodes] + self._nodal())

    def _mean(self, nodal: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.einsum("nk,nki->ni", self._averages, nodal))

    def _exact_quadrature(self) -> DomainQuadrature:
        """Return the rule exact for body force and mass, many times the size of a body's rest."""
        return DomainQuadrature(self.mesh, self._shape_functions, self._exact_degree)

    @cached_property
    def _initial_volume(self) -> NDArray[np.float64]:
        return np.asarray(self._exact_quadrature().weights.sum(axis=1))

    @cached_property
    def _averages(self) -> NDArray[np.float64]:
        """Averages of the shape functions over the undeformed domains, shape ``(n, k)``."""
        exact = self._exact_quadrature()
        return np.asarray(exact.weights @ exact.shapes / exact.weights.sum(axis=1)[:, None])

    @property
    def has_material(self) -> bool:
        """Whether a problem with a material governs these particles."""
        return self._constitutive is not None

    @property
    def stress(self) -> NDArray[np.float64]:
        """Cauchy stress, shape ``(n, 3, 3)`` (volume averages).

        With ``f_bar="pair"`` or ``"patch"`` the part of it that is constant on a patch is
        recovered linearly from the patches around.

        Raises:
            MPMError: The particles have no material (a problem written in UFL).
        """
        history = self._history("stress")
        return self._average(history.cauchy_stress()) + history.recovery

    @property
    def plastic_strain(self) -> NDArray[np.float64]:
        """Accumulated plastic strain ``sqrt(2/3) |d eps_p|``, shape ``(n,)``."""
        return self._average(self._history("plastic strain").plastic_strain())

    @property
    def initial_points(self) -> NDArray[np.float64]:
        """Undeformed positions of the quadrature points, shape ``(n, nq, gdim)``."""
        return self._at_points(self._nodes[self.domain_nodes])

    @property
    def points(self) -> NDArray[np.float64]:
        """Positions of the quadrature points, shape ``(n, nq, gdim)``."""
        return self._at_points(self._nodes[self.domain_nodes] + self._nodal())

    def _at_points(self, nodal: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.einsum("qk,nki->nqi", self.quadrature.shapes, nodal))

    @property
    def point_stress(self) -> NDArray[np.float64]:
        """Cauchy stress at the quadrature points, shape ``(n, nq, 3, 3)``.

        Raises:
            MPMError: The particles have no material (a problem written in UFL).
        """
        return self._history("stress").cauchy_stress()

    @property
    def point_plastic_strain(self) -> NDArray[np.float64]:
        """Accumulated plastic strain at the quadrature points, shape ``(n, nq)``."""
        return self._history("plastic strain").plastic_strain()

    @property
    def point_deformation_gradient(self) -> NDArray[np.float64]:
        """Deformation gradient at the quadrature points, shape ``(n, nq, 3, 3)``."""
        gradient = self.displacement_gradient(self._axisymmetric)
        dim = gradient.shape[2]
        F = np.tile(np.eye(3), (*gradient.shape[:2], 1, 1))
        F[:, :, :dim, :dim] += gradient
        return F

    def fields(self) -> dict[str, NDArray[np.float64]]:
        """Return what is known of each particle, for output: arrays ``(n, ...)`` by name.

        ``volume_ratio`` and, where there is a material, ``stress`` (Cauchy), ``pressure``
        (mean of the normal stresses, compression positive) and ``plastic_strain``; with
        ``outside="delete"`` also ``deleted`` (1 where a particle is).
        """
        values = {"volume_ratio": self.volume / self.initial_volume}
        if self.has_material:
            values["stress"] = self.stress
            values["pressure"] = -np.trace(values["stress"], axis1=1, axis2=2) / 3.0
            values["plastic_strain"] = self.plastic_strain
        if self.deletion is not None:
            values["deleted"] = self.deleted.astype(np.float64)
        return values

    def _history(self, what: str) -> ConstitutiveHistory:
        if self._constitutive is None:
            raise MPMError(
                f"These particles have no material, so no {what}; give them one with "
                "QuasiStaticProblem, or evaluate your own UFL expression."
            )
        return self._constitutive

    def options(self) -> dict[str, Any]:
        """Return method and degrees, for a checkpoint to know these particles by."""
        return {
            "method": self.method,
            "degree": self.W.ufl_element().degree,
            "quadrature_degree": self._degree,
            "domain_update": self._domain_update,
            "delete": self.deletion is not None,
        }

    def converged_state(self) -> dict[str, NDArray[Any]]:
        """Return the last converged step cell by cell, for a checkpoint: arrays ``(n, ...)``."""
        nodal = self._converged[self.domain_nodes]
        if self.deletion is None:
            return {"displacement": nodal}
        return {
            "displacement": nodal,
            "deleted": self.deletion.mask,
            "kept": self.deletion.kept(nodal),
        }

    def set_converged_state(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Make what :meth:`converged_state` once returned the last converged step (collective)."""
        d = self.displacement.x
        d.array.reshape(-1, self._gdim)[self.domain_nodes] = arrays["displacement"]
        d.scatter_forward()
        if self.deletion is not None:
            self.deletion.restore(np.zeros_like(self.deletion.mask), arrays["kept"])
            self.deletion.restore(arrays["deleted"], arrays["kept"])
        self.commit()

    def crossed(self) -> NDArray[np.int64]:
        """Return global indices of quadrilaterals whose edges cross.

        A quadrilateral with one corner turned inwards is concave, with two it crosses itself
        and part of it is inverted. Other domains cannot cross without ``det F <= 0``.
        """
        if self.mesh.basix_cell() != basix.CellType.quadrilateral or self.method != "cpdi2":
            return self.global_index[:0]
        if self._shape_functions.degree > 1:
            return self.global_index[:0]
        inwards = (self._corner_jacobians() <= 0.0).sum(axis=1)
        return np.asarray(self.global_index[inwards >= 2])

    @cached_property
    def _jacobian_bound(self) -> JacobianBound:
        return JacobianBound(self.mesh.basix_cell(), self._shape_functions)

    def folded(self) -> NDArray[np.int64]:
        """Return global indices of domains whose map is not one to one everywhere.

        Decided by a bound (Bernstein coefficients of the Jacobian), not by sampling, at the
        present displacement. Such a domain covers a part of itself twice; it goes on as long as
        ``det F > 0`` at its quadrature points.
        """
        now = self._nodes[self.domain_nodes] + self._nodal()
        sign = np.sign(self._orientation[:, 0])
        return np.asarray(self.global_index[self._jacobian_bound.vanishes(now, sign)])

    def _corner_jacobians(self) -> NDArray[np.float64]:
        """Return det J at the corners of the present domains, positive as in the undeformed."""
        points = basix.geometry(self.mesh.basix_cell())
        slopes = self._shape_functions.tabulate(1, points)[1:, :, :, 0]
        now = self._nodes[self.domain_nodes] + self._nodal()
        det = np.linalg.det(np.einsum("jqk,nki->nqij", slopes, now))
        return np.asarray(np.sign(self._orientation) * det)

    def domain_distortion(self) -> NDArray[np.float64]:
        """Return the smallest det J of each domain over its mean, shape ``(n,)``.

        One for an undistorted domain, zero or less where a quadrilateral is concave. For curved
        domains and hexahedra it is a bound from below.
        """
        mean = self.volume / quadrature_rule(self.mesh.basix_cell(), 0)[1].sum()
        now = self._nodes[self.domain_nodes] + self._nodal()
        least = self._jacobian_bound.lower_bound(now, np.sign(self._orientation[:, 0]))
        return np.asarray(least / np.abs(mean))

    @cached_property
    def _orientation(self) -> NDArray[np.float64]:
        """Sign of the reference map of each undeformed domain, shape ``(n, 1)``."""
        middle = basix.geometry(self.mesh.basix_cell()).mean(axis=0)[None]
        slopes = self._shape_functions.tabulate(1, middle)[1:, :, :, 0]
        corners = self._nodes[self.domain_nodes]
        return np.asarray(np.linalg.det(np.einsum("jqk,nki->nqij", slopes, corners)))

    def inverted(self) -> NDArray[np.int64]:
        """Return global indices of domains with ``det F <= 0`` or not finite at a point."""
        gradient = self.displacement_gradient()
        return np.asarray(self.global_index[~(volume_ratio(gradient) > 0.0).all(axis=1)])

    def commit(self) -> NDArray[np.float64]:
        """Make the present displacement the converged one; return what that was before."""
        before = self._converged
        present = self.displacement.x.array.reshape(-1, self._gdim)
        self.restore(np.array(present, dtype=np.float64))
        return before

    def restore(self, converged: NDArray[np.float64]) -> None:
        """Set the converged displacement, shape ``(N, gdim)`` at the local nodes of W."""
        self._converged = converged
        for name in ("_rows", "active_nodes", "T"):
            self.__dict__.pop(name, None)

    def roll_back(self) -> None:
        """Restore the converged displacement."""
        self.displacement.x.array[:] = self._converged.ravel()
        self.increment.x.array[:] = 0.0
